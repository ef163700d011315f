"""Objects that left the spool keep their rows for ``spool.remember_days``."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from spool.conftest import Open
from spool.making import BUCKET, NOON_NS, FakeClock, assert_whole, make, new_spool, put, rows

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import DataObject, Outcome, State
from shadowhound_data_logger.shipping.audit import Deliveries
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Spool

HOUR_NS = 3600 * SECOND
DAY_NS = 24 * HOUR_NS
FACTS = {'pose': '3.214 -1.502 0.7854 odom', 'battery_pct': '81.0', 'mission_id': 'patrol_20251018_080000', 'run_id': 'f' * 32}


def frame(second: int, **fields: object) -> DataObject:
    """An object as a node creates it during a mission, at this second of the day."""
    key = f'thor/camera/20251018/{second // 3600:02}{second // 60 % 60:02}{second % 60:02}_front.jpg'
    times = {'t_start_ns': str(NOON_NS + second * SECOND), 't_end_ns': str(NOON_NS + second * SECOND)}
    return make(key, f'frame {second}'.encode(), **{'metadata': {'robot': 'thor', **times, **FACTS}, **fields})


def leave(spool: Spool, *objects: DataObject, state: State = State.DELIVERED) -> None:
    """Spool them and give them their final outcome; the catalog has their rows."""
    items = put(spool, *objects)
    spool.commit(outcomes=[Outcome(item, state, 'no_room' if state is State.EVICTED else None) for item in items])
    catalog(spool)


def catalog(spool: Spool) -> None:
    with closing(Index(spool.root / 'index.db')) as index:
        index.open()
        index.catalog.clear()


def age(spool: Spool, by_ns: int = 2 * HOUR_NS) -> None:
    """Let time pass, and commit until everything that has expired is removed."""
    clock = spool._clock
    assert isinstance(clock, FakeClock)
    clock.now_ns += by_ns
    for _ in range(20):
        spool.commit()


def used(root: Path) -> tuple[int, int]:
    """Bytes of the index: in use, of the file."""
    with closing(sqlite3.connect(root / 'index.db')) as db:
        size, count, free = (db.execute(f'PRAGMA {name}').fetchone()[0] for name in ('page_size', 'page_count', 'freelist_count'))
    return (count - free) * size, count * size


def test_free_pages_are_reused(spool: Spool, root: Path) -> None:
    """The file stops growing once as many rows are forgotten as added."""
    sizes = []
    for day in range(10):
        leave(spool, *(replace(frame(second), key=f'thor/camera/{day}/{second}') for second in range(300)))
        age(spool, DAY_NS)
        sizes.append(used(root)[1])
    assert max(sizes[-3:]) <= 1.02 * max(sizes[3:7])


def test_keys_stay_known_as_long_as_they_are_needed(opened: Open, spool: Spool, root: Path) -> None:
    """That the key was used, and for which content; the outcome; and the ledger."""
    leave(spool, frame(1), make('thor/rosbags/bag_a/bag_a_0.mcap', b'a slice'))
    leave(spool, make('thor/rosbags/bag_a/bag_a_1.mcap', b'another'), state=State.EVICTED)
    before = assert_whole(root)
    age(spool)
    assert assert_whole(root) == before
    key, sha256 = frame(1).key, content_sha256(frame(1).body)
    objects = spool.reading.objects
    assert objects.row(BUCKET, key)
    assert not objects.row('trajectories', key)
    assert objects.knows(BUCKET, key, sha256)
    assert not objects.knows(BUCKET, key, '0' * 64)
    assert {row['key']: State(row['state']) for row in objects.with_prefix(BUCKET, 'thor/rosbags/bag_a/')} == {
        'thor/rosbags/bag_a/bag_a_0.mcap': State.DELIVERED, 'thor/rosbags/bag_a/bag_a_1.mcap': State.EVICTED,
    }  # fmt: skip
    (again,) = put(spool, replace(frame(1), body=b'other'))
    assert again.key == key.replace('.jpg', '_1.jpg'), 'a name is used once'
    spool.commit(outcomes=[Outcome(again, State.DELIVERED)])
    path = root / 'ready' / BUCKET / key
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(frame(1).body if isinstance(frame(1).body, bytes) else b'')
    spool.close()
    assert opened().recovery.counts['delivered files removed'] == 1, 'a file that reappeared is recognized by its content'
    assert not os.path.lexists(path)


def test_an_audit_checks_each_delivery_once(spool: Spool, root: Path) -> None:
    """Parts of the catalog are not checked."""
    part = make('thor/_catalog/a', b'part', sensor='_catalog', topic=None, samples=0)
    leave(spool, *(frame(second) for second in range(9)), part)
    with closing(Deliveries(root)) as deliveries:
        deliveries.open()
        assert (deliveries.known(), deliveries.forgotten(), deliveries.since_ns()) == (9, 0, NOON_NS)
        (asked,) = deliveries.pages()
        assert sorted(info.key for info in asked) == sorted(frame(second).key for second in range(9))
        assert {info.sha256 for info in asked} == {content_sha256(frame(second).body) for second in range(9)}


def test_uncataloged_objects_keep_their_rows(spool: Spool, root: Path) -> None:
    """A catalog part is built from their metadata."""
    (item,) = put(spool, frame(1))
    spool.commit(outcomes=[Outcome(item, State.DELIVERED)])
    age(spool, 30 * DAY_NS)
    assert len(rows(root)) == 1
    catalog(spool)
    age(spool, DAY_NS)
    assert rows(root) == []


def test_objects_refused_by_a_full_disk_are_forgotten_too(root: Path) -> None:
    """It records the time of the refusal."""
    clock = FakeClock()
    spool = new_spool(root, clock, max_bytes=1)
    spool.open()
    put(spool, frame(1))
    assert [row['state'] for row in rows(root)] == ['evicted']
    age(spool, 30 * DAY_NS)
    assert rows(root) == []
    assert assert_whole(root)['objects']['evicted'] == 1
    spool.close()
