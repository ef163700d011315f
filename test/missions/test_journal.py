"""The journal: written records stay readable, whatever happens to others."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.missions.journal import Journal, abandoned, finish, line_of, read


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    made = Journal(tmp_path / 'journal')
    made.create()
    yield made
    made.close()


def records(path: Path, offset: int = 0) -> list[object]:
    return [line.record for line in read(path, offset)]


def test_a_journal_is_read_as_it_was_written(journal: Journal) -> None:
    """Records come back in order, floats to the last bit, and reading continues at the end of any line."""
    reports = [{'k': 'metrics', 'm': {'a': 0.1 + 0.2}, 't': 1 << 60}, {'k': 'event', 'name': 'Küche\n\0'}, {'k': 'end'}]
    for record in reports:
        journal.append(record)
    assert records(journal.path) == reports
    ends = [line.end for line in read(journal.path)]
    assert [records(journal.path, end) for end in ends] == [reports[1:], reports[2:], []]
    assert ends[-1] == journal.path.stat().st_size


def test_a_torn_line_costs_only_itself(journal: Journal) -> None:
    """An incomplete line is skipped until it is complete; one that never becomes complete is damaged."""
    journal.append({'a': 1})
    with journal.path.open('ab') as file:
        file.write(line_of({'b': 2})[:-4])
    assert records(journal.path) == [{'a': 1}]
    with journal.path.open('ab') as file:
        file.write(b'\n')
    journal.append({'c': 3})
    assert records(journal.path) == [{'a': 1}, None, {'c': 3}]


def test_a_record_after_a_full_disk_is_complete(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record that a full disk cut off does not damage the next one."""
    journal.append({'a': 1})
    write = os.write
    monkeypatch.setattr(os, 'write', lambda descriptor, data: write(descriptor, data[:7]))
    with pytest.raises(OSError, match='only partly written'):
        journal.append({'b': 2})
    monkeypatch.undo()
    journal.append({'c': 3})
    assert records(journal.path) == [{'a': 1}, None, {'c': 3}]


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 400), st.integers(1, 255))
def test_corruption_is_detected(tmp_path_factory: pytest.TempPathFactory, place: int, flip: int) -> None:
    """Of a journal with a changed byte, every record that is read is one that was written, and at most two are missing."""
    reports = [{'k': 'metrics', 'n': number, 'v': number / 7} for number in range(10)]
    data = bytearray(b''.join(map(line_of, reports)))
    data[place % len(data)] ^= flip
    path = tmp_path_factory.mktemp('rot') / 'journal'
    path.write_bytes(data)
    found = [record for record in records(path) if record is not None]
    assert all(record in reports for record in found)
    assert len(found) >= len(reports) - 2


def test_threads_share_a_journal(journal: Journal) -> None:
    """Records of many threads do not mix, and each thread's stay in order."""
    threads = [
        threading.Thread(target=lambda me=me: [journal.append({'me': me, 'n': n, 'x': 'y' * 99}) for n in range(200)])
        for me in range(5)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = records(journal.path)
    assert len(found) == 1000
    for me in range(5):
        assert [record['n'] for record in found if record['me'] == me] == list(range(200))  # type: ignore[index]


def test_a_running_writer_is_detected(journal: Journal) -> None:
    """No process can finish the journal while its writer has it open; afterwards any process can."""
    with abandoned(journal.path) as descriptor:
        assert descriptor is None
    journal.close()
    with abandoned(journal.path) as descriptor:
        assert descriptor is not None


def test_an_exited_writer_is_detected_whatever_it_forked(tmp_path: Path) -> None:
    """A killed writer's lock is free although a process that it forked is still running."""
    program = """
import os, signal, sys
from pathlib import Path
from shadowhound_data_logger.missions.journal import Journal
journal = Journal(Path(sys.argv[1]))
journal.create()
journal.append({'a': 1})
if os.fork() == 0:
    journal.append({'from': 'the child'})
    os.write(1, b'%d\\n' % os.getpid())
signal.pause()
"""
    path = tmp_path / 'journal'
    writer = subprocess.Popen([sys.executable, '-c', program, str(path)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    child = int(writer.stdout.readline())
    try:
        with abandoned(path) as descriptor:
            assert descriptor is None
        writer.kill()
        writer.wait()
        with abandoned(path) as descriptor:
            assert descriptor is not None
        assert records(path) == [{'a': 1}]
    finally:
        os.kill(child, 9)
        writer.stdout.close()


def test_the_last_record_replaces_a_torn_one(journal: Journal) -> None:
    """Finishing removes a partial record and returns its size."""
    journal.append({'a': 1})
    end = journal.path.stat().st_size
    with journal.path.open('ab') as file:
        file.write(b'01234567 {"half')
    journal.close()
    with abandoned(journal.path) as descriptor:
        assert descriptor is not None
        assert finish(journal.path, descriptor, end, {'k': 'end'}) == 15
    assert records(journal.path) == [{'a': 1}, {'k': 'end'}]


def test_syncing_does_not_delay_writers(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records are appended while the disk is busy with a sync."""
    entered, leave = threading.Event(), threading.Event()
    monkeypatch.setattr(os, 'fsync', lambda _: (entered.set(), leave.wait(60)))
    thread = threading.Thread(target=journal.sync)
    thread.start()
    try:
        assert entered.wait(60)
        journal.append({'a': 1})
        assert records(journal.path) == [{'a': 1}]
    finally:
        leave.set()
        thread.join()


def test_other_users_cannot_read_the_journal(journal: Journal) -> None:
    """Only the owner can read what a robot did."""
    assert journal.path.stat().st_mode & 0o077 == 0


def test_a_journal_is_created_once(journal: Journal) -> None:
    """A second one under the same name is refused, and the first keeps its lock."""
    with pytest.raises(FileExistsError):
        Journal(journal.path).create()
    descriptor = os.open(journal.path, os.O_RDONLY)
    with pytest.raises(BlockingIOError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(descriptor)
