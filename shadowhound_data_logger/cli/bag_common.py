"""What the verbs of ``shadowhound-data bag`` share: options, the store of the environment, progress, and how times are told."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn
from rich.text import Text

from shadowhound_data_logger.bags.fetch import Told
from shadowhound_data_logger.cli.tables import plain
from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.config import UploadSettings, home, store_settings
from shadowhound_data_logger.errors import NameRefused
from shadowhound_data_logger.keys import MAX_BAG_BYTES, check_name
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

THREADS = 8
STYLES = {'complete': 'green', 'growing': 'cyan', 'recovered': 'yellow', 'gaps': 'yellow', 'foreign': 'dim'}


def _robot(_: click.Context, __: click.Parameter, name: str) -> str:
    try:
        return check_name(name, 'the robot name')
    except NameRefused as error:
        raise click.BadParameter(str(error)) from error


def _bag(_: click.Context, __: click.Parameter, name: str) -> str | Path:
    """A name, or the path of a folder."""
    path = Path(name)
    if '/' in name or name in {'.', '..'}:
        if not path.is_dir():
            raise click.BadParameter(f'there is no folder {name}')
        return path.absolute()
    try:
        return check_name(name, 'the bag', MAX_BAG_BYTES)
    except NameRefused as error:
        raise click.BadParameter(str(error)) from error


as_json = click.option('--json', 'as_json', is_flag=True, help='Print it as JSON.')
robot = click.option(
    '--robot', envvar='SHADOWHOUND_ROBOT', default='thor', show_default=True, callback=_robot, help='Whose bags.'
)
bag_or_folder = click.argument('bag', metavar='BAG|DIR', callback=_bag)


@contextmanager
def the_store() -> Iterator[ObjectStore]:
    """The one that the environment names."""
    where = home(os.environ)
    store = open_store(store_settings(os.environ, where), UploadSettings(threads=THREADS))
    try:
        yield store
    finally:
        store.close()


def the_home() -> Path:
    """The folder of the spool and of what is being recorded."""
    return home(os.environ)


def progress() -> Progress:
    """Of bytes, on standard error, where that is a terminal."""
    console = Console(stderr=True)
    columns = (TextColumn('{task.description}'), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def moment(time_ns: int | None) -> str:
    """UTC, to the millisecond; a dash for what is not known."""
    if time_ns is None:
        return '-'
    when = datetime.fromtimestamp(time_ns // SECOND, timezone.utc)
    return f'{when:%Y-%m-%d %H:%M:%S}.{time_ns % SECOND // 1_000_000:03d}'


def iso_or_none(time_ns: int | None) -> str | None:
    """For programs: to the nanosecond."""
    if time_ns is None:
        return None
    when = datetime.fromtimestamp(time_ns // SECOND, timezone.utc)
    return f'{when:%Y-%m-%dT%H:%M:%S}.{time_ns % SECOND:09d}Z'


def said_json(value: dict[str, Any]) -> dict[str, Any]:
    """With each ``..._ns`` told as a date as well."""
    dates = {name.removesuffix('_ns'): iso_or_none(time) for name, time in value.items() if name.endswith('_ns')}
    return {**value, **dates}


def say(*lines: str | Text) -> None:
    """Lines that a terminal folds and a file keeps whole."""
    console = Console(highlight=False)
    for line in lines:
        console.print(plain(line) if isinstance(line, str) else line, soft_wrap=True)


class Bar(Told):
    """A progress bar that any thread may move."""

    def __init__(self, bar: Progress, what: str) -> None:
        self._bar = bar
        self._task = bar.add_task(what, total=None)
        self._lock = threading.Lock()

    def begin(self, total: int) -> None:
        self._bar.update(self._task, total=total)

    def have(self, count: int) -> None:
        with self._lock:
            self._bar.advance(self._task, count)
