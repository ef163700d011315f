"""``python -m shadowhound_data_logger.cli.parameters``: docs/parameters.md, made from the settings themselves.

The page cannot drift: a test compares it with what this prints, and the environment variables with those that are read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Final

import click

from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.options import DEFAULT_SENSORS, GIBI, GROUPS, MEBI, SensorSettings

PAGE: Final = Path(__file__).parents[2] / 'docs' / 'parameters.md'
COLUMNS: Final = ('parameter', 'default', 'allowed', 'live', '')
HEAD: Final = """\
# Parameters

*Made from the code by `make docs`: change `shadowhound_data_logger/options.py`, not this page.*

They are set in a parameter file (`--ros-args --params-file my.yaml`; [go2.yaml](../launch_configs/go2.yaml) has all of them with
their defaults: copy it and delete what you do not change) or one by one (`--ros-args -p camera.rate_hz:=5.0`). An unknown name
or a value that is not allowed stops the start with exit code 2 and a message that says what is.

**Live** ones can be changed while the node runs, and the others only at its start; a value that is not allowed changes nothing:

    shadowhound-data node set camera.rate_hz 5.0              # on the robot
    ros2 param set /sensor_logger_node camera.rate_hz 5.0     # with ROS, from anywhere

`shadowhound-data node params` lists them as they are.

## Whose data, and which
| parameter | default | allowed | |
|---|---|---|---|
| `robot` | | a name | Leads every key; where empty, `SHADOWHOUND_ROBOT`, else the node's namespace, else `thor`. |
| `sensors` | all those below | names | The sensors there are. A name that is not among those below needs its `topics` at least. |
"""
SENSORS: Final = """
## A sensor
Each name in `sensors` has all of these, `camera.rate_hz` for one. Where a sensor's own default differs, the next table has it.

"""
OWN: Final = """
## The sensors' own defaults
"""
ENVIRONMENT: Final = """
## Environment variables
Secrets are read from the environment alone: whatever is a ROS parameter can be seen by everybody on the network.

| variable | default | |
|---|---|---|
"""
VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ('AWS_ENDPOINT_URL', 'a folder, `$SHADOWHOUND_HOME/store`', 'The S3 server, such as `http://TOWER_IP:9000`.'),
    ('AWS_ACCESS_KEY_ID', '', 'Its access key.'),
    ('AWS_SECRET_ACCESS_KEY', '', 'Its secret key.'),
    ('AWS_SESSION_TOKEN', '', 'Where the credentials are temporary.'),
    ('AWS_REGION', '`us-east-1`', 'The region that requests are signed for; most servers of your own ignore it.'),
    ('AWS_DEFAULT_REGION', '', 'The same, where `AWS_REGION` is not set.'),
    ('SHADOWHOUND_HOME', '`~/.shadowhound`', 'Holds `spool/` and, without a server, `store/`.'),
    ('SHADOWHOUND_ROBOT', '', 'The name of the robot, where the parameter `robot` is empty.'),
)
"""Name, default, meaning of each variable that the node and the command line read."""


@click.command()
@click.option('--write', is_flag=True, help='Write docs/parameters.md rather than print it.')
def main(*, write: bool) -> None:
    """Print the page that tells every parameter and environment variable."""
    if write:
        PAGE.write_text(page(), encoding='utf-8')
    else:
        click.echo(page(), nl=False)


def page() -> str:
    """The whole page, as Markdown."""
    parts = [HEAD, SENSORS, *_table(SensorSettings, '*sensor*'), OWN, *_sensors()]
    for name, kind in GROUPS.items():
        summary = re.sub(r' \(D[^)]*\)', '', (kind.__doc__ or '').partition('\n')[0])
        parts += [f'\n## {name}\n{summary}\n\n', *_table(kind, name)]
    parts += [ENVIRONMENT, *(_row(f'`{name}`', default, text) for name, default, text in VARIABLES)]
    return ''.join(parts)


def _table(kind: type, prefix: str) -> Iterator[str]:
    """A row for each setting of a class."""
    yield _row(*COLUMNS)
    yield '|---' * len(COLUMNS) + '|\n'
    for spec in fields(kind):
        if spec.metadata:
            name = f'{prefix}.`{spec.name}`' if prefix.startswith('*') else f'`{prefix}.{spec.name}`'
            live = 'yes' if spec.metadata['live'] else ''
            yield _row(name, _shown(_default(spec)), _allowed(spec), live, spec.metadata['help'])


def _sensors() -> Iterator[str]:
    """A row for each sensor that is there without any setting, with all in which it differs."""
    yield _row('sensor', 'topics', 'otherwise than above')
    yield '|---|---|---|\n'
    for sensor in Settings.load({}, {}).sensors:
        own = DEFAULT_SENSORS[sensor.name]
        listed = (f'`{name}`: {_shown(value)}' for name, value in own.items() if name not in {'topics', 'types'})
        topics = (f'`{topic}` ({kind})' for topic, kind in zip(sensor.topics, sensor.types, strict=True))
        yield _row(f'`{sensor.name}`', '<br>'.join(topics), '<br>'.join(listed))


def _default(spec: Field[Any]) -> Any:
    return () if spec.default is MISSING else spec.default


def _allowed(spec: Field[Any]) -> str:
    """The bounds of a value, as ``config`` checks them."""
    low, high, choices = (spec.metadata[name] for name in ('low', 'high', 'choices'))
    default = _default(spec)
    if choices:
        return ', '.join(f'`{choice}`' for choice in choices)
    if isinstance(default, bool):
        return '`true`, `false`'
    if isinstance(default, tuple):
        return 'a list of strings'
    if low is None:
        return 'text'
    return f'at least {_figure(low)}{_binary(low)}' if high is None else f'{_figure(low)} to {_figure(high)}'


def _shown(value: Any) -> str:
    """A value as it is written in a parameter file."""
    if isinstance(value, bool):
        return f'`{str(value).lower()}`'
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ', '.join(_shown(part) for part in value)
    return f'`{value}`' + _binary(value)


def _binary(value: Any) -> str:
    """Bytes that are a power of two as people read them."""
    for unit, size in (('GiB', GIBI), ('MiB', MEBI)):
        if isinstance(value, int) and value >= size and value % size == 0:
            return f' ({value // size} {unit})'
    return ''


def _figure(value: float) -> str:
    return f'{value:,.0f}' if value == int(value) else f'{value:g}'


def _row(*cells: str) -> str:
    return '| ' + ' | '.join(_cell(cells)) + ' |\n'


def _cell(cells: Iterable[str]) -> Iterator[str]:
    for cell in cells:
        yield cell.replace('|', '\\|')


if __name__ == '__main__':
    main()
