"""``shadowhound-data policy``: packs, signs and publishes policies; on the robot fetches, verifies, activates and rolls back."""

from __future__ import annotations

import logging
import os
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    robot_name,
    the_home,
    the_store,
)
from shadowhound_data_logger.cli.output import plain_table, print_json, print_page
from shadowhound_data_logger.errors import DataLoggerError, PolicyError, PolicyRefused
from shadowhound_data_logger.missions.active import MissionFinder
from shadowhound_data_logger.mlflow_rest import MlflowRest
from shadowhound_data_logger.options import GIBI
from shadowhound_data_logger.policies import packing, running, signing
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.registry import CANARY, CHAMPION, MlflowRegistry
from shadowhound_data_logger.policies.smoke import ISOLATIONS, SANDBOX, is_enough
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync, SyncResult

JITTER: Final = 0.2
"""Of the time between two looks: a fleet that was switched on together does not ask together."""
_Verb = TypeVar('_Verb', bound=Callable[..., Any])

_folder = click.Path(path_type=Path, file_okay=False, exists=True)
_file = click.Path(path_type=Path, dir_okay=False, exists=True)


@click.group(epilog=examples('policy publish packed --alias champion', 'policy sync --name go2_patrol'))
def policy() -> None:
    """Bring trained policies to robots, signed.

    MLflow's registry says which version runs (alias champion), the store has its bytes, and a signature says whether it may run.
    """


# -- on Spark ------------------------------------------------------------------------------------------------------------------


@policy.command(epilog=examples('policy keygen spark.key'))
@click.argument('path', type=click.Path(path_type=Path, dir_okay=False))
@as_json
def keygen(*, path: Path, as_json: bool) -> ExitCode:
    """Make a key that signs policies.

    It stays on the machine that publishes; PATH.pub goes to policies/keys in SHADOWHOUND_HOME of each robot.
    """
    name = signing.keygen(path)
    told = {'key': name, 'private': str(path), 'public': f'{path}.pub'}
    print_json(told) if as_json else click.echo(f'key {name}: {path} (keep it), {path}.pub (for robots)')
    return ExitCode.FINE


@policy.command(epilog=examples('policy pack outputs/go2_patrol --name go2_patrol --smoke sample.npz -o packed'))
@click.argument('folder', metavar='DIR', type=_folder)
@click.option('--name', required=True, help='Name of the registered model.')
@click.option('--version', type=click.IntRange(1), help="Its version  [default: the registry's next one]")
@click.option('--serial', type=click.IntRange(1), help='Robots take no new version with a lower one  [default: the version]')
@click.option('--smoke', type=_file, required=True, metavar='NPZ', help='An array for each input, for the smoke run.')
@click.option('--dataset', default='', metavar='DIGEST', help='Digest of the training set.')
@click.option('--run', 'run_id', default='', metavar='ID', help='MLflow run that trained it.')
@click.option('--robot-type', 'robot_types', multiple=True, default=('go2',), show_default=True, help='Robots it is for.')
@click.option('--fps', type=click.FloatRange(0.01, 1000.0), default=10.0, show_default=True, help='Steps a second.')
@click.option('--tolerance', type=click.FloatRange(0.0, min_open=True), default=1e-4, show_default=True,
              help="How much the sample's output may differ on a robot.")  # fmt: skip
@click.option('--p99-ms', type=click.FloatRange(0.0, min_open=True), default=100.0, show_default=True,
              help='The slowest p99 of a step that is allowed.')  # fmt: skip
@click.option('--failures', type=click.IntRange(0), default=3, show_default=True, help='Failed steps of 100 that are allowed.')
@click.option('-o', '--output', type=click.Path(path_type=Path), required=True, help='A new folder.')
@as_json
def pack(*, folder: Path, name: str, version: int | None, smoke: Path, output: Path, run_id: str, as_json: bool, **given: Any
         ) -> ExitCode:  # fmt: skip
    """Make a folder with a manifest of what a training wrote.

    DIR has model.onnx in one file, and beside it .json, .safetensors and .npy files. The model runs once, to note what the smoke
    run on a robot has to give.
    """
    number = version or 1 + max((each.version for each in _registry().versions(name)), default=0)
    manifest = packing.pack(folder, smoke, output, packing.Packing(name=name, version=number, run=run_id, **given))
    told = {'policy': manifest.id, 'folder': str(output), 'files': len(manifest.files), 'bytes': manifest.size}
    print_json(told) if as_json else click.echo(
        f'{manifest.id}: {len(manifest.files)} files, {manifest.size:,} bytes in {output}'
    )
    return ExitCode.FINE


