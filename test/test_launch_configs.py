"""The parameter files: one spells out exactly the defaults of the code, the other stores everything."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from shadowhound_data_logger.core.config import Settings, default_parameters
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
