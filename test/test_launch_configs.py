"""The parameter files: one spells out exactly the defaults of the code, the other stores everything.

The systemd units: what they start exists, and when they start it again.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import pytest
import yaml

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.config import Settings, default_parameters
from shadowhound_data_logger.core.options import ShutdownSettings
from shadowhound_data_logger.core.type_rules import RULES
from shadowhound_data_logger.node.intake.sampling import EveryMessage, rule_for

FOLDER = Path(__file__).parents[1] / 'launch_configs'


def flat(tree: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    """Dotted names, as ROS makes them of a parameter file."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= flat(value, f'{prefix}{name}.') if isinstance(value, dict) else {f'{prefix}{name}': value}
    return found


def parameters(path: Path) -> dict[str, Any]:
    return flat(yaml.safe_load(path.read_text(encoding='utf-8'))['/**']['ros__parameters'])


def test_go2_yaml_is_the_defaults() -> None:
    """Each parameter stands there with its default in its own type, and no other parameter."""
    given, defaults = parameters(FOLDER / 'go2.yaml'), default_parameters()
    assert given == defaults
    assert {name: type(value) for name, value in given.items()} == {name: type(value) for name, value in defaults.items()}


@pytest.mark.parametrize('path', sorted(FOLDER.glob('*.yaml')), ids=lambda path: path.name)
def test_every_parameter_file_is_valid(path: Path) -> None:
    """The node starts with each of the files."""
    assert Settings.load(parameters(path), {}).sensors


def test_generic_yaml_logs_every_topic_by_its_type() -> None:
    """Its comments name the rules as they are, and its examples are settings that the node takes."""
    text = (FOLDER / 'generic.yaml').read_text(encoding='utf-8')
    assert parameters(FOLDER / 'generic.yaml') == {'robot': '', 'capture.topics': 'all'}
    table = text.partition('names:\n')[2].partition('# docs/parameters')[0]
    for words, kind in (('Odometry', 'nav_msgs/msg/Odometry'), ('DiagnosticArray', 'diagnostic_msgs/msg/DiagnosticArray')):
        assert words.lower() in table.lower()
        assert RULES[kind]['batch_s'] == {'Odometry': 1.0, 'DiagnosticArray': 10.0}[words]
    examples = re.sub(r'^    # ', '    ', text.partition('capture:')[2], flags=re.MULTILINE).replace(
        'A sensor of', '# A sensor of'
    )
    given = flat(yaml.safe_load('    capture:' + examples))
    settings = Settings.load(given, {})
    assert {sensor.name for sensor in settings.sensors} >= {'camera', 'front'}
    assert (settings.upload.max_mbps, settings.bag.record) == (20.0, 'mission')


def test_the_full_rate_keeps_every_message() -> None:
    """With go2_full_rate.yaml every sensor of go2.yaml is logged, none leaves a message out, an object holds a second."""
    settings = Settings.load(parameters(FOLDER / 'go2_full_rate.yaml'), {})
    assert [sensor.name for sensor in settings.sensors] == parameters(FOLDER / 'go2.yaml')['sensors']
    for sensor in settings.sensors:
        assert sensor.enabled, sensor.name
        assert sensor.batch_s == 1.0, sensor.name
        assert isinstance(rule_for(sensor, has_header=True, last_stored_ns=0), EveryMessage), sensor.name


def test_the_full_rate_says_only_what_differs() -> None:
    """Each line of go2_full_rate.yaml changes a default: what it does not change is read in go2.yaml."""
    defaults = default_parameters()
    same = [name for name, value in parameters(FOLDER / 'go2_full_rate.yaml').items() if defaults[name] == value]
    assert same == []


ROOT = Path(__file__).resolve().parents[1]
UNITS = sorted((ROOT / 'launch_configs').glob('*.service'))
UNIT, LIVE = (ROOT / 'launch_configs' / f'shadowhound-{name}.service' for name in ('data-logger', 'live'))
CLOSE_S = 5.0
"""What node/pipeline.py allows for making durable what is in memory."""


def section(unit: Path) -> dict[str, str]:
    """The [Service] section, with continued lines joined as systemd joins them (systemd.syntax(7))."""
    parser = ConfigParser(interpolation=None, delimiters=('=',))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(unit.read_text(encoding='utf-8').replace('\\\n', ' '))
    return dict(parser['Service'])


def script(service: dict[str, str]) -> str:
    """What the shell is given, which parses and becomes an executable of ours."""
    found = re.fullmatch(r"/bin/bash -c '(.*)'", service['ExecStart'])
    assert found
    text = found[1].replace('$$', '$')
    assert subprocess.run(['bash', '-n', '-c', text], check=False).returncode == 0
    executable = re.search(r'exec "\$P/lib/shadowhound_data_logger/([\w-]+)"', text)
    assert executable
    assert f"'{executable[1]} = shadowhound_data_logger." in (ROOT / 'setup.py').read_text(encoding='utf-8')
    return text


