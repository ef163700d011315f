"""The mailbox of a robot: what is asked of it, as one JSON object in the store that it polls and may only read.

``sensor-data/_requests/<robot>/inbox.json`` is ``{"format": 1, "entries": [...]}``. An entry asks (``id robot by made_ns
expires_ns priority want``) or takes a request back (``cancel by made_ns``). The id is the hash of what is asked for, so that
asking twice is asking once. Answers are objects of their own, ``<robot>/_answers/<id>/<n>.json``, never changed. Whoever writes
an inbox is not trusted: everything in it is checked here, before anything is done with it.
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
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import LOST, ON_ROBOT
from shadowhound_data_logger.core.untrusted import from_json

MAILBOX_BUCKET: Final = 'sensor-data'
FORMAT: Final = 1
MOST_INBOX_BYTES: Final = 256 << 10
MAX_ENTRIES: Final = 256
MAX_KEYS: Final = 1000
"""Keys and patterns of one request."""
MAX_PATTERN: Final = 512
MAX_WILD: Final = 16
"""Of them with ``*`` or ``?``: each is tried on all that is kept."""
LATEST_NS: Final = 4_102_444_800 * SECOND
"""2100."""
LONGEST_NS: Final = 90 * 24 * 3600 * SECOND
"""From asking to expiry."""
DEFAULT_EXPIRY_NS: Final = 7 * 24 * 3600 * SECOND
DEFAULT_PRIORITY: Final = 5
BAG_SENSOR: Final = 'bag'
"""Its objects are slices: one is wanted where its time overlaps the time that is asked for."""
MIN_SPARED: Final = 64 << 10
"""Bytes that cutting a slice has to spare: a cut is three objects."""
_ID: Final = re.compile(r'[0-9a-f]{32}')
_PATTERN: Final = re.compile(r"[A-Za-z0-9!_.'()=+@*?/-]+")
_WORDS: Final = ('sensor', 'topic', 'mission', 'mission_type')
_MAX_WORD: Final = 256
_ASKING: Final = frozenset({'id', 'robot', 'by', 'made_ns', 'expires_ns', 'priority', 'want'})
_CANCELLING: Final = frozenset({'cancel', 'by', 'made_ns'})


class RequestRefused(ValueError):
    """An entry or a mailbox is not one of ours; ``reason`` is a word for counting."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFilter:
    """Which of the objects that a robot keeps are wanted: all that is given must hold."""

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
    """How the id of a mission or of its run begins."""
    mission_type: str | None = None
    keys: frozenset[str] = frozenset()
    """Its key is one of these, or matches one of the patterns."""
    patterns: tuple[str, ...] = ()
    """``*`` stands for any letters, ``?`` for one."""

    def to_json(self) -> dict[str, Any]:
        """What is given, in the form that the id is the hash of."""
        said: dict[str, Any] = {name: value for name in _WORDS if (value := getattr(self, name)) is not None}
        said |= {name: value for name in ('since_ns', 'until_ns') if (value := getattr(self, name)) is not None}
        for name, circle in (('near', self.near), ('near_gps', self.near_gps)):
            if circle is not None:
                said[name] = [float(value) for value in circle]
        if self.keys or self.patterns:
            said['keys'] = sorted(self.keys.union(self.patterns))
        return said

    def bytes_of(self, key: str, sensor: str, size: int, begin_ns: int, end_ns: int, metadata: Mapping[str, str]) -> int:
        """About how many bytes of an object are wanted: fewer than it has of a slice that is cut at a time that is asked for.

        A slice whose times are not those of its messages, since the clock was set later, is sent whole.
        """
        if sensor != BAG_SENSOR or not key.endswith('.mcap') or words.CLOCK in metadata:
            return size
        since_ns, until_ns = max(self.since_ns or begin_ns, begin_ns), min(self.until_ns or end_ns + 1, end_ns + 1)
        wanted = size * max(until_ns - since_ns, 1) // max(end_ns + 1 - begin_ns, 1)
        return max(wanted, 1) if size - wanted >= MIN_SPARED else size

    def takes(self, key: str, sensor: str, topic: str | None, begin_ns: int, end_ns: int, metadata: Mapping[str, str]) -> bool:
        """Whether an object is wanted; ``metadata`` as it will have it in the store."""
        if self.sensor not in {None, sensor} or self.topic not in {None, topic}:
            return False
        if self.since_ns is not None and (end_ns if sensor == BAG_SENSOR else begin_ns) < self.since_ns:
            return False
        if self.until_ns is not None and begin_ns >= self.until_ns:
            return False
        if self.mission_type not in {None, metadata.get(words.MISSION_TYPE)}:
            return False
        if self.mission is not None:
            names = (metadata.get(words.MISSION_ID, ''), metadata.get(words.RUN_ID, ''))
            if not any(name.startswith(self.mission) for name in names):
                return False
        is_near = self.near is None or _is_near(metadata.get(words.POSE, ''), *self.near)
        if not is_near or not (self.near_gps is None or _is_near_on_earth(metadata.get(words.GPS, ''), self.near_gps)):
            return False
        if not self.keys and not self.patterns:
            return True
        return key in self.keys or any(_matches(pattern, key) for pattern in self.patterns)


