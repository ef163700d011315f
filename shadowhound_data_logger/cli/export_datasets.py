"""``shadowhound-data export verify``, ``where`` and ``drop``: datasets that were exported."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click
from rich.text import Text

from shadowhound_data_logger.cli.common import (
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_home,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import counted, number, plain, print_json, print_lines
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import quietly
from shadowhound_data_logger.core.errors import TrackingError
from shadowhound_data_logger.stores import open_reader

if TYPE_CHECKING:
    from shadowhound_data_logger.datasets.transfer import DatasetPlace
    from shadowhound_data_logger.datasets.verify import DatasetUse, VerifyResult

from shadowhound_data_logger.cli.export import COPIES, SCHEME, SHOWN, copy_of, exporting

_place = click.argument('place', metavar='DIR|s3://...')


@click.command('verify', epilog=examples('export verify go2_patrol', 'export verify s3://lerobot/datasets/go2/go2_patrol --all'))
@_place
@click.option('--all', 'is_all', is_flag=True, help='Compare every frame with its source, instead of five per episode.')
@click.option('--deep', 'is_deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@as_json
def export_verify(*, place: str, is_all: bool, is_deep: bool, as_json: bool) -> ExitCode:
    """Verify a dataset against its sources.

    It checks that the files are intact, the sources unchanged, and the images those of their sources.

    Exit code 1 when something is wrong.
    """
    with exporting():
        from shadowhound_data_logger.datasets import verify as library  # noqa: PLC0415
        from shadowhound_data_logger.datasets.transfer import DatasetPlace, fetch_dataset  # noqa: PLC0415

        stored = DatasetPlace.of(place) if place.startswith(SCHEME) else None
    with TemporaryDirectory() as temporary, progress('files') as bar, closing(open_reader(the_store_settings())) as store:
        folder = Path(place)
        if stored is not None:
            folder = Path(temporary)
            fetch_dataset(stored, folder, store, bar.say)
        found = library.verify(folder, store, frames=None if is_all else library.FRAMES, is_read=is_deep, forgotten=_forgotten,
                               say=bar.say)  # fmt: skip
    if as_json:
        print_json(asdict(found))
    else:
        print_lines(*_proof(found, place))
    return exit_code(finding=found.wrong)


def _proof(found: VerifyResult, place: str) -> Iterator[Text]:
    for wrong in found.wrong[:SHOWN]:
        yield plain(f'  {wrong}', 'red')
    verdict = f'{number(len(found.wrong))} problems' if found.wrong else 'everything is unchanged'
    like = '' if not found.frames else f', {number(found.frames)} frames compared (lowest SSIM {found.least_ssim:.3f})'
    yield plain(f'{place}: {counted(found.episodes, "episode")}, {counted(found.files, "file")}, '
                f'{counted(found.sources, "source")}{like}: {verdict}.')  # fmt: skip


@click.command('where', epilog=examples('export where sensor-data/thor/camera/20261121/120000_front.jpg'))
@click.argument('key')
@click.option('--in', 'places', multiple=True, metavar='DIR|s3://...',
              help='Only in this dataset  [default: all on this machine and in the bucket lerobot]')  # fmt: skip
@as_json
def export_where(*, key: str, places: tuple[str, ...], as_json: bool) -> ExitCode:
    """Find the datasets and models that contain an object.

    Models are found through the MLflow runs that lake.log_dataset marked. Exit code 1 if MLflow cannot be queried.
    """
    with exporting():
        from shadowhound_data_logger.lake.training import runs_trained_on  # noqa: PLC0415
    found = list(_uses(key, places))
    runs, unknown = dict[str, list[str]](), None
    try:
        runs = runs_trained_on(digest for each in found for digest in each.digests)
    except TrackingError as error:
        unknown = error
        click.echo(f'Which models were trained on it is not known: {error}', err=True)
    uses = [
        {**asdict(each), 'runs': None if unknown else sorted({run for digest in each.digests for run in runs[digest]})}
        for each in found
    ]
    if as_json:
        print_json(uses)
        return exit_code(finding=unknown)
    lines = []
    if (date := _date_of(key)) is not None:
        lines.append(plain(f'It was deleted from the store on {date} (lake prune).'))
    for each in uses:
        lines.append(plain(f'{each["where"]}: {number(each["frames"])} frames of {", ".join(each["missions"])}'))
        lines += [plain(f'  trained on it: run {run}') for run in each['runs'] or ()]
    print_lines(*lines, *([] if uses else [plain(f'No dataset has values of {key}.')]))
    return exit_code(finding=unknown)


def _date_of(key: str) -> str | None:
    """On which date an object was deleted on purpose; named as ``KEY`` or ``BUCKET/KEY``."""
    return next((date for (bucket, name), date in _forgotten().items() if key in {name, f'{bucket}/{name}'}), None)


def _forgotten() -> Mapping[tuple[str, str], str]:
    """(bucket, key) -> the date on which it was deleted from the store on purpose."""
    from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
    from shadowhound_data_logger.lake.prune import dates_of_deletion, forgotten  # noqa: PLC0415

    return dates_of_deletion(forgotten(default_source(the_store_settings()), None, quietly()))


def all_datasets() -> tuple[list[Path], list[DatasetPlace]]:
    """Those that this machine exported or fetched, and those in the store, in the bucket ``lerobot``. Raises StoreError."""
    from shadowhound_data_logger.datasets.export import known_folders  # noqa: PLC0415
    from shadowhound_data_logger.datasets.transfer import datasets_in  # noqa: PLC0415

    copies = the_home() / COPIES
    with closing(open_reader(the_store_settings())) as store:
        stored = list(datasets_in(store))
    return [each for each in known_folders(the_home()) if copies not in each.parents], stored


def _copied() -> list[DatasetPlace]:
    """Those that have a copy on this machine, including interrupted uploads."""
    from shadowhound_data_logger.datasets.export import known_folders  # noqa: PLC0415
    from shadowhound_data_logger.datasets.transfer import DatasetPlace  # noqa: PLC0415

    copies = the_home() / COPIES
    mine = [each.relative_to(copies) for each in known_folders(the_home()) if copies in each.parents]
    return [DatasetPlace.of(f'{SCHEME}{each.as_posix()}') for each in mine]


def _uses(key: str, places: tuple[str, ...]) -> Iterator[DatasetUse]:
    from shadowhound_data_logger.datasets import verify as library  # noqa: PLC0415
    from shadowhound_data_logger.datasets.transfer import DatasetPlace  # noqa: PLC0415
    from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415

    settings = the_store_settings()
    folders = [Path(each) for each in places if not each.startswith(SCHEME)]
    stored = [DatasetPlace.of(each) for each in places if each.startswith(SCHEME)]
    if not places:
        folders, stored = all_datasets()
    for folder in folders:
        if (use := library.use_in_folder(folder, key)) is not None:
            yield use
    for place in stored:
        if (use := library.use_in_store(Bucket(settings, place.bucket), place, key)) is not None:
            yield use


@click.command('drop', epilog=examples('export drop mission_20261121_120000_ab12', 'export drop MISSION --in go2_patrol'))
@click.argument('mission')
@click.option('--in', 'places', multiple=True, metavar='DIR|s3://...',
              help='Only in this dataset  [default: all on this machine and in the bucket lerobot]')  # fmt: skip
@as_json
def export_drop(*, mission: str, places: tuple[str, ...], as_json: bool) -> ExitCode:
    """Remove the episode of a mission from datasets.

    It is not exported to them again.

    Exit code 1 when none of them has it.
    """
    with exporting():
        from shadowhound_data_logger.datasets import export as library  # noqa: PLC0415
        from shadowhound_data_logger.datasets.lerobot import Lerobot  # noqa: PLC0415
        from shadowhound_data_logger.datasets.transfer import DatasetPlace, catch_up, upload  # noqa: PLC0415

        stored = [DatasetPlace.of(each) for each in places if each.startswith(SCHEME)]
    folders = [Path(each) for each in places if not each.startswith(SCHEME)]
    dropped: dict[str, str] = {}
    with progress('looking for it') as bar, the_store() as store:
        if not places:
            folders, stored = all_datasets()
            stored += [each for each in _copied() if each not in stored]
        for folder in folders:
            if mission in Lerobot(folder).mission_ids or (folder / library.DROPPING).is_file():
                dropped[str(folder)] = library.drop(folder, mission)
        for place in stored:
            folder = copy_of(str(place))
            bar.say(str(place))
            with library.writing(folder):
                library.resumed(folder)
                is_there = catch_up(place, folder, store, bar.say)
            made = Lerobot(folder)
            if mission in made.mission_ids:
                dropped[str(place)] = library.drop(folder, mission)
            elif library.hashed(mission) not in made.dropped:
                continue
            if is_there:
                with library.writing(folder):
                    moved = upload(folder, place, store, bar.say)
                if moved.files:  # also where a drop was killed before the store had it
                    dropped[str(place)] = Lerobot(folder).digest
    if as_json:
        print_json(dropped)
    else:
        lines = [plain(f'{where}: dropped; its digest is {digest[:16]} now.') for where, digest in dropped.items()]
        print_lines(*lines or [plain(f'No dataset has an episode of {mission}.', 'yellow')])
    return exit_code(finding=not dropped)
