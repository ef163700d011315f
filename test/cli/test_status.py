"""``shadowhound-data status`` on status files made here: what it prints, how wide, its exit codes, and the live view.

A status file that is damaged, foreign or hostile is an error that names it, or unknown figures: never a traceback.
"""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, Union, get_args, get_origin, get_type_hints

import pytest
from click.testing import CliRunner, Result
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console
from spool.making import make, new_spool, put

from shadowhound_data_logger.cli.common import ExitCode
from shadowhound_data_logger.cli.main import cli, main
from shadowhound_data_logger.cli.output import print_page
from shadowhound_data_logger.cli.status import Page, status, view
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.status import NodeStatus
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.spool.status import RUNNING, NodeReport, file

ERROR = 'Tower at http://192.168.10.20:9000 refused the connection (is it on, and the WiFi up? it is tried again until it works)'


def a_topic(**figures: Any) -> dict[str, Any]:
    row = {
        'sensor': 'imu', 'type': 'x/msg/Y', 'enabled': True, 'publishers': 1, 'matched': 1, 'may_be_silent': False,
        'unavailable': '', 'rate_hz': 99.84, 'age_s': 0.02, 'size': 324, 'received': 1200,
        'stored': 1100, 'skipped': 0, 'rejected': 0, 'dropped': 0, 'paused': 0, 'missed': 0, 'open': 100, 'accounting': 'exact',
        'missed_estimated': None, 'wrong_type': 0, 'other_types': {}, 'missed_by': {}, 'gaps': 0,
        'by_arrival': {}, 'corrected': {}, 'stamps': None,
    }  # fmt: skip
    return row | figures


def a_status(**changes: Any) -> dict[str, Any]:
    """A status as the node writes it, with changes; mappings are merged."""
    found: dict[str, Any] = {
        'robot': 'thor', 'version': '0.1.0', 'pid': 12345, 'boot_id': 'b', 'boot_ns': 0, 'time': '2026-11-21T06:39:05.123Z',
        'uptime_s': 7412.3, 'paused': False, 'ended': False, 'middleware': {'undiscovered': None},
        'topics': {'/camera/camera_info': a_topic(received=1_234_567), '/imu': a_topic()},
        'queue': {'batches': 1, 'messages': 12_345, 'bytes': 1_234_567, 'max_messages': 50_000, 'max_bytes': 67_108_864},
        'spool': {'path': '/home/go2/.shadowhound/spool', 'pending': 3, 'held': 0, 'quarantined': 0, 'bytes': 123_456_789,
                  'max_bytes': 21_474_836_480, 'free_bytes': 50_000_000_000, 'oldest_age_s': 725.0},
        'store': {'target': 'the S3 server at http://192.168.10.20:9000', 'state': 'shipping', 'last_error': '',
                  'delivered': 1234, 'in_flight': 0, 'deferred': 0, 'retries': 0, 'quarantined': 0, 'blocked_buckets': {},
                  'waits_for': {},
                  'mbps': 1.23, 'max_mbps': 8.0},
        'workers': {'intake': {'failing': False, 'failures': 0, 'last_error': '', 'busy_s': 0.0}}, 'stalls': {},
    }  # fmt: skip
    for name, value in changes.items():
        found[name] = found.get(name, {}) | value if isinstance(value, dict) and name != 'topics' else value
    return found


def shown(width: int = 80, *, terminal: bool = True, encoding: str = 'utf-8', state: str = RUNNING, age_s: float = 0.5,
          findings: tuple[str, ...] = (), **changes: Any) -> str:  # fmt: skip
    """The view of a running node."""
    output = io.TextIOWrapper(io.BytesIO(), encoding)
    console = Console(file=output, width=width, highlight=False, force_terminal=terminal, color_system=None)
    node = parse(NodeStatus, a_status(**changes))
    report = NodeReport(node.robot, state, age_s, node, node.spool, findings=findings)
    print_page(*view(Page(report), console), console=console)
    output.flush()
    output.seek(0)
    return output.read()


def write(root: Path, **changes: Any) -> None:
    """Write a current status."""
    clock = SystemClock.of_this_machine()
    root.mkdir(exist_ok=True)
    given = a_status(boot_id=clock.boot_id, boot_ns=clock.boot_ns(), **changes)
    file(root, given['robot']).write_text(json.dumps(given))


