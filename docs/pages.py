"""``python -m docs.pages``: docs/parameters.md and docs/commands.md, generated from the code.

A test compares the pages with what this writes, and the environment variables with those that the code reads.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Final, NamedTuple

import click

from shadowhound_data_logger.cli.common import MEANINGS
from shadowhound_data_logger.cli.main import SECTIONS as VERBS
from shadowhound_data_logger.core.options import GIBI, GROUPS, MEBI, SensorSettings

DOCS: Final = Path(__file__).parent
HEAD: Final = """\
# Parameters

*Generated from the code by `make docs`: change `shadowhound_data_logger/core/options.py`, not this page.*

None is required. Set them in a parameter file (`--ros-args --params-file my.yaml`) or one by one
(`--ros-args -p camera.rate_hz:=5.0`). `shadowhound-data init` writes a file for your robot;
[generic.yaml](../launch_configs/generic.yaml) is one for any robot, [go2.yaml](../launch_configs/go2.yaml) has all
defaults for a Unitree Go2. With an unknown name or an invalid value the node exits with code 2.

Defaults are in parentheses after the name, what is allowed at the end. **Live** parameters can be changed while the node runs:

    shadowhound-data node set camera.rate_hz 5.0              # on the robot
    ros2 param set /sensor_logger_node camera.rate_hz 5.0     # with ROS, from anywhere
    shadowhound-data node params                              # the present values

