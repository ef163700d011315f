"""Every verb helps with an example, every error says what to do, and every verb ends with an exit code of the table.

Completion works in a real bash, with the file that the package installs and with click's own line.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import pty
import re
import select
import shlex
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from spool.making import new_spool
from spool.test_status import written

import shadowhound_data_logger
from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.cli import main as main_module
from shadowhound_data_logger.cli.common import BadUsage, ExitCode, the_robot
from shadowhound_data_logger.cli.main import PROGRAM, SECTIONS, cli, described, main, verb_of
from shadowhound_data_logger.core.errors import BagError, DataLoggerError, PolicyRefused, SettingError, UnknownName
from shadowhound_data_logger.doctor.context import make


def verbs(command: click.Command = cli, path: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """All commands with their full names, subcommands included."""
    yield ' '.join(path), command
    if isinstance(command, click.Group):
        for name, each in command.commands.items():
            yield from verbs(each, (*path, name))


VERBS = dict(verbs())
LEAVES = {name: verb for name, verb in VERBS.items() if name and not isinstance(verb, click.Group)}


def help_of(name: str, width: int = 80) -> str:
    verb = VERBS[name]
    return verb.get_help(
        click.Context(verb, info_name=f'{PROGRAM} {name}'.strip(), max_content_width=width, terminal_width=width)
    )


def examples_of(name: str) -> list[str]:
    """The examples in the help, which are one line each even in a narrow terminal."""
    return re.findall(rf'^ +({PROGRAM} .*)$', help_of(name, 40).partition('Examples:')[2], re.MULTILINE)


def parsed(arguments: Sequence[str]) -> tuple[click.Command, click.Context]:
    """The verb of a command line, after checking that its options exist and are valid, and that none is missing."""
    command, context, rest = cli, click.Context(cli, info_name=PROGRAM), list(arguments)
    while True:
        given, rest, order = command.make_parser(context).parse_args(args=rest)
        for option in (each for each in command.params if isinstance(each, click.Option)):
            assert option.name is not None
            if option in order:
                option.type_cast_value(context, given[option.name])
            assert option in order or not option.required, f'{option.name} is missing'
        for argument in (each for each in command.params if isinstance(each, click.Argument)):
            value = given.get(argument.name or '')
            assert (isinstance(value, (str, tuple)) and value) or not argument.required, f'{argument.name} is missing'
        if not isinstance(command, click.Group) or not rest:
            return command, context
        name, command, rest = command.resolve_command(context, rest)
        assert command is not None
        context = click.Context(command, parent=context, info_name=name)


@pytest.mark.parametrize('name', VERBS)
def test_every_verb_has_examples_that_parse(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each example calls this verb or a subcommand, and no option in it is unknown, missing or without its value."""
    monkeypatch.chdir(tmp_path)
    for folder in ('packed', 'outputs/go2_patrol', 'clip-vit-base-patch32', 'usb', 'examples'):  # which some examples read
        (tmp_path / folder).mkdir(parents=True)
    for file in ('bumps.json', 'sample.npz', 'door.jpg', 'root.json', 'alice.key', 'alice.pub', 'bob.pub', 'usb/root.key',
                     'examples/export_base.yaml'):  # fmt: skip
        (tmp_path / file).write_text('[]')
    found = examples_of(name)
    assert found
    for example in found:
        program, *arguments = shlex.split(example)
        assert program == PROGRAM
        assert ' '.join(verb_of(arguments)).startswith(name)
        if '--help' not in arguments:
            command, context = parsed(arguments)
            context.close()
            assert not isinstance(command, click.Group) or getattr(command, 'invoke_without_command', False)


def test_an_example_with_a_wrong_option_would_be_found() -> None:
    """``parsed`` rejects wrong command lines."""
    for wrong in ('bag fetch x', 'bag fetch --to y', 'bag list --sinc yesterday', 'missions export x --format xml', 'bag lst'):
        with pytest.raises((click.UsageError, AssertionError)):
            parsed(wrong.split())


def test_the_verbs_are_in_sections() -> None:
    """Each verb is in one section with its own help, and no line is cut."""
    listed = [verb for section in SECTIONS.values() for verb in section]
    assert sorted(verb.name for verb in listed) == sorted(cli.commands)
    assert [verb.load().get_short_help_str(1000) for verb in listed] == [verb.help for verb in listed]
    text = help_of('')
    for title in SECTIONS:
        assert f'\n{title}:\n' in text
    for name in (name for name, verb in VERBS.items() if isinstance(verb, click.Group)):
        assert '...' not in help_of(name).partition('Options:')[2]


