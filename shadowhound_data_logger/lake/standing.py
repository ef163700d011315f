"""Which parts of a day count: a compacted part stands for the parts that it was made of, whether those are gone already or not.

A folder is the rows of one robot and one date. What a compacted part was made of stands in its footer, down to the parts that a
robot wrote, so whoever lists a folder at whatever moment of a compaction sees each row once (docs/decisions/0014).
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import time
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.catalogue.schema import OBJECTS, TableSchema
from shadowhound_data_logger.clock import utc
from shadowhound_data_logger.errors import LakeError, ObjectRefused
from shadowhound_data_logger.keys import is_name
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.untrusted import from_json

LEAVES: Final = 'shadowhound.leaves'
"""Of a compacted part's Parquet metadata: the names of the parts that it was made of, as JSON, zlib, base64."""
MOST_LEAVES_BYTES: Final = 8 << 20
"""Of such a list, as JSON: 100,000 parts."""
UNLISTED: Final = 'it cannot be listed, since a name in it is none'
_FOLDER: Final = re.compile(r'date=\d{4}-\d\d-\d\d', re.ASCII)
_COMPACTED: Final = re.compile(r'_compacted_[0-9a-f]{16}(_mended)?\.parquet$')
_MENDED: Final = re.compile(r'_mended(_[0-9a-f]{16})?\.parquet$')


@dataclass(frozen=True, slots=True)
class Day:
    """One folder of the catalogue or the gap journal, as it was listed."""

    robot: str
    date: str
    entries: tuple[ObjectInfo, ...]
    """What is to be read: each row stands in one of them."""
    covered: tuple[ObjectInfo, ...]
    """What those stand for and is still there."""
    leaves: Mapping[str, frozenset[str]]
    """Key of a compacted part among ``entries`` -> the names of the robot's parts that it holds; not of one that is alone."""

    @property
    def is_mended(self) -> bool:
        """Whether ``reindex`` wrote in it: a row may then stand in two parts, as the robot's own part can come later."""
        return any(_MENDED.search(entry.key) for entry in self.entries)


def folder_of(robot: str, date: str, of: TableSchema = OBJECTS) -> str:
    """What the keys of a robot's parts of a date begin with."""
    return f'{of.prefix(robot)}date={date}/'


def name_of(key: str) -> str:
    """What tells a part from the others of its folder."""
    return key.rpartition('/')[2]


def compacted_key(robot: str, date: str, leaves: Iterable[str], *, is_mended: bool, of: TableSchema = OBJECTS) -> str:
    """The key of the part that is made of these: the same for all who compact the same."""
    digest = hashlib.sha256('\n'.join(sorted(leaves)).encode()).hexdigest()[:16]
    return of.part_key(robot, date, f'{date.replace("-", "")}_compacted_{digest}{"_mended" * is_mended}')


def mended_key(robot: str, date: str, keys: Iterable[str]) -> str:
    """The key of a part with rows that ``reindex`` found missing."""
    digest = hashlib.sha256('\n'.join(sorted(keys)).encode()).hexdigest()[:16]
    return OBJECTS.part_key(robot, date, f'{date.replace("-", "")}_mended_{digest}')


def is_compacted(key: str) -> bool:
    """Whether it is a part made of parts."""
    return _COMPACTED.search(key) is not None


def encode_leaves(names: Iterable[str]) -> str:
    """As ``LEAVES`` has them."""
    return base64.b64encode(zlib.compress(json.dumps(sorted(names)).encode())).decode('ascii')


def robots(source: Bucket) -> list[str]:
    """Those that have a folder. Raises StoreError."""
    return [name for name in source.folders('') if is_name(name)]


def dates_of(source: Bucket, robot: str, findings: Findings, of: TableSchema = OBJECTS) -> list[str]:
    """The dates of which a robot has rows. Raises StoreError."""
    try:
        return [name[5:] for name in source.folders(of.prefix(robot)) if _FOLDER.fullmatch(name)]
    except ObjectRefused as error:
        findings.add(of.prefix(robot), f'{UNLISTED}: {error}')
        return []


def days(source: Bucket, named: Sequence[str], dates: Sequence[str] | None, pool: Executor, findings: Findings,
         has: Callable[[str], bool] = lambda _: True, of: TableSchema = OBJECTS) -> list[Day]:  # fmt: skip
    """The folders of these robots and dates (None: of all that there are, those it ``has``) that hold something, oldest first.

    No other folder is listed, and a footer is read only of compacted parts that do not stand alone. Raises StoreError.
    """
    pairs = [(robot, date) for robot in named
             for date in (filter(has, dates_of(source, robot, findings, of)) if dates is None else dates)]  # fmt: skip
    found = pool.map(lambda pair: _day(source, pair[0], pair[1], findings, of), sorted(pairs, key=lambda pair: pair[::-1]))
    return [day for day in found if day.entries]