@policy.command(epilog=examples('policy sign packed --key spark.key'))
@click.argument('packed', type=_folder)
@click.option('--key', type=_file, required=True, help='Private key of policy keygen.')
def sign(*, packed: Path, key: Path) -> ExitCode:
    """Sign what was packed."""
    click.echo(f'signed with the key {packing.sign(packed, key)}')
    return ExitCode.FINE


@policy.command(
    epilog=examples('policy publish packed --alias champion', 'policy publish packed --alias canary --robots thor,tachi')
)
@click.argument('packed', type=_folder)
@click.option('--alias', 'aliases', multiple=True, help=f'Such as {CHAMPION}, {CANARY} or robot-NAME; may be repeated.')
@click.option('--robots', default='', metavar='NAMES', help=f'The robots that take it as {CANARY}, with commas between.')
@as_json
def publish(*, packed: Path, aliases: tuple[str, ...], robots: str, as_json: bool) -> ExitCode:
    """Upload a signed policy and register it.

    May be repeated, also to give a version that is there another alias. Nothing is overwritten.
    """
    names = [robot.strip() for robot in robots.split(',') if robot.strip()]
    with the_store() as store:
        manifest = packing.publish(packed, store, _registry(), aliases, names)
    told = {'policy': manifest.id, 'aliases': list(aliases), 'robots': names}
    print_json(told) if as_json else click.echo(f'published {manifest.id}{" as " if aliases else ""}{", ".join(aliases)}')
    return ExitCode.FINE


@policy.command(epilog=examples('policy revoke 0123456789abcdef --key other.key'))
@click.argument('keys', nargs=-1, required=True)
@click.option('--key', type=_file, required=True, help='Private key that signs the list; none of those that it revokes.')
def revoke(*, keys: tuple[str, ...], key: Path) -> ExitCode:
    """Tell all robots that keys are revoked.

    A robot that runs a policy signed with one of them goes back to one that is not.
    """
    with the_store() as store:
        number = packing.revoke(key, keys, store)
    click.echo(f'list {number}: {", ".join(keys)}')
    return ExitCode.FINE


# -- on the robot --------------------------------------------------------------------------------------------------------------


_isolation = click.option(
    '--isolation', envvar='SHADOWHOUND_POLICY_ISOLATION', type=click.Choice(ISOLATIONS), default=SANDBOX, show_default=True,
    help='The least that a smoke run has to be in; limits: it may run with the rights of this user.',
)  # fmt: skip


def _follows(verb: _Verb) -> _Verb:
    """The options of what a robot follows."""
    for option in reversed((
        click.option('--name', envvar='SHADOWHOUND_POLICY', required=True, help='Registered model  [$SHADOWHOUND_POLICY]'),
        click.option('--robot', envvar='SHADOWHOUND_ROBOT', default='thor', callback=robot_name, show_default=True),
        click.option('--robot-type', default='go2', show_default=True, help='What the manifest has to be for.'),
        click.option('--max-mbps', type=click.FloatRange(0.0, 1e5), default=0.0, show_default=True,
                     help='Most megabits a second to download; 0: no limit.'),
        click.option('--max-gib', type=click.FloatRange(0.001), default=8.0, show_default=True, help='Most disk for policies.'),
        click.option('--min-free-gib', type=click.FloatRange(0.0), default=2.0, show_default=True, help='Disk to leave free.'),
        click.option('--keep', type=click.IntRange(2), default=3, show_default=True, help='Versions to keep on the disk.'),
        _isolation,
        click.option('--now', is_flag=True, help='Activate also while a mission is active.'),
    )):  # fmt: skip
        verb = option(verb)
    return verb


@policy.command(epilog=examples('policy sync --name go2_patrol'))
@_follows
@as_json
def sync(*, as_json: bool, **given: Any) -> ExitCode:
    """Take what the registry says, once."""
    with _syncing(given) as one:
        result = one.run()
    print_json(_told(result)) if as_json else click.echo(_sentence(result))
    return ExitCode.FINE