def run(spool: Path, *arguments: str, **environ: str | None) -> Result:
    return CliRunner(env={'SHADOWHOUND_ROBOT': None, **environ}).invoke(
        status, ['--spool', str(spool), *arguments], standalone_mode=False
    )


def line(text: str, start: str) -> str:
    return next(each.rstrip() for each in text.splitlines() if each.startswith(start))


def test_status_fits_into_80_columns() -> None:
    """For a working robot no line is longer or wrapped."""
    text = shown()
    assert max(len(each.rstrip()) for each in text.splitlines()) <= 80
    assert line(text, 'thor') == 'thor  running for 2 h 3 min, process 12345, version 0.1.0'
    assert line(text, '/camera').split() == ['/camera/camera_info', '99.8', '0.0', 's', '1,234,567', '1,100', '0']
    assert line(text, 'queue') == 'queue  ██░░░░░░░░  12,345 of 50,000 messages, 1.2 MB'
    assert line(text, 'spool') == 'spool  █░░░░░░░░░  123.5 MB of 21.5 GB, the disk has 50.0 GB free'
    assert line(text, 'store') == 'store  shipping    the S3 server at http://192.168.10.20:9000'
    assert '3 objects wait (oldest 12 min 5 s)' in text
    assert '1,234 delivered, 1.2 of 8 Mbit/s' in text
    assert text.rstrip().splitlines()[-1].startswith('Fine')


def test_without_a_message_it_names_the_command_that_finds_out_why() -> None:
    """The verdict is not OK."""
    text = shown(topics={})
    assert 'doctor --only ros' in text
    assert 'Fine' not in text


def test_status_shows_the_recording() -> None:
    """The bag, its size, and its error if there is one; no line while nothing is recorded."""
    bag = {'recording': True, 'paused': False, 'bag': 'patrol_1', 'slice': 3, 'messages': 12_345, 'bytes': 10**7, 'dropped': 0,
           'duration_s': 200.0, 'queue_bytes': 0, 'refused': '', 'topics': {}}  # fmt: skip
    assert 'bag' not in shown(bag={**bag, 'recording': False})
    text = shown(bag=bag)
    assert line(text, 'bag').split() == ['bag', 'records', 'patrol_1', 'for', '3', 'min', '20', 's']
    assert '12,345 messages, 10.0 MB, slice 3' in text
    text = shown(bag={**bag, 'refused': 'no_room', 'dropped': 7})
    assert 'stands still' in line(text, 'bag')
    assert '7 messages dropped' in text


def test_status_shows_events() -> None:
    """The content of the ring and the last trigger; no line while it is off."""
    events = {'enabled': True, 'seconds': 30.2, 'bytes': 10**7, 'max_bytes': 64 << 20, 'bag': '', 'refused': '', 'triggers': 2,
              'written': 1, 'topics': {},
              'last': {'name': 'fall', 'by': 'log_event', 'time': '2026-11-21T12:00:00.5Z', 'bag': 'event_fall'}}  # fmt: skip
    assert 'events' not in shown(events={**events, 'enabled': False})
    text = shown(events=events)
    assert line(text, 'events').split() == ['events', 'ready', 'the', 'last', '30', 's', 'are', 'kept']
    assert '10.0 MB of 67.1 MB of memory, 1 written' in text
    assert 'last: fall by log_event, 2026-11-21 12:00:00 UTC' in text
    assert line(shown(events={**events, 'bag': 'event_fall_1'}), 'events').split() == ['events', 'writes', 'event_fall_1']
    assert 'stands still' in line(shown(events={**events, 'bag': 'event_fall_1', 'refused': 'no_room'}), 'events')


