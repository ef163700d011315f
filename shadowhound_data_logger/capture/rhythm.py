"""When one topic has fallen silent while its publisher is there. Plain Python, fed with the rows of the status.

A topic is missed only where its messages came evenly before: one that is latched, or published when something happens, may
be silent for as long as it likes. One that was never heard is told where there is no connection at all; and where there is
one, unless the topic may be silent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import Any, Final

SILENT_S: Final = 5.0
"""A topic is silent after so long ..."""
SILENT_PERIODS: Final = 10
"""... and after so many of its usual periods."""
ARRIVALS: Final = 10
"""Looks with new messages that it takes to know a topic."""
EVEN: Final = 3.0
"""Most that the longest pause among those may be of the usual one."""
UNMATCHED_S: Final = 10.0
"""Discovery takes a second or two on a WiFi that works."""
UNHEARD_S: Final = 30.0


class Rhythm:
    """New for each topic; ``look`` at each status."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._pauses: deque[tuple[float, int]] = deque(maxlen=ARRIVALS)  # seconds and messages between two looks with news
        self._since_s: float | None = None
        self._heard_s: float | None = None
        self._received = 0

    def look(self, row: Mapping[str, Any], now_s: float) -> str:
        """Why it is to be missed, in words; empty where it is not."""
        if not row['enabled'] or not row['publishers']:
            self._since_s = None
            return ''
        received = row['received'] - row['wrong_type']
        if self._since_s is None:  # whoever publishes it from now on has a rhythm of its own
            self._since_s, self._heard_s, self._received = now_s, None, received
            self._pauses.clear()
        if received > self._received:
            self._hear(row, received, now_s)
        if row['unavailable']:
            return f'nobody can listen to it here: {row["unavailable"]}'
        return self._unheard(row, now_s - self._since_s) if self._heard_s is None else self._stopped(row, now_s - self._heard_s)

    def _hear(self, row: Mapping[str, Any], received: int, now_s: float) -> None:
        heard_s = now_s - (row['age_s'] or 0.0)
        if self._heard_s is not None:
            self._pauses.append((heard_s - self._heard_s, received - self._received))
        self._heard_s, self._received = heard_s, received

    def _unheard(self, row: Mapping[str, Any], waited_s: float) -> str:
        if not row['matched'] and waited_s > UNMATCHED_S:
            hint = f'compare type and QoS (ros2 topic info -v {self._topic}), and the firewall between the two machines'
            return f'its publisher has been there for {waited_s:.0f} s without a connection to it; {hint}'
        if row['matched'] and not row['may_be_silent'] and waited_s > UNHEARD_S:
            hint = f'does it publish (ros2 topic hz {self._topic}), and do large messages get through the network?'
            return f'its publisher has been connected for {waited_s:.0f} s and not one message came; {hint}'
        return ''

    def _stopped(self, row: Mapping[str, Any], silent_s: float) -> str:
        if row['may_be_silent'] or len(self._pauses) < ARRIVALS:
            return ''
        pauses = [pause for pause, _ in self._pauses]
        period_s = sum(pauses) / sum(count for _, count in self._pauses)
        if max(pauses) > EVEN * median(pauses) or silent_s <= max(SILENT_S, SILENT_PERIODS * period_s):
            return ''
        why = 'look at the program that publishes it' if row['matched'] else 'the connection to it is gone: look at the network'
        return f'silent for {silent_s:.0f} s after {1 / period_s:.3g} Hz, though its publisher is there; {why}'
