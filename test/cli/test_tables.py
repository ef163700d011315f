"""Tables of any width fit a terminal without a broken word; without a terminal they are as wide as they need."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from shadowhound_data_logger.cli.output import plain, plain_table, print_page

TOPIC = '/oakd/rgb/preview/image_raw/compressed'
ROWS = (
    (TOPIC, '2026-11-28 02:45:50.123', '1,234,567', 'transport'),
    ('/imu', '-', '7', 'the network, or a robot without spare CPU'),
)
NAMES = ('topic', 'from (UTC)', 'messages', 'cause')


def printed(width: int, *, is_terminal: bool = True) -> list[str]:
    table = plain_table('Gaps', NAMES, ('topic', 'from (UTC)', 'cause'))
    for row in ROWS:
        table.add_row(*map(plain, row))
    console = Console(file=io.StringIO(), width=width, force_terminal=is_terminal, color_system=None, legacy_windows=False)
    print_page(table, console=console)
    assert isinstance(console.file, io.StringIO)
    return re.sub(r'\x1b\[[0-9;]*m', '', console.file.getvalue()).splitlines()


@pytest.mark.parametrize('width', [52, 60, 72, 80, 100, 200])
def test_no_word_is_broken_and_no_line_is_too_long(width: int) -> None:
    """All words of all cells are there, each in one piece."""
    lines = printed(width)
    words = [word for line in lines for word in line.split()]
    assert max(map(len, lines)) <= width
    for word in ' '.join(value for row in ROWS for value in row).split():
        assert word in words, word


def test_a_table_that_is_too_wide_is_a_list_of_names_and_values() -> None:
    """One block per row."""
    lines = [line.rstrip() for line in printed(60)]
    assert lines[:2] == ['Gaps', f'topic       {TOPIC}']
    assert lines.count('') == 1


def test_a_file_gets_the_complete_table() -> None:
    """However narrow the terminal was."""
    lines = printed(40, is_terminal=False)
    assert [line.split()[0] for line in lines] == ['Gaps', 'topic', TOPIC, '/imu']
