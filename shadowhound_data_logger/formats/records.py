"""Converts messages of any type to JSON: one message, or a batch. Every finite number reads back bit for bit.

Numbers are written as the shortest decimal that reads back as the same float32 or float64, 64-bit integers exactly, NaN as null,
infinities as the strings ``"Infinity"`` and ``"-Infinity"`` (as in protobuf's JSON), byte sequences as base64. ``non_finite`` is
the count of NaN and infinities. If a field has the name of one of the document's own keys, an underscore is appended to it.

A compiled expression for each type, made from its definition, converts a decoded message to values that ``orjson`` can write.
``float32`` scalars become ``numpy.float32``, so that ``orjson`` writes the shortest decimal for a float32, as it does for arrays.
"""

from __future__ import annotations

from binascii import b2a_base64
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import orjson
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import normalize_fieldname

from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Sample
from shadowhound_data_logger.formats.payload import Job, Payload, Rejections
from shadowhound_data_logger.formats.statistics import INFINITE, NONE, FieldStatistics, pack_statistics
from shadowhound_data_logger.formats.types import PLACEHOLDER, MessageTypes, nested_type

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc

ODOMETRY: Final = 'nav_msgs/msg/Odometry'
TRANSFORMS: Final = 'tf2_msgs/msg/TFMessage'
FIX: Final = 'sensor_msgs/msg/NavSatFix'
NON_FINITE: Final = 'non_finite'
_RESERVED: Final = frozenset({'stamp_ns', NON_FINITE})
_RESERVED_SINGLE: Final = _RESERVED | {'robot', 'sensor', 'topic', 'type', 'timestamp'}
RECORDS_PER_PART: Final = 100
"""Records that exist as Python objects at a time: they take twenty times the size of the message, and ``orjson`` holds the GIL
while it writes them."""
_DOUBLE_ROUNDED: Final = b'7.038531e-26'
"""JSON readers parse decimals as float64. For this float32 and its negative, and no others, converting that to float32 gives
its neighbor (double rounding)."""
ToRecord = Callable[[Job, Sample, Any], dict[str, Any]]
"""Converts a decoded message to the record that is written."""
Convert = Callable[[Any], dict[str, Any]]
_BYTES: Final = frozenset({'uint8', 'byte', 'char', 'octet'})


def encode_records(job: Job, rejections: Rejections) -> Payload | None:
    """The JSON of a batch; messages that cannot be decoded are rejected as ``malformed`` or ``unknown_type``."""
    batched = bool(job.sensor.batch_s) or len(job.batch.samples) > 1
    kept: list[Sample] = []
    records = _records(job, _batch_record if batched else _single_record, kept, rejections)
    parts: list[bytes] = []
    non_finite = 0
    while some := list(islice(records, RECORDS_PER_PART)):
        part, missing = _dump(some)
        parts.append(part[1:-1])
        non_finite += missing
    if not kept:
        return None
    statistics = _statistics(job, parts)
    body = b','.join(parts)
    if batched:
        body = b'%b,"samples":[%b]}' % (_batch_header(job, kept)[:-1], body)
    if non_finite:
        body = b'%b,"non_finite":%d}' % (body[:-1], non_finite)
    return Payload(body, tuple(kept), 'json', 'application/json', statistics=statistics)


def _records(job: Job, record: ToRecord, kept: list[Sample], rejections: Rejections) -> Iterator[dict[str, Any]]:
    """The records of the messages that can be decoded, in the order of the batch; adds their samples to ``kept``."""
    for sample in job.batch.samples:
        try:
            message = job.types.deserialize(job.batch.type, sample.cdr)
        except Rejected as error:
            rejections.add(error, sample)
            continue
        kept.append(sample)
        yield record(job, sample, message)


def _single_record(job: Job, sample: Sample, message: Any) -> dict[str, Any]:
    """The document of a single message."""
    special = _SPECIAL_RECORDS.get(job.batch.type)
    if special is not None:
        return special(sample, message)
    own = {**_origin(job), 'timestamp': iso(sample.stamp_ns), 'stamp_ns': sample.stamp_ns}
    return {**own, **converter(job.types, job.batch.type, _RESERVED_SINGLE)(message)}


def _batch_record(job: Job, sample: Sample, message: Any) -> dict[str, Any]:
    """The record of one message in the document of a batch."""
    return {'stamp_ns': sample.stamp_ns, **converter(job.types, job.batch.type, _RESERVED)(message)}


def _batch_header(job: Job, kept: Sequence[Sample]) -> bytes:
    """The document of a batch, without its samples."""
    stamps = [sample.stamp_ns for sample in kept]
    return orjson.dumps({**_origin(job), 'count': len(kept), 't_start_ns': min(stamps), 't_end_ns': max(stamps)})


def _origin(job: Job) -> dict[str, Any]:
    return {'robot': job.robot, 'sensor': job.sensor.name, 'topic': job.batch.topic, 'type': job.batch.type}


def _odometry(sample: Sample, message: Any) -> dict[str, Any]:
    """The record that the trajectory tools read, without covariances."""
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


_SPECIAL_RECORDS: Final[Mapping[str, Callable[[Sample, Any], dict[str, Any]]]] = {ODOMETRY: _odometry}
"""Types with a special form for single records."""


