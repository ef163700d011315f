"""Which parts of a day count: a compacted part stands for the parts that it was made of, whether those are gone already or not.

A folder is the rows of one robot and one date. What a compacted part was made of stands in its footer, down to the parts that a
robot wrote, so whoever lists a folder at whatever moment of a compaction sees each row once (docs/decisions/0014).
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import zlib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.errors import LakeError
from shadowhound_data_logger.lake.schema import part_key, prefix
from shadowhound_data_logger.lake.source import Entry, Source

LEAVES: Final = 'shadowhound.leaves'
"""Of a compacted part's Parquet metadata: the names of the parts that it was made of, as JSON, zlib, base64."""
FOOTER_BYTES: Final = 1 << 18
_COMPACTED: Final = re.compile(r'_compacted_[0-9a-f]{16}(_mended)?\.parquet$')
_MENDED: Final = re.compile(r'_mended(_[0-9a-f]{16})?\.parquet$')


@dataclass(frozen=True, slots=True)
class Day:
    """One folder of the catalogue, as it was listed."""

    robot: str
    date: str
    entries: tuple[Entry, ...]
    """What is to be read: each row stands in one of them."""
    covered: tuple[Entry, ...]
    """What those stand for and is still there."""
    leaves: frozenset[str]
    """The names of the parts that a robot wrote and ``entries`` hold, as far as compacted ones say so."""

    @property
    def is_mended(self) -> bool:
        """Whether ``reindex`` wrote in it: a row may then stand in two parts, as the robot's own part can come later."""
        return any(_MENDED.search(entry.key) for entry in self.entries)


def folder_of(robot: str, date: str) -> str:
    """What the keys of a robot's parts of a date begin with."""
    return f'{prefix(robot)}date={date}/'


def name_of(key: str) -> str:
    """What tells a part from the others of its folder."""
    return key.rpartition('/')[2]


def compacted_key(robot: str, date: str, leaves: Iterable[str], *, is_mended: bool) -> str:
    """The key of the part that is made of these: the same for all who compact the same."""
    digest = hashlib.sha256('\n'.join(sorted(leaves)).encode()).hexdigest()[:16]
    return part_key(robot, date, f'{date.replace("-", "")}_compacted_{digest}{"_mended" * is_mended}')


def mended_key(robot: str, date: str, keys: Iterable[str]) -> str:
    """The key of a part with rows that ``reindex`` found missing."""
    digest = hashlib.sha256('\n'.join(sorted(keys)).encode()).hexdigest()[:16]
    return part_key(robot, date, f'{date.replace("-", "")}_mended_{digest}')


def is_compacted(key: str) -> bool:
    """Whether it is a part made of parts."""
    return _COMPACTED.search(key) is not None


def encode_leaves(names: Iterable[str]) -> str:
    """As ``LEAVES`` has them."""
    return base64.b64encode(zlib.compress(json.dumps(sorted(names)).encode())).decode('ascii')


def days(
    source: Source,
    robots: Sequence[str],
    dates: Sequence[str] | None,
    pool: Executor,
    has: Callable[[str], bool] = lambda _: True,
) -> list[Day]:
    """The folders of these robots and dates (None: of all that there are, those it ``has``) that hold something, oldest first.

    No other folder is listed, and a footer is read only of compacted parts that do not stand alone. Raises StoreError, LakeError.
    """
    if dates is None:
        pairs = [
            (robot, name[5:])
            for robot in robots
            for name in source.folders(prefix(robot))
            if name.startswith('date=') and has(name[5:])
        ]
    else:
        pairs = [(robot, date) for robot in robots for date in dates]
    found = pool.map(lambda pair: _day(source, *pair), sorted(pairs, key=lambda pair: pair[::-1]))
    return [day for day in found if day.entries]


def _day(source: Source, robot: str, date: str) -> Day:
    entries = [entry for entry in source.list(folder_of(robot, date)) if entry.key.endswith('.parquet')]
    made = [entry for entry in entries if is_compacted(entry.key)]
    leaves = {entry.key: leaves_of(source, entry) for entry in made} if len(entries) > 1 else {}
    return standing(robot, date, entries, leaves)


def standing(robot: str, date: str, entries: Sequence[Entry], leaves: dict[str, frozenset[str]]) -> Day:
    """Of parts and compacted parts: the fullest first, then others that share nothing with it, then parts that none holds.

    Raises LakeError where a part is gone and the compacted part that held it contradicts a fuller one.
    """
    held: set[str] = set()
    stand: list[Entry] = []
    names = {name_of(entry.key) for entry in entries}
    for entry in sorted(entries, key=lambda entry: (-len(leaves.get(entry.key, ())), entry.key)):
        inside = leaves.get(entry.key, frozenset({name_of(entry.key)}))
        if not inside & held:
            stand.append(entry)
            held |= inside
        elif not inside <= held | names:
            raise LakeError(
                f'two compacted parts of {robot} {date} contradict each other, and parts that they were made of are gone',
                remedy=f'move {entry.key} away and run `shadowhound-data lake reindex`', robot=robot, date=date, key=entry.key,
            )  # fmt: skip
    chosen = {entry.key for entry in stand}
    covered = tuple(entry for entry in entries if entry.key not in chosen)
    made = frozenset().union(*(leaves.get(entry.key, frozenset()) for entry in stand))
    return Day(robot, date, tuple(sorted(stand, key=lambda entry: entry.key)), covered, made)


def leaves_of(source: Source, entry: Entry) -> frozenset[str]:
    """What a compacted part says that it was made of. Raises LakeError for a file that does not say it."""
    import pyarrow.parquet as pq  # noqa: PLC0415 - only for days that are between two states

    count = min(entry.size, FOOTER_BYTES)
    while True:
        tail = source.tail(entry.key, count)
        need = int.from_bytes(tail[-8:-4], 'little') + 8
        if need <= len(tail) or count >= entry.size:
            break
        count = min(entry.size, need)
    try:
        about = pq.read_metadata(io.BytesIO(tail)).metadata or {}
        return frozenset(json.loads(zlib.decompress(base64.b64decode(about[LEAVES.encode()]))))
    except (OSError, ValueError, KeyError, zlib.error) as error:
        raise LakeError(f'{entry.key} does not say what it was made of', remedy='is it one of ours?', key=entry.key) from error
