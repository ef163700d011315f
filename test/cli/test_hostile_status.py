"""A status file that is damaged, foreign or hostile is an error that names it, or unknown figures: never a traceback."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, Union, get_args, get_origin, get_type_hints

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shadowhound_data_logger.cli.common import ExitCode
from shadowhound_data_logger.cli.main import cli, main
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.status import NodeStatus
from shadowhound_data_logger.spool.status import file

NUMBERS = st.integers() | st.floats() | st.sampled_from([0, -1, 2**63, 10**300, 1e308, -1e308, float('inf'), float('nan')])
TEXTS = st.text(max_size=12) | st.sampled_from(
    ['\ud800', '\x1b[2J', '2026-11-20', '2026-11-20T12:00:00', '2026-11-20T12:00:00Z', '[red]']
)
ANY = st.recursive(st.none() | st.booleans() | NUMBERS | TEXTS, lambda inner: st.lists(inner, max_size=2)
                   | st.dictionaries(TEXTS, inner, max_size=2), max_leaves=4)  # fmt: skip


def of_type(hint: Any) -> st.SearchStrategy[Any]:
    """Values that a field takes, extreme ones among them, and now and then another one."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in {Union, UnionType}:
        (kind,) = (each for each in arguments if each is not NoneType)
        return st.none() | of_type(kind)
    if is_dataclass(hint):
        return of_dataclass(hint)
    if origin is tuple:
        return st.lists(of_type(arguments[0]), max_size=2)
    if origin is not None:
        return st.dictionaries(TEXTS, of_type(arguments[1]), max_size=2)
    return {str: TEXTS, bool: st.booleans(), int: st.integers(), float: NUMBERS}[hint]


def of_dataclass(kind: Any) -> st.SearchStrategy[dict[str, Any]]:
    hints = get_type_hints(kind)
    return st.fixed_dictionaries({}, optional={name: of_type(hint) for name, hint in hints.items()})


def shown(home: Path, *arguments: str, columns: int = 80) -> str:
    """What the verb prints; an exit code that is not in the table, or a traceback, fails."""
    ran = CliRunner(env={'SHADOWHOUND_HOME': str(home), 'COLUMNS': str(columns)}).invoke(
        cli, arguments, standalone_mode=False, catch_exceptions=False
    )
    assert ran.return_value in {ExitCode.FINE, ExitCode.FINDING}
    return ran.output


def write(home: Path, status: object) -> None:
    (home / 'spool').mkdir(exist_ok=True)
    file(home / 'spool', 'thor').write_bytes(json.dumps(status).encode())


def running() -> dict[str, Any]:
    clock = SystemClock.of_this_machine()
    return {'robot': 'thor', 'pid': os.getpid(), 'boot_id': clock.boot_id, 'boot_ns': clock.boot_ns(), 'version': '1'}


FUZZ: Final = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None)


@FUZZ
@given(status=of_dataclass(NodeStatus))
def test_any_figures_of_a_running_node(tmp_path: Path, status: dict[str, Any]) -> None:
    """All fields have the types that they should have, and values that nobody would write."""
    write(tmp_path, {**status, **running()})
    assert 'thor' in shown(tmp_path, 'status')
    document = json.loads(shown(tmp_path, 'status', '--json'))
    assert document['robot'] == 'thor'


@FUZZ
@given(document=ANY | st.dictionaries(st.sampled_from([*get_type_hints(NodeStatus), 'x']), ANY, max_size=4))
def test_any_document(tmp_path: Path, document: Any) -> None:
    """The file is JSON, and nothing else of it is as it should be."""
    write(tmp_path, {**document, **running()} if isinstance(document, dict) else document)
    assert 'thor' in shown(tmp_path, 'status')


@pytest.mark.parametrize(
    'content', [b'', b'{', b'\xff\xfe', b'[' * 100_000, b'{"uptime_s": 1e999}', b'{"pid": NaN}', b'9' * 5000], ids=range(7)
)
def test_a_file_that_is_no_document(tmp_path: Path, content: bytes) -> None:
    """The error names the file."""
    write(tmp_path, {})
    file(tmp_path / 'spool', 'thor').write_bytes(content)
    assert 'status-thor.json cannot be read' in ' '.join(shown(tmp_path, 'status', columns=200).split())


@pytest.mark.parametrize('started', ['', 'yesterday', '9999-99-99T00:00:00Z', '2026-11-20T12:00:00+25:00', 'Z'])
def test_a_mission_with_an_invalid_start(tmp_path: Path, started: str) -> None:
    """It is shown, and its start is unknown."""
    write(
        tmp_path,
        {**running(), 'time': '2026-11-20T12:00:05Z', 'mission': {'mission_id': 'm1', 'type': 'patrol', 'started': started}},
    )
    assert 'patrol, since an unknown time' in ' '.join(shown(tmp_path, 'status').split())


def test_the_program_ends_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where a figure is out of any range."""
    write(tmp_path, {**running(), 'uptime_s': 1e308, 'queue': {'messages': 10**30, 'max_messages': 1}})
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'status'])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in {ExitCode.FINE, ExitCode.FINDING}
    assert 'Traceback' not in ''.join(capsys.readouterr())
