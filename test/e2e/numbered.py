"""Strings with a publisher's name and a sequence number, published in the background until stopped. Does not depend on DDS."""

from __future__ import annotations

import struct
import threading
import time
from array import array
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any


def message(name: str, number: int, size: int) -> bytes:
    """A std_msgs/String in CDR: ``name:number:``, padded to this size."""
    text = f'{name}:{number}:'.ljust(size).encode() + b'\0'
    return b'\0\1\0\0' + struct.pack('<I', len(text)) + text


def parse_numbered(text: str) -> tuple[str, int]:
    """Name and number of a String."""
    name, number, _ = text.split(':')
    return name, int(number)


class Numbered:
    """One thread per topic; late ones catch up. The numbers of a topic continue when it is started again.

    ``write`` raises TimeoutError for a message that it did not send: that message is retried, and sent once.
    """

    def __init__(self, write: Callable[[str, bytes], None]) -> None:
        self._write = write
        self._sent: dict[str, int] = {}
        self._times: dict[str, array[int]] = {}
        self._running: dict[str, tuple[threading.Event, threading.Thread]] = {}

    @staticmethod
    def takes(order: Mapping[str, Any]) -> bool:
        """Whether it handles this command."""
        return order['do'] in {'begin_numbered', 'halt_numbered', 'pauses_numbered'}

    def obey(self, order: Mapping[str, Any]) -> int | list[tuple[int, int]] | None:
        """The number sent, when stopping; or the pauses longer than requested, wall clock in ns."""
        if order['do'] == 'pauses_numbered':
            return [pair for pair in pairwise(self._times[order['topic']]) if pair[1] - pair[0] > order['longer_ns']]
        if order['do'] == 'halt_numbered':
            return self._halt(order['topic'])
        self._begin(order['topic'], order['name'], order['size'], order['period_s'])
        return None

    def _begin(self, topic: str, name: str, size: int, period_s: float) -> None:
        over = threading.Event()
        thread = threading.Thread(target=self._publish, args=(topic, name, size, period_s, over), daemon=True)
        self._running[topic] = over, thread
        thread.start()

    def _halt(self, topic: str) -> int:
        over, thread = self._running.pop(topic)
        over.set()
        thread.join()
        return self._sent[topic]

    def _publish(self, topic: str, name: str, size: int, period_s: float, over: threading.Event) -> None:
        due = time.monotonic()
        while not over.wait(max(0.0, due - time.monotonic())):
            number = self._sent.get(topic, 0)
            at_ns = time.time_ns()
            try:
                self._write(topic, message(name, number, size))
            except TimeoutError:
                continue
            due += period_s
            self._sent[topic] = number + 1
            self._times.setdefault(topic, array('q')).append(at_ns)
