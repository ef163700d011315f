"""What the registry hands to an encoder and gets back from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.encode.cdr import ENCAPSULATION_BYTES
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Batch, Sample

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


@dataclass(frozen=True, slots=True)
class Rejections:
    """The samples of a batch that are not in its object."""

    counts: Counter[str] = field(default_factory=Counter)
    details: dict[str, str] = field(default_factory=dict)
    """Reason -> what was wrong with the first one, a sentence."""

    def add(self, error: Rejected, samples: int = 1) -> None:
        self.counts[error.reason] += samples
        self.details.setdefault(error.reason, str(error))


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
                rejections.add(Rejected('surplus', f'{job.sensor.format} holds one message'))
                continue
            try:
                payload = encode(job, sample)
            except Rejected as error:
                rejections.add(error)
        return payload

    return encoder


def encode_cdr(job: Job, sample: Sample) -> Payload:  # noqa: ARG001 - as every encoder of one message
    """The bytes of one message; its definition is not needed. Raises Rejected ``malformed`` where there are too few for CDR."""
    if len(sample.cdr) < ENCAPSULATION_BYTES:
        raise Rejected('malformed', f'{len(sample.cdr)} bytes are not CDR')
    return Payload(sample.cdr, (sample,), 'cdr', 'application/octet-stream')
