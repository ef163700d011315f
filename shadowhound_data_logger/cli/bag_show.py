"""``bag list``, ``bag info`` and ``bag verify``: what there is, what is in it, and whether it is what was recorded."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console, RenderableType
from rich.text import Text

from shadowhound_data_logger.bags.info import BagInfo, info_folder, info_of
from shadowhound_data_logger.bags.manifest import ClockOf, Missing
from shadowhound_data_logger.bags.overview import BagRow, NoStore, overview
from shadowhound_data_logger.bags.remote import FOREIGN, GROWING, find_bag
from shadowhound_data_logger.bags.span import since as since_ns
from shadowhound_data_logger.bags.verify import Verified, verify_folder, verify_remote
from shadowhound_data_logger.cli.bag_common import (
    STYLES,
    as_json,
    bag_or_folder,
    moment,
    progress,
    robot,
    said_json,
    the_home,
    the_store,
)
from shadowhound_data_logger.cli.tables import duration, number, plain, plain_table, show_whole, volume
from shadowhound_data_logger.clock import SystemClock
from shadowhound_data_logger.errors import StoreUnavailable

DURABILITY: Final = {1: 'transient_local', 2: 'volatile'}
RELIABILITY: Final = {1: 'reliable', 2: 'best_effort'}
"""rmw's numbers, which bags before Jazzy keep; https://docs.ros.org/en/jazzy/p/rmw/generated/file_include_rmw_types.h.html"""


@click.command('list')
@click.option('--since', default='', metavar='TIME', help='Those that began since: 2025-10-18, 2025-10-18T12:00, 90min, 12h, 2d.')
@robot
@as_json
def list_(*, since: str, robot: str, as_json: bool) -> int:
    """One line a bag, the newest last: those in the store, and those still on this machine.

    \b
    growing    still recorded, or not all of it has arrived yet
    complete   all slices are known, with their checksums
    gaps       the same, but messages were dropped while it recorded: bag info says which
    recovered  the same, after a crash or power cut: bag info says what is missing
    foreign    not from this package: nobody says what should be in it

    Exit code 1 when something is wrong with one of them, or the store is away: then only what is on this machine is told.
    """  # noqa: D301 - click's mark for lines that stay as they are
    begin_ns = since_ns(since, SystemClock.of_this_machine().wall_ns(), '--since') if since else 0
    with the_store() as store:
        where, away = store.describe(), ''
        try:
            rows = overview(store, robot, the_home(), since_ns=begin_ns)
        except StoreUnavailable as error:
            rows, away = overview(NoStore(), robot, the_home(), since_ns=begin_ns), str(error)
            click.echo(f'The store is away, so this is what is on this machine: {away}', err=True)
    if as_json:
        click.echo(json.dumps([said_json(asdict(row)) for row in rows], indent=2))
    elif not rows:
        click.echo(f'There is no bag of {robot} in {where}, nor on this machine{" since then" if since else ""}.')
    else:
        show_whole([_rows(rows), *_findings(rows)], Console(highlight=False))
    return 1 if away or any(row.finding and row.state != GROWING for row in rows) else 0


@click.command()
@bag_or_folder
@robot
@as_json
def info(*, bag: str | Path, robot: str, as_json: bool) -> int:
    """Topics, types, rates, QoS, times and slices of a bag, from a few short reads. Exit code 1 when a slice is missing."""
    if isinstance(bag, Path):
        found = info_folder(bag)
    else:
        with the_store() as store:
            found = info_of(store, robot, bag, the_home())
    if as_json:
        click.echo(json.dumps(_info_json(found), indent=2))
    else:
        show_whole(list(_page(found)), Console(highlight=False))
    return 1 if found.missing else 0


@click.command()
@click.option('--deep', is_flag=True, help='Read every byte: content against checksums, and the CRC of every chunk.')
@bag_or_folder
@robot
@as_json
def verify(*, bag: str | Path, deep: bool, robot: str, as_json: bool) -> int:
    """Whether every slice is there as it was recorded. Exit code 0 only when it is, and the bag is not growing.

    In the store sizes and checksums are compared, and nothing is downloaded but each slice's summary; in a folder everything is
    read. --deep reads everything in the store as well, and unpacks every chunk.
    """
    with progress() as bar:
        task = bar.add_task('read', total=None)

        def told(count: int) -> None:
            bar.advance(task, count)

        if isinstance(bag, Path):
            found = verify_folder(bag, deep=deep, told=told)
        else:
            with the_store() as store:
                found = verify_remote(store, find_bag(store, robot, bag), deep=deep, told=told)
    if as_json:
        said = {**asdict(found), 'is_sound': found.is_sound, 'is_complete': found.state not in {GROWING, FOREIGN}}
        click.echo(json.dumps(said, indent=2))
    else:
        show_whole(list(_verdict(found)), Console(highlight=False))
    return 0 if found.is_sound and found.state != GROWING else 1


def _rows(rows: Sequence[BagRow]) -> RenderableType:
    columns = ('bag', 'state', 'began (UTC)', 'duration', 'messages', 'topics', 'slices', 'size', 'where')
    table = plain_table('Bags', columns, ('bag', 'state', 'began (UTC)', 'where'))
    for row in rows:
        length = '-' if row.t_start_ns is None or row.t_end_ns is None else duration((row.t_end_ns - row.t_start_ns) / 1e9)
        table.add_row(
            plain(row.bag), plain(row.state, STYLES.get(row.state, 'red')), moment(row.t_start_ns)[:19], length,
            number(row.messages), number(row.topics), number(row.slices), volume(row.bytes), _places(row.where),
        )  # fmt: skip
    return table