@policy.command(epilog=examples('policy run --name go2_patrol --max-mbps 20'))
@click.option('--every', type=click.FloatRange(0.1, 86_400.0), default=30.0, show_default=True, help='Seconds between two looks.')
@_follows
def run(*, every: float, **given: Any) -> ExitCode:
    """Follow the registry until interrupted.

    A Tower that is away changes nothing: what is active goes on. Where there is ROS, the node shadowhound_policy publishes the
    active version as ~/policy (std_msgs/String, latched), and takes word of its health on ~/health.
    """
    logging.basicConfig(level=logging.INFO, format='%(message)s')
    for number in (signal.SIGINT, signal.SIGTERM):  # also in the middle of a download: whatever is cut off is done again
        signal.signal(number, signal.default_int_handler)
    said = ''
    with suppress(KeyboardInterrupt), _syncing(given) as one, _telling():
        while True:
            try:
                text = _sentence(one.run(again=False))
            except (DataLoggerError, OSError) as error:
                text = f'{error}'
            if text != said:
                print(text, file=sys.stderr, flush=True)
                said = text
            time.sleep(every * random.uniform(1.0 - JITTER, 1.0 + JITTER))
    return ExitCode.FINE


@policy.command(name='list', epilog=examples('policy list', 'policy list --json'))
@as_json
def list_(*, as_json: bool) -> ExitCode:
    """List the versions on this robot."""
    folder = _policies()
    state, now = folder.state(), folder.current()
    rows = [{'policy': name, 'active': name == now, 'pinned': name == state.pin, 'why_not': state.bad.get(name, ''),
             'isolation': state.verified.get(name)}
            for name in folder.installed()]  # fmt: skip
    if as_json:
        print_json(rows)
    else:
        table = plain_table('', ('policy', '', 'tried in', 'why not'), ('policy', '', 'tried in', 'why not'))
        for row in rows:
            marks = [word for word in ('active', 'pinned') if row[word]]
            table.add_row(str(row['policy']), ' '.join(marks), str(row['isolation'] or '-'), str(row['why_not']))
        print_page(table)
    return ExitCode.FINE


@policy.command(epilog=examples('policy show', 'policy show go2_patrol@7'))
@click.argument('name', required=False)
@as_json
def show(*, name: str | None, as_json: bool) -> ExitCode:
    """Describe and verify the active version, or NAME@7."""
    folder = _policies()
    found = folder.find(name) if name else folder.current()
    if found is None:
        raise PolicyError('no policy is active')
    try:
        manifest, why = folder.check(found, folder.state()), ''
    except PolicyRefused as error:
        manifest, why = None, f'{error.reason}: {error.what}'
    told = {'policy': found, 'active': found == folder.current(), 'path': str(folder.versions / found), 'refused': why,
            'isolation': folder.state().verified.get(found)}  # fmt: skip
    if manifest is not None:
        told |= {'serial': manifest.serial, 'robot_types': list(manifest.robot_types), 'fps': manifest.fps,
                 'inputs': [spec.name for spec in manifest.inputs], 'outputs': [spec.name for spec in manifest.outputs],
                 'dataset': manifest.dataset, 'run': manifest.run, 'p99_ms': manifest.p99_ms, 'bytes': manifest.size}  # fmt: skip
    if as_json:
        print_json(told)
    else:
        for key, value in told.items():
            if value == '':
                continue
            click.echo(f'{key}: {", ".join(value) if isinstance(value, list) else value}')
    return ExitCode.FINDING if why else ExitCode.FINE


@policy.command(epilog=examples('policy use go2_patrol@7'))
@click.argument('name')
@click.option('--now', is_flag=True, help='Also while a mission is active.')
@_isolation
def use(*, name: str, now: bool, isolation: str) -> ExitCode:
    """Activate a version that is on this robot, and pin it."""
    folder = _policies()
    found = folder.find(name)
    tried = folder.state().verified.get(found, 'no isolation that is known')
    if not is_enough(tried, isolation):
        raise PolicyError(f'the smoke run of {found} was in {tried}, required is {isolation}',
                          remedy='policy sync tries it again; or allow less: --isolation limits')  # fmt: skip
    if not now and not _no_mission()():
        raise PolicyError('a mission is active', remedy='wait for its end, or add --now')
    folder.use(found)
    click.echo(f'{found} is active and pinned')
    return ExitCode.FINE