def test_status_shows_the_active_mission() -> None:
    """Its type, start, id and run, in 80 columns; no line without a mission."""
    assert 'mission' not in shown()
    mission = {'mission_id': 'patrol_20261121_063605_1f2e3d4c', 'run_id': None, 'type': 'patrol',
               'started': '2026-11-21T06:36:05.123456Z'}  # fmt: skip
    text = shown(mission=mission)
    assert line(text, 'mission') == 'mission  active      patrol, since 2026-11-21 06:36:05 UTC, 3 min'
    assert mission['mission_id'] in text
    assert 'no MLflow run yet' in text
    assert 'policy' not in text
    assert 'policy go2_patrol@7#0123456789abcdef' in shown(mission={**mission, 'policy': 'go2_patrol@7#0123456789abcdef'})
    text = shown(mission={**mission, 'run_id': 'a' * 32, 'started': '1970-01-01T00:02:00.000000Z'})
    assert f'MLflow run {"a" * 32}' in text
    assert 'patrol, started before the clock was set' in text
    assert max(len(each.rstrip()) for each in text.splitlines()) <= 80


@pytest.mark.parametrize(('isolation', 'text'), [
    ('sandbox', 'tested in a sandbox'), ('limits', 'tested in resource limits alone, without a sandbox'),
    (None, 'tested in an unknown isolation'),
])  # fmt: skip
def test_the_isolation_of_the_active_policy_is_reported(tmp_path: Path, isolation: str | None, text: str) -> None:
    """With and without --json; a damaged state file of policies is a finding, and the rest of the status is shown."""
    name = f'go2_patrol@1#{"a" * 16}'
    folder = PolicyFolder(tmp_path)
    folder.make()
    (folder.versions.path / name).mkdir()
    (folder.path / 'current').symlink_to(Path('versions') / name)
    with folder.state.changing() as state:
        state.verified |= {name: isolation} if isolation else {}
    home = {'SHADOWHOUND_HOME': str(tmp_path)}
    assert json.loads(run(tmp_path, '--json', **home).stdout)['policy'] == {'active': name, 'isolation': isolation}
    assert f'Active policy: {name}, {text}' in ' '.join(run(tmp_path, **home).stdout.split())
    (folder.path / 'state.json').write_text('{')
    found = json.loads(run(tmp_path, '--json', **home).stdout)
    assert found['policy'] == {'active': name, 'isolation': None}
    assert any('state.json is damaged' in finding for finding in found['findings'])


def test_status_estimates_when_requests_finish() -> None:
    """Waiting requests, their bytes, and how long they will take; no line for a node that keeps nothing."""
    asked = {'open': 2, 'bytes': 120_000_000, 'mbps': 3.2, 'left_s': 300}
    assert '2 open, for 120.0 MB, which arrive in 5 min' in shown(requests=asked)
    assert 'arrive' not in shown(requests={**asked, 'left_s': None})
    assert 'requests' not in shown()


@pytest.mark.parametrize('width', [52, 60])
def test_a_narrow_terminal_breaks_no_topic(width: int) -> None:
    """A table that is too wide becomes a list; other text is wrapped between words."""
    topics = {'/tachi/front_camera/image_raw/compressed': a_topic(dropped=1_000)}
    text = shown(width, topics=topics, store={'state': 'store_down', 'last_error': ERROR})
    assert max(map(len, text.splitlines())) <= width
    assert '/tachi/front_camera/image_raw/compressed' in text.split()
    assert ERROR.replace(' ', '') in ''.join(text.split('store  ')[1].split())


def test_a_pipe_gets_every_topic_on_one_line() -> None:
    """Without a terminal the table is as wide as its content."""
    name = '/tachi/a_camera_with_a_long_name/at_the_front/image_raw/compressed'
    text = shown(terminal=False, topics={name: a_topic(received=10**9, stored=10**9)})
    assert line(text, name).split()[-3:] == ['1,000,000,000', '1,000,000,000', '0']


def test_a_terminal_that_knows_only_ascii_gets_ascii() -> None:
    """Bars as well."""
    assert line(shown(encoding='ascii'), 'queue').startswith('queue  ##........  12,345')


def test_losses_have_columns_only_where_there_are_any() -> None:
    """The columns dropped and rejected appear with the first count; unknown values are dashes, never 0."""
    assert not {'dropped', 'rejected'} & set(shown().split('queue')[0].split())
    text = shown(topics={'/imu': a_topic(dropped=5, missed=None)})
    assert 'dropped' in text
    assert 'rejected' not in text.split('queue')[0]
    assert line(text, '/imu').split()[-2:] == ['-', '5']


