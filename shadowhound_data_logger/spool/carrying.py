"""What earlier sessions left open in files of their own becomes the next session's to account for.

A message is open until its file is spooled, or known to be lost. The two rows change in one transaction, so that the sums stay.
"""

from __future__ import annotations

import json
from dataclasses import replace

from shadowhound_data_logger.spool.account_rows import Snapshot, TopicRow
from shadowhound_data_logger.spool.index import Index


def carry(index: Index, session: int, robot: str, sink: str) -> list[TopicRow]:
    """Move what a robot's ended sessions left open to this one; its new rows. In a transaction, before it has any of the sink."""
    moved: dict[str, TopicRow] = {}
    for number in _ended(index, robot, sink):
        for row in index.topics(number):
            if row.topic.startswith(sink) and row.open > 0:
                before = moved.get(row.topic) or TopicRow(row.topic, '', '', 0, 0, 0, {}, {}, 0)
                unknown = min(row.unknown, row.open)
                estimated = min(row.estimated, row.open - unknown)
                moved[row.topic] = replace(
                    before, type=row.type, accounting=row.accounting, received=before.received + row.open,
                    estimated=before.estimated + estimated, unknown=before.unknown + unknown,
                )  # fmt: skip
                place = number, row.topic
                query = 'UPDATE accounts SET received = received - ? WHERE session = ? AND topic = ?'
                index.db.execute(query, (row.open, *place))
                index.db.execute(
                    'UPDATE estimates SET estimated = estimated - ?, unknown = unknown - ? WHERE session = ? AND topic = ?',
                    (estimated, unknown, *place),
                )
    index.write(session, Snapshot(tuple(moved.values()), ()))
    return list(moved.values())


def _ended(index: Index, robot: str, sink: str) -> list[int]:
    """Sessions that may have left something open."""
    columns = 'SELECT session, received - skipped - stored, rejected, dropped FROM accounts JOIN sessions ON id = session'
    rows = index.db.execute(f'{columns} WHERE robot = ? AND ended_ns IS NOT NULL AND topic GLOB ?', (robot, f'{sink}*'))
    return sorted({
        number for number, rest, *lost in rows if rest > sum(sum(json.loads(each).values()) for each in lost)
    })  # fmt: skip
