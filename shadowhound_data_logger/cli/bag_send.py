"""``bag upload``, ``bag watch`` and ``bag record``: bags into the store."""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from shadowhound_data_logger.bags.record import DEADLINE_S
from shadowhound_data_logger.bags.record import record as record_bag
from shadowhound_data_logger.bags.upload import Uploaded, deliver, opened_spool, parcel, spool_parcel, upload_now
from shadowhound_data_logger.bags.watch import Step, Watch
from shadowhound_data_logger.cli.bag_common import Bar, as_json, progress, robot, say, the_home, the_store
from shadowhound_data_logger.cli.tables import number, plain, volume
from shadowhound_data_logger.clock import SystemClock, iso
from shadowhound_data_logger.config import Settings

STYLES = {'spooled': 'cyan', 'stored': 'green', 'removed': 'green', 'refused': 'red'}


@click.command()
@click.argument('folder', metavar='DIR', type=click.Path(path_type=Path))
@click.option('--name', default='', help='The name of the bag in the store  [default: that of DIR]')
@click.option('--tar-gz', is_flag=True, help='As one ROBOT/rosbags/NAME.tar.gz instead of its files.')
@click.option('--now', is_flag=True, help='Past the spool: nothing is left behind when it does not get through in time.')
@click.option('--deadline', type=click.FloatRange(0.0, 1e7), default=600.0, show_default=True, help='Seconds to wait for Tower.')
@robot
@as_json
def upload(*, folder: Path, name: str, now: bool, deadline: float, robot: str, as_json: bool, tar_gz: bool) -> int:
    """Send a finished bag, SQLite or MCAP, as rosbag2 wrote it: its files as they are, and a manifest with their checksums.

    It goes through the spool of this machine and waits until the store has it. When Tower is away for longer than the deadline
    the bag stays in the spool, safe, and is delivered by the node that runs here, or by the next upload; exit code 1 says so.
    DIR itself is never touched.
    """
    folder = folder.absolute()
    settings, clock = Settings.load({'robot': robot}, os.environ), SystemClock.of_this_machine()
    with parcel(folder, robot, name or folder.name, the_home(), is_archive=tar_gz) as sent, progress() as bar:
        if now:
            with the_store() as store:
                found = upload_now(store, sent, deadline_s=deadline, told=Bar(bar, 'sent'))
        else:
            with opened_spool(settings, clock) as spool:
                spool_parcel(sent, spool)
                found = deliver(settings, spool, sent, deadline_s=deadline, told=Bar(bar, 'sent'))
    if as_json:
        click.echo(json.dumps({**asdict(found), 'is_delivered': found.is_delivered}, indent=2))
    else:
        say(_told(found))
    return 0 if found.is_delivered else 1


@click.command()
@click.argument('folder', metavar='DIR', type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option('--settle', type=click.FloatRange(0.0, 86_400.0), default=10.0, show_default=True, help='Seconds without a change.')
@click.option('--every', type=click.FloatRange(0.1, 3600.0), default=5.0, show_default=True, help='Seconds between two looks.')
@click.option('--remove', is_flag=True, help='Remove a bag from DIR once the store has confirmed every file of it.')
@click.option('--once', is_flag=True, help='Look, wait for what is still changing, look again, and end. For a timer.')
@robot
@as_json
def watch(*, folder: Path, settle: float, every: float, once: bool, robot: str, as_json: bool, remove: bool) -> int:
    """Send every bag that `ros2 bag record` finishes in DIR, each once, until Ctrl-C.

    Finished is a folder in DIR with a metadata.yaml and all that it names, unchanged for --settle seconds. What was sent stands
    in DIR/.shadowhound-bags.json: it is not sent again after a restart. With --once exit code 1 says that something is not in
    the store yet.
    """
    settings = Settings.load({'robot': robot}, os.environ)
    watching = Watch(folder.absolute(), settings, SystemClock.of_this_machine(), settle_s=settle, is_removing=remove)
    with watching.alone():
        try:
            while True:
                _tell(watching.round(), as_json)
                time.sleep(settle if once else every)
                if once:
                    _tell(watching.round(), as_json)
                    return 1 if watching.is_owing() else 0
        except KeyboardInterrupt:
            return 0


@click.command()
@click.argument('name')
@click.option('--duration', type=click.FloatRange(0.1, 86_400.0), required=True, help='Seconds; Ctrl-C ends it earlier.')
@click.option('--topic', '--topics', 'topics', multiple=True, help='Record it; more by repeating it, or with commas.')
@click.option('--regex', default='', help='Record also topics in which it is found; ".*" is all of them.')
@click.option('--deadline', type=click.FloatRange(0.0, 1e6), default=DEADLINE_S, show_default=True, help='Seconds for Tower.')
@robot
@as_json
def record(*, topics: tuple[str, ...], as_json: bool, **wanted: Any) -> int:
    """Record topics as NAME_YYYYMMDD_HHMMSS and have it in the store; without a topic those that the node logs by default.

    It needs ROS 2, but not its rosbag2, and no node that runs. Slices leave while it records. When Tower is away the bag waits in
    the spool, and exit code 1 says so.
    """
    names = [name.strip() for each in topics for name in each.split(',') if name.strip()]
    duration, deadline = wanted.pop('duration'), wanted.pop('deadline')
    found = record_bag(duration_s=duration, deadline_s=deadline, topics=names, **wanted)
    if as_json:
        click.echo(json.dumps({**asdict(found), 'where': found.where}, indent=2))
    else:
        state = 'confirmed by the store' if found.delivered else f'waits in the spool for the store ({found.last_error})'
        say(f'{found.where}: {number(found.messages)} messages on {number(len(found.topics))} topics, '
            f'{number(found.slices)} slices, {volume(found.bytes)}, {state}')  # fmt: skip
        if found.dropped:
            say(f'{number(found.dropped)} messages were dropped: this machine was too slow for them.')
    return 0 if found.delivered and not found.dropped else 1


def _told(found: Uploaded) -> str:
    name = f'{found.robot}/rosbags/{found.bag}'
    if found.is_delivered:
        return f'{name}: {number(found.files)} files, {volume(found.bytes)}, confirmed by the store'
    left = found.files - found.delivered
    why = f' ({found.last_error})' if found.last_error else ''
    return f'{name}: {number(left)} of {number(found.files)} files wait in the spool for the store{why}'


def _tell(steps: list[Step], as_json: bool) -> None:
    console = Console(highlight=False)
    for step in steps:
        if as_json:
            click.echo(json.dumps(asdict(step)))
        else:
            now = iso(SystemClock.of_this_machine().wall_ns())[:19]
            console.print(plain(f'{now} {step.bag} {step.what} {step.reason}'.rstrip(), STYLES[step.what]), soft_wrap=True)
