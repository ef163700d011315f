"""``shadowhound-data export``: training sets of missions: made, proved, found again, and with episodes taken out."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, TypeVar

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
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import counted, number, plain, print_json, print_lines, volume
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import FLAGS, NAMES, asking, quietly, report_skipped
from shadowhound_data_logger.core.errors import SettingError, TrackingError
from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.stamps import BY_STAMP
from shadowhound_data_logger.stores import open_reader

if TYPE_CHECKING:
    from shadowhound_data_logger.datasets.cluster import Cluster
    from shadowhound_data_logger.datasets.export import Exported
    from shadowhound_data_logger.datasets.export_file import ExportFile
    from shadowhound_data_logger.datasets.features import ExportOptions
    from shadowhound_data_logger.datasets.imports import Demonstration
    from shadowhound_data_logger.datasets.transfer import DatasetPlace
    from shadowhound_data_logger.datasets.verify import DatasetUse, VerifyResult

SCHEME: Final = 's3://'
SHOWN: Final = 30
COPIES: Final = 'exports'
"""In SHADOWHOUND_HOME: copies of what is exported to a store."""
TASK_SET: Final = 'synchronized/lerobot'
NOT_ASKED: Final = {'sensor', 'topic', 'near', 'near_gps'}
_Command = TypeVar('_Command', bound=Callable[..., Any])
_place = click.argument('place', metavar='DIR|s3://...')


@click.group(epilog=examples('export lerobot go2_patrol --mission-type patrol --since 30d', 'export verify go2_patrol'))
def export() -> None:
    """Make training sets of missions.

    One mission is one episode. What is missing is marked, and every value names the object that it came from.
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
              help='Also take missions with large gaps, and those of which it is not known what is missing.')  # fmt: skip
@click.option('--wait', is_flag=True, help='Wait until the data have arrived.')
@click.option('--pull', is_flag=True, help='Ask robots for what they keep of these missions, and wait until it has come.')
@click.option('--dry-run', is_flag=True, help='Only show what would be done.')
@click.option('--workers', type=click.IntRange(1, 1024), metavar='N',
              help='Episodes at a time  [default: 1; with Ray the cores of the cluster]')  # fmt: skip
@click.option('--ray', metavar='ADDRESS',
              help='Make episodes on this Ray cluster; auto: that of RAY_ADDRESS, or a Ray on this machine.')  # fmt: skip
@as_json
def export_lerobot(*, name: str, flags: Mapping[str, Any], to: str | None, config: Path | None, allow_gaps: bool,  # noqa: PLR0913
                   wait: bool, pull: bool, dry_run: bool, workers: int | None, ray: str | None,
                   as_json: bool) -> ExitCode:  # fmt: skip
    """Add missions to the LeRobot dataset NAME (v3.0).

    Missions that are already in it stay as they are. Exit code 1 when a mission was refused or waits: the report says why.
    """
    with _exporting():
        from shadowhound_data_logger.datasets import export as library  # noqa: PLC0415
        from shadowhound_data_logger.datasets import export_file  # noqa: PLC0415
        from shadowhound_data_logger.datasets.transfer import DatasetPlace, catch_up, upload  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.names import check_names  # noqa: PLC0415
        from shadowhound_data_logger.lake.pull import bring  # noqa: PLC0415

        check_name(name, 'the name of the dataset')
        file = export_file.read(config) if config else export_file.ExportFile()
        options = _options(file, config, allow_gaps=allow_gaps)
        cluster = _cluster(ray) if ray else None
        place = DatasetPlace.of(to) if to and to.startswith(SCHEME) else None
        if file.task and options.by != BY_STAMP:
            raise BadUsage(f'task with by: {options.by} is refused', 'the recordings of a task are by stamps')
        if file.task and place is not None:
            raise BadUsage(f'a task with --to {to} is refused', 'the folder of a task is made on this machine: --to DIR')
    folder = _copy_of(to) if place and to else Path(to or name)
    folder = folder / TASK_SET if file.task else folder
    left_out, moved = quietly(), None
    with progress('looking at what there is') as bar:
        if place is not None and not dry_run:
            with the_store() as store, library.writing(folder):
                library.resumed(folder)
                catch_up(place, folder, store, bar.say)
        source = default_source(the_store_settings())
        if pull and not dry_run:
            with _exporting():
                bring(source, flags, say=bar.say, findings=left_out)
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


def _words(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (word.strip() for word in text.split(','))))


def _copy_of(url: str) -> Path:
    """The folder on this machine of a dataset in a store."""
    return the_home() / COPIES / url.removeprefix(SCHEME).rstrip('/')


@contextmanager
def _exporting() -> Iterator[None]:
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


