"""Facts that several files of the repository state agree."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from test_borders import ROS

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ROOT / 'requirements'
PROFILE = ROOT / 'launch_configs' / 'fastdds_shm.xml'
INTERFACES = ROOT / 'interfaces' / 'go2_interfaces'
MEBI = 1 << 20
PACKAGES = {'PIL': 'pillow', 'backports': 'backports-zstd', 'gi': 'python3-gi', 'google': 'protobuf', 'grpc': 'grpcio',
            'mlflow': 'mlflow-skinny', 'ruamel': 'ruamel-yaml', 'yaml': 'pyyaml'}  # fmt: skip
"""Names in imports -> those of the packages, where they differ."""
OURS = ('shadowhound_data_logger', 'sim/shadowhound_sim', 'tower/shadowhound_tower')
IMPORT = re.compile(r'^ *(?:import (?=[\w.]+(?: as \w+)?(?:  #.*)?$)|from (?=[\w.]+ import ))(\w+)', re.MULTILINE)


def setup_arguments() -> dict[str, Any]:
    """The literal arguments of setup() in setup.py, by name."""
    tree = ast.parse((ROOT / 'setup.py').read_text())
    call = next(node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'setup')
    literal = {}
    for keyword in call.keywords:
        try:
            literal[str(keyword.arg)] = ast.literal_eval(keyword.value)
        except ValueError:
            continue
    return literal


def requirements(name: str) -> dict[str, str]:
    """The requirements of a file, by the package's name: the whole requirement without comment and blanks."""
    lines = ((REQUIREMENTS / name).read_text()).splitlines()
    wanted = [line.split('#')[0].strip() for line in lines if line.split('#')[0].strip()]
    return {re.split(r'[^A-Za-z0-9_.-]', line)[0].lower(): line for line in wanted}


def locked(name: str) -> set[str]:
    """The packages that a lock file pins."""
    return set(re.findall(r'^([a-z0-9_.-]+)==', (REQUIREMENTS / name).read_text(), re.MULTILINE))


def console_scripts() -> list[str]:
    """The entry points of setup.py, as `name = module:function`."""
    points = setup_arguments()['entry_points']
    return list(points['console_scripts'])


def test_the_version_is_the_same_everywhere() -> None:
    """package.xml, setup.py and the changelog's newest heading, if it has one, name the same version."""
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert version == setup_arguments()['version']
    headings = re.findall(r'^(\d+\.\d+\.\d+) \(', (ROOT / 'CHANGELOG.rst').read_text(), re.MULTILINE)
    assert headings[:1] in ([], [version])


def test_the_package_is_registered_under_its_name() -> None:
    """The marker that ROS looks up has the name of the package and is installed."""
    name = ElementTree.parse(ROOT / 'package.xml').findtext('name')
    assert setup_arguments().get('name', name) == name
    assert (ROOT / 'resource' / str(name)).is_file()
    assert 'share/ament_index/resource_index/packages' in (ROOT / 'setup.py').read_text()


@pytest.mark.parametrize('point', console_scripts())
def test_an_entry_point_leads_to_a_function(point: str) -> None:
    """The module of an installed command can be imported and has the function."""
    module, _, function = point.partition(' = ')[2].partition(':')
    if module.split('.')[1] == 'node' and importlib.util.find_spec('rclpy') is None:
        pytest.skip('this command needs ROS')
    assert callable(getattr(importlib.import_module(module), function))


def test_setup_py_and_the_lock_files_agree() -> None:
    """`pip install .` and the lock files start from the same requirements."""
    assert sorted(setup_arguments()['install_requires']) == sorted(requirements('runtime.in').values())


@pytest.mark.parametrize('name', sorted(path.name for path in REQUIREMENTS.glob('*.in')))
def test_every_dependency_has_its_reason(name: str) -> None:
    """docs/dependencies.md names each package in a .in file."""
    page = set(re.findall(r'[a-z0-9_.-]+', (ROOT / 'docs' / 'dependencies.md').read_text().lower()))
    wanted = {package.split('[')[0] for package in requirements(name)}
    assert wanted, name
    assert not wanted - page


