"""``python -m shadowhound_data_logger.cli.pages``: docs/parameters.md and docs/commands.md, made from the code.

The pages cannot drift: a test compares them with what this writes, and the environment variables with those that are read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Final, NamedTuple

import click

from shadowhound_data_logger.cli.common import MEANINGS
from shadowhound_data_logger.cli.main import SECTIONS as VERBS
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.options import DEFAULT_SENSORS, GIBI, GROUPS, MEBI, SensorSettings

DOCS: Final = Path(__file__).parents[2] / 'docs'
COLUMNS: Final = ('parameter', 'default', 'allowed', 'live', '')
HEAD: Final = """\
# Parameters

*Made from the code by `make docs`: change `shadowhound_data_logger/core/options.py`, not this page.*

The node runs without any of them. Set them in a parameter file (`--ros-args --params-file my.yaml`;
[go2.yaml](../launch_configs/go2.yaml) has all of them with their defaults: copy it and delete what you do not change) or one by
one (`--ros-args -p camera.rate_hz:=5.0`). An unknown name or a value that is not allowed stops the start with exit code 2, and
the message says what is allowed.

**Live** parameters can be changed while the node runs, the others only at its start; a value that is not allowed changes nothing:

    shadowhound-data node set camera.rate_hz 5.0              # on the robot
    ros2 param set /sensor_logger_node camera.rate_hz 5.0     # with ROS, from anywhere

`shadowhound-data node params` lists their present values.