@policy.command(epilog=examples('policy rollback'))
def rollback() -> ExitCode:
    """Go back to the last good version, at once.

    What was active is not taken again, unless policy use brings it back.
    """
    click.echo(f'active: {_policies().roll_back() or "none"}')
    return ExitCode.FINE


@policy.command(epilog=examples('policy pin'))
def pin() -> ExitCode:
    """Stay with the active version, whatever the registry says."""
    click.echo(f'pinned: {_policies().pin()}')
    return ExitCode.FINE


@policy.command(epilog=examples('policy unpin'))
def unpin() -> ExitCode:
    """Follow the registry again."""
    _policies().unpin()
    click.echo('follows the registry again')
    return ExitCode.FINE


@policy.command(epilog=examples('policy report --failures 4', 'policy report --p99-ms 180'))
@click.option('--failures', type=click.IntRange(0), default=0, help='Failed steps among the last 100.')
@click.option('--p99-ms', type=click.FloatRange(0.0), default=0.0, help='p99 of a step.')
def report(*, failures: int, p99_ms: float) -> ExitCode:
    """Report how the active version does.

    Beyond the limits of its manifest it is rolled back.
    """
    folder = _policies()
    name = folder.current()
    if name is None:
        raise PolicyError('no policy is active')
    if running.judge(folder, name, folder.check(name, folder.state(), hashes=False), failures, p99_ms):
        return ExitCode.FINE
    click.echo(f'{name} is rolled back; active: {folder.current() or "none"}')
    return ExitCode.FINDING


def _policies() -> PolicyFolder:
    folder = PolicyFolder(the_home())
    folder.make()
    return folder


@contextmanager
def _syncing(given: dict[str, Any]) -> Iterator[PolicySync]:
    is_now = given.pop('now')
    settings = PolicySettings(
        max_bytes=int(given.pop('max_gib') * GIBI), min_free_bytes=int(given.pop('min_free_gib') * GIBI), **given
    )
    with the_store(1) as store:
        may_activate = (lambda: True) if is_now else _no_mission(settings.robot)
        yield PolicySync(_policies(), store, _registry(), settings, may_activate)


@contextmanager
def _telling() -> Iterator[None]:
    """The topics of the policy meanwhile, where there is ROS."""
    try:
        from shadowhound_data_logger.ros.policy_topics import telling  # noqa: PLC0415 - ROS is not everywhere
    except ImportError as error:
        print(
            f'without ROS ({error}): ~/policy is not published, and only `policy report` tells of health',
            file=sys.stderr,
            flush=True,
        )
        yield
        return
    with telling(_policies()):
        yield


def _no_mission(robot: str = '') -> Callable[[], bool]:
    missions = MissionFinder(the_home(), robot or os.environ.get('SHADOWHOUND_ROBOT') or 'thor')
    return lambda: missions.look() is None


def _registry() -> MlflowRegistry:
    url = os.environ.get('MLFLOW_TRACKING_URI', '')
    if not url.startswith(('http://', 'https://')) or '@' in url:
        raise BadUsage('the registry is an MLflow server, and MLFLOW_TRACKING_URI names none', 'set it: http://TOWER_IP:5001')
    return MlflowRegistry(MlflowRest(url.rstrip('/'), os.environ, Path.home()))


def _told(result: SyncResult) -> dict[str, object]:
    return {'wanted': result.wanted, 'active': result.active, 'done': result.done, 'p99_ms': result.p99_ms,
            'fetched_bytes': result.fetched_bytes, 'begun_anew': result.begun_anew}  # fmt: skip


def _sentence(result: SyncResult) -> str:
    words: dict[str, Sequence[str]] = {
        'unchanged': ('active, as before: ', result.wanted), 'activated': ('active now: ', result.wanted),
        'waiting': ('waits for the end of the mission: ', result.wanted), 'pinned': ('pinned: ', result.wanted),
        'rolled_back': ('its key was revoked; active now: ', result.active or 'none'),
        'none': ('the registry names no version for this robot; active: ', result.active or 'none'),
    }  # fmt: skip
    return ''.join(words[result.done])
