"""CSV files from spreadsheets: with a byte order mark, in UTF-16, or with other separators, in every reader that there is."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.datasets import clocks, imports
from shadowhound_data_logger.lake.labels import from_csv
from shadowhound_data_logger.missions.pictures import read_path

NOON_NS = 1_793_188_800_000_000_000
READERS: dict[str, tuple[str, Callable[[Path], Any], Any]] = {
    'trajectory': ('timestamp,x,y,yaw\n1,0,0,0\n2,1,0,0\n', read_path, [(1.0, 0.0, 0.0), (2.0, 1.0, 0.0)]),
    '--times': (f'episode,begin_ns\n0,{NOON_NS}\n', imports.read_times, {0: NOON_NS}),
    '--clock': (f'robot_ns,arm_ns\n{NOON_NS},{NOON_NS + 1}\n', lambda path: clocks.read_pairs(path).tolist(),
                [[NOON_NS, NOON_NS + 1]]),
    'labels': ('label,since,until\nTür,2026-11-20T12:30,2026-11-20T12:31\n',
               lambda path: [(one.label, one.until_ns - one.since_ns) for one in from_csv(path.read_bytes(), 'thor', 0)],
               [('Tür', 60_000_000_000)]),
}  # fmt: skip
ENCODINGS = {
    'UTF-8': 'utf-8',
    'CSV UTF-8 of Excel': 'utf-8-sig',
    'UTF-16 with a mark': 'utf-16',
    'UTF-16 of the other order': 'utf-16-be',
}


@pytest.mark.parametrize('encoding', ENCODINGS)
@pytest.mark.parametrize('reader', READERS)
@pytest.mark.parametrize('end', ['\n', '\r\n'])
def test_every_reader_takes_what_a_spreadsheet_saves(tmp_path: Path, reader: str, encoding: str, end: str) -> None:
    """The values are those of the plain file, whatever the mark, the order of the bytes and the ends of the lines."""
    text, read, expected = READERS[reader]
    mark = '\ufeff' if encoding.endswith('order') else ''
    path = tmp_path / 'a.csv'
    path.write_bytes((mark + text.replace('\n', end)).encode(ENCODINGS[encoding]))
    assert read(path) == expected


@pytest.mark.parametrize(('separator', 'name'), [(';', 'semicolons'), ('\t', 'tabs')])
@pytest.mark.parametrize('reader', ['trajectory', '--times', '--clock', 'labels'])
def test_other_separators_are_named(tmp_path: Path, reader: str, separator: str, name: str) -> None:
    """Excel uses semicolons where the decimal mark is a comma, and tabs in "Unicode text": the error says what to do."""
    text, read, _ = READERS[reader]
    path = tmp_path / 'a.csv'
    path.write_text(text.replace(',', separator), encoding='utf-8-sig')
    with pytest.raises((SettingError, LakeError, ValueError), match=f'separated by {name}: save it with commas'):
        read(path)


@pytest.mark.parametrize('body', [b'\xff\xfe\x00', b'\xff\xff\xff', b'a,b\n"', b'\xef\xbb\xbf', b''])
@pytest.mark.parametrize('reader', ['--times', '--clock', 'labels'])
def test_what_is_no_text_is_refused_or_empty(tmp_path: Path, reader: str, body: bytes) -> None:
    """Nothing but the reader's own error leaves it."""
    path = tmp_path / 'a.csv'
    path.write_bytes(body)
    found: Any = []
    with suppress(SettingError, LakeError):
        found = READERS[reader][1](path)
    assert len(found) == 0
