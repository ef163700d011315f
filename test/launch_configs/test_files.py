"""The parameter files: one contains exactly the defaults of the code, another stores everything.

The systemd units: what they start, and when they restart it.
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

FOLDER = Path(__file__).parents[2] / 'launch_configs'


def flat(tree: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    """A parameter file's tree with dotted names, as in ROS."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= flat(value, f'{prefix}{name}.') if isinstance(value, dict) else {f'{prefix}{name}': value}
    return found


def parameters(path: Path) -> dict[str, Any]:
    return flat(yaml.safe_load(path.read_text(encoding='utf-8'))['/**']['ros__parameters'])


def test_go2_yaml_is_the_defaults() -> None:
    """It contains each parameter with its default, in the right type, and no others."""
    given, defaults = parameters(FOLDER / 'go2.yaml'), default_parameters()
    assert given == defaults
    assert {name: type(value) for name, value in given.items()} == {name: type(value) for name, value in defaults.items()}


@pytest.mark.parametrize('path', sorted(FOLDER.glob('*.yaml')), ids=lambda path: path.name)
def test_every_parameter_file_is_valid(path: Path) -> None:
    """The node starts with each of the files."""
    assert Settings.load(parameters(path), {}).sensors


def test_generic_yaml_logs_every_topic_by_its_type() -> None:
    """Its comments name the current rules, and its examples are valid settings."""
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
    """With go2_full_rate.yaml every sensor of go2.yaml stores every message, in objects of one second."""
    settings = Settings.load(parameters(FOLDER / 'go2_full_rate.yaml'), {})
    assert [sensor.name for sensor in settings.sensors] == parameters(FOLDER / 'go2.yaml')['sensors']
    for sensor in settings.sensors:
        assert sensor.enabled, sensor.name
        assert sensor.batch_s == 1.0, sensor.name
        assert isinstance(rule_for(sensor, has_header=True, last_stored_ns=0), EveryMessage), sensor.name


def test_the_full_rate_has_only_changed_parameters() -> None:
    """Each line of go2_full_rate.yaml changes a default."""
    defaults = default_parameters()
    same = [name for name, value in parameters(FOLDER / 'go2_full_rate.yaml').items() if defaults[name] == value]
    assert same == []


ROOT = Path(__file__).resolve().parents[2]
UNITS = sorted((ROOT / 'launch_configs').glob('*.service'))
UNIT, LIVE = (ROOT / 'launch_configs' / f'shadowhound-{name}.service' for name in ('data-logger', 'live'))
CLOSE_S = 5.0
"""How long node/pipeline.py may take to commit what is in memory."""


def section(unit: Path) -> dict[str, str]:
    """The [Service] section, with continued lines joined as systemd joins them (systemd.syntax(7))."""
    parser = ConfigParser(interpolation=None, delimiters=('=',))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(unit.read_text(encoding='utf-8').replace('\\\n', ' '))
    return dict(parser['Service'])


def script(service: dict[str, str]) -> str:
    """The unit's shell script, after checking that it parses and starts one of our executables."""
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
    """The script parses; the executable and the files that it names are installed."""
    text = script(service)
    named = re.findall(r'\$C/([\w.]+)', text)
    assert named == ['fastdds_shm.xml']
    assert all((UNIT.parent / name).is_file() for name in named)


@pytest.mark.parametrize(('environ', 'arguments'), [
    ({}, ['--ros-args']),
    ({'SHADOWHOUND_PARAMETERS': '/etc/a robot.yaml'}, ['--ros-args', '--params-file', '/etc/a robot.yaml']),
])  # fmt: skip
def test_the_node_reads_the_file_that_is_set(service: dict[str, str], environ: dict[str, str], arguments: list[str]) -> None:
    """Without one the defaults apply."""
    words = script(service).rpartition('/sensor_logger_node"')[2]
    given = {'PATH': os.environ['PATH'], **environ}
    ran = subprocess.run(['bash', '-c', f"printf '%s\\n' {words}"], env=given, capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines() == arguments


def test_the_smoke_run_of_policies_can_make_its_sandbox() -> None:
    """The unit that does smoke runs restricts neither namespaces nor mounts."""
    service = section(UNIT.with_name('shadowhound-policy.service'))
    assert 'RestrictNamespaces' not in service
    assert '@mount' in service['SystemCallFilter'].split()


def test_the_smoke_run_of_policies_has_a_place_to_work() -> None:
    """Because of ``ProtectSystem=strict`` it can otherwise write only to home and /data."""
    text = UNIT.with_name('shadowhound-policy.service').read_text(encoding='utf-8')
    assert 'ProtectSystem=strict' in text
    assert 'PrivateTmp=true' in text


def test_refused_settings_are_not_tried_again(service: dict[str, str]) -> None:
    """It is restarted after a crash but not after exit code 2, and has time to close before it is killed."""
    assert service['Restart'] == 'on-failure'
    assert service['RestartPreventExitStatus'] == '2'
    assert float(service['TimeoutStopSec']) > CLOSE_S + ShutdownSettings().drain_s + 5


def test_the_secrets_are_in_the_file_that_the_guide_makes(service: dict[str, str]) -> None:
    """docs/thor.md creates the unit's environment file, readable by its user only, and the unit itself contains no secret."""
    guide = (ROOT / 'docs' / 'thor.md').read_text(encoding='utf-8')
    assert f'install -m 0600 -o {service["User"]} /dev/null {service["EnvironmentFile"]}' in guide
    assert not [name for name in service if name == 'Environment']


@pytest.mark.parametrize('unit', UNITS, ids=lambda unit: unit.stem)
def test_systemd_accepts_the_units(unit: Path) -> None:
    """``systemd-analyze verify`` reports nothing."""
    if shutil.which('systemd-analyze') is None:
        pytest.skip('no systemd here')
    done = subprocess.run(['systemd-analyze', 'verify', str(unit)], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, '')


@pytest.mark.parametrize(('environ', 'spool', 'bind'), [
    ({}, '/home/go2/.shadowhound/spool', '127.0.0.1'),
    ({'SHADOWHOUND_HOME': '/data/a robot', 'SHADOWHOUND_LIVE_BIND': '0.0.0.0'}, '/data/a robot/spool', '0.0.0.0'),
])  # fmt: skip
def test_the_live_page_is_started_with_arguments_that_it_takes(environ: dict[str, str], spool: str, bind: str) -> None:
    """The node's spool, which may not exist yet, and the address to listen on."""
    words = script(section(LIVE)).rpartition('/shadowhound-data"')[2]
    given = {'PATH': os.environ['PATH'], 'HOME': '/home/go2', **environ}
    output = subprocess.run(
        ['bash', '-c', f"printf '%s\\n' {words}"], env=given, capture_output=True, text=True, check=True
    ).stdout
    verb, *arguments = output.splitlines()
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
    """A core dump would contain the keys of the store and the passwords of MLflow."""
    assert section(unit)['LimitCORE'] == '0'