def imported() -> set[str]:
    """The packages that the library's modules import, by their names for pip (gi: for apt), without ROS and type checking."""
    found: set[str] = set()
    for path in (path for folder in OURS for path in (ROOT / folder).rglob('*.py')):
        text = re.sub(r'^if TYPE_CHECKING:\n(?: .*\n|\n)*', '', path.read_text(), flags=re.MULTILINE)
        found.update(IMPORT.findall(text))
    stdlib = {*sys.stdlib_module_names, 'compression'}  # the latter from 3.14 on
    return {PACKAGES.get(name, name) for name in found - stdlib - ROS - {Path(folder).name for folder in OURS}}


def test_every_import_is_a_dependency() -> None:
    """In setup.py or in docs/dependencies.md, which lists no package that is not imported."""
    arguments = setup_arguments()
    required = [*arguments['install_requires'], *(each for extra in arguments['extras_require'].values() for each in extra)]
    names = {re.split(r'[^A-Za-z0-9_-]', each)[0].lower() for each in required}
    page = (ROOT / 'docs' / 'dependencies.md').read_text()
    section = page.partition('### Imported, and brought by something else')[2].partition('\n## ')[0]
    transitive = {name for row in re.findall(r'^\| ([^|]+) \|', section, re.MULTILINE)[1:] for name in row.split(', ')}
    found = imported()
    assert transitive == found - names
    assert found & names <= set(re.findall(r'[a-z0-9_.-]+', page.lower()))


@pytest.mark.parametrize(
    ('lock', 'sources'),
    [
        ('uv.txt', ['uv.in']),
        ('audit.txt', ['audit.in']),
        ('docs.txt', ['docs.in']),
        ('runtime.txt', ['runtime.in']),
        ('robot.txt', ['runtime.in']),
        ('wheels.txt', ['runtime.in', 'ros.in', 'demo.in', 'dev.in']),
        ('demo_wheels.txt', ['runtime.in', 'ros.in', 'demo.in']),
        ('sourced.txt', ['runtime.in', 'demo.in', 'dev.in']),
        ('demo_sourced.txt', ['runtime.in', 'demo.in']),
        ('lyrical.txt', ['runtime.in', 'demo.in', 'dev.in']),
        ('demo_lyrical.txt', ['runtime.in', 'demo.in']),
        ('jazzy.txt', ['ros.in']),
        ('kilted_wheels.txt', ['runtime.in', 'kilted.in', 'demo.in', 'dev.in']),
    ],
)
def test_a_lock_file_has_its_requirements(lock: str, sources: list[str]) -> None:
    """No requirement was added without `make lock`, and each pin has a hash."""
    wanted = {package.split('[')[0] for source in sources for package in requirements(source)}
    assert not wanted - locked(lock)
    text = (REQUIREMENTS / lock).read_text()
    pins = re.findall(r'^[a-z0-9_.-]+==.*\\\n    --hash=sha256:', text, re.MULTILINE)
    assert len(pins) == len(re.findall(r'^[a-z0-9_.-]+==', text, re.MULTILINE))


@pytest.mark.parametrize('lock', ['wheels.txt', 'sourced.txt', 'lyrical.txt'])
def test_the_demo_has_the_versions_of_the_tests(lock: str) -> None:
    """What `make demo` installs stays when `make test` installs the rest, and is less."""
    some, every = (set(re.findall(r'^(\S+==[^ ;]+)', (REQUIREMENTS / name).read_text(), re.MULTILINE))
                   for name in (f'demo_{lock}', lock))  # fmt: skip
    assert some < every


@pytest.mark.parametrize('lock', ['robot.txt', 'sourced.txt', 'jazzy.txt'])
def test_with_a_sourced_ros_numpy_stays_at_1(lock: str) -> None:
    """The message packages of Humble and Jazzy were compiled against numpy 1 and crash on numpy 2."""
    assert set(re.findall(r'^numpy==(\d+)\.', (REQUIREMENTS / lock).read_text(), re.MULTILINE)) == {'1'}


def test_with_lyrical_numpy_and_empy_are_unpinned() -> None:
    """Its message packages are compiled against numpy 2, and its rosidl takes empy 4."""
    text = (REQUIREMENTS / 'lyrical.txt').read_text()
    assert set(re.findall(r'^numpy==(\d+)\.', text, re.MULTILINE)) == {'2'}
    assert 'sourced.in' not in text


