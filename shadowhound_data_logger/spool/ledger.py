"""The ledger: what became of every message and every object, read from the spool's index, and whether it closes (D10)."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import State
from shadowhound_data_logger.spool import clock_record
from shadowhound_data_logger.spool.account_rows import OtherTypeRow
from shadowhound_data_logger.spool.accounts import GRADES, MAX_NODES, RECEIVED_ONLY, SINKS
from shadowhound_data_logger.spool.index import Index

STATES: Final = tuple(state.value for state in State)


def read(spool: Path, robot: str) -> dict[str, Any]:
    """The ledger of a spool folder, as ``shadowhound-data ledger --json`` prints it; works while a node runs.

    Raises SpoolError when there is no spool or it cannot be read. Unknown figures are None, never 0.
    """
    path = spool / 'index.db'
    if not path.is_file():
        raise SpoolError(f'there is no spool in {spool}', remedy='has the node run here? SHADOWHOUND_HOME names its folder')
    index = Index(path, read_only=True)
    try:
        index.open()
        known = clock_record.read(spool, robot)
        del known['offsets']
        return {**of_index(index, robot), 'clock': {**known, 'held': index.held_count('clock')}}
    except (sqlite3.Error, ValueError) as error:
        raise SpoolError(f'the spool index {path} cannot be read: {error}',
                         remedy='a start of the node rebuilds a damaged one') from error  # fmt: skip
    finally:
        index.close()


def of_index(index: Index, robot: str) -> dict[str, Any]:
    """The ledger of an open index, all of one instant."""
    index.db.execute('BEGIN')
    try:
        topics, publishers, tally, others = index.topics(), index.publishers(), index.tally(), index.other_types()
    finally:
        index.db.execute('COMMIT')
    names = {row.topic for row in topics} | {row[0] for row in tally if row[0]}
    accounts = {topic: _topic(topic, topics, publishers, tally, others) for topic in sorted(names)}
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
        if row['published'] is not None and row['published'] != row['received'] + row['missed']:
            found.append(f'{topic}: published {row["published"]}, but received + missed = {row["received"] + row["missed"]}')
        if row['missed'] is not None and row['missed'] != sum(row['missed_by'].values()):
            found.append(f'{topic}: missed {row["missed"]}, but by cause {sum(row["missed_by"].values())}')
        if row['stored'] != sum(row['stored_in'].values()):
            found.append(f'{topic}: stored {row["stored"]}, but in objects there are {sum(row["stored_in"].values())}')
    for what in ('objects', 'bytes'):
        parts = sum(ledger[what][state] for state in STATES)
        if ledger[what]['spooled'] != parts or min(ledger[what].values()) < 0:
            found.append(f'{what}: spooled {ledger[what]["spooled"]}, but by state {parts} ({dict(ledger[what])})')
    return found


def _topic(topic: str, topics: list[Any], publishers: list[Any], tally: list[tuple[str, str, int, int, int]],
           others: list[OtherTypeRow]) -> dict[str, Any]:  # fmt: skip
    rows = [row for row in topics if row.topic == topic]
    spans = [row for row in publishers if row.topic == topic]
    accounting = max((row.accounting for row in rows), key=GRADES.index, default=RECEIVED_ONLY)
    missed_by: Counter[str] = Counter()
    for span in spans:
        missed_by.update(span.missed)
    known = accounting != RECEIVED_ONLY
    return {
        'type': rows[-1].type if rows else '',
        'accounting': accounting,
        'published': sum(span.published for span in spans) if known else None,
        'received': sum(row.received for row in rows),
        'missed': missed_by.total() if known else None,
        'missed_by': dict(missed_by) if known else {},
        'skipped': sum(row.skipped for row in rows),
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


def _sum(mappings: Any) -> dict[str, int]:
    total: Counter[str] = Counter()
    for mapping in mappings:
        total.update(mapping)
    return dict(+total)
