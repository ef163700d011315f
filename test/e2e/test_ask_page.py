"""The commands of docs/ask.md, run in order on the data of a demo, succeed with output in the documented form.

``scripts/with-env python test/e2e/test_ask_page.py`` updates the page with their output on the data of ``make demo`` in demo/.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from shadowhound_tower.embedded import Tower

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'ask.md'
HOME = '/home/ann/.shadowhound'
"""As on the page."""
MAX_LINES, FIRST_LINES = 9, 4
"""The page has the first lines of a long output, and what follows its table."""
COMMAND = '    $ '


def commands(page: str) -> Iterator[tuple[int, int, str]]:
    """For each command its line number, the number of the line after its output, and the command."""
    lines = page.splitlines()
    for number, line in enumerate(lines):
        if line.startswith(COMMAND):
            end = number + 1
            while end < len(lines) and (not lines[end] or lines[end].startswith('    ')) and not lines[end].startswith(COMMAND):
                end += 1
            while not lines[end - 1]:
                end -= 1
            yield number, end, line.removeprefix(COMMAND)


def answered(page: str, ask: Callable[[str], str]) -> str:
    """The page with current outputs."""
    lines = page.splitlines()
    made: list[str] = []
    done = 0
    for number, end, command in commands(page):
        answer = shortened(ask(command).rstrip().splitlines())
        made += [*lines[done : number + 1], *(f'    {line}'.rstrip() for line in answer)]
        done = end
    return '\n'.join((*made, *lines[done:], ''))


def shortened(lines: list[str]) -> list[str]:
    if len(lines) <= MAX_LINES:
        return lines
    after = lines.index('') if '' in lines else len(lines)
    return [*lines[:FIRST_LINES], '...', *lines[after:]]


def asking(tower: Tower, folder: Path) -> Callable[[str], str]:
    """Runs a command as a user of a machine in the Tower's network, in a separate folder and home."""
    environ = {**os.environ, **tower.environment(), 'SHADOWHOUND_HOME': str(folder / 'home'), 'COLUMNS': '150',
               'NO_PROXY': '127.0.0.1'}  # fmt: skip

    def ask(command: str) -> str:
        done = subprocess.run(
            ['sh', '-c', command], cwd=folder, env=environ, capture_output=True, text=True, timeout=300, check=False
        )
        assert (done.returncode, done.stderr) == (0, ''), f'{command}\n{done.stdout}{done.stderr}'
        return done.stdout.replace(str(folder / 'home'), HOME)

    return ask


@pytest.mark.long('a demo')
@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.seaweedfs
def test_the_commands_of_the_page_have_answers_of_the_form_that_it_shows(tmp_path: Path) -> None:
    """Tables have the documented columns, and no command fails, or prints nothing if the page shows output."""
    pytest.importorskip('rclpy')
    pytest.importorskip('go2_interfaces')
    command = [sys.executable, '-m', 'shadowhound_sim.demo', '--duration', '20', '--outage', '0', '--folder', 'demo']
    made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=400, check=False)
    assert 'read back from the S3 server' in made.stdout, made.stdout + made.stderr
    page = PAGE.read_text(encoding='utf-8')
    shown = {command: page.splitlines()[number + 1 : end] for number, end, command in commands(page)}
    assert len(shown) >= 11
    (tmp_path / 'asked').mkdir()
    with Tower(tmp_path / 'demo' / 'tower') as tower:
        ask = asking(tower, tmp_path / 'asked')
        for command, lines in shown.items():
            answer = ask(command).split('\n')
            assert bool(lines) == bool(answer[0]), command
            if lines and not re.search(r'\d', lines[0]) and answer[0][:8] != '0 times.':  # 20 seconds produce less output
                assert answer[0].split() == lines[0].split(), command


def main(demo: Path) -> None:
    """Update the page."""
    with tempfile.TemporaryDirectory() as folder, Tower(demo / 'tower') as tower:
        PAGE.write_text(answered(PAGE.read_text(encoding='utf-8'), asking(tower, Path(folder))), encoding='utf-8')


if __name__ == '__main__':
    main(Path(sys.argv[1] if len(sys.argv) > 1 else 'demo'))
