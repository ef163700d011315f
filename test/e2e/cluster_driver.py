"""Queries the tables of a lake with Daft, in this process or on a Ray cluster; used by test_two_nodes.py.

Reads a JSON document: ``runner`` (the address of a cluster, or null), ``table`` (the folder of the tables), ``options`` of S3,
``near`` (x, y, radius), and ``mark``: a file created by tasks that run on another node, which then take a while.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault('DAFT_ANALYTICS_ENABLED', '0')
os.environ.setdefault('DAFT_PROGRESS_BAR', '0')
import daft

SLOW_S = 5.0


def main() -> None:
    given = json.load(sys.stdin)
    if given['runner']:
        import ray

        ray.init(given['runner'], log_to_driver=False)
        daft.set_runner_ray(given['runner'])
    config = daft.io.IOConfig(s3=daft.io.S3Config(**given['options'], use_ssl=False))
    objects = daft.read_deltalake(f'{given["table"]}/objects', io_config=config).where(daft.col('robot').startswith('node-'))
    gaps = daft.read_deltalake(f'{given["table"]}/gaps', io_config=config).where(daft.col('robot').startswith('node-'))
    if given['mark']:
        objects = objects.with_column('x', slowly(given['mark'], here())(daft.col('x')))
    x, y, radius = given['near']
    distance = (daft.col('x') - x) * (daft.col('x') - x) + (daft.col('y') - y) * (daft.col('y') - y)
    json.dump({
        'objects': counts(objects), 'gaps': counts(gaps),
        'near': objects.where((distance <= radius * radius) & (daft.col('battery_pct') < 90)).count_rows(),
    }, sys.stdout)  # fmt: skip


def counts(frame: daft.DataFrame) -> list[list[object]]:
    found = frame.groupby('robot').agg(daft.col('date').count().alias('n')).sort('robot').to_pydict()
    return [list(pair) for pair in zip(found['robot'], found['n'], strict=True)]


def here() -> str:
    import ray

    return str(ray.util.get_node_ip_address())


def slowly(mark: str, asker: str):  # noqa: ANN201 - Daft's
    @daft.func.batch(return_dtype=daft.DataType.float64())
    def same(column: daft.Series) -> daft.Series:
        if here() != asker:
            Path(mark).touch()
            time.sleep(SLOW_S)
        return column

    return same


main()