def _places(where: Mapping[str, int]) -> str:
    """Only the place, where it is one."""
    return next(iter(where)) if len(where) == 1 else ', '.join(f'{place} {count}' for place, count in where.items())


def _findings(rows: Sequence[BagRow]) -> Iterator[RenderableType]:
    found = [row for row in rows if row.finding]
    if found:
        yield ''
        yield from (plain(f'{row.bag}: {row.finding}', 'yellow') for row in found)


def _page(found: BagInfo) -> Iterator[RenderableType]:
    told = found.description
    yield Text.assemble(plain(found.bag, 'bold'), '  ', plain(found.state, STYLES.get(found.state, 'red')))
    manifest = found.manifest
    mission, event = (manifest.mission, manifest.event) if manifest else (None, None)
    lines = {
        'robot': found.robot or (manifest.robot if manifest else ''),
        'mission': f'{mission.type}, run {mission.run_id or "-"}, id {mission.mission_id or "-"}' if mission else '',
        'event': ', '.join(f'{each.name} by {each.by}' for each in event.triggers) if event else '',
        'clock': _clock(manifest.clock, told.t_start_ns) if manifest and manifest.clock else '',
        'began': f'{moment(told.t_start_ns)} UTC' if told.messages else '-',
        'ended': f'{moment(told.t_end_ns)} UTC' if told.messages else '-',
        'duration': duration(told.duration_s), 'messages': f'{number(told.messages)} on {len(told.topics)} topics',
        'size': f'{volume(found.bytes)} in {len(found.files)} files',
        'storage': ', '.join(filter(None, (told.storage, told.compression, f'ROS {told.distro}' if told.distro else ''))),
    }  # fmt: skip
    table = plain_table('', ('', 'value'), ('', 'value'))
    table.show_header = False
    table.padding = (0, 2, 0, 0)
    for name, value in lines.items():
        if value:
            table.add_row(plain(name, 'dim'), plain(value))
    yield table
    yield ''
    yield _topics(found)
    yield ''
    yield _files(found)
    if found.missing:
        yield plain(f'Not here yet: {", ".join(found.missing)}', 'yellow')
    yield from _lost(manifest.missing if manifest else ())


def _clock(clock: ClockOf, start_ns: int) -> str:
    """What the times of a bag are worth whose clock was not set."""
    if clock.offset_ns is None:
        return f'was never set in boot {clock.boot_id}: nobody knows the date, and the times below are by that clock'
    began = f'the bag began {moment(start_ns + clock.offset_ns)} UTC'
    return f'was not set yet: {began}, and {clock.offset_ns / 1e9:.3f} s are to be added to the times below'


def _lost(missing: Sequence[Missing]) -> Iterator[RenderableType]:
    """What the recording itself could not get into the bag."""
    for lost in missing:
        count = '' if lost.messages is None else f' ({number(lost.messages)} messages)'
        topic = f' of {lost.topic}' if lost.topic else ''
        yield plain(f'Missing{topic}, in or after {lost.file}: {lost.what}{count}', 'yellow')


def _topics(found: BagInfo) -> RenderableType:
    table = plain_table('Topics', ('topic', 'type', 'messages', 'rate', 'QoS'), ('topic', 'type', 'QoS'))
    seconds = found.description.duration_s
    for topic in sorted(found.description.topics, key=lambda each: each.name):
        rate = f'{(topic.messages - 1) / seconds:.1f} Hz' if topic.messages > 1 and seconds else '-'
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
        table.add_row(plain(name), moment(start), length, number(part.messages if part else None), volume(size), where)
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
    times = said_json({'t_start_ns': told.t_start_ns, 't_end_ns': told.t_end_ns}) if told.messages else {}
    parts = {part.name: said_json(asdict(part)) for part in told.parts}
    return {
        'robot': found.robot, 'bag': found.bag, 'state': found.state, **times, 'duration_s': told.duration_s,
        'messages': told.messages, 'bytes': found.bytes, 'storage': told.storage, 'compression': told.compression,
        'ros_distro': told.distro, 'topics': [asdict(topic) for topic in told.topics],
        'files': [
            {**parts.get(name, {'name': name}), 'bytes': size, 'where': where} for name, (size, where) in found.files.items()
        ],
        'missing': list(found.missing), 'read_bytes': found.read_bytes,
        'manifest': json.loads(found.manifest.to_json()) if found.manifest else None,
    }  # fmt: skip


def _verdict(found: Verified) -> Iterator[RenderableType]:
    for check in found.findings:
        yield plain(f'{check.name} {check.finding}', 'red')
    sound = [check for check in found.checks if not check.finding]
    how = ', '.join(sorted({check.checked for check in sound}))
    text = f'{number(len(sound))} of {number(len(found.checks))} files are sound (by {how})' if sound else 'No file is sound'
    yield Text.assemble(plain(found.bag, 'bold'), ' ', plain(found.state, STYLES.get(found.state, 'red')), f': {text}.')
    yield from _lost(found.missing)
    if found.state == GROWING:
        yield plain('It is still growing: its manifest, or a slice that it promises, is not there yet.', 'yellow')
    if found.state == FOREIGN:
        yield plain('It has no manifest, so nobody says what should be in it.', 'dim')
