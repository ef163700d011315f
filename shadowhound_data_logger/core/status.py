"""What a node reports about itself once per second: the content of the status file, the source of ``/diagnostics``.

Field names are those of ``shadowhound-data status --json``. Every field has a default, so that a newer program can read the
status of an older node. Unknown values are None.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from shadowhound_data_logger.core.stamps import StampReport


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """A thread."""

    alive: bool = True
    failing: bool = False
    """Whether the last round failed, or the thread exited unexpectedly."""
    failures: int = 0
    """Failed rounds and unexpected exits."""
    deaths: int = 0
    """Unexpected exits of the thread itself."""
    last_error: str = ''
    """The newest failure; the thread may have recovered."""
    busy_s: float = 0.0
    """Duration of the current round so far."""
    patience_s: float | None = None
    """Longer rounds are a stall; None where any duration is normal."""


@dataclass(frozen=True, slots=True)
class ConsumerStatus:
    """A consumer of the intake."""

    failures: int = 0
    last_error: str = ''


@dataclass(frozen=True, slots=True)
class ClockState:
    """The wall clock."""

    is_set: bool = True
    gave_up: bool = False
    """Whether it was not set for so long that objects no longer wait for it."""
    unset_s: float = 0.0
    """How long it has not been set, as far as this process knows; 0 when it is set."""
    steps: int = 0
    """Steps so far; the first setting is one."""
    last_step_s: float | None = None
    last_step_age_s: float | None = None


@dataclass(frozen=True, slots=True)
class OtherType:
    """Another type under which the topic is published in addition to the one that is logged."""

    publishers: tuple[str, ...] = ()
    """Nodes; some of them if there are many."""
    messages: int | None = 0
    """Rejected messages of this type; None if not all of them were received."""


@dataclass(frozen=True, slots=True)
class Totals:
    """The messages of a topic in this session, as sums."""

    type: str = ''
    accounting: str | None = None
    """The grade of the newest message; None before the first."""
    received: int = 0
    stored: int = 0
    skipped: int = 0
    rejected: int = 0
    dropped: int = 0
    """Without those during a pause that an operator requested."""
    paused: int = 0
    missed: int | None = None
    """None if it is not known exactly."""
    missed_estimated: int | None = None
    """None if it is known exactly, or unknown."""
    open: int = 0
    wrong_type: int = 0
    """Part of ``received`` and ``rejected``: messages of another type than the topic's own."""
    other_types: Mapping[str, OtherType] = field(default_factory=dict)
    missed_by: Mapping[str, int] = field(default_factory=dict)
    """By cause, estimates included."""
    gaps: int = 0
    """How often consecutive messages were lost, for any cause."""
    by_arrival: Mapping[str, int] = field(default_factory=dict)
    """Messages dated by their arrival, by the reason why their own time was not trusted."""
    corrected: Mapping[str, int] = field(default_factory=dict)
    """Stored messages that had to be corrected, by what was wrong with them."""
    stamps: StampReport | None = None
    """Unusual stamps of its publishers at present."""


@dataclass(frozen=True, slots=True)
class TopicStatus(Totals):
    """A topic with its subscription."""

    sensor: str = ''
    enabled: bool = True
    publishers: int = 0
    matched: int = 0
    """Publishers that the subscription is matched with."""
    may_be_silent: bool = False
    unavailable: str = ''
    """Why it cannot be subscribed to here; empty if it can."""
    rate_hz: float = 0.0
    age_s: float | None = None
    """Seconds since its last message."""
    size: int | None = None
    """Bytes of its last message, serialized."""


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """The queue between intake and encoders."""

    batches: int = 0
    messages: int = 0
    bytes: int = 0
    finished: int = 0
    """Batches that were taken from it and are finished."""
    max_messages: int = 0
    max_bytes: int = 0


@dataclass(frozen=True, slots=True)
class SpoolStatus:
    """What a spool contains."""

    path: str = ''
    pending: int = 0
    held: int = 0
    quarantined: int = 0
    bytes: int = 0
    """Payload on disk, without kept objects."""
    free_bytes: int | None = None
    """Free space of the file system."""
    oldest_age_s: float | None = None
    """How long the oldest pending object has waited; None if none waits, or it was spooled before the clock was set."""
    kept: int = 0
    """Objects that stay here until they are requested."""
    kept_bytes: int = 0
    evicted: int = 0
    """In this session."""
    unkept: int = 0
    """Objects of this session that could not be kept, because no kept object may be evicted."""
    max_bytes: int | None = None
    """A setting of the node, like the next two."""
    min_free_bytes: int | None = None
    remember_days: float | None = None