@dataclass(frozen=True, slots=True, kw_only=True)
class PullRequest:
    """Somebody asks for what a robot keeps; times in Unix nanoseconds."""

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
    """Somebody takes a request back."""

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
    """An answer of a robot to a request, as JSON in ``answer_key``."""

    format: int = FORMAT
    id: str
    number: int = 0
    """Of the answers to this request, from 1."""
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
    """That the request found."""
    bytes: int = 0
    gone: Mapping[str, Any] = field(default_factory=dict)
    """What had left the robot before the request; empty if nothing had."""
    mbps: float | None = None
    """The pace of the link."""
    outcomes: Mapping[str, ObjectCount] = field(default_factory=dict)
    """By state: ``delivered``, ``pending``, ``unsent``, ..."""
    lost: tuple[LostObject, ...] = ()
    """The first of them."""
    bags: tuple[str, ...] = ()
    """Bags that were cut for the request."""

    @property
    def delivered(self) -> ObjectCount:
        return self.outcomes.get('delivered', ObjectCount())


def size_of(want: KeptFilter, row: Mapping[str, Any]) -> int:
    """About how many bytes of an object are wanted, by its row of ``catalog.schema.KEPT``: of a slice at its ends a part."""
    begin_ns = row['t_start_ns'] or 0
    return want.bytes_of(row['key'], row['sensor'] or '', row['bytes'] or 0, begin_ns, row['t_end_ns'] or begin_ns, {})


@dataclass(frozen=True, slots=True)
class Offer:
    """What a request would get."""

    objects: int
    """That the robot keeps."""
    bytes: int
    """That it would send, approximately."""
    lost: Mapping[str, int]
    """Objects that it has lost, by reason."""
    mbps: float | None
    """Its pace; None if unknown."""

    @property
    def seconds(self) -> float | None:
        """How long these bytes take at this pace."""
        return 8e-6 * self.bytes / self.mbps if self.mbps else None

    def to_json(self) -> dict[str, Any]:
        return {'objects': self.objects, 'bytes': self.bytes, 'lost': dict(self.lost), 'mbps': self.mbps, 'seconds': self.seconds}


def offer(want: KeptFilter, rows: Iterable[Mapping[str, Any]], mbps: float | None) -> Offer:
    """What a request for these rows of ``formats.rows.schema.KEPT`` would get; the filter selects all of them."""
    objects, size, lost = 0, 0, Counter[str]()
    for row in rows:
        if row['where'] == ON_ROBOT:
            size += size_of(want, row)
            objects += 1
        elif row['where'] == LOST:
            lost[row['reason'] or 'unknown'] += 1
    return Offer(objects, size, lost, mbps)


def inbox_key(robot: str) -> str:
    """Of a robot's mailbox, in ``MAILBOX_BUCKET``."""
    return f'_requests/{robot}/inbox.json'


def answers_prefix(robot: str, request: str) -> str:
    """Of the keys of the answers to a request."""
    return f'{robot}/_answers/{request}/'


def answer_key(robot: str, request: str, number: int) -> str:
    """Of one of them, counted from 1."""
    return f'{answers_prefix(robot, request)}{number}.json'


def request_id(robot: str, want: Mapping[str, Any]) -> str:
    """The hash of what is asked for of a robot: 32 hexadecimal digits."""
    text = json.dumps({'robot': robot, 'want': want}, sort_keys=True, separators=(',', ':'))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def encode_inbox(entries: Sequence[Mapping[str, Any]]) -> bytes:
    """The mailbox with these entries. Raises RequestRefused where it would be too large."""
    body = json.dumps({'format': FORMAT, 'entries': list(entries)}, separators=(',', ':')).encode()
    if len(entries) > MAX_ENTRIES or len(body) > MOST_INBOX_BYTES:
        raise RequestRefused('too_large', f'the mailbox is full: {len(entries):,} entries, {len(body):,} bytes')
    return body


