"""The encoder of each format, and ``encode``, which turns a batch into an object. No input makes it raise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.errors import NameRefused, Rejected
from shadowhound_data_logger.core.keys import KeyTemplate, dated
from shadowhound_data_logger.core.model import Batch, DataObject, Sample
from shadowhound_data_logger.formats.archive import archive, pack_tar, pack_zip
from shadowhound_data_logger.formats.image import encode_jpeg, encode_png
from shadowhound_data_logger.formats.payload import (
    Encoder,
    Fact,
    Job,
    Payload,
    Rejection,
    Rejections,
    encode_cdr,
    one_message,
)
from shadowhound_data_logger.formats.pointcloud import encode_cloud
from shadowhound_data_logger.formats.records import encode_records
from shadowhound_data_logger.formats.types import MessageTypes

ENCODERS: Final[Mapping[str, Encoder]] = {
    'jpeg': one_message(encode_jpeg),
    'png': one_message(encode_png),
    'pcd': one_message(encode_cloud),
    'json': encode_records,
    'cdr': one_message(encode_cdr),
    'zip': archive(pack_zip, 'zip', 'application/zip'),
    'tar': archive(pack_tar, 'tar', 'application/x-tar'),
}
"""Format name in the settings -> encoder. A new format is one file and one line here (and its name in options.FORMATS)."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """The result of encoding a batch: ``object.samples`` plus the sum of ``rejected`` is its number of samples.

    ``object.samples`` includes the corrected samples.
    """

    object: DataObject | None
    """None if no sample could be encoded."""
    rejections: tuple[Rejection, ...] = ()
    """The samples that are not in the object, by reason and publisher."""
    corrected: Mapping[str, int] = field(default_factory=dict)
    """Reason -> number of samples that were corrected and are in the object."""

    @property
    def rejected(self) -> dict[str, int]:
        """Reason -> number of samples that are not in the object."""
        counts = Counter[str]()
        for each in self.rejections:
            counts[each.reason] += each.count
        return dict(counts)

    @property
    def details(self) -> dict[str, str]:
        """Reason -> what was wrong with the first rejected sample."""
        found: dict[str, str] = {}
        for each in self.rejections:
            found.setdefault(each.reason, each.text)
        return found


def encode(batch: Batch, sensor: SensorSettings, robot: str, types: MessageTypes) -> Encoding:
    """Encode a batch in the sensor's format. Thread-safe. A sample that cannot be encoded is counted and skipped."""
    rejections = Rejections()
    encoded = _encode(batch, sensor, robot, types, rejections)
    return Encoding(encoded, tuple(rejections.found.values()), dict(rejections.corrected) if encoded else {})


def _encode(batch: Batch, sensor: SensorSettings, robot: str, types: MessageTypes, rejections: Rejections) -> DataObject | None:
    payload = ENCODERS[sensor.format](Job(batch, sensor, robot, types), rejections)
    if payload is None:
        return None
    pattern = KeyTemplate(sensor.key).pattern(robot=robot, sensor=sensor.name, period_ns=sensor.period_ns, ext=payload.ext)
    try:
        key = dated(pattern, payload.kept[0].stamp_ns)
    except NameRefused as error:
        rejections.add(Rejected('unsafe_key', str(error)), *payload.kept)
        return None
    return _object(batch, sensor, robot, payload, key, pattern)


def _object(batch: Batch, sensor: SensorSettings, robot: str, payload: Payload, key: str, pattern: str) -> DataObject:
    start_ns = min(sample.stamp_ns for sample in payload.kept)
    end_ns = max(sample.stamp_ns for sample in payload.kept)
    metadata = {
        meta.ROBOT: robot,
        meta.SENSOR: sensor.name,
        meta.TOPIC: batch.topic,
        meta.TYPE: batch.type,
        meta.COUNT: str(len(payload.kept)),
        meta.T_START_NS: str(start_ns),
        meta.T_END_NS: str(end_ns),
        **_other_times(payload.kept),
    }
    return DataObject(
        bucket=sensor.bucket,
        key=key,
        body=payload.body,
        content_type=payload.content_type,
        sensor=sensor.name,
        topic=batch.topic,
        type=batch.type,
        samples=len(payload.kept),
        t_start_ns=start_ns,
        t_end_ns=end_ns,
        priority=sensor.priority,
        dedup=sensor.dedup,
        metadata={**{name: _text(fact) for name, fact in payload.facts.items()}, **metadata},
        key_pattern=pattern,
        statistics=payload.statistics,
    )


def _other_times(samples: Sequence[Sample]) -> dict[str, str]:
    """The arrival times of the messages, if known, and the stamps of messages that are dated by their arrival."""
    found: dict[str, str] = {}
    received = [sample.received_ns for sample in samples if sample.received_ns >= EARLIEST_SANE_NS]
    if len(received) == len(samples):
        found |= {meta.RECEIVED_START_NS: str(min(received)), meta.RECEIVED_END_NS: str(max(received))}
    if untrusted := [sample.untrusted_ns for sample in samples if sample.untrusted_ns]:
        found |= {
            meta.STAMP_START_NS: str(min(untrusted)), meta.STAMP_END_NS: str(max(untrusted)),
            meta.BY_ARRIVAL: str(len(untrusted)),
        }  # fmt: skip
    return found


def _text(fact: Fact) -> str:
    return str(fact).lower() if isinstance(fact, bool) else str(fact)
