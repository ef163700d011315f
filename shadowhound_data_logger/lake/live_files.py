"""Which parts of a day are live: a compacted part supersedes its sources, whether or not they have been deleted yet.

A folder has the rows of one robot and one date. The footer of a compacted part names its sources, down to the parts that a robot
wrote, so a reader who lists the folder at any moment of a compaction sees each row once (docs/decisions/0014).
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

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.formats.rows.schema import OBJECTS, SUFFIX, TableSchema
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings

SOURCES: Final = 'shadowhound.leaves'
"""The key in a compacted part's Parquet metadata; its value: the names of its sources, as JSON, zlib, base64."""
MOST_SOURCES_BYTES: Final = 8 << 20
"""The longest such list, as JSON: 100,000 parts."""
UNLISTED: Final = 'it cannot be listed: it contains an invalid name'
_FOLDER: Final = re.compile(r'date=\d{4}-\d\d-\d\d', re.ASCII)
_COMPACTED: Final = re.compile(r'_compacted_[0-9a-f]{16}(_mended)?\.parquet$')
_BACKFILLED: Final = re.compile(r'_mended(_[0-9a-f]{16})?\.(parquet|jsonl\.zst)$')


@dataclass(frozen=True, slots=True)
class Day:
    """One folder of the catalogue or the gap journal, as it was listed."""

    robot: str
    date: str
    entries: tuple[ObjectInfo, ...]
    """The live files: each row is in one of them."""
    superseded: tuple[ObjectInfo, ...]
    """Sources of live files that have not been deleted yet."""
    sources: Mapping[str, frozenset[str]]
    """Key of a compacted part among ``entries`` -> the names of the robot's parts that it holds. Omits a part that is alone."""

    @property
    def is_backfilled(self) -> bool:
        """Whether ``reindex`` added a part: a row may then be in two parts, because the robot's own part can come later."""
        return any(_BACKFILLED.search(entry.key) for entry in self.entries)


def folder_of(robot: str, date: str, of: TableSchema = OBJECTS) -> str:
    """The prefix of the keys of a robot's parts of a date."""
    return f'{of.prefix(robot)}date={date}/'


def name_of(key: str) -> str:
    """The name of a part in its folder."""
    return key.rpartition('/')[2]


def compacted_key(robot: str, date: str, sources: Iterable[str], *, is_backfilled: bool, of: TableSchema = OBJECTS) -> str:
    """The key of the part that is made from these sources: the same whoever makes it."""
    digest = hashlib.sha256('\n'.join(sorted(sources)).encode()).hexdigest()[:16]
    name = f'{date.replace("-", "")}_compacted_{digest}{"_mended" * is_backfilled}'
    return of.part_key(robot, date, name).removesuffix(SUFFIX) + '.parquet'


def backfilled_key(robot: str, date: str, keys: Iterable[str], of: TableSchema = OBJECTS) -> str:
    """The key of a part with rows that were missing (``reindex``); ``_mended`` in it is part of the format."""
    digest = hashlib.sha256('\n'.join(sorted(keys)).encode()).hexdigest()[:16]
    return of.part_key(robot, date, f'{date.replace("-", "")}_mended_{digest}')


def is_compacted(key: str) -> bool:
    """Whether this is the key of a compacted part."""
    return _COMPACTED.search(key) is not None


def encode_sources(names: Iterable[str]) -> str:
    """The value of ``SOURCES`` for these names."""
    return base64.b64encode(zlib.compress(json.dumps(sorted(names)).encode())).decode('ascii')


def robots(source: Bucket) -> list[str]:
    """Robots that have a folder. Raises StoreError."""
    return [name for name in source.folders('') if is_name(name)]


def dates_of(source: Bucket, robot: str, findings: Findings, of: TableSchema = OBJECTS) -> list[str]:
    """The dates for which a robot has rows. Raises StoreError."""
    try:
        return [name[5:] for name in source.folders(of.prefix(robot)) if _FOLDER.fullmatch(name)]
    except ObjectRefused as error:
        findings.add(of.prefix(robot), f'{UNLISTED}: {error}')
        return []


def days(source: Bucket, named: Sequence[str], dates: Sequence[str] | None, pool: Executor, findings: Findings,
         has: Callable[[str], bool] = lambda _: True, of: TableSchema = OBJECTS) -> list[Day]:  # fmt: skip
    """The folders of these robots and dates that are not empty, oldest first. ``dates`` None: all for which ``has`` is true.

    Lists no other folder, and reads footers only of compacted parts that share their folder. Raises StoreError.
    """
    pairs = [(robot, date) for robot in named
             for date in (filter(has, dates_of(source, robot, findings, of)) if dates is None else dates)]  # fmt: skip
    found = pool.map(lambda pair: _day(source, pair[0], pair[1], findings, of), sorted(pairs, key=lambda pair: pair[::-1]))
    return [day for day in found if day.entries]


