"""The flags of ``query`` and ``fetch`` that select objects, and the library behind them, which a robot does not have."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, exit_code
from shadowhound_data_logger.cli.output import number
from shadowhound_data_logger.core.errors import LakeError, SettingError, UnknownName
from shadowhound_data_logger.core.stamps import BY_STAMP, CLOCKS
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, from_json

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.findings import Findings

EXTRA: Final = {'deltalake', 'matplotlib', 'obstore', 'pyarrow'}
ranges_option = click.option(
    '--ranges',
    type=click.File('rb'),
    metavar='FILE.json',
    callback=lambda _, __, file: _ranges(file),
    help='Only in these times: the answer of `query --when ... --json`; - is stdin.',
)
by_option = click.option(
    '--by', type=click.Choice(CLOCKS), default=BY_STAMP, show_default=True,
    help='Which time of a message counts: when it was measured, or when it arrived.',
)  # fmt: skip
FLAGS: Final = {
    'robot': click.option('--robot', metavar='NAME', help='Only of this robot.'),
    'sensor': click.option('--sensor', metavar='NAME', help='Only of this sensor.'),
    'topic': click.option('--topic', metavar='NAME', help='Only of this topic.'),
    'since': click.option('--since', metavar='TIME', help='From TIME on: yesterday, 2h, 2026-11-20, 2026-11-20T12:30 (UTC).'),
    'until': click.option('--until', metavar='TIME', help='Before TIME.'),
    'near': click.option('--near', metavar='X,Y,R', help='Within R meters of X,Y in the frame of the pose.'),
    'near_gps': click.option('--near-gps', metavar='LAT,LON,R', help='Within R meters of this latitude and longitude.'),
    'mission': click.option('--mission', metavar='ID', help='Only of missions whose id, or whose run id, begins with ID.'),
    'mission_type': click.option('--mission-type', metavar='TYPE', help='Only of missions of this type.'),
    'failed': click.option(
        '--failed', 'success', flag_value=False, type=bool, default=None, help='Only of missions that failed.'
    ),
    'succeeded': click.option(
        '--succeeded', 'success', flag_value=True, type=bool, default=None, help='Only of missions that succeeded.'
    ),
    'policy': click.option('--policy', metavar='NAME[@7]', help='Only of missions in which this policy was active.'),
    'where': click.option('--where', metavar='SQL', help="SQL over the columns, such as 'battery_pct < 30'."),
    'label': click.option('--label', metavar='NAME', help='Only with this label.'),
    'ranges': ranges_option,
}
_RANGES: Final = 'it is what `query --when ... --json` prints'
NAMES: Final = (
    'robot',
    'sensor',
    'topic',
    'since',
    'until',
    'near',
    'near_gps',
    'mission',
    'mission_type',
    'success',
    'policy',
    'where',
    'label',
    'ranges',
)
_Command = TypeVar('_Command', bound=Callable[..., Any])


def question(command: _Command) -> _Command:
    """Adds the flags; their values come as one mapping ``flags`` of those that were given."""

    @functools.wraps(command)
    def asked(**given: Any) -> Any:
        flags = {name: given.pop(name) for name in NAMES}
        return command(flags={name: value for name, value in flags.items() if value is not None}, **given)

    for flag in reversed(FLAGS.values()):
        asked = flag(asked)
    return asked  # type: ignore[return-value]


def by_flag(command: _Command) -> _Command:
    """Adds ``--by`` to the flags."""

    @functools.wraps(command)
    def asked(*, by: str, flags: Mapping[str, Any], **given: Any) -> Any:
        return command(flags=flags if by == BY_STAMP else {**flags, 'by': by}, **given)

    return by_option(asked)  # type: ignore[return-value]


def _ranges(file: Any) -> list[Any] | None:
    """Those of an answer: its list, or all of it."""
    if file is None:
        return None
    try:
        document = from_json(file.read(MAX_DOCUMENT_BYTES + 1))
    except ValueError as error:
        raise BadUsage(f'--ranges {file.name}: {error}', _RANGES) from error
    found = document.get('ranges') if isinstance(document, dict) else document
    if not isinstance(found, list):
        raise BadUsage(f'--ranges {file.name} is not a list of times', _RANGES)
    return found


def question_text(flags: Mapping[str, Any]) -> str:
    """The query, as the title of a picture."""
    values = {**flags, 'success': {True: 'succeeded', False: 'failed'}.get(flags.get('success'), '')}  # type: ignore[arg-type]
    return ', '.join(
        str(values[name]) if name in {'sensor', 'success'} else f'{name} {values[name]}'
        for name in NAMES
        if name != 'ranges' and values.get(name)
    )


@contextmanager
def asking() -> Iterator[None]:
    """An invalid query is bad usage, and so is a machine without the library."""
    try:
        yield
    except (LakeError, SettingError, UnknownName) as error:
        raise BadUsage(error.what, error.remedy or error.DEFAULT_REMEDY) from error
    except ModuleNotFoundError as error:
        if error.name not in EXTRA:
            raise
        raise BadUsage(f'{error.name} is not installed', "pip install 'shadowhound_data_logger[lake]'") from error


def quietly() -> Findings:
    """Skipped files, to be reported at the end."""
    from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415

    return Findings(lambda _: None)


def report_skipped(left_out: Findings) -> ExitCode:
    """Each on standard error; the exit code."""
    for one in left_out:
        click.echo(str(one), err=True)
    if len(left_out):
        text = (
            f'{number(len(left_out))} files of the catalog are skipped. Move them away, and run `shadowhound-data lake reindex`.'
        )
        click.echo(text, err=True)
    return exit_code(finding=len(left_out))