def _statistics(job: Job, parts: Sequence[bytes]) -> bytes:
    """Statistics of the numbers in the JSON."""
    if job.sensor.statistics == (NONE,):
        return b''
    found = FieldStatistics(job.sensor.statistics)
    for part in parts:
        found.add(orjson.loads(b'[%b]' % part))
    return pack_statistics(found.result())


def _dump(records: list[dict[str, Any]]) -> tuple[bytes, int]:
    """The records as a JSON list, and the count of non-finite numbers."""
    body = orjson.dumps(records, option=orjson.OPT_SERIALIZE_NUMPY)
    if _DOUBLE_ROUNDED in body:
        records = widen(records)
        body = orjson.dumps(records, option=orjson.OPT_SERIALIZE_NUMPY)
    # Only NaN and infinities become null, but text may contain the word.
    non_finite = _count_nulls(orjson.loads(body)) if b'null' in body else 0
    if non_finite:
        body = orjson.dumps(_with_infinities(records), option=orjson.OPT_SERIALIZE_NUMPY)
    return body, non_finite


def _with_infinities(value: Any) -> Any:
    """The same value with infinities as strings, because REP 117 distinguishes them from NaN."""
    if isinstance(value, dict):
        return {key: _with_infinities(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_infinities(item) for item in value]
    if isinstance(value, np.ndarray) and value.dtype.kind == 'f' and len(places := np.flatnonzero(np.isinf(value))):
        parts = orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1].split(b',')
        for index in places:
            parts[index] = b'"%b"' % INFINITE[int(value[index] < 0)].encode()
        return orjson.Fragment(b'[%b]' % b','.join(parts))
    return INFINITE[int(value < 0)] if isinstance(value, (float, np.floating)) and np.isinf(value) else value


def _count_nulls(value: Any) -> int:
    if isinstance(value, dict):
        return sum(map(_count_nulls, value.values()))
    if isinstance(value, list):
        return sum(map(_count_nulls, value))
    return int(value is None)


@lru_cache(maxsize=1024)
def converter(types: MessageTypes, type_name: str, reserved: frozenset[str] = frozenset()) -> Convert:
    """A function that converts a decoded message to a dict of its fields, in order. Raises Rejected: ``unknown_type``.

    Nested messages become dicts, arrays and sequences of numbers stay numpy arrays, sequences of bytes (``uint8[]``, bounded
    or not, but not fixed arrays) become base64 text. An underscore is appended to fields whose names are ``reserved``.
    """
    # One expression, such as ``{'stamp': {'sec': m.stamp.sec}, 'q': float32(m.q)}``, because a call per nested message takes
    # longer than converting its values. All names in it are identifiers from a parsed definition, so eval is safe.
    source = f'lambda m: {_message(types, type_name, "m", reserved)}'
    convert: Convert = eval(source, {'float32': np.float32, 'base64': _base64, 'unsigned': _unsigned})  # noqa: S307
    return convert


def _message(types: MessageTypes, type_name: str, at: str, reserved: frozenset[str] = frozenset()) -> str:
    """The expression that converts the message at the expression ``at``."""
    fields = {name: description for name, description in types.fields(type_name) if name != PLACEHOLDER}
    entries = []
    for name, description in fields.items():
        value = _value(types, description, f'{at}.{normalize_fieldname(name)}')
        entries.append(f'{_unused_name(name, reserved, fields)!r}: {value}')
    return f'{{{", ".join(entries)}}}'


def _unused_name(name: str, reserved: Collection[str], fields: Collection[str]) -> str:
    """The name, with underscores appended until it is neither reserved nor another field's."""
    unused = name
    while unused in reserved or (unused != name and unused in fields):
        unused += '_'
    return unused


def _value(types: MessageTypes, description: FieldDesc, at: str) -> str:
    """The expression that converts a field; ``at`` itself if orjson writes the value correctly."""
    nested = nested_type(description)
    if nested is not None:
        if description[0] == Nodetype.NAME:
            return _message(types, nested, at)
        return f'[{_message(types, nested, "i")} for i in {at}]'
    if description[0] == Nodetype.BASE:
        return {'float32': f'float32({at})', 'byte': f'{at} & 255'}.get(description[1][0], at)
    base = description[1][0][1][0]
    if description[0] == Nodetype.SEQUENCE and base in _BYTES:
        return f'base64({at})'
    return f'unsigned({at})' if base == 'byte' else at


def _unsigned(values: Any) -> Any:
    """An array of ``byte`` as ROS 2 defines it, 0 to 255; ``rosbags`` reads it as signed."""
    return values.view(np.uint8)


def _base64(data: Any) -> str:
    return b2a_base64(data, newline=False).decode('ascii')


def widen(value: Any) -> Any:
    """The same plain value with every float32 converted to float64."""
    if isinstance(value, dict):
        return {key: widen(item) for key, item in value.items()}
    if isinstance(value, list):
        return [widen(item) for item in value]
    if isinstance(value, np.float32):
        return float(value)
    if isinstance(value, np.ndarray) and value.dtype == np.float32:
        return value.astype(np.float64)
    return value
