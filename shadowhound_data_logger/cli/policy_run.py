"""``shadowhound-data policy sync`` to ``policy report``: the policies of a robot."""

from __future__ import annotations

import logging
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, TypeVar

import click

from shadowhound_data_logger.cli.common import (
    ExitCode,
    Size,
    as_json,
    examples,
    exit_code,
    robot_name,
    the_home,
    the_robot,
    the_store,
)
from shadowhound_data_logger.cli.output import plain_table, print_json, print_page
from shadowhound_data_logger.cli.policy import registry
from shadowhound_data_logger.core.errors import DataLoggerError, PolicyError, PolicyRefused
from shadowhound_data_logger.missions.active import MissionFinder
from shadowhound_data_logger.policies import running
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.smoke import ISOLATIONS, SANDBOX, is_enough
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync, SyncResult
from shadowhound_data_logger.policies.trust import why_stale

_Verb = TypeVar('_Verb', bound=Callable[..., Any])


JITTER: Final = 0.2
"""Of the time between two looks: a fleet that was switched on together does not ask together."""
_isolation = click.option(
    '--isolation', envvar='SHADOWHOUND_POLICY_ISOLATION', type=click.Choice(ISOLATIONS), default=SANDBOX, show_default=True,
    help='Weakest isolation that a smoke run may have; limits: it may run with the rights of this user.',
)  # fmt: skip


def _follows(verb: _Verb) -> _Verb:
    """The options of what a robot follows."""
    for option in reversed((
        click.option('--name', envvar='SHADOWHOUND_POLICY', required=True, metavar='NAME',
                     help='Name of the registered model  [default: $SHADOWHOUND_POLICY]'),
        click.option('--robot', metavar='NAME', default=lambda: the_robot(None), callback=robot_name,
                     show_default='that of this machine', help='The robot.'),
        click.option('--robot-type', default='go2', show_default=True, metavar='TYPE', help='Type of robot.'),
        click.option('--max-mbps', type=click.FloatRange(0.0, 1e5), default=0.0, show_default=True,
                     metavar='N', help='Download at most N Mbit/s; 0: no limit.'),
        click.option('--max-bytes', type=Size(), metavar='SIZE', default='8GiB', show_default=True,
                     help='Keep at most SIZE, such as 2TB.'),
        click.option('--min-free-bytes', type=Size(), metavar='SIZE', default='2GiB', show_default=True,
                     help='Leave SIZE of the disk free.'),
        click.option('--keep-versions', 'keep', type=click.IntRange(2), default=3, show_default=True, metavar='N',
                     help='Versions to keep on the disk.'),
        _isolation,
        click.option('--now', is_flag=True, help='Activate it even while a mission is active.'),
    )):  # fmt: skip
        verb = option(verb)
    return verb


@click.command(epilog=examples('policy sync --name go2_patrol'))
@_follows
@as_json
def sync(*, as_json: bool, **given: Any) -> ExitCode:
    """Install the version that the registry selects, once."""
    with _syncing(given) as one:
        result = one.run()
    print_json(_fields(result)) if as_json else click.echo(_sentence(result))
    return ExitCode.FINE


@click.command(epilog=examples('policy run --name go2_patrol --max-mbps 20'))
@click.option('--interval', type=click.FloatRange(0.1, 86_400.0), default=30.0, show_default=True, metavar='S',
              help='Seconds between two rounds.')  # fmt: skip
@_follows
@as_json
def run(*, interval: float, as_json: bool, **given: Any) -> ExitCode:
    """Follow the registry until interrupted.

    With --json, each change is one line of JSON on standard output.

    An unreachable server changes nothing: the active version stays active. With ROS, the node shadowhound_policy publishes
    the active version as ~/policy (std_msgs/String, latched) and receives reports of its health on ~/health.
    """
    logging.basicConfig(level=logging.INFO, format='%(message)s')
    logging.getLogger('tuf').setLevel(logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM):  # also in the middle of a download: whatever is cut off is done again
        signal.signal(number, signal.default_int_handler)
    previous = ''
    with suppress(KeyboardInterrupt), _syncing(given) as one, _telling():
        while True:
            try:
                result = one.run(again=False)
                text, fields = _sentence(result), _fields(result)
            except (DataLoggerError, OSError) as error:
                text, fields = f'{error}', {'error': f'{error}'}
            if text != previous:
                previous = text
                print_json(fields, is_line=True) if as_json else print(text, file=sys.stderr, flush=True)
            time.sleep(interval * random.uniform(1.0 - JITTER, 1.0 + JITTER))
    return ExitCode.FINE


