"""The mailbox of a robot: one JSON object with requests, in a store that the robot polls and can only read.

``sensor-data/_requests/<robot>/inbox.json`` is ``{"format": 1, "entries": [...]}``. An entry is a request (``id robot by made_ns
expires_ns priority want``) or cancels one (``cancel by made_ns``). The id is the hash of what is requested, so that repeating a
request has no effect. Answers are separate objects, ``<robot>/_answers/<id>/<n>.json``, which never change. The writer of an
inbox is not trusted: everything in it is validated here before use.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from shadowhound_data_logger.core import earth
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import LOST, ON_ROBOT
from shadowhound_data_logger.core.untrusted import from_json

MAILBOX_BUCKET: Final = 'sensor-data'
FORMAT: Final = 1
MAX_INBOX_BYTES: Final = 256 << 10
MAX_ENTRIES: Final = 256
MAX_KEYS: Final = 1000
"""Keys and patterns of one request."""
MAX_PATTERN: Final = 512
MAX_WILDCARDS: Final = 16
"""Patterns with ``*`` or ``?`` in one request: each is matched against everything that is kept."""
LATEST_NS: Final = 4_102_444_800 * SECOND
"""2100-01-01."""
MAX_EXPIRY_NS: Final = 90 * 24 * 3600 * SECOND
"""Maximum time from request to expiry."""
DEFAULT_EXPIRY_NS: Final = 7 * 24 * 3600 * SECOND
DEFAULT_PRIORITY: Final = 5
BAG_SENSOR: Final = 'bag'
"""Its objects are slices: one is wanted if it overlaps the requested time."""
MIN_SAVED_BYTES: Final = 64 << 10
"""Minimum bytes that cutting a slice must save: a cut is three objects."""
_ID: Final = re.compile(r'[0-9a-f]{32}')
_PATTERN: Final = re.compile(r"[A-Za-z0-9!_.'()=+@*?/-]+")
_WORDS: Final = ('sensor', 'topic', 'mission', 'mission_type')
_MAX_WORD: Final = 256
_ASKING: Final = frozenset({'id', 'robot', 'by', 'made_ns', 'expires_ns', 'priority', 'want'})
_CANCELLING: Final = frozenset({'cancel', 'by', 'made_ns'})


class RequestRefused(ValueError):
    """An entry or a mailbox is invalid; ``reason`` is a word for counting."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFilter:
    """Selects the kept objects that are wanted: all given conditions must be true."""

    sensor: str | None = None
    topic: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None
    """Exclusive."""
    near: tuple[float, float, float] | None = None
    """x, y and radius in meters, in the frame of the pose."""
    near_gps: tuple[float, float, float] | None = None
    """Latitude and longitude in degrees, and radius in meters."""
    mission: str | None = None
    """Prefix of the id of a mission or of its run."""
    mission_type: str | None = None
    keys: frozenset[str] = frozenset()
    """Its key is one of these, or matches one of the patterns."""
    patterns: tuple[str, ...] = ()
    """``*`` matches any characters, ``?`` one."""

    def to_json(self) -> dict[str, Any]:
        """The conditions that are given, in the form that the id is the hash of."""
        given: dict[str, Any] = {name: value for name in _WORDS if (value := getattr(self, name)) is not None}
        given |= {name: value for name in ('since_ns', 'until_ns') if (value := getattr(self, name)) is not None}
        for name, circle in (('near', self.near), ('near_gps', self.near_gps)):
            if circle is not None:
                given[name] = [float(value) for value in circle]
        if self.keys or self.patterns:
            given['keys'] = sorted(self.keys.union(self.patterns))
        return given

    def bytes_of(self, key: str, sensor: str, size: int, begin_ns: int, end_ns: int, metadata: Mapping[str, str]) -> int:
        """Approximate number of bytes wanted of an object: a slice that overlaps the requested time in part is cut.

        A slice whose times differ from those of its messages, because the clock was set later, is sent complete.
        """
        if sensor != BAG_SENSOR or not key.endswith('.mcap') or meta.CLOCK in metadata:
            return size
        since_ns, until_ns = max(self.since_ns or begin_ns, begin_ns), min(self.until_ns or end_ns + 1, end_ns + 1)
        wanted = size * max(until_ns - since_ns, 1) // max(end_ns + 1 - begin_ns, 1)
        return max(wanted, 1) if size - wanted >= MIN_SAVED_BYTES else size

    def matches(self, key: str, sensor: str, topic: str | None, begin_ns: int, end_ns: int, metadata: Mapping[str, str]) -> bool:
        """Whether an object is wanted; ``metadata`` is what it will have in the store."""
        if self.sensor not in {None, sensor} or self.topic not in {None, topic}:
            return False
        if self.since_ns is not None and (end_ns if sensor == BAG_SENSOR else begin_ns) < self.since_ns:
            return False
        if self.until_ns is not None and begin_ns >= self.until_ns:
            return False
        if self.mission_type not in {None, metadata.get(meta.MISSION_TYPE)}:
            return False
        if self.mission is not None:
            names = (metadata.get(meta.MISSION_ID, ''), metadata.get(meta.RUN_ID, ''))
            if not any(name.startswith(self.mission) for name in names):
                return False
        is_near = self.near is None or _is_near(metadata.get(meta.POSE, ''), *self.near)
        if not is_near or not (self.near_gps is None or _is_near_on_earth(metadata.get(meta.GPS, ''), self.near_gps)):
            return False
        if not self.keys and not self.patterns:
            return True
        return key in self.keys or any(_matches(pattern, key) for pattern in self.patterns)


