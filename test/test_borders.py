"""The borders of the package: who may import what, and that using its face costs next to nothing."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = 'shadowhound_data_logger'
ROOT = Path(__file__).parents[1] / PACKAGE
STAGES = ('capture', 'encode', 'spool', 'ship', 'stores')
"""In the order of the data."""
ROS = {'ament_index_python', 'builtin_interfaces', 'geometry_msgs', 'go2_interfaces', 'nav_msgs', 'rcl_interfaces', 'rclpy',
       'rosidl_generator_py', 'sensor_msgs', 'std_msgs', 'std_srvs', 'diagnostic_msgs'}  # fmt: skip
ALLOWED = {
    **{name: {'capture', 'sim'} for name in ROS},
    'rclpy': {'capture', 'doctor', 'sim'},
    'boto3': {'stores', 'sim'},
    'botocore': {'stores', 'ship', 'sim'},
    'mlflow': {'missions', 'sim'},
    **{name: {'lake'} for name in ('daft', 'obstore')},
    'pyarrow': {'lake', 'sim'},
}
HEAVY = ('rclpy', 'boto3', 'botocore', 'mlflow', 'numpy', 'PIL', 'sqlite3', 'daft', 'obstore', 'pyarrow')
LATE = ('import_module', '__import__')
MODULES = sorted(ROOT.rglob('*.py'))


def imports(path: Path) -> Iterator[str]:
    """The full names of all modules that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f'{path}: relative imports hide which border they cross'
            assert node.module
            yield node.module
            yield from (f'{node.module}.{name.name}' for name in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, 'id', getattr(node.func, 'attr', '')) in LATE:
            yield from (argument.value for argument in node.args if isinstance(argument, ast.Constant))


def folder(path: Path) -> str:
    """The stage or folder of a module; empty for those beside them."""
    inside = path.relative_to(ROOT).parts
    return inside[0] if len(inside) > 1 else ''


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_who_imports_what(path: Path) -> None:
    """ROS, S3 and MLflow are known to their own folders alone."""
    for name in imports(path):
        allowed = ALLOWED.get(name.partition('.')[0])
        assert allowed is None or folder(path) in allowed, f'{folder(path) or path.name} must not import {name}'


def test_one_file_knows_mlflow() -> None:
    """Of the missions, tracking.py alone imports it, and none of its importing happens where an agent logs."""
    ours = [path for path in MODULES if folder(path) == 'missions']
    assert [path.name for path in ours if any(name.startswith('mlflow') for name in imports(path))] == ['tracking.py']


def test_one_file_of_the_doctor_knows_ros() -> None:
    """It is loaded in a process of its own, which may crash; the rest of the doctor works on machines without ROS."""
    ours = [path for path in MODULES if folder(path) == 'doctor']
    assert [path.name for path in ours if any(name.startswith('rclpy') for name in imports(path))] == ['ros_watch.py']


def test_a_robot_writes_the_catalogue_without_reading_it() -> None:
    """What the node runs of the lake imports none of the packages that only the extra ``lake`` brings."""
    program = f"""
import sys
from {PACKAGE} import lake
from {PACKAGE}.lake import catalogue, parts, schema
print([name for name in ('daft', 'obstore', 'pyarrow') if name in sys.modules])
"""
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.strip() == '[]'


@pytest.mark.parametrize('path', [path for path in MODULES if folder(path) in STAGES], ids=lambda path: '/'.join(path.parts[-2:]))
def test_the_way_of_the_data(path: Path) -> None:
    """A stage never imports one before it: capture, encode, spool, ship, stores."""
    before = STAGES[: STAGES.index(folder(path))]
    for name in imports(path):
        parts = name.split('.')
        assert parts[0] != PACKAGE or len(parts) < 2 or parts[1] not in before, f'{folder(path)} must not import {name}'


@pytest.mark.parametrize('path', [path for path in MODULES if not folder(path)], ids=lambda path: path.name)
def test_the_contracts_know_no_stage(path: Path) -> None:
    """What all share depends on none of them."""
    outside = {'capture', 'sim', 'cli', 'doctor', *STAGES}
    for name in imports(path):
        parts = name.split('.')
        assert parts[0] != PACKAGE or len(parts) < 2 or parts[1] not in outside, f'{path.name} must not import {name}'


PROGRAM = f"""
import json, resource, sys
def cpu():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
before = cpu()
from {PACKAGE} import *
print(json.dumps([cpu() - before, [name for name in {HEAVY!r} if name in sys.modules]]))
"""


def test_the_public_face_is_light() -> None:
    """``from shadowhound_data_logger import *`` takes under 0.2 s of CPU and loads none of the heavy packages."""
    ran = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, text=True, check=True, timeout=60)
    seconds, loaded = json.loads(ran.stdout)
    assert loaded == []
    assert seconds < 0.2


def test_the_public_names_are_told() -> None:
    """``__all__`` is explicit, and every name in it is there."""
    module = __import__(PACKAGE)
    assert isinstance(module.__all__, list)
    assert all(hasattr(module, name) for name in module.__all__)
