"""The ledger: what became of every message and every object, read from the spool's index, and whether it balances."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypedDict

from shadowhound_data_logger.core.dataclass_json import as_plain
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool import clock_record, operator_requests
from shadowhound_data_logger.spool.account_rows import OtherTypeRow
from shadowhound_data_logger.spool.gaps import DROPPED, ESTIMATED, EVICTED, EXACT, MISSED, QUARANTINED, REJECTED, Gap, Watermark
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.operator_requests import OperatorRequest
from shadowhound_data_logger.spool.topic_account import GRADES, MAX_NODES, RECEIVED_ONLY, SINKS

STATES: Final = tuple(state.value for state in State)


class GradeFigures(TypedDict):
    """Messages of one grade of accounting."""

    published: int | None
    published_estimated: int | None
    received: int
    missed: int | None
    missed_estimated: int | None
    missed_by: dict[str, int]
    """By cause."""


class OtherTypeFigures(TypedDict):
    """A type under which a topic is published in addition to the one that is logged."""

    publishers: list[str]
    messages: int | None


class TopicFigures(GradeFigures):
    """A topic over all sessions, or its messages in bags or events. Its figures are those of the worst of its grades."""

    type: str
    accounting: str | None
    by_grade: dict[str, GradeFigures]
    skipped: int
    by_arrival: dict[str, int]
    corrected: dict[str, int]
    stamps: dict[str, Any] | None
    """The fields of a ``StampReport``."""
    rejected: dict[str, int]
    other_types: dict[str, OtherTypeFigures]
    dropped: dict[str, int]
    stored: int
    open: int
    stored_in: dict[str, int]
    """Messages by the state of their objects."""
    gaps: dict[str, dict[str, int]]
    """Messages in the gap journal by kind and cause."""


class ClockFigures(TypedDict):
    """The robot's wall clock."""

    is_set: bool | None
    steps: int
    last_step_s: float | None
    last_step_time: str | None
    held: int
    """Objects that wait for it to be set."""


class Ledger(TypedDict):
    """The ledger of an index."""

    robot: str
    balanced: bool
    topics: dict[str, TopicFigures]
    bags: dict[str, TopicFigures]
    events: dict[str, TopicFigures]
    objects: dict[str, int]
    """By state, and ``spooled``."""
    bytes: dict[str, int]


class SpoolLedger(Ledger):
    """The ledger of a spool folder."""

    clock: ClockFigures
    operator_requests: list[OperatorRequest]
    """What operators requested."""


def read(spool: Path, robot: str) -> SpoolLedger:
    """The ledger of a spool folder, as ``shadowhound-data ledger --json`` prints it; works while a node runs.

    Raises SpoolError if there is no spool or it cannot be read. Unknown figures are None, never 0.
    """
    with _reading(spool) as index:
        known = clock_record.read(spool, robot)
        clock = ClockFigures(is_set=known.is_set, steps=known.steps, last_step_s=known.last_step_s,
                             last_step_time=known.last_step_time, held=index.objects.held_count('clock'))  # fmt: skip
        return {**of_index(index, robot), 'clock': clock, 'operator_requests': operator_requests.read(spool, robot)}


def journal(spool: Path, robot: str) -> list[Gap]:
    """The gap journal of a spool folder, by time; works while a node runs. Raises SpoolError as ``read``."""
    with _reading(spool) as index:
        return index.gaps.known(clock_record.read(spool, robot).offsets)


def watermarks(spool: Path) -> list[Watermark]:
    """The watermarks of a spool folder's gap journal. Raises SpoolError as ``read``."""
    with _reading(spool) as index:
        return index.gaps.watermarks()


@contextmanager
def _reading(spool: Path) -> Iterator[Index]:
    path = spool / 'index.db'
    if not path.is_file():
        raise SpoolError(f'there is no spool in {spool}', remedy='has the node run here? set SHADOWHOUND_HOME to its folder')
    index = Index(path, read_only=True)
    try:
        index.open()
        yield index
    except (sqlite3.Error, ValueError) as error:
        raise SpoolError(f'the spool index {path} cannot be read: {error}',
                         remedy='start the node: it rebuilds a damaged index') from error  # fmt: skip
    finally:
        index.close()


