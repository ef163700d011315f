"""``shadowhound-data bag verify`` and ``bag repair``: whether a bag is intact, and copies of what a damaged one still has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Final

import click
from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.bags.remote import FOREIGN, GROWING, find_bag
from shadowhound_data_logger.bags.repair import BagRepair, FileRepair, repair_bag
from shadowhound_data_logger.bags.verify import VerifiedBag, verify_folder, verify_remote
from shadowhound_data_logger.cli.bag import (
    REPAIR,
    STATES,
    STORE_THREADS,
    bag_or_folder,
    in_folder,
    in_store_hint,
    lost_lines,
    remark_lines,
    robot_option,
)
from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_robot,
    the_store,
)
from shadowhound_data_logger.cli.output import (
    counted,
    number,
    plain,
    print_json,
    print_page,
    shown_time,
    volume,
)
from shadowhound_data_logger.cli.progress import progress

MAX_LOSSES: Final = 20
"""Of a repaired file that are printed."""


@click.command('verify', epilog=examples('bag verify patrol_20251018_120000 --deep'))
@click.option('--deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@bag_or_folder
@robot_option
@as_json
def bag_verify(*, bag: str | Path, deep: bool, robot: str | None, as_json: bool) -> ExitCode:
    """Check that a bag is complete and intact.

    Exit code 0 only if every file is intact and the bag is not growing.

    In the store, sizes and checksums are compared, and only the summary of each slice is downloaded; --deep reads everything and
    unpacks every chunk. In a folder everything is read.
    """
    with progress('read', of='bytes') as bar:
        if isinstance(bag, Path):
            with in_folder():
                found = verify_folder(bag, deep=deep, on_progress=bar.have)
        else:
            with in_store_hint(bag), the_store(STORE_THREADS) as store:
                found = verify_remote(
                    store, find_bag(store, the_robot(robot, in_store=True), bag), deep=deep, on_progress=bar.have
                )
    if as_json:
        checks = [{'name': each.name, 'finding': each.finding, 'checked': each.checked} for each in found.checks]
        facts = {'bag': found.bag, 'state': found.state, 'checks': checks, 'read_bytes': found.read_bytes,
                 'missing': list(map(asdict, found.missing)), 'remarks': list(found.remarks)}  # fmt: skip
        report = {**facts, 'is_intact': found.is_intact, 'is_complete': found.state not in {GROWING, FOREIGN}}
        print_json(report)
    else:
        print_page(*_verdict(found))
    return exit_code(finding=not (found.is_intact and found.state != GROWING))


@click.command('repair', epilog=examples('bag repair my_bag', 'bag repair my_bag/my_bag_3.mcap --to repaired.mcap'))
@click.argument('path', metavar='PATH', type=click.Path(path_type=Path, exists=True))
@click.option('--to', type=click.Path(path_type=Path), metavar='PATH', help='Where to write it  [default: PATH_repaired]')
@click.option('--in-place', is_flag=True, help='Replace the damaged files; their damaged parts are lost.')
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


def _verdict(found: VerifiedBag) -> Iterator[RenderableType]:
    for check in found.findings:
        yield plain(f'{check.name} {check.finding}', 'red')
    yield from [REPAIR] if any(check.checked != 'presence' for check in found.findings) else []
    intact = [check for check in found.checks if not check.finding]
    how = ', '.join(sorted({check.checked for check in intact}))
    are = 'is' if len(intact) == 1 else 'are'
    text = (
        f'{number(len(intact))} of {counted(len(found.checks), "file")} {are} intact (by {how})'
        if intact
        else 'No file is intact'
    )
    yield Text.assemble(plain(found.bag, 'bold'), ' ', plain(found.state, STATES.get(found.state, 'red')), f': {text}.')
    yield from lost_lines(found.missing)
    yield from remark_lines(found.remarks)
    if found.state == GROWING:
        yield plain('It is still growing: its manifest, or a slice that it promises, is not there yet.', 'yellow')
    if found.state == FOREIGN:
        yield plain('It has no manifest, so what should be in it is not known.', 'dim')


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