## What most people set
A whole parameter file; where the data goes is in the [environment](#environment-variables).

```yaml
"""
EXAMPLE: Final = """\
/**:
  ros__parameters:
    robot: tachi
    camera: {rate_hz: 5.0}            # pictures a second; 0.0 stores every one
    lidar: {enabled: false}           # do not log the clouds
    spool: {max_bytes: 100000000000}  # disk for what is not delivered yet: 100 GB
    upload: {max_mbps: 20.0}          # leave the WiFi to others
    bag: {record: mission}            # a bag of each mission, at full rate
    events: {topics: [imu, odom]}     # keep the last 30 s, for an event
"""
COMMANDS: Final = """\
# Commands

*Made from the code by `make docs`: change `shadowhound_data_logger/cli/`, not this page.*

`shadowhound-data VERB --help` describes each verb with all of its options; each prints JSON with `--json`. Times
are UTC, and all of them are written alike: `yesterday`, `2h`, `2025-10-18`, `2025-10-18T12:30`.

An error names the verb, what is wrong and where, and on the next line what to do:

    shadowhound-data bag info: there is no bag patrol of thor in the folder /home/hound/.shadowhound/store
      -> the store has no bag of thor; --robot names another robot

With `--json` (and `--format json`) an error is JSON as well: one line on standard error, and nothing on standard output.

    {"error": "there is no sensor 'camra'", "remedy": "is it 'camera'?", "verb": "shadowhound-data query", "exit_code": 2}

Names that nothing in the store has (robot, sensor, topic, field, mission, mission type, policy, label, bag) are wrong usage. If
all names exist and nothing matches, the answer is empty and the exit code 0, in every format: `--format keys` prints nothing.
What a terminal's encoding does not have is printed as its escape (`\\u5de1`).

## Exit codes
Of every verb; the node ends with 0, 1 or 2 in the same sense.

"""
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
        'SENSOR is the name of any sensor: `camera.rate_hz`. The sensors that there are without any '
        'setting are listed [below](#the-sensors).',
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
        'What an object is, and what it is called in the bucket ([formats](formats.md)).',
        ('SENSOR.format', 'SENSOR.batch_s', 'SENSOR.quality', 'SENSOR.dedup', 'SENSOR.key', 'SENSOR.bucket'),
    ),
    Section(
        'Limit the disk',
        'What waits for the store is on the disk of the robot. When that is full, the objects of the lowest '
        'priority are deleted, the oldest first, and the ledger counts them as `evicted`.',
        ('spool.max_bytes', 'spool.min_free_bytes', 'SENSOR.priority', 'spool.remember_days'),
    ),
    Section(
        'Keep on the robot, and upload what is requested',
        'What is `on_request` stays on the disk of the robot until it is requested ([keep](keep.md)).',
        (
            'SENSOR.ship',
            'bag.ship',
            'keep.max_bytes',
            'keep.days',
            'keep.thin_to_hz',
            'keep.missions',
            'keep.preview_s',
            'keep.poll_s',
        ),
    ),
    Section(
        'Upload fast, or leave the network to others',
        '',
        ('upload.max_mbps', 'upload.threads', 'upload.backoff_s', 'upload.read_timeout_s', 'shutdown.drain_s'),
    ),
    Section(
        'Upload when it suits',
        'Only while a rule holds, such as `lowstate:bms_state.soc > 30 and wifi.ssid == "lab"` '
        '([thor](thor.md#upload-when-it-suits)).',
        ('upload.when', 'events.when', 'keep.when'),
    ),
    Section(
        'Record bags',
        'At full rate, whatever the sensors keep ([bags](bags.md)).',
        (
            'bag.record',
            'bag.topics',
            'bag.regex',
            'bag.exclude',
            'bag.slice_s',
            'bag.slice_bytes',
            'bag.compression',
            'bag.priority',
        ),
    ),
    Section(
        'Keep what led to an event',
        'The last seconds of some topics are held in memory, and an event makes a bag of them; off '
        'while no topic is named ([bags](bags.md)).',
        (
            'events.topics',
            'events.regex',
            'events.exclude',
            'events.pre_s',
            'events.post_s',
            'events.conditions',
            'events.log_event',
            'events.max_s',
            'events.max_bytes',
        ),
    ),
    Section(
        'Log missions',
        'What the node adds to the run of a mission of its robot ([missions](missions.md)).',
        (
            'mission.join',
            'mission.frames',
            'mission.frame_every_s',
            'mission.battery',
            'mission.temperature',
            'mission.odometry',
            'mission.period_s',
        ),
    ),
    Section(
        'Find it later',
        'The catalog of what the store holds ([lake](lake.md)).',
        ('catalog.enabled', 'catalog.period_s', 'SENSOR.statistics'),
    ),
    Section(
        'Know what was lost',
        'Only where messages carry no numbers: without Fast DDS ([formats](formats.md)).',
        ('SENSOR.expected_hz', 'SENSOR.counter'),
    ),
    Section(
        'Clocks',
        'Which stamps are trusted ([formats.md](formats.md#which-stamps-are-trusted)), and what happens before the clock is set.',
        ('clock.max_offset_s', 'clock.hold_s'),
    ),
    Section('Fit the machine and its network', '', ('capture.rmw', 'queue.max_bytes')),
)
OWN: Final = """
## The sensors
Where the default of a sensor is not the one above.

"""
ENVIRONMENT: Final = """
## Environment variables
Secrets are read from the environment alone: whatever is a ROS parameter can be seen by everybody on the network.

| variable | default | |
|---|---|---|
"""
VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ('AWS_ENDPOINT_URL', 'a folder, `$SHADOWHOUND_HOME/store`', 'The S3 server, such as `http://TOWER_IP:9000`.'),
    ('AWS_ENDPOINT_URL_S3', '', 'The same, for S3 alone: it takes precedence, as in all AWS programs.'),
    ('AWS_ACCESS_KEY_ID', '', 'Its access key.'),
    ('AWS_SECRET_ACCESS_KEY', '', 'Its secret key.'),
    ('AWS_SESSION_TOKEN', '', 'Where the credentials are temporary.'),
    ('AWS_REGION', '`us-east-1`', 'The region that requests are signed for; most servers of your own ignore it.'),
    ('AWS_DEFAULT_REGION', '', 'The same, where `AWS_REGION` is not set.'),
    ('SHADOWHOUND_HOME', '`~/.shadowhound`', 'Holds `spool/` and, without a server, `store/`.'),
    ('SHADOWHOUND_ROBOT', '', 'The name of the robot, where the parameter `robot` is empty.'),
)
"""Name, default, meaning of each variable that config.py reads for the node and the command line."""
OTHER_VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ('SHADOWHOUND_PARAMETERS', '', 'The parameter file: read by the systemd unit and the doctor, not by the node itself.'),
    ('SHADOWHOUND_POLICY', '', 'The registered model that `policy sync` and `policy run` follow.'),
    ('SHADOWHOUND_POLICY_KEYS', '`policy-keys` in SHADOWHOUND_HOME', 'The folder of keys of who publishes policies.'),
    (
        'SHADOWHOUND_KEY_PASSPHRASE',
        '',
        'The passphrase of keys that `policy keys --encrypt` made; without it, the terminal is asked.',
    ),
    ('SHADOWHOUND_LIVE_BIND', '`127.0.0.1`', 'Where the live page listens: read by its systemd unit.'),
    (
        'AWS_SHARED_CREDENTIALS_FILE',
        '`~/.aws/credentials`',
        'The keys, where the two variables are not set; read again when the server refuses them ([how](thor.md#5-credentials)).',
    ),
    ('AWS_PROFILE', '`default`', 'The section of that file.'),
    ('HTTP_PROXY', '', 'The proxy for `http://` servers, as for `curl`; `HTTPS_PROXY` for `https://`. `ALL_PROXY` is ignored.'),
    ('NO_PROXY', '', 'Hosts without a proxy: names, ends of names, `host:port`, `*`; networks such as `10.0.0.0/8` are ignored.'),
    ('AWS_CA_BUNDLE', "the system's", 'Certificate of your own authority, for the S3 server ([TLS](thor.md#tls)).'),
    ('REQUESTS_CA_BUNDLE', '', 'The same, for the S3 server and MLflow.'),
    (
        'MLFLOW_TRACKING_URI',
        'SQLite in `$SHADOWHOUND_HOME`',
        'The MLflow server, such as `http://TOWER_IP:5001` ([missions](missions.md)).',
    ),
    ('MLFLOW_TRACKING_USERNAME', '', 'Who logs there; else `~/.mlflow/credentials` says it.'),
    ('MLFLOW_TRACKING_PASSWORD', '', 'And the password.'),
    ('MLFLOW_TRACKING_SERVER_CERT_PATH', '', 'Certificate of your own authority, for MLflow.'),
    ('MLFLOW_S3_ENDPOINT_URL', '`AWS_ENDPOINT_URL`', 'Where artifacts are, if the MLflow server does not proxy them.'),
    ('ROS_DOMAIN_ID', '`0`', "The robot driver's."),
    ('RMW_IMPLEMENTATION', 'that of ROS', "The robot's middleware ([thor.md](thor.md#4-middleware))."),
    ('FASTRTPS_DEFAULT_PROFILES_FILE', '', 'The profile of Fast DDS 2 (Humble, Jazzy). The live page omits `fastdds_shm.xml`.'),
    ('FASTDDS_DEFAULT_PROFILES_FILE', '', 'The same of Fast DDS 3 (Kilted).'),
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
    parts = [COMMANDS, _row('code', 'meaning'), '|---|---|\n']
    parts += [_row(f'`{code.value}`', meaning) for code, meaning in MEANINGS.items()]
    for title, verbs in VERBS.items():
        parts += [f'\n## {title}\n', _row('verb', '', 'for example'), '|---|---|---|\n']
        for verb in verbs:
            parts += _verbs((verb.name,), verb.load())
    return ''.join(parts)


