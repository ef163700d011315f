"""One robot's bad part of the gap journal is left out, named and counted; what the others told is answered by every command."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from hostile import bad_parts
from hypothesis import given, settings
from hypothesis import strategies as st
from lake.gap_parts import lost, mark, tell
from lake.making import NOON_NS, folder_store

from shadowhound_data_logger import lake
from shadowhound_data_logger.cli.lake import lake as lake_command
from shadowhound_data_logger.cli.query import query
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import coverage, known, of_rows

ROWS = [lost(str(number), number, number + 1) for number in range(3)]
MOST = (1 << 63) - 1
END_NS = NOON_NS + 3600 * SECOND


def with_(**fields: Any) -> bytes:
    return parts.encode([{**row, **fields} for row in ROWS], GAPS)


BAD: dict[str, Callable[[], bytes]] = {
    'empty': lambda: b'',
    'garbage': lambda: random.Random(1).randbytes(5000),
    'a part of the catalogue': lambda: parts.encode([catalog.row_of('sensor-data', 'thor/a', 1, '', {})]),
    'a text for a number': lambda: bad_parts.lines(ROWS, 'gap', revision='newest'),
    'a number for an id': lambda: bad_parts.lines(ROWS, 'gap', id=1),
    'no revision': lambda: bad_parts.lines(ROWS, 'gap', revision=None),
    'of tachi': lambda: with_(robot='tachi'),
    'a kind of statement that is none': lambda: with_(what='forget'),
    'an end before the beginning': lambda: with_(to_ns=0),
    'a year of six digits': lambda: with_(t_to=1 << 62),
    'a revision below nothing': lambda: with_(revision=-1),
    'a bomb': bad_parts.bomb,
}  # fmt: skip


@pytest.fixture
def home(tmp_path: Path) -> Path:
    tell(folder_store(tmp_path), tmp_path, mark(3600), lost('1', 600, 660))
    return tmp_path


def run(command: Callable[..., object], home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '200', 'AWS_ENDPOINT_URL': ''}
    found = CliRunner().invoke(command, arguments, env=env, standalone_mode=False)  # type: ignore[arg-type]
    assert found.exception is None, found.exception
    return found


@pytest.mark.parametrize('kind', BAD)
def test_a_bad_part_affects_no_other_robot(home: Path, kind: str) -> None:
    """``query``, ``lake coverage`` and ``known`` answer with the rest, name the part, and say that there is one."""
    source = Bucket(folder_store(home), catalog.BUCKET)
    before = known('thor', '/imu', NOON_NS, END_NS, source=source)
    assert [gap.count for gap in before.gaps] == [5]
    key = bad_parts.put(folder_store(home), BAD[kind](), of=GAPS)
    findings = Findings(lambda _: None)
    assert known('thor', '/imu', NOON_NS, END_NS, source=source, findings=findings) == before
    assert [one.key for one in findings] == [key]
    found = run(query, home, 'SELECT cause FROM gaps', '--json')
    assert (json.loads(found.stdout), found.return_value) == ([{'cause': 'transport'}], 1)
    assert f'{key} is skipped: ' in found.stderr
    times = '--since', '2026-10-28T12:00', '--until', '2026-10-28T13:00'
    found = run(lake_command, home, 'coverage', *times, '--json')
    assert (json.loads(found.stdout)[0]['hours'][0]['seconds'], found.return_value) == ({'stored': 3540.0, 'transport': 60.0}, 1)


def test_ingest_leaves_it_alone(home: Path) -> None:
    """The others are merged; it stays as it is."""
    tell(folder_store(home), home, lost('2', 700, 701), name='b')
    key = bad_parts.put(folder_store(home), BAD['a text for a number'](), of=GAPS)
    source = Bucket(folder_store(home), catalog.BUCKET)
    before = known('thor', '/imu', NOON_NS, END_NS, source=source, findings=Findings(lambda _: None))
    found = run(lake_command, home, 'ingest', '--delete-after', '0s')
    assert (found.return_value, f'{key} is skipped: ' in found.stderr) == (1, True)
    assert key in [entry.key for entry in source.list('thor/_gaps/')]
    assert known('thor', '/imu', NOON_NS, END_NS, source=source, findings=Findings(lambda _: None)) == before


def test_no_robot_speaks_for_another(home: Path) -> None:
    """Statements of tachi with the names of thor's change nothing that thor told."""
    source = Bucket(folder_store(home), catalog.BUCKET)
    before = known('thor', '/imu', NOON_NS, END_NS, source=source)
    theirs = [
        {**lost('1', 600, 660, 99, 'withdrawn'), 'robot': 'tachi'},
        {**mark(3600, 99, grade='received-only'), 'robot': 'tachi'},
    ]
    bad_parts.put(folder_store(home), parts.encode(theirs, GAPS), 'tachi_x', 'tachi', GAPS)
    assert known('thor', '/imu', NOON_NS, END_NS, source=source) == before
    assert len(known('tachi', '/imu', NOON_NS, END_NS, source=source).gaps) == 0


