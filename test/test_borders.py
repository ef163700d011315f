"""The structure of the package: which folder may import what, and that importing the package is fast."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from shadowhound_data_logger.core import metadata_keys

PACKAGE = 'shadowhound_data_logger'
ROOT = Path(__file__).parents[1] / PACKAGE
ORDER = ('core', 'stores', 'formats', 'policies', 'ros', 'spool', 'shipping', 'missions', 'face', 'bags', 'node', 'lake',
         'datasets', 'live', 'doctor', 'cli')  # fmt: skip
"""Each folder may import those before it. ``face`` is the package itself."""
ROS = {'ament_index_python', 'builtin_interfaces', 'geometry_msgs', 'go2_interfaces', 'nav_msgs', 'rcl_interfaces', 'rclpy',
       'rosidl_generator_py', 'sensor_msgs', 'std_msgs', 'std_srvs', 'diagnostic_msgs',
       'type_description_interfaces'}  # fmt: skip
ALLOWED = {
    **{name: {'node', 'ros'} for name in ROS},
    'rclpy': {'node', 'doctor', 'live', 'ros'},
    'aiohttp': {'live'},
    **{name: {'stores'} for name in ('boto3', 'botocore')},
    **{name: {'policies'} for name in ('cryptography', 'securesystemslib', 'tuf')},
    'mlflow': {'missions'},
    'onnxruntime': {'lake', 'policies'},
    'tokenizers': {'lake'},
    'av': {'datasets', 'live'},
    'aiortc': {'live'},
    'deltalake': {'lake'},
    'obstore': {'stores'},
    'pyarrow': {'datasets', 'lake', 'live'},
}
HEAVY = ('rclpy', 'aiohttp', 'boto3', 'botocore', 'mlflow', 'numpy', 'PIL', 'sqlite3', 'deltalake', 'obstore',
         'pyarrow', 'av', 'cryptography', 'onnxruntime', 'securesystemslib', 'tokenizers', 'tuf')  # fmt: skip
LATE = ('import_module', '__import__')
MODULES = sorted(ROOT.rglob('*.py'))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding='utf-8'))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree(path)))


@cache
def imports(path: Path) -> tuple[str, ...]:
    """The full names of all modules that a file imports, anywhere in it."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[str]:
    for node in nodes(path):
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
    """The folder of a module, as named in ``ORDER``."""
    inside = path.relative_to(ROOT).parts
    if len(inside) > 1:
        return inside[0]
    return 'face'


PLACES = {path.relative_to(ROOT).with_suffix('').parts[0]: folder(path) for path in MODULES}
"""The name after the package's name in an import -> its folder."""


def folders(path: Path) -> Iterator[str]:
    """The folders of this package that a module imports from."""
    for name in imports(path):
        package, _, inside = name.partition('.')
        if package == PACKAGE and inside:
            yield PLACES.get(inside.partition('.')[0], 'face')


def test_every_folder_has_its_position() -> None:
    """ORDER contains exactly the existing folders."""
    assert sorted(ORDER) == sorted(set(PLACES.values()))


@pytest.mark.parametrize('name', ORDER)
def test_a_folder_imports_only_those_before_it(name: str) -> None:
    """No folder imports a later one."""
    later = ORDER[ORDER.index(name) + 1 :]
    ours = [path for path in MODULES if folder(path) == name]
    assert [f'{path.relative_to(ROOT)}: {found}' for path in ours for found in folders(path) if found in later] == []


@pytest.mark.parametrize('package', sorted(ALLOWED))
def test_imports_are_those_that_are_allowed(package: str) -> None:
    """ROS, S3, MLflow and Arrow are imported by certain folders only."""
    importers = {folder(path) for path in MODULES if any(name.partition('.')[0] == package for name in imports(path))}
    assert importers <= ALLOWED[package]


def test_one_file_imports_mlflow() -> None:
    """In missions/ only tracking.py imports it, which the agent's process does not load."""
    ours = [path for path in MODULES if folder(path) == 'missions']
    assert [path.name for path in ours if any(name.startswith('mlflow') for name in imports(path))] == ['tracking.py']


def test_one_file_of_the_stores_imports_obstore() -> None:
    """It comes with the extra ``lake``, which robots do not install."""
    ours = [path for path in MODULES if folder(path) == 'stores']
    assert [path.name for path in ours if any(name.startswith('obstore') for name in imports(path))] == ['s3_obstore.py']


