"""``shadowhound-data bag``: recordings, wherever they are: find, look at, check, download, cut out, send and record them."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.bags.cut import COMES, Choice, Cut, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.info import BagInfo, info_folder, info_of
from shadowhound_data_logger.bags.manifest import Missing
from shadowhound_data_logger.bags.naming import SLICES, safe_bag
from shadowhound_data_logger.bags.overview import BagRow, bag_overview
from shadowhound_data_logger.bags.record import DEADLINE_S, record
from shadowhound_data_logger.bags.remote import FOREIGN, GROWING, find_bag
from shadowhound_data_logger.bags.repair import BagRepair, FileRepair, repair_bag
from shadowhound_data_logger.bags.upload import Uploaded, deliver, opened_spool, planned, spool_upload, upload_now
from shadowhound_data_logger.bags.verify import VerifiedBag, verify_folder, verify_remote
from shadowhound_data_logger.bags.watch import Watch, WatchStep
from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    robot_name,
    store_hint,
    the_home,
    the_robot,
    the_store,
)
from shadowhound_data_logger.cli.output import (
    counted,
    duration,
    number,
    plain,
    plain_table,
    print_json,
    print_lines,
    print_page,
    shown_time,
    value_table,
    volume,
    with_dates,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import ranges_option
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import SystemClock, iso
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import BagDamaged, BagError, NameRefused, StoreUnavailable
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, check_name
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.stores.memory import MemoryStore

STORE_THREADS: Final = 8
LOCAL_REMEDY: Final = 'shadowhound-data bag verify DIR --deep shows what is damaged'
MIN_RATED_S: Final = 0.01
"""A bag that is shorter has no rates."""
REPAIR: Final = 'In a folder, `shadowhound-data bag repair` recovers what a damaged file still holds.'
MAX_LOSSES: Final = 20
"""Of a repaired file that are printed."""
LOOK_S: Final = 5.0
"""Between two looks for bags that are finished."""
STATES: Final = {'complete': 'green', 'growing': 'cyan', 'recovered': 'yellow', 'gaps': 'yellow', 'foreign': 'dim'}
STEPS: Final = {'spooled': 'cyan', 'stored': 'green', 'removed': 'green', 'refused': 'red'}
DURABILITY: Final = {1: 'transient_local', 2: 'volatile'}
RELIABILITY: Final = {1: 'reliable', 2: 'best_effort'}
"""rmw's numbers, which bags before Jazzy keep; https://docs.ros.org/en/jazzy/p/rmw/generated/file_include_rmw_types.h.html"""


def _bag(_: click.Context, __: click.Parameter, name: str) -> str | Path:
    """A name, or the path of a folder or of one file of messages."""
    path = Path(name)
    if '/' in name or name in {'.', '..'} or (name.endswith(SLICES) and path.is_file()):
        if not path.exists():
            raise BadUsage(f'there is no folder {name}', 'the name of a bag in the store has no slash: shadowhound-data bag list')
        return path.absolute()
    try:
        return check_name(name, 'the bag', MAX_BAG_BYTES)
    except NameRefused as error:
        raise BadUsage(error.what, error.remedy or error.DEFAULT_REMEDY) from error


@contextmanager
def _in_folder() -> Iterator[None]:
    """What helps against damage in a folder, which no store may have."""
    try:
        yield
    except BagDamaged as error:
        error.remedy = error.remedy or LOCAL_REMEDY
        raise


@contextmanager
def _in_store(name: str) -> Iterator[None]:
    """The name of a bag means one in the store; a folder of that name needs a slash."""
    try:
        yield
    except BagError as error:
        if Path(name).is_dir():
            error.remedy = f'the folder {name} is ./{name}: a name without a slash is that of a bag in the store'
        raise


_robot = click.option(
    '--robot',
    metavar='NAME',
    callback=robot_name,
    help='The robot  [default: SHADOWHOUND_ROBOT, else that of this machine or store]',
)
_bag_or_folder = click.argument('bag', metavar='BAG|DIR', callback=_bag)


@click.group(
    epilog=examples(
        'bag list --since yesterday',
        'bag fetch patrol_20251018_120000 --to bags',
    )
)
def bag() -> None:
    """Find, download, check, cut and upload bags.

    BAG is the name of a bag in the store, as `bag list` shows it. The store is the S3 server that AWS_ENDPOINT_URL names, else
    the folder SHADOWHOUND_HOME/store. A bag in a folder is named by a path with a slash in it: ./patrol_20251018_120000
    """


