"""``shadowhound-data bag upload``, ``bag watch`` and ``bag record``: bags into the store."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click

from shadowhound_data_logger.bags.naming import safe_bag
from shadowhound_data_logger.bags.record import DEADLINE_S, record
from shadowhound_data_logger.bags.upload import Uploaded, deliver, open_spool, plan_upload, spool_upload, upload_now
from shadowhound_data_logger.bags.watch import Watch, WatchStep
from shadowhound_data_logger.cli.bag import REPAIR, STORE_THREADS, in_folder, remark_lines, robot_option
from shadowhound_data_logger.cli.common import (
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_home,
    the_robot,
    the_store,
)
from shadowhound_data_logger.cli.output import (
    counted,
    number,
    plain,
    print_json,
    print_lines,
    volume,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.core.clock import SystemClock, iso
from shadowhound_data_logger.core.config import Settings

LOOK_S: Final = 5.0
"""Between two looks for bags that are finished."""
STEPS: Final = {'spooled': 'cyan', 'stored': 'green', 'removed': 'green', 'refused': 'red'}


@click.command('upload', epilog=examples('bag upload my_bag', 'bag upload my_bag --bag-name patrol_2 --tar-gz'))
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
@robot_option
@as_json
def bag_upload(
    *, folder: Path, bag_name: str, direct: bool, timeout: float, robot: str | None, as_json: bool, tar_gz: bool
) -> ExitCode:
    """Upload a finished bag.

    The files of an SQLite or MCAP bag of rosbag2 are stored unchanged, with a manifest of their checksums.

    The bag passes through the spool of this machine, and the command waits until the store has it. If the store is
    unreachable within --timeout, the exit code is 1 and the bag is safe in the spool: the node that runs here, or the next
    upload, delivers it. DIR is never changed.
    """
    robot, folder = the_robot(robot), folder.absolute()
    settings, clock = Settings.load({'robot': robot}, os.environ), SystemClock.of_this_machine()
    with (
        in_folder(),
        plan_upload(folder, robot, bag_name or safe_bag(folder.name), the_home(), is_archive=tar_gz) as sent,
        progress('sent', of='bytes') as bar,
    ):
        if direct:
            with the_store(STORE_THREADS) as store:
                found = upload_now(store, sent, deadline_s=timeout, progress=bar)
        else:
            with open_spool(settings, clock) as spool:
                spool_upload(sent, spool)
                found = deliver(settings, spool, sent, deadline_s=timeout, progress=bar)
    if as_json:
        facts = {'damaged': dict(sent.damaged), 'remarks': list(sent.remarks), 'renamed': dict(sent.renamed)}
        print_json({**asdict(found), 'is_delivered': found.is_delivered, **facts})
    else:
        damaged = (plain(f'{name} {why}; it was uploaded unchanged.', 'red') for name, why in sent.damaged.items())
        renamed = (f'{name} is {stored} in the store.' for name, stored in sent.renamed.items())
        print_lines(_told_upload(found), *renamed, *damaged, *([REPAIR] if sent.damaged else []), *remark_lines(sent.remarks))
    return exit_code(finding=not found.is_delivered or sent.damaged)


@click.command('watch', epilog=examples('bag watch bags --remove'))
@click.argument('folder', metavar='DIR', type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option(
    '--settle',
    type=click.FloatRange(0.0, 86_400.0),
    default=10.0,
    show_default=True,
    metavar='S',
    help='Treat a bag as finished after S seconds without a change.',
)
@click.option('--remove', is_flag=True, help='Remove a bag from DIR once the store has confirmed every file of it.')
@click.option('--once', is_flag=True, help='Check twice, --settle seconds apart, and exit: for a timer.')
@robot_option
@as_json
def bag_watch(*, folder: Path, settle: float, once: bool, robot: str | None, as_json: bool, remove: bool) -> ExitCode:
    """Upload each finished bag in DIR, until Ctrl-C.

    It uploads each bag once, for example those of `ros2 bag record`.

    A bag is finished if it is a folder in DIR with a metadata.yaml and all files that it names, unchanged for --settle
    seconds. DIR/.shadowhound-bags.json lists what was uploaded, so that a restart does not upload it again. With --once, exit
    code 1 means that a bag is not in the store yet.
    """
    settings = Settings.load({'robot': the_robot(robot)}, os.environ)
    watching = Watch(folder.absolute(), settings, SystemClock.of_this_machine(), settle_s=settle, is_removing=remove)
    with watching.exclusive():
        try:
            while True:
                _tell(watching.round(), as_json)
                time.sleep(settle if once else LOOK_S)
                if once:
                    _tell(watching.round(), as_json)
                    return exit_code(finding=watching.has_undelivered())
        except KeyboardInterrupt:
            return ExitCode.FINE


@click.command('record', epilog=examples('bag record kitchen --duration 60 --topic /imu --topic /odom'))
@click.argument('name')
@click.option('--duration', type=click.FloatRange(0.1, 86_400.0), required=True,
              metavar='S', help='Stop after S seconds, or with Ctrl-C.')  # fmt: skip
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
@robot_option
@as_json
def bag_record(*, topics: tuple[str, ...], robot: str | None, as_json: bool, **wanted: Any) -> ExitCode:
    """Record topics into a bag and upload it.

    The bag is NAME_YYYYMMDD_HHMMSS; without --topic and --regex it has all topics, of a Unitree those of the
    default sensors.

    It needs ROS 2, but neither rosbag2 nor a running node. Slices are uploaded while it records. If the store is unreachable,
    the bag waits in the spool and the exit code is 1.
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