@export.command('verify', epilog=examples('export verify go2_patrol', 'export verify s3://lerobot/datasets/go2/go2_patrol --all'))
@_place
@click.option('--all', 'is_all', is_flag=True, help='Compare every frame with its source, not five of each episode.')
@click.option('--deep', 'is_deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@as_json
def export_verify(*, place: str, is_all: bool, is_deep: bool, as_json: bool) -> ExitCode:
    """Prove that a dataset is as it was written.

    It checks that the files are whole, the sources unchanged, and the pictures those of their sources.

    Exit code 1 when something is wrong.
    """
    with _exporting():
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


_arm = click.option('--arm', default='soarm', show_default=True, metavar='NAME', help='Name of the arm.')
_times = click.option('--times', type=click.Path(path_type=Path), metavar='FILE',
                      help="When each episode began, by the arm's clock: CSV with episode,begin_ns.")  # fmt: skip


@export.command('import-lerobot', epilog=examples('export import-lerobot so100_fetch --arm soarm --times begins.csv --degrees'))
@click.argument('folder', type=click.Path(file_okay=False, path_type=Path), metavar='DIR')
@_arm
@_times
@click.option('--degrees', 'is_degrees', is_flag=True, help='Its joints are in degrees: make radians of them.')
@as_json
def export_import_lerobot(*, folder: Path, arm: str, times: Path | None, is_degrees: bool, as_json: bool) -> ExitCode:
    """Store a LeRobotDataset (v2.1, v3.0) of an arm.

    Joints and actions; its videos stay where they are. Again, when it has grown, it adds the new episodes. Exit code 1 when an
    episode is refused: its content changed, or the store has another recording of its time.
    """
    with _exporting():
        from shadowhound_data_logger.datasets import imports as library  # noqa: PLC0415
    begins = library.times_of(times) if times else {}
    return _import(library.of_lerobot(folder, begins, is_degrees=is_degrees), arm, is_json=as_json)


@export.command('import-hdf5', epilog=examples('export import-hdf5 episode_0.hdf5 episode_1.hdf5 --times begins.csv --fps 50'))
@click.argument('files', type=click.Path(dir_okay=False, path_type=Path), metavar='FILE...', nargs=-1, required=True)
@_arm
@_times
@click.option('--fps', type=click.FloatRange(0.1, 10000), default=50.0, show_default=True, metavar='N', help='Frames per second.')
@click.option('--joints', default='', metavar='NAMES', help='Of qpos, in their order  [default: joint_0, joint_1, ...]')
@as_json
def export_import_hdf5(*, files: tuple[Path, ...], arm: str, times: Path | None, fps: float, joints: str,
                       as_json: bool) -> ExitCode:  # fmt: skip
    """Store HDF5 demonstrations (ACT, ALOHA) of an arm.

    The n-th file is episode n, from 0. Joints and actions; pictures stay where they are. Again, with more files, it adds the new
    episodes. Exit code 1 when an episode is refused: its content changed, or the store has another recording of its time.
    """
    with _exporting():
        from shadowhound_data_logger.datasets import imports as library  # noqa: PLC0415
    begins = library.times_of(times) if times else {}
    return _import(library.of_hdf5(files, begins, fps=fps, joints=_words(joints)), arm, is_json=as_json)


def _import(demonstrations: Iterator[Demonstration], arm: str, *, is_json: bool) -> ExitCode:
    from shadowhound_data_logger.datasets import imports as library  # noqa: PLC0415

    check_name(arm, '--arm')
    with _exporting(), the_store() as store:
        found = library.import_episodes(demonstrations, arm, store)
    if is_json:
        print_json(asdict(found))
        return exit_code(finding=found.refused)
    lines = [plain(f'  {episode} is refused: {why}', 'red') for episode, why in list(found.refused.items())[:SHOWN]]
    lines += [plain(f'  imported before, and not in this dataset: {episode}', 'yellow') for episode in found.absent[:SHOWN]]
    rest = f', {number(len(found.refused))} refused' if found.refused else ''
    rest += f', {number(len(found.absent))} imported before are not in it' if found.absent else ''
    lines.append(plain(f'{counted(found.episodes, "new episode")} of {arm} with {number(found.samples)} samples, '
                       f'{number(found.unchanged)} in the store already{rest}.'))  # fmt: skip
    print_lines(*lines)
    return exit_code(finding=found.refused)


def _proof(found: VerifyResult, place: str) -> Iterator[Text]:
    for wrong in found.wrong[:SHOWN]:
        yield plain(f'  {wrong}', 'red')
    said = f'{number(len(found.wrong))} things are wrong' if found.wrong else 'all is as it was written'
    like = '' if not found.frames else f', {number(found.frames)} frames compared (least SSIM {found.least_ssim:.3f})'
    yield plain(f'{place}: {counted(found.episodes, "episode")}, {counted(found.files, "file")}, '
                f'{counted(found.sources, "source")}{like}: {said}.')  # fmt: skip


@export.command('where', epilog=examples('export where sensor-data/thor/camera/20261121/120000_front.jpg'))
@click.argument('key')
@click.option('--in', 'places', multiple=True, metavar='DIR|s3://...',
              help='Only in this dataset  [default: all that this machine has, and the bucket lerobot]')  # fmt: skip
@as_json
def export_where(*, key: str, places: tuple[str, ...], as_json: bool) -> ExitCode:
    """Find the datasets and models that saw an object.

    Models are found by the MLflow runs that lake.log_dataset marked. Exit code 1 when MLflow cannot be asked.
    """
    with _exporting():
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
    """Those of which this machine has a copy, also where the upload was cut off."""
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


@export.command('drop', epilog=examples('export drop mission_20261121_120000_ab12', 'export drop MISSION --in go2_patrol'))
@click.argument('mission')
@click.option('--in', 'places', multiple=True, metavar='DIR|s3://...',
              help='Only in this dataset  [default: all that this machine has, and the bucket lerobot]')  # fmt: skip
@as_json
def export_drop(*, mission: str, places: tuple[str, ...], as_json: bool) -> ExitCode:
    """Take the episode of a mission out of datasets.

    It is not exported to them again.

    Exit code 1 when none of them has it.
    """
    with _exporting():
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
            folder = _copy_of(str(place))
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
