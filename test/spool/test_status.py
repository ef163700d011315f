"""What a status file, the boot clock, the process table and the spool's index together show about a node."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from spool.making import NOON_NS, FakeClock, make, new_spool, put, settle

from shadowhound_data_logger.core.clock import SECOND, SystemClock, iso
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.stamps import CAUSES as OF
from shadowhound_data_logger.spool.local_robot import robots
from shadowhound_data_logger.spool.status import NodeSession, file, limits, not_logged, read, targets

OWN = SpoolSettings(max_bytes=20 << 20, min_free_bytes=10)


def written(root: Path, **changes: Any) -> None:
    """A status as the node writes it, with the time and boot of FakeClock."""
    root.mkdir(exist_ok=True)
    head = {'robot': 'thor', 'pid': os.getpid(), 'boot_id': 'a-boot', 'boot_ns': NOON_NS, 'uptime_s': 12.0, 'ended': False}
    file(root, changes.get('robot', 'thor')).write_text(json.dumps({**head, 'spool': {'max_bytes': 1000}, **changes}))


@pytest.fixture(scope='module')
def child() -> Iterator[int]:
    """The id of a running process."""
    with subprocess.Popen([sys.executable, '-c', 'input()'], stdin=subprocess.PIPE) as process:
        yield process.pid
        process.communicate(b'\n')


def state(root: Path, now_ns: int = NOON_NS) -> str:
    return read(root, 'thor', FakeClock(now_ns)).state


def test_a_fresh_status_means_a_running_node(tmp_path: Path) -> None:
    """Younger than five seconds by the boot clock, whatever the wall clock shows; its values are reported unchanged."""
    written(tmp_path, topics={'/imu': {'received': 7}}, time='1970-01-01T00:00:00Z')
    found = read(tmp_path, 'thor', FakeClock(NOON_NS + 4 * SECOND))
    assert (found.state, found.running, found.age_s) == ('running', True, 4.0)
    assert found.node.topics['/imu'].received == 7
    assert found.findings == ()


@pytest.mark.parametrize(
    'changes', [{'boot_id': 'another'}, {'ended': True}, {'pid': 2**22 + 1, 'boot_ns': NOON_NS - 6 * SECOND}]
)
def test_an_exited_node_is_not_running(tmp_path: Path, changes: dict[str, Any]) -> None:
    """From another boot, stopped cleanly, or old with a process that is gone: not running, and its values are not shown."""
    written(tmp_path, topics={'/imu': {}}, **changes)
    found = read(tmp_path, 'thor', FakeClock())
    assert (found.state, found.running) == ('not_running', False)
    assert not found.node.topics
    assert 'the node is not running' in found.findings


def test_a_silent_process_is_not_answering(tmp_path: Path, child: int) -> None:
    """The process was there when the status was written and still is, but wrote nothing for five seconds."""
    clock = SystemClock.of_this_machine()
    written(tmp_path, pid=child, boot_id=clock.boot_id, boot_ns=clock.boot_ns())
    found = read(tmp_path, 'thor', Ahead(clock.boot_id))
    assert (found.state, found.running, found.node.pid) == ('not_answering', False, child)
    assert any(f'process {child}' in line for line in found.findings)


def test_a_later_process_of_the_same_number_is_not_the_node(tmp_path: Path, child: int) -> None:
    """Process ids are reused: a process that started after the status was written did not write it."""
    clock = SystemClock.of_this_machine()
    written(tmp_path, pid=child, boot_id=clock.boot_id, boot_ns=clock.boot_ns() - 3600 * SECOND)
    assert read(tmp_path, 'thor', clock).state == 'not_running'


class Ahead(SystemClock):
    """Six seconds from now."""

    def boot_ns(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 6 * SECOND


@pytest.mark.parametrize(
    'content',
    [
        '',
        '{"robot": "th',
        '[]',
        '{"topics": 3}',
        '{"store": null, "queue": []}',
        '\x00\x00',
        '{"topics": {"/imu": {"received": "7"}}}',
        '{"workers": {"intake": [1]}}',
        '{"topics": {"/imu": {"other_types": {"x/msg/Y": {"publishers": [3]}}}}}',
        '{"boot_ns": 1.5}',
        '{"topics": {"/imu": {"stamps": {}}}}',
        '[' * 100_000,
    ],
)
def test_a_damaged_file_is_a_finding(tmp_path: Path, content: str) -> None:
    """A power cut may damage a file that is never synced; another version may write other types. Readers do not fail."""
    path = file(tmp_path, 'thor')
    path.write_text(content)
    found = read(tmp_path, 'thor', FakeClock())
    assert found.state == 'not_running'
    assert any(line.startswith(f'the status {path} cannot be read: ') for line in found.findings)
    assert (targets(tmp_path), not_logged(tmp_path, 'thor'), limits(tmp_path, OWN)) == ([], {}, OWN)


def test_fields_of_a_newer_node_are_ignored(tmp_path: Path) -> None:
    """At the top, in a section and in a topic; all other values are read."""
    written(tmp_path, mood='good', store={'mood': 1, 'delivered': 5}, topics={'/imu': {'mood': [], 'received': 7}})
    found = read(tmp_path, 'thor', FakeClock()).node
    assert (found.store.delivered, found.topics['/imu'].received) == (5, 7)


def test_fields_of_other_versions_have_defaults(tmp_path: Path) -> None:
    """A program newer than the running node can still show its status."""
    written(tmp_path, topics={'/imu': {}}, workers={'intake': {}})
    found = read(tmp_path, 'thor', FakeClock())
    assert found.node.topics['/imu'].missed is None
    assert found.node.store.blocked_buckets == {}
    assert found.node.workers['intake'].failing is False


def test_without_a_node_the_index_is_read(tmp_path: Path) -> None:
    """The contents of the spool, the age of the oldest object, and when the last session started and ended."""
    clock = FakeClock()
    spool = new_spool(tmp_path / 'spool', clock)
    spool.open()
    done, _, bad = put(spool, make('a', b'12345'), make('b', b'123'), make('c', b'1'))
    put(spool, make('d', b'22', held='clock'))
    settle(spool, done, State.DELIVERED)
    settle(spool, bad, State.QUARANTINED, 'denied')
    clock.now_ns += 90 * SECOND
    spool.close()
    written(tmp_path / 'spool', ended=True, boot_ns=clock.now_ns)
    found = read(tmp_path / 'spool', 'thor', clock)
    assert found.session == NodeSession('2025-10-18T12:00:00.000000Z', '2025-10-18T12:01:30.000000Z')
    pile = found.spool
    assert pile
    assert (pile.pending, pile.held, pile.quarantined, pile.bytes) == (1, 1, 1, 6)
    assert (pile.oldest_age_s, pile.max_bytes) == (90.0, 1000)
    assert pile.free_bytes


def test_a_killed_session_has_no_end(tmp_path: Path) -> None:
    """A killed node has a session without an end, and no other time is used instead."""
    spool = new_spool(tmp_path / 'spool')
    spool.open()
    found = read(tmp_path / 'spool', 'thor', FakeClock())
    spool.close()
    assert found.session == NodeSession('2025-10-18T12:00:00.000000Z', None)


def test_the_session_is_that_of_the_node(tmp_path: Path) -> None:
    """Not that of another process that has sent a mission or a bag from the same spool."""
    for clock in (FakeClock(), FakeClock(NOON_NS + 60 * SECOND)):
        spool = new_spool(tmp_path, clock)
        spool.open()
        spool.close()
    with closing(sqlite3.connect(tmp_path / 'index.db')) as index:
        index.execute('UPDATE sessions SET pid = pid + 1 WHERE id = 2')
        index.commit()
    written(tmp_path, ended=True)
    session = read(tmp_path, 'thor', FakeClock()).session
    assert session
    assert session.started == '2025-10-18T12:00:00.000000Z'


def test_a_missing_and_a_damaged_spool_are_reported(tmp_path: Path) -> None:
    """Both are findings, and the contents of the spool are unknown."""
    found = read(tmp_path, 'thor', FakeClock())
    assert found.spool is None
    assert any(str(tmp_path) in line for line in found.findings)
    (tmp_path / 'index.db').write_bytes(b'no database' * 1000)
    found = read(tmp_path, 'thor', FakeClock())
    assert found.spool is None
    assert any('cannot be read' in line for line in found.findings)


MANY = {'/a': {'missed': 1}, '/b': {'missed': 4_000}, '/c': {'missed': 1}, '/d': {'missed': 2}, '/e': {'missed': 0}}
FORGED = {'/odom': {'by_arrival': {'stamp_too_old': 3, 'sent_ahead': 2}}, '/imu': {'by_arrival': {'stamp_too_old': 4}}}
SINCE = iso(NOON_NS)
LATE_CLOCK = {'publisher': None, 'state': 'offset', 'offset_s': 146.0, 'spread_s': 0.0, 'since_ns': NOON_NS, 'cause': 'clock'}
LATE = {topic: {'stamps': LATE_CLOCK} for topic in ('/imu', '/odom')}
STUCK = {'/odom': {'stamps': {**LATE_CLOCK, 'state': 'stuck', 'cause': 'stuck'}}}
CAUSES = {'/odom': {'missed': 5, 'missed_by': {'restart': 3, 'transport': 2}}}
TOPICS = {'/imu': {'dropped': 2}, '/odom': {'missed': 3}, '/camera': {'rejected': 1, 'missed': 0}}


@pytest.mark.parametrize(
    ('changes', 'finding'),
    [
        ({'topics': TOPICS}, 'dropped in this session: /imu 2'),
        ({'topics': TOPICS}, 'missed in this session: /odom 3'),
        ({'topics': CAUSES}, 'missed in this session by restart: /odom 3'),
        ({'topics': CAUSES}, 'missed in this session by transport: /odom 2'),
        ({'topics': TOPICS}, 'rejected in this session: /camera 1'),
        ({'topics': FORGED}, 'dated by arrival in this session, because of sent_ahead: /odom 2'),
        ({'topics': FORGED}, 'dated by arrival in this session, because of stamp_too_old: /imu 4, /odom 3'),
        ({'topics': MANY}, 'missed in this session: /b 4,000, /d 2, /a 1 and 1 more'),
        ({'topics': LATE}, f'/imu, /odom: stamps are 146.0 s older than their arrival since {SINCE}: {OF["clock"]}'),
        ({'topics': STUCK}, f'/odom: stamps do not advance since {SINCE}, messages are dated by their arrival: {OF["stuck"]}'),
        ({'store': {'quarantined': 4}}, 'quarantined in this session: 4 objects'),
        (
            {'spool': {'evicted': 4000}},
            'evicted in this session: 4,000 objects; disk or spool is full (spool.min_free_bytes, spool.max_bytes)',
        ),
        ({'store': {'state': 'store_down'}}, 'the store cannot be reached: objects wait on the disk'),
        ({'store': {'state': 'paused'}}, 'an error stops uploads: objects wait on the disk'),
        ({'store': {'blocked_buckets': {'maps': 'there is none'}}}, 'bucket maps takes nothing: there is none'),
        ({'workers': {'intake': {'failing': True, 'last_error': 'OSError: 5'}}}, 'intake fails: OSError: 5'),
        ({'paused': True}, 'the node is paused: nothing is logged'),
        ({'stalls': {'/imu': 'silent for 7 s'}}, '/imu: silent for 7 s'),
        (
            {'topics': {'/odom': {'type': 'A', 'other_types': {'B': {'publishers': ['/x'], 'messages': 1234}}}}},
            '/odom was also published as B, by /x, but is only logged as A; 1,234 messages were rejected',
        ),
        (
            {'bag': {'topics': {'/map': {'type': 'A', 'other_types': {'B': {'publishers': [], 'messages': None}}}}}},
            (
                '/map was also published as B, by a program that is not a ROS node, but is only logged as A; '
                'these messages were not received or counted'
            ),
        ),
    ],
)
def test_each_fault_of_a_running_node_is_a_finding(tmp_path: Path, changes: dict[str, Any], finding: str) -> None:
    written(tmp_path, **changes)
    assert finding in read(tmp_path, 'thor', FakeClock()).findings


@pytest.mark.parametrize('name', ['idle', 'shipping', 'not_draining'])
def test_a_working_store_is_not_a_finding(tmp_path: Path, name: str) -> None:
    """Neither is one that another process delivers to, nor files already in quarantine."""
    written(tmp_path, store={'state': name}, spool={'quarantined': 5}, topics={'/imu': {'skipped': 9, 'open': 3}})
    assert read(tmp_path, 'thor', FakeClock()).findings == ()


def test_the_robots_of_a_spool_are_listed(tmp_path: Path) -> None:
    """From their status files; other files are ignored."""
    written(tmp_path, robot='thor')
    written(tmp_path, robot='robot_1.a')
    (tmp_path / 'status.json').touch()
    assert robots(tmp_path) == ['robot_1.a', 'thor']


@pytest.mark.parametrize(('gave_up', 'words'), [(False, 'objects wait for their date'), (True, 'objects go without a date')])
def test_a_clock_that_is_not_set_is_a_finding(tmp_path: Path, words: str, *, gave_up: bool) -> None:
    """And so are its consequences for the objects."""
    written(tmp_path, clock={'is_set': False, 'gave_up': gave_up})
    assert f'the clock of this machine is not set: {words}' in read(tmp_path, 'thor', FakeClock()).findings


def test_an_unknown_age_is_unknown(tmp_path: Path) -> None:
    """An object spooled before the clock was set has not waited since 1970."""
    clock = FakeClock(60 * SECOND)
    spool = new_spool(tmp_path, clock)
    spool.open()
    put(spool, make())
    clock.now_ns += 9 * SECOND
    assert spool.usage().oldest_age_s == 9.0
    clock.now_ns = NOON_NS
    assert spool.usage().oldest_age_s is None
    spool.close()


def test_other_processes_use_the_limits_of_the_node(tmp_path: Path) -> None:
    """The highest of several nodes' limits; if none has run, or an old one reported none, the process's limits."""
    assert limits(tmp_path, OWN) == OWN
    written(tmp_path, spool={'max_bytes': 9 << 20})
    assert limits(tmp_path, OWN) == SpoolSettings(max_bytes=9 << 20, min_free_bytes=10)
    written(tmp_path, robot='tachi', spool={'max_bytes': 50 << 20, 'min_free_bytes': 0, 'remember_days': 30.0})
    assert limits(tmp_path, OWN) == SpoolSettings(max_bytes=50 << 20, min_free_bytes=0, remember_days=30.0)
