"""Statistics of the numbers in each object, in separate row files: only queries by value read them.

A row is one field of one object (formats/statistics.py). The files are
``<robot>/_stats/date=YYYY-MM-DD/<robot>_<YYYYMMDDTHHMMSS>_<...>.jsonl.zst``; the date is that of ``t_start``, UTC, as in the
catalog. A row can be in two files: a robot writes the last ones again after a power cut.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from shadowhound_data_logger.formats.rows.catalog import DOUBLE, INT32, INT64, STATISTICS_FOLDER, STRING, TIME, Row, TableSchema
from shadowhound_data_logger.formats.statistics import NUMBERS, Statistic, numbers_of

FORMAT_VERSION: Final = 1
"""Version of the rows. Columns are only ever added, at the end."""
STATISTICS: Final = TableSchema(
    folder=STATISTICS_FOLDER,
    columns={
        'robot': STRING,
        'sensor': STRING,
        'bucket': STRING,
        'key': STRING,
        't_start': TIME,
        't_start_ns': INT64,
        'field': STRING,
        'first': DOUBLE,
        'last': DOUBLE,
        'min': DOUBLE,
        'max': DOUBLE,
        'mean': DOUBLE,
        'count': INT64,
        'nan_count': INT64,
        'format_version': INT32,
    },
    required=('bucket', 'key', 'field', 'count', 'nan_count', 'format_version'),
)
"""``robot sensor bucket key t_start t_start_ns`` are those of the object's row in the catalog.

``first last min max mean`` describe the ``count`` finite numbers of a ``field``; ``nan_count`` were NaN or infinite. The row with
an empty ``field`` is about the object: ``count`` messages, and ``nan_count`` fields without statistics.
"""
_OF_OBJECT: Final = ('robot', 'sensor', 'bucket', 'key', 't_start', 't_start_ns')


def statistic_rows(of: Row, found: Mapping[str, Statistic]) -> Iterator[Row]:
    """The statistics rows of an object; ``of`` is its row in the catalog."""
    common = {name: of[name] for name in _OF_OBJECT}
    for field, each in found.items():
        numbers = dict(zip(NUMBERS, numbers_of(each), strict=True))
        yield {**common, 'field': field, **numbers, 'format_version': FORMAT_VERSION}
