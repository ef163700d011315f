"""Records a bag for some time and delivers it to the store: ``record_and_upload_rosbag``.

    from shadowhound_data_logger.bags import record_and_upload_rosbag
    record_and_upload_rosbag('patrol', 60)

It leaves the robot slice by slice while it records, and what Tower cannot take now waits in the spool. A process of its own
does it (``node/recording/bag_process.py``), so neither rclpy nor its signals get into the caller's.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from shadowhound_data_logger.core.errors import BagError

PROGRAM: Final = 'shadowhound_data_logger.node.recording.bag_process'
DEADLINE_S: Final = 60.0
"""For the rest of it after the recording; most of a bag is delivered by then."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A bag that is complete, in the store or in the spool."""

    robot: str
    bag: str
    """Its name."""
    messages: int
    slices: int
    bytes: int
    topics: Mapping[str, int]
    """Topic -> messages."""
    dropped: int
    """Messages that this machine was too slow to write, or had no disk for."""
    delivered: bool
    """Whether the store has all of it. Otherwise the spool has the rest and delivers it later."""
    last_error: str
    """Why it is not delivered, if that is known."""

    @property
    def where(self) -> str:
        """Its URL in the store."""
        return f's3://sensor-data/{self.robot}/rosbags/{self.bag}/'


def record_and_upload_rosbag(mission_name: str, duration_s: int) -> Recorded:
    """Record a bag of all topics (of a Unitree, those of the default sensors) at full rate, and upload it while it is recorded.

    A server that is unreachable is not an error: ``delivered`` is then False, and the rest waits in the spool.

    Args:
        mission_name: the bag is called ``<mission_name>_YYYYMMDD_HHMMSS``.
        duration_s: for how long, in seconds.

    Raises:
        BagError: nothing could be recorded.
    """
    found = record(mission_name, duration_s)
    print(f'Uploaded: {found.where}' if found.delivered else f'Waits in the spool: {found.where}')  # noqa: T201 - as the guide's
    return found


def record(name: str, duration_s: float, *, topics: Sequence[str] = (), regex: str = '', robot: str = 'thor',
           deadline_s: float = DEADLINE_S) -> Recorded:  # fmt: skip
    """As above, of these topics and those in which ``regex`` is found. SIGINT ends it early. Raises BagError."""
    command = [sys.executable, '-m', PROGRAM, f'--duration={duration_s}', f'--deadline={deadline_s}', f'--robot={robot}']
    command += [f'--topic={topic}' for topic in topics] + ([f'--regex={regex}'] if regex else []) + ['--', name]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            output, _ = process.communicate()
        except KeyboardInterrupt:  # a terminal tells the child as well; else it is told here, and ends the bag
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate()
    said = _last_line(output, process.returncode)
    if 'error' in said:
        raise BagError(said['error'])
    return Recorded(**said)


def _last_line(output: bytes, code: int) -> dict[str, Any]:
    try:
        return dict(json.loads(output.splitlines()[-1]))
    except (IndexError, ValueError) as error:
        remedy = 'is ROS sourced? its output is above'
        raise BagError(f'the recorder ended with exit code {code} and without a word', remedy=remedy) from error
