"""The node's services: ``~/flush`` makes durable what is open, ``~/pause`` stops storing while everything is still counted.

Both answer when it is done, from the thread of the executor: for up to ``FLUSH_S`` only other services wait meanwhile.
"""

from __future__ import annotations

import logging
import time
from typing import Any, Final

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from shadowhound_data_logger.capture.intake import Intake
from shadowhound_data_logger.encode.queue import BatchQueue
from shadowhound_data_logger.spool.writer import SpoolWriter

log = logging.getLogger(__name__)

FLUSH_S: Final = 5.0
"""A caller is told what has not been done by then; it takes a fraction of that unless the disk is slow."""


class Control:
    """New; open once; close once."""

    def __init__(self, node: Node, intake: Intake, queue: BatchQueue, writer: SpoolWriter) -> None:
        self._node = node
        self._intake = intake
        self._queue = queue
        self._writer = writer
        self._services: list[Any] = []

    def open(self) -> None:
        self._services = [
            self._node.create_service(Trigger, '~/flush', self._on_flush),
            self._node.create_service(SetBool, '~/pause', self._on_pause),
        ]

    def close(self) -> None:
        while self._services:
            self._node.destroy_service(self._services.pop())

    def flush(self, deadline_s: float = FLUSH_S) -> tuple[bool, str]:
        """Spool all that was taken or waits to be; whether that worked, and what became durable, in words."""
        end_s = time.monotonic() + deadline_s
        before = self._writer.written()
        stages = {
            'intake': self._intake.flush,
            'encode pool': self._queue.finished,
            'spool writer': self._writer.flush,
        }
        for name, flush in stages.items():
            if not flush(max(0.0, end_s - time.monotonic())):
                return False, f'not everything is spooled: the {name} did not finish within {deadline_s:g} s'
        objects, messages = (now - then for now, then in zip(self._writer.written(), before, strict=True))
        return True, f'{_count(objects, "object")} with {_count(messages, "message")} spooled'

    def pause(self, *, paused: bool, deadline_s: float = FLUSH_S) -> tuple[bool, str]:
        """Begin or end a pause; whether it is in force, and what became of the open batches, in words."""
        if paused is self._intake.paused:
            return True, 'paused already' if paused else 'not paused'
        end_s = time.monotonic() + deadline_s
        if not self._intake.pause(deadline_s, paused=paused):
            return False, f'the intake did not do it within {deadline_s:g} s; it does as soon as it can'
        if not paused:
            return True, 'messages are stored again'
        _, spooled = self.flush(end_s - time.monotonic())
        return True, f'paused: messages are counted and not stored, delivery goes on; {spooled}'

    def _on_flush(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self.flush()
        log.log(logging.INFO if response.success else logging.WARNING, '~/flush: %s', response.message)
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = self.pause(paused=request.data)
        log.log(logging.INFO if response.success else logging.WARNING, '~/pause: %s', response.message)
        return response


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'