def test_only_the_tables_of_the_spools_index_send_sql_to_it() -> None:
    """Other modules that send SQL have their own database: fetched objects, a bag, the lake's tables."""
    tables = {path.relative_to(ROOT).as_posix() for path in ROOT.glob('spool/*_table.py')}
    index = {'spool/index.py', 'spool/schema.py', *tables}
    own = {
        'lake/fetched.py', 'lake/search.py', 'lake/sink.py', 'lake/tables.py', 'bags/contents.py',
        'bags/sqlite_repair.py',
    }  # fmt: skip
    senders = {
        path.relative_to(ROOT).as_posix() for path in MODULES for node in nodes(path)
        if isinstance(node, ast.Attribute) and node.attr in {'execute', 'executemany', 'executescript'}
    }  # fmt: skip
    assert senders == index | own
    assert [name for name in own if 'FROM objects' in (ROOT / name).read_text(encoding='utf-8')] == []


def test_the_live_page_does_not_import_the_node() -> None:
    """It reads topics through ros/ and stored data through spool/; two files import rclpy."""
    ours = [path for path in MODULES if folder(path) == 'live']
    reads_the_past = {'past.py', 'history.py', 'kept.py', 'fleet.py'}  # in a separate process
    assert {name for path in ours if path.name not in reads_the_past for name in folders(path)} <= {
        'core', 'formats', 'live', 'policies', 'ros', 'spool',
    }  # fmt: skip
    assert {name for path in ours for name in folders(path)}.isdisjoint({'node', 'shipping', 'missions', 'doctor', 'cli'})
    assert [path.name for path in ours if any(name.startswith('rclpy') for name in imports(path))] == ['sampling.py', 'topics.py']


def test_one_file_of_the_doctor_imports_ros() -> None:
    """It runs in a separate process, which may crash; the rest of the doctor works without ROS."""
    ours = [path for path in MODULES if folder(path) == 'doctor']
    assert [path.name for path in ours if any(name.startswith('rclpy') for name in imports(path))] == ['ros_watch.py']


def test_a_robot_writes_the_catalog_without_reading_it() -> None:
    """The node imports none of the packages that are only in the extra ``lake``."""
    program = f"""
import sys
from {PACKAGE}.shipping import catalog_writer
print([name for name in ('deltalake', 'obstore', 'pyarrow') if name in sys.modules])
"""
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.strip() == '[]'


def test_metadata_keys_are_documented() -> None:
    """Each key is defined once, and docs/formats.md explains it."""
    words = {name: word for name, word in vars(metadata_keys).items() if name.isupper()}
    page = (ROOT.parent / 'docs' / 'formats.md').read_text(encoding='utf-8')
    assert len(set(words.values())) == len(words)
    assert [word for word in words.values() if f'`{word}`' not in page] == []


def test_the_page_on_architecture_names_existing_files() -> None:
    """Each module that docs/architecture.md names exists."""
    page = (ROOT.parent / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    named = set(re.findall(r'`([\w/]+\.py)\b', page)) - {'bench/code.py', 'test/test_borders.py'}
    there = {path.relative_to(ROOT).as_posix() for path in MODULES} | {path.name for path in MODULES}
    assert len(named) > 50
    assert sorted(named - there) == []


def test_the_glossary_names_existing_terms() -> None:
    """Each term is used in the code or on another page; terms are unique and sorted."""
    page = (ROOT.parent / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    terms = re.findall(r'^- \*\*(.+?)\*\*', page.partition('## Glossary')[2].partition('\n## ')[0], re.MULTILINE)
    assert len(terms) > 20
    assert terms == sorted(set(terms), key=str.lower)
    pages = [path for path in (ROOT.parent / 'docs').rglob('*.md') if path.name != 'architecture.md']
    text = '\n'.join(path.read_text(encoding='utf-8').lower() for path in (*MODULES, *pages))
    words = [word for term in terms for word in term.lower().split(', ')]
    assert [word for word in words if not re.search(rf'\b{word}', text) and word.replace(' ', '_') not in text] == []


PROGRAM = f"""
import json, sys
from {PACKAGE} import *
print(json.dumps([name for name in sys.modules if name.partition('.')[0] not in sys.stdlib_module_names]))
"""
LIGHT = frozenset({PACKAGE, '__main__', 'orjson'})


def test_the_public_face_is_light() -> None:
    """``from shadowhound_data_logger import *`` loads fewer than 60 of our modules, and of others only orjson."""
    plain = subprocess.run(
        [sys.executable, '-c', PROGRAM.replace(f'from {PACKAGE} import *', '')], capture_output=True, check=True
    )
    ran = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, check=True)
    loaded = {name.partition('.')[0] for name in set(json.loads(ran.stdout)) - set(json.loads(plain.stdout))}
    assert not loaded.intersection(HEAVY)
    assert loaded <= LIGHT
    assert sum(name.startswith(f'{PACKAGE}.') for name in json.loads(ran.stdout)) < 60


def test_public_names_are_documented() -> None:
    """``__all__`` is explicit, and every name in it exists."""
    module = __import__(PACKAGE)
    assert isinstance(module.__all__, list)
    assert all(hasattr(module, name) for name in module.__all__)
