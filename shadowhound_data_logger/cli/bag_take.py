"""``bag fetch`` and ``bag cut``: a bag out of the store, whole or in part."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click
from rich.text import Text

from shadowhound_data_logger.bags.cut import COMES, Choice, Cut, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import THREADS
from shadowhound_data_logger.bags.fetch import fetch as fetch_bag
from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.cli.bag_common import Bar, as_json, bag_or_folder, moment, progress, robot, said_json, say, the_store
from shadowhound_data_logger.cli.tables import duration, number, plain, volume


@click.command()
@click.argument('bag', metavar='BAG')
@click.option('--to', type=click.Path(path_type=Path, file_okay=False), required=True, help='The folder above that of the bag.')
@click.option('--threads', type=click.IntRange(1, 32), default=THREADS, show_default=True, help='Files at a time.')
@robot
@as_json
def fetch(*, bag: str, to: Path, threads: int, robot: str, as_json: bool) -> int:
    """Download a bag as TO/BAG, or what is there of it yet, each file checked against its SHA-256.

    Run it again after it was stopped: it goes on where it ended. What is there and right is not downloaded again. A bag that is
    still growing gets a metadata.yaml of what there is, so that players open it; fetch it again later for the rest.
    """
    with the_store() as store, progress() as bar:
        there = find_bag(store, robot, bag)
        found = fetch_bag(store, there, to, threads=threads, told=Bar(bar, 'fetched'))
    if as_json:
        click.echo(json.dumps({**asdict(found), 'folder': str(found.folder)}, indent=2))
        return 0
    lines = [plain(f'{found.folder}: {number(found.files)} files, {volume(found.bytes)}; downloaded {volume(found.downloaded)}')]
    if found.unverified:
        lines.append(plain(f'No checksum is known of {", ".join(found.unverified)}: only the size was compared.', 'yellow'))
    elif found.missing:
        lines.append(plain(f'Not in the store yet: {", ".join(found.missing)}. Fetch it again for the rest.', 'cyan'))
    elif not found.is_complete:
        lines.append(plain('The bag is still growing: fetch it again for the rest.', 'cyan'))
    say(*lines)
    return 0


@click.command()
@bag_or_folder
@click.option('--start', default='', metavar='TIME', help='From then on  [default: the start of the bag]')
@click.option('--end', default='', metavar='TIME', help='Before then  [default: the end of the bag]')
@click.option('--topics', '--topic', multiple=True, metavar='TOPIC', help='Only these: repeat it, or put commas between them.')
@click.option('--regex', default='', help='Also topics in which this regular expression is found.')
@click.option('-o', '--output', type=click.Path(path_type=Path), required=True, help='The new folder, which becomes a bag.')
@robot
@as_json
def cut(*, bag: str | Path, topics: tuple[str, ...], output: Path, robot: str, as_json: bool, **wanted: str) -> int:
    """Copy a span of time and some topics of a bag into a new bag, message by message.

    \b
    TIME   2025-10-18T12:00:05.5   a date, UTC where it names no zone
           12.5                    seconds since the start of the bag
           -30                     seconds before its end
           1760788805.5            seconds since 1970

    It goes by the time at which messages were received, as ros2 bag play does. Of a bag in the store only the chunks that hold
    something of it are read. Exit code 1 when a slice of that time is not there.
    """  # noqa: D301 - click's mark for lines that stay as they are
    names = tuple(name.strip() for each in topics for name in each.split(',') if name.strip())
    choice = Choice(topics=names, **wanted)
    if isinstance(bag, Path):
        found = cut_folder(bag, output, choice)
    else:
        with the_store() as store:
            found = cut_remote(store, find_bag(store, robot, bag), output, choice)
    if as_json:
        click.echo(json.dumps(said_json({**asdict(found), 'folder': str(found.folder)}), indent=2))
    else:
        say(*_told(found))
    return 1 if found.missing else 0


def _told(found: Cut) -> Iterator[str | Text]:
    length = duration((found.t_end_ns - found.t_start_ns) / 1e9)
    what = f'{number(found.messages)} messages on {number(found.topics)} topics, {volume(found.bytes)}'
    share = f'{100 * found.read_bytes / max(found.bag_bytes, 1):.1f} %'
    read = f'Read {volume(found.read_bytes)} of {volume(found.bag_bytes)} ({share}) in {number(found.read_requests)} requests.'
    yield f'{found.folder}: {what}, {moment(found.t_start_ns)} to {moment(found.t_end_ns)} UTC ({length})'
    yield read
    if found.absent:
        yield plain(f'The bag has no topic {", ".join(found.absent)}.', 'yellow')
    if found.missing:
        yield plain(f'Not all of that time: {", ".join(found.missing)} is not there; {COMES}', 'yellow')
