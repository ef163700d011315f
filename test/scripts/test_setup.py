"""Which Python `make setup` uses without a sourced ROS: a suitable one, wherever it is, or an error on what to install.

Each Python here is the running one, which claims another version and fails to create the environment, so the script names it.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ('awk', 'basename', 'cat', 'cut', 'dirname', 'find', 'flock', 'grep', 'ls', 'mkdir', 'printf', 'pwd', 'rm', 'sed', 'sh',
         'sha256sum', 'sort', 'tail', 'uname', 'xargs')  # fmt: skip
PLACES = {'PATH': 'bin/{}', 'pyenv': 'home/.pyenv/versions/{}.1/bin/python3', 'uv': 'uv/{}/bin/python3'}


class Machine:
    """A separate checkout, home and PATH, with the tools that the script needs and no Python."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / 'bin').mkdir()
        for tool in TOOLS:
            if found := shutil.which(tool):
                (folder / 'bin' / tool).symlink_to(found)
        checkout = folder / 'checkout'
        (checkout / 'scripts').mkdir(parents=True)
        shutil.copy(ROOT / 'scripts' / 'setup', checkout / 'scripts')
        for name in ('interfaces', 'launch_configs', 'package.xml', 'requirements', 'setup.cfg', 'setup.py', 'sim', 'tower'):
            (checkout / name).symlink_to(ROOT / name)

    def python(self, where: str, version: str, *, makes_venvs: bool = True) -> Path:
        """Add a Python that claims a version such as 3.12."""
        path = self.folder / PLACES[where].format(f'python{version}' if where == 'PATH' else version)
        claim = f'import sys; sys.version_info = ({version.replace(".", ", ")}, 1)'
        hidden = '' if makes_venvs else "; sys.modules['ensurepip'] = None"
        _program(path, f"""[ "$1" = -c ] || exit 1\nexec {sys.executable} -I -S -c "{claim}{hidden}; $2"\n""")
        if where == 'uv':
            known = self.folder / 'known'
            with known.open('a') as file:
                file.write(f'cpython-{version}.1-linux-x86_64-gnu    {path}\n')
            _program(self.folder / 'bin' / 'uv', f'[ "$1 $2" = "python list" ] && cat {known}\n')
        return path

    def setup(self) -> str:
        """The errors of the script, which never succeeds here."""
        environ = {'PATH': str(self.folder / 'bin'), 'HOME': str(self.folder / 'home'), 'LANG': os.environ.get('LANG', 'C')}
        command = [str(self.folder / 'checkout' / 'scripts' / 'setup')]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environ, timeout=60)
        assert done.returncode == 1
        return done.stderr

    def taken(self) -> str:
        """The Python that the script uses."""
        errors = self.setup()
        found = re.search(r'could not make a virtual environment with (\S+)\.$', errors, re.MULTILINE)
        assert found, errors
        return found[1]


def _program(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('#!/bin/sh\n' + text)
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_a_python_on_the_path_is_used(machine: Machine) -> None:
    """It takes precedence over those of pyenv and uv."""
    for where, version in (('PATH', '3.12'), ('pyenv', '3.10'), ('uv', '3.11')):
        machine.python(where, version)
    assert machine.taken() == 'python3.12'


@pytest.mark.parametrize('where', ['pyenv', 'uv'])
def test_a_python_outside_the_path_is_found(machine: Machine, where: str) -> None:
    """If those on PATH are newer than the ROS wheels support."""
    machine.python('PATH', '3.13')
    machine.python(where, '3.14')
    machine.python(where, '3.9')
    suitable = machine.python(where, '3.11')
    assert machine.taken() == str(suitable)


def test_only_a_python_that_makes_environments_is_used(machine: Machine) -> None:
    """A Python without venv, such as Debian's, is skipped."""
    machine.python('PATH', '3.11', makes_venvs=False)
    suitable = machine.python('uv', '3.12')
    assert machine.taken() == str(suitable)


def test_missing_programs_are_reported(machine: Machine) -> None:
    """A Python that lacks only venv is named, with the package to install."""
    machine.python('PATH', '3.11', makes_venvs=False)
    errors = machine.setup()
    assert 'python3.11 cannot make virtual environments' in errors
    assert 'apt install python3-venv' in errors


def test_without_a_suitable_python_the_remedy_is_named(machine: Machine) -> None:
    """One line names the versions and how to install one."""
    for where in ('PATH', 'pyenv', 'uv'):
        machine.python(where, '3.13')
    (line,) = machine.setup().splitlines()
    assert 'no Python 3.10, 3.11 or 3.12 found' in line
    assert 'uv python install 3.12' in line
    assert 'make setup PYTHON=' in line
