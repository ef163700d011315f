"""How fast uploads went, and where the robot was: what tells how long a pull takes, and where to dock."""

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
"""Of uploading without a pause, for one sample: shorter ones would measure single objects."""
MAX_SAMPLES: Final = 120
"""In one object: ten minutes of uploading."""
FIRST_S, LONGEST_S = 60.0, 900.0
"""From the first sample of an object to its end: of the first object, so that a pace is known soon, and of any other."""
RECENT: Final = 24
"""Samples that the pace is the median of: two minutes of uploading."""
LINK: Final = '_wifi'
"""The sensor of these objects."""


class LinkTrack:
    """Samples the link while there is something to upload.

    New; ``poll`` once a second, on one thread; ``mbps`` from any.
    """

    def __init__(self, upload: Callable[[], UploadStatus], marks: Callable[[int], Mapping[str, str]], robot: str, clock: Clock,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``marks`` has the pose at a time, as metadata (``RobotTrack.marks``)."""
        self._upload = upload
        self._marks = marks
        self._robot = robot
        self._clock = clock
        self._monotonic = monotonic
        self._began: tuple[float, int] | None = None
        self._samples: list[dict[str, Any]] = []
        self._longest_s = FIRST_S
        self._recent = deque[float](maxlen=RECENT)

    @property
    def mbps(self) -> float | None:
        """Megabits a second at which uploads went lately; None before the first sample."""
        return round(median(self._recent), 3) if self._recent else None

    def poll(self, *, is_last: bool = False) -> DataObject | None:
        """An object of samples, when one is full or old enough, or at the end."""
        now_s, status = self._monotonic(), self._upload()
        is_away = status.state == 'store_down'
        if not is_away and not (status.state == 'shipping' and status.in_flight):
            self._began = None
        elif self._began is None:
            self._began = now_s, status.sent_bytes
        elif now_s - self._began[0] >= SAMPLE_S:
            self._sample(8e-6 * (status.sent_bytes - self._began[1]) / (now_s - self._began[0]), is_away=is_away)
            self._began = now_s, status.sent_bytes
        if not self._samples:
            return None
        age_s = (self._clock.wall_ns() - self._samples[0]['stamp_ns']) / SECOND
        return self._object() if is_last or len(self._samples) >= MAX_SAMPLES or age_s >= self._longest_s else None

    def _sample(self, mbps: float, *, is_away: bool) -> None:
        stamp_ns = self._clock.wall_ns()
        if not is_away:
            self._recent.append(mbps)
        pose = self._marks(stamp_ns).get(meta.POSE, '').split(' ')
        if stamp_ns >= EARLIEST_SANE_NS:
            x, y = (float(pose[0]), float(pose[1])) if len(pose) == 4 else (None, None)
            self._samples.append({'stamp_ns': stamp_ns, 'x': x, 'y': y, 'mbps': round(mbps, 3)})

    def _object(self) -> DataObject:
        samples, self._samples = self._samples, []
        self._longest_s = LONGEST_S
        start_ns, end_ns = samples[0]['stamp_ns'], samples[-1]['stamp_ns']
        body = json.dumps({'robot': self._robot, 'sensor': LINK, 'samples': samples}).encode()
        return DataObject(
            bucket='sensor-data', key=f'{self._robot}/{LINK}/{utc(start_ns):%Y%m%d/%H%M%S}_wifi.json', body=body,
            content_type='application/json', sensor=LINK, topic=None, type='', samples=0, t_start_ns=start_ns, t_end_ns=end_ns,
            priority=3, metadata={meta.ROBOT: self._robot},
        )  # fmt: skip
