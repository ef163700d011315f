"""Upload speed by position."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from spool.making import NOON_NS, FakeClock

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.node.keeping.link_track import MAX_SAMPLES, LinkTrack
from shadowhound_data_logger.shipping.uploader import UploadStatus

IDLE = UploadStatus('idle', '', 0, 0, 0, 0, 0)


class Link:
    """Time, and an uploader that sends as the test sets it."""

    def __init__(self) -> None:
        self.clock, self.now_s, self.status = FakeClock(), 0.0, IDLE
        self.track = LinkTrack(lambda: self.status, self.marks, 'thor', self.clock, lambda: self.now_s)
        self.made: list[DataObject] = []

    @staticmethod
    def marks(stamp_ns: int) -> dict[str, str]:
        return {'pose': f'{(stamp_ns - NOON_NS) / SECOND:.0f} 2 0 odom'}

    def send(self, seconds: int, bytes_a_second: int, state: str = 'shipping') -> None:
        for _ in range(seconds):
            self.now_s += 1
            self.clock.now_ns += SECOND
            sent = self.status.sent_bytes + bytes_a_second
            self.status = replace(self.status, state=state, in_flight=int(state == 'shipping'), sent_bytes=sent)
            if (found := self.track.poll()) is not None:
                self.made.append(found)

    def end(self) -> list[dict[str, Any]]:
        last = self.track.poll(is_last=True)
        assert last
        assert isinstance(last.body, bytes)
        samples: list[dict[str, Any]] = json.loads(last.body)['samples']
        return samples


def test_a_sample_is_five_seconds_without_a_pause() -> None:
    """Bursts are no measure of the link, and an outage is 0 at the robot's position."""
    link = Link()
    link.send(11, 500_000)
    link.send(3, 0, 'idle')
    for _ in range(5):
        link.send(2, 900_000)
        link.send(1, 0, 'idle')
    link.send(6, 0, 'store_down')
    samples = link.end()
    assert [(one['x'], one['y'], one['mbps']) for one in samples] == [(6.0, 2.0, 4.0), (11.0, 2.0, 4.0), (35.0, 2.0, 0.0)]
    assert link.track.mbps == 4.0


def test_the_first_object_comes_after_a_minute_and_others_after_ten() -> None:
    """So that a speed is known early; and no object is created if nothing was sent."""
    link = Link()
    assert link.track.poll(is_last=True) is None
    link.send(65, 1000)
    assert link.made == []
    link.send(1, 1000)
    link.send(5 * MAX_SAMPLES, 1000)
    assert [(one.sensor, one.key) for one in link.made] == [
        ('_wifi', 'thor/_wifi/20251018/120006_wifi.json'), ('_wifi', 'thor/_wifi/20251018/120111_wifi.json'),
    ]  # fmt: skip
