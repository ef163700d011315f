"""``shadowhound-data bag fetch`` and ``bag cut``: bags, and parts of them, from the store or a folder."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.text import Text

from shadowhound_data_logger.bags.cut import MAY_ARRIVE, Choice, Cut, cut_folder, cut_remote
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.cli.bag import (
    REPAIR,
    STORE_THREADS,
    bag_or_folder,
    in_folder,
    in_store_hint,
    remark_lines,
    robot_option,
)
from shadowhound_data_logger.cli.common import (
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_robot,
    the_store,
)
from shadowhound_data_logger.cli.output import (
    counted,
    duration,
    number,
    plain,
    print_json,
    print_lines,
    shown_time,
    volume,
    with_dates,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import ranges_option


@click.command('fetch', epilog=examples('bag fetch patrol_20251018_120000 --to bags'))
@click.argument('bag', metavar='BAG')
@click.option(
    '--to',
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar='DIR',
    help='Where to write it.',
)
@robot_option
@as_json
def bag_fetch(*, bag: str, to: Path, robot: str | None, as_json: bool) -> ExitCode:
    """Download a bag, verified.

    The bag becomes DIR/BAG. Run it again after an interruption: complete files are skipped. A bag that is still growing gets
    a metadata.yaml of the files so far, so that players can open it; fetch it again later for the rest.
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
        lines.append(plain(f'There is no checksum for {", ".join(found.unverified)}: only the size was compared.', 'yellow'))
    elif found.missing:
        lines.append(plain(f'Not in the store yet: {", ".join(found.missing)}. Fetch it again for the rest.', 'cyan'))
    elif not found.is_complete:
        lines.append(plain('The bag is still growing: fetch it again for the rest.', 'cyan'))
    print_lines(*lines)
    return ExitCode.FINE


@click.command(
    'cut',
    epilog=examples(
        'bag cut patrol_20251018_120000 --start +30 --end +60 --to cut',
        'bag cut ./patrol_20251018_120000 --topic /imu --topic /odom --to cut',
    ),
)
@bag_or_folder
@click.option('--start', default='', metavar='TIME', help='From this time on  [default: the start of the bag]')
@click.option('--end', default='', metavar='TIME', help='Before this time  [default: the end of the bag]')
@ranges_option
@click.option('--topic', 'topics', multiple=True, metavar='NAME', help='Only of this topic; may be repeated.')
@click.option('--regex', default='', help='Also topics whose name matches this regular expression.')
@click.option('--to', type=click.Path(path_type=Path), required=True, metavar='DIR', help='Where to write it.')
@robot_option
@as_json
def bag_cut(*, bag: str | Path, topics: tuple[str, ...], to: Path, robot: str | None, as_json: bool, ranges: list[Any] | None,
            **wanted: str) -> ExitCode:  # fmt: skip
    """Copy a span of time or some topics into a new bag.

    \b
    TIME   2025-10-18T12:00:05.5   a date, UTC unless it names a zone
           12.5                    seconds since the start of the bag
           -30                     seconds before its end
           1760788805.5            seconds since 1970

    Times are when messages were received, as in ros2 bag play; those of --ranges are stamps of messages, which are slightly
    earlier: query --pad 1 extends each. For a bag in the store, only the required chunks are read. Exit code 1 if a slice of
    that time is missing or cannot be read.
    """  # noqa: D301 - click's mark for lines that are not wrapped
    choice = Choice(topics=topics, spans=None if ranges is None else _spans(ranges), **wanted)
    if isinstance(bag, Path):
        with in_folder():
            found = cut_folder(bag, to, choice)
    else:
        with in_store_hint(bag), the_store(STORE_THREADS) as store:
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
    yield from (plain(f'{name} {why}; none of it was copied.', 'red') for name, why in found.damaged.items())
    yield from [REPAIR] if found.damaged else []
    if found.extras:
        what = 'attachment or metadata record' if found.extras == 1 else 'attachments or metadata records'
        yield f'Not copied: {number(found.extras)} {what}.'
    if found.absent:
        yield plain(f'The bag has no topic {", ".join(found.absent)}.', 'yellow')
    if found.missing:
        yield plain(
            f'Not all of that time: {", ".join(found.missing)} is not there{f"; {MAY_ARRIVE}" if is_remote else ""}', 'yellow'
        )
    yield from remark_lines(found.remarks)
