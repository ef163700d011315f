"""With what Humble's rclpy offers the node stores everything, and reports as unknown what it cannot count."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from e2e import rclpy_names
from e2e.bag_reading import in_slice
from e2e.processes import HERE, Processes
from e2e.reading import STRING, Objects, texts
from shadowhound_tower.embedded import Tower

FAST_DDS, CYCLONE_DDS = 'rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp'
PROBE = """
import json, sys
from rclpy.impl.implementation_singleton import rclpy_implementation

def try_out(code):
    try:
        exec(code, {'__name__': sys.argv[1]})
    except (AttributeError, ImportError) as error:
        return type(error).__name__
    return ''

print(json.dumps([try_out(code) for code in json.load(sys.stdin)]))
"""
IN_HUMBLE = (
    'from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks',
    'from rclpy.node import Node; Node.create_subscription; Node.get_publishers_info_by_topic',
    'from rclpy.impl.implementation_singleton import rclpy_implementation as r; r.QoSEvent; r.Subscription.pointer',
    'import rclpy; rclpy.init; rclpy.node.Node; rclpy.qos.QoSProfile',
    'from rclpy.qos import ReliabilityPolicy; ReliabilityPolicy.RELIABLE',
)
COMPILED = 'from rclpy.impl.implementation_singleton import rclpy_implementation as r; '
NOT_IN_HUMBLE = {
    'from rclpy.event_handler import SubscriptionEventCallbacks': 'ImportError',
    'import rclpy; rclpy.event_handler': 'AttributeError',
    f'{COMPILED}r.EventHandle': 'AttributeError',
    f'{COMPILED}r.Subscription.get_publisher_count': 'AttributeError',
    'from rclpy.node import Node; Node.add_post_set_parameters_callback': 'AttributeError',
}
SOURCES = {
    'package.xml': '<package><name>rclpy</name><version>3.3.15</version></package>',
    'rclpy/__init__.py': 'def init(*, args=None):\n    from rclpy.node import Node\n',
    'rclpy/node.py': """
import warnings
if TYPE_CHECKING:
    from somewhere import OnlyForTypes
try:
    from here import there
except ImportError:
    there = None
HIDDEN: int = 3
Other = HIDDEN
class Node(module.Base):
    NAME = 'x'
    def __init__(self):
        self._handle = local = 1
    @property
    def name(self): return self._handle
""",
    'src/rclpy/subscription.cpp': """
  return py::make_tuple(taken, py::dict("source_timestamp"_a = info.source, "received_timestamp"_a = info.received));
  py::class_<Subscription, Destroyable, std::shared_ptr<Subscription>>(module, "Subscription")
  .def(py::init<Node &, std::string>())
  .def_property_readonly(
    "pointer", [](const Subscription & s) { return s.get(); },
    "Get the address")
  .def("take_message", &Subscription::take_message, "Take \\"it\\"");
  m.def(
    "rclpy_resolve", &resolve);
  m.attr("LIMIT") = py::int_(3);
  py::enum_<kind_t>(m, "Kind").value("ONE", 1)
  .value("TWO", 2);
  py::register_exception<RCLError>(
    m, "RCLError", PyExc_RuntimeError);
""",
}
"""A source tree of rclpy with one name of each kind."""
COUNT = 200
TOPICS = ('/one', '/two', '/latched')
SENSORS = {
    'sensors': ['one', 'two', 'latched'], 'bag.record': 'always',
    **{f'{name}.{key}': value for name in ('one', 'two', 'latched')
       for key, value in {'topics': [name], 'types': [STRING], 'rate_hz': 0.0, 'batch_s': 0.2}.items()},
}  # fmt: skip


newer = pytest.mark.skipif(os.environ.get('ROS_DISTRO') == 'humble', reason='this is Humble: it needs no imitation')


def humble(folder: Path, rmw: str) -> dict[str, str]:
    """The environment of a Python with an rclpy that has only Humble's names."""
    folder.mkdir()
    shutil.copy(HERE / 'humble.py', folder / 'sitecustomize.py')
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get('PYTHONPATH'))))
    return {'PYTHONPATH': path, 'RCLPY_NAMES': str(HERE / 'rclpy_humble.json'), 'HUMBLE_RMW': rmw}


