"""What the registry hands to an encoder and gets back from it."""

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
    """One batch to encode, and all that may be known about it."""

    batch: Batch
    sensor: SensorSettings
    robot: str
    types: MessageTypes


@dataclass(frozen=True, slots=True)
class Payload:
    """The content of an object; ``kept`` are the samples that are in it, in their order, at least one."""

    body: bytes
    kept: tuple[Sample, ...]
    ext: str
    content_type: str
    facts: Mapping[str, Fact] = field(default_factory=dict)
    """What is known of the content: lower-case names, numbers or printable ASCII. It becomes the object's S3 user metadata,
    or in an archive the JSON beside the file."""
    statistics: bytes = b''
    """Of the numbers in it, as ``statistics.packed``; empty where nobody looked."""
    corrected: str = ''
    """What was wrong with the message, by a short word, if it was stored all the same because it has only one reading."""


@dataclass(slots=True)
class Rejection:
    """Messages of one publisher that were rejected for one reason."""

    reason: str
    publisher: str
    """Its gid, '' if that is unknown."""
    text: str
    """What was wrong with the first one, a sentence."""
    count: int = 0
    remedy: str = ''
    """What to do about it, if that is not what helps against the reason in general."""


@dataclass(frozen=True, slots=True)
class Rejections:
    """The samples of a batch that are not in its object, and those that are there corrected."""

    found: dict[tuple[str, str], Rejection] = field(default_factory=dict)
    """By reason and publisher."""
    corrected: Counter[str] = field(default_factory=Counter)
    """Of the samples in the object, those that had to be corrected, by what was wrong with them."""

    def add(self, error: Rejected, *samples: Sample) -> None:
        for sample in samples:
            key = error.reason, sample.publisher or ''
            known = self.found.setdefault(key, Rejection(*key, error.what, remedy=error.remedy))
            known.count += 1

    def add_corrected(self, payload: Payload) -> None:
        """Count what was wrong with a message that is stored all the same."""
        if payload.corrected:
            self.corrected[payload.corrected] += 1


Encoder = Callable[[Job, Rejections], 'Payload | None']
"""Makes one payload of a job and adds what it could not use to the rejections; None when nothing is left."""
OneMessage = Callable[[Job, Sample], Payload]
"""Makes a payload of one message, or raises Rejected."""


def one_message(encode: OneMessage) -> Encoder:
    """An encoder for a format that holds a single message.

    Settings refuse to batch such a format; should a batch come all the same, its later samples count as ``surplus``.
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


def encode_cdr(job: Job, sample: Sample) -> Payload:  # noqa: ARG001 - as every encoder of one message
    """The bytes of one message; its definition is not needed. Raises Rejected ``malformed`` where there are too few for CDR."""
    if len(sample.cdr) < ENCAPSULATION_BYTES:
        raise Rejected('malformed', f'{len(sample.cdr)} bytes are not CDR')
    return Payload(sample.cdr, (sample,), 'cdr', 'application/octet-stream')


def verbatim(sample: Sample, why: str, facts: Mapping[str, Fact], corrected: str = '') -> Payload:
    """The bytes of a message that its format cannot hold: not converted, and not lost. ``why`` is a short word."""
    return Payload(sample.cdr, (sample,), 'cdr', 'application/octet-stream', {**facts, 'verbatim': why}, corrected=corrected)