def test_topics_without_messages_are_one_line() -> None:
    """Topics without a publisher and disabled ones have no row; a topic that was received before keeps its row."""
    gone = a_topic(publishers=0, rate_hz=0.0)
    silent = a_topic(publishers=0, received=0, age_s=None)
    text = shown(topics={'/a': silent, '/b': silent, '/c': gone, '/d': a_topic(enabled=False, rate_hz=0.0),
                         '/e': silent | {'enabled': False}})  # fmt: skip
    assert 'Nobody publishes /a, /b\nOff: /e\n' in text
    assert line(text, '/c').split()[1] == '0.0'
    assert line(text, '/d').split()[1] == 'off'


def test_problems_have_remedies() -> None:
    """The store's last error while it fails, each failing worker, and a paused node."""
    text = shown(store={'state': 'store_down', 'last_error': 'refused (is it on?)'}, paused=True,
                 findings=('the store cannot be reached',),
                 workers={'upload': {'failing': True, 'failures': 12, 'last_error': 'OSError: no space'}})  # fmt: skip
    assert 'refused (is it on?)' in text
    assert line(text, 'upload').split() == ['upload', 'fails', '12', 'times', 'so', 'far:', 'OSError:', 'no', 'space']
    assert 'PAUSED' in text
    assert 'the store cannot be reached' in text
    assert 'Fine' not in text
    assert 'refused' not in shown(store={'state': 'shipping', 'last_error': 'refused (is it on?)'})


@pytest.mark.parametrize(
    ('row', 'words'),
    [
        ({}, None),
        ({'failures': 2, 'last_error': 'SystemExit: 1'}, 'works failed 2 times and was started again, last: SystemExit: 1'),
        ({'busy_s': 75.0}, 'hangs for 1 min 15 s'),
    ],
)
def test_a_thread_that_failed_is_shown(row: dict[str, Any], words: str | None) -> None:
    """A restarted one with the number of failures and the reason, a stuck one with the duration; others have no line."""
    workers = {'intake': {'failing': False, 'failures': 0, 'last_error': '', 'busy_s': 0.0, **row}}
    text = shown(100, workers=workers, stalls={'intake': 'it takes no messages'} if 'busy_s' in row else {})
    shown_as = [' '.join(each.split()[1:]) for each in text.splitlines() if each.startswith('intake')]
    assert shown_as == ([words] if words else [])


def test_hostile_text_is_shown_as_text() -> None:
    """Markup and control characters in names and errors have no effect."""
    text = shown(topics={'/[red]a[/red]\x1b[31m': a_topic()}, findings=('[bold]x\r\x07\u202e',),
                 store={'state': 'paused', 'target': '[link=x]y', 'last_error': 'a[/]\nb'})  # fmt: skip
    for each in ('/[red]a[/red]?[31m', '[bold]x???', '[link=x]y', 'a[/]?b'):
        assert each in text
    assert not {'\x1b', '\r', '\x07', '\u202e'} & set(text)


def test_the_status_of_a_hung_node_shows_its_age() -> None:
    """Its age, and its last values."""
    text = shown(state='not_answering', age_s=80.0, findings=('the node has written no status',))
    assert line(text, 'thor') == 'thor  NOT ANSWERING for 1 min 20 s, process 12345, version 0.1.0'
    assert line(text, '/imu')
    assert 'the node has written no status' in text


def test_exit_codes_and_json_have_the_verdict(tmp_path: Path) -> None:
    """0 for a working node, 1 with a finding; --json has the content of the file and the verdict."""
    write(tmp_path)
    text, as_json = run(tmp_path), run(tmp_path, '--json')
    assert (text.return_value, as_json.return_value) == (0, 0)
    assert 'thor  running' in text.stdout
    found = json.loads(as_json.stdout)
    assert (found['running'], found['state'], found['findings']) == (True, 'running', [])
    assert found['topics'] == a_status()['topics']
    write(tmp_path, topics={'/imu': a_topic(missed=1)})
    assert (run(tmp_path).return_value, run(tmp_path, '--json').return_value) == (1, 1)