def test_texts_of_robots_are_shown_harmless(home: Path, tmp_path: Path) -> None:
    """Names and causes with control characters and formulas, on a terminal and in a picture."""
    rows = [
        {**mark(3600), 'topic': '/\x1b[31m$\\frac{$'},
        {**lost('9', 5, 6, cause='\x1b]0;x\x07$_$'), 'topic': '/\x1b[31m$\\frac{$'},
    ]
    bad_parts.put(folder_store(home), parts.encode(rows, GAPS), of=GAPS)
    times = '--since', '2026-10-28T12:00', '--until', '2026-10-28T13:00'
    found = run(lake_command, home, 'coverage', *times, '--chart', str(tmp_path / 'coverage.png'))
    assert '\x1b' not in found.stdout
    assert (tmp_path / 'coverage.png').stat().st_size > 1000


NUMBERS = st.none() | st.integers(-(1 << 63), MOST) | st.integers(NOON_NS, END_NS)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.fixed_dictionaries({
    'what': st.sampled_from(['gap', 'complete', 'withdrawn']), 'from_ns': NUMBERS, 'to_ns': NUMBERS, 'count': NUMBERS,
    'skipped': st.none() | st.integers(0, MOST), 'grade': st.none() | st.text(max_size=3) | st.just('exact'),
    'cause': st.none() | st.text(max_size=3), 'kind': st.none(), 'clock': st.none() | st.just('unset'),
}), max_size=6))  # fmt: skip
def test_hostile_rows_partition_time(given_: list[dict[str, Any]]) -> None:
    """Any times and counts give stretches that fill the time, one after the other."""
    rows = [{**ROWS[0], **row, 'id': str(number)} for number, row in enumerate(given_)]
    found = of_rows('thor', 'objects', '/imu', NOON_NS, END_NS, rows)
    assert [each.begin_ns for each in found.stretches] == [NOON_NS, *(each.end_ns for each in found.stretches[:-1])]
    assert found.stretches[-1].end_ns == END_NS
    assert all(each.begin_ns < each.end_ns for each in found.stretches)


def test_extremes_that_are_sane_are_answered(tmp_path: Path) -> None:
    """Times at the ends of 64 bits, in a part that is otherwise sound."""
    rows = [
        {**mark(3600), 'from_ns': -MOST, 'to_ns': MOST},
        {**lost('9', 5, 6), 'from_ns': -MOST, 'to_ns': NOON_NS + 1, 'count': MOST},
    ]
    bad_parts.put(folder_store(tmp_path), parts.encode(rows, GAPS), of=GAPS)
    source = Bucket(folder_store(tmp_path), catalog.BUCKET)
    (found,) = coverage(NOON_NS, END_NS, source=source)
    assert [(each.causes, each.grade) for each in found.known.stretches] == [(('transport',), 'exact'), ((), 'exact')]
    assert len(lake.sql('SELECT * FROM gaps', source).to_pylist()) == 1