def _verbs(path: tuple[str, ...], verb: click.Command) -> Iterator[str]:
    """A row of the verb, and of each verb of it."""
    lines = ((verb.epilog or '').splitlines())[2:]
    yield _row(f'`{" ".join(path)}`', verb.get_short_help_str(1000), '<br>'.join(f'`{line.strip()}`' for line in lines))
    if isinstance(verb, click.Group):
        for name, each in verb.commands.items():
            yield from _verbs((*path, name), each)


def parameters() -> str:
    """The page on parameters and environment variables, as Markdown."""
    parts = [HEAD, EXAMPLE, '```\n']
    described = _described()
    for section in SECTIONS:
        parts += [f'\n## {section.title}\n', f'{section.text}\n\n' if section.text else '', _row(*COLUMNS)]
        parts += ['|---' * len(COLUMNS) + '|\n', *(described[name] for name in section.names)]
    variables = (_row(f'`{name}`', default, text) for name, default, text in (*VARIABLES, *OTHER_VARIABLES))
    parts += [OWN, *_sensors(), ENVIRONMENT, *variables]
    return ''.join(parts)


def _described() -> dict[str, str]:
    """The row of each parameter."""
    rows = {
        'robot': _row(
            '`robot`',
            '',
            'a name',
            '',
            "Leads every key; where empty, `SHADOWHOUND_ROBOT`, else the node's namespace, else `thor`.",
        ),
        'sensors': _row(
            '`sensors`',
            'all those below',
            'names',
            '',
            'The sensors to log; this replaces the default. Other names also need `topics` ([how](extending.md#add-a-sensor)).',
        ),
    }
    for prefix, kind in ((SENSOR, SensorSettings), *GROUPS.items()):
        for spec in fields(kind):
            if spec.metadata:
                name, live = f'{prefix}.{spec.name}', 'yes' if spec.metadata['live'] else ''
                rows[name] = _row(f'`{name}`', _shown(_default(spec)), _allowed(spec), live, spec.metadata['help'])
    return rows


def _sensors() -> Iterator[str]:
    """A row for each sensor that is there without any setting, with all in which it differs."""
    yield _row('sensor', 'topics', 'defaults of its own')
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
