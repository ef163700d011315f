"""Slices that extend beyond the requested time are cut, and the cut is sent in their place."""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from bags.slices import ECHO, TALK, Recorded, indexed
from shipping.asking import Desk
from spool.making import NOON_NS, assert_whole, make, receive, rows

from shadowhound_data_logger.bags.cut import Choice, cut_remote
from shadowhound_data_logger.bags.kept import CUTTING
from shadowhound_data_logger.bags.remote import find_bag, read_manifest, state_of
from shadowhound_data_logger.bags.verify import verify_remote
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import DataObject, FileBody
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.spool.topic_account import BAG as ACCOUNT

BAG = 'patrol_20251018_120000'
SLICE_S = 10
HERTZ = 50
SIZE = 1000


def recorded(number: int) -> list[Recorded]:
    """Two topics, alternating, in one slice."""
    first = number * SLICE_S * HERTZ
    return [
        Recorded((TALK, ECHO)[at % 2].topic, (log_ns := NOON_NS + at * SECOND // HERTZ), log_ns - 5, at,
                 at.to_bytes(4, 'big') + bytes([at % 251]) * SIZE)
        for at in range(first, first + SLICE_S * HERTZ)
    ]  # fmt: skip


def kept_slice(folder: Path, number: int, bag: str = BAG, **more: str) -> DataObject:
    """A slice of ten seconds as spooled by the node, of about 500 KB."""
    writer = SliceWriter(folder / f'{bag}_{number}.mcap', compression='none', chunk_bytes=32 << 10)
    for one in recorded(number):
        writer.write({each.topic: each for each in (TALK, ECHO)}[one.topic], one.log_ns, one.publish_ns, one.sequence, one.cdr)
    info = writer.close()
    fields = {meta.ROBOT: 'thor', meta.BAG: bag, meta.SLICE: str(number), meta.MISSION_ID: 'm1',
            meta.MISSION_TYPE: 'patrol'}  # fmt: skip
    fields |= {meta.SHIP: meta.ON_REQUEST, **more}
    return make(f'thor/rosbags/{bag}/{bag}_{number}.mcap', FileBody(info.path, info.bytes, info.sha256), sensor='bag',
                topic=None, type='', samples=0, t_start_ns=info.t_start_ns, t_end_ns=info.t_end_ns, metadata=fields,
                counts={f'{ACCOUNT}/talk': SLICE_S * HERTZ // 2, f'{ACCOUNT}/echo': SLICE_S * HERTZ // 2})  # fmt: skip


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    made = Desk(tmp_path / 'spool')
    for topic in (f'{ACCOUNT}/talk', f'{ACCOUNT}/echo'):
        receive(made.spool, 3 * SLICE_S * HERTZ // 2, topic)
    made.spool.commit([kept_slice(tmp_path, number) for number in range(3)])
    yield made
    made.spool.close()
    assert not list((tmp_path / CUTTING).rglob('*.mcap*'))


def between(since_ns: int, until_ns: int) -> list[Recorded]:
    return [one for number in range(3) for one in recorded(number) if since_ns <= one.log_ns < until_ns]


def asked(desk: Desk, since_s: float, until_s: float, **more: object) -> tuple[str, int, int]:
    since_ns, until_ns = NOON_NS + round(since_s * SECOND), NOON_NS + round(until_s * SECOND)
    return desk.ask(sensor='bag', since_ns=since_ns, until_ns=until_ns, **more), since_ns, until_ns  # type: ignore[arg-type]


def stored(desk: Desk, bag: str, folder: Path) -> list[Recorded]:
    """The messages of a complete bag in the store."""
    remote = find_bag(desk.store, 'thor', bag)
    manifest = read_manifest(desk.store, remote)
    assert state_of(remote, manifest, {}) == 'complete'
    assert verify_remote(desk.store, remote, deep=True).is_intact
    cut_remote(desk.store, remote, folder / 'read', Choice())
    path = folder / f'{bag}.mcap'
    path.write_bytes(desk.store.get('sensor-data', remote.slices[0].key))
    found = indexed(path)
    assert indexed(folder / 'read' / 'read_0.mcap') == found
    return found


def test_a_range_within_a_slice_arrives_as_a_separate_bag(desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has the messages of that time, byte for byte, and about their size; the slice stays, and the ledger balances."""
    request, since_ns, until_ns = asked(desk, 12, 14)
    monkeypatch.setattr('shadowhound_data_logger.shipping.slice_cuts.CUT_S', 0.0)
    desk.step()
    monkeypatch.undo()
    first = desk.answers(request)[0]
    assert first['objects'] == 1
    assert 90_000 < first['bytes'] < 130_000
    desk.finish()
    last = desk.answers(request)[-1]
    assert (last['state'], last['outcomes']['delivered']['objects'], len(last['bags'])) == ('done', 3, 1)
    assert last['bags'][0].startswith(f'{BAG}_cut_')
    assert stored(desk, last['bags'][0], tmp_path) == between(since_ns, until_ns)
    assert assert_whole(desk.root)['objects']['kept'] == 3
    with closing(sqlite3.connect(desk.root / 'index.db')) as db:
        counted = db.execute('SELECT state, samples FROM tally WHERE topic = ? AND samples', (f'{ACCOUNT}/talk',)).fetchall()
    assert counted == [('kept', 3 * SLICE_S * HERTZ // 2), ('spooled', 3 * SLICE_S * HERTZ // 2)]
    manifest = read_manifest(desk.store, find_bag(desk.store, 'thor', last['bags'][0]))
    assert manifest
    assert manifest.mission
    assert (manifest.mission.type, manifest.mission.mission_id) == ('patrol', 'm1')


def test_a_range_over_slices_is_cut_at_its_ends(desk: Desk, tmp_path: Path) -> None:
    """Slices inside it arrive unchanged; the two ends are one bag."""
    request, since_ns, until_ns = asked(desk, 8, 23)
    desk.finish()
    last = desk.answers(request)[-1]
    assert last['state'] == 'done'
    whole = desk.store.get('sensor-data', f'thor/rosbags/{BAG}/{BAG}_1.mcap')
    (tmp_path / 'whole.mcap').write_bytes(whole)
    ends = stored(desk, last['bags'][0], tmp_path)
    middle = indexed(tmp_path / 'whole.mcap')
    assert sorted(ends + middle, key=lambda one: one.log_ns) == between(since_ns, until_ns)
    assert assert_whole(desk.root)['objects']['kept'] == 2


def test_the_same_range_is_cut_and_sent_once(desk: Desk) -> None:
    """For any client, and however the request is written."""
    first, *_ = asked(desk, 2, 4)
    desk.finish()
    before = len(rows(desk.root))
    second, *_ = asked(desk, 2, 4, by='other', patterns=(f'thor/rosbags/{BAG}/*',))
    assert second != first
    desk.finish()
    last = desk.answers(second)[-1]
    assert (last['state'], last['outcomes']) == ('done', desk.answers(first)[-1]['outcomes'])
    assert [row for row in rows(desk.root)[before:] if row['sensor'] == 'bag'] == []


def test_a_kill_during_a_cut_leaves_one_cut(desk: Desk, tmp_path: Path) -> None:
    """Whether it was killed before the spool had the cut, or before the request referred to it."""
    request, since_ns, until_ns = asked(desk, 12, 14)
    desk.server._cuts.work = lambda _: False  # type: ignore[method-assign] # it dies before any work is done
    desk.step()
    desk.spool.close()
    desk.open()

    def die(*_: object) -> int:
        raise SpoolError('it died', remedy='')

    desk.spool.requests.set_cut = die  # type: ignore[method-assign]
    with pytest.raises(SpoolError):
        desk.step()
    desk.spool.close()
    desk.open()
    desk.finish()
    last = desk.answers(request)[-1]
    assert (last['state'], last['objects'], last['outcomes']['delivered']['objects']) == ('done', 3, 3)
    assert stored(desk, last['bags'][0], tmp_path) == between(since_ns, until_ns)
    assert_whole(desk.root)


@pytest.mark.parametrize('damage', ['torn', 'gone'])
def test_a_slice_that_cannot_be_cut_is_sent_completely(desk: Desk, damage: str) -> None:
    """The robot continues, and the uploader reports the outcome of the slice."""
    path = next((desk.root / 'kept').rglob(f'{BAG}_1.mcap'))
    if damage == 'torn':
        path.write_bytes(path.read_bytes()[:-30])
    else:
        path.unlink()
    request, *_ = asked(desk, 12, 14)
    desk.step()
    desk.step()
    assert [item.key.rpartition('/')[2] for item in desk.released] == [f'{BAG}_1.mcap']
    assert {row.id: row.objects for row in desk.spool.reading.requests.rows()} == {request: 1}


def test_a_cancelled_request_ends_its_cut(desk: Desk) -> None:
    """None of it is sent, and nothing stays on the disk."""
    ticks = itertools.count()
    desk.server._monotonic = desk.server._cuts._monotonic = lambda: next(ticks) * 0.03  # one chunk per step
    request, *_ = asked(desk, 12, 14)
    desk.step()
    desk.step()
    assert list((desk.root.parent / CUTTING).rglob('*.mcap.open'))
    desk.spool.requests.close(request, 'cancelled')
    desk.finish()
    assert desk.answers(request)[-1]['outcomes']['unsent']['objects'] == 1
    assert {row['state'] for row in rows(desk.root) if row['sensor'] == 'bag'} == {'kept'}


def test_a_slice_without_a_date_is_sent_completely(tmp_path: Path, desk: Desk) -> None:
    """Its messages have different times from the requested ones."""
    bag = 'patrol_20251018_130000'
    desk.spool.commit([kept_slice(tmp_path, 0, bag, clock='set_later')])
    asked(desk, 2, 4, patterns=(f'thor/rosbags/{bag}/*',))
    desk.step()
    assert [item.key.rpartition('/')[2] for item in desk.released] == [f'{bag}_0.mcap']