def _day(source: Bucket, robot: str, date: str, findings: Findings, of: TableSchema) -> Day:
    """What a part says that is no good, or contradicts others, is left out: neither read nor stood for."""
    try:
        entries = [entry for entry in source.list(folder_of(robot, date, of)) if entry.key.endswith('.parquet')]
    except ObjectRefused as error:
        findings.add(folder_of(robot, date, of), f'{UNLISTED}: {error}')
        entries = []
    leaves: dict[str, frozenset[str]] = {}
    for entry in [entry for entry in entries if is_compacted(entry.key)] if len(entries) > 1 else []:
        try:
            leaves[entry.key] = leaves_of(source, entry)
        except LakeError as error:
            findings.add(entry.key, str(error))
            entries.remove(entry)
    while True:
        try:
            return standing(robot, date, entries, leaves)
        except LakeError as error:
            findings.add(error.data['key'], str(error))
            entries = [entry for entry in entries if entry.key != error.data['key']]


def standing(robot: str, date: str, entries: Sequence[ObjectInfo], leaves: dict[str, frozenset[str]]) -> Day:
    """Of parts and compacted parts: the fullest first, then others that share nothing with it, then parts that none holds.

    Raises LakeError where a part is gone and the compacted part that held it contradicts a fuller one.
    """
    held: set[str] = set()
    stand: list[ObjectInfo] = []
    names = {name_of(entry.key) for entry in entries}
    for entry in sorted(entries, key=lambda entry: (-len(leaves.get(entry.key, ())), entry.key)):
        inside = leaves.get(entry.key, frozenset({name_of(entry.key)}))
        if not inside & held:
            stand.append(entry)
            held |= inside
        elif not inside <= held | names:
            raise LakeError(
                f'it contradicts another compacted part of {robot} {date}, and parts that they were made of are gone',
                remedy=f'move {entry.key} away and run `shadowhound-data lake reindex`', robot=robot, date=date, key=entry.key,
            )  # fmt: skip
    chosen = {entry.key for entry in stand}
    covered = tuple(entry for entry in entries if entry.key not in chosen)
    made = {entry.key: leaves[entry.key] for entry in stand if entry.key in leaves}
    return Day(robot, date, tuple(sorted(stand, key=lambda entry: entry.key)), covered, made)


def leaves_of(source: Bucket, entry: ObjectInfo) -> frozenset[str]:
    """What a compacted part says that it was made of. Raises LakeError for a file that does not say it."""
    from shadowhound_data_logger.lake import reading  # noqa: PLC0415 - pyarrow, only for days that are between two states

    try:
        packed = base64.b64decode(reading.footer(source, entry)[LEAVES.encode()], validate=True)
        names = from_json(zlib.decompressobj().decompress(packed, MOST_LEAVES_BYTES + 1), MOST_LEAVES_BYTES)
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError('that is no list of names')
    except (*reading.UNREADABLE, zlib.error) as error:
        text = f'it does not say what it was made of: {error or type(error).__name__}'
        raise LakeError(text, remedy='is it one of ours?', key=entry.key) from error
    return frozenset(names)


@dataclass(frozen=True, slots=True)
class CatalogueState:
    """Of one robot's catalogue."""

    robot: str
    days: int
    first: str
    """Date, as all dates UTC."""
    last: str
    files: int
    size: int
    """Bytes of all of them."""
    compacted: int
    """Days that are one file."""
    open_days: int
    """Days that are over and have several."""
    covered: int
    """Files that others stand for: they only take room."""


def state(source: Bucket, robot: str | None = None, findings: Findings | None = None) -> list[CatalogueState]:
    """Of all robots that have a catalogue. Raises StoreError."""
    findings = Findings() if findings is None else findings
    today = f'{utc(time.time_ns()):%Y-%m-%d}'
    with ThreadPoolExecutor(THREADS) as pool:
        found = {name: days(source, [name], None, pool, findings) for name in ([robot] if robot else robots(source))}
    return [_state(name, each, today) for name, each in found.items() if each]


def _state(robot: str, found: Iterable[Day], today: str) -> CatalogueState:
    each = list(found)
    entries = [entry for day in each for entry in (*day.entries, *day.covered)]
    return CatalogueState(
        robot=robot, days=len(each), first=each[0].date, last=each[-1].date, files=len(entries),
        size=sum(entry.size for entry in entries), covered=sum(len(day.covered) for day in each),
        compacted=sum(len(day.entries) == 1 and is_compacted(day.entries[0].key) for day in each),
        open_days=sum(len(day.entries) > 1 and day.date < today for day in each),
    )  # fmt: skip
