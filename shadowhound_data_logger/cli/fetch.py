"""``shadowhound-data fetch``: objects into a folder, by prefix or by query; after an interruption it resumes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich.text import Text

from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    store_hint,
    the_home,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import counted, duration, number, plain, print_json, print_lines, volume
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import asking, question, quietly, report_skipped
from shadowhound_data_logger.lake.bucket import default_source
from shadowhound_data_logger.stores import open_reader

THREADS: Final = 16
"""Objects at a time."""
SHOWN: Final = 20
"""Of what could not be fetched; --json has all."""


@click.command(
    epilog=examples(
        'fetch thor/camera/20251018/ --to data',
        'fetch --sensor camera --since yesterday --near 2.0,6.5,3 --to data',
        'fetch s3://lerobot/datasets/go2/go2_patrol --to go2_patrol',
    )
)
@click.argument('prefix', required=False)
@question
@click.option('--limit', type=click.IntRange(1), metavar='N', help='At most N results.')
@click.option(
    '--to',
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    metavar='DIR',
    help='Where to write it.',
)
@click.option('--bucket', default='sensor-data', show_default=True, help='Bucket of PREFIX.')
@click.option('--deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@as_json
def fetch(*, prefix: str | None, flags: Mapping[str, Any], limit: int | None, to: Path, bucket: str, deep: bool,
          as_json: bool) -> ExitCode:  # fmt: skip
    """Download objects, verified.

    It downloads everything under a PREFIX (thor/camera/20261121/), the objects that the flags select, or a training set
    (s3://lerobot/datasets/...), which becomes the folder DIR. Objects are written to DIR/KEY. A second run downloads only
    what is new. Exit code 1 if something could not be downloaded; it is not an error if nothing matches.
    """
    if prefix is not None and prefix.startswith('s3://') and not flags:
        return _fetch_dataset(prefix, to, is_json=as_json)
    if (prefix is None) == (not flags):
        raise BadUsage('give either a prefix or flags that choose objects', 'shadowhound-data fetch thor/camera/ --to data')
    with asking():
        from shadowhound_data_logger.lake import fetch as lake  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415
        from shadowhound_data_logger.lake.fetched import keep_rows  # noqa: PLC0415

        store = the_store_settings()
        begun_s = time.monotonic()
        left_out = quietly()
        rows = [] if prefix is not None else _asked(flags, limit, left_out)
        requests = list(dict.fromkeys(lake.FetchRequest(row['bucket'], row['key'], row['bytes'], row['sha256']) for row in rows))
        if prefix is not None:
            requests = lake.under(Bucket(store, bucket), prefix)
    size = sum(request.size for request in requests)
    with closing(open_reader(store)) as source, progress(f'0 of {number(len(requests))} objects', size, of='bytes') as bar:
        here = 0

        def tell(size: int, objects: int) -> None:
            nonlocal here
            here += objects
            bar.have(size)
            bar.say(f'{number(here)} of {number(len(requests))} objects')

        found = lake.fetch(requests, to, source, verify=deep, threads=THREADS, tell=tell)
        keep_rows(to, [row for row in rows if f'{row["bucket"]}/{row["key"]}' not in found.failed])
    took_s = time.monotonic() - begun_s
    if as_json:
        report = {'to': str(to), 'asked': len(requests), 'moved': found.moved, 'present': found.present, 'bytes': found.bytes,
                'unverified': found.unverified, 'failed': found.failed, 'left_out': [asdict(one) for one in left_out],
                'took_s': round(took_s, 3)}  # fmt: skip
        print_json(report)
    else:
        where = f'{"" if prefix is None else f"under {prefix} "}in {Bucket(store, bucket).describe()}'
        print_lines(*_report(found, len(requests), took_s, to, where))
        report_skipped(left_out)
    return exit_code(finding=found.failed or len(left_out))


def _fetch_dataset(url: str, to: Path, *, is_json: bool) -> ExitCode:
    with asking():
        from shadowhound_data_logger.datasets.export import remember  # noqa: PLC0415
        from shadowhound_data_logger.datasets.transfer import DatasetPlace, fetch_dataset  # noqa: PLC0415

        place = DatasetPlace.of(url)
    with closing(open_reader(the_store_settings())) as store, progress('looking at what there is') as bar:
        moved = fetch_dataset(place, to, store, bar.say)
    remember(the_home(), to)
    if is_json:
        print_json({'to': str(to), **asdict(moved)})
    else:
        print_lines(plain(f'{counted(moved.files, "file")} ({volume(moved.bytes)}) of {place} fetched to {to}.'))
    return ExitCode.FINE


def _asked(flags: Mapping[str, Any], limit: int | None, left_out: Any) -> list[dict[str, Any]]:
    """The rows of the catalog."""
    from shadowhound_data_logger.lake import query as lake  # noqa: PLC0415 - the extra lake
    from shadowhound_data_logger.lake.names import check_names  # noqa: PLC0415

    source = default_source(the_store_settings())
    rows = lake.objects(source, findings=left_out, order='t_start_ns', limit=limit, **flags)
    found: list[dict[str, Any]] = rows.to_pylist()
    if not found:
        check_names(source, left_out, **flags)
    return found


def _report(found: Any, asked: int, took_s: float, to: Path, where: str) -> Iterator[Text]:
    if not asked:
        yield plain(f'No objects {where} match: nothing to fetch.{store_hint()}')
        return
    rate = f', {volume(found.bytes / took_s)}/s' if found.moved and took_s else ''
    yield plain(f'{number(found.moved)} objects ({volume(found.bytes)}) downloaded to {to} in {duration(took_s)}{rate}; '
                f'{number(found.present)} were there already.')  # fmt: skip
    if found.unverified:
        yield plain(f'{number(found.unverified)} have no checksum in the store: their sizes are right.', 'yellow')
    for key, why in list(found.failed.items())[:SHOWN]:
        yield plain(f'  {key}: {why}', 'red')
    if found.failed:
        yield plain(f'{number(len(found.failed))} could not be fetched; run it again to try only those.', 'red')