@click.command(name='list', epilog=examples('policy list', 'policy list --json'))
@as_json
def list_(*, as_json: bool) -> ExitCode:
    """List the versions on this robot."""
    folder = _policies()
    state, now = folder.state.read(), folder.current()
    why_not = {**state.bad, **dict.fromkeys(state.withdrawn, 'no signer lists it any longer')}
    rows = [{'policy': name, 'active': name == now, 'pinned': name == state.pin, 'why_not': why_not.get(name, ''),
             'isolation': state.verified.get(name)}
            for name in folder.versions.ids()]  # fmt: skip
    stale = why_stale(folder.path, time.time_ns())
    if as_json:
        print_json({'policies': rows, 'stale': stale})
    else:
        table = plain_table('', ('policy', '', 'tried in', 'why not'), ('policy', '', 'tried in', 'why not'))
        for row in rows:
            marks = [word for word in ('active', 'pinned') if row[word]]
            table.add_row(str(row['policy']), ' '.join(marks), str(row['isolation'] or '-'), str(row['why_not']))
        print_page(table) if rows else click.echo('There is no version on this robot.')
        if stale:
            click.echo(f'no new version is taken: {stale}')
    return ExitCode.FINE


@click.command(epilog=examples('policy show', 'policy show go2_patrol@7'))
@click.argument('name', required=False)
@as_json
def show(*, name: str | None, as_json: bool) -> ExitCode:
    """Describe and verify the active version, or NAME@7."""
    folder = _policies()
    found = folder.versions.find(name) if name else folder.current()
    if found is None:
        raise PolicyError('no policy is active')
    try:
        manifest, why = folder.check(found, folder.state.read()), ''
    except PolicyRefused as error:
        manifest, why = None, f'{error.reason}: {error.what}'
    fields = {'policy': found, 'active': found == folder.current(), 'path': str(folder.versions.path / found), 'refused': why,
            'isolation': folder.state.read().verified.get(found), 'stale': why_stale(folder.path, time.time_ns())}  # fmt: skip
    if manifest is not None:
        fields |= {'robot_types': list(manifest.robot_types), 'fps': manifest.fps,
                 'inputs': [spec.name for spec in manifest.inputs], 'outputs': [spec.name for spec in manifest.outputs],
                 'dataset': manifest.dataset, 'run': manifest.run, 'p99_ms': manifest.p99_ms, 'bytes': manifest.size}  # fmt: skip
    if as_json:
        print_json(fields)
    else:
        for key, value in fields.items():
            if value == '':
                continue
            click.echo(f'{key}: {", ".join(value) if isinstance(value, list) else value}')
    return ExitCode.FINDING if why else ExitCode.FINE


@click.command(epilog=examples('policy use go2_patrol@7'))
@click.argument('name')
@click.option('--now', is_flag=True, help='Activate it even while a mission is active.')
@_isolation
@as_json
def use(*, name: str, now: bool, isolation: str, as_json: bool) -> ExitCode:
    """Activate a version that is on this robot, and pin it."""
    folder = _policies()
    found = folder.versions.find(name)
    tried = folder.state.read().verified.get(found, 'no isolation that is known')
    if not is_enough(tried, isolation):
        raise PolicyError(f'the smoke run of {found} was in {tried}, required is {isolation}',
                          remedy='policy sync tries it again; or allow less: --isolation limits')  # fmt: skip
    if not now and not _no_mission()():
        raise PolicyError('a mission is active', remedy='wait for its end, or add --now')
    folder.use(found)
    print_json({'active': found, 'pinned': found}) if as_json else click.echo(f'{found} is active and pinned')
    return ExitCode.FINE