def decode_inbox(body: bytes) -> list[Any]:
    """The entries of a mailbox, none of them checked. Raises RequestRefused."""
    if len(body) > MOST_INBOX_BYTES:
        raise RequestRefused('too_large', f'the mailbox has more than {MOST_INBOX_BYTES:,} bytes')
    try:
        found = from_json(body, MOST_INBOX_BYTES)
    except ValueError as error:
        raise RequestRefused('not_json', f'the mailbox is not JSON: {error}') from error
    entries = found.get('entries') if isinstance(found, dict) and set(found) == {'format', 'entries'} else None
    if not isinstance(entries, list) or found['format'] != FORMAT:
        raise RequestRefused('not_ours', f'the mailbox is none of format {FORMAT}')
    if len(entries) > MAX_ENTRIES:
        raise RequestRefused('too_many', f'the mailbox has more than {MAX_ENTRIES} entries')
    return entries


def read_entry(robot: str, entry: Any) -> PullRequest | PullCancel:
    """An entry of a mailbox. Raises RequestRefused for one that is not as ``to_json`` makes them."""
    if not isinstance(entry, dict):
        raise RequestRefused('not_ours', 'it is not an object')
    fields = _CANCELLING if 'cancel' in entry else _ASKING
    if set(entry) != fields:
        unlike = sorted(str(name)[:32] for name in set(entry) ^ fields)
        raise RequestRefused('fields', f'it has to have exactly the fields {" ".join(sorted(fields))}; wrong: {unlike[:3]}')
    by, made_ns = entry['by'], entry['made_ns']
    if not (isinstance(by, str) and is_name(by)):
        raise RequestRefused('name', 'by is not a name')
    _check_time('made_ns', made_ns)
    if 'cancel' in entry:
        return PullCancel(id=_checked_id(entry['cancel']), by=by, made_ns=made_ns)
    expires_ns, priority = entry['expires_ns'], entry['priority']
    _check_time('expires_ns', expires_ns)
    if not made_ns < expires_ns <= made_ns + LONGEST_NS:
        raise RequestRefused('time', 'expires_ns is not within 90 days after made_ns')
    if type(priority) is not int or not 0 <= priority <= 9:
        raise RequestRefused('priority', 'priority is not a whole number from 0 to 9')
    if entry['robot'] != robot:
        raise RequestRefused('robot', 'it is for another robot')
    want = _read_want(entry['want'])
    request = PullRequest(robot=robot, by=by, made_ns=made_ns, expires_ns=expires_ns, want=want, priority=priority)
    if _checked_id(entry['id']) != request.id:
        raise RequestRefused('id', 'its id is not the hash of what it asks for')
    return request


def _read_want(said: Any) -> KeptFilter:
    if not isinstance(said, dict) or not set(said) <= {*_WORDS, 'since_ns', 'until_ns', 'near', 'near_gps', 'keys'} or not said:
        raise RequestRefused('fields', 'want is not an object of known fields')
    for name in _WORDS:
        if name in said and not (isinstance(said[name], str) and 0 < len(said[name]) <= _MAX_WORD and said[name].isprintable()):
            raise RequestRefused('want', f'{name} is not a short text')
    for name in ('since_ns', 'until_ns'):
        if name in said:
            _check_time(name, said[name])
    keys = said.get('keys', [])
    if (
        not isinstance(keys, list)
        or len(keys) > MAX_KEYS
        or not all(map(_is_pattern, keys))
        or sum(map(_is_wild, keys)) > MAX_WILD
    ):
        raise RequestRefused('keys', f'keys are not at most {MAX_KEYS} keys, {MAX_WILD} of them patterns')
    near, on_earth = said.get('near'), said.get('near_gps')
    if near is not None and not _is_circle(near):
        raise RequestRefused('near', 'near is not x, y and a radius in meters')
    if on_earth is not None and not (_is_circle(on_earth) and earth.is_place(*on_earth[:2])):
        raise RequestRefused('near_gps', 'near_gps is not latitude, longitude and a radius in meters')
    given = {name: said[name] for name in (*_WORDS, 'since_ns', 'until_ns') if name in said}
    return KeptFilter(
        **given, near=_triple(near), near_gps=_triple(on_earth), keys=frozenset(key for key in keys if not _is_wild(key)),
        patterns=tuple(key for key in keys if _is_wild(key)),
    )  # fmt: skip


def _is_circle(near: Any) -> bool:
    numbers = isinstance(near, list) and len(near) == 3 and all(type(one) in {int, float} for one in near)
    return numbers and all(abs(one) < 1e9 and math.isfinite(one) for one in near) and near[2] > 0


def _triple(circle: Any) -> tuple[float, float, float] | None:
    return None if circle is None else (circle[0], circle[1], circle[2])


def _is_pattern(pattern: Any) -> bool:
    return isinstance(pattern, str) and len(pattern) <= MAX_PATTERN and bool(_PATTERN.fullmatch(pattern))


def _is_wild(pattern: str) -> bool:
    return '*' in pattern or '?' in pattern


def _matches(pattern: str, key: str) -> bool:
    """Whether ``*`` and ``?`` can be filled so; it goes back to the last star alone, so hostile patterns cost little."""
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
