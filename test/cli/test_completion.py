"""Completion works in a real bash, with the file that the package installs and with click's own line."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / 'resource/completion/shadowhound-data'
CLICKS = 'eval "$(_SHADOWHOUND_DATA_COMPLETE=bash_source shadowhound-data)"'


@pytest.fixture(autouse=True)
def _path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The program of this environment is in PATH, and its home is empty."""
    monkeypatch.setenv('PATH', f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}')
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))


@pytest.mark.parametrize('how', [f'source {FILE}', CLICKS], ids=['file', 'line'])
def test_verbs_options_and_choices_are_completed(how: str) -> None:
    """As bash calls the function for each word before the cursor."""
    script = (
        how
        + """
        for line in 'led' 'bag ve' 'query --sens' 'query --format ' 'node bag st'; do
            COMP_WORDS=(shadowhound-data $line); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
            [ "${line% }" = "$line" ] || { COMP_WORDS+=(''); COMP_CWORD=$((COMP_CWORD + 1)); }
            _shadowhound_data_completion shadowhound-data
            echo "${COMPREPLY[@]}"
        done"""
    )
    said = subprocess.run(['bash', '--norc', '-c', script], capture_output=True, text=True, check=True, timeout=250).stdout
    assert said.splitlines() == ['ledger', 'verify', '--sensor', 'table csv json keys', 'start stop']


def test_a_terminal_completes_with_tab() -> None:
    """In an interactive bash, up to the space behind the verb."""
    process, terminal = pty.fork()
    if process == 0:
        os.execvp('bash', ['bash', '--norc', '--noprofile', '-i'])  # noqa: S606 - a bash that a person types into
    try:
        os.write(terminal, f'source {FILE}; bind "set enable-bracketed-paste off"\r'.encode())
        os.write(terminal, b'shadowhound-data miss\t')
        seen, deadline = b'', time.monotonic() + 250
        while b'shadowhound-data missions ' not in seen:
            assert time.monotonic() < deadline, seen
            if select.select([terminal], [], [], 1.0)[0]:
                seen += os.read(terminal, 4096)
    finally:
        os.write(terminal, b'\x03exit\r')
        os.close(terminal)
        os.waitpid(process, 0)


def test_verbs_are_completed_without_importing_them() -> None:
    """Each word would otherwise take as long as the slowest verb."""
    code = """import sys, click
from shadowhound_data_logger.cli.main import cli
print(*[each.value for each in cli.shell_complete(click.Context(cli), '')])
print(*(name for name in sys.modules if name.startswith('shadowhound_data_logger.cli.')))"""
    verbs, modules = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert {'doctor', 'policy'} < set(verbs.split())
    assert set(modules.split()) == {'shadowhound_data_logger.cli.common', 'shadowhound_data_logger.cli.main'}