@dataclass(frozen=True, slots=True)
class DeliveryStatus:
    """Delivery in this session."""

    state: str = 'idle'
    """``idle``, ``shipping``, ``store_down``, ``paused`` (keys, certificate, rights), ``not_draining`` (another process
    delivers) or ``waiting`` (for a rule, ``waits_for``)."""
    last_error: str = ''
    """The newest failure of this session, with its remedy; it may have ended."""
    delivered: int = 0
    """Objects that the store confirmed, including those that it had already."""
    in_flight: int = 0
    deferred: int = 0
    """Objects that failed and wait for their next attempt."""
    retries: int = 0
    """Failed attempts of objects that stay pending."""
    quarantined: int = 0
    blocked_buckets: Mapping[str, str] = field(default_factory=dict)
    """Bucket -> why nothing is sent to it."""
    max_mbps: float = 0.0
    """The configured limit, megabits per second; 0 for none. It applies to S3 servers, not to a folder."""
    waits_for: Mapping[str, str] = field(default_factory=dict)
    """Rules that are not satisfied, such as ``upload.when``, and why."""


@dataclass(frozen=True, slots=True)
class StoreStatus(DeliveryStatus):
    """Delivery and its target."""

    target: str = ''
    """The store, as it describes itself."""
    mbps: float = 0.0
    left_s: int | None = None
    """How long uploading the spool takes at this throughput."""
    stuck: Mapping[str, str] = field(default_factory=dict)
    """Rules that can never be satisfied, because their topics have no publisher: what to do."""


@dataclass(frozen=True, slots=True)
class RequestStatus:
    """Open requests for kept objects."""

    open: int = 0
    bytes: int = 0
    """Requested and not yet released."""
    mbps: float | None = None
    """Throughput of the link; None before it is known."""
    left_s: int | None = None
    """How long these bytes take at this throughput."""


@dataclass(frozen=True, slots=True)
class UndiscoveredTopic:
    """A topic with publishers that the robot's RMW finds and the node does not."""

    publishers: int = 0
    nodes: tuple[str, ...] = ()
    seconds: int = 0
    text: str = ''


@dataclass(frozen=True, slots=True)
class MiddlewareStatus:
    """The RMW through which the node listens, and that of the robot."""

    rmw: str = ''
    robot: str = ''
    why: str = ''
    asked: str = ''
    network: str = ''
    receive_bytes: int | None = None
    """The largest receive buffer of its UDP sockets."""
    dropped_datagrams: int = 0
    undiscovered: Mapping[str, UndiscoveredTopic] | None = None
    """None while the two are not compared."""


@dataclass(frozen=True, slots=True)
class MissionStatus:
    """The active mission; false if there is none."""

    mission_id: str = ''
    run_id: str | None = None
    type: str = ''
    started: str = ''
    policy: str | None = None

    def __bool__(self) -> bool:
        return bool(self.mission_id)


@dataclass(frozen=True, slots=True)
class BagStatus:
    """The recording; all but ``recording``, ``topics`` and ``left_out`` describe the bag that is being recorded."""

    recording: bool = False
    paused: bool = False
    bag: str = ''
    slice: int = 0
    """Number of the newest one, from 0."""
    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    duration_s: float = 0.0
    queue_bytes: int = 0
    refused: str = ''
    """Why it cannot be written to the disk now."""
    topics: Mapping[str, Totals] = field(default_factory=dict)
    left_out: int = 0
    """Topics that are not recorded because there are too many that no setting names."""


@dataclass(frozen=True, slots=True)
class Trigger:
    """What triggered an event; false if nothing did."""

    name: str = ''
    by: str = ''
    time: str = ''
    bag: str = ''

    def __bool__(self) -> bool:
        return bool(self.name)


@dataclass(frozen=True, slots=True)
class EventStatus:
    """Ring and events."""

    enabled: bool = False
    seconds: float = 0.0
    """In the ring, from the oldest message to the newest."""
    bytes: int = 0
    max_bytes: int = 0
    bag: str = ''
    """The one being written now."""
    refused: str = ''
    """Why it cannot be written to the disk now."""
    triggers: int = 0
    written: int = 0
    """Events that ended."""
    last: Trigger = Trigger()
    topics: Mapping[str, Totals] = field(default_factory=dict)
    left_out: int = 0
    """As in ``BagStatus``."""


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """The node at one instant."""

    robot: str = ''
    version: str = ''
    pid: int = 0
    boot_id: str = ''
    boot_ns: int = 0
    time: str = ''
    uptime_s: float = 0.0
    paused: bool = False
    ended: bool = False
    """Whether this is the last status of a node that was stopped."""
    not_logged: Mapping[str, str] = field(default_factory=dict)
    """Topics that were found and are not logged, and why."""
    stalls: Mapping[str, str] = field(default_factory=dict)
    """Topics and threads (``encode`` and ``delivery``) that make no progress: what is wrong."""
    middleware: MiddlewareStatus = MiddlewareStatus()
    mission: MissionStatus = MissionStatus()
    bag: BagStatus = BagStatus()
    events: EventStatus = EventStatus()
    topics: Mapping[str, TopicStatus] = field(default_factory=dict)
    queue: QueueStatus = QueueStatus()
    spool: SpoolStatus = SpoolStatus()
    store: StoreStatus = StoreStatus()
    requests: RequestStatus = RequestStatus()
    clock: ClockState = ClockState()
    consumers: Mapping[str, ConsumerStatus] = field(default_factory=dict)
    workers: Mapping[str, WorkerStatus] = field(default_factory=dict)
