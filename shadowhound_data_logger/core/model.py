"""The only things that stages exchange: frozen, slotted, without behavior of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.stamps import Times, by_arrival

UPLOAD_WHEN: Final = 'upload.when'
EVENTS_WHEN: Final = 'events.when'
"""Settings that objects wait for (``waits_for``)."""
ON_ROBOT, LOST = 'robot', 'lost'
"""Where an object is that a robot kept (the column ``where`` of ``catalog.schema.KEPT``)."""
PREVIEWS: Final = '_previews'
"""The folder of previews; a preview's sensor has this behind its name."""


class Sample(NamedTuple):
    """One message as it was taken: its time and its serialized form (CDR with the 4-byte encapsulation header)."""

    stamp_ns: int
    """By ``stamps.StampTrack``."""
    cdr: bytes
    received_ns: int = 0
    """When it arrived, as of ``Taken``."""
    publisher: str | None = None
    """Who sent it, as of ``Taken``."""
    untrusted_ns: int = 0
    """Its own stamp if it is dated by its arrival instead, as of ``Taken``."""

    @property
    def times(self) -> Times:
        return Times(self.stamp_ns, self.received_ns)


class Taken(NamedTuple):
    """A serialized message with what the middleware knows of it; None where it does not say."""

    cdr: bytes
    source_ns: int
    """When it was sent, Unix nanoseconds; to the consumers of a stream, its arrival where that cannot be trusted."""
    publisher: str | None
    number: int | None
    received_ns: int = 0
    """When the middleware of this machine received it, Unix nanoseconds; 0 if it does not report that."""
    stamp_ns: int = 0
    """The time of the message by ``stamps.StampTrack``; 0 before its stream has decided that."""
    clock: str | None = None
    """The publisher, if its stamps are trusted and more than a second from their arrival: they follow another clock."""
    untrusted_ns: int = 0
    """Its own stamp if it is dated by its arrival instead; 0 otherwise."""

    @property
    def times(self) -> Times:
        return Times(self.stamp_ns, self.received_ns)


@dataclass(frozen=True, slots=True)
class Batch:
    """The samples of one sensor that become one object; ``samples`` is never empty and of one type."""

    sensor: str
    topic: str
    type: str
    samples: tuple[Sample, ...]
    size: int
    """Bytes of CDR in it."""


@dataclass(frozen=True, slots=True)
class FileBody:
    """A finished file, synced by its writer, as the content of an object: the spool takes it over without reading it.

    It has to be closed for good. Where ``path`` is on the spool's file system it is linked, else copied; it is removed once
    the object is durable, and stays where that never happened.
    """

    path: Path
    size: int
    sha256: str
    """Lower-case hex of the content."""

    def __len__(self) -> int:
        return self.size


@dataclass(frozen=True, slots=True)
class DataObject:
    """A finished object on its way into the spool: where it wants to go, its bytes, and what it is."""

    bucket: str
    key: str
    """The wanted key; the spool makes it unique (``_1``, ``_2``, ...)."""
    body: bytes | FileBody
    content_type: str
    sensor: str
    topic: str | None
    """The ROS topic its samples count for in the ledger; None for bookkeeping."""
    type: str
    samples: int
    t_start_ns: int
    t_end_ns: int
    priority: int = 5
    """0 ... 9; 0 is shipped first and evicted last."""
    protected: bool = False
    """Never evicted."""
    held: str | None = None
    """Why it has no final name yet; None when it may be shipped."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Further S3 user metadata: lower-case names, printable ASCII values."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Messages by account (``spool.accounts``) of an object that holds those of several; ``topic`` is None then."""
    dedup: bool = False
    """Not stored where its content is that of the object which its sensor stored before it (``spool.repeats``)."""
    key_pattern: str | None = None
    """The wanted key with its time left open (``keys.dated``), should that not be known yet."""
    statistics: bytes = b''
    """Statistics of the numbers in it, for the catalog, as ``formats.statistics.pack_statistics`` returns them."""
    catalogs: tuple[int, ...] = ()
    """A part of the catalog: the ids of the objects that it has rows of. It is left out where another part has one of them."""
    tells: tuple[tuple[int, str], ...] = ()
    """A part of the table of what is kept: the ids and states of its rows. It is left out where another part has one of them."""
    answers: tuple[str, int, str] | None = None
    """An answer to a request: its id, the answer's number and the state that it tells. It is left out where that was given."""

    @property
    def last_times(self) -> Times:
        """Of its last message. Files of several topics are bags, which are dated by arrival."""
        if self.counts:
            return by_arrival(self.t_end_ns)
        received = self.metadata.get(words.RECEIVED_END_NS, '')
        return Times(self.t_end_ns, int(received) if received.isdecimal() and len(received) < 20 else 0)

    @property
    def is_on_request(self) -> bool:
        """Whether it stays on the robot until somebody asks for it."""
        return self.metadata.get(words.SHIP) == words.ON_REQUEST


