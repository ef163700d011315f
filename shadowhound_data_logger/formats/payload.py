"""What an encoder receives (``Job``) and returns (``Payload``, ``Rejections``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.formats.cdr import ENCAPSULATION_BYTES
from shadowhound_data_logger.formats.types import MessageTypes

Fact = str | int | float


@dataclass(frozen=True, slots=True)
class Job:
    """One batch to encode, with its sensor's settings."""

    batch: Batch
    sensor: SensorSettings
    robot: str
    types: MessageTypes


@dataclass(frozen=True, slots=True)
class Payload:
    """The content of an object. ``kept`` has its samples in their order, at least one."""

    body: bytes
    kept: tuple[Sample, ...]
    ext: str
    content_type: str
    facts: Mapping[str, Fact] = field(default_factory=dict)
    """Properties of the content: lower-case names; values are numbers or printable ASCII. They become the object's S3 user
    metadata, or in an archive the JSON next to the file."""
    statistics: bytes = b''
    """Statistics of the numbers in it, as ``pack_statistics`` returns them; empty if they were not computed."""
    corrected: str = ''
    """A word for what was wrong with the message, if it was corrected and stored because only one reading is possible."""


@dataclass(slots=True)
class Rejection:
    """Messages of one publisher that were rejected for one reason."""

    reason: str
    publisher: str
    """Its gid; '' if unknown."""
    text: str
    """A sentence: what was wrong with the first one."""
    count: int = 0
    remedy: str = ''
    """What to do about it, if that differs from the remedy for the reason in general."""


@dataclass(frozen=True, slots=True)
class Rejections:
    """The samples of a batch that are not in its object, and counts of those that were corrected."""

    found: dict[tuple[str, str], Rejection] = field(default_factory=dict)
    """By reason and publisher."""
    corrected: Counter[str] = field(default_factory=Counter)
    """What was wrong -> number of samples in the object that were corrected."""

    def add(self, error: Rejected, *samples: Sample) -> None:
        for sample in samples:
            key = error.reason, sample.publisher or ''
            known = self.found.setdefault(key, Rejection(*key, error.what, remedy=error.remedy))
            known.count += 1

    def add_corrected(self, payload: Payload) -> None:
        """Count a message that is stored, if it was corrected."""
        if payload.corrected:
            self.corrected[payload.corrected] += 1


Encoder = Callable[[Job, Rejections], 'Payload | None']
"""Makes one payload from a job and adds the unusable samples to the rejections; returns None if no sample is usable."""
OneMessage = Callable[[Job, Sample], Payload]
"""Makes a payload from one message, or raises Rejected."""


def one_message(encode: OneMessage) -> Encoder:
    """An encoder for a format that holds a single message.

    The settings reject batching for such a format. If a batch arrives anyway, samples after the first usable one count as
    ``surplus``.
    """

    def encoder(job: Job, rejections: Rejections) -> Payload | None:
        payload = None
        for sample in job.batch.samples:
            if payload is not None:
                rejections.add(Rejected('surplus', f'{job.sensor.format} holds one message'), sample)
                continue
            try:
                payload = encode(job, sample)
                rejections.add_corrected(payload)
            except Rejected as error:
                rejections.add(error, sample)
        return payload

    return encoder


def encode_cdr(job: Job, sample: Sample) -> Payload:  # noqa: ARG001 - the signature of OneMessage
    """The bytes of one message; needs no definition. Raises Rejected ``malformed`` if they are too short for CDR."""
    if len(sample.cdr) < ENCAPSULATION_BYTES:
        raise Rejected('malformed', f'{len(sample.cdr)} bytes are not CDR')
    return Payload(sample.cdr, (sample,), 'cdr', 'application/octet-stream')


def verbatim(sample: Sample, why: str, facts: Mapping[str, Fact], corrected: str = '') -> Payload:
    """The unconverted bytes of a message that the sensor's format cannot represent. ``why`` is one word."""
    return Payload(sample.cdr, (sample,), 'cdr', 'application/octet-stream', {**facts, 'verbatim': why}, corrected=corrected)
