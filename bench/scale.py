"""Numbers for fleets of 1, 100 and 10,000 robots, from measured rates: the tables of docs/scale.md and docs/evidence/scale.md.

Run it as ``python bench/scale.py`` to print them, with ``--write`` to update the pages.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

DOCS: Final = Path(__file__).resolve().parents[1] / 'docs'
PAGE: Final = DOCS / 'scale.md'
FLEETS: Final = (1, 100, 10_000)
HOURS: Final = 8
"""Hours per day that a robot works; everything else is for a day of these."""
DAY_S: Final = HOURS * 3600
PART_BYTES, ROW_BYTES = 4000, 81
"""Bytes of a part of the catalog, and of each row in it (measured with the rows of bench/lake.py: 23 take 5.9 KB, 360 take 33
KB).
"""
TABLE_ROW_BYTES: Final = 85
"""Bytes of a row in the table ``objects`` (``bench/fleet.py``, 200,000 rows of 10 robots; a sha256 hardly compresses)."""
PART_S: Final = 60
"""``catalog.period_s``."""
LISTED: Final = 1000
"""Keys per LIST response in S3."""
PUTS_A_CORE: Final = 190
"""Objects of 50 KB confirmed per second, for each of two cores shared by robot and store (docs/evidence/benchmarks.md: 377)."""
INDEX_BYTES: Final = 16
"""Memory of a SeaweedFS volume server per object (its README, "O(1) disk read")."""
FILER_BYTES: Final = 1073
"""Bytes in its filer's LevelDB per object with our metadata (measured on 12,000, its log included)."""
PUT_DOLLARS, GET_DOLLARS, MONTH_DOLLARS = 0.005 / 1000, 0.0004 / 1000, 0.023
"""Prices of one PUT or LIST, one GET, one GB for a month: S3 Standard in us-east-1 as we know it; yours will differ."""
DAYS: Final = 30


@dataclass(frozen=True, slots=True)
class Profile:
    """A parameter file, by what a run of it stored (docs/thor.md)."""

    name: str
    bytes_s: float
    objects_s: float


PROFILES: Final = (
    Profile('default (go2.yaml)', 36e9 / 86_400, 6),
    Profile('default, batches of 10 s as tar', 36e9 / 86_400, 0.8),
    Profile('full rate (go2_full_rate.yaml)', 384e9 / 86_400, 8),
)
"""The second one: camera, lidar, imu, states, joints, odom, lowstate each one object per 10 s, and the calibration hardly ever.
"""


def flow(profile: Profile) -> Iterator[tuple[str, ...]]:
    """Rows: incoming data."""
    for robots in FLEETS:
        objects = robots * profile.objects_s
        yield (
            f'{robots:,}', f'{robots * profile.bytes_s * 8 / 1e6:,.0f} Mbit/s', f'{objects:,.1f}',
            size(robots * profile.bytes_s * DAY_S), size(robots * profile.bytes_s * DAY_S * 365), f'{objects / PUTS_A_CORE:,.2f}',
        )  # fmt: skip


def catalog(profile: Profile) -> Iterator[tuple[str, ...]]:
    """Rows: the rows of a day, and the requests of a query over all robots' day: of row files, and of the tables.

    Row files: a LIST per 1,000 of a robot, and a GET per file. Tables whose row files have expired: two LISTs for each robot
    (are there newer row files of objects, of deletions?) and one GET for its file of that day.
    """
    for robots in FLEETS:
        parts = robots * DAY_S // PART_S
        rows = robots * profile.objects_s * DAY_S
        yield (
            f'{robots:,}', f'{rows:,.0f}', f'{parts:,}', size(parts * PART_BYTES + rows * ROW_BYTES),
            f'{robots * lists(DAY_S // PART_S) + parts:,}', size(rows * TABLE_ROW_BYTES), f'{robots * 3:,}',
        )  # fmt: skip


def lists(keys: int) -> int:
    """Requests for listing this many keys."""
    return -(-keys // LISTED)


def store(profile: Profile) -> Iterator[tuple[str, ...]]:
    """Rows: thirty days of objects in a SeaweedFS, and at a cloud's prices."""
    for robots in FLEETS:
        objects = robots * profile.objects_s * DAY_S * DAYS
        gigabytes = robots * profile.bytes_s * DAY_S * DAYS / 1e9
        parts = robots * DAY_S // PART_S * DAYS
        yield (
            f'{robots:,}', f'{objects:,.0f}', size(objects * FILER_BYTES), size(objects * INDEX_BYTES),
            f'${(objects + parts) * PUT_DOLLARS:,.0f}', f'${gigabytes * MONTH_DOLLARS:,.0f}', f'${objects * GET_DOLLARS:,.0f}',
        )  # fmt: skip


HEADS: Final = {
    'flow': (
        'robots',
        'network, while they work',
        'objects per second',
        'bytes per day',
        'bytes per year',
        'cores that take it',
    ),
    'catalog': (
        'robots',
        'rows per day',
        'row files per day',
        'their size',
        'requests for a day of all',
        'in tables',
        'requests then',
    ),
    'store': (
        'robots',
        'objects in 30 days',
        "filer's metadata",
        "volume servers' memory",
        'PUTs',
        'storage per month',
        'reading all once',
    ),
}
TABLES: Final = {'flow': flow, 'catalog': catalog, 'store': store}
PAGES: Final = {PAGE: ('flow',), DOCS / 'evidence' / 'scale.md': ('catalog', 'store')}
"""Which page has which tables."""


def size(count: float) -> str:
    """Human-readable, in powers of ten."""
    for unit in ('B', 'KB', 'MB', 'GB', 'TB', 'PB'):
        if count < 1000 or unit == 'PB':
            return f'{count:,.0f} {unit}' if count >= 100 or unit == 'B' else f'{count:.2g} {unit}'
        count /= 1000
    raise AssertionError('unreachable')


def markdown(name: str) -> str:
    """One table, all profiles below each other."""
    lines = ['| ' + ' | '.join(('', *HEADS[name])) + ' |', '|' + '---|' * (len(HEADS[name]) + 1)]
    for profile in PROFILES:
        for number, row in enumerate(TABLES[name](profile)):
            lines.append('| ' + ' | '.join(('' if number else profile.name, *row)) + ' |')
    return '\n'.join(lines)


def filled(page: str, names: Sequence[str]) -> str:
    """The page with updated tables."""
    for name in names:
        before, rest = page.split(f'<!-- scale {name} -->\n')
        page = f'{before}<!-- scale {name} -->\n{markdown(name)}\n<!-- end {name} -->{rest.partition(f"<!-- end {name} -->")[2]}'
    return page


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--write', action='store_true', help='into the pages')
    if parser.parse_args(arguments).write:
        for path, names in PAGES.items():
            path.write_text(filled(path.read_text(encoding='utf-8'), names), encoding='utf-8')
        return
    print('\n\n'.join(markdown(name) for name in TABLES))


if __name__ == '__main__':
    main()
