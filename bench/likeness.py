"""Similarity search over a day of images at 1 Hz: 86,400 vectors of 512 numbers, relative to one product of plain numpy.

Run it as ``python bench/likeness.py [--vectors 86400] [--numbers 512] [--json]``. Only the search is measured, as the answer
needs it: reading the parts and the catalog's rows is separate (``read_s``).
"""

from __future__ import annotations

import argparse
import hashlib
import statistics
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from _report import Bar, Report, main, progress

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import BUCKET, OBJECTS, row_of
from shadowhound_data_logger.lake import likeness
from shadowhound_data_logger.lake.bucket import Bucket, put_part
from shadowhound_data_logger.stores import open_store

FIRST_NS: Final = 1_790_812_800 * SECOND
"""2026-10-01T00:00:00Z."""
SEARCH_S: Final = 0.2
ROUNDS: Final = 7
LIMIT: Final = 30


class Numbers:
    """A stand-in for a model: its vectors are random."""

    name, digest = 'drawn numbers', hashlib.sha256(b'drawn').hexdigest()


def measure(options: argparse.Namespace) -> Report:
    model: Any = Numbers()
    rng = np.random.default_rng(1)
    vectors = rng.standard_normal((options.vectors, options.numbers), np.float32)
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype('<f2')
    wanted = vectors[1].astype(np.float32)
    searched, plain = [], []
    for _ in range(ROUNDS):
        began_s = time.perf_counter()
        found, scores = likeness.nearest(vectors, wanted, LIMIT)
        searched.append(time.perf_counter() - began_s)
        began_s = time.perf_counter()
        whole = vectors.astype(np.float32) @ wanted
        expected = np.argsort(-whole, kind='stable')[:LIMIT]
        plain.append(time.perf_counter() - began_s)
        assert found.tolist() == expected.tolist()
        assert scores.tolist() == whole[expected].tolist()
    options.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        settings = StoreSettings(directory=Path(folder) / 'store')
        rows = []
        with closing(open_store(settings, UploadSettings())) as store:
            for place in range(options.vectors):
                stamp = str(FIRST_NS + place * SECOND * 86_400 // options.vectors)
                about = {'robot': 'thor', 'sensor': 'camera', 'count': '1', 't_start_ns': stamp, 't_end_ns': stamp,
                         'sha256': hashlib.sha256(stamp.encode()).hexdigest()}  # fmt: skip
                rows.append(
                    row_of(BUCKET, f'thor/camera/{utc(int(stamp)):%Y%m%d/%H%M%S}_{place}.jpg', 50_000, 'image/jpeg', about)
                )
            progress('the day is written')
            put_part(store, OBJECTS.part_key('thor', '2026-10-01', 'bench'), 'thor', parts.encode(rows), len(rows))
            for start in range(0, len(rows), 4096):
                few = enumerate(rows[start : start + 4096])
                some = [(bytes.fromhex(str(row['sha256'])), vectors[start + place]) for place, row in few]
                likeness.put_vectors(store, model, 'thor', '2026-10-01', some)
        progress('and asked for')
        began_s = time.perf_counter()
        answer = likeness.like(Bucket(settings, BUCKET), model, wanted, limit=LIMIT)
        whole_s = time.perf_counter() - began_s
        assert answer.without == 0
        assert answer.rows['key'].to_pylist()[0] == rows[1]['key']
        size = sum(path.stat().st_size for path in (settings.directory / BUCKET / '_vectors').rglob('*.parquet'))
    search_s, took_ms = statistics.median(searched), tuple(1000 * each for each in searched)
    ratios = [one / other for one, other in zip(searched, plain, strict=True)]
    ratio = statistics.median(ratios)
    what = f'search of {options.vectors:,} vectors of {options.numbers}'
    return Report(
        (
            Bar(what, f'under {1000 * SEARCH_S:g} ms', 1000 * search_s, 'ms', search_s < SEARCH_S, took_ms),
            Bar(f'{what} against one product of numpy', 'at most 1.5', ratio, 'of it', ratio <= 1.5, tuple(ratios)),
        ),
        {'vectors': options.vectors, 'numbers': options.numbers, 'search_ms': 1000 * search_s, 'whole_s': whole_s, 'bytes': size},
    )  # fmt: skip


def more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--vectors', type=int, default=86_400)
    parser.add_argument('--numbers', type=int, default=512)


if __name__ == '__main__':
    main(__doc__, measure, seconds=0.0, more=more)
