"""The ledger: what became of every message and every object, read from the spool's index, and whether it closes."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.dataclass_json import as_plain
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool import act_record, clock_record
from shadowhound_data_logger.spool.account_rows import OtherTypeRow
from shadowhound_data_logger.spool.accounts import GRADES, MAX_NODES, RECEIVED_ONLY, SINKS
from shadowhound_data_logger.spool.gaps import DROPPED, ESTIMATED, EVICTED, EXACT, MISSED, QUARANTINED, REJECTED, Gap, Watermark
from shadowhound_data_logger.spool.index import Index

STATES: Final = tuple(state.value for state in State)


def read(spool: Path, robot: str) -> dict[str, Any]:
    """The ledger of a spool folder, as ``shadowhound-data ledger --json`` prints it; works while a node runs.

    Raises SpoolError when there is no spool or it cannot be read. Unknown figures are None, never 0.
    """
    with _reading(spool) as index:
        known = clock_record.read(spool, robot)
        del known['offsets']
        clock = {**known, 'held': index.objects.held_count('clock')}
        return {**of_index(index, robot), 'clock': clock, 'acts': act_record.read(spool, robot)}


def journal(spool: Path, robot: str) -> list[Gap]:
    """What the gap journal of a spool folder has, in the order of time; works while a node runs.

    Raises SpoolError as ``read``.
    """
    with _reading(spool) as index:
        return index.gaps.known(clock_record.read(spool, robot)['offsets'])


def watermarks(spool: Path) -> list[Watermark]:
    """From when until when the journal of a spool folder is complete, by sink and topic. Raises SpoolError as ``journal``."""
    with _reading(spool) as index:
        return index.gaps.watermarks()


@contextmanager
def _reading(spool: Path) -> Iterator[Index]:
    path = spool / 'index.db'
    if not path.is_file():
        raise SpoolError(f'there is no spool in {spool}', remedy='has the node run here? SHADOWHOUND_HOME names its folder')
    index = Index(path, read_only=True)
    try:
        index.open()
        yield index
    except (sqlite3.Error, ValueError) as error:
        raise SpoolError(f'the spool index {path} cannot be read: {error}',
                         remedy='a start of the node rebuilds a damaged one') from error  # fmt: skip
    finally:
        index.close()


def of_index(index: Index, robot: str) -> dict[str, Any]:
    """The ledger of an open index, all of one instant."""
    with index.snapshot():
        topics, publishers, others = index.accounts.topics(), index.accounts.publishers(), index.accounts.other_types()
        tally, journal = index.overview.tally(), index.gaps.sums()
    names = {row.topic for row in topics} | {row[0] for row in tally if row[0]}
    accounts = {topic: _topic(topic, topics, publishers, tally, others) for topic in sorted(names)}
    for topic, row in accounts.items():
        row['gaps'] = _journaled(topic, journal)
    sensors = {topic: row for topic, row in accounts.items() if not topic.startswith(SINKS)}
    bags, events = ({topic.removeprefix(sink): row for topic, row in accounts.items() if topic.startswith(sink)}
                    for sink in SINKS)  # fmt: skip
    objects = {what: sum(row[2] for row in tally if row[1] == what) for what in ('spooled', *STATES)}
    volume = {what: sum(row[3] for row in tally if row[1] == what) for what in ('spooled', *STATES)}
    ledger: dict[str, Any] = {
        'robot': robot, 'balanced': True, 'topics': sensors, 'bags': bags, 'events': events, 'objects': objects, 'bytes': volume,
    }  # fmt: skip
    ledger['balanced'] = not imbalances(ledger)
    return ledger


def imbalances(ledger: Mapping[str, Any]) -> list[str]:
    """One sentence for each identity that does not hold; empty when the ledger closes."""
    found: list[str] = []
    in_files = [(f'{topic} in {sink}', row) for sink in ('bags', 'events') for topic, row in ledger.get(sink, {}).items()]
    for topic, row in (*ledger['topics'].items(), *in_files):
        settled = row['skipped'] + sum(row['rejected'].values()) + sum(row['dropped'].values()) + row['stored'] + row['open']
        if row['received'] != settled or row['open'] < 0:
            found.append(f'{topic}: received {row["received"]}, but skipped + rejected + dropped + stored + open = {settled}')
        found += [f'{topic}: {sentence}' for sentence in (*_ungraded(row), *_undated(row))]
        if row['stored'] != sum(row['stored_in'].values()):
            found.append(f'{topic}: stored {row["stored"]}, but in objects there are {sum(row["stored_in"].values())}')
    for what in ('objects', 'bytes'):
        parts = sum(ledger[what][state] for state in STATES)
        if ledger[what]['spooled'] != parts or min(ledger[what].values()) < 0:
            found.append(f'{what}: spooled {ledger[what]["spooled"]}, but by state {parts} ({dict(ledger[what])})')
    return found


def _undated(row: Mapping[str, Any]) -> Iterator[str]:
    """One sentence for each account of losses that the rows of the gap journal do not add up to."""
    lost = {
        MISSED: _sum(part['missed_by'] for part in row['by_grade'].values()), REJECTED: row['rejected'], DROPPED: row['dropped'],
    }  # fmt: skip
    for kind, causes in lost.items():
        gaps = row['gaps'].get(kind, {})
        for cause in sorted(causes.keys() | gaps.keys()):
            if causes.get(cause, 0) != gaps.get(cause, 0):
                yield f'{kind} by {cause} {causes.get(cause, 0)}, but in the gap journal {gaps.get(cause, 0)}'
    for kind in (EVICTED, QUARANTINED):
        there = sum(row['gaps'].get(kind, {}).values())
        if row['stored_in'][kind] != there:
            yield f'{kind} {row["stored_in"][kind]}, but in the gap journal {there}'


def _journaled(topic: str, journal: Mapping[tuple[str, str, str, str], int]) -> dict[str, dict[str, int]]:
    """What the gap journal has of a topic: kind -> cause -> messages."""
    found: dict[str, Counter[str]] = {}
    for (account, kind, cause, _), count in journal.items():
        if account == topic:
            found.setdefault(kind, Counter())[cause] += count
    return {kind: dict(causes) for kind, causes in found.items()}


def _ungraded(row: Mapping[str, Any]) -> Iterator[str]:
    """One sentence for each identity of published and missed that does not hold, of the whole and by grade."""
    for part in (*row['by_grade'].values(), row):
        about = '' if part['missed'] is not None else '_estimated'
        published, missed, causes = part[f'published{about}'], part[f'missed{about}'], sum(part['missed_by'].values())
        if published is not None and published != part['received'] + missed:
            yield f'published {published}, but received + missed = {part["received"] + missed}'
        if missed is not None and missed != causes:
            yield f'missed {missed}, but by cause {causes}'
    graded = sum(part['received'] for part in row['by_grade'].values())
    if row['received'] != graded:
        yield f'received {row["received"]}, but by grade {graded}'


def _topic(topic: str, topics: list[Any], publishers: list[Any], tally: list[tuple[str, str, int, int, int]],
           others: list[OtherTypeRow]) -> dict[str, Any]:  # fmt: skip
    rows = [row for row in topics if row.topic == topic]
    spans = [row for row in publishers if row.topic == topic]
    received = sum(row.received for row in rows)
    grades = _by_grade(rows, spans)
    heard = [row.accounting for row in rows if row.received and row.accounting]
    return {
        'type': rows[-1].type if rows else '',
        'accounting': heard[-1] if heard else None,
        **(_whole(received, grades) if heard and heard[-1] != RECEIVED_ONLY else {**_UNKNOWN, 'received': received}),
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
    }


def _other_types(rows: Iterable[OtherTypeRow]) -> dict[str, dict[str, Any]]:
    """Over all sessions; a count that is not known in one of them is not known."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        known = found.setdefault(row.type, {'publishers': [], 'messages': 0})
        nodes = [*known['publishers'], *row.publishers]
        known['publishers'] = list(dict.fromkeys(nodes))[:MAX_NODES]
        known['messages'] = None if None in {known['messages'], row.messages} else known['messages'] + row.messages
    return found


