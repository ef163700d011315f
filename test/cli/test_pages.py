"""docs/parameters.md and docs/commands.md say what the code says."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

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

PACKAGE = Path(__file__).parents[2] / 'shadowhound_data_logger'


def test_the_pages_are_those_that_the_code_makes() -> None:
    """Whoever changes a setting or a verb runs `make docs`."""
    assert (DOCS / 'parameters.md').read_text(encoding='utf-8') == parameters()
    assert (DOCS / 'commands.md').read_text(encoding='utf-8') == commands()


def test_the_exit_codes_are_in_one_table() -> None:
    """That page has each with its meaning, and `--help` names them."""
    told = CliRunner().invoke(cli, ['--help']).stdout
    assert set(MEANINGS) == set(ExitCode)
    for code, meaning in MEANINGS.items():
        assert f'| `{code.value}` | {meaning} |' in commands()
        assert re.search(rf'^  {code.value} +{meaning}$', told, re.MULTILINE)


def test_every_parameter_is_on_it() -> None:
    """Each parameter that the node declares has a line, or one that all sensors share."""
    rows = set(re.findall(r'^- (`.+?`)', parameters(), re.MULTILINE))
    names = [name.rpartition('.') for name in default_parameters()]
    named = (f'`{"SENSOR" if group in DEFAULT_SENSORS else group}{dot}{field}`' for group, dot, field in names)
    missing = [name for name in named if name not in rows]
    assert len(names) > 100
    assert not missing
    guide = (DOCS / 'thor.md').read_text(encoding='utf-8').partition('## What is stored')[2]
    assert [sensor for sensor in DEFAULT_SENSORS if not re.search(rf'\b{sensor}\b', guide)] == []


def test_each_is_in_one_section() -> None:
    """Of what a person wants to do, in whatever group its name is."""
    listed = Counter(name for section in (*SECTIONS, ADVANCED) for name in section.names)
    known = {
        f'SENSOR.{name.partition(".")[2]}' if name.partition('.')[0] in DEFAULT_SENSORS else name for name in default_parameters()
    }
    assert listed == Counter(known)


def test_each_verb_is_for_one_reader() -> None:
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


def test_every_environment_variable_is_on_it() -> None:
    """The page tells the variables that config.py reads, all of them and no others."""
    read = set(re.findall(r"environ\.get\('(\w+)'\)", (PACKAGE / 'core' / 'config.py').read_text(encoding='utf-8')))
    assert read == {name for name, _, _ in VARIABLES}


def test_every_variable_of_the_guide_is_on_it() -> None:
    """docs/thor.md, the launch files and the units name no variable that the page does not have."""
    names = r'\b(?:AWS|SHADOWHOUND|MLFLOW|ROS|RMW|REQUESTS|FAST(?:RTPS|DDS)|CYCLONEDDS)_[A-Z_]*[A-Z]\b'
    root = DOCS.parent
    files = (DOCS / 'thor.md', *(root / 'launch_configs').glob('*.service'))
    told = {name for file in files for name in re.findall(names, file.read_text(encoding='utf-8'))}
    assert {name for name in told if f'\n- `{name}`' not in parameters()} == {'ROS_DISTRO'} & told


def test_every_table_is_complete() -> None:
    """The rows of a table have as many cells as its head."""
    for table in re.findall(r'(?:^\|.*\n)+', parameters() + commands(), re.MULTILINE):
        assert len({len(re.findall(r'(?<!\\)\|', row)) for row in table.splitlines()}) == 1, table


def test_the_command_prints_it() -> None:
    """Without --write nothing is written."""
    assert CliRunner().invoke(main, []).stdout == parameters() + commands()
