"""The values that stages exchange: frozen, slotted, without behavior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.stamps import Times, by_arrival

UPLOAD_WHEN: Final = 'upload.when'
EVENTS_WHEN: Final = 'events.when'
"""Settings that delay the upload of objects (``waits_for``)."""
ON_ROBOT, LOST = 'robot', 'lost'
"""The state of an object that a robot kept (the column ``where`` of ``formats.rows.catalog.KEPT``)."""
PREVIEWS: Final = '_previews'
"""The folder of previews, and the suffix of a preview's sensor."""


class Sample(NamedTuple):
    """One message as taken: its time and its serialized form (CDR with the 4-byte encapsulation header)."""

    stamp_ns: int
    """From ``stamps.StampTrack``."""
    cdr: bytes
    received_ns: int = 0
    """Arrival time, as in ``Taken``."""
    publisher: str | None = None
    """The publisher, as in ``Taken``."""
    untrusted_ns: int = 0
    """Its own stamp if it is dated by its arrival instead, as in ``Taken``."""

    @property
    def times(self) -> Times:
        return Times(self.stamp_ns, self.received_ns)


class Taken(NamedTuple):
    """A serialized message with the middleware's information about it; None where unknown."""

    cdr: bytes
    source_ns: int
    """Time of sending, Unix ns; for the consumers of a stream, the arrival if the time of sending cannot be trusted."""
    publisher: str | None
    number: int | None
    received_ns: int = 0
    """When the middleware of this machine received it, Unix ns; 0 if it does not report that."""
    stamp_ns: int = 0
    """The time of the message by ``stamps.StampTrack``; 0 until its stream has decided."""
    clock: str | None = None
    """The publisher, if its stamps are trusted and more than a second from their arrival: they follow another clock."""
    untrusted_ns: int = 0
    """Its own stamp if it is dated by its arrival instead; 0 otherwise."""

    @property
    def times(self) -> Times:
        return Times(self.stamp_ns, self.received_ns)


@dataclass(frozen=True, slots=True)
class Batch:
    """The samples of one sensor that become one object; ``samples`` is never empty and has one type."""

    sensor: str
    topic: str
    type: str
    samples: tuple[Sample, ...]
    size: int
    """Bytes of CDR in it."""


@dataclass(frozen=True, slots=True)
class FileBody:
    """A finished file, synced by its writer, as the content of an object: the spool takes it over without reading it.

    It must be closed. If ``path`` is on the spool's file system it is linked, otherwise copied. It is removed once the object is
    durable, and kept if that fails.
    """

    path: Path
    size: int
    sha256: str
    """Lower-case hex of the content."""

    def __len__(self) -> int:
        return self.size


@dataclass(frozen=True, slots=True)
class DataObject:
    """A finished object for the spool: its wanted key, its content, and its metadata."""

    bucket: str
    key: str
    """The wanted key; the spool makes it unique (``_1``, ``_2``, ...)."""
    body: bytes | FileBody
    content_type: str
    sensor: str
    topic: str | None
    """The ROS topic that the ledger counts its samples for; None for bookkeeping."""
    type: str
    samples: int
    t_start_ns: int
    t_end_ns: int
    priority: int = 5
    """0 ... 9; 0 is shipped first and evicted last."""
    protected: bool = False
    """Never evicted."""
    held: str | None = None
    """Why it has no final name yet; None if it can be uploaded."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Further S3 user metadata: lower-case names, printable ASCII values."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Messages by account (``spool.accounts``), if the object has messages of several topics; ``topic`` is None then."""
    dedup: bool = False
    """Do not store it if its content equals the previous object of its sensor (``spool.repeats``)."""
    key_pattern: str | None = None
    """The wanted key without its time (``keys.dated``), if that is not known yet."""
    statistics: bytes = b''
    """Statistics of its numbers, for the catalog, as returned by ``formats.statistics.pack_statistics``."""
    catalogs: tuple[int, ...] = ()
    """Set on a part of the catalog: the ids of the objects it has rows for. It is skipped if another part has one of them."""
    reports: tuple[tuple[int, str], ...] = ()
    """Set on a part of the table of kept objects: the ids and states of its rows. It is skipped if another part has one of them.
    """
    answers: tuple[str, int, str] | None = None
    """Set on an answer to a request: its id, the answer's number and state. It is skipped if that answer was given."""

    @property
    def last_times(self) -> Times:
        """The times of its last message. Files with several topics are bags, which are dated by arrival."""
        if self.counts:
            return by_arrival(self.t_end_ns)
        received = self.metadata.get(meta.RECEIVED_END_NS, '')
        return Times(self.t_end_ns, int(received) if received.isdecimal() and len(received) < 20 else 0)

    @property
    def is_on_request(self) -> bool:
        """Whether it is kept on the robot until requested."""
        return self.metadata.get(meta.SHIP) == meta.ON_REQUEST