class State(str, Enum):
    """Where a spooled object is; the value is the ledger's word for it."""

    PENDING = 'pending'
    HELD = 'held'
    DELIVERED = 'delivered'
    EVICTED = 'evicted'
    QUARANTINED = 'quarantined'
    DEDUPLICATED = 'deduplicated'
    KEPT = 'kept'
    """Stays on the robot's disk until somebody asks for it."""


@dataclass(frozen=True, slots=True)
class SpooledObject:
    """A durable object as the index knows it: its bytes lie at ``path`` until the store confirmed them."""

    id: int
    bucket: str
    key: str
    path: Path
    size: int
    sha256: str
    """Lower-case hex of the content."""
    content_type: str
    metadata: Mapping[str, str]
    """S3 user metadata, ``sha256`` among it."""
    priority: int
    created_ns: int
    waits_for: str = ''
    """The rule that has to hold for it to be uploaded (``waits_for``); empty for none."""


def waits_for(sensor: str, metadata: Mapping[str, str], *, protected: bool) -> str:
    """The setting that says when an object is uploaded; empty for what always is.

    Always: what tells of the robot and of other objects (catalog, gaps, ledger, previews, answers), and what is never evicted
    (endings of bags, summaries of missions, what was asked for), but for the bags of events.
    """
    if sensor.startswith('_') or sensor.endswith(PREVIEWS):
        return ''
    if not protected:
        return UPLOAD_WHEN
    return EVENTS_WHEN if words.EVENT in metadata else ''


@dataclass(frozen=True, slots=True)
class HeldObject:
    """An object that has no final name yet, as the index knows it."""

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
    """What a held object becomes; its content stays."""

    id: int
    key: str
    """The wanted key; the spool makes it unique."""
    metadata: Mapping[str, str]
    """All of it but ``sha256``, which stays."""
    t_start_ns: int
    t_end_ns: int


class SliceRow(NamedTuple):
    """A closed slice of a recording, as the index and each later slice know it."""

    number: int
    bytes: int
    sha256: str
    t_start_ns: int
    t_end_ns: int
    messages: int
    counts: str
    """JSON: a list of its messages by topic, in the order of the recording's channels; null for a topic that it has not."""


class MissingRow(NamedTuple):
    """Something that should have been in a recording (``bags.manifest.Missing``)."""

    place: int
    """Among all that is missing in it, from 0."""
    file: str
    what: str
    messages: int | None
    topic: str | None
    reason: str | None


@dataclass(frozen=True, slots=True)
class RecordingRows:
    """What the index keeps of a bag that is not whole in the spool yet, or what one commit adds to that."""

    folder: str
    """The name of its folder: no other recording of its owner has it."""
    said: str = ''
    """JSON: what is known of it (``bags.state``)."""
    channels: str = ''
    """JSON: a list of its channels without definitions, as they first appeared."""
    slices: tuple[SliceRow, ...] = ()
    missing: tuple[MissingRow, ...] = ()
    is_whole: bool = False
    """All that is known of it goes."""


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """What a store says of one object that it holds."""

    bucket: str
    key: str
    size: int
    sha256: str | None
    """From the object's metadata; None where a listing does not tell, or a foreign writer set none."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    content_type: str = ''
    etag: str = ''
    """Of a listing, and of content that is read: changes with the content; empty where the store has none."""
    modified: datetime | None = None
    """Of a listing."""


class Put(str, Enum):
    """How a confirmed put ended."""

    CREATED = 'created'
    IDENTICAL = 'identical'
    """The key held the very same content already (an earlier try whose answer was lost): a success."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What delivery found out about an object: it leaves PENDING for ``state``."""

    item: SpooledObject
    state: State
    reason: str | None = None
