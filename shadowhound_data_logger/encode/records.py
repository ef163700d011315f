"""Messages of any type to JSON: a record of one message, or a batch of many. Every finite number reads back bit for bit.

Numbers are written as the shortest decimal that gives the same float32 or float64 again, 64-bit integers exactly, NaN and
Infinity as null with their number in ``non_finite``, byte sequences as base64. A message field whose name the document uses
itself gets an underscore behind it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final

import orjson

from shadowhound_data_logger.clock import iso
from shadowhound_data_logger.encode.payload import Job, Payload
from shadowhound_data_logger.encode.plain import converter, widened
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Sample

ODOMETRY: Final = 'nav_msgs/msg/Odometry'
NON_FINITE: Final = 'non_finite'
_AWKWARD: Final = b'7.038531e-26'
"""The shortest decimal of a float32 that comes out as its neighbour when it is read by way of a float64, as JSON readers
do; there is no other (and its negative) among all float32."""


def encode_records(job: Job, rejected: Counter[str]) -> Payload | None:
    """The JSON of a batch; messages that cannot be decoded are counted as ``malformed`` or ``unknown_type``."""
    kept, records = [], []
    for sample in job.batch.samples:
        try:
            message = job.types.deserialize(job.batch.type, sample.cdr)
        except Rejected as error:
            rejected[error.reason] += 1
            continue
        kept.append(sample)
        records.append(message)
    if not kept:
        return None
    single = not job.sensor.batch_s and len(kept) == 1
    document = _record(job, kept[0], records[0]) if single else _batch(job, kept, records)
    return Payload(_dump(document), tuple(kept), 'json', 'application/json')


def _record(job: Job, sample: Sample, message: Any) -> dict[str, Any]:
    special = _RECORDS.get(job.batch.type)
    if special is not None:
        return special(sample, message)
    own = {**_origin(job), 'timestamp': iso(sample.stamp_ns), 'stamp_ns': sample.stamp_ns}
    return _merged(own, converter(job.types, job.batch.type)(message))


def _batch(job: Job, kept: list[Sample], messages: list[Any]) -> dict[str, Any]:
    convert = converter(job.types, job.batch.type)
    stamps = [sample.stamp_ns for sample in kept]
    return {
        **_origin(job),
        'count': len(kept),
        't_start_ns': min(stamps),
        't_end_ns': max(stamps),
        'samples': [_merged({'stamp_ns': stamp}, convert(message)) for stamp, message in zip(stamps, messages, strict=True)],
    }


def _origin(job: Job) -> dict[str, Any]:
    return {'robot': job.robot, 'sensor': job.sensor.name, 'topic': job.batch.topic, 'type': job.batch.type}


def _merged(own: dict[str, Any], fields: dict[str, Any]) -> dict[str, Any]:
    """The document's own entries, then the message's fields, renamed where the name is taken."""
    if own.keys().isdisjoint(fields) and NON_FINITE not in fields:
        own.update(fields)
        return own
    for name, value in fields.items():
        key = name
        while key in own or key == NON_FINITE or (key != name and key in fields):
            key += '_'
        own[key] = value
    return own


def _odometry(sample: Sample, message: Any) -> dict[str, Any]:
    """The record that the trajectory tools read; covariances are left out."""
    pose, twist = message.pose.pose, message.twist.twist
    return {
        'timestamp': iso(sample.stamp_ns),
        'stamp_ns': sample.stamp_ns,
        'frame_id': message.header.frame_id,
        'child_frame_id': message.child_frame_id,
        'position': _vector(pose.position),
        'orientation': {**_vector(pose.orientation), 'w': pose.orientation.w},
        'linear_velocity': _vector(twist.linear),
        'angular_velocity': _vector(twist.angular),
    }


def _vector(vector: Any) -> dict[str, float]:
    return {'x': vector.x, 'y': vector.y, 'z': vector.z}


_RECORDS: Final[Mapping[str, Callable[[Sample, Any], dict[str, Any]]]] = {ODOMETRY: _odometry}
"""Types whose single record has a form of its own."""


def _dump(document: dict[str, Any]) -> bytes:
    body = orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    if _AWKWARD in body:
        document = widened(document)
        body = orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    if b'null' in body:  # a message has no nulls of its own, but text may contain the word
        missing = _nulls(orjson.loads(body))
        if missing:
            body = orjson.dumps({**document, NON_FINITE: missing}, option=orjson.OPT_SERIALIZE_NUMPY)
    return body


def _nulls(value: Any) -> int:
    if isinstance(value, dict):
        return sum(map(_nulls, value.values()))
    if isinstance(value, list):
        return sum(map(_nulls, value))
    return int(value is None)
