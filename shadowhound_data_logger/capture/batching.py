"""Samples become batches, a batch becomes one object. Plain Python, owned by the intake thread."""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.capture.gate import STEP_BACK_NS
from shadowhound_data_logger.model import Batch, Sample

MAX_BATCH_BYTES: Final = 4 << 20
"""A batch is closed early at this size: memory stays bounded whatever a topic sends."""


class Batcher:
    """The open batch of one topic: whole windows of ``batch_ns`` in UTC, or with 0 one message each.

    A late sample (of a second publisher with another clock, say) joins the open batch; a clock that was set begins a new one.
    """

    def __init__(self, sensor: str, topic: str, type_name: str, batch_ns: int) -> None:
        self._sensor = sensor
        self._topic = topic
        self._type = type_name
        self._batch_ns = batch_ns
        self._samples: list[Sample] = []
        self._size = 0
        self._window = 0
        self._opened_s = 0.0

    def add(self, sample: Sample, now_s: float) -> list[Batch]:
        """Take a sample; returns the batches that are closed by it, in order (mostly none, at most two)."""
        closed: list[Batch] = []
        window = sample.stamp_ns // self._batch_ns if self._batch_ns else 0
        if self._samples and (window > self._window or sample.stamp_ns < self._samples[0].stamp_ns - STEP_BACK_NS):
            closed.append(self.close())
        if not self._samples:
            self._window = window
            self._opened_s = now_s
        self._samples.append(sample)
        self._size += len(sample.cdr)
        if not self._batch_ns or self._size >= MAX_BATCH_BYTES:
            closed.append(self.close())
        return closed

    def is_due(self, now_s: float, grace_s: float) -> bool:
        """Whether the window is over by the monotonic clock, though no message of the next one came."""
        return bool(self._samples) and now_s - self._opened_s >= self._batch_ns / 1e9 + grace_s

    def __len__(self) -> int:
        return len(self._samples)

    def close(self) -> Batch:
        """The open samples as a batch; there must be some."""
        batch = Batch(self._sensor, self._topic, self._type, tuple(self._samples), self._size)
        self._samples = []
        self._size = 0
        return batch
