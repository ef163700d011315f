"""Objects of the default profile, of the simulated robot's sizes, without ROS."""

from __future__ import annotations

import os
from collections.abc import Iterator
from heapq import merge
from typing import Final

from shadowhound_data_logger.core.config import DEFAULT_SENSORS
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.spool.spool import Spool

LIVE: Final = 'live-'
"""Part of the keys of objects made while a backlog is uploaded."""
SIZES: Final = {
    'camera': 38_000, 'lidar': 311_000, 'imu': 25_000, 'odom': 400, 'states': 9_000, 'joints': 25_000, 'lowstate': 22_000,
}  # fmt: skip
"""Bytes per object, measured with ``sim_go2_node``."""
PERIODS_S: Final = {name: 10.0 if name == 'lowstate' else 1.0 for name in SIZES}
_BODIES: Final = {name: os.urandom(size) for name, size in SIZES.items()}


def arrivals(seconds: float) -> Iterator[tuple[float, str]]:
    """(time, sensor) of each object in this many seconds, in order."""

    def stream(name: str, period_s: float) -> Iterator[tuple[float, str]]:
        return ((number * period_s, name) for number in range(int(seconds / period_s)))

    return merge(*(stream(name, period_s) for name, period_s in PERIODS_S.items()))


def make(sensor: str, name: str) -> DataObject:
    """One object with unique content."""
    priority = int(DEFAULT_SENSORS[sensor]['priority'])
    head = f'{sensor}/{name}'.encode()
    return DataObject(
        bucket='sensor-data', key=f'thor/{sensor}/20251018/{name}.bin', body=head + _BODIES[sensor][len(head) :],
        content_type='application/octet-stream', sensor=sensor, topic=f'/{sensor}', type='t', samples=1, t_start_ns=0,
        t_end_ns=0, priority=priority, metadata={'robot': 'thor'},
    )  # fmt: skip


def receive(spool: Spool, item: DataObject) -> None:
    """Account for the message of an object that is about to be spooled."""
    with spool.accounts.entry(str(item.topic)) as account:
        span = account.publishers.get('robot')
        account.receive('robot', ((span.last if span else 0) or 0) + 1)
