"""Shared memory of killed processes: what is freed, and what is not changed."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.ros.shared_memory import MAX_DEAD_PORTS, Orphan, dead_ports_avoided, orphans

DEAD, ALIVE, YOUNG = 'fastrtps_0123456789abcdef', 'fastdds_00000000000000aa', 'fastdds_00000000000000bb'
OTHERS = ('fastrtps_port7411', 'fastrtps_port7411_el', 'fast_datasharing_01.0f.78.fd.2f.45.bd.0f.00.00.00.00_0.0.6.3',
          'fastdds_00000000000000cc', 'fastdds-profile.xml', 'fastdds_0123_el')  # fmt: skip


@pytest.fixture
def shm(tmp_path: Path) -> Path:
    """Three segments with their locks, and foreign files, all old except one."""
    for name in (*OTHERS, *(f'{segment}{end}' for segment in (DEAD, ALIVE, YOUNG) for end in ('', '_el'))):
        (tmp_path / name).write_bytes(b'x' * 8192 if '_el' not in name else b'')
        os.utime(tmp_path / name, (0, 0))
    now = time.time()
    os.utime(tmp_path / f'{YOUNG}_el', (now, now + 3600))
    return tmp_path


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_only_unowned_segments_are_freed(shm: Path) -> None:
    """Not that of a running or starting process, nor ports, nor one without a lock; checking them changes nothing."""
    before = names(shm)
    with flock(shm / f'{ALIVE}_el'):
        assert [each.name for each in orphans(shm)] == [DEAD]
        assert names(shm) == before
        assert orphans(shm, free=True) == [Orphan(DEAD, 8192)]
        assert names(shm) == before - {DEAD, f'{DEAD}_el'}
        assert orphans(shm, free=True) == []


def test_segments_of_another_user_are_kept(shm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if this process may remove it, as root may."""
    before, mine = names(shm), os.geteuid()
    monkeypatch.setattr(os, 'geteuid', lambda: mine + 1)
    assert orphans(shm, free=True) == []
    assert names(shm) == before


def test_an_unrelated_lock_is_ignored(shm: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Any user may write there: links are not followed, and a pipe does not block."""
    outside = tmp_path_factory.mktemp('outside') / 'file'
    outside.write_text('precious')
    os.utime(outside, (0, 0))
    link, pipe = shm / 'fastdds_00000000000000dd_el', shm / 'fastdds_00000000000000ee_el'
    link.symlink_to(outside)
    os.mkfifo(pipe)
    os.utime(pipe, (0, 0))
    segment = shm / f'{DEAD}'
    segment.unlink()
    segment.symlink_to(outside)
    assert [each.name for each in orphans(shm, free=True)] == [ALIVE]
    assert outside.read_text() == 'precious'
    assert {link.name, pipe.name} <= names(shm)


def test_without_the_folder_nothing_is_freed(tmp_path: Path) -> None:
    """Nothing is freed, and nothing fails."""
    assert orphans(tmp_path / 'none', free=True) == []


def ports(shm: Path, *numbers: int) -> list[str]:
    """Ports of Fast DDS with their locks, without an owner."""
    names = [f'fastrtps_port{number}' for number in numbers]
    for name in names:
        (shm / name).write_bytes(b'x')
        (shm / f'{name}_el').touch()
    return names


def process(proc: Path, number: int, *mapped: str) -> Path:
    """A process with these files mapped."""
    maps = proc / f'{number}' / 'maps'
    maps.parent.mkdir(parents=True)
    maps.write_text(''.join(f'7f00-7f01 rw-s 00000000 00:18 12 /dev/shm/{name}\n' for name in mapped))
    return maps


def is_locked(shm: Path, name: str) -> bool:
    with flock(shm / f'{name}_el', wait=False) as was_had:
        return not was_had


def test_a_dead_port_with_a_writer_is_avoided(tmp_path: Path) -> None:
    """In this domain, also if the segment was replaced; not one in use, and none that no process has mapped."""
    shm = tmp_path / 'shm'
    shm.mkdir()
    written, replaced, alive, forgotten, other = ports(shm, 7413, 7001, 7415, 7417, 7663)
    process(tmp_path / 'proc', 1, written, f'{replaced} (deleted)', alive, other, 'fastrtps_port74170')
    os.utime(shm / written, (0, 0))
    proc = tmp_path / 'proc'
    with flock(shm / f'{alive}_el'), dead_ports_avoided(0, shm, proc) as avoided:
        assert avoided == [replaced, written]
        assert [is_locked(shm, name) for name in (written, replaced, forgotten, other)] == [True, True, False, False]
    assert not any(is_locked(shm, name) for name in (written, replaced, alive))
    with dead_ports_avoided(1, shm, proc) as avoided:
        assert set(avoided) == {replaced, other}, 'those from 7000 on are of all domains'


def test_where_owners_are_unknown_all_ports_are_avoided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But so few that Fast DDS finds another one, the most recent first."""
    shm = tmp_path / 'shm'
    shm.mkdir()
    dead = ports(shm, *range(7411, 7651, 2))
    for when, name in enumerate(dead):
        os.utime(shm / name, (when, when))
    maps = process(tmp_path / 'proc', 1)
    read = Path.read_text

    def refuse(path: Path, *more: object, **words: object) -> str:
        if path == maps:
            raise PermissionError
        return read(path, *more, **words)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, 'read_text', refuse)
    with dead_ports_avoided(0, shm, tmp_path / 'proc') as avoided:
        assert avoided == dead[: -MAX_DEAD_PORTS - 1 : -1]
    with dead_ports_avoided(0, tmp_path / 'none', tmp_path / 'proc') as avoided:
        assert avoided == []