## What most people set
Where the data is sent is in the [environment](#environment-variables).

```yaml
"""
EXAMPLE: Final = """\
/**:
  ros__parameters:
    robot: tachi
    camera: {rate_hz: 5.0}            # images per second; 0.0 stores all of them
    lidar: {enabled: false}           # do not log point clouds
    spool: {max_bytes: 100000000000}  # disk space for what is not delivered yet: 100 GB
    upload: {max_mbps: 20.0}          # leave bandwidth to others
    bag: {record: mission}            # a bag of each mission, at full rate
    events: {topics: [imu, odom]}     # keep the last 30 s, for an event
"""
COMMANDS: Final = """\
# Commands

*Generated from the code by `make docs`: change `shadowhound_data_logger/cli/`, not this page.*

`shadowhound-data VERB --help` has all options of a verb, with examples. Most verbs print JSON with `--json`.
Times are UTC: `yesterday`, `2h`, `2025-10-18`, `2025-10-18T12:30`.

An error has the verb, what is wrong, and what to do; with `--json` as a line on standard error, and nothing on standard output:

    {"error": "there is no sensor 'camra'", "remedy": "is it 'camera'?", "verb": "shadowhound-data query", "exit_code": 2}

A name that is not in the store (robot, sensor, topic, mission, label, ...) is a usage error. An empty answer has exit code 0.

## Completion in the shell
The package installs it for bash. If your shell does not find it, put one of these lines into `~/.bashrc`; the second also
works in a virtual environment, and in other shells with `zsh_source` and `fish_source`:

    source $(ros2 pkg prefix shadowhound_data_logger)/share/bash-completion/completions/shadowhound-data
    eval "$(_SHADOWHOUND_DATA_COMPLETE=bash_source shadowhound-data)"

## Exit codes
The same for every verb; the node exits with 0, 1 or 2 in the same sense.

"""
READERS: Final = {
    'Operators': ('doctor', 'init', 'status', 'ledger', 'spool', 'node', 'live'),
    'Agent authors': ('missions',),
    'Researchers': ('query', 'search', 'fetch', 'pull', 'bag', 'label', 'export'),
    'Administrators': ('lake', 'policy'),
}
"""Who uses a verb."""
SENSOR: Final = 'SENSOR'
"""Stands for the name of any sensor."""


class Section(NamedTuple):
    """What a person wants to do, and the parameters for it, in the order in which most people need them."""

    title: str
    text: str
    names: Sequence[str]


SECTIONS: Final = (
    Section(
        'Choose what is logged',
        'SENSOR is the name of any sensor: `camera.rate_hz`. Without settings a Unitree Go2 has '
        '[these sensors](thor.md#what-is-stored-of-a-unitree-go2); any other robot is logged by the types of its topics.',
        (
            'robot',
            'capture.topics',
            'SENSOR.enabled',
            'SENSOR.rate_hz',
            'mission.capture',
            'sensors',
            'SENSOR.topics',
            'SENSOR.types',
            'SENSOR.on_change',
        ),
    ),
    Section(
        'Choose how it is stored',
        'Object formats and keys are in [formats](formats.md).',
        ('SENSOR.format', 'SENSOR.batch_s', 'SENSOR.quality', 'SENSOR.dedup'),
    ),
    Section(
        'Limit the disk',
        'Objects wait on the disk of the robot. When it is full, those of the lowest priority are deleted, the oldest first, '
        'and counted as `evicted`.',
        ('spool.max_bytes', 'spool.min_free_bytes', 'SENSOR.priority'),
    ),
    Section(
        'Keep data on the robot until it is requested',
        'How: [keep](keep.md).',
        ('SENSOR.ship', 'bag.ship', 'keep.max_bytes', 'keep.days', 'keep.thin_to_hz', 'keep.missions'),
    ),
    Section(
        'Limit uploads',
        'By bandwidth, or by a rule such as `battery_state:percentage > 0.3 and wifi.ssid == "lab"` '
        '([how](operation.md#upload-when-it-suits)).',
        ('upload.max_mbps', 'upload.when', 'events.when', 'keep.when'),
    ),
    Section(
        'Record bags',
        'At full rate, independent of what the sensors keep ([bags](bags.md)).',
        ('bag.record', 'bag.topics', 'bag.regex', 'bag.exclude'),
    ),
    Section(
        'Keep what led to an event',
        'In memory, for a bag at an event; off while no topic is named ([bags](bags.md#events)).',
        (
            'events.topics',
            'events.regex',
            'events.exclude',
            'events.pre_s',
            'events.post_s',
            'events.conditions',
            'events.log_event',
        ),
    ),
    Section(
        'Log missions',
        'What the node adds to the run of a mission ([missions](missions.md)).',
        ('mission.join', 'mission.frames', 'mission.frame_every_s', 'mission.battery', 'mission.temperature', 'mission.odometry'),
    ),
)
ADVANCED: Final = Section(
    'Advanced',
    'The defaults of these fit almost every robot.',
    (
        'capture.rmw',
        'queue.max_bytes',
        'SENSOR.key',
        'SENSOR.bucket',
        'SENSOR.statistics',
        'SENSOR.expected_hz',
        'SENSOR.counter',
        'clock.max_offset_s',
        'clock.hold_s',
        'spool.remember_days',
        'catalog.enabled',
        'catalog.period_s',
        'upload.threads',
        'upload.max_backoff_s',
        'upload.read_timeout_s',
        'shutdown.drain_s',
        'keep.preview_s',
        'keep.poll_s',
        'bag.slice_s',
        'bag.slice_bytes',
        'bag.compression',
        'bag.priority',
        'events.max_s',
        'events.max_bytes',
        'mission.period_s',
    ),
)
ENVIRONMENT: Final = """
## Environment variables
Secrets are read from the environment only: a ROS parameter is visible to everyone on the network.

"""
OTHERS: Final = """
Rarely needed:

"""
USUAL: Final = {
    'AWS_ENDPOINT_URL',
    'AWS_ACCESS_KEY_ID',
    'AWS_SECRET_ACCESS_KEY',
    'AWS_SHARED_CREDENTIALS_FILE',
    'MLFLOW_TRACKING_URI',
    'MLFLOW_TRACKING_USERNAME',
    'MLFLOW_TRACKING_PASSWORD',
    'SHADOWHOUND_HOME',
    'SHADOWHOUND_ROBOT',
    'SHADOWHOUND_PARAMETERS',
    'ROS_DOMAIN_ID',
    'RMW_IMPLEMENTATION',
}
"""Variables that most people set."""
VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ('AWS_ENDPOINT_URL', 'the folder `$SHADOWHOUND_HOME/store`', 'The S3 server, such as `http://SERVER:9000`.'),
    ('AWS_ENDPOINT_URL_S3', '', 'The same for S3 only; takes precedence.'),
    ('AWS_ACCESS_KEY_ID', '', 'Its access key.'),
    ('AWS_SECRET_ACCESS_KEY', '', 'Its secret key.'),
    ('AWS_SESSION_TOKEN', '', 'For temporary credentials.'),
    ('AWS_REGION', '`us-east-1`', 'The region of the signature; most self-hosted servers ignore it.'),
    ('AWS_DEFAULT_REGION', '', 'The same, if `AWS_REGION` is not set.'),
    ('SHADOWHOUND_HOME', '`~/.shadowhound`', 'Contains `spool/` and, without a server, `store/`.'),
    ('SHADOWHOUND_ROBOT', '', 'The name of the robot, if the parameter `robot` is empty.'),
)
"""Name, default, meaning of each variable that config.py reads for the node and the command line."""
OTHER_VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ('SHADOWHOUND_PARAMETERS', '', 'The parameter file, for the systemd unit and the doctor, not the node.'),
    ('SHADOWHOUND_POLICY', '', 'The registered model that `policy sync` and `policy run` follow.'),
    ('SHADOWHOUND_POLICY_KEYS', '`policy-keys` in SHADOWHOUND_HOME', 'The folder with the keys that sign policies.'),
    (
        'SHADOWHOUND_KEY_PASSPHRASE',
        '',
        'The passphrase of keys of `policy keys --encrypt`; otherwise prompted for.',
    ),
    (
        'SHADOWHOUND_POLICY_ISOLATION',
        '`sandbox`',
        'The weakest isolation of a smoke run ([policies](policies.md#the-smoke-runs-sandbox)).',
    ),
    ('SHADOWHOUND_ALERT_URL', '', 'Where the live page sends [alerts](live.md#alerts).'),
    ('SHADOWHOUND_LIVE_BIND', '`127.0.0.1`', 'Where the live page listens; read by its systemd unit.'),
    (
        'SHADOWHOUND_PORT_GUARD',
        '`on`',
        'With `off`, ports of killed listeners are not repaired ([why](reliability.md#limits)).',
    ),
    (
        'SHADOWHOUND_TYPE_SUPPORT',
        '`on`',
        'With `off`, topics need their message package ([why](decisions/0027-type-supports-from-definitions.md)).',
    ),
    (
        'AWS_SHARED_CREDENTIALS_FILE',
        '`~/.aws/credentials`',
        'The keys, if the two variables are not set; read again when the server rejects them ([how](thor.md#rotate-keys)).',
    ),
    ('AWS_PROFILE', '`default`', 'The section of that file.'),
    ('HTTP_PROXY', '', 'The proxy for `http://` servers; `HTTPS_PROXY` for `https://`. `ALL_PROXY` is ignored.'),
    ('NO_PROXY', '', 'Hosts without a proxy: names, ends of names, `host:port`, `*`; networks such as `10.0.0.0/8` are ignored.'),
    ('AWS_CA_BUNDLE', "the system's", 'Certificate of your authority, for the S3 server ([TLS](thor.md#tls)).'),
    ('REQUESTS_CA_BUNDLE', '', 'The same, for the S3 server and MLflow.'),
    (
        'MLFLOW_TRACKING_URI',
        'SQLite in `$SHADOWHOUND_HOME`',
        'The MLflow server, such as `http://SERVER:5001` ([missions](missions.md)).',
    ),
    ('MLFLOW_TRACKING_USERNAME', '', 'The user name for it; otherwise from `~/.mlflow/credentials`.'),
    ('MLFLOW_TRACKING_PASSWORD', '', 'The password.'),
    ('MLFLOW_TRACKING_SERVER_CERT_PATH', '', 'Certificate of your authority, for MLflow.'),
    ('MLFLOW_S3_ENDPOINT_URL', '`AWS_ENDPOINT_URL`', 'The S3 server of artifacts, if MLflow does not proxy them.'),
    ('ROS_DOMAIN_ID', '`0`', "That of the robot's driver."),
    ('RMW_IMPLEMENTATION', 'that of ROS', "The robot's middleware ([how](thor.md#4-middleware))."),
    ('FASTRTPS_DEFAULT_PROFILES_FILE', '', 'The profile of Fast DDS 2 (Humble, Jazzy).'),
    ('FASTDDS_DEFAULT_PROFILES_FILE', '', 'The profile of Fast DDS 3 (Kilted).'),
    ('CYCLONEDDS_URI', '', 'Interfaces, peers and buffers of Cyclone DDS.'),
)
"""Those that libraries and the systemd units read."""