@pytest.fixture
def service() -> dict[str, str]:
    return section(UNIT)


def test_the_units_start_existing_programs(service: dict[str, str]) -> None:
    """The shell's script parses; the executable and the files that it names are installed under these names."""
    text = script(service)
    named = re.findall(r'\$C/([\w.]+)', text)
    assert named == ['fastdds_shm.xml']
    assert all((UNIT.parent / name).is_file() for name in named)


@pytest.mark.parametrize(('environ', 'arguments'), [
    ({}, ['--ros-args']),
    ({'SHADOWHOUND_PARAMETERS': '/etc/a robot.yaml'}, ['--ros-args', '--params-file', '/etc/a robot.yaml']),
])  # fmt: skip
def test_the_node_reads_the_file_that_is_set(service: dict[str, str], environ: dict[str, str], arguments: list[str]) -> None:
    """Without one it has the defaults, which suit any robot."""
    words = script(service).rpartition('/sensor_logger_node"')[2]
    given = {'PATH': os.environ['PATH'], **environ}
    ran = subprocess.run(['bash', '-c', f"printf '%s\\n' {words}"], env=given, capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines() == arguments


def test_the_smoke_run_of_policies_can_make_its_sandbox() -> None:
    """Namespaces are not restricted, and mounts are allowed, in the unit that runs policies for the first time."""
    service = section(UNIT.with_name('shadowhound-policy.service'))
    assert 'RestrictNamespaces' not in service
    assert '@mount' in service['SystemCallFilter'].split()


def test_the_smoke_run_of_policies_has_a_place_to_work() -> None:
    """``ProtectSystem=strict`` leaves nothing to write in but home and /data."""
    text = UNIT.with_name('shadowhound-policy.service').read_text(encoding='utf-8')
    assert 'ProtectSystem=strict' in text
    assert 'PrivateTmp=true' in text


def test_refused_settings_are_not_tried_again(service: dict[str, str]) -> None:
    """A crash starts it again, exit code 2 does not; it has time to close before it is killed."""
    assert service['Restart'] == 'on-failure'
    assert service['RestartPreventExitStatus'] == '2'
    assert float(service['TimeoutStopSec']) > CLOSE_S + ShutdownSettings().drain_s + 5


def test_the_secrets_are_in_the_file_that_the_guide_makes(service: dict[str, str]) -> None:
    """docs/thor.md creates the file of the unit, for its user alone, and no secret stands in the unit."""
    guide = (ROOT / 'docs' / 'thor.md').read_text(encoding='utf-8')
    assert f'install -m 0600 -o {service["User"]} /dev/null {service["EnvironmentFile"]}' in guide
    assert not [name for name in service if name == 'Environment']


@pytest.mark.parametrize('unit', UNITS, ids=lambda unit: unit.stem)
def test_systemd_accepts_the_units(unit: Path) -> None:
    """systemd-analyze finds nothing to complain about."""
    if shutil.which('systemd-analyze') is None:
        pytest.skip('no systemd here')
    said = subprocess.run(['systemd-analyze', 'verify', str(unit)], capture_output=True, text=True, check=False, timeout=60)
    assert (said.returncode, said.stderr) == (0, '')


@pytest.mark.parametrize(('environ', 'spool', 'bind'), [
    ({}, '/home/go2/.shadowhound/spool', '127.0.0.1'),
    ({'SHADOWHOUND_HOME': '/data/a robot', 'SHADOWHOUND_LIVE_BIND': '0.0.0.0'}, '/data/a robot/spool', '0.0.0.0'),
])  # fmt: skip
def test_the_live_page_is_started_with_arguments_that_it_takes(environ: dict[str, str], spool: str, bind: str) -> None:
    """The spool of the node, named because there is none before the node has run, and where to listen."""
    words = script(section(LIVE)).rpartition('/shadowhound-data"')[2]
    given = {'PATH': os.environ['PATH'], 'HOME': '/home/go2', **environ}
    said = subprocess.run(['bash', '-c', f"printf '%s\\n' {words}"], env=given, capture_output=True, text=True, check=True).stdout
    verb, *arguments = said.splitlines()
    with cli.commands[verb].make_context(verb, arguments) as context:
        assert (context.params['spool'], context.params['bind']) == (Path(spool), bind)


def test_the_live_page_reads_what_the_logger_writes() -> None:
    """As the same user, with the same environment; it starts again after a crash, and not with settings that are refused."""
    live, logger = section(LIVE), section(UNIT)
    for name in ('User', 'EnvironmentFile', 'Restart', 'RestartPreventExitStatus', 'ReadWritePaths', 'UMask'):
        assert live[name] == logger[name], name
    assert not [name for name in live if name == 'Environment']


@pytest.mark.parametrize('unit', UNITS, ids=lambda unit: unit.stem)
def test_no_service_leaves_its_memory_on_the_disk(unit: Path) -> None:
    """A core dump would have the keys of the store and the passwords of MLflow in it."""
    assert section(unit)['LimitCORE'] == '0'