def _day(source: Bucket, robot: str, date: str, findings: Findings, of: TableSchema) -> Day:
    """A part whose list of sources is invalid or contradicts another is left out: neither live nor superseded."""
    try:
        listed = source.list(folder_of(robot, date, of), lambda _, key: findings.add(key, 'its key is not a path'))
        entries = [entry for entry in listed if entry.key.endswith(('.parquet', SUFFIX))]
    except ObjectRefused as error:
        findings.add(folder_of(robot, date, of), f'{UNLISTED}: {error}')
        entries = []
    sources: dict[str, frozenset[str]] = {}
    for entry in [entry for entry in entries if is_compacted(entry.key)] if len(entries) > 1 else []:
        try:
            sources[entry.key] = sources_of(source, entry)
        except LakeError as error:
            findings.add(entry.key, str(error))
            entries.remove(entry)
    while True:
        try:
            return live_files(robot, date, entries, sources)
        except LakeError as error:
            findings.add(error.data['key'], str(error))
            entries = [entry for entry in entries if entry.key != error.data['key']]


def live_files(robot: str, date: str, entries: Sequence[ObjectInfo], sources: dict[str, frozenset[str]]) -> Day:
    """Choose the live files: the compacted part with the most sources, others that share none with it, then parts in neither.

    Raises LakeError where a part is gone and the compacted part that held it contradicts a fuller one.
    """
    held: set[str] = set()
    live: list[ObjectInfo] = []
    names = {name_of(entry.key) for entry in entries}
    for entry in sorted(entries, key=lambda entry: (-len(sources.get(entry.key, ())), entry.key)):
        inside = sources.get(entry.key, frozenset({name_of(entry.key)}))
        if not inside & held:
            live.append(entry)
            held |= inside
        elif not inside <= held | names:
            raise LakeError(
                f'it contradicts another compacted part of {robot} {date}, and parts that they were made of are gone',
                remedy=f'move {entry.key} away and run `shadowhound-data lake reindex`', robot=robot, date=date, key=entry.key,
            )  # fmt: skip
    chosen = {entry.key for entry in live}
    superseded = tuple(entry for entry in entries if entry.key not in chosen)
    made = {entry.key: sources[entry.key] for entry in live if entry.key in sources}
    return Day(robot, date, tuple(sorted(live, key=lambda entry: entry.key)), superseded, made)


def sources_of(source: Bucket, entry: ObjectInfo) -> frozenset[str]:
    """The sources that a compacted part names. Raises LakeError for a file without a valid list."""
    from shadowhound_data_logger.lake import reading  # noqa: PLC0415 - pyarrow, only for days that are between two states

    try:
        packed = base64.b64decode(reading.footer(source, entry)[SOURCES.encode()], validate=True)
        names = from_json(zlib.decompressobj().decompress(packed, MOST_SOURCES_BYTES + 1), MOST_SOURCES_BYTES)
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError('not a list of names')
    except (*reading.UNREADABLE, zlib.error) as error:
        text = f'its list of sources is invalid: {error or type(error).__name__}'
        raise LakeError(text, remedy='was it written by `lake compact`?', key=entry.key) from error
    return frozenset(names)


@dataclass(frozen=True, slots=True)
class CatalogueState:
    """What one robot's catalogue consists of."""

    robot: str
    days: int
    first: str
    """Date, as all dates UTC."""
    last: str
    files: int
    size: int
    """Bytes of all files."""
    compacted: int
    """Days with one file."""
    open_days: int
    """Days that are over and have several files."""
    covered: int
    """Superseded files that have not been deleted yet."""


def state(source: Bucket, robot: str | None = None, findings: Findings | None = None) -> list[CatalogueState]:
    """The state of one robot's catalogue, or of all. Raises StoreError."""
    findings = Findings() if findings is None else findings
    today = f'{utc(time.time_ns()):%Y-%m-%d}'
    with ThreadPoolExecutor(THREADS) as pool:
        found = {name: days(source, [name], None, pool, findings) for name in ([robot] if robot else robots(source))}
    return [_state(name, each, today) for name, each in found.items() if each]


def _state(robot: str, found: Iterable[Day], today: str) -> CatalogueState:
    each = list(found)
    entries = [entry for day in each for entry in (*day.entries, *day.superseded)]
    return CatalogueState(
        robot=robot, days=len(each), first=each[0].date, last=each[-1].date, files=len(entries),
        size=sum(entry.size for entry in entries), covered=sum(len(day.superseded) for day in each),
        compacted=sum(len(day.entries) == 1 and is_compacted(day.entries[0].key) for day in each),
        open_days=sum(len(day.entries) > 1 and day.date < today for day in each),
    )  # fmt: skip
