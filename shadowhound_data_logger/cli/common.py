"""What the verbs share: options, exit codes, examples, and the store that the environment names."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from shadowhound_data_logger.core.config import UploadSettings, home, store_settings
from shadowhound_data_logger.core.errors import NameRefused, SettingError, StoreError
from shadowhound_data_logger.core.keys import check_name, is_name
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.times import age_in_ns

if TYPE_CHECKING:
    from shadowhound_data_logger.stores.base import ObjectStore

    _Number = click.ParamType[int]
else:
    _Number = click.ParamType  # older versions of click have no type arguments

PROGRAM: Final = 'shadowhound-data'
DAY_NS: Final = 86_400_000_000_000
_SIZE: Final = re.compile(r'(\d{1,15}(?:\.\d{1,9})?)\s*([kMGTP]?)(i?)B?', re.ASCII)


class ExitCode(IntEnum):
    """What every verb ends with; ``MEANINGS`` is the table of it, for the help and the docs."""

    FINE = 0
    FINDING = 1
    USAGE = 2
    INTERRUPTED = 130


MEANINGS: Final = {
    ExitCode.FINE: 'done, and nothing is wrong',
    ExitCode.FINDING: 'something is wrong, or could not be done',
    ExitCode.USAGE: 'wrong usage, setting or query',
    ExitCode.INTERRUPTED: 'interrupted with Ctrl-C',
}


def exit_code(*, finding: object) -> ExitCode:
    """Of a verb that did what it was asked: whether it found something wrong."""
    return ExitCode.FINDING if finding else ExitCode.FINE


def examples(*commands: str) -> str:
    """The end of a verb's help: command lines that follow the program's name."""
    return '\n'.join(('\b', 'Examples:', *(f'  {PROGRAM} {command}' for command in commands)))


class BadUsage(click.UsageError):
    """Something is wrong with how a verb was called; ``remedy`` says what to do instead of looking at its help."""

    def __init__(self, message: str, remedy: str = '') -> None:
        super().__init__(message)
        self.remedy = remedy


class Verb(NamedTuple):
    """A verb whose module is imported when the verb is called, or its help is needed."""

    name: str
    help: str = ''
    """The first line of its help, for the help of the program, which imports no verb."""
    module: str = ''
    """In this folder; by default that of its name."""
    attribute: str = ''

    def load(self) -> click.Command:
        module = import_module(f'{__package__}.{self.module or self.name}')
        command: click.Command = getattr(module, self.attribute or self.name)
        return command


class LazyCommands(MutableMapping[str, click.Command]):
    """The commands of a group: of some only the names are known until they are looked up."""

    def __init__(self, verbs: Iterable[Verb]) -> None:
        self._found: dict[str, click.Command | Verb] = {verb.name: verb for verb in verbs}

    def __getitem__(self, name: str) -> click.Command:
        found = self._found[name]
        if isinstance(found, Verb):
            found = self._found[name] = found.load()
        return found

    def __setitem__(self, name: str, command: click.Command) -> None:
        self._found[name] = command

    def __delitem__(self, name: str) -> None:
        del self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __contains__(self, name: object) -> bool:
        return name in self._found


class Size(_Number):
    """Bytes, as ``2TB``, ``500 GB`` or ``8GiB``."""

    name = 'size'

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        match = _SIZE.fullmatch(value.strip())
        if match is None:
            self.fail(f'{value!r} is not a size such as 500GB, 2TB or 8GiB', param, ctx)
        return int(float(match[1]) * (1024 if match[3] else 1000) ** ' kMGTP'.index(match[2] or ' '))


class Age(_Number):
    """Nanoseconds, as ``30min``, ``2h`` or ``7d``."""

    name = 'age'

    def __init__(self, longest_ns: int | None = None) -> None:
        self._longest_ns = longest_ns

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        try:
            found = age_in_ns('', value)
        except SettingError:
            self.fail(f'{value!r} is not an age such as 30min, 2h or 7d', param, ctx)
        if self._longest_ns is not None and not 0 < found <= self._longest_ns:
            self.fail(f'{value!r} is not an age of at most {self._longest_ns // DAY_NS} days', param, ctx)
        return found


def robot_name(_: click.Context, __: click.Parameter, name: str | None) -> str | None:
    """What ``--robot`` names; raises BadParameter for what is not a name of a robot."""
    try:
        return None if name is None else check_name(name, 'the robot name')
    except NameRefused as error:
        raise BadUsage(error.what, error.remedy or error.DEFAULT_REMEDY) from error


as_json = click.option('--json', 'as_json', is_flag=True, help='Print JSON.')
spool_folder = click.option(
    '--spool', type=click.Path(path_type=Path, file_okay=False), help='The spool  [default: $SHADOWHOUND_HOME/spool]'
)


def the_robot(named: str | None, spool: Path | None = None, *, in_store: bool = False) -> str:
    """The robot that a verb is about.

    The named one, otherwise that of this machine (``local_robots``); with ``in_store`` otherwise the only one of the store.
    Raises BadUsage if there are several, or none.
    """
    from shadowhound_data_logger.spool.local_robot import local_robots  # noqa: PLC0415 - SQLite

    if named:
        return named
    found, where = local_robots(os.environ, the_spool(spool)), ''
    if not found and in_store:
        found, where = the_store_robots()
    if not found:
        what = f'no robot found: no node has run with the spool {the_spool(spool)}{where}'
        raise BadUsage(what, 'add --robot NAME, or set SHADOWHOUND_ROBOT; SHADOWHOUND_HOME is the folder of the spool')
    return only_robot(found)


def only_robot(found: Sequence[str]) -> str:
    """The only name, empty if there is none. Raises BadUsage if there are several."""
    if len(found) > 1:
        raise BadUsage(f'which robot? There are {", ".join(found)}', 'add --robot NAME, or set SHADOWHOUND_ROBOT')
    return found[0] if found else ''


def the_store_robots() -> tuple[list[str], str]:
    """Robots with data in the store, and why there are none."""
    with the_store(1) as store:
        try:
            found = [name for name in store.folders('sensor-data') if is_name(name)]
        except StoreError as error:
            return [], f', and {error}'
        return found, f', and there is no data in {store.describe()}'


def the_home() -> Path:
    """The folder of the spool and of what is being recorded."""
    return home(os.environ)


def the_spool(given: Path | None) -> Path:
    """The folder that ``--spool`` names, otherwise the one in the home."""
    return given or the_home() / 'spool'


def the_store_settings() -> StoreSettings:
    """Of the store that the environment names."""
    return store_settings(os.environ, the_home())


def store_hint() -> str:
    """A hint for empty answers: which folder was the store, if no server is set. It begins with a space, or is empty."""
    return '' if the_store_settings().endpoint_url else ' AWS_ENDPOINT_URL is not set, so this folder is the store.'


@contextmanager
def the_store(threads: int = UploadSettings().threads) -> Iterator[ObjectStore]:
    """The one that the environment names, asked by so many threads at a time."""
    from shadowhound_data_logger.stores import open_store  # noqa: PLC0415 - not every verb opens one

    store = open_store(the_store_settings(), UploadSettings(threads=threads))
    try:
        yield store
    finally:
        store.close()
