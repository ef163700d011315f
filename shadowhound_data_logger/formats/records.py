"""Messages of any type to JSON: a record of one message, or a batch of many. Every finite number reads back bit for bit.

Numbers are written as the shortest decimal that gives the same float32 or float64 again, 64-bit integers exactly, NaN as null,
infinities as the text ``"Infinity"`` or ``"-Infinity"`` (as the JSON of protobuf has them), the number of all these in
``non_finite``, byte sequences as base64. A message field whose name the document uses itself gets an underscore behind it.

Decoded messages become plain values that ``orjson`` can write: one compiled expression a type, made from its definition.
``float32`` scalars become ``numpy.float32``, because then the shortest decimal that reads back as that float32 is written, as
it is for arrays.
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
from shadowhound_data_logger.formats.columns import BatchStatistics
from shadowhound_data_logger.formats.payload import Job, Payload, Rejections
from shadowhound_data_logger.formats.statistics import INFINITE, NONE, UNCOUNTED, FieldStatistics, covers, packed
from shadowhound_data_logger.formats.types import PLACEHOLDER, MessageTypes, nested_type

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc

ODOMETRY: Final = 'nav_msgs/msg/Odometry'
TRANSFORMS: Final = 'tf2_msgs/msg/TFMessage'
FIX: Final = 'sensor_msgs/msg/NavSatFix'
NON_FINITE: Final = 'non_finite'
_TAKEN: Final = frozenset({'stamp_ns', NON_FINITE})
_TAKEN_ALONE: Final = _TAKEN | {'robot', 'sensor', 'topic', 'type', 'timestamp'}
AT_ONCE: Final = 100
"""Records that are Python objects at a time: they take twenty times the bytes of the message, and ``orjson`` holds the GIL
while it writes them."""
_AWKWARD: Final = b'7.038531e-26'
"""The shortest decimal of a float32 that comes out as its neighbor when it is read by way of a float64, as JSON readers
do; there is no other (and its negative) among all float32."""
ToRecord = Callable[[Job, Sample, Any], dict[str, Any]]
"""From a decoded message to what is written of it."""
Convert = Callable[[Any], dict[str, Any]]
_BYTES: Final = frozenset({'uint8', 'byte', 'char', 'octet'})


def encode_records(job: Job, rejections: Rejections) -> Payload | None:
    """The JSON of a batch; messages that cannot be decoded are rejected as ``malformed`` or ``unknown_type``."""
    batched = bool(job.sensor.batch_s) or len(job.batch.samples) > 1
    kept: list[Sample] = []
    records = _records(job, _of_batch if batched else _alone, kept, rejections)
    parts: list[bytes] = []
    non_finite = 0
    are_widened = False
    while some := list(islice(records, AT_ONCE)):
        part, missing, is_widened = _dump(some)
        are_widened |= is_widened
        parts.append(part[1:-1])
        non_finite += missing
    if not kept:
        return None
    said = _statistics(job, kept, parts, batched=batched, is_widened=are_widened)
    body = b','.join(parts)
    if batched:
        body = b'%b,"samples":[%b]}' % (_head(job, kept)[:-1], body)
    if non_finite:
        body = b'%b,"non_finite":%d}' % (body[:-1], non_finite)
    return Payload(body, tuple(kept), 'json', 'application/json', statistics=said)


def _records(job: Job, record: ToRecord, kept: list[Sample], rejections: Rejections) -> Iterator[dict[str, Any]]:
    """What can be decoded of the batch, in its order; adds each such sample to ``kept``."""
    for sample in job.batch.samples:
        try:
            message = job.types.deserialize(job.batch.type, sample.cdr)
        except Rejected as error:
            rejections.add(error, sample)
            continue
        kept.append(sample)
        yield record(job, sample, message)


def _alone(job: Job, sample: Sample, message: Any) -> dict[str, Any]:
    """The document of a single message."""
    special = _RECORDS.get(job.batch.type)
    if special is not None:
        return special(sample, message)
    own = {**_origin(job), 'timestamp': iso(sample.stamp_ns), 'stamp_ns': sample.stamp_ns}
    return {**own, **converter(job.types, job.batch.type, _TAKEN_ALONE)(message)}


def _of_batch(job: Job, sample: Sample, message: Any) -> dict[str, Any]:
    """A message among the samples of a batch."""
    return {'stamp_ns': sample.stamp_ns, **converter(job.types, job.batch.type, _TAKEN)(message)}


def _head(job: Job, kept: Sequence[Sample]) -> bytes:
    """The document of a batch without its samples."""
    stamps = [sample.stamp_ns for sample in kept]
    return orjson.dumps({**_origin(job), 'count': len(kept), 't_start_ns': min(stamps), 't_end_ns': max(stamps)})


def _origin(job: Job) -> dict[str, Any]:
    return {'robot': job.robot, 'sensor': job.sensor.name, 'topic': job.batch.topic, 'type': job.batch.type}


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


_PLACES: Final[Mapping[str, Mapping[str, str]]] = {
    ODOMETRY: {'pose.pose.position': 'position', 'pose.pose.orientation': 'orientation', 'twist.twist.linear': 'linear_velocity',
               'twist.twist.angular': 'angular_velocity'},
}  # fmt: skip
"""Where the numbers of the message are in such a record."""


def _statistics(job: Job, kept: Sequence[Sample], parts: Sequence[bytes], *, batched: bool, is_widened: bool) -> bytes:
    """Of the numbers in the JSON: from the messages at once where they are of one layout, else by reading it again."""
    if job.sensor.statistics == (NONE,):
        return b''
    told = None
    if not is_widened:
        told = _columns(job.types, job.batch.type, job.sensor.statistics, batched).told([sample.cdr for sample in kept])
    if told is None:
        found = FieldStatistics(job.sensor.statistics)
        for part in parts:
            found.add(orjson.loads(b'[%b]' % part))
        told = packed(found.told())
    return told


@lru_cache(maxsize=1024)
def _columns(types: MessageTypes, type_name: str, chosen: tuple[str, ...], batched: bool) -> BatchStatistics:
    special = None if batched else _PLACES.get(type_name)
    names = [name for name, _ in types.fields(type_name)]
    free = {name: _free(name, _TAKEN if batched else _TAKEN_ALONE, names) for name in names}

    def named(path: str) -> str | None:
        if special is not None:
            return next((new + path[len(old) :] for old, new in special.items() if covers(old, path)), None)
        name, dot, rest = path.partition('.')
        return None if free[name] in UNCOUNTED else f'{free[name]}{dot}{rest}'

    return BatchStatistics(types, type_name, chosen, named)


def _dump(records: list[dict[str, Any]]) -> tuple[bytes, int, bool]:
    """The records as a JSON list, how many numbers are not finite, and whether the others are ``widened``."""
    body = orjson.dumps(records, option=orjson.OPT_SERIALIZE_NUMPY)
    if is_awkward := _AWKWARD in body:
        records = widened(records)
        body = orjson.dumps(records, option=orjson.OPT_SERIALIZE_NUMPY)
    # A message has no nulls of its own, but text may contain the word.
    non_finite = _nulls(orjson.loads(body)) if b'null' in body else 0
    if non_finite:
        body = orjson.dumps(_with_infinities(records), option=orjson.OPT_SERIALIZE_NUMPY)
    return body, non_finite, is_awkward


def _with_infinities(value: Any) -> Any:
    """The same with the texts of infinities in their places: REP 117 gives them a meaning that NaN does not have."""
    if isinstance(value, dict):
        return {key: _with_infinities(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_infinities(item) for item in value]
    if isinstance(value, np.ndarray) and value.dtype.kind == 'f' and len(places := np.flatnonzero(np.isinf(value))):
        parts = orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1].split(b',')
        for place in places:
            parts[place] = b'"%b"' % INFINITE[int(value[place] < 0)].encode()
        return orjson.Fragment(b'[%b]' % b','.join(parts))
    return INFINITE[int(value < 0)] if isinstance(value, (float, np.floating)) and np.isinf(value) else value


def _nulls(value: Any) -> int:
    if isinstance(value, dict):
        return sum(map(_nulls, value.values()))
    if isinstance(value, list):
        return sum(map(_nulls, value))
    return int(value is None)


@lru_cache(maxsize=1024)
def converter(types: MessageTypes, type_name: str, taken: frozenset[str] = frozenset()) -> Convert:
    """The function from a decoded message of a type to a dict of its fields in order. Raises Rejected: ``unknown_type``.

    Nested messages become dicts, arrays and sequences of numbers stay numpy arrays, sequences of bytes (``uint8[]``, bounded
    or not, but no fixed arrays) become base64 text. A field whose name is ``taken`` gets an underscore behind it.
    """
    # One expression, such as ``{'stamp': {'sec': m.stamp.sec}, 'q': float32(m.q)}``: a call for each nested message
    # costs more than its values. All names in it are identifiers of a definition that was parsed.
    source = f'lambda m: {_message(types, type_name, "m", taken)}'
    convert: Convert = eval(source, {'float32': np.float32, 'base64': _base64, 'unsigned': _unsigned})  # noqa: S307
    return convert


def _message(types: MessageTypes, type_name: str, at: str, taken: frozenset[str] = frozenset()) -> str:
    """The expression for a message that is the value of the expression ``at``."""
    fields = {name: description for name, description in types.fields(type_name) if name != PLACEHOLDER}
    entries = []
    for name, description in fields.items():
        value = _value(types, description, f'{at}.{normalize_fieldname(name)}')
        entries.append(f'{_free(name, taken, fields)!r}: {value}')
    return f'{{{", ".join(entries)}}}'


def _free(name: str, taken: Collection[str], fields: Collection[str]) -> str:
    """The name, or the first one like it that is neither taken nor another field's."""
    free = name
    while free in taken or (free != name and free in fields):
        free += '_'
    return free


def _value(types: MessageTypes, description: FieldDesc, at: str) -> str:
    """The expression for a field; ``at`` itself where orjson writes its value rightly as it is."""
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
    """An array of ``byte`` as ROS 2 means it, 0 to 255; ``rosbags`` reads it signed."""
    return values.view(np.uint8)


def _base64(data: Any) -> str:
    return b2a_base64(data, newline=False).decode('ascii')


def widened(value: Any) -> Any:
    """The same plain value with every float32 as the float64 that equals it."""
    if isinstance(value, dict):
        return {key: widened(item) for key, item in value.items()}
    if isinstance(value, list):
        return [widened(item) for item in value]
    if isinstance(value, np.float32):
        return float(value)
    if isinstance(value, np.ndarray) and value.dtype == np.float32:
        return value.astype(np.float64)
    return value