def test_without_a_node_the_spool_is_shown(tmp_path: Path) -> None:
    """Exit code 1, what is pending, and when the node last ran; none of the node's old values."""
    spool = new_spool(tmp_path / 'spool')
    spool.open()
    put(spool, make('a', b'12345'))
    spool.close()
    result = run(tmp_path / 'spool', '--robot', 'thor')
    assert result.return_value == 1
    assert 'thor  not running; last session 2025-10-18 12:00:00 to 2025-10-18 12:00:00 UTC' in result.stdout
    assert '1 objects wait' in result.stdout
    assert 'queue' not in result.stdout
    none = run(tmp_path / 'none')
    assert none.return_value == 1
    assert 'SHADOWHOUND_HOME' in none.stdout


def test_status_shows_the_robot_whose_node_runs(tmp_path: Path) -> None:
    """The running one, unless option or environment name another; other running ones are listed, or all if none runs."""
    write(tmp_path, robot='rex', ended=True)
    write(tmp_path, robot='tachi')
    write(tmp_path, robot='thor')
    text = run(tmp_path).stdout
    assert text.startswith('tachi  running')
    assert 'Also running here: thor' in text
    assert run(tmp_path, '--robot', 'rex').stdout.startswith('rex  not running')
    assert run(tmp_path, SHADOWHOUND_ROBOT='thor').stdout.startswith('thor  running')
    for robot in ('tachi', 'thor'):
        write(tmp_path, robot=robot, ended=True)
    assert 'Not running either: tachi, thor' in run(tmp_path).stdout


@pytest.mark.parametrize('arguments', [['--robot', '../x'], ['--interval', '0'], ['--nonsense']])
def test_bad_usage_is_exit_code_2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    """An invalid name, an interval of zero, and an unknown option."""
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'status', '--spool', str(tmp_path), *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('as_json', [False, True])
def test_watch_runs_until_ctrl_c(tmp_path: Path, as_json: bool) -> None:
    """Into a pipe: one status after the other, with --json one per line; Ctrl-C ends it with exit code 0."""
    write(tmp_path)
    command = [sys.executable, '-u', '-m', 'shadowhound_data_logger.cli.main', 'status', '--watch', '--interval', '0.05']
    options = ['--spool', str(tmp_path), *(['--json'] if as_json else [])]
    with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        heads = [json.loads(each)['robot'] if as_json else each for each in read_heads(process, 3, as_json)]
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert error == ''
    assert all(each.startswith('thor') for each in heads)


def read_heads(process: subprocess.Popen[str], count: int, as_json: bool) -> list[str]:
    """The first line of each of ``count`` updates."""
    assert process.stdout is not None
    heads: list[str] = []
    for each in process.stdout:
        if each.startswith('{' if as_json else 'thor'):
            heads.append(each)
        if len(heads) == count:
            break
    return heads


@pytest.mark.long('a process of its own')
def test_watch_restores_the_terminal(tmp_path: Path) -> None:
    """It uses the alternate screen, and the last view remains on the normal one; exit code 0."""
    write(tmp_path)
    ours, theirs = os.openpty()
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'status', '--watch', '--interval', '0.05']
    environ = {**os.environ, 'TERM': 'xterm', 'COLUMNS': '80', 'LINES': '30'}
    with subprocess.Popen(
        [*command, '--spool', str(tmp_path)], stdin=theirs, stdout=theirs, stderr=theirs, env=environ
    ) as process:
        os.close(theirs)
        text, deadline = '', time.monotonic() + 60
        while text.count('thor') < 2:
            assert time.monotonic() < deadline
            text += os.read(ours, 65536).decode(errors='replace')
        process.send_signal(signal.SIGINT)
        try:
            while part := os.read(ours, 65536):
                text += part.decode(errors='replace')
        except OSError:  # Linux: the other side is closed
            pass
    os.close(ours)
    assert process.returncode == 0
    assert text.index('\x1b[?1049h') < text.index('\x1b[?1049l')
    assert 'thor' in text.partition('\x1b[?1049l')[2]
    assert text.count('\x1b[?25h') >= text.count('\x1b[?25l') > 0


def test_a_topic_that_other_nodes_receive_is_not_called_silent() -> None:
    """The finding names its publishers."""
    row = a_topic(publishers=0, received=0)
    undiscovered = {'/imu': {'text': '/imu is not all heard'}}
    text = shown(topics={'/imu': row}, middleware={'undiscovered': undiscovered}, findings=['/imu is not all heard'])
    assert '/imu is not all heard' in text
    assert 'Nobody publishes' not in text
    assert 'Nobody publishes /imu' in shown(topics={'/imu': row})