@dataclass(frozen=True, slots=True, kw_only=True)
class PullRequest:
    """A request for objects that a robot keeps; times in Unix nanoseconds."""

    robot: str
    by: str
    made_ns: int
    expires_ns: int
    want: KeptFilter
    priority: int = DEFAULT_PRIORITY

    @property
    def id(self) -> str:
        return request_id(self.robot, self.want.to_json())

    def to_json(self) -> dict[str, Any]:
        return {
            'id': self.id, 'robot': self.robot, 'by': self.by, 'made_ns': self.made_ns, 'expires_ns': self.expires_ns,
            'priority': self.priority, 'want': self.want.to_json(),
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class PullCancel:
    """Cancels a request."""

    id: str
    by: str
    made_ns: int

    def to_json(self) -> dict[str, Any]:
        return {'cancel': self.id, 'by': self.by, 'made_ns': self.made_ns}


@dataclass(frozen=True, slots=True)
class ObjectCount:
    """Objects and their bytes."""

    objects: int = 0
    bytes: int = 0


@dataclass(frozen=True, slots=True)
class LostObject:
    """A requested object that will not arrive."""

    key: str
    state: str
    reason: str | None
    when: str | None
    """None if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestAnswer:
    """A robot's answer to a request, the JSON object at ``answer_key``."""

    format: int = FORMAT
    id: str
    number: int = 0
    """Number of this answer to the request, from 1."""
    robot: str = ''
    by: str = ''
    """The requester."""
    state: str
    """``accepted``, ``sending``, ``done``, ``expired``, ``cancelled`` or ``refused``."""
    time: str = ''
    made_ns: int = 0
    """When the request was made."""
    expires: str = ''
    why: str = ''
    """Why it was refused."""
    want: Mapping[str, Any] = field(default_factory=dict)
    """The ``KeptFilter``."""
    objects: int = 0
    """Objects that the request selected."""
    bytes: int = 0
    gone: Mapping[str, Any] = field(default_factory=dict)
    """Objects that were delivered before the request; empty if none."""
    mbps: float | None = None
    """Throughput of the link."""
    outcomes: Mapping[str, ObjectCount] = field(default_factory=dict)
    """By state: ``delivered``, ``pending``, ``unsent``, ..."""
    lost: tuple[LostObject, ...] = ()
    """The first lost objects."""
    bags: tuple[str, ...] = ()
    """Bags that were cut for the request."""

    @property
    def delivered(self) -> ObjectCount:
        return self.outcomes.get('delivered', ObjectCount())


def size_of(want: KeptFilter, row: Mapping[str, Any]) -> int:
    """Approximate number of bytes wanted of an object, from its row of ``formats.rows.catalog.KEPT``: a slice may be cut."""
    begin_ns = row['t_start_ns'] or 0
    return want.bytes_of(row['key'], row['sensor'] or '', row['bytes'] or 0, begin_ns, row['t_end_ns'] or begin_ns, {})


@dataclass(frozen=True, slots=True)
class Offer:
    """What a request would get."""

    objects: int
    """Objects that the robot keeps."""
    bytes: int
    """Bytes that it would send, approximately."""
    lost: Mapping[str, int]
    """Objects that it has lost, by reason."""
    mbps: float | None
    """Throughput; None if unknown."""

    @property
    def seconds(self) -> float | None:
        """How long the bytes take at this throughput."""
        return 8e-6 * self.bytes / self.mbps if self.mbps else None

    def to_json(self) -> dict[str, Any]:
        return {'objects': self.objects, 'bytes': self.bytes, 'lost': dict(self.lost), 'mbps': self.mbps, 'seconds': self.seconds}


def offer(want: KeptFilter, rows: Iterable[Mapping[str, Any]], mbps: float | None) -> Offer:
    """What a request for these rows of ``formats.rows.catalog.KEPT`` would get; the filter selects all of them."""
    objects, size, lost = 0, 0, Counter[str]()
    for row in rows:
        if row['where'] == ON_ROBOT:
            size += size_of(want, row)
            objects += 1
        elif row['where'] == LOST:
            lost[row['reason'] or 'unknown'] += 1
    return Offer(objects, size, lost, mbps)


def inbox_key(robot: str) -> str:
    """Key of a robot's mailbox, in ``MAILBOX_BUCKET``."""
    return f'_requests/{robot}/inbox.json'


def answers_prefix(robot: str, request: str) -> str:
    """Key prefix of the answers to a request."""
    return f'{robot}/_answers/{request}/'


def answer_key(robot: str, request: str, number: int) -> str:
    """Key of one answer, counted from 1."""
    return f'{answers_prefix(robot, request)}{number}.json'


def request_id(robot: str, want: Mapping[str, Any]) -> str:
    """The hash of a request to a robot: 32 hexadecimal digits."""
    text = json.dumps({'robot': robot, 'want': want}, sort_keys=True, separators=(',', ':'))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def encode_inbox(entries: Sequence[Mapping[str, Any]]) -> bytes:
    """The mailbox with these entries. Raises RequestRefused if it would be too large."""
    body = json.dumps({'format': FORMAT, 'entries': list(entries)}, separators=(',', ':')).encode()
    if len(entries) > MAX_ENTRIES or len(body) > MAX_INBOX_BYTES:
        raise RequestRefused('too_large', f'the mailbox is full: {len(entries):,} entries, {len(body):,} bytes')
    return body


def decode_inbox(body: bytes) -> list[Any]:
    """The entries of a mailbox, not validated. Raises RequestRefused."""
    if len(body) > MAX_INBOX_BYTES:
        raise RequestRefused('too_large', f'the mailbox has more than {MAX_INBOX_BYTES:,} bytes')
    try:
        found = from_json(body, MAX_INBOX_BYTES)
    except ValueError as error:
        raise RequestRefused('not_json', f'the mailbox is not JSON: {error}') from error
    entries = found.get('entries') if isinstance(found, dict) and set(found) == {'format', 'entries'} else None
    if not isinstance(entries, list) or found['format'] != FORMAT:
        raise RequestRefused('not_ours', f'the mailbox does not have format {FORMAT}')
    if len(entries) > MAX_ENTRIES:
        raise RequestRefused('too_many', f'the mailbox has more than {MAX_ENTRIES} entries')
    return entries


def read_entry(robot: str, entry: Any) -> PullRequest | PullCancel:
    """An entry of a mailbox. Raises RequestRefused for one that differs from what ``to_json`` writes."""
    if not isinstance(entry, dict):
        raise RequestRefused('not_ours', 'it is not an object')
    fields = _CANCELLING if 'cancel' in entry else _ASKING
    if set(entry) != fields:
        invalid = sorted(str(name)[:32] for name in set(entry) ^ fields)
        raise RequestRefused('fields', f'it must have exactly the fields {" ".join(sorted(fields))}; wrong: {invalid[:3]}')
    by, made_ns = entry['by'], entry['made_ns']
    if not (isinstance(by, str) and is_name(by)):
        raise RequestRefused('name', 'by is not a name')
    _check_time('made_ns', made_ns)
    if 'cancel' in entry:
        return PullCancel(id=_checked_id(entry['cancel']), by=by, made_ns=made_ns)
    expires_ns, priority = entry['expires_ns'], entry['priority']
    _check_time('expires_ns', expires_ns)
    if not made_ns < expires_ns <= made_ns + MAX_EXPIRY_NS:
        raise RequestRefused('time', 'expires_ns is not within 90 days after made_ns')
    if type(priority) is not int or not 0 <= priority <= 9:
        raise RequestRefused('priority', 'priority is not a whole number from 0 to 9')
    if entry['robot'] != robot:
        raise RequestRefused('robot', 'it is for another robot')
    want = _read_want(entry['want'])
    request = PullRequest(robot=robot, by=by, made_ns=made_ns, expires_ns=expires_ns, want=want, priority=priority)
    if _checked_id(entry['id']) != request.id:
        raise RequestRefused('id', 'its id is not the hash of its request')
    return request


def _read_want(given: Any) -> KeptFilter:
    if (
        not isinstance(given, dict)
        or not set(given) <= {*_WORDS, 'since_ns', 'until_ns', 'near', 'near_gps', 'keys'}
        or not given
    ):
        raise RequestRefused('fields', 'want is not an object of known fields')
    for name in _WORDS:
        if name in given and not (
            isinstance(given[name], str) and 0 < len(given[name]) <= _MAX_WORD and given[name].isprintable()
        ):
            raise RequestRefused('want', f'{name} is not a short text')
    for name in ('since_ns', 'until_ns'):
        if name in given:
            _check_time(name, given[name])
    keys = given.get('keys', [])
    if (
        not isinstance(keys, list)
        or len(keys) > MAX_KEYS
        or not all(map(_is_pattern, keys))
        or sum(map(_has_wildcard, keys)) > MAX_WILDCARDS
    ):
        raise RequestRefused('keys', f'keys are not at most {MAX_KEYS} keys, {MAX_WILDCARDS} of them patterns')
    near, on_earth = given.get('near'), given.get('near_gps')
    if near is not None and not _is_circle(near):
        raise RequestRefused('near', 'near is not x, y and a radius in meters')
    if on_earth is not None and not (_is_circle(on_earth) and earth.is_place(*on_earth[:2])):
        raise RequestRefused('near_gps', 'near_gps is not latitude, longitude and a radius in meters')
    plain = {name: given[name] for name in (*_WORDS, 'since_ns', 'until_ns') if name in given}
    return KeptFilter(
        **plain, near=_triple(near), near_gps=_triple(on_earth), keys=frozenset(key for key in keys if not _has_wildcard(key)),
        patterns=tuple(key for key in keys if _has_wildcard(key)),
    )  # fmt: skip


def _is_circle(near: Any) -> bool:
    numbers = isinstance(near, list) and len(near) == 3 and all(type(one) in {int, float} for one in near)
    return numbers and all(abs(one) < 1e9 and math.isfinite(one) for one in near) and near[2] > 0


def _triple(circle: Any) -> tuple[float, float, float] | None:
    return None if circle is None else (circle[0], circle[1], circle[2])


def _is_pattern(pattern: Any) -> bool:
    return isinstance(pattern, str) and len(pattern) <= MAX_PATTERN and bool(_PATTERN.fullmatch(pattern))


def _has_wildcard(pattern: str) -> bool:
    return '*' in pattern or '?' in pattern


def _matches(pattern: str, key: str) -> bool:
    """Match with ``*`` and ``?``. It backtracks only to the last star, so that hostile patterns stay cheap."""
    place = at = 0
    star, tried = -1, 0
    while at < len(key):
        if place < len(pattern) and pattern[place] == '*':
            star, tried = place, at
            place += 1
        elif place < len(pattern) and pattern[place] in {'?', key[at]}:
            place += 1
            at += 1
        elif star >= 0:
            tried += 1
            place, at = star + 1, tried
        else:
            return False
    return not pattern[place:].strip('*')


def _is_near(pose: str, x: float, y: float, radius: float) -> bool:
    try:
        east, north = (float(part) for part in pose.split(' ')[:2])
    except ValueError:
        return False
    return math.hypot(east - x, north - y) <= radius


def _is_near_on_earth(fix: str, circle: tuple[float, float, float]) -> bool:
    latitude, longitude, radius = circle
    try:
        north, east = (float(part) for part in fix.split(' ')[:2])
    except ValueError:
        return False
    return earth.is_within(north, east, latitude, longitude, radius)


def _check_time(name: str, stamp_ns: Any) -> None:
    if type(stamp_ns) is not int or not EARLIEST_SANE_NS <= stamp_ns <= LATEST_NS:
        raise RequestRefused('time', f'{name} is not a time in nanoseconds since 1970')


def _checked_id(given: Any) -> str:
    if not (isinstance(given, str) and _ID.fullmatch(given)):
        raise RequestRefused('id', 'an id is 32 hexadecimal digits')
    return given
