"""The services of the bags: ``~/bag/start``, ``~/bag/stop``, ``~/bag/split`` (Trigger) and ``~/bag/pause`` (SetBool).

They answer when it is done, from the thread of the executor; ``message`` names the bag, or says why nothing was done.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from shadowhound_data_logger.bags.recorder import Answer, Recorder

log = logging.getLogger(__name__)


class BagControl:
    """New; open once; close once."""

    def __init__(self, node: Node, recorder: Recorder) -> None:
        self._node = node
        self._recorder = recorder
        self._services: list[Any] = []

    def open(self) -> None:
        asked: dict[str, Callable[[], Answer]] = {
            'start': self._recorder.start, 'stop': self._recorder.stop, 'split': self._recorder.split,
        }  # fmt: skip
        self._services = [
            *(self._node.create_service(Trigger, f'~/bag/{name}', _answering(name, ask)) for name, ask in asked.items()),
            self._node.create_service(SetBool, '~/bag/pause', self._on_pause),
        ]

    def close(self) -> None:
        while self._services:
            self._node.destroy_service(self._services.pop())

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        return _say('pause', self._recorder.pause(paused=request.data), response)


def _answering(name: str, ask: Callable[[], Answer]) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
    def on_call(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return _say(name, ask(), response)

    return on_call


def _say(name: str, answer: Answer, response: Any) -> Any:
    response.success, response.message = answer
    log.log(logging.INFO if response.success else logging.WARNING, '~/bag/%s: %s', name, response.message)
    return response