@newer
@pytest.mark.parametrize(
    ('rmw', 'grades'),
    [
        pytest.param(FAST_DDS, {'exact'}, marks=pytest.mark.long('a robot and a node of each middleware')),
        (CYCLONE_DDS, {'estimated', 'received-only'}),
    ],
)
def test_everything_is_stored_and_unknown_counts_are_null(
    processes: Processes, seaweed: Tower, stored: Callable[..., Objects], tmp_path: Path, rmw: str, grades: set[str]
) -> None:
    """From one and from two publishers and from their history, each message once; the accounts have only what is known."""
    first, second = processes.publisher(), processes.publisher()
    first.create('/latched', STRING, latched=True)
    began_ns = time.time_ns()
    first.publish('/latched', texts(range(COUNT)))
    node = processes.node(seaweed.environment(), SENSORS, environ=humble(tmp_path / 'humble', rmw))
    first.create('/one', STRING)
    for publisher in (first, second):
        publisher.create('/two', STRING)
        publisher.matched('/two')
    first.heard('/one', node, texts(['warm-up'])[0])
    first.publish('/one', texts(range(COUNT)))
    first.publish('/two', texts(range(COUNT)))
    second.publish('/two', texts(range(COUNT, 2 * COUNT)))
    expected = {'/one': COUNT, '/two': 2 * COUNT, '/latched': COUNT}
    for topic, count in expected.items():
        node.received(topic, count)
    ledger = node.stop()
    rows: dict[str, dict[str, Any]] = ledger['topics']
    objects = stored(processes.robot)
    for topic, count in expected.items():
        row = rows[topic]
        assert objects.numbers(topic.strip('/')) == list(range(count))
        assert row['accounting'] in grades
        known = (row['received'], 0) if grades == {'exact'} else (None, None)
        assert (row['published'], row['missed'], row['dropped'], row['rejected'], row['open']) == (*known, {}, {}, 0)
        assert row['stored'] == row['received'] >= count
    slice_file = tmp_path / 'slice.mcap'
    slice_file.write_bytes(next(body for key, body in objects.contents.items() if key.endswith('.mcap')))
    recorded = list(in_slice(slice_file))
    assert {topic: sum(each.topic == topic for each in recorded) for topic in TOPICS} == {
        topic: row['received'] for topic, row in ledger['bags'].items()
    }
    assert all(began_ns < each.log_ns < time.time_ns() for each in recorded), 'the middleware does not report arrival times'
    assert len(re.findall(r'\[WARN\]', node.log)) <= 1
    assert '[ERROR]' not in node.log
    assert 'Traceback' not in node.log


@newer
def test_names_are_hidden_from_this_package_alone(tmp_path: Path) -> None:
    """Humble's names are there, later ones are not; rclpy's own modules still use them."""
    environ = {**os.environ, **humble(tmp_path / 'humble', FAST_DDS)}
    for name, expected in (
        ('shadowhound_data_logger.probe', dict.fromkeys(IN_HUMBLE, '') | NOT_IN_HUMBLE),
        ('rclpy.probe', dict.fromkeys(NOT_IN_HUMBLE, '')),
    ):
        done = subprocess.run([sys.executable, '-c', PROBE, name], env=environ, input=json.dumps(list(expected)), text=True,
                              capture_output=True, check=False)  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert dict(zip(expected, json.loads(done.stdout), strict=True)) == expected


def test_names_are_read_from_a_source_tree(tmp_path: Path) -> None:
    """Those of modules, classes and members, in Python and in C++, and the fields that a take returns."""
    tree = tmp_path / 'rclpy'
    for name, text in SOURCES.items():
        path = tree / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    found = rclpy_names.main(tree, 'abc')
    assert (found['version'], found['commit']) == ('3.3.15', 'abc')
    assert found['message_info'] == ['received_timestamp', 'source_timestamp']
    assert found['modules'] == {
        'rclpy': {'names': ['init'], 'classes': {}},
        'rclpy.node': {
            'names': ['HIDDEN', 'Node', 'Other', 'there', 'warnings'],
            'classes': {'Node': {'bases': ['Base'], 'members': ['NAME', '__init__', '_handle', 'name']}},
        },
        'rclpy._rclpy_pybind11': {
            'names': ['Kind', 'LIMIT', 'RCLError', 'Subscription', 'rclpy_resolve'],
            'classes': {
                'Kind': {'bases': ['Destroyable'], 'members': ['ONE', 'TWO']},
                'RCLError': {'bases': ['Destroyable'], 'members': []},
                'Subscription': {'bases': ['Destroyable'], 'members': ['pointer', 'take_message']},
            },
        },
    }


def test_the_names_of_an_installed_rclpy_are_those_that_it_has() -> None:
    """The names read from its source are those that Python finds: none invented, none missing."""
    for name in ('rclpy.node', 'rclpy.qos', 'rclpy.subscription', 'rclpy.utilities', 'rclpy.executors'):
        module = import_module(name)
        assert module.__file__
        found = rclpy_names.module(ast.parse(Path(module.__file__).read_text(encoding='utf-8')))
        assert {each for each in found['names'] if each[:2] != '__'} == {each for each in vars(module) if each[:2] != '__'}