def test_every_verb_ends_with_a_code_of_the_table() -> None:
    """Each is annotated with ExitCode, which mypy checks."""
    for name, verb in LEAVES.items():
        assert verb.callback is not None
        assert verb.callback.__annotations__['return'] in {'ExitCode', 'Any'}, name  # ``question`` wraps another function
        inner = getattr(verb.callback, '__wrapped__', verb.callback)
        assert inner.__annotations__['return'] == 'ExitCode', name


def test_every_verb_answers_in_json() -> None:
    """Each has --json, for programs."""
    assert [name for name, verb in LEAVES.items() if not any('--json' in option.opts for option in verb.params)] == []


# -- errors ------------------------------------------------------------------------------------------------------------


def classes(base: type[Exception] = DataLoggerError) -> Iterator[type[Exception]]:
    """All public error classes."""
    for each in pkgutil.walk_packages(shadowhound_data_logger.__path__, 'shadowhound_data_logger.'):
        if each.name.rpartition('.')[2] not in {'main', '__main__'} and '.capture.' not in each.name:
            importlib.import_module(each.name)
    pending = [base]
    while pending:
        pending += (one := pending.pop()).__subclasses__()
        if not one.__name__.startswith('_'):
            yield one


def ended(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, list[str]]:
    """Exit code and lines on standard error of the program."""
    monkeypatch.setattr(sys, 'argv', [PROGRAM, *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0), capsys.readouterr().err.splitlines()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ('AWS_ENDPOINT_URL', 'SHADOWHOUND_ROBOT'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.setenv('COLUMNS', '150')
    return tmp_path


def made(kind: type[Exception]) -> Exception:
    if issubclass(kind, SettingError):
        return kind('camera.rate_hz', 'fast', 'a number')
    return kind('reason', 'it went wrong in /here') if issubclass(kind, PolicyRefused) else kind('it went wrong in /here')


def test_every_class_of_errors_has_a_remedy(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors have two lines: verb and message, then the remedy; commands in remedies exist."""
    kinds = [*classes(), OSError, PermissionError, sqlite3.OperationalError, sqlite3.DatabaseError]
    assert len(kinds) > 25
    for kind in kinds:

        def fail(*_: object, kind: type[Exception] = kind, **__: object) -> None:
            raise made(kind)

        with monkeypatch.context() as patched:
            patched.setattr(main_module.cli.commands['bag'].commands['list'], 'callback', fail)  # type: ignore[attr-defined]
            code, (what, remedy) = ended(patched, capsys, 'bag', 'list')
        assert code == (ExitCode.USAGE if issubclass(kind, (SettingError, UnknownName)) else ExitCode.FINDING), kind
        assert what.startswith(f'{PROGRAM} bag list: '), kind
        assert ('camera.rate_hz' if issubclass(kind, SettingError) else 'it went wrong in /here') in what, kind
        assert re.fullmatch(r'  -> \S.{10,}', remedy), kind
        for command in re.findall(rf'{PROGRAM} ([a-z]+(?: [a-z]+)?)', remedy):
            assert command in VERBS or command.split()[0] in VERBS, remedy


def test_a_specific_remedy_takes_precedence() -> None:
    """The remedy of the class is only the default."""
    error = BagError('no bag x', remedy='look again')
    assert described(error, ['bag', 'info', 'x']) == (f'{PROGRAM} bag info', 'no bag x', 'look again')
    missing = FileNotFoundError(2, 'No such file or directory', '/nowhere')
    assert described(missing, ['spool', '--spool', 'x', 'list'])[:2] == (
        f'{PROGRAM} spool list', '/nowhere: No such file or directory',
    )  # fmt: skip


@pytest.mark.parametrize(('arguments', 'code', 'what', 'remedy'), [
    (['nope'], ExitCode.USAGE, "No such command 'nope'", f'{PROGRAM} --help'),
    (['bag', 'fetch'], ExitCode.USAGE, 'Missing argument', f'{PROGRAM} bag fetch --help'),
    (['bag', 'list', '--sinc', 'now'], ExitCode.USAGE, 'No such option', f'{PROGRAM} bag list --help'),
    (['bag', 'list', '--since', 'soon'], ExitCode.USAGE, "--since = 'soon' is refused", 'allowed is now, today'),
    (['bag', 'list', '--robot', '../x'], ExitCode.USAGE, 'the robot name', 'letters'),
    (['bag', 'info', './none'], ExitCode.USAGE, 'there is no folder ./none', f'{PROGRAM} bag list'),
    (['bag', 'info', 'none', '--robot', 'thor'], ExitCode.USAGE, 'none', '--robot'),
    (['missions', 'show', 'x'], ExitCode.USAGE, "there is no mission or run with the id 'x'", f'{PROGRAM} missions list'),
    (['ledger', '--topic', '/imu'], ExitCode.USAGE, 'choose among gaps', '--gaps'),
    (['ledger', '--since', 'now', '--gaps', '--until', 'x'], ExitCode.USAGE, "--until = 'x' is refused", 'allowed is now'),
    (['status', '--interval', '0'], ExitCode.USAGE, 'Invalid value', f'{PROGRAM} status --help'),
    (['spool', 'list'], ExitCode.FINDING, 'there is no spool in', 'SHADOWHOUND_HOME'),
    (['node', 'flush'], ExitCode.FINDING, 'no node', ''),
    (['fetch', '--to', '/x'], ExitCode.USAGE, 'a prefix or flags', f'{PROGRAM} fetch'),
    (['query', '--since', 'soon'], ExitCode.USAGE, "since = 'soon' is refused", 'allowed is now'),
    (['query', 'SELEKT 1'], ExitCode.USAGE, 'SELEKT', ''),
])  # fmt: skip
def test_an_error_has_a_message_and_a_remedy(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
                                           arguments: list[str], code: ExitCode, what: str, remedy: str) -> None:  # fmt: skip
    """For mistakes that users make: the verb and what is wrong, then the remedy; exit code 2 for wrong usage, otherwise 1."""
    assert home.is_dir()
    found, lines = ended(monkeypatch, capsys, *arguments)
    assert found == code
    assert lines[0].startswith(f'{PROGRAM}{"" if arguments == ["nope"] else " " + arguments[0]}')
    assert what in lines[0]
    assert lines[-1].startswith('  -> ')
    assert remedy in lines[-1]


@pytest.mark.parametrize(('arguments', 'code'), [
    (['query', '--since', 'soon', '--json'], ExitCode.USAGE), (['query', '--json', '--nope'], ExitCode.USAGE),
    (['query', '--since', 'soon', '--format', 'json'], ExitCode.USAGE), (['status', '--json', '--interval', '0'], ExitCode.USAGE),
    (['bag', 'info', 'none', '--json'], ExitCode.USAGE), (['spool', 'list', '--json'], ExitCode.FINDING),
    (['missions', 'show', 'x', '--json'], ExitCode.USAGE),
])  # fmt: skip
def test_an_error_is_json_where_the_answer_would_be(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], code: ExitCode
) -> None:
    """With --json an error is one JSON object on standard error, with the exit code."""
    assert home.is_dir()
    found, lines = ended(monkeypatch, capsys, *arguments)
    assert found == code
    (line,) = lines
    report = json.loads(line)
    assert set(report) == {'error', 'remedy', 'verb', 'exit_code'}
    assert all(report.values())
    assert report['exit_code'] == code
    assert report['verb'].startswith(f'{PROGRAM} {arguments[0]}')


@pytest.mark.parametrize('arguments', [(), ('missions',), ('node', 'bag')])
def test_a_group_without_a_verb_prints_its_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]
) -> None:
    """Not an error with a remedy."""
    code, lines = ended(monkeypatch, capsys, *arguments)
    assert code == ExitCode.USAGE
    assert lines[0].startswith(' '.join(('Usage:', PROGRAM, *arguments)))
    assert lines[-1].startswith('  ')
    assert '->' not in lines[-1]


def test_an_invalid_environment_is_wrong_usage(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As for the node: exit code 2 for an invalid setting."""
    assert home.is_dir()
    monkeypatch.setenv('AWS_ENDPOINT_URL', 'tower:9000')
    code, lines = ended(monkeypatch, capsys, 'bag', 'list')
    assert code == ExitCode.USAGE
    assert "AWS_ENDPOINT_URL = 'tower:9000' is refused" in lines[0]


@pytest.mark.parametrize(('error', 'code'), [(KeyboardInterrupt(), ExitCode.INTERRUPTED), (BadUsage('x', 'y'), ExitCode.USAGE)])
def test_every_kind_of_error_has_its_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: BaseException, code: ExitCode
) -> None:
    """Ctrl-C is 130, as in a shell."""

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(cli.commands['status'], 'callback', fail)
    assert ended(monkeypatch, capsys, 'status')[0] == code


def printing(lines: int, **environ: str) -> list[str]:
    """A command that prints lines with characters that 8-bit encodings, or all encodings, lack."""
    script = (
        'from shadowhound_data_logger.cli import main, output\n'
        'import click\n'
        'def talk(**_):\n'
        f'    for _ in range({lines}):\n'
        '        click.echo("\\u5de1 caf\\xe9 \\ud800")\n'
        '    output.print_page("\\u2588")\n'
        'main.cli.commands["status"].callback = talk\n'
        'main.sys.argv[1:] = ["status"]\n'
        'main.main()\n'
    )
    return ['env', *(f'{name}={value}' for name, value in environ.items()), sys.executable, '-c', script]


@pytest.mark.parametrize('encoding', ['ascii', 'latin-1', 'utf-8:strict'])
def test_output_that_the_terminal_cannot_hold_is_escaped(encoding: str) -> None:
    """Characters that the encoding lacks are escaped; there is no traceback."""
    done = subprocess.run(printing(1, PYTHONIOENCODING=encoding, PYTHONUTF8='0'), capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b'')
    if encoding != 'ascii':  # click takes it for a mistake, and writes UTF-8
        first = done.stdout.splitlines()[0].decode(encoding.partition(':')[0])
        assert first == ('巡 café \\ud800' if 'utf-8' in encoding else '\\u5de1 café \\ud800')


@pytest.mark.parametrize('lines', [1, 100_000])
def test_a_closed_pipe_is_not_an_error(lines: int) -> None:
    """With ``| head`` nothing is printed on standard error, whether the rest was written already or is still buffered."""
    with subprocess.Popen(printing(lines), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b''
        assert process.wait(30) == ExitCode.FINDING


def test_the_help_imports_no_verb() -> None:
    """Each verb is imported when it is called."""
    code = 'import sys; from shadowhound_data_logger.cli.main import cli; cli(["-h"], standalone_mode=False); print(*sys.modules)'
    names = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout.split()
    loaded = {name for name in names if name.startswith('shadowhound_data_logger.cli.')}
    assert loaded == {'shadowhound_data_logger.cli.common', 'shadowhound_data_logger.cli.main'}
    assert not {'rich', 'numpy', 'pyarrow', 'sqlite3.dbapi2', 'mcap'} & {name.partition('.')[0] for name in names}


def test_a_query_of_a_folder_imports_no_s3_client() -> None:
    """The S3 client botocore takes a quarter of the time of a query."""
    code = 'import sys; from shadowhound_data_logger.lake import labels, names, query, values; print(*sys.modules)'
    names = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout.split()
    assert not {'botocore', 'boto3', 'matplotlib', 'pandas'} & {name.partition('.')[0] for name in names}


# -- the robot ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def spool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The spool of a machine without any robot name."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    for name in ('SHADOWHOUND_ROBOT', 'AWS_ENDPOINT_URL'):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / 'spool').mkdir()
    return tmp_path / 'spool'


def test_verbs_use_the_robot_of_this_machine(spool: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The robot whose node has run here; if there are several, an error asks for the name."""
    written(spool, robot='turtle')
    assert the_robot(None) == 'turtle'
    assert cli(['bag', 'list'], standalone_mode=False) == ExitCode.FINE
    assert 'no bag of turtle' in capsys.readouterr().out
    assert make(os.environ).settings.robot == 'turtle'
    with closing(MissionDataLogger(replay=False)) as logger:
        assert logger.robot == 'turtle'
    written(spool, robot='tachi')
    with pytest.raises(BadUsage, match='which robot'):
        the_robot(None)
    assert the_robot('tachi') == 'tachi'
    with pytest.raises(SettingError, match='one of tachi, turtle'):
        MissionDataLogger(replay=False)
    examined = make(os.environ)
    assert (examined.settings.robot, [str(error.data['name']) for error in examined.refused]) == ('tachi', ['SHADOWHOUND_ROBOT'])
    with pytest.raises(BadUsage, match='which robot'):
        cli(['bag', 'list'], standalone_mode=False)


@pytest.mark.parametrize('arguments', [
    ['bag', 'list'], ['bag', 'upload', '.'], ['bag', 'watch', '.'], ['pull', '--sensor', 'camera'],
    ['label', 'add', 'keep', '--since', '1h', '--until', 'now'], ['policy', 'sync', '--name', 'patrol'],
])  # fmt: skip
def test_a_verb_that_finds_no_robot_names_the_folder(
    spool: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Even where the messages of a Go2 are installed, no name is assumed."""
    (spool.parent / 'share/go2_interfaces').mkdir(parents=True)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(spool.parent))
    monkeypatch.chdir(spool)
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    error = ' '.join(capsys.readouterr().err.split())
    assert caught.value.code == ExitCode.USAGE
    assert f'no robot found: no node has run with the spool {spool}' in error
    assert 'add --robot NAME, or set SHADOWHOUND_ROBOT' in error
    assert not list(spool.iterdir())


def test_a_status_without_a_robot_names_none(spool: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing has run, and of a spool that only an agent or an upload has used."""
    (spool.parent / 'share/go2_interfaces').mkdir(parents=True)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(spool.parent))
    answer = CliRunner().invoke(cli, ['status', '--json'], standalone_mode=False)
    assert (json.loads(answer.stdout)['robot'], answer.return_value) == (None, ExitCode.FINDING)
    monkeypatch.setenv('COLUMNS', '300')
    text = ' '.join(CliRunner().invoke(cli, ['status'], standalone_mode=False).stdout.split())
    assert text.startswith('not running; no node has run here yet')
    assert f'there is no spool in {spool}: start the node' in text
    index = new_spool(spool)
    index.open()
    index.close()
    assert 'thor' not in CliRunner().invoke(cli, ['status'], standalone_mode=False).stdout
    answer = CliRunner().invoke(cli, ['ledger'], standalone_mode=False)
    assert 'No message of this spool has been received yet' in answer.stdout
    found = json.loads(CliRunner().invoke(cli, ['ledger', '--json'], standalone_mode=False).stdout)
    assert (found['robot'], found['robots']) == (None, [])


def test_an_agent_without_a_robot_warns(spool: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """A mission never fails because its robot is not named, but it is not named silently."""
    monkeypatch.setattr(socket, 'gethostname', lambda: 'turtle')
    monkeypatch.setenv('AMENT_PREFIX_PATH', '')
    with closing(MissionDataLogger(replay=False)) as logger:
        assert logger.robot == 'turtle'
    assert 'the robot is called turtle' in caplog.text
    caplog.clear()
    with closing(MissionDataLogger(robot='rover', replay=False)):
        assert not caplog.text


FILE = Path(__file__).parents[2] / 'resource/completion/shadowhound-data'
CLICKS = 'eval "$(_SHADOWHOUND_DATA_COMPLETE=bash_source shadowhound-data)"'


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The program of this environment is in PATH, and its home is empty."""
    monkeypatch.setenv('PATH', f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}')
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))


@pytest.mark.usefixtures('shell')
@pytest.mark.parametrize(('how', 'expected'), [
    (f'source {FILE}', {'bag ve': 'verify', 'query --sens': '--sensor', 'query --format ': 'table csv json keys'}),
    (CLICKS, {'node bag st': 'start stop'}),
], ids=['file', 'line'])  # fmt: skip
def test_verbs_options_and_choices_are_completed(how: str, expected: dict[str, str]) -> None:
    """As bash calls the completion function."""
    script = (
        how
        + """
        for line in LINES; do
            COMP_WORDS=(shadowhound-data $line); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
            [ "${line% }" = "$line" ] || { COMP_WORDS+=(''); COMP_CWORD=$((COMP_CWORD + 1)); }
            _shadowhound_data_completion shadowhound-data
            echo "${COMPREPLY[@]}"
        done""".replace('LINES', shlex.join(expected))
    )
    completed = subprocess.run(['bash', '--norc', '-c', script], capture_output=True, text=True, check=True, timeout=250).stdout
    assert completed.splitlines() == list(expected.values())


@pytest.mark.usefixtures('shell')
def test_a_terminal_completes_with_tab() -> None:
    """In an interactive bash."""
    process, terminal = pty.fork()
    if process == 0:
        os.execvp('bash', ['bash', '--norc', '--noprofile', '-i'])  # noqa: S606 - a bash that a person types into
    try:
        os.write(terminal, f'source {FILE}; bind "set enable-bracketed-paste off"\r'.encode())
        os.write(terminal, b'shadowhound-data miss\t')
        seen, deadline = b'', time.monotonic() + 250
        while b'shadowhound-data missions ' not in seen:
            assert time.monotonic() < deadline, seen
            if select.select([terminal], [], [], 1.0)[0]:
                seen += os.read(terminal, 4096)
    finally:
        os.write(terminal, b'\x03exit\r')
        os.close(terminal)
        os.waitpid(process, 0)


@pytest.mark.usefixtures('shell')
def test_verbs_are_completed_without_importing_them() -> None:
    """Otherwise each completion would take as long as the slowest import."""
    code = """import sys, click
from shadowhound_data_logger.cli.main import cli
print(*[each.value for each in cli.shell_complete(click.Context(cli), '')])
print(*(name for name in sys.modules if name.startswith('shadowhound_data_logger.cli.')))"""
    verbs, modules = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert {'doctor', 'policy'} < set(verbs.split())
    assert set(modules.split()) == {'shadowhound_data_logger.cli.common', 'shadowhound_data_logger.cli.main'}
