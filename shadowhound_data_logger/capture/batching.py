"""Samples become batches, a batch becomes one object. Plain Python, owned by the intake thread."""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.capture.gate import STEP_BACK_NS
from shadowhound_data_logger.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.model import Batch, Sample
from shadowhound_data_logger.options import ARCHIVES

MAX_BATCH_BYTES: Final = 4 << 20
"""A batch is closed early at this size, so that memory is bounded whatever a topic sends; as JSON it is four times as large."""
MAX_ARCHIVE_BYTES: Final = 16 << 20
"""The same where messages stay about as large as they are. A second of the Go2's camera or clouds is 2 to 6 MB, of raw images
27 MB. One such batch may be open, as much again be in the making in each encoder, and the queue holds four."""
MAX_BATCH_MESSAGES: Final = 10_000
"""The same for messages so small that their bytes say little; the queue holds five such batches."""
MAX_BATCH_S: Final = 60.0
"""How long a batch that is only limited in number stays open: what is in memory alone can be lost."""


class Batcher:
    """The open batch of one topic: one message each, or whole windows of ``batch_s`` in UTC, at most ``batch_count`` messages.

    A late sample (of a second publisher with another clock, say) joins the open batch; a clock that was set begins a new one.
    """

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str) -> None:
        self._sensor = sensor.name
        self._topic = topic
        self._type = type_name
        self._window_ns = round(sensor.batch_s * 1e9)
        self._longest_s = sensor.batch_s or MAX_BATCH_S
        self._most = (sensor.batch_count or MAX_BATCH_MESSAGES) if sensor.batched else 1
        self._most_bytes = MAX_ARCHIVE_BYTES if sensor.format in ARCHIVES else MAX_BATCH_BYTES
        self._samples: list[Sample] = []
        self._size = 0
        self._window = 0
        self._opened_s = 0.0

    def add(self, sample: Sample, now_s: float) -> list[Batch]:
        """Take a sample; returns the batches that are closed by it, in order (mostly none, at most two)."""
        closed: list[Batch] = []
        window = sample.stamp_ns // self._window_ns if self._window_ns else 0
        if self._samples and (window > self._window or _is_elsewhere(sample.stamp_ns, self._samples[0].stamp_ns)):
            closed.append(self.close())
        if not self._samples:
            self._window = window
            self._opened_s = now_s
        self._samples.append(sample)
        self._size += len(sample.cdr)
        if len(self._samples) == self._most or self._size >= self._most_bytes:
            closed.append(self.close())
        return closed

    def is_due(self, now_s: float, grace_s: float) -> bool:
        """Whether the window is over by the monotonic clock, though no message of the next one came."""
        return bool(self._samples) and now_s - self._opened_s >= self._longest_s + grace_s

    def __len__(self) -> int:
        return len(self._samples)

    def close(self) -> Batch:
        """The open samples as a batch; there must be some."""
        batch = Batch(self._sensor, self._topic, self._type, tuple(self._samples), self._size)
        self._samples = []
        self._size = 0
        return batch


def _is_elsewhere(stamp_ns: int, first_ns: int) -> bool:
    """Whether the clock was set in between: backwards by more than jitter, or from the boot clock's time to UTC."""
    return stamp_ns < first_ns - STEP_BACK_NS or (stamp_ns < EARLIEST_SANE_NS) != (first_ns < EARLIEST_SANE_NS)
