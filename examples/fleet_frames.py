"""Finds the sharp frames of a fleet with several worker processes: query the catalog, fetch the frames, decode and rate them.

    python examples/fleet_frames.py --since yesterday --near=-0.6,3.1,2 --workers 4
    python examples/fleet_frames.py --since yesterday --runner ray --address ray://HEAD:10001 --workers 64

The query and the code are the same on a laptop (Daft's own runner, processes) and on a Ray cluster (``pip install 'daft[ray]'``).
Frames never reach this process: workers return two numbers for each. Sharpness is the variance of the Laplacian, which is small
for
blurred frames.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.lake import decode, query
from shadowhound_data_logger.lake.prefetch import Place, Prefetch
from shadowhound_data_logger.lake.track import Object

os.environ.setdefault('DAFT_ANALYTICS_ENABLED', '0')  # otherwise Daft sends telemetry for each run
os.environ.setdefault('DAFT_PROGRESS_BAR', '0')
import daft  # isort: skip
from daft import DataType, Series, col  # isort: skip

THREADS = 8
ROWS = 64
"""Frames per batch of a worker."""
RATING = DataType.struct({'sharpness': DataType.float64(), 'brightness': DataType.float64()})


class FrameRater:
    """Runs in a worker. It gets the location of the store; its repr contains no secret, so plans and logs do not either."""

    def __init__(self, place: Place) -> None:
        self._place = place

    @daft.method.batch(return_dtype=RATING, batch_size=ROWS)
    def rate(self, bucket: Series, key: Series, size: Series, sha256: Series) -> list[dict[str, float | None]]:
        """The rating of each frame; nulls for one that can no longer be read."""
        columns = (each.to_pylist() for each in (bucket, key, size, sha256))
        objects = [Object(one, two, three, four or '') for one, two, three, four in zip(*columns, strict=True)]
        found = []
        with Prefetch(self._place.read, 1, THREADS) as prefetch:
            prefetch.ahead(objects)
            for each in objects:
                try:
                    found.append(rated(decode.image(prefetch.get(each))))
                except DataLoggerError:
                    found.append({'sharpness': None, 'brightness': None})
        return found


def rated(pixels: Any) -> dict[str, float | None]:
    """Sharpness and mean brightness of an image, by its green channel, which contributes most to perceived brightness."""
    gray = (pixels[..., 1] if pixels.ndim == 3 else pixels).astype(np.float32)
    inner = gray[1:-1, 1:-1]
    laplacian = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * inner
    return {'sharpness': float(np.var(laplacian)), 'brightness': float(gray.mean())}


def frames(place: Place, workers: int, least: float, **flags: Any) -> daft.DataFrame:
    """A lazy frame: the rows of the sharp frames and their sharpness, the sharpest first."""
    rate = daft.cls(FrameRater, use_process=True, max_concurrency=workers)(place)
    columns = ('robot', 'bucket', 'key', 't_start', 'x', 'y', 'bytes', 'sha256', 'content_type')
    rows = daft.from_arrow(query.objects(sensor='camera', columns=columns, **flags))
    told = rows.where(col('content_type').is_in(['image/jpeg', 'image/png'])).into_batches(ROWS)
    made = told.with_column('judged', rate.rate(col('bucket'), col('key'), col('bytes'), col('sha256')))
    plain = made.select('robot', 'key', 't_start', 'x', 'y', col('judged').get('sharpness').alias('sharpness'),
                        col('judged').get('brightness').alias('brightness'))  # fmt: skip
    return plain.where(col('sharpness') >= least).sort('sharpness', desc=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    options = _parser().parse_args(arguments)
    if options.runner == 'ray':
        daft.set_runner_ray(options.address)
    else:
        daft.set_runner_native()
    place = Place(store_settings(os.environ, home(os.environ)))
    names = ('robot', 'since', 'until', 'near', 'mission_type', 'where')
    flags = {name: getattr(options, name) for name in names if getattr(options, name)}
    try:
        began = time.perf_counter()
        found = frames(place, options.workers, options.least, **flags).to_pydict()
        took = time.perf_counter() - began
    except DataLoggerError as error:
        print(f'fleet_frames: {error}', file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps({'frames': len(found['key']), 'took_s': round(took, 3), 'keys': found['key']}))
        return 0
    for robot, key, sharpness, brightness in list(zip(*(found[name] for name in ('robot', 'key', 'sharpness', 'brightness')),
                                                      strict=True))[: options.show]:  # fmt: skip
        print(f'{sharpness:10.1f} {brightness:6.1f}  {robot}  {key}')
    print(
        f'{len(found["key"])} frames of a sharpness of {options.least:g} or more, by {options.workers} processes in {took:.1f} s'
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='fleet_frames', description=__doc__.partition('\n')[0])
    for name, text in (('robot', 'of this robot'), ('since', 'yesterday, 2h, ...'), ('until', 'likewise'), ('near', 'X,Y,RADIUS'),
                       ('mission-type', 'such as patrol'), ('where', 'SQL, such as battery_pct < 30')):  # fmt: skip
        parser.add_argument(f'--{name}', help=text)
    parser.add_argument('--least', type=float, default=0.0, help='sharpness of what is shown')
    parser.add_argument('--workers', type=int, default=2, help='processes')
    parser.add_argument('--runner', choices=('native', 'ray'), default='native')
    parser.add_argument('--address', help='of a Ray cluster; without one Ray is started on this machine')
    parser.add_argument('--show', type=int, default=10, metavar='N', help='lines')
    parser.add_argument('--json', action='store_true')
    return parser


if __name__ == '__main__':
    code = main()
    sys.stdout.flush()
    os._exit(
        code
    )  # Daft's threads keep running after its workers: the interpreter's shutdown occasionally crashed because of them