def of_index(index: Index, robot: str) -> Ledger:
    """The ledger of an open index, at one instant."""
    with index.snapshot():
        topics, publishers, others = index.accounts.topics(), index.accounts.publishers(), index.accounts.other_types()
        tally, journal = index.overview.tally(), index.gaps.sums()
    names = {row.topic for row in topics} | {row[0] for row in tally if row[0]}
    accounts = {topic: _topic(topic, topics, publishers, tally, others, journal) for topic in sorted(names)}
    sensors = {topic: row for topic, row in accounts.items() if not topic.startswith(SINKS)}
    bags, events = ({topic.removeprefix(sink): row for topic, row in accounts.items() if topic.startswith(sink)}
                    for sink in SINKS)  # fmt: skip
    objects = {what: sum(row[2] for row in tally if row[1] == what) for what in ('spooled', *STATES)}
    volume = {what: sum(row[3] for row in tally if row[1] == what) for what in ('spooled', *STATES)}
    ledger: Ledger = {
        'robot': robot, 'balanced': True, 'topics': sensors, 'bags': bags, 'events': events, 'objects': objects, 'bytes': volume,
    }  # fmt: skip
    ledger['balanced'] = not imbalances(ledger)
    return ledger


def rows_of(ledger: Ledger) -> dict[str, TopicFigures]:
    """All rows by name: topics, topics in bags, topics in events."""
    bags = {f'{topic} in bags': row for topic, row in ledger['bags'].items()}
    return ledger['topics'] | bags | {f'{topic} in events': row for topic, row in ledger['events'].items()}


def imbalances(ledger: Ledger) -> list[str]:
    """One sentence for each identity that does not hold; empty if the ledger balances."""
    found: list[str] = []
    for topic, row in rows_of(ledger).items():
        settled = row['skipped'] + sum(row['rejected'].values()) + sum(row['dropped'].values()) + row['stored'] + row['open']
        if row['received'] != settled or row['open'] < 0:
            found.append(f'{topic}: received {row["received"]}, but skipped + rejected + dropped + stored + open = {settled}')
        found += [f'{topic}: {sentence}' for sentence in (*_ungraded(row), *_undated(row))]
        if row['stored'] != sum(row['stored_in'].values()):
            found.append(f'{topic}: stored {row["stored"]}, but in objects there are {sum(row["stored_in"].values())}')
    for what, counts in (('objects', ledger['objects']), ('bytes', ledger['bytes'])):
        parts = sum(counts[state] for state in STATES)
        if counts['spooled'] != parts or min(counts.values()) < 0:
            found.append(f'{what}: spooled {counts["spooled"]}, but by state {parts} ({counts})')
    return found


def _undated(row: TopicFigures) -> Iterator[str]:
    """One sentence for each count of losses that differs from the sum of the gap journal's rows."""
    lost = {
        MISSED: _sum(part['missed_by'] for part in row['by_grade'].values()), REJECTED: row['rejected'], DROPPED: row['dropped'],
    }  # fmt: skip
    for kind, causes in lost.items():
        gaps = row['gaps'].get(kind, {})
        for cause in sorted(causes.keys() | gaps.keys()):
            if causes.get(cause, 0) != gaps.get(cause, 0):
                yield f'{kind} by {cause} {causes.get(cause, 0)}, but in the gap journal {gaps.get(cause, 0)}'
    for kind in (EVICTED, QUARANTINED):
        journaled = sum(row['gaps'].get(kind, {}).values())
        if row['stored_in'][kind] != journaled:
            yield f'{kind} {row["stored_in"][kind]}, but in the gap journal {journaled}'


def _journaled(topic: str, journal: Mapping[tuple[str, str, str, str], int]) -> dict[str, dict[str, int]]:
    """A topic's losses in the gap journal: kind -> cause -> messages."""
    found: dict[str, Counter[str]] = {}
    for (account, kind, cause, _), count in journal.items():
        if account == topic:
            found.setdefault(kind, Counter())[cause] += count
    return {kind: dict(causes) for kind, causes in found.items()}


def _ungraded(row: TopicFigures) -> Iterator[str]:
    """One sentence for each identity of published and missed that does not hold, in total and by grade."""
    for part in (*row['by_grade'].values(), row):
        published, missed, causes = part['published'], part['missed'], sum(part['missed_by'].values())
        if missed is None:
            published, missed = part['published_estimated'], part['missed_estimated']
        total = part['received'] + (missed or 0)
        if published is not None and published != total:
            yield f'published {published}, but received + missed = {total}'
        if missed is not None and missed != causes:
            yield f'missed {missed}, but by cause {causes}'
    graded = sum(part['received'] for part in row['by_grade'].values())
    if row['received'] != graded:
        yield f'received {row["received"]}, but by grade {graded}'