@bag.command('list', epilog=examples('bag list --since yesterday', 'bag list --robot tachi --json'))
@click.option('--since', default='', metavar='TIME', help='From TIME on: yesterday, 2h, 2026-11-20, 2026-11-20T12:30 (UTC).')
@_robot
@as_json
def bag_list(*, since: str, robot: str | None, as_json: bool) -> ExitCode:
    """List the bags in the store and on this machine.

    \b
    growing    still recorded, or not all of it has arrived yet
    complete   all slices are known, with their checksums
    gaps       the same, but messages were dropped while it recorded: bag info says which
    recovered  the same, after a crash or power cut: bag info says what is missing
    foreign    not made by this package: what should be in it is not known

    Exit code 1 when something is wrong with a bag, or when the store cannot be reached: then only what is on this machine is
    listed.
    """  # noqa: D301 - click's mark for lines that stay as they are
    robot = the_robot(robot, in_store=True)
    begin_ns = moment('--since', since, SystemClock.of_this_machine().wall_ns()) if since else 0
    with the_store(STORE_THREADS) as store:
        where, away = store.describe(), ''
        try:
            rows = bag_overview(store, robot, the_home(), since_ns=begin_ns)
        except StoreUnavailable as error:
            rows, away = bag_overview(MemoryStore(name='no store'), robot, the_home(), since_ns=begin_ns), str(error)
            click.echo(f'The store cannot be reached, so this is what is on this machine: {away}', err=True)
    if as_json:
        print_json([with_dates(asdict(row)) for row in rows])
    elif not rows:
        then = f' that began since {since}' if since else ''
        click.echo(f'There is no bag of {robot}{then}, neither in {where} nor on this machine.{store_hint()}')
    else:
        print_page(_rows(rows), *_findings(rows))
    return exit_code(finding=away or any(row.finding and row.state != GROWING for row in rows))


@bag.command(
    'info',
    epilog=examples('bag info patrol_20251018_120000', 'bag info ./patrol_20251018_120000'),
)
@_bag_or_folder
@_robot
@as_json
def bag_info(*, bag: str | Path, robot: str | None, as_json: bool) -> ExitCode:
    """Show topics, rates, times and files of a bag.

    It downloads almost nothing, except of MCAP files whose summary does not have the message counts: those are read as a whole.
    Exit code 1 when a file is missing or cannot be read.
    """
    if isinstance(bag, Path):
        with _in_folder():
            found = info_folder(bag)
    else:
        with _in_store(bag), the_store(STORE_THREADS) as store:
            found = info_of(store, the_robot(robot, in_store=True), bag, the_home())
    if as_json:
        print_json(_info_json(found))
    else:
        print_page(*_page(found))
    return exit_code(finding=found.missing or found.description.damaged)


