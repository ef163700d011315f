"""Upload throughput by position of the robot: predicts how long a pull takes, and shows where the WiFi is good."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock, utc
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.shipping.uploader import UploadStatus

SAMPLE_S: Final = 5.0
"""Duration of continuous uploading per sample: shorter ones would measure single objects."""
MAX_SAMPLES: Final = 120
"""Per object: ten minutes of uploading."""
FIRST_S, LONGEST_S = 60.0, 900.0
"""Maximum age of an object: for the first one, so that the throughput is known soon, and for later ones."""
RECENT: Final = 24
"""Number of samples in the median: two minutes of uploading."""
LINK: Final = '_wifi'
"""The sensor of these objects."""


class LinkTrack:
    """Samples the link while there is something to upload.

    New; ``poll`` once per second, on one thread; ``mbps`` from any thread.
    """

    def __init__(self, upload: Callable[[], UploadStatus], marks: Callable[[int], Mapping[str, str]], robot: str, clock: Clock,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``marks`` returns the pose at a time, as metadata (``RobotTrack.marks``)."""
        self._upload = upload
        self._marks = marks
        self._robot = robot
        self._clock = clock
        self._monotonic = monotonic
        self._began: tuple[float, int] | None = None
        self._samples: list[dict[str, Any]] = []
        self._max_age_s = FIRST_S
        self._recent = deque[float](maxlen=RECENT)

    @property
    def mbps(self) -> float | None:
        """Recent upload throughput in Mbit/s; None before the first sample."""
        return round(median(self._recent), 3) if self._recent else None

    def poll(self, *, is_last: bool = False) -> DataObject | None:
        """An object of samples, when it is full or old enough, or at the end."""
        now_s, status = self._monotonic(), self._upload()
        is_down = status.state == 'store_down'
        if not is_down and not (status.state == 'shipping' and status.in_flight):
            self._began = None
        elif self._began is None:
            self._began = now_s, status.sent_bytes
        elif now_s - self._began[0] >= SAMPLE_S:
            self._sample(8e-6 * (status.sent_bytes - self._began[1]) / (now_s - self._began[0]), is_down=is_down)
            self._began = now_s, status.sent_bytes
        if not self._samples:
            return None
        age_s = (self._clock.wall_ns() - self._samples[0]['stamp_ns']) / SECOND
        return self._object() if is_last or len(self._samples) >= MAX_SAMPLES or age_s >= self._max_age_s else None

    def _sample(self, mbps: float, *, is_down: bool) -> None:
        stamp_ns = self._clock.wall_ns()
        if not is_down:
            self._recent.append(mbps)
        pose = self._marks(stamp_ns).get(meta.POSE, '').split(' ')
        if stamp_ns >= EARLIEST_SANE_NS:
            x, y = (float(pose[0]), float(pose[1])) if len(pose) == 4 else (None, None)
            self._samples.append({'stamp_ns': stamp_ns, 'x': x, 'y': y, 'mbps': round(mbps, 3)})

    def _object(self) -> DataObject:
        samples, self._samples = self._samples, []
        self._max_age_s = LONGEST_S
        start_ns, end_ns = samples[0]['stamp_ns'], samples[-1]['stamp_ns']
        body = json.dumps({'robot': self._robot, 'sensor': LINK, 'samples': samples}).encode()
        return DataObject(
            bucket='sensor-data', key=f'{self._robot}/{LINK}/{utc(start_ns):%Y%m%d/%H%M%S}_wifi.json', body=body,
            content_type='application/json', sensor=LINK, topic=None, type='', samples=0, t_start_ns=start_ns, t_end_ns=end_ns,
            priority=3, metadata={meta.ROBOT: self._robot},
        )  # fmt: skip