def _topic(topic: str, topics: list[Any], publishers: list[Any], tally: list[tuple[str, str, int, int, int]],
           others: list[OtherTypeRow], journal: Mapping[tuple[str, str, str, str], int]) -> TopicFigures:  # fmt: skip
    rows = [row for row in topics if row.topic == topic]
    spans = [row for row in publishers if row.topic == topic]
    received = sum(row.received for row in rows)
    grades = _by_grade(rows, spans)
    graded = [row.accounting for row in rows if row.received and row.accounting]
    return {
        'type': rows[-1].type if rows else '',
        'accounting': graded[-1] if graded else None,
        **(_whole(received, grades) if graded and graded[-1] != RECEIVED_ONLY else _unknown(received)),
        'by_grade': grades,
        'skipped': sum(row.skipped for row in rows),
        'by_arrival': _sum(row.by_arrival for row in rows),
        'corrected': _sum(row.corrected for row in rows),
        'stamps': as_plain(rows[-1].stamps) if rows else None,
        'rejected': _sum(row.rejected for row in rows),
        'other_types': _other_types(row for row in others if row.topic == topic),
        'dropped': _sum(row.dropped for row in rows),
        'stored': sum(row.stored for row in rows),
        'open': sum(row.open for row in rows),
        'stored_in': {state: sum(row[4] for row in tally if row[:2] == (topic, state)) for state in STATES},
        'gaps': _journaled(topic, journal),
    }


def _other_types(rows: Iterable[OtherTypeRow]) -> dict[str, OtherTypeFigures]:
    """The other types of a topic over all sessions; a count that is unknown in one session is unknown."""
    found: dict[str, OtherTypeFigures] = {}
    for row in rows:
        known = found.setdefault(row.type, {'publishers': [], 'messages': 0})
        nodes = [*known['publishers'], *row.publishers]
        known['publishers'] = list(dict.fromkeys(nodes))[:MAX_NODES]
        before = known['messages']
        known['messages'] = None if before is None or row.messages is None else before + row.messages
    return found


def _by_grade(rows: list[Any], spans: list[Any]) -> dict[str, GradeFigures]:
    """The figures of each grade that a topic has."""
    unknown, estimated = sum(row.unknown for row in rows), sum(row.estimated for row in rows)
    numbered = sum(row.received for row in rows) - estimated - unknown
    exact = _counted(numbered, _sum(span.missed for span in spans), sum(span.published for span in spans))
    about = _sum(row.missed for row in rows)
    found = {
        EXACT: exact,
        ESTIMATED: _counted(estimated, about, estimated + sum(about.values()), is_estimated=True),
        RECEIVED_ONLY: _unknown(unknown),
    }
    return {grade: found[grade] for grade in GRADES if found[grade]['received'] or found[grade]['missed_by']}


def _unknown(received: int) -> GradeFigures:
    return {'published': None, 'published_estimated': None, 'received': received, 'missed': None, 'missed_estimated': None,
            'missed_by': {}}  # fmt: skip


def _counted(received: int, missed_by: dict[str, int], published: int, *, is_estimated: bool = False) -> GradeFigures:
    missed, found = sum(missed_by.values()), _unknown(received)
    found['missed_by'] = missed_by
    if is_estimated:
        found['published_estimated'], found['missed_estimated'] = published, missed
    else:
        found['published'], found['missed'] = published, missed
    return found


def _whole(received: int, grades: Mapping[str, GradeFigures]) -> GradeFigures:
    """The sum of all grades, with the worst of them."""
    if not grades or RECEIVED_ONLY in grades:
        return _unknown(received)
    published = sum(part['published'] or part['published_estimated'] or 0 for part in grades.values())
    missed_by = _sum(part['missed_by'] for part in grades.values())
    return _counted(received, missed_by, published, is_estimated=ESTIMATED in grades)


def _sum(mappings: Any) -> dict[str, int]:
    total: Counter[str] = Counter()
    for mapping in mappings:
        total.update(mapping)
    return dict(+total)