@bag.command('verify', epilog=examples('bag verify patrol_20251018_120000 --deep'))
@click.option('--deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@_bag_or_folder
@_robot
@as_json
def bag_verify(*, bag: str | Path, deep: bool, robot: str | None, as_json: bool) -> ExitCode:
    """Check that a bag is there as it was recorded.

    Exit code 0 only when every file is sound and the bag is not growing.

    In the store, sizes and checksums are compared, and only the summary of each slice is downloaded; --deep reads everything and
    unpacks every chunk. In a folder everything is read.
    """
    with progress('read', of='bytes') as bar:
        if isinstance(bag, Path):
            with _in_folder():
                found = verify_folder(bag, deep=deep, told=bar.have)
        else:
            with _in_store(bag), the_store(STORE_THREADS) as store:
                found = verify_remote(store, find_bag(store, the_robot(robot, in_store=True), bag), deep=deep, told=bar.have)
    if as_json:
        checks = [{'name': each.name, 'finding': each.finding, 'checked': each.checked} for each in found.checks]
        facts = {'bag': found.bag, 'state': found.state, 'checks': checks, 'read_bytes': found.read_bytes,
                 'missing': list(map(asdict, found.missing)), 'remarks': list(found.remarks)}  # fmt: skip
        said = {**facts, 'is_intact': found.is_intact, 'is_complete': found.state not in {GROWING, FOREIGN}}
        print_json(said)
    else:
        print_page(*_verdict(found))
    return exit_code(finding=not (found.is_intact and found.state != GROWING))


@bag.command('repair', epilog=examples('bag repair my_bag', 'bag repair my_bag/my_bag_3.mcap --to repaired.mcap'))
@click.argument('path', metavar='PATH', type=click.Path(path_type=Path, exists=True))
@click.option('--to', type=click.Path(path_type=Path), metavar='PATH', help='Where to write it  [default: PATH_repaired]')
@click.option('--in-place', is_flag=True, help='Replace the damaged files. What is damaged in them is gone then.')
@click.option('--keep-damaged', is_flag=True,
              help='Also keep the messages of chunks whose checksum does not match: some of them are wrong.')  # fmt: skip
@as_json
def bag_repair(*, path: Path, to: Path | None, in_place: bool, keep_damaged: bool, as_json: bool) -> ExitCode:
    """Repair a bag or one of its files.

    PATH is a folder or an MCAP or SQLite file of any recorder: torn by a crash or a full disk, without its end or summary, with
    damaged bytes or bytes added. Everything that is intact is copied, metadata.yaml is rebuilt, and what is lost is listed.

    Nothing is written if nothing is damaged. Exit code 1 means that something was.
    """
    if in_place and to is not None:
        raise BadUsage('--in-place and --to exclude each other', 'omit one of them')
    with progress('read', of='bytes') as bar:
        found = repair_bag(path, to, in_place=in_place, unverified=keep_damaged, progress=bar)
    if as_json:
        print_json({**asdict(found), 'is_damaged': found.is_damaged})
    else:
        print_page(*_told_repair(found, keep_damaged=keep_damaged))
    return exit_code(finding=found.is_damaged)


@bag.command('fetch', epilog=examples('bag fetch patrol_20251018_120000 --to bags'))
@click.argument('bag', metavar='BAG')
@click.option(
    '--to',
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar='DIR',
    help='Where to write it.',
)
@_robot
@as_json
def bag_fetch(*, bag: str, to: Path, robot: str | None, as_json: bool) -> ExitCode:
    """Download a bag, verified.

    It becomes DIR/BAG. Run it again after an interruption: files that are already complete are skipped. A bag that is still
    growing gets a metadata.yaml of what there is, so that players open it; fetch it again later for the rest.
    """
    with the_store(STORE_THREADS) as store, progress('fetched', of='bytes') as bar:
        there = find_bag(store, the_robot(robot, in_store=True), bag)
        found = fetch(store, there, to, progress=bar)
    if as_json:
        print_json({**asdict(found), 'folder': str(found.folder)})
        return ExitCode.FINE
    lines = [
        plain(f'{found.folder}: {counted(found.files, "file")}, {volume(found.bytes)}; downloaded {volume(found.downloaded)}')
    ]
    if found.unverified:
        lines.append(plain(f'No checksum is known of {", ".join(found.unverified)}: only the size was compared.', 'yellow'))
    elif found.missing:
        lines.append(plain(f'Not in the store yet: {", ".join(found.missing)}. Fetch it again for the rest.', 'cyan'))
    elif not found.is_complete:
        lines.append(plain('The bag is still growing: fetch it again for the rest.', 'cyan'))
    print_lines(*lines)
    return ExitCode.FINE


@bag.command(
    'cut',
    epilog=examples(
        'bag cut patrol_20251018_120000 --start +30 --end +60 --to cut',
        'bag cut ./patrol_20251018_120000 --topic /imu --topic /odom --to cut',
    ),
)
@_bag_or_folder
@click.option('--start', default='', metavar='TIME', help='From this time on  [default: the start of the bag]')
@click.option('--end', default='', metavar='TIME', help='Before this time  [default: the end of the bag]')
@ranges_option
@click.option('--topic', 'topics', multiple=True, metavar='NAME', help='Only of this topic; may be repeated.')
@click.option('--regex', default='', help='Also topics whose name matches this regular expression.')
@click.option('--to', type=click.Path(path_type=Path), required=True, metavar='DIR', help='Where to write it.')
@_robot
@as_json
def bag_cut(*, bag: str | Path, topics: tuple[str, ...], to: Path, robot: str | None, as_json: bool, ranges: list[Any] | None,
            **wanted: str) -> ExitCode:  # fmt: skip
    """Copy a span of time or some topics into a new bag.

    \b
    TIME   2025-10-18T12:00:05.5   a date, UTC unless it names a zone
           12.5                    seconds since the start of the bag
           -30                     seconds before its end
           1760788805.5            seconds since 1970

    Times are those at which messages were received, as in ros2 bag play; those of --ranges are stamps of messages, which are a
    little earlier: query --pad 1 makes each longer. Of a bag in the store, only the chunks that are needed
    are read. Exit code 1 when a slice of that time is missing or cannot be read.
    """  # noqa: D301 - click's mark for lines that stay as they are
    choice = Choice(topics=topics, spans=None if ranges is None else _spans(ranges), **wanted)
    if isinstance(bag, Path):
        with _in_folder():
            found = cut_folder(bag, to, choice)
    else:
        with _in_store(bag), the_store(STORE_THREADS) as store:
            found = cut_remote(store, find_bag(store, the_robot(robot, in_store=True), bag), to, choice)
    if as_json:
        print_json(with_dates({**asdict(found), 'folder': str(found.folder)}))
    else:
        print_lines(*_told_cut(found, is_remote=not isinstance(bag, Path)))
    return exit_code(finding=found.missing or found.damaged)


def _spans(ranges: list[Any]) -> tuple[tuple[int, int], ...]:
    """Of an answer: apart from each other, in their order, of whichever robot."""
    from shadowhound_data_logger.lake.select import Wanted, spans_of, within  # noqa: PLC0415

    (chosen,) = within(Wanted(), (span._replace(robot=None) for span in spans_of(ranges))).chosen
    return tuple((span.since_ns, span.until_ns + 1) for span in chosen.spans)


@bag.command('upload', epilog=examples('bag upload my_bag', 'bag upload my_bag --bag-name patrol_2 --tar-gz'))
@click.argument('folder', metavar='DIR', type=click.Path(path_type=Path))
@click.option(
    '--bag-name',
    metavar='NAME',
    default='',
    help='Name of the bag in the store  [default: that of DIR, or the nearest valid one]',
)
@click.option('--tar-gz', is_flag=True, help='Store one ROBOT/rosbags/NAME.tar.gz instead of the files.')
@click.option('--direct', is_flag=True, help='Bypass the spool: nothing is kept here if the store does not take it in time.')
@click.option('--timeout', type=click.FloatRange(0.0, 1e7), default=600.0, show_default=True, metavar='S',
              help='Give up after S seconds.')  # fmt: skip
@_robot
@as_json
def bag_upload(
    *, folder: Path, bag_name: str, direct: bool, timeout: float, robot: str | None, as_json: bool, tar_gz: bool
) -> ExitCode:
    """Upload a finished bag.

    SQLite or MCAP, as rosbag2 wrote it: its files as they are, and a manifest with their checksums.

    The bag goes through the spool of this machine, and the command waits until the store has it. If Tower cannot be reached
    within --timeout, the exit code is 1 and the bag stays safely in the spool: the node that runs here, or the next upload,
    delivers it. DIR itself is never changed.
    """
    robot, folder = the_robot(robot), folder.absolute()
    settings, clock = Settings.load({'robot': robot}, os.environ), SystemClock.of_this_machine()
    with (
        _in_folder(),
        planned(folder, robot, bag_name or safe_bag(folder.name), the_home(), is_archive=tar_gz) as sent,
        progress('sent', of='bytes') as bar,
    ):
        if direct:
            with the_store(STORE_THREADS) as store:
                found = upload_now(store, sent, deadline_s=timeout, progress=bar)
        else:
            with opened_spool(settings, clock) as spool:
                spool_upload(sent, spool)
                found = deliver(settings, spool, sent, deadline_s=timeout, progress=bar)
    if as_json:
        facts = {'damaged': dict(sent.damaged), 'remarks': list(sent.remarks), 'renamed': dict(sent.renamed)}
        print_json({**asdict(found), 'is_delivered': found.is_delivered, **facts})
    else:
        damaged = (plain(f'{name} {why}; it was uploaded as it is.', 'red') for name, why in sent.damaged.items())
        renamed = (f'{name} is {stored} in the store.' for name, stored in sent.renamed.items())
        print_lines(_told_upload(found), *renamed, *damaged, *([REPAIR] if sent.damaged else []), *_remarks(sent.remarks))
    return exit_code(finding=not found.is_delivered or sent.damaged)


@bag.command('watch', epilog=examples('bag watch bags --remove'))
@click.argument('folder', metavar='DIR', type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option('--settle', type=click.FloatRange(0.0, 86_400.0), default=10.0, show_default=True, help='Seconds without a change.')
@click.option('--remove', is_flag=True, help='Remove a bag from DIR once the store has confirmed every file of it.')
@click.option('--once', is_flag=True, help='Look, wait for what is still changing, look again, and end: for a timer.')
@_robot
@as_json
def bag_watch(*, folder: Path, settle: float, once: bool, robot: str | None, as_json: bool, remove: bool) -> ExitCode:
    """Upload each finished bag in DIR, until Ctrl-C.

    For example those of `ros2 bag record`. Each is sent once.

    A bag is finished when it is a folder in DIR with a metadata.yaml and all files that it names, unchanged for --settle seconds.
    DIR/.shadowhound-bags.json lists what was sent, so that a restart does not send it again. With --once, exit code 1 means that
    a bag is not in the store yet.
    """
    settings = Settings.load({'robot': the_robot(robot)}, os.environ)
    watching = Watch(folder.absolute(), settings, SystemClock.of_this_machine(), settle_s=settle, is_removing=remove)
    with watching.alone():
        try:
            while True:
                _tell(watching.round(), as_json)
                time.sleep(settle if once else LOOK_S)
                if once:
                    _tell(watching.round(), as_json)
                    return exit_code(finding=watching.is_owing())
        except KeyboardInterrupt:
            return ExitCode.FINE


@bag.command('record', epilog=examples('bag record kitchen --duration 60 --topic /imu --topic /odom'))
@click.argument('name')
@click.option('--duration', type=click.FloatRange(0.1, 86_400.0), required=True,
              metavar='S', help='Stop after S seconds; Ctrl-C stops it earlier.')  # fmt: skip
@click.option('--topic', 'topics', multiple=True, metavar='NAME', help='Only of this topic; may be repeated.')
@click.option('--regex', default='', help='Also topics whose name matches this regular expression.')
@click.option(
    '--timeout',
    type=click.FloatRange(0.0, 1e7),
    default=DEADLINE_S,
    show_default=True,
    metavar='S',
    help='Give up after S seconds.',
)
@_robot
@as_json
def bag_record(*, topics: tuple[str, ...], robot: str | None, as_json: bool, **wanted: Any) -> ExitCode:
    """Record topics into a bag and upload it.

    The bag is NAME_YYYYMMDD_HHMMSS; without --topic it has the topics that the node logs by default;
    --regex '.*' records all.

    It needs ROS 2, but neither rosbag2 nor a running node. Slices are uploaded while it records. If Tower cannot be reached, the
    bag waits in the spool, and the exit code is 1.
    """
    duration, timeout = wanted.pop('duration'), wanted.pop('timeout')
    found = record(duration_s=duration, deadline_s=timeout, topics=topics, robot=the_robot(robot), **wanted)
    if as_json:
        print_json({**asdict(found), 'where': found.where})
    else:
        state = 'confirmed by the store' if found.delivered else f'waits in the spool for the store ({found.last_error})'
        what = f'{counted(found.messages, "message")} on {counted(len(found.topics), "topic")}, {counted(found.slices, "slice")}'
        print_lines(f'{found.where}: {what}, {volume(found.bytes)}, {state}')
        if found.dropped:
            print_lines(f'Dropped: {counted(found.dropped, "message")}; this machine was too slow.')
    return exit_code(finding=not (found.delivered and not found.dropped))


def _rows(rows: Sequence[BagRow]) -> RenderableType:
    columns = ('bag', 'state', 'began (UTC)', 'duration', 'messages', 'topics', 'slices', 'size', 'where')
    table = plain_table('Bags', columns, ('bag', 'state', 'began (UTC)', 'where'))
    for row in rows:
        length = '-' if row.t_start_ns is None or row.t_end_ns is None else duration((row.t_end_ns - row.t_start_ns) / 1e9)
        table.add_row(
            plain(row.bag), plain(row.state, STATES.get(row.state, 'red')), shown_time(row.t_start_ns)[:19], length,
            number(row.messages), number(row.topics), number(row.slices), volume(row.bytes), _places(row.where),
        )  # fmt: skip
    return table


def _places(where: Mapping[str, int]) -> str:
    """Only the place, where it is one."""
    return next(iter(where)) if len(where) == 1 else ', '.join(f'{place} {count}' for place, count in where.items())


def _findings(rows: Sequence[BagRow]) -> Iterator[RenderableType]:
    found = [row for row in rows if row.finding or row.remark]
    if found:
        yield ''
        yield from (plain(f'{row.bag}: {row.finding or row.remark}', 'yellow') for row in found)


def _page(found: BagInfo) -> Iterator[RenderableType]:
    told = found.description
    yield Text.assemble(plain(found.bag, 'bold'), '  ', plain(found.state, STATES.get(found.state, 'red')))
    manifest = found.manifest
    mission, event = (manifest.mission, manifest.event) if manifest else (None, None)
    lines = {
        'robot': found.robot or (manifest.robot if manifest else ''),
        'mission': f'{mission.type}, run {mission.run_id or "-"}, id {mission.mission_id or "-"}' if mission else '',
        'event': ', '.join(f'{each.name} by {each.by}' for each in event.triggers) if event else '',
        'clock': _clock(told.clock, told.t_start_ns) if told.clock else '',
        'began': f'{shown_time(told.t_start_ns)} UTC' if told.t_start_ns is not None else '-',
        'ended': f'{shown_time(told.t_end_ns)} UTC' if told.t_end_ns is not None else '-',
        'duration': duration(told.duration_s) if told.duration_s is not None else '-',
        'messages': f'{number(told.messages)} on {counted(len({topic.name for topic in told.topics}), "topic")}',
        'size': f'{volume(found.bytes)} in {counted(len(found.files), "file")}',
        'storage': ', '.join(filter(None, (told.storage, told.compression, f'ROS {told.distro}' if told.distro else ''))),
    }  # fmt: skip
    yield value_table('', {name: value for name, value in lines.items() if value})
    yield ''
    yield _topics(found)
    yield ''
    yield _files(found)
    yield from (plain(f'{name} {why}; it is not counted.', 'red') for name, why in told.damaged.items())
    yield from [REPAIR] if told.damaged else []
    if found.missing:
        yield plain(f'{"Not here yet" if found.robot else "Not here"}: {", ".join(found.missing)}', 'yellow')
    yield from _remarks(told.remarks)
    yield from _lost(manifest.missing if manifest else ())


def _clock(clock: Mapping[str, str], start_ns: int | None) -> str:
    """What the times of a bag are worth whose clock was not set."""
    if words.CLOCK_OFFSET_NS not in clock:
        return f'was never set in boot {clock[words.BOOT_ID]}: the date is not known, and the times below are by that clock'
    offset_ns = int(clock[words.CLOCK_OFFSET_NS])
    began = f'the bag began {shown_time(start_ns + offset_ns)} UTC' if start_ns is not None else 'the bag has no messages'
    return f'was not set yet: {began}, and {offset_ns / 1e9:.3f} s are to be added to the times below'


def _lost(missing: Sequence[Missing]) -> Iterator[RenderableType]:
    """What the recording itself could not get into the bag."""
    for lost in missing:
        count = '' if lost.messages is None else f' ({counted(lost.messages, "message")})'
        topic = f' of {lost.topic}' if lost.topic else ''
        yield plain(f'Missing{topic}, in or after {lost.file}: {lost.what}{count}', 'yellow')


def _remarks(remarks: Sequence[str]) -> Iterator[Text]:
    """Where a metadata.yaml contradicts the files, whose figures are shown."""
    yield from (plain(f'{remark}.', 'yellow') for remark in remarks)


def _rate(messages: int | None, seconds: float | None) -> str:
    """Nothing where a bag is too short for one: times may be a counter instead of a clock."""
    if messages is None or seconds is None or messages < 2 or seconds < MIN_RATED_S:
        return '-'
    return f'{(messages - 1) / seconds:,.1f} Hz'


def _topics(found: BagInfo) -> RenderableType:
    table = plain_table('Topics', ('topic', 'type', 'messages', 'rate', 'QoS'), ('topic', 'type', 'QoS'))
    for topic in sorted(found.description.topics, key=lambda each: (each.name, each.type)):
        rate = _rate(topic.messages, found.description.duration_s)
        table.add_row(plain(topic.name), plain(topic.type), number(topic.messages), rate, plain(_qos(topic.qos)))
    return table


def _files(found: BagInfo) -> RenderableType:
    columns = ('file', 'began (UTC)', 'duration', 'messages', 'size', 'where')
    table = plain_table('Files', columns, ('file', 'began (UTC)', 'where'))
    parts = {part.name: part for part in found.description.parts}
    for name, (size, where) in found.files.items():
        part = parts.get(name)
        start, end = (part.t_start_ns, part.t_end_ns) if part else (None, None)
        length = '-' if start is None or end is None else duration((end - start) / 1e9)
        table.add_row(plain(name), shown_time(start), length, number(part.messages if part else None), volume(size), where)
    return table


def _qos(profiles: Sequence[Mapping[str, Any]]) -> str:
    """What decides whether a subscription hears anything; of several publishers each that differs."""
    found: list[str] = []
    for profile in profiles:
        reliability, durability = profile.get('reliability'), profile.get('durability')
        words = [str(RELIABILITY.get(reliability, reliability) if isinstance(reliability, int) else reliability)]
        durability = DURABILITY.get(durability, durability) if isinstance(durability, int) else durability
        words += [str(durability)] if durability != 'volatile' else []
        if ' '.join(words) not in found:
            found.append(' '.join(words))
    return ', '.join(found) or '-'


def _info_json(found: BagInfo) -> dict[str, Any]:
    told = found.description
    times = with_dates({'t_start_ns': told.t_start_ns, 't_end_ns': told.t_end_ns}) if told.t_start_ns is not None else {}
    parts = {part.name: with_dates(asdict(part)) for part in told.parts}
    return {
        'robot': found.robot, 'bag': found.bag, 'state': found.state, **times, 'duration_s': told.duration_s,
        'messages': told.messages, 'bytes': found.bytes, 'storage': told.storage, 'compression': told.compression,
        'ros_distro': told.distro, 'topics': [asdict(topic) for topic in told.topics],
        'files': [
            {**parts.get(name, {'name': name}), 'bytes': size, 'where': where} for name, (size, where) in found.files.items()
        ],
        'clock': dict(told.clock) or None, 'missing': list(found.missing), 'damaged': dict(told.damaged),
        'remarks': list(told.remarks), 'read_bytes': found.read_bytes,
        'manifest': json.loads(found.manifest.to_json()) if found.manifest else None,
    }  # fmt: skip


def _verdict(found: VerifiedBag) -> Iterator[RenderableType]:
    for check in found.findings:
        yield plain(f'{check.name} {check.finding}', 'red')
    yield from [REPAIR] if any(check.checked != 'presence' for check in found.findings) else []
    sound = [check for check in found.checks if not check.finding]
    how = ', '.join(sorted({check.checked for check in sound}))
    are = 'is' if len(sound) == 1 else 'are'
    text = f'{number(len(sound))} of {counted(len(found.checks), "file")} {are} sound (by {how})' if sound else 'No file is sound'
    yield Text.assemble(plain(found.bag, 'bold'), ' ', plain(found.state, STATES.get(found.state, 'red')), f': {text}.')
    yield from _lost(found.missing)
    yield from _remarks(found.remarks)
    if found.state == GROWING:
        yield plain('It is still growing: its manifest, or a slice that it promises, is not there yet.', 'yellow')
    if found.state == FOREIGN:
        yield plain('It has no manifest, so what should be in it is not known.', 'dim')


def _told_cut(found: Cut, *, is_remote: bool) -> Iterator[str | Text]:
    length = duration((found.t_end_ns - found.t_start_ns) / 1e9)
    what = f'{counted(found.messages, "message")} on {counted(found.topics, "topic")}, {volume(found.bytes)}'
    what += f', {number(found.latched)} of them latched before' if found.latched else ''
    yield f'{found.folder}: {what}, {shown_time(found.t_start_ns)} to {shown_time(found.t_end_ns)} UTC ({length})'
    if is_remote:
        requests = counted(found.read_requests, 'request')
        if found.read_bytes < found.bag_bytes:
            share = f'{volume(found.read_bytes)} of {volume(found.bag_bytes)} ({100 * found.read_bytes / found.bag_bytes:.1f} %)'
        else:  # parts of a small file are read twice
            share = f'all {volume(found.bag_bytes)}'
        yield f'Read {share} in {requests}.'
    yield from (plain(f'{name} {why}; nothing of it was copied.', 'red') for name, why in found.damaged.items())
    yield from [REPAIR] if found.damaged else []
    if found.extras:
        what = 'attachment or metadata record' if found.extras == 1 else 'attachments or metadata records'
        yield f'Not copied: {number(found.extras)} {what}.'
    if found.absent:
        yield plain(f'The bag has no topic {", ".join(found.absent)}.', 'yellow')
    if found.missing:
        yield plain(f'Not all of that time: {", ".join(found.missing)} is not there{f"; {COMES}" if is_remote else ""}', 'yellow')
    yield from _remarks(found.remarks)


def _told_repair(found: BagRepair, *, keep_damaged: bool) -> Iterator[RenderableType]:
    if not found.is_damaged:
        yield f'{found.path}: nothing is damaged in {counted(len(found.files), "file")}.'
        return
    damaged = [file for file in found.files if file.is_damaged]
    messages = sum(file.messages or 0 for file in found.files)
    where = found.out if found.out is not None else found.path
    yield Text.assemble(plain(where, 'bold'), f': {counted(messages, "message")} in {counted(len(found.files), "file")}, ',
                        f'{number(len(damaged))} of them damaged')  # fmt: skip
    for file in damaged:
        yield ''
        yield from _told_file(file, keep_damaged=keep_damaged)
    for remark in found.metadata:
        yield plain(f'metadata.yaml was rebuilt: {remark}', 'yellow')
    if found.absent:
        yield plain(f'Not there, and no longer in metadata.yaml: {", ".join(found.absent)}', 'yellow')


def _told_file(file: FileRepair, *, keep_damaged: bool) -> Iterator[RenderableType]:
    if file.failed:
        yield plain(f'{file.name} cannot be repaired: {file.failed}', 'red')
        return
    lost = 'an unknown number is lost' if file.lost_messages is None else f'{number(file.lost_messages)} lost'
    yield plain(f'{file.name}: {counted(file.messages or 0, "message")}, {lost}', 'yellow')
    for loss in file.losses[:MAX_LOSSES]:
        count = '' if loss.messages is None else f', {counted(loss.messages, "message")}'
        span = '' if loss.from_ns is None else f', after {shown_time(loss.from_ns)}'
        span += '' if loss.to_ns is None else f', until {shown_time(loss.to_ns)}'
        yield plain(f'  lost at {number(loss.at)}: {volume(loss.bytes)}, {loss.what}{count}{span}')
    if len(file.losses) > MAX_LOSSES:
        yield f'  and {number(len(file.losses) - MAX_LOSSES)} more places: --json lists them'
    if file.rebuilt:
        yield plain(f'  rebuilt: {", ".join(file.rebuilt)}')
    if file.is_cut:
        yield plain('  Its end is missing: it is unknown whether more followed.')
    if file.unverified:
        what = f'  {counted(file.unverified, "message")} of chunks whose checksum does not match'
        kept = 'are in it, some of them wrong' if keep_damaged else 'are lost; --keep-damaged keeps them, some of them wrong'
        yield plain(f'{what} {kept}', 'red' if keep_damaged else 'yellow')


def _told_upload(found: Uploaded) -> str:
    name = f'{found.robot}/rosbags/{found.bag}'
    if found.is_delivered:
        return f'{name}: {counted(found.files, "file")}, {volume(found.bytes)}, confirmed by the store'
    left = found.files - found.delivered
    why = f' ({found.last_error})' if found.last_error else ''
    return f'{name}: {number(left)} of {counted(found.files, "file")} wait in the spool for the store{why}'


def _tell(steps: list[WatchStep], as_json: bool) -> None:
    for step in steps:
        if as_json:
            print_json(asdict(step), is_line=True)
        else:
            now = iso(SystemClock.of_this_machine().wall_ns())[:19]
            print_lines(plain(f'{now} {step.bag} {step.what} {step.reason}'.rstrip(), STEPS[step.what]))