def test_the_shared_memory_segment_holds_a_second_of_raw_images() -> None:
    """The Fast DDS profile is the default profile, uses its transports, and its segment has at least 32 MiB."""
    tree = ElementTree.parse(PROFILE)
    space = {'dds': 'http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles'}
    transports = {t.findtext('dds:transport_id', '', space): t for t in tree.iterfind('.//dds:transport_descriptor', space)}
    participant = tree.find('.//dds:participant', space)
    assert participant is not None
    assert participant.get('is_default_profile') == 'true'
    used = {node.text for node in participant.iterfind('.//dds:userTransports/dds:transport_id', space)}
    assert used == set(transports)
    assert {t.findtext('dds:type', '', space) for t in transports.values()} == {'SHM', 'UDPv4'}
    shared = next(t for t in transports.values() if t.findtext('dds:type', '', space) == 'SHM')
    assert int(shared.findtext('dds:segment_size', '0', space)) >= 32 * MEBI


def test_every_message_definition_is_built() -> None:
    """CMakeLists.txt of go2_interfaces names each .msg file, and nothing else."""
    built = set(re.findall(r'"(msg/\w+\.msg)"', (INTERFACES / 'CMakeLists.txt').read_text()))
    assert built == {f'msg/{path.name}' for path in (INTERFACES / 'msg').glob('*.msg')}
    assert (ROOT / 'interfaces' / 'COLCON_IGNORE').exists()


def test_no_file_names_a_package_index() -> None:
    """The machine decides where packages come from; no file in the repository names a host."""
    if shutil.which('git') is None or not (ROOT / '.git').exists():
        pytest.skip('not a git checkout')
    hosts = ['pypi' + '.org', 'python' + 'hosted.org', 'registry.' + 'npmjs.org', 'deb.' + 'debian.org', 'index' + '-url =']
    expression = [argument for host in hosts for argument in ('-e', host)]
    found = subprocess.run(
        ['git', 'grep', '-I', '-l', '-F', '--untracked', *expression], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert found.returncode == 1, found.stdout + found.stderr


@pytest.mark.parametrize('script', sorted(path.name for path in (ROOT / 'scripts').iterdir()))
def test_a_script_is_executable_and_parses(script: str) -> None:
    """The scripts are plain sh, for dash and bash."""
    path = ROOT / 'scripts' / script
    assert path.stat().st_mode & 0o111
    assert subprocess.run(['sh', '-n', str(path)], check=False, capture_output=True).returncode == 0


def test_a_commit_is_checked_as_make_check_does() -> None:
    """The hooks of pre-commit are the commands of `make check`, in its order."""
    makefile = (ROOT / 'Makefile').read_text()
    rule = re.search(r'^check:.*\n((?:\t.+\n)+)', makefile, re.MULTILINE)
    assert rule is not None
    (repository,) = yaml.safe_load((ROOT / '.pre-commit-config.yaml').read_text())['repos']
    assert repository['repo'] == 'local'
    assert [hook['entry'] for hook in repository['hooks']] == [line.strip() for line in rule[1].splitlines()]


def test_with_env_without_an_environment_has_a_remedy(tmp_path: Path) -> None:
    """In a fresh clone it fails and names `make setup`."""
    (tmp_path / 'scripts').mkdir()
    script = shutil.copy(ROOT / 'scripts' / 'with-env', tmp_path / 'scripts')
    done = subprocess.run([script, 'true'], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert 'make setup' in done.stderr


def test_with_env_keeps_a_profile_that_the_user_has_set(tmp_path: Path) -> None:
    """Our Fast DDS profile does not replace the user's."""
    if not (ROOT / '.venv' / 'done').exists():
        pytest.skip('no environment made by scripts/setup')
    bare = {
        name: value for name, value in os.environ.items() if 'PROFILES_FILE' not in name and name != 'SHADOWHOUND_ENVIRONMENT'
    }
    own = {**bare, 'FASTRTPS_DEFAULT_PROFILES_FILE': str(tmp_path / 'mine.xml')}
    for variables, expected in ((own, 'mine.xml'), (bare, 'fastdds_shm.xml')):
        command = [
            str(ROOT / 'scripts' / 'with-env'),
            'sh',
            '-c',
            'echo "$FASTDDS_DEFAULT_PROFILES_FILE$FASTRTPS_DEFAULT_PROFILES_FILE"',
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=variables)
        assert Path(done.stdout.strip()).name == expected, done.stderr
