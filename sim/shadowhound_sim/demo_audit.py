"""The demo's independent audit: reads every object back from the S3 server, and compares all counts.

It does not trust totals: messages come from the simulated robot's own count, content from the server, hashes and sequence numbers
from the spool's index, and samples are counted in the objects.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.formats.rows.catalog import SENSOR, is_row
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.ledger import Ledger
from shadowhound_data_logger.stores.base import ObjectStore

BUCKET: Final = 'sensor-data'
BOOKKEEPING: Final = '_ledger'
"""The sensor under which objects without a topic are listed."""


@dataclass(slots=True)
class SensorTotals:
    """The objects of one sensor."""

    objects: int = 0
    delivered: int = 0
    bytes: int = 0
    latest: str = ''
    """Key of the latest; for the catalog its folder, because its keys are long."""


@dataclass(frozen=True, slots=True)
class Messages:
    """The fate of a topic's messages; None means unknown."""

    published: int
    """Counted by the robot."""
    before_match: int | None
    """Published before the node had found the publisher."""
    account: ledger.TopicFigures | None
    """The topic's part of the ledger; None for a topic that is not logged."""

    @property
    def unaccounted(self) -> int:
        """Messages after the match that are not in the ledger: published after the last one that arrived."""
        if self.account is None or self.before_match is None:
            return 0
        return self.published - self.before_match - (self.account['published'] or 0)


@dataclass(frozen=True, slots=True)
class DemoAudit:
    """The result of a demo's audit."""

    ledger: Ledger
    messages: Mapping[str, Messages]
    totals: Mapping[str, SensorTotals]
    read_back: int
    """Objects read from the server."""
    samples: int
    """Messages counted in them."""
    bodies: Mapping[str, bytes]
    """Content by key; keys are unique across buckets."""
    rows: int
    """Rows of the catalog in the server."""
    problems: tuple[str, ...]
    """One sentence for each problem."""


def audit(spool: Path, robot: str, published: Mapping[str, int], store: ObjectStore) -> DemoAudit:
    """Raises StoreError if the server cannot be read, SpoolError for the spool."""
    found = ledger.read(spool, robot)
    index = Index(spool / 'index.db', read_only=True)
    index.open()
    try:
        rows = index.objects.rows()
        publishers = index.accounts.publishers()
    finally:
        index.close()
    before: Counter[str] = Counter()
    for publisher in publishers:
        before[publisher.topic] += max((publisher.first or 1) - 1, 0)
    accounts = found['topics']
    messages = {topic: _messages(number, before[topic], accounts.get(topic)) for topic, number in published.items()}
    buckets = sorted({BUCKET, *(row['bucket'] for row in rows)})
    bodies = {info.key: store.get(bucket, info.key) for bucket in buckets for info in store.list(bucket, f'{robot}/')}
    delivered = {row['key']: row['sha256'] for row in rows if row['state'] == State.DELIVERED.value}
    samples = _count(rows, bodies)
    problems = [*ledger.imbalances(found), *_unread(delivered, bodies), *_unaccounted(messages), *_undelivered(found)]
    catalog = _cataloged(bodies)
    problems += [*_uncounted(found, samples), *_uncataloged(catalog, bodies)]
    return DemoAudit(found, messages, _totals(rows), len(bodies), sum(samples.values()), bodies, catalog.total(), tuple(problems))


def _messages(published: int, before: int, account: ledger.TopicFigures | None) -> Messages:
    known = account is not None and account['published'] is not None
    return Messages(published, before if known else None, account)


def _totals(rows: list[Any]) -> dict[str, SensorTotals]:
    totals: dict[str, SensorTotals] = {}
    for row in rows:
        total = totals.setdefault(json.loads(row['metadata']).get('sensor', BOOKKEEPING), SensorTotals())
        total.objects += 1
        total.delivered += row['state'] == State.DELIVERED.value
        total.bytes += row['bytes']
        total.latest = row['key'] if is_row(BUCKET, row['key']) else f'{row["key"].rpartition("/")[0]}/'
    return totals


def _count(rows: list[Any], bodies: Mapping[str, bytes]) -> Counter[str]:
    """Messages by topic, counted in the objects that were read back."""
    samples: Counter[str] = Counter()
    for row in rows:
        topic = json.loads(row['metadata']).get('topic')
        if topic and row['key'] in bodies:
            body = json.loads(bodies[row['key']]) if row['key'].endswith('.json') else {}
            samples[topic] += len(body.get('samples', (1,)))
    return samples


def _unread(delivered: Mapping[str, str], bodies: Mapping[str, bytes]) -> list[str]:
    found = [f'{key} was delivered, but is not in the bucket' for key in delivered.keys() - bodies.keys()]
    found += [f'{key} is in the bucket, but not known as delivered' for key in bodies.keys() - delivered.keys()]
    for key in delivered.keys() & bodies.keys():
        if hashlib.sha256(bodies[key]).hexdigest() != delivered[key]:
            found.append(f'{key} differs from the spooled object')
    return sorted(found)


def _cataloged(bodies: Mapping[str, bytes]) -> Counter[str]:
    """Rows by key, in all parts of the catalog."""
    rows: Counter[str] = Counter()
    for key, body in bodies.items():
        if key.split('/')[1:2] == [SENSOR]:
            rows.update(row['key'] for row in read_rows(body, key.partition('/')[0]).rows.get(SENSOR, ()))
    return rows


def _uncataloged(rows: Mapping[str, int], bodies: Mapping[str, bytes]) -> list[str]:
    keys = {key for key in bodies if is_row(BUCKET, key)}
    found = [f'{key} has {rows.get(key, 0)} rows in the catalog' for key in keys if rows.get(key, 0) != 1]
    found += [f'{key} has a row in the catalog, but is not in the bucket' for key in rows.keys() - keys]
    return sorted(found)


def _unaccounted(messages: Mapping[str, Messages]) -> list[str]:
    found = []
    for topic, row in messages.items():
        if row.unaccounted:
            found.append(f'{topic}: {row.unaccounted:,} of {row.published:,} messages are not in the ledger')
        if row.account is not None:
            lost = {'missed': row.account['missed'] or 0, 'open': row.account['open']}
            lost |= {name: sum(row.account[name].values()) for name in ('rejected', 'dropped')}
            found += [f'{topic}: {count:,} messages are {name}' for name, count in lost.items() if count]
    return found


def _undelivered(found: Ledger) -> list[str]:
    left = {state: count for state, count in found['objects'].items() if state not in {'spooled', 'delivered'} and count}
    return [f'{count:,} objects are {state}' for state, count in left.items()]


def _uncounted(found: Ledger, samples: Mapping[str, int]) -> list[str]:
    return [
        f'{topic}: {row["stored_in"]["delivered"]:,} messages are delivered, but {samples.get(topic, 0):,} are in the bucket'
        for topic, row in found['topics'].items()
        if row['stored_in']['delivered'] != samples.get(topic, 0)
    ]
