"""The status as ``/diagnostics``: one entry for each topic, the spool, the store, the clock, the workers and the node itself.

Levels: WARN for what should be checked (messages recently missed, dropped or rejected, stalls, an unreachable store, a spool
that fills up, a clock that is not set or stepped recently), ERROR for what needs action (a thread that fails or failed
recently, objects recently quarantined, rejected credentials, publishers that the robot finds and the node does not), STALE for
a topic without a publisher. Plain values; ``interface`` converts them to a message if there are subscribers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from shadowhound_data_logger.core.dataclass_json import as_plain, fields_of
from shadowhound_data_logger.core.stamps import describe
from shadowhound_data_logger.core.status import (
    BagStatus,
    ClockState,
    ConsumerStatus,
    EventStatus,
    NodeStatus,
    SpoolStatus,
    StoreStatus,
    TopicStatus,
)

FULL: Final = 0.8
"""Share of its limit above which the spool is a warning."""
STEPPED_S: Final = 60.0
"""How long a step of the clock is a warning."""
OK, WARN, ERROR, STALE = range(4)
"""As in diagnostic_msgs/msg/DiagnosticStatus."""
Entry = tuple[str, int, str, Mapping[str, Any]]
"""Name, level, message, and values."""


def plain_entries(status: NodeStatus, earlier: NodeStatus | None) -> list[dict[str, Any]]:
    """All entries as plain values; ``earlier`` is the status of a few seconds before: increases since then are recent."""
    return [
        {'name': name, 'level': level, 'message': text, 'values': {key: _text(value) for key, value in figures.items()}}
        for name, level, text, figures in entries(status, earlier or status)
    ]


def entries(status: NodeStatus, earlier: NodeStatus) -> Iterator[Entry]:
    """All entries of a status."""
    stalls = status.stalls
    yield _node(status)
    undiscovered = status.middleware.undiscovered or {}
    for topic, row in status.topics.items():
        level, text = _topic(row, earlier.topics.get(topic, row), stalls.get(topic, ''))
        if topic in undiscovered:
            level, text = ERROR, undiscovered[topic].text
        yield topic, level, text, fields_of(row)
    for topic in undiscovered.keys() - status.topics.keys():
        yield topic, ERROR, undiscovered[topic].text, {'publishers': undiscovered[topic].publishers}
    yield _bag(status.bag, earlier.bag)
    yield _events(status.events, earlier.events)
    yield _spool(status.spool, earlier.spool)
    yield 'store', *_store(status.store, earlier.store, stalls.get('delivery', '')), fields_of(status.store)
    yield _clock(status.clock)
    yield _workers(status, earlier)


def _node(status: NodeStatus) -> Entry:
    figures = {'version': status.version, 'pid': status.pid, 'uptime_s': status.uptime_s, 'paused': status.paused,
               **{f'queue {name}': value for name, value in fields_of(status.queue).items()}}  # fmt: skip
    if status.paused:
        return 'node', WARN, 'paused: messages are counted and not stored', figures
    return 'node', OK, 'logging', figures


def _bag(bag: BagStatus, before: BagStatus) -> Entry:
    figures = fields_of(bag)
    del figures['topics']
    if not bag.recording:
        return 'bag', OK, 'nothing is recorded', figures
    if bag.refused:
        return 'bag', ERROR, f'{bag.bag} records nothing now: {bag.refused}', figures
    if bag.bag == before.bag and bag.dropped > before.dropped:
        return 'bag', WARN, f'{bag.bag} dropped {bag.dropped - before.dropped} messages recently', figures
    return 'bag', OK, f'{bag.bag} is {"paused" if bag.paused else "recorded"}', figures


def _events(events: EventStatus, before: EventStatus) -> Entry:
    figures = fields_of(events)
    del figures['topics'], figures['last']
    figures |= {f'last {name}': value for name, value in fields_of(events.last).items()}
    if not events.enabled:
        return 'events', OK, 'nothing is kept', figures
    if events.refused:
        return 'events', ERROR, f'{events.bag} is not written: {events.refused}', figures
    dropped = sum(row.dropped for row in events.topics.values()) - sum(row.dropped for row in before.topics.values())
    if dropped > 0:
        return 'events', WARN, f'{dropped} messages of an event were dropped recently', figures
    if events.bag:
        return 'events', OK, f'writing {events.bag}', figures
    return 'events', OK, f'the last {events.seconds:g} s are kept', figures


def _topic(row: TopicStatus, before: TopicStatus, stall: str) -> tuple[int, str]:
    if not row.enabled:
        return OK, 'not enabled'
    lost = {'missed': (row.missed or 0) - (before.missed or 0), 'dropped': row.dropped - before.dropped,
            'rejected': row.rejected - before.rejected}  # fmt: skip
    grown = [f'{count} {what}' for what, count in lost.items() if count > 0]
    about = (row.missed_estimated or 0) - (before.missed_estimated or 0)
    if about > 0:
        grown.insert(0, f'~{about} missed')
    if grown:
        return WARN, f'{", ".join(grown)} recently'
    if row.stamps:
        return WARN, describe(row.stamps)
    if row.other_types:
        return WARN, f'it was published as {" and as ".join(row.other_types)} too; only {row.type or "another type"} is logged'
    if not row.publishers:
        return STALE, 'nobody publishes it'
    if stall:
        return WARN, stall
    return OK, f'{row.rate_hz:g} Hz'


def _spool(spool: SpoolStatus, before: SpoolStatus) -> Entry:
    evicted, figures = spool.evicted - before.evicted, fields_of(spool)
    if evicted > 0:
        return 'spool', ERROR, f'{evicted} objects were evicted recently: the disk or the spool is full', figures
    share = spool.bytes / spool.max_bytes if spool.max_bytes else 0.0
    text = f'{spool.pending} objects wait for delivery, {share:.0%} of its limit is used'
    return 'spool', WARN if share > FULL else OK, text, figures


def _store(store: StoreStatus, before: StoreStatus, stall: str) -> tuple[int, str]:
    state = store.state.replace('_', ' ')
    quarantined = store.quarantined - before.quarantined
    if quarantined > 0:
        return ERROR, f'{quarantined} objects were quarantined recently: {store.last_error}'
    if store.state == 'paused':
        return ERROR, f'{state}: {store.last_error}'
    if store.state == 'store_down':
        return WARN, f'{state}: {store.last_error}'
    if store.waits_for:
        return OK, f'{state}; ' + '; '.join(f'{name} is not true: {why}' for name, why in store.waits_for.items())
    if store.blocked_buckets:
        return WARN, f'{state}; buckets that reject everything: {", ".join(store.blocked_buckets)}'
    return (WARN, stall) if stall else (OK, state)


def _clock(clock: ClockState) -> Entry:
    figures = fields_of(clock)
    if not clock.is_set:
        what = 'objects are uploaded under _unsynced' if clock.gave_up else 'objects wait for their date'
        return 'clock', WARN, f'not set for {clock.unset_s:.0f} s: {what}', figures
    if clock.last_step_age_s is not None and clock.last_step_age_s < STEPPED_S:
        return 'clock', WARN, f'stepped by {clock.last_step_s:g} s {clock.last_step_age_s:.0f} s ago', figures
    return 'clock', OK, 'set', figures


def _workers(status: NodeStatus, earlier: NodeStatus) -> Entry:
    workers = status.workers
    failing = [f'{name} fails: {row.last_error}' for name, row in workers.items() if row.failing]
    failing += [f'{name} failed recently and works again: {row.last_error}' for name, row in workers.items()
                if not row.failing and row.failures > earlier.workers.get(name, row).failures]  # fmt: skip
    failing += [f'{name} recently failed to take messages: {row.last_error}' for name, row in status.consumers.items()
                if row.failures > earlier.consumers.get(name, ConsumerStatus()).failures]  # fmt: skip
    stuck = [f'{name}: {text}' for name, text in status.stalls.items() if name in workers or name == 'encode']
    figures: dict[str, Any] = {}
    for name, row in workers.items():
        figures |= {f'{name} failures': row.failures, f'{name} deaths': row.deaths}
    figures |= {f'{name} last error': row.last_error for name, row in workers.items() if row.last_error}
    figures |= {f'{name} {what}': value for name, row in status.consumers.items() for what, value in fields_of(row).items()}
    level = ERROR if failing else WARN if stuck else OK
    return 'workers', level, '; '.join((*failing, *stuck)) or 'all work', figures


def _text(value: Any) -> str:
    """A value as text; empty if unknown."""
    plain = as_plain(value)
    if isinstance(plain, dict):
        return ', '.join(f'{key}: {part}' for key, part in plain.items())
    return '' if plain is None else f'{plain:g}' if isinstance(plain, float) else str(plain)
