"""``shadowhound-data bag``: recordings, wherever they are: find, look at, check, download, cut out, send and record them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.bags.info import BagInfo, info_folder, info_of
from shadowhound_data_logger.bags.manifest import Missing
from shadowhound_data_logger.bags.naming import SLICES
from shadowhound_data_logger.bags.overview import BagRow, bag_overview
from shadowhound_data_logger.bags.remote import GROWING
from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    LazyCommands,
    Verb,
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
    print_page,
    shown_time,
    value_table,
    volume,
    with_dates,
)
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.errors import BagDamaged, BagError, NameRefused, StoreUnavailable
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, check_name
from shadowhound_data_logger.core.times import moment

STORE_THREADS: Final = 8
LOCAL_REMEDY: Final = 'shadowhound-data bag verify DIR --deep shows what is damaged'
MIN_RATED_S: Final = 0.01
"""A bag that is shorter has no rates."""
REPAIR: Final = 'In a folder, `shadowhound-data bag repair` recovers what a damaged file still holds.'
STATES: Final = {'complete': 'green', 'growing': 'cyan', 'recovered': 'yellow', 'gaps': 'yellow', 'foreign': 'dim'}
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
def in_folder() -> Iterator[None]:
    """What helps against damage in a folder, which no store may have."""
    try:
        yield
    except BagDamaged as error:
        error.remedy = error.remedy or LOCAL_REMEDY
        raise


@contextmanager
def in_store_hint(name: str) -> Iterator[None]:
    """The name of a bag means one in the store; a folder of that name needs a slash."""
    try:
        yield
    except BagError as error:
        if Path(name).is_dir():
            error.remedy = f'the folder {name} is ./{name}: a name without a slash is that of a bag in the store'
        raise


robot_option = click.option(
    '--robot',
    metavar='NAME',
    callback=robot_name,
    help='The robot  [default: SHADOWHOUND_ROBOT, otherwise that of this machine or store]',
)
bag_or_folder = click.argument('bag', metavar='BAG|DIR', callback=_bag)


@click.group(
    commands=LazyCommands(
        (
            Verb('verify', module='bag_check', attribute='bag_verify'),
            Verb('repair', module='bag_check', attribute='bag_repair'),
            Verb('fetch', module='bag_copy', attribute='bag_fetch'),
            Verb('cut', module='bag_copy', attribute='bag_cut'),
            Verb('upload', module='bag_send', attribute='bag_upload'),
            Verb('watch', module='bag_send', attribute='bag_watch'),
            Verb('record', module='bag_send', attribute='bag_record'),
        )
    ),
    epilog=examples(
        'bag list --since yesterday',
        'bag fetch patrol_20251018_120000 --to bags',
    ),
)
def bag() -> None:
    """Find, download, check, cut and upload bags.

    BAG is the name of a bag in the store, as `bag list` shows it. The store is the S3 server in AWS_ENDPOINT_URL, otherwise
    the folder SHADOWHOUND_HOME/store. A bag in a folder is named by a path with a slash: ./patrol_20251018_120000
    """


@bag.command('list', epilog=examples('bag list --since yesterday', 'bag list --robot tachi --json'))
@click.option('--since', default='', metavar='TIME', help='From TIME on: yesterday, 2h, 2026-11-20, 2026-11-20T12:30 (UTC).')
@robot_option
@as_json
def bag_list(*, since: str, robot: str | None, as_json: bool) -> ExitCode:
    """List the bags in the store and on this machine.

    \b
    growing    still recorded, or not all of it has arrived yet
    complete   all slices are known, with their checksums
    gaps       the same, but messages were dropped while it recorded: bag info says which
    recovered  the same, after a crash or power cut: bag info says what is missing
    foreign    not made by this package: its intended content is unknown

    Exit code 1 if something is wrong with a bag, or if the store is unreachable: then only the bags on this machine are
    listed.
    """  # noqa: D301 - click's mark for lines that are not wrapped
    begin_ns = moment('--since', since, SystemClock.of_this_machine().wall_ns()) if since else 0
    robot = the_robot(robot, in_store=True)
    with the_store(STORE_THREADS) as store:
        where, away = store.describe(), ''
        try:
            rows = bag_overview(store, robot, the_home(), since_ns=begin_ns)
        except StoreUnavailable as error:
            rows, away = bag_overview(store, robot, the_home(), since_ns=begin_ns, is_local=True), str(error)
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
@bag_or_folder
@robot_option
@as_json
def bag_info(*, bag: str | Path, robot: str | None, as_json: bool) -> ExitCode:
    """Show topics, rates, times and files of a bag.

    It downloads very little, except for MCAP files whose summary lacks the message counts: those are read completely. Exit
    code 1 if a file is missing or cannot be read.
    """
    if isinstance(bag, Path):
        with in_folder():
            found = info_folder(bag)
    else:
        with in_store_hint(bag), the_store(STORE_THREADS) as store:
            found = info_of(store, the_robot(robot, in_store=True), bag, the_home())
    if as_json:
        print_json(_info_json(found))
    else:
        print_page(*_page(found))
    return exit_code(finding=found.missing or found.description.damaged)


def _rows(rows: Sequence[BagRow]) -> RenderableType:
    columns = ('bag', 'state', 'began (UTC)', 'duration', 'messages', 'topics', 'slices', 'size', 'where')
    table = plain_table('Bags', columns, ('bag', 'state', 'began (UTC)', 'where'), minor=('slices', 'topics', 'duration'))
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
    info = found.description
    yield Text.assemble(plain(found.bag, 'bold'), '  ', plain(found.state, STATES.get(found.state, 'red')))
    manifest = found.manifest
    mission, event = (manifest.mission, manifest.event) if manifest else (None, None)
    lines = {
        'robot': found.robot or (manifest.robot if manifest else ''),
        'mission': f'{mission.type}, run {mission.run_id or "-"}, id {mission.mission_id or "-"}' if mission else '',
        'event': ', '.join(f'{each.name} by {each.by}' for each in event.triggers) if event else '',
        'clock': _clock(info.clock, info.t_start_ns) if info.clock else '',
        'began': f'{shown_time(info.t_start_ns)} UTC' if info.t_start_ns is not None else '-',
        'ended': f'{shown_time(info.t_end_ns)} UTC' if info.t_end_ns is not None else '-',
        'duration': duration(info.duration_s) if info.duration_s is not None else '-',
        'messages': f'{number(info.messages)} on {counted(len({topic.name for topic in info.topics}), "topic")}',
        'size': f'{volume(found.bytes)} in {counted(len(found.files), "file")}',
        'storage': ', '.join(filter(None, (info.storage, info.compression, f'ROS {info.distro}' if info.distro else ''))),
    }  # fmt: skip
    yield value_table('', {name: value for name, value in lines.items() if value})
    yield ''
    yield _topics(found)
    yield ''
    yield _files(found)
    yield from (plain(f'{name} {why}; it is not counted.', 'red') for name, why in info.damaged.items())
    yield from [REPAIR] if info.damaged else []
    if found.missing:
        yield plain(f'{"Not here yet" if found.robot else "Not here"}: {", ".join(found.missing)}', 'yellow')
    yield from remark_lines(info.remarks)
    yield from lost_lines(manifest.missing if manifest else ())


def _clock(clock: Mapping[str, str], start_ns: int | None) -> str:
    """What the times of a bag are worth whose clock was not set."""
    if meta.CLOCK_OFFSET_NS not in clock:
        return f'was never set in boot {clock[meta.BOOT_ID]}: the date is not known, and the times below are by that clock'
    offset_ns = int(clock[meta.CLOCK_OFFSET_NS])
    began = f'the bag began {shown_time(start_ns + offset_ns)} UTC' if start_ns is not None else 'the bag has no messages'
    return f'was not set yet: {began}, and {offset_ns / 1e9:.3f} s must be added to the times below'


def lost_lines(missing: Sequence[Missing]) -> Iterator[RenderableType]:
    """What the recording itself could not get into the bag."""
    for lost in missing:
        count = '' if lost.messages is None else f' ({counted(lost.messages, "message")})'
        topic = f' of {lost.topic}' if lost.topic else ''
        yield plain(f'Missing{topic}, in or after {lost.file}: {lost.what}{count}', 'yellow')


def remark_lines(remarks: Sequence[str]) -> Iterator[Text]:
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
    """The QoS that decides whether a subscription receives messages; of several publishers each that differs."""
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
    info = found.description
    times = with_dates({'t_start_ns': info.t_start_ns, 't_end_ns': info.t_end_ns}) if info.t_start_ns is not None else {}
    parts = {part.name: with_dates(asdict(part)) for part in info.parts}
    return {
        'robot': found.robot, 'bag': found.bag, 'state': found.state, **times, 'duration_s': info.duration_s,
        'messages': info.messages, 'bytes': found.bytes, 'storage': info.storage, 'compression': info.compression,
        'ros_distro': info.distro, 'topics': [asdict(topic) for topic in info.topics],
        'files': [
            {**parts.get(name, {'name': name}), 'bytes': size, 'where': where} for name, (size, where) in found.files.items()
        ],
        'clock': dict(info.clock) or None, 'missing': list(found.missing), 'damaged': dict(info.damaged),
        'remarks': list(info.remarks), 'read_bytes': found.read_bytes,
        'manifest': json.loads(found.manifest.to_json()) if found.manifest else None,
    }  # fmt: skip