NUMBERS = st.integers() | st.floats() | st.sampled_from([0, -1, 2**63, 10**300, 1e308, -1e308, float('inf'), float('nan')])
TEXTS = st.text(max_size=12) | st.sampled_from(
    ['\ud800', '\x1b[2J', '2026-11-20', '2026-11-20T12:00:00', '2026-11-20T12:00:00Z', '[red]']
)
ANY = st.recursive(st.none() | st.booleans() | NUMBERS | TEXTS, lambda inner: st.lists(inner, max_size=2)
                   | st.dictionaries(TEXTS, inner, max_size=2), max_leaves=4)  # fmt: skip


def of_type(hint: Any) -> st.SearchStrategy[Any]:
    """Values of a field's type, including extreme ones, and sometimes a value of another type."""
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


def shown_status(home: Path, *arguments: str, columns: int = 80) -> str:
    """The output; an unknown exit code or a traceback fails."""
    ran = CliRunner(env={'SHADOWHOUND_HOME': str(home), 'COLUMNS': str(columns)}).invoke(
        cli, arguments, standalone_mode=False, catch_exceptions=False
    )
    assert ran.return_value in {ExitCode.FINE, ExitCode.FINDING}
    return ran.output


def write_status(home: Path, status: object) -> None:
    (home / 'spool').mkdir(exist_ok=True)
    file(home / 'spool', 'thor').write_bytes(json.dumps(status).encode())


def running() -> dict[str, Any]:
    clock = SystemClock.of_this_machine()
    return {'robot': 'thor', 'pid': os.getpid(), 'boot_id': clock.boot_id, 'boot_ns': clock.boot_ns(), 'version': '1'}


FUZZ: Final = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None)


@FUZZ
@given(status=of_dataclass(NodeStatus))
def test_any_values_of_a_running_node_are_shown(tmp_path: Path, status: dict[str, Any]) -> None:
    """All fields have valid types but unusual values."""
    write_status(tmp_path, {**status, **running()})
    assert 'thor' in shown_status(tmp_path, 'status')
    document = json.loads(shown_status(tmp_path, 'status', '--json'))
    assert document['robot'] == 'thor'


@FUZZ
@given(document=ANY | st.dictionaries(st.sampled_from([*get_type_hints(NodeStatus), 'x']), ANY, max_size=4))
def test_any_json_document_is_shown_or_an_error(tmp_path: Path, document: Any) -> None:
    """Any JSON document as the status file."""
    write_status(tmp_path, {**document, **running()} if isinstance(document, dict) else document)
    assert 'thor' in shown_status(tmp_path, 'status')


@pytest.mark.parametrize(
    'content', [b'', b'{', b'\xff\xfe', b'[' * 100_000, b'{"uptime_s": 1e999}', b'{"pid": NaN}', b'9' * 5000], ids=range(7)
)
def test_a_file_that_is_not_json_is_an_error(tmp_path: Path, content: bytes) -> None:
    """The error names the file."""
    write_status(tmp_path, {})
    file(tmp_path / 'spool', 'thor').write_bytes(content)
    assert 'status-thor.json cannot be read' in ' '.join(shown_status(tmp_path, 'status', columns=200).split())


@pytest.mark.parametrize('started', ['', 'yesterday', '9999-99-99T00:00:00Z', '2026-11-20T12:00:00+25:00', 'Z'])
def test_a_mission_with_an_invalid_start_is_shown(tmp_path: Path, started: str) -> None:
    """Its start is unknown."""
    write_status(
        tmp_path,
        {**running(), 'time': '2026-11-20T12:00:05Z', 'mission': {'mission_id': 'm1', 'type': 'patrol', 'started': started}},
    )
    assert 'patrol, since an unknown time' in ' '.join(shown_status(tmp_path, 'status').split())


def test_the_program_ends_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Even if a value is out of range."""
    write_status(tmp_path, {**running(), 'uptime_s': 1e308, 'queue': {'messages': 10**30, 'max_messages': 1}})
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'status'])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in {ExitCode.FINE, ExitCode.FINDING}
    assert 'Traceback' not in ''.join(capsys.readouterr())