@click.command(epilog=examples('policy rollback'))
@as_json
def rollback(*, as_json: bool) -> ExitCode:
    """Roll back to the last good version immediately.

    The version that was active is not installed again, unless policy use activates it.
    """
    active = _policies().roll_back()
    print_json({'active': active}) if as_json else click.echo(f'active: {active or "none"}')
    return ExitCode.FINE


@click.command(epilog=examples('policy pin'))
@as_json
def pin(*, as_json: bool) -> ExitCode:
    """Keep the active version, whatever the registry selects."""
    pinned = _policies().pin()
    print_json({'pinned': pinned}) if as_json else click.echo(f'pinned: {pinned}')
    return ExitCode.FINE


@click.command(epilog=examples('policy unpin'))
@as_json
def unpin(*, as_json: bool) -> ExitCode:
    """Follow the registry again after policy pin or use."""
    _policies().unpin()
    print_json({'pinned': None}) if as_json else click.echo('follows the registry again')
    return ExitCode.FINE


@click.command(epilog=examples('policy report --failures 4', 'policy report --p99-ms 180'))
@click.option('--failures', type=click.IntRange(0), default=0, help='Failed steps among the last 100.')
@click.option('--p99-ms', type=click.FloatRange(0.0), default=0.0, help='99th percentile of the duration of a step.')
@as_json
def report(*, failures: int, p99_ms: float, as_json: bool) -> ExitCode:
    """Report the health of the active version.

    A version that exceeds the limits of its manifest is rolled back.
    """
    folder = _policies()
    name = folder.current()
    if name is None:
        raise PolicyError('no policy is active')
    is_good = running.judge(folder, name, folder.check(name, folder.state.read(), hashes=False), failures, p99_ms)
    active = folder.current()
    if as_json:
        print_json({'policy': name, 'rolled_back': not is_good, 'active': active})
    elif not is_good:
        click.echo(f'{name} is rolled back; active: {active or "none"}')
    return exit_code(finding=not is_good)


def _fields(result: SyncResult) -> dict[str, object]:
    return {'wanted': result.wanted, 'active': result.active, 'done': result.done, 'p99_ms': result.p99_ms,
            'fetched_bytes': result.fetched_bytes, 'begun_anew': result.restarted_files, 'stale': result.stale,
            'isolation': result.isolation}  # fmt: skip


def _sentence(result: SyncResult) -> str:
    words: dict[str, Sequence[str]] = {
        'unchanged': ('active, as before: ', result.wanted), 'activated': ('active now: ', result.wanted),
        'waiting': ('waits for the end of the mission: ', result.wanted), 'pinned': ('pinned: ', result.wanted),
        'withdrawn': ('no signer lists the active version any longer; active now: ', result.active or 'none'),
        'none': ('the registry names no version for this robot; active: ', result.active or 'none'),
    }  # fmt: skip
    return ''.join(words[result.done]) + (f'; no new version is taken: {result.stale}' if result.stale else '')


def _policies() -> PolicyFolder:
    folder = PolicyFolder(the_home())
    folder.make()
    return folder


@contextmanager
def _syncing(given: dict[str, Any]) -> Iterator[PolicySync]:
    is_now = given.pop('now')
    settings = PolicySettings(**given)
    with the_store(1) as store:
        may_activate = (lambda: True) if is_now else _no_mission(settings.robot)
        yield PolicySync(_policies(), store, registry(), settings, may_activate)


@contextmanager
def _telling() -> Iterator[None]:
    """The topics of the policy during that time, if ROS is installed."""
    try:
        from shadowhound_data_logger.ros.policy_topics import serve_policy_topics  # noqa: PLC0415 - ROS is not everywhere
    except ImportError as error:
        print(
            f'without ROS ({error}): ~/policy is not published, and only `policy report` reports health',
            file=sys.stderr,
            flush=True,
        )
        yield
        return
    with serve_policy_topics(_policies()):
        yield


def _no_mission(robot: str | None = None) -> Callable[[], bool]:
    missions = MissionFinder(the_home(), robot)
    return lambda: missions.active() is None