class State(str, Enum):
    """The state of a spooled object; the values are the ledger's terms."""

    PENDING = 'pending'
    HELD = 'held'
    DELIVERED = 'delivered'
    EVICTED = 'evicted'
    QUARANTINED = 'quarantined'
    DEDUPLICATED = 'deduplicated'
    KEPT = 'kept'
    """Kept on the robot's disk until requested."""


@dataclass(frozen=True, slots=True)
class SpooledObject:
    """A durable object as in the index: its file is at ``path`` until the store has confirmed it."""

    id: int
    bucket: str
    key: str
    path: Path
    size: int
    sha256: str
    """Lower-case hex of the content."""
    content_type: str
    metadata: Mapping[str, str]
    """S3 user metadata, including ``sha256``."""
    priority: int
    created_ns: int
    waits_for: str = ''
    """The rule that must be true before it is uploaded (``waits_for``); empty for none."""


def waits_for(sensor: str, metadata: Mapping[str, str], *, protected: bool) -> str:
    """The setting that decides when an object is uploaded; empty if it is always uploaded.

    Always uploaded: data about the robot and about other objects (catalog, gaps, ledger, previews, answers), and everything that
    is never evicted (ends of bags, summaries of missions, requested objects), except the bags of events.
    """
    if sensor.startswith('_') or sensor.endswith(PREVIEWS):
        return ''
    if not protected:
        return UPLOAD_WHEN
    return EVENTS_WHEN if meta.EVENT in metadata else ''


@dataclass(frozen=True, slots=True)
class HeldObject:
    """An object in the index that has no final name yet."""

    id: int
    bucket: str
    key: str
    """A provisional one."""
    metadata: Mapping[str, str]
    t_start_ns: int
    t_end_ns: int
    created_ns: int


@dataclass(frozen=True, slots=True)
class Binding:
    """What a held object becomes; its content is unchanged."""

    id: int
    key: str
    """The wanted key; the spool makes it unique."""
    metadata: Mapping[str, str]
    """Complete except for ``sha256``, which does not change."""
    t_start_ns: int
    t_end_ns: int


class SliceRow(NamedTuple):
    """A closed slice of a recording, as stored in the index and in each later slice."""

    number: int
    bytes: int
    sha256: str
    t_start_ns: int
    t_end_ns: int
    messages: int
    counts: str
    """JSON: its message counts by topic, in the order of the recording's channels; null for a topic that is not in it."""


class MissingRow(NamedTuple):
    """Something missing from a recording (``bags.manifest.Missing``)."""

    place: int
    """Its position in the recording's list of missing things, from 0."""
    file: str
    what: str
    messages: int | None
    topic: str | None
    reason: str | None


@dataclass(frozen=True, slots=True)
class RecordingRows:
    """What the index stores of an incomplete bag, or what one commit adds to that."""

    folder: str
    """The name of its folder, unique among the recordings of its owner."""
    facts: str = ''
    """JSON: facts about it (``bags.state``)."""
    channels: str = ''
    """JSON: a list of its channels without definitions, in order of first appearance."""
    slices: tuple[SliceRow, ...] = ()
    missing: tuple[MissingRow, ...] = ()
    is_whole: bool = False
    """Everything about it is removed."""


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """What a store reports of one object."""

    bucket: str
    key: str
    size: int
    sha256: str | None
    """From the object's metadata; None if a listing does not contain it, or a foreign writer did not set it."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    content_type: str = ''
    etag: str = ''
    """From a listing or a read: changes with the content; empty if the store has none."""
    modified: datetime | None = None
    """From a listing."""


class Put(str, Enum):
    """How a confirmed put ended."""

    CREATED = 'created'
    IDENTICAL = 'identical'
    """The key already had the same content (an earlier attempt whose response was lost): a success."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a delivery: the object moves from PENDING to ``state``."""

    item: SpooledObject
    state: State
    reason: str | None = None