@click.command()
@click.option('--write', is_flag=True, help='Write them below docs/ rather than print them.')
def main(*, write: bool) -> None:
    """Make the pages on parameters, environment variables and commands."""
    for name, page in (('parameters.md', parameters()), ('commands.md', commands())):
        if write:
            (DOCS / name).write_text(page, encoding='utf-8')
        else:
            click.echo(page, nl=False)


def commands() -> str:
    """The page on the verbs, as Markdown."""
    verbs = {verb.name: verb for section in VERBS.values() for verb in section}
    parts = [COMMANDS, _row('code', 'meaning'), '|---|---|\n']
    parts += [_row(f'`{code.value}`', meaning) for code, meaning in MEANINGS.items()]
    for title, names in READERS.items():
        parts.append(f'\n## {title}\n')
        for name in names:
            parts += _verb(name, verbs[name].load())
    return ''.join(parts)


def _verb(name: str, verb: click.Command) -> Iterator[str]:
    """The section of a verb: a line for each verb below it, or an example."""
    yield f'\n### {name}\n{verb.get_short_help_str(1000)}\n\n'
    if isinstance(verb, click.Group):
        yield from _rows((name,), verb)
    else:
        yield from (f'    {line}\n' for line in _examples(verb)[:1] if line != f'shadowhound-data {name}')


