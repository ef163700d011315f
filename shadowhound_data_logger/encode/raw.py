"""Any message as the middleware serialized it: CDR with its encapsulation header, byte for byte."""

from __future__ import annotations

from shadowhound_data_logger.encode.payload import Job, Payload
from shadowhound_data_logger.encode.types import ENCAPSULATION_BYTES
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Sample


def encode_cdr(job: Job, sample: Sample) -> Payload:  # noqa: ARG001 - as every encoder of one message
    """The bytes of one message; its definition is not needed. Raises Rejected ``malformed`` where there are too few for CDR."""
    if len(sample.cdr) < ENCAPSULATION_BYTES:
        raise Rejected('malformed', f'{len(sample.cdr)} bytes are no CDR')
    return Payload(sample.cdr, (sample,), 'cdr', 'application/octet-stream')
