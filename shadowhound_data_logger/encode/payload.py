"""What the registry hands to an encoder and gets back from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Batch, Sample


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
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Further S3 user metadata: lower-case names, printable ASCII values."""


Encoder = Callable[[Job, Counter[str]], 'Payload | None']
"""Makes one payload of a job and adds what it could not use to the counter, by reason; None when nothing is left."""


def one_message(encode: Callable[[Job, Sample], Payload]) -> Encoder:
    """An encoder for a format that holds a single message, from a function that raises Rejected for a bad one.

    Settings refuse to batch such a format; should a batch come all the same, its later samples count as ``surplus``.
    """

    def encoder(job: Job, rejected: Counter[str]) -> Payload | None:
        payload = None
        for sample in job.batch.samples:
            if payload is not None:
                rejected['surplus'] += 1
                continue
            try:
                payload = encode(job, sample)
            except Rejected as error:
                rejected[error.reason] += 1
        return payload

    return encoder