def _by_grade(rows: list[Any], spans: list[Any]) -> dict[str, dict[str, Any]]:
    """What is known of the messages of each grade that there is."""
    unknown, estimated = sum(row.unknown for row in rows), sum(row.estimated for row in rows)
    numbered = sum(row.received for row in rows) - estimated - unknown
    exact = _counted(numbered, _sum(span.missed for span in spans), sum(span.published for span in spans))
    about = _sum(row.missed for row in rows)
    found = {
        EXACT: exact,
        ESTIMATED: _counted(estimated, about, estimated + sum(about.values()), '_estimated'),
        RECEIVED_ONLY: {**_UNKNOWN, 'received': unknown},
    }
    return {grade: found[grade] for grade in GRADES if found[grade]['received'] or found[grade]['missed_by']}


_UNKNOWN: Final[dict[str, Any]] = {
    'published': None, 'published_estimated': None, 'received': 0, 'missed': None, 'missed_estimated': None, 'missed_by': {},
}  # fmt: skip


def _counted(received: int, missed_by: dict[str, int], published: int, about: str = '') -> dict[str, Any]:
    missed = sum(missed_by.values())
    return {**_UNKNOWN, f'published{about}': published, 'received': received, f'missed{about}': missed, 'missed_by': missed_by}


def _whole(received: int, grades: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """All grades as one: no better than the worst of them."""
    if not grades or RECEIVED_ONLY in grades:
        return {**_UNKNOWN, 'received': received}
    about = '_estimated' if ESTIMATED in grades else ''
    parts = [(part, '_estimated' if grade == ESTIMATED else '') for grade, part in grades.items()]
    published = sum(part[f'published{kind}'] for part, kind in parts)
    return _counted(received, _sum(part['missed_by'] for part, _ in parts), published, about)


def _sum(mappings: Any) -> dict[str, int]:
    total: Counter[str] = Counter()
    for mapping in mappings:
        total.update(mapping)
    return dict(+total)
