"""Kept data is sent on request, and every request gets a response."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from shipping.asking import Desk, frame
from spool.making import NOON_NS, assert_whole, rows

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import KeepSettings
from shadowhound_data_logger.core.mailbox import KeptFilter, PullCancel, PullRequest, encode_inbox
from shadowhound_data_logger.shipping.requests import WINDOW
from shadowhound_data_logger.spool.request_table import RequestedTable, RequestRow


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    made = Desk(tmp_path / 'spool')
    yield made
    made.spool.close()


def test_objects_on_request_stay_until_requested(desk: Desk) -> None:
    """It is counted as kept, stored separately, and sent and verified on request; the ledger balances at every step."""
    desk.keeps(*(frame(number) for number in range(5)))
    assert desk.deliver() == 0
    found = assert_whole(desk.root)
    assert (found['objects']['kept'], found['topics']['/camera']['stored_in']['kept']) == (5, 5)
    assert len(list((desk.root / 'kept').rglob('*.jpg'))) == 5
    request = desk.ask(sensor='camera', since_ns=NOON_NS + SECOND, until_ns=NOON_NS + 4 * SECOND)
    desk.step()
    assert len(desk.released) == 3
    desk.finish()
    answers = desk.answers(request)
    assert (answers[0]['state'], answers[0]['objects'], answers[0]['bytes']) == ('accepted', 3, 18)
    assert answers[-1]['state'] == 'done'
    assert answers[-1]['outcomes'] == {'delivered': {'objects': 3, 'bytes': 18}}
    assert [desk.store.get('sensor-data', f'thor/camera/20251018/{number:06d}_front.jpg') for number in (1, 2, 3)] == [
        b'000001', b'000002', b'000003']  # fmt: skip
    found = assert_whole(desk.root)
    assert (found['objects']['kept'], found['topics']['/camera']['stored_in']['delivered']) == (2, 3)
    assert not list((desk.root / 'ready').rglob('*.jpg'))


def test_a_repeated_request_counts_once(desk: Desk) -> None:
    """The same request has the same id from any client; its response is final."""
    desk.keeps(frame(1))
    first, second = desk.ask(sensor='camera'), desk.ask(by='other', sensor='camera')
    assert first == second
    desk.finish()
    before = len(desk.answers(first))
    desk.step()
    desk.step()
    assert len(desk.answers(first)) == before
    assert len(desk.spool.reading.requests.rows()) == 1


@pytest.mark.parametrize(('want', 'numbers'), [
    ({'near': (3.0, 0.5, 1.2)}, [3, 4]), ({'near': (3.0, 0.0, 1.0)}, [2, 3, 4]),
    ({'near_gps': (0.0, 180.0, 150.0)}, [1, 2]), ({'topic': '/lidar'}, []),
    ({'mission': 'patrol'}, [7]), ({'mission_type': 'patrol'}, [7]), ({'patterns': ('thor/camera/*/00000?_*',)}, list(range(8))),
    ({'keys': frozenset({'thor/camera/20251018/000005_front.jpg'})}, [5]),
])  # fmt: skip
def test_a_request_selects_by_all_its_criteria(desk: Desk, want: dict[str, Any], numbers: list[int]) -> None:
    """All given criteria must match."""
    desk.keeps(*(frame(number, metadata={meta.MISSION_ID: 'patrol_1', meta.MISSION_TYPE: 'patrol'} if number == 7 else
                       {meta.GPS: f'0 {179.999 if number == 1 else -179.999} 0'} if number in {1, 2} else {})
                 for number in range(8)))  # fmt: skip
    if want == {'near': (3.0, 0.5, 1.2)}:
        numbers = [2, 3, 4]
    desk.ask(sensor='camera', **want)
    desk.step()
    assert sorted(int(item.key[-16:-10]) for item in desk.released) == numbers


def test_a_kill_at_any_moment_loses_no_request(desk: Desk) -> None:
    """The node is killed after each step of a pull; the requested data arrives once, with a response."""
    desk.keeps(*(frame(number) for number in range(4)))
    request = desk.ask(sensor='camera')
    for _ in range(3):
        desk.step()
        desk.spool.close()
        desk.open()
        assert not desk.spool.recovery.counts
    desk.finish()
    assert {desk.state(number) for number in range(4)} == {'delivered'}
    answers = desk.answers(request)
    assert [answer['number'] for answer in answers] == list(range(1, len(answers) + 1))
    assert [answer['state'] for answer in answers if answer['state'] != 'sending'] == ['accepted', 'done']
    assert_whole(desk.root)


def test_eviction_starts_with_the_oldest_and_spares_requested_objects(tmp_path: Path) -> None:
    """Above keep.max_bytes unrequested objects are evicted, as the ledger shows; if all are requested, the new ones."""
    size = 200 << 10
    desk = Desk(tmp_path / 'spool', KeepSettings(max_bytes=1 << 20))
    with closing(desk.spool):
        for number in range(8):
            desk.keeps(frame(number, body=bytes([number]) * size))
        assert [desk.state(number) for number in range(8)] == ['evicted'] * 3 + ['kept'] * 5
        found = assert_whole(desk.root)
        assert found['topics']['/camera']['gaps'] == {'evicted': {'keep_limit': 3}}
        request = desk.ask(sensor='camera')
        desk.server.step()
        for number in range(8, 20):
            desk.keeps(frame(number, body=bytes([number]) * size))
        assert {desk.state(number) for number in range(3, 8)} <= {'kept', 'pending'}
        desk.finish()
        assert {desk.state(number) for number in range(3, 8)} == {'delivered'}
        assert desk.answers(request)[-1]['outcomes']['delivered']['objects'] == 5
        assert_whole(desk.root)


def test_keeping_ends_when_protected_objects_alone_exceed_the_limit(tmp_path: Path) -> None:
    """Protected objects stay: new ones are not kept, and counted."""
    desk = Desk(tmp_path / 'spool', KeepSettings(max_bytes=1 << 20))
    with closing(desk.spool):
        desk.keeps(*(frame(number, body=bytes([number]) * (300 << 10), protected=True) for number in range(4)))
        desk.keeps(frame(9, body=b'9' * 100_000))
        assert [desk.state(number) for number in (0, 1, 2, 3, 9)] == ['kept'] * 4 + ['evicted']
        assert desk.spool.room.unkept == 1
        assert_whole(desk.root)


def test_objects_kept_for_too_long_are_evicted(desk: Desk) -> None:
    """After keep.days, unless requested."""
    desk.keeps(frame(1), frame(2))
    desk.clock.now_ns += 15 * 24 * 3600 * SECOND
    desk.ask(patterns=('*/000002_front.jpg',))
    desk.step()
    assert [desk.state(number) for number in (1, 2)] == ['evicted', 'pending']
    assert assert_whole(desk.root)['topics']['/camera']['gaps'] == {'evicted': {'keep_days': 1}}


def test_requesters_share_the_link(desk: Desk) -> None:
    """A client that requests a lot does not block another; a more important request gets a larger share of the link, not all."""
    size = 100 << 10
    for number in range(0, 300, 30):
        desk.keeps(*(frame(n, body=b'%06d' % n * (size // 6)) for n in range(number, number + 30)))
    desk.ask(by='much', sensor='camera', until_ns=NOON_NS + 250 * SECOND)
    desk.step()
    assert len(desk.released) <= WINDOW
    desk.ask(by='little', sensor='camera', since_ns=NOON_NS + 250 * SECOND)
    desk.ask(by='urgent', priority=0, sensor='camera', since_ns=NOON_NS + 200 * SECOND, until_ns=NOON_NS + 250 * SECOND)
    desk.deliver()
    desk.released.clear()
    desk.step()
    numbers = [int(item.key[-16:-10]) for item in desk.released]
    assert sum(number >= 250 for number in numbers) > 7
    assert sum(200 <= number < 250 for number in numbers) > sum(number >= 250 for number in numbers)
    assert sum(number < 200 for number in numbers) > 7


def test_cancel_and_expiry_end_a_request(desk: Desk) -> None:
    """Released objects are sent; the rest is kept, and the last response has its size."""
    size = 100 << 10
    for number in range(0, 200, 50):
        desk.keeps(*(frame(n, body=b'%06d' % n * (size // 6)) for n in range(number, number + 50)))
    late = desk.ask(sensor='camera', until_ns=NOON_NS + 100 * SECOND, expires_s=25)
    gone = desk.ask(sensor='camera', since_ns=NOON_NS + 100 * SECOND)
    desk.step()
    desk.clock.now_ns += 1
    desk.entries.append(PullCancel(id=gone, by='spark', made_ns=desk.clock.now_ns).to_json())
    desk.write(encode_inbox(desk.entries))
    desk.step()
    desk.finish()
    for request, state in ((late, 'expired'), (gone, 'cancelled')):
        last = desk.answers(request)[-1]
        assert last['state'] == state
        counts = {name: each['objects'] for name, each in last['outcomes'].items()}
        assert sum(counts.values()) == 100
        assert counts['unsent'] > 0
    assert_whole(desk.root)
    assert not any(row['state'] == 'pending' for row in rows(desk.root))


def test_a_hostile_mailbox_is_refused(desk: Desk) -> None:
    """By its size, form, fields and ids; the valid entries count, and the robot continues."""
    desk.keeps(frame(1))
    good = PullRequest(
        robot='thor',
        by='spark',
        made_ns=desk.clock.now_ns,
        expires_ns=desk.clock.now_ns + SECOND * 3600,
        want=KeptFilter(sensor='camera'),
    ).to_json()
    bad: list[tuple[str, Any]] = [
        ('not_ours', 7), ('fields', {**good, 'more': 1}), ('fields', {'cancel': good['id']}), ('id', {**good, 'id': 'f' * 32}),
        ('id', {**good, 'id': '../../x'}), ('name', {**good, 'by': '../x'}), ('time', {**good, 'made_ns': 1 << 62}),
        ('time', {**good, 'expires_ns': 1e30}), ('time', {**good, 'made_ns': float('nan')}),
        ('near', {**good, 'want': {'near': [1e308, -1e308, 1e308]}}), ('near', {**good, 'want': {'near': [10**400, 0, 1]}}),
        ('time', {**good, 'want': {'until_ns': -(1 << 70)}}), ('priority', {**good, 'priority': '0'}),
        ('id', {**good, 'id': ['x']}), ('fields', {'x' * 100_000: 1, '\x1b[2J': 2}), ('priority', {**good, 'priority': True}),
        ('robot', {**good, 'robot': 'tachi'}),
        ('fields', {**good, 'want': {'sql': '1'}}), ('fields', {**good, 'want': {}}),
        ('keys', {**good, 'want': {'keys': ['[a-z]']}}),
        ('keys', {**good, 'want': {'keys': ['a*'] * 17}}), ('near', {**good, 'want': {'near': [float('nan'), 0, 1]}}),
        ('want', {**good, 'want': {'sensor': 'x' * 257}}), ('near', {**good, 'want': {'near': [1, 2]}}),
        ('near_gps', {**good, 'want': {'near_gps': [91, 0, 1]}}), ('near_gps', {**good, 'want': {'near_gps': 'here'}}),
    ]  # fmt: skip
    for _, entry in bad:
        desk.write(json.dumps({'format': 1, 'entries': [entry]}).encode())
        desk.step()
    for body in (b'{', b'[]', b'{"format":2,"entries":[]}', b'[' * 100_000, b'{"a":' * 40_000 + b'1' + b'}' * 40_000,
                 b' ' * 300_000, json.dumps({'format': 1, 'entries': [good] * 257}).encode()):  # fmt: skip
        desk.write(body)
        desk.step()
    assert desk.released == []
    expected = [reason for reason, _ in bad]
    found = dict(desk.server.refused)
    assert {reason: found.pop(reason) for reason in set(expected)} == {
        reason: expected.count(reason) + (2 if reason == 'not_ours' else 0) for reason in set(expected)
    }
    assert found == {'not_json': 3, 'too_large': 1, 'too_many': 1}
    desk.write(json.dumps({'format': 1, 'entries': [{}, good]}).encode())
    desk.step()
    assert len(desk.released) == 1


def test_a_kill_during_acceptance_leaves_no_partial_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A request is accepted in pieces, so that nothing is blocked for long; before its row exists nothing of it is visible."""
    monkeypatch.setattr('shadowhound_data_logger.spool.requests.PIECE', 4)
    desk = Desk(tmp_path / 'spool', KeepSettings(max_bytes=1 << 20))
    desk.keeps(*(frame(number) for number in range(10)))
    with closing(desk.spool):
        real, calls = RequestedTable.add, Counter[str]()

        def add(table: RequestedTable, request: str, chosen: Sequence[tuple[int, int]]) -> None:
            calls[request] += 1
            if calls[request] == 3:
                raise OSError('it died')
            real(table, request, chosen)

        monkeypatch.setattr(RequestedTable, 'add', add)
        request = desk.ask(sensor='camera')
        with pytest.raises(OSError, match='it died'):
            desk.step()
        assert desk.spool.reading.requests.rows() == []
        assert len(desk.spool.reading.requested.unreleased(request, 100)) == 8
    desk.entries.clear()
    desk.write(encode_inbox([]))  # the client removed it again
    desk.open()
    with closing(desk.spool):
        desk.step()
        assert desk.spool.reading.requested.unreleased(request, 100) == []
        request = desk.ask(sensor='camera')
        desk.finish()
        assert desk.answers(request)[-1]['outcomes'] == {'delivered': {'objects': 10, 'bytes': 60}}
        assert_whole(desk.root)