def _rows(path: tuple[str, ...], group: click.Group) -> Iterator[str]:
    for name, verb in group.commands.items():
        at = (*path, name)
        if isinstance(verb, click.Group):
            yield from _rows(at, verb)
        else:
            yield f'- `{" ".join(at)}`: {verb.get_short_help_str(1000)}\n'


def _examples(verb: click.Command) -> list[str]:
    return [line.strip() for line in (verb.epilog or '').splitlines()[2:]]


def parameters() -> str:
    """The page on parameters and environment variables, as Markdown."""
    parts = [HEAD, EXAMPLE, '```\n']
    described = _described()
    for section in (*SECTIONS, ADVANCED):
        parts += [f'\n## {section.title}\n', f'{section.text}\n\n', *(described[name] for name in section.names)]
        if section is SECTIONS[-1]:
            parts += [ENVIRONMENT, *_variables(usual=True)]
    return ''.join((*parts, OTHERS, *_variables(usual=False)))


def _variables(*, usual: bool) -> Iterator[str]:
    for name, default, text in (*VARIABLES, *OTHER_VARIABLES):
        if (name in USUAL) == usual:
            yield _item(name, default, text)


def _item(name: str, default: str, text: str) -> str:
    return f'- `{name}`{f" ({default})" if default else ""}: {text}\n'


def _described() -> dict[str, str]:
    """The line of each parameter."""
    rows = {
        'robot': _item(
            'robot',
            '',
            "The first part of every key. If empty: `SHADOWHOUND_ROBOT`, otherwise the node's namespace, otherwise `thor` if the "
            'messages of a Go2 are installed, otherwise the host name.',
        ),
        'sensors': _item(
            'sensors',
            'those of a Go2',
            'The sensors to log, instead of the default ones. Other names also need `topics` ([how](extending.md#add-a-sensor)).',
        ),
    }
    for prefix, kind in ((SENSOR, SensorSettings), *GROUPS.items()):
        for spec in fields(kind):
            if spec.metadata:
                name, notes = f'{prefix}.{spec.name}', [*_allowed(spec), *(['**live**'] if spec.metadata['live'] else [])]
                rows[name] = _item(name, _shown(_default(spec)), ' '.join((spec.metadata['help'], *notes)))
    return rows


def _default(spec: Field[Any]) -> Any:
    return () if spec.default is MISSING else spec.default


def _allowed(spec: Field[Any]) -> Iterator[str]:
    """The bounds of a value, as ``config`` checks them; lists, texts, true and false need no word."""
    low, high, choices = (spec.metadata[name] for name in ('low', 'high', 'choices'))
    if choices:
        yield f'({", ".join(f"`{choice}`" for choice in choices)})'
    elif low is not None:
        yield f'({_binary(low)[2:] or _figure(low)} or more)' if high is None else f'({_figure(low)} to {_figure(high)})'


def _shown(value: Any) -> str:
    """A value in the syntax of a parameter file; nothing for an empty one."""
    if value == '':
        return ''
    if isinstance(value, bool):
        return f'`{str(value).lower()}`'
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ', '.join(filter(None, map(_shown, value)))
    return f'`{value}`' + _binary(value)


def _binary(value: Any) -> str:
    """Bytes that are a power of two as people read them."""
    for unit, size in (('GiB', GIBI), ('MiB', MEBI)):
        if isinstance(value, int) and value >= size and value % size == 0:
            return f', {value // size} {unit}'
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
