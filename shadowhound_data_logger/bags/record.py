"""Records a bag for some time and uploads it to the store: ``record_and_upload_rosbag``.

    from shadowhound_data_logger.bags import record_and_upload_rosbag
    record_and_upload_rosbag('patrol', 60)

The bag is uploaded slice by slice during the recording; if Tower is unreachable, slices wait in the spool. A separate process
records (``node/recording/bag_process.py``), so neither rclpy nor its signal handlers run in the caller's process.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from shadowhound_data_logger.core.config import home
from shadowhound_data_logger.core.errors import BagError
from shadowhound_data_logger.spool.local_robot import robot_of_recorder

PROGRAM: Final = 'shadowhound_data_logger.node.recording.bag_process'
DEADLINE_S: Final = 60.0
"""Maximum time to deliver the rest after the recording; most of a bag has been delivered by then."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A complete bag, in the store or in the spool."""

    robot: str
    bag: str
    """Its name."""
    messages: int
    slices: int
    bytes: int
    topics: Mapping[str, int]
    """Topic -> messages."""
    dropped: int
    """Messages that were not written, because the machine was too slow or the disk was full."""
    delivered: bool
    """Whether the store has all of it; otherwise the spool delivers the rest later."""
    last_error: str
    """Why it was not delivered, if known."""

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


def record(name: str, duration_s: float, *, topics: Sequence[str] = (), regex: str = '', robot: str = '',
           deadline_s: float = DEADLINE_S) -> Recorded:  # fmt: skip
    """Like ``record_and_upload_rosbag``, for these topics and those that match ``regex``. SIGINT ends it.

    ``robot`` is by default the robot of this machine, as for a node without that parameter. Raises BagError, and SettingError
    where nodes of several robots share this machine.
    """
    robot = robot or robot_of_recorder(os.environ, home(os.environ) / 'spool')
    command = [sys.executable, '-m', PROGRAM, f'--duration={duration_s}', f'--deadline={deadline_s}', f'--robot={robot}']
    command += [f'--topic={topic}' for topic in topics] + ([f'--regex={regex}'] if regex else []) + ['--', name]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            output, _ = process.communicate()
        except KeyboardInterrupt:  # a terminal also interrupts the child; otherwise do it here, so that it ends the bag
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate()
    result = _last_line(output, process.returncode)
    if 'error' in result:
        raise BagError(result['error'])
    return Recorded(**result)


def _last_line(output: bytes, code: int) -> dict[str, Any]:
    try:
        return dict(json.loads(output.splitlines()[-1]))
    except (IndexError, ValueError) as error:
        remedy = 'see its output above; check that ROS is sourced'
        raise BagError(f'the recorder exited with code {code} and without a result', remedy=remedy) from error