def test_a_flooding_requester_delays_no_other(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """One requests everything in more variants than are read together; the few objects of another are among the first sent."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.requests.AT_A_TIME', 6)
    size = 60 << 10
    desk.keeps(*(frame(n, body=b'%06d' % n * (size // 6)) for n in range(80)))
    for number in range(20):
        desk.ask(by='flood', priority=0, sensor='camera', until_ns=NOON_NS + (80 + number) * SECOND)
    desk.ask(by='other', priority=9, sensor='camera', since_ns=NOON_NS + 75 * SECOND)
    desk.step()
    assert set(range(75, 80)) <= {int(item.key[-16:-10]) for item in desk.released}


def test_a_request_expires_in_the_middle_of_a_slice_of_many(desk: Desk) -> None:
    """Released objects arrive, the rest is kept and may be evicted or requested again; the last response has both."""
    size = 200 << 10
    for number in range(0, 60, 20):
        desk.keeps(*(frame(n, body=b'%06d' % n * (size // 6)) for n in range(number, number + 20)))
    request = desk.ask(sensor='camera', expires_s=15)
    desk.step()
    desk.deliver()
    desk.step(10.0)
    desk.finish()
    last = desk.answers(request)[-1]
    assert last['state'] == 'expired'
    counts = {name: each['objects'] for name, each in last['outcomes'].items()}
    assert set(counts) == {'delivered', 'unsent'}
    assert sum(counts.values()) == 60
    again = desk.ask(sensor='camera', expires_s=3600)
    assert again == request
    desk.finish()
    assert desk.answers(request)[-1]['state'] == 'done'
    assert {row['state'] for row in rows(desk.root) if row['sensor'] == 'camera'} == {'delivered'}


def test_a_mailbox_that_keeps_changing_requests_once(desk: Desk) -> None:
    """Whatever changes in an entry except its selection, and however often it is there; others are served at the same time."""
    desk.keeps(*(frame(number) for number in range(4)))
    asked = PullRequest(robot='thor', by='flood', made_ns=desk.clock.now_ns, expires_ns=desk.clock.now_ns + 3600 * SECOND,
                        want=KeptFilter(sensor='camera', until_ns=NOON_NS + 2 * SECOND))  # fmt: skip
    accepted = Counter[str]()
    real = desk.spool.requests.accept

    def accept(row: RequestRow, chosen: Sequence[tuple[int, int]]) -> RequestRow:
        accepted[row.id] += 1
        return real(row, chosen)

    desk.spool.requests.accept = accept  # type: ignore[method-assign]
    desk.server._release = lambda _: False  # type: ignore[method-assign] # the link is away, so nothing ends
    for number in range(5):
        entries = [replace(asked, by=f'flood{turn}', priority=(number + turn) % 10).to_json() for turn in range(200)]
        desk.entries = entries[number:] + entries[:number]
        desk.ask(by='other', sensor='camera', since_ns=NOON_NS + 2 * SECOND)
        desk.step()
    assert sorted(accepted.values()) == [1, 1]
    del desk.server._release  # type: ignore[method-assign]
    desk.finish()
    assert {desk.state(number) for number in range(4)} == {'delivered'}


def test_many_requests_are_remembered_and_the_first_ones_forgotten(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond a limit, so that clients that repeatedly request nothing do not block others."""
    monkeypatch.setattr('shadowhound_data_logger.shipping.requests.MAX_REQUESTS', 4)
    desk.keeps(frame(1))
    for number in range(10):
        desk.entries.clear()
        desk.ask(by='flood', topic=f'/none{number}')
        desk.step()
        desk.deliver()
        desk.step()
        desk.deliver()
    assert len(desk.spool.reading.requests.rows()) <= 4
    desk.ask(by='other', sensor='camera')
    desk.finish()
    assert desk.state(1) == 'delivered'
