"""The generated pages agree with the code, and every command in a document, remedy or message exists."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click
from click.testing import CliRunner
from ruamel.yaml import YAML

from docs.pages import (
    ADVANCED,
    DOCS,
    EXAMPLE,
    READERS,
    SECTIONS,
    USUAL,
    VARIABLES,
    commands,
    main,
    parameters,
)
from shadowhound_data_logger.cli.common import MEANINGS, ExitCode
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.config import DEFAULT_SENSORS, Settings, default_parameters
from shadowhound_data_logger.core.options import GROUPS

PACKAGE = Path(__file__).parents[2] / 'shadowhound_data_logger'


def test_the_generated_pages_are_up_to_date() -> None:
    """A change of a setting or a verb needs `make docs`."""
    assert (DOCS / 'parameters.md').read_text(encoding='utf-8') == parameters()
    assert (DOCS / 'commands.md').read_text(encoding='utf-8') == commands()


def test_the_exit_codes_are_in_one_table() -> None:
    """The page and `--help` have each code with its meaning."""
    named = CliRunner().invoke(cli, ['--help']).stdout
    assert set(MEANINGS) == set(ExitCode)
    for code, meaning in MEANINGS.items():
        assert f'| `{code.value}` | {meaning} |' in commands()
        assert re.search(rf'^  {code.value} +{meaning}$', named, re.MULTILINE)


def test_every_parameter_is_on_the_page() -> None:
    """Each parameter that the node declares has a line, or one that all sensors share."""
    rows = set(re.findall(r'^- (`.+?`)', parameters(), re.MULTILINE))
    names = [name.rpartition('.') for name in default_parameters()]
    named = (f'`{"SENSOR" if group in DEFAULT_SENSORS else group}{dot}{field}`' for group, dot, field in names)
    missing = [name for name in named if name not in rows]
    assert len(names) > 100
    assert not missing
    guide = (DOCS / 'thor.md').read_text(encoding='utf-8').partition('## What is stored')[2]
    assert [sensor for sensor in DEFAULT_SENSORS if not re.search(rf'\b{sensor}\b', guide)] == []


def test_each_parameter_is_in_one_section() -> None:
    """Of what a person wants to do, in whatever group its name is."""
    listed = Counter(name for section in (*SECTIONS, ADVANCED) for name in section.names)
    known = {
        f'SENSOR.{name.partition(".")[2]}' if name.partition('.')[0] in DEFAULT_SENSORS else name for name in default_parameters()
    }
    assert listed == Counter(known)


def test_each_verb_has_one_kind_of_reader() -> None:
    """And each variable that most people set is on the page."""
    assert sorted(name for names in READERS.values() for name in names) == sorted(cli.commands)
    assert [name for name in USUAL if f'\n- `{name}`' not in parameters()] == []


def test_the_example_is_a_parameter_file() -> None:
    """What most people set: the node would start with it."""
    given = YAML(typ='safe').load(EXAMPLE)['/**']['ros__parameters']
    flat = {
        f'{group}.{name}': value for group, values in given.items() if isinstance(values, dict) for name, value in values.items()
    }
    settings = Settings.load({'robot': given['robot'], **flat}, {})
    assert (settings.robot, settings.bag.record, settings.events.topics) == ('tachi', 'mission', ('imu', 'odom'))
    assert len(flat) == 6


def test_live_parameters_are_marked() -> None:
    """Those that `ros2 param set` can change, and no others."""
    live = set(re.findall(r'^- (`.+?`).* \*\*live\*\*$', parameters(), re.MULTILINE))
    events = {f'`events.{name}`' for name in ('pre_s', 'post_s', 'max_s', 'max_bytes', 'log_event')}
    sensors = {f'`SENSOR.{name}`' for name in ('enabled', 'rate_hz', 'quality', 'priority')}
    assert live == {*sensors, '`upload.max_mbps`', *events}


def test_every_environment_variable_is_on_the_page() -> None:
    """The page lists exactly the variables that config.py reads."""
    read = set(re.findall(r"environ\.get\('(\w+)'\)", (PACKAGE / 'core' / 'config.py').read_text(encoding='utf-8')))
    assert read == {name for name, _, _ in VARIABLES}


def test_every_variable_of_the_guide_is_on_the_page() -> None:
    """docs/thor.md, the launch files and the units name no variable that the page does not have."""
    names = r'\b(?:AWS|SHADOWHOUND|MLFLOW|ROS|RMW|REQUESTS|FAST(?:RTPS|DDS)|CYCLONEDDS)_[A-Z_]*[A-Z]\b'
    root = DOCS.parent
    files = (DOCS / 'thor.md', *(root / 'launch_configs').glob('*.service'))
    named = {name for file in files for name in re.findall(names, file.read_text(encoding='utf-8'))}
    assert {name for name in named if f'\n- `{name}`' not in parameters()} == {'ROS_DISTRO'} & named


def test_every_table_is_complete() -> None:
    """The rows of a table have as many cells as its head."""
    for table in re.findall(r'(?:^\|.*\n)+', parameters() + commands(), re.MULTILINE):
        assert len({len(re.findall(r'(?<!\\)\|', row)) for row in table.splitlines()}) == 1, table


def test_without_write_the_command_prints_the_pages() -> None:
    """Without --write nothing is written."""
    assert CliRunner().invoke(main, []).stdout == parameters() + commands()


ROOT: Final = Path(__file__).resolve().parents[2]
COMMAND: Final = re.compile(r'shadowhound-data (?P<verb>[a-z]+)(?P<rest>[^`#|;)\n\']*)')
"""To the end of the code span, comment, string or line, or to a pipe."""
SERVICE: Final = re.compile(r'service call (?:/\w+)?/sensor_logger_node/(?P<name>[\w/]+) std_srvs/srv/(?P<type>\w+)')
PARAMETER: Final = re.compile(r'param set (?:/\w+)?/sensor_logger_node (?P<name>[\w.]+)')
SERVICES: Final = {
    'flush': 'Trigger', 'pause': 'SetBool', 'bag/start': 'Trigger', 'bag/stop': 'Trigger', 'bag/split': 'Trigger',
    'bag/pause': 'SetBool', 'event/trigger': 'Trigger',
}  # fmt: skip
"""The services of the node; test/e2e calls each."""


def commands_named(pattern: re.Pattern[str]) -> Iterator[tuple[str, re.Match[str]]]:
    """Each match with its file and line."""
    pages = [page for page in ROOT.glob('docs/**/*.md') if page.parent.name != 'evidence']  # records of what was run then
    files = [ROOT / 'README.md', *pages, *ROOT.glob('launch_configs/*'), *ROOT.glob('tower/*')]
    for path in (*files, *ROOT.glob('shadowhound_data_logger/**/*.py')):
        if path.is_file():
            text = path.read_text(encoding='utf-8')
            for match in pattern.finditer(text):
                yield f'{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}', match


def test_every_verb_and_option_exists() -> None:
    """Subcommands and their options included."""
    wrong, seen = [], set()
    for where, match in commands_named(COMMAND):
        command: click.Command | None = cli.commands.get(match['verb'])
        words = match['rest'].split()
        if isinstance(command, click.Group) and words and re.fullmatch('[a-z][a-z0-9-]*', words[0]):
            command = command.commands.get(words[0])
        if command is None:
            wrong.append(f'{where}: {match[0]}')
            continue
        options = {name for each in command.params for name in (*each.opts, *each.secondary_opts)} | {'--help'}
        words = re.findall(r'(?<=\s)--[a-z][a-z0-9-]*', match['rest'])
        wrong += [f'{where}: {word} of {match[0]}' for word in words if word not in options]
        seen.add(match['verb'])
    assert wrong == []
    assert seen == set(cli.commands)


def test_every_service_exists() -> None:
    """With this name and type."""
    calls = [(where, match['name'], match['type']) for where, match in commands_named(SERVICE)]
    assert [call for call in calls if SERVICES.get(call[1]) != call[2]] == []
    assert calls


def test_every_parameter_that_is_set_is_live() -> None:
    """`ros2 param set` rejects other parameters."""
    settings = Settings.load({}, {}, '/')
    owners = {name: getattr(settings, name) for name in GROUPS} | {sensor.name: sensor for sensor in settings.sensors}
    live = {f'{name}.{key}' for name, owner in owners.items() for key, spec in type(owner).__dataclass_fields__.items()
            if spec.metadata and spec.metadata['live']}  # fmt: skip
    sets = [(where, match['name']) for where, match in commands_named(PARAMETER)]
    assert [each for each in sets if each[1] not in live] == []
    assert sets


def test_every_link_leads_somewhere() -> None:
    """In the README and the docs: the file exists, and so does the heading with GitHub's anchor."""
    wrong, seen = [], 0
    for page in (ROOT / 'README.md', *ROOT.glob('docs/**/*.md')):
        for target in re.findall(r'\]\((?!https?://)([^)\s]+)\)', page.read_text(encoding='utf-8')):
            path, _, anchor = target.partition('#')
            file = (page.parent / path).resolve() if path else page
            seen += 1
            if not file.exists() or (anchor and anchor not in _anchors(file)):
                wrong.append(f'{page.relative_to(ROOT)}: {target}')
    assert wrong == []
    assert seen > 100


def _anchors(page: Path) -> set[str]:
    headings = re.findall(r'^#+ (.+)$', page.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}
