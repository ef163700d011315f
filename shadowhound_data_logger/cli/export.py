"""``shadowhound-data export``: training sets of missions: made, proved, found again, and with episodes taken out."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click
from rich.text import Text

from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    LazyCommands,
    Verb,
    as_json,
    examples,
    exit_code,
    store_hint,
    the_home,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import counted, number, plain, print_json, print_lines, volume
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import FLAGS, NAMES, asking, quietly, report_skipped
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.stamps import BY_STAMP

if TYPE_CHECKING:
    from shadowhound_data_logger.datasets.cluster import Cluster
    from shadowhound_data_logger.datasets.export import Exported
    from shadowhound_data_logger.datasets.export_file import ExportFile
    from shadowhound_data_logger.datasets.features import ExportOptions


SCHEME: Final = 's3://'
SHOWN: Final = 30
COPIES: Final = 'exports'
"""In SHADOWHOUND_HOME: copies of what is exported to a store."""
TASK_SET: Final = 'synchronized/lerobot'
NOT_ASKED: Final = {'sensor', 'topic', 'near', 'near_gps'}
_Command = TypeVar('_Command', bound=Callable[..., Any])


@click.group(
    commands=LazyCommands(
        (
            Verb('import-lerobot', module='export_import', attribute='export_import_lerobot'),
            Verb('import-hdf5', module='export_import', attribute='export_import_hdf5'),
            Verb('verify', module='export_datasets', attribute='export_verify'),
            Verb('where', module='export_datasets', attribute='export_where'),
            Verb('drop', module='export_datasets', attribute='export_drop'),
        )
    ),
    epilog=examples('export lerobot go2_patrol --mission-type patrol --since 30d', 'export verify go2_patrol'),
)
def export() -> None:
    """Make training sets from missions.

    One mission becomes one episode. Missing data is marked, and every value names the object that it came from.
    """


def _missions(command: _Command) -> _Command:
    """Adds the flags that choose missions; their values come as one mapping ``flags`` of those that were given."""

    @functools.wraps(command)
    def asked(**given: Any) -> Any:
        flags = {name: given.pop(name) for name in NAMES if name not in NOT_ASKED}
        return command(flags={name: value for name, value in flags.items() if value is not None}, **given)

    for name in reversed([name for name in FLAGS if name not in NOT_ASKED]):
        asked = FLAGS[name](asked)
    return asked  # type: ignore[return-value]


@export.command(
    'lerobot',
    epilog=examples(
        'export lerobot go2_patrol --mission-type patrol --since 30d',
        'export lerobot go2_patrol --mission-type patrol --to s3://lerobot/datasets/go2/go2_patrol --wait',
        'export lerobot base --since yesterday --config examples/export_base.yaml --dry-run',
        'export lerobot go2_patrol --mission-type patrol --ray ray://HEAD:10001',
    ),
)
@click.argument('name')
@_missions
@click.option('--to', metavar='DIR|s3://...', help='Where to write it  [default: the folder NAME]')
@click.option('--config', type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar='FILE',
              help='YAML file with the features of the dataset and how they are made: docs/datasets.md.')  # fmt: skip
@click.option('--allow-gaps', is_flag=True,
              help='Also take missions with large gaps or unknown losses.')  # fmt: skip
@click.option('--wait', is_flag=True, help='Wait until the data has arrived.')
@click.option('--pull', is_flag=True, help='First request the data that robots keep of these missions, and wait for it.')
@click.option('--dry-run', is_flag=True, help='Only show what would be done.')
@click.option('--workers', type=click.IntRange(1, 1024), metavar='N',
              help='Make N episodes at a time  [default: 1; with Ray, the cores of the cluster]')  # fmt: skip
@click.option('--ray', metavar='ADDRESS',
              help='Make episodes on this Ray cluster; auto: that of RAY_ADDRESS, otherwise Ray on this machine.')  # fmt: skip
@as_json
def export_lerobot(*, name: str, flags: Mapping[str, Any], to: str | None, config: Path | None, allow_gaps: bool,  # noqa: PLR0913
                   wait: bool, pull: bool, dry_run: bool, workers: int | None, ray: str | None,
                   as_json: bool) -> ExitCode:  # fmt: skip
    """Add missions to the LeRobot dataset NAME (v3.0).

    Missions that are already in it are unchanged. Exit code 1 if a mission was refused or waits: the report states why.
    """
    with exporting():
        from shadowhound_data_logger.datasets import export as library  # noqa: PLC0415
        from shadowhound_data_logger.datasets import export_file  # noqa: PLC0415
        from shadowhound_data_logger.datasets.transfer import DatasetPlace, catch_up, upload  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.names import check_names  # noqa: PLC0415
        from shadowhound_data_logger.lake.pull import request_and_wait  # noqa: PLC0415

        check_name(name, 'the name of the dataset')
        file = export_file.read(config) if config else export_file.ExportFile()
        options = _options(file, config, allow_gaps=allow_gaps)
        cluster = _cluster(ray) if ray else None
        place = DatasetPlace.of(to) if to and to.startswith(SCHEME) else None
        if file.task and options.by != BY_STAMP:
            raise BadUsage(f'task with by: {options.by} is refused', 'the recordings of a task are by stamps')
        if file.task and place is not None:
            raise BadUsage(f'a task with --to {to} is refused', 'the folder of a task is made on this machine: --to DIR')
    folder = copy_of(to) if place and to else Path(to or name)
    folder = folder / TASK_SET if file.task else folder
    left_out, moved = quietly(), None
    with progress('looking at what there is') as bar:
        if place is not None and not dry_run:
            with the_store() as store, library.writing(folder):
                library.resumed(folder)
                catch_up(place, folder, store, bar.say)
        source = default_source(the_store_settings())
        if pull and not dry_run:
            with exporting():
                request_and_wait(source, flags, say=bar.say, findings=left_out)
        result = library.export(
            folder, source, flags, options, workers=workers, cluster=cluster, wait=wait, is_dry=dry_run,
            findings=left_out, say=bar.say,
        )  # fmt: skip
        if not (result.added or result.present or result.refused or result.waiting):
            with asking():
                check_names(source, left_out, **flags)
        if result.digest and not dry_run:
            library.remember(the_home(), folder)
            if place is not None:
                with the_store() as store, library.writing(folder):
                    moved = upload(folder, place, store, bar.say)
    if as_json:
        print_json({**asdict(result), 'folder': str(folder), 'to': to or str(folder), 'uploaded': moved and asdict(moved)})
    else:
        print_lines(*_report(result, str(place or folder), is_dry=dry_run))
        if moved is not None:
            print_lines(plain(f'{number(moved.files)} files ({volume(moved.bytes)}) uploaded to {place}.'))
    report_skipped(left_out)
    return exit_code(finding=result.refused or result.waiting or len(left_out))


def _cluster(address: str) -> Cluster:
    """Raises BadUsage on a machine without Ray."""
    from shadowhound_data_logger.datasets.cluster import Cluster  # noqa: PLC0415

    try:
        import ray  # noqa: F401, PLC0415
    except ModuleNotFoundError as error:
        raise BadUsage('ray is not installed', "pip install 'daft[ray]', the same version on the whole cluster") from error
    return Cluster(None if address == 'auto' else address)


def _options(file: ExportFile, config: Path | None, *, allow_gaps: bool) -> ExportOptions:
    from shadowhound_data_logger.datasets.export_file import REMEDY  # noqa: PLC0415

    try:
        return file.options(config.parent if config else Path(), allow_gaps=allow_gaps)
    except (ValueError, SettingError) as error:
        raise BadUsage(f'{config}: {error}', REMEDY) from error


def copy_of(url: str) -> Path:
    """The folder on this machine of a dataset in a store."""
    return the_home() / COPIES / url.removeprefix(SCHEME).rstrip('/')


@contextmanager
def exporting() -> Iterator[None]:
    """Bad usage, as of questions; and a machine without the extra."""
    try:
        with asking():
            yield
    except ModuleNotFoundError as error:
        if error.name not in {'av', 'h5py'}:
            raise
        raise BadUsage(f'{error.name} is not installed', "pip install 'shadowhound_data_logger[datasets]'") from error


def _report(result: Exported, where: str, *, is_dry: bool) -> Iterator[Text]:
    for mission, streams in list(result.streams.items())[:SHOWN]:
        yield plain(f'  {mission}')
        yield from (plain(f'    {name}: {source}') for name, source in streams.items())
    for episode in result.added[:SHOWN]:
        stale = max((each['stale_share'] for each in episode['streams'].values()), default=0.0)
        yield plain(f'  {episode["mission_id"]}: {number(episode["frames"])} frames, {stale:.1%} stale')
        for name, each in episode['streams'].items():
            if each['offset_changed']:
                span = f'{each["offset_min_s"]:,.1f} to {each["offset_max_s"]:,.1f} s'
                yield plain(f'    {name}: the offset between stamps and arrivals changed, from {span}', 'yellow')
    for mission, why in list(result.refused.items())[:SHOWN]:
        yield plain(f'  {mission} is refused: {why}', 'red')
    for mission, why in list(result.waiting.items())[:SHOWN]:
        yield plain(f'  {mission} waits: {why}', 'yellow')
    others = [(number(len(result.refused)), 'refused')] if result.refused else []
    others += [(number(len(result.waiting)), 'waiting')] if result.waiting else []
    rest = ''.join(f', {count} {what}' for count, what in others)
    if is_dry:
        yield plain(f'{counted(len(result.streams), "mission")} would be exported to {where} at {result.fps} frames a second, '
                    f'with {result.action} as action; {number(len(result.present))} in it already{rest}.')  # fmt: skip
        return
    if not (result.added or result.present):
        yield plain(f'No mission was exported{rest}.{"" if rest else store_hint()}')
        return
    yield from (plain(line) for line in result.absent)
    yield plain(f'{counted(len(result.added), "episode")} added to {where}, {number(len(result.present))} in it already{rest}; '
                f'digest {result.digest[:16]}.')  # fmt: skip
