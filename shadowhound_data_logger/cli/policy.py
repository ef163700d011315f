"""``shadowhound-data policy``: keys, packs and publishes policies; on the robot fetches, verifies, activates and rolls back."""

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
    DAY_NS,
    Age,
    BadUsage,
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
from shadowhound_data_logger.core.errors import DataLoggerError, PolicyError, PolicyRefused
from shadowhound_data_logger.core.mlflow_rest import MlflowRest
from shadowhound_data_logger.missions.active import MissionFinder
from shadowhound_data_logger.policies import packing, running
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.registry import CANARY, CHAMPION, MlflowRegistry
from shadowhound_data_logger.policies.smoke import ISOLATIONS, SANDBOX, is_enough
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync, SyncResult
from shadowhound_data_logger.policies.trust import FRESH_DAYS, MISSING_PACKAGE, ROOT, target_of, why_stale

JITTER: Final = 0.2
"""Of the time between two looks: a fleet that was switched on together does not ask together."""
_Verb = TypeVar('_Verb', bound=Callable[..., Any])

_folder = click.Path(path_type=Path, file_okay=False, exists=True)
_file = click.Path(path_type=Path, dir_okay=False, exists=True)


@click.group(epilog=examples('policy publish packed --alias champion', 'policy sync --name go2_patrol'))
def policy() -> None:
    """Bring trained policies to robots, signed.

    MLflow's registry says which version runs (alias champion), the store has its bytes, and The Update Framework says whether it
    may run: a robot trusts the root.json that was installed on it, and the keys that this names.
    """


# -- on Spark ------------------------------------------------------------------------------------------------------------------


def _signs(verb: _Verb) -> _Verb:
    """The option of where a signer works."""
    return click.option('--keys', 'folder', type=click.Path(path_type=Path, file_okay=False), envvar='SHADOWHOUND_POLICY_KEYS',
                        help='Folder of keys  [default: $SHADOWHOUND_POLICY_KEYS, or policy-keys in SHADOWHOUND_HOME]'
                        )(verb)  # fmt: skip


_key = click.option(
    '--key', type=_file, metavar='FILE', help='Private key to sign with  [default: targets.key in the folder of keys]'
)
_root_keys = click.option('--root-key', 'publics', type=_file, multiple=True, metavar='PUB',
                          help='Public key of a person who keeps a part of the root; may be repeated.')  # fmt: skip
_encrypt = click.option('--encrypt', is_flag=True, help='Ask for a passphrase for the keys that are made, except online.key.')


@policy.command(epilog=examples('policy keys', 'policy keys --person alice',
                                'policy keys --threshold 2 --root-key alice.pub --root-key bob.pub'))  # fmt: skip
@_root_keys
@click.option(
    '--threshold', type=click.IntRange(1), default=1, show_default=True, metavar='N', help='How many keys of a root must sign it.'
)
@click.option('--person', metavar='NAME', help='Make one key for this person: NAME.key to keep, NAME.pub to pass on.')
@_encrypt
@_signs
@as_json
def keys(*, publics: tuple[Path, ...], threshold: int, person: str | None, encrypt: bool, folder: Path | None, as_json: bool
         ) -> ExitCode:  # fmt: skip
    """Make the keys that say which policies may run.

    A team of one gets root.key, which goes offline, targets.key, which signs versions, online.key, which dates them, and
    root.json for robots. With --root-key, several people keep the root: each signs root.json by policy sign-root.
    """
    place, passphrase = _keys_folder(folder), _new_passphrase() if encrypt else ''
    files, repository = _signers()
    if person:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        private = place / f'{person}{files.PRIVATE}'
        keyid, public = files.make_key(private, passphrase).public_key.keyid, private.with_suffix(files.PUBLIC)
        told: dict[str, object] = {'key': keyid, 'private': str(private), 'public': str(public)}
        lines = [f'{private}: keep it', f'{public}: for who runs policy keys or policy delegate']
    else:
        found = repository.create(place, [files.load_public(path) for path in publics], threshold, passphrase)
        told = {'folder': str(place), 'root': str(place / ROOT), 'missing_signatures': found.missing}
        lines = [
            f'{place / repository.TARGETS_KEY}: signs versions; stays with who publishes',
            f'{place / repository.ONLINE_KEY}: dates what is signed, for policy publish and a daily policy refresh',
            f'{place / ROOT}: ' + (f'lacks {found.missing} signatures (policy sign-root)' if found.missing else
                                   'for each robot, as policies/root.json in its SHADOWHOUND_HOME'),
        ]  # fmt: skip
        if not publics:
            lines.insert(0, f'{place / repository.ROOT_KEY}: move it offline, to two places; it replaces all other keys')
    print_json(told) if as_json else click.echo('\n'.join(lines))
    return ExitCode.FINE


@policy.command(name='sign-root', epilog=examples('policy sign-root root.json --key alice.key'))
@click.argument('root', type=_file)
@click.option('--key', type=_file, required=True, metavar='FILE', help='Private key to sign with.')
@as_json
def sign_root(*, root: Path, key: Path, as_json: bool) -> ExitCode:
    """Sign a new root with another key."""
    repository = _signers()[1]
    lines = [*repository.described(root)]
    if not as_json:
        click.echo('\n'.join(lines))  # before the passphrase is asked for
    found = repository.sign_root(root, key, _passphrase)
    missing = f', {found.missing} missing' if found.missing else ': complete'
    told = {'root': str(root), 'content': lines, 'signatures': found.signed, 'missing_signatures': found.missing}
    print_json(told) if as_json else click.echo(f'{found.signed} signatures{missing}')
    return ExitCode.FINE


@policy.command(epilog=examples('policy rotate', 'policy rotate root --key usb/root.key', 'policy rotate online'))
@click.argument('roles', nargs=-1, type=click.Choice(['root', 'targets', 'online']))
@click.option('--key', 'secrets', type=_file, multiple=True, metavar='FILE',
              help='Private key to sign with; may be repeated  [default: root.key in the folder of keys]')  # fmt: skip
@_root_keys
@click.option(
    '--threshold', type=click.IntRange(1), metavar='N', help='How many keys of a root must sign it  [default: as before]'
)
@_encrypt
@_signs
@as_json
def rotate(*, roles: tuple[str, ...], secrets: tuple[Path, ...], publics: tuple[Path, ...], threshold: int | None, encrypt: bool,
           folder: Path | None, as_json: bool) -> ExitCode:  # fmt: skip
    """Replace keys that may have been stolen.

    By default those are targets.key and online.key.
    Robots learn of it from the store. What others signed with the old keys is no longer listed.
    """
    if (publics or threshold) and 'root' not in roles:
        raise BadUsage('--root-key and --threshold are of a new root', 'policy rotate root --root-key alice.pub')
    place, passphrase = _keys_folder(folder), _new_passphrase() if encrypt else ''
    files, repository = _signers()
    new_root = [files.load_public(path) for path in publics]
    with _signing(folder) as signing:
        before = signing.listed()
        found = signing.rotate(roles or ('targets', 'online'), secrets, new_root, threshold, passphrase)
        listed = before if found.missing else signing.listed()
    gone = sorted({*before} - {*listed})
    if found.missing:
        lines = [f'{place / repository.PENDING} lacks {found.missing} signatures: policy sign-root, then policy refresh']
    else:
        lines = [f'root version {found.version} is in force; listed are: {", ".join(listed) or "no policies"}']
        if gone:
            lines.append(f'not signed in this folder, and no longer listed: {", ".join(gone)}; '
                         'policy publish lists what is yours again')  # fmt: skip
        if 'online' in roles or 'targets' in roles or not roles:
            lines.append(f'copy {place / repository.ONLINE_KEY} to where policy refresh runs')
        if (place / repository.ROOT_KEY).is_file():
            lines.append(f'move {place / repository.ROOT_KEY} offline')
    told = {'folder': str(place), 'root_version': found.version, 'missing_signatures': found.missing, 'listed': listed,
            'no_longer_listed': gone}  # fmt: skip
    print_json(told) if as_json else click.echo('\n'.join(lines))
    return ExitCode.FINE


@policy.command(epilog=examples("policy delegate alice.pub --for 'go2/go2_patrol/*'", 'policy delegate alice --revoke'))
@click.argument('who', metavar='PUB|NAME')
@click.option('--for', 'paths', multiple=True, metavar='PATTERN', help='ROBOT_TYPE/POLICY/VERSION, * for any; may be repeated.')
@click.option('--revoke', is_flag=True, help='Take the right from NAME: robots no longer run what only that key listed.')
@_key
@_signs
@as_json
def delegate(*, who: str, paths: tuple[str, ...], revoke: bool, key: Path | None, folder: Path | None, as_json: bool) -> ExitCode:
    """Let another key list versions of some policies."""
    if revoke == bool(paths):
        raise BadUsage('either --for or --revoke', "policy delegate alice.pub --for 'go2/go2_patrol/*'")
    with _signing(folder) as signing:
        if revoke:
            names = list(signing.end_delegation(who, key))
            text = f'no longer may sign: {", ".join(names)}'
        else:
            names = [signing.delegate(_signers()[0].load_public(Path(who)), paths, key)]
            text = f'{names[0]} may sign {", ".join(paths)}'
    print_json({'names': names, 'may_sign': list(paths)}) if as_json else click.echo(text)
    return ExitCode.FINE


@policy.command(epilog=examples('policy refresh', 'policy refresh --expires 3d'))
@click.option('--expires', type=Age(365 * DAY_NS), metavar='AGE', default=f'{FRESH_DAYS:g}d', show_default=True,
              help='How long it is valid, such as 2h or 30d.')  # fmt: skip
@_signs
@as_json
def refresh(*, expires: int, folder: Path | None, as_json: bool) -> ExitCode:
    """Renew the signed timestamp, once a day.

    It needs online.key and runs from cron.
    It takes in what other signers have published, and puts a root in force that has all its signatures by now.
    """
    with _signing(folder, expires / DAY_NS) as signing:
        state = signing.refresh()
        listed = signing.listed()
    told = {'expires': f'{state.expires:%Y-%m-%dT%H:%M:%SZ}', 'root_expires': f'{state.root.signed.expires:%Y-%m-%dT%H:%M:%SZ}',
            'listed': listed, 'soon': (soon := [*state.soon()])}  # fmt: skip
    fresh = f'fresh until {told["expires"]}; the root until {told["root_expires"]}; {len(listed)} versions are listed'
    print_json(told) if as_json else click.echo('\n'.join((fresh, *soon)))
    return exit_code(finding=soon)


@policy.command(epilog=examples('policy pack outputs/go2_patrol --name go2_patrol --smoke sample.npz --to packed'))
@click.argument('folder', metavar='DIR', type=_folder)
@click.option('--name', required=True, metavar='NAME', help='Name of the registered model.')
@click.option('--version', type=click.IntRange(1), help="Its version  [default: the registry's next one]")
@click.option('--smoke', type=_file, required=True, metavar='NPZ', help='An array for each input, for the smoke run.')
@click.option('--dataset', default='', metavar='DIGEST', help='Digest of the training set.')
@click.option('--run', 'run_id', default='', metavar='ID', help='MLflow run that trained it.')
@click.option(
    '--robot-type',
    'robot_types',
    multiple=True,
    default=('go2',),
    show_default=True,
    metavar='TYPE',
    help='Type of robot; may be repeated.',
)
@click.option(
    '--fps', type=click.FloatRange(0.01, 1000.0), default=10.0, show_default=True, metavar='N', help='Frames per second.'
)
@click.option('--tolerance', type=click.FloatRange(0.0, min_open=True), default=1e-4, show_default=True,
              help="How much the sample's output may differ on a robot.")  # fmt: skip
@click.option('--max-p99-ms', 'p99_ms', type=click.FloatRange(0.0, min_open=True), default=100.0, show_default=True,
              help='Longest p99 of a step that is allowed.')  # fmt: skip
@click.option('--max-failures', 'failures', type=click.IntRange(0), default=3, show_default=True,
              help='Failed steps among the last 100 that are allowed.')  # fmt: skip
@click.option('--to', type=click.Path(path_type=Path), required=True, metavar='DIR', help='Where to write it.')
@as_json
def pack(*, folder: Path, name: str, version: int | None, smoke: Path, to: Path, run_id: str, as_json: bool, **given: Any
         ) -> ExitCode:  # fmt: skip
    """Make a folder with a manifest of what a training wrote.

    DIR has model.onnx in one file, and beside it .json, .safetensors and .npy files. The model runs once, to note what the smoke
    run on a robot has to give.
    """
    number = version or 1 + max((each.version for each in _registry().versions(name)), default=0)
    manifest = packing.pack(folder, smoke, to, packing.Packing(name=name, version=number, run=run_id, **given))
    told = {'policy': manifest.id, 'folder': str(to), 'files': len(manifest.files), 'bytes': manifest.size}
    print_json(told) if as_json else click.echo(f'{manifest.id}: {len(manifest.files)} files, {manifest.size:,} bytes in {to}')
    return ExitCode.FINE


@policy.command(
    epilog=examples('policy publish packed --alias champion', 'policy publish packed --alias canary --canary thor --canary tachi')
)
@click.argument('packed', type=_folder)
@click.option('--alias', 'aliases', multiple=True, help=f'Such as {CHAMPION}, {CANARY} or robot-NAME; may be repeated.')
@click.option('--canary', 'robots', multiple=True, metavar='ROBOT', help=f'Robot that takes it as {CANARY}; may be repeated.')
@_key
@_signs
@as_json
def publish(
    *, packed: Path, aliases: tuple[str, ...], robots: tuple[str, ...], key: Path | None, folder: Path | None, as_json: bool
) -> ExitCode:
    """Upload what was packed, register it, and sign that it may run.

    May be repeated, also to give a version that is there another alias. Nothing is overwritten.
    """
    with the_store() as store:
        signing = _signers()[1].Repository(_keys_folder(folder), store, _passphrase)
        manifest, is_told = packing.publish(packed, store, _registry(), signing, key=key, aliases=aliases, robots=robots)
    told = {'policy': manifest.id, 'aliases': list(aliases), 'robots': list(robots), 'refreshed': is_told}
    text = f'published {manifest.id}{" as " if aliases else ""}{", ".join(aliases)}'
    print_json(told) if as_json else click.echo(
        text if is_told else f'{text}; robots take it after policy refresh, where online.key is'
    )
    return ExitCode.FINE


@policy.command(epilog=examples('policy withdraw go2_patrol@7'))
@click.argument('name', metavar='NAME@VERSION')
@click.option(
    '--robot-type',
    'robot_types',
    multiple=True,
    default=('go2',),
    show_default=True,
    metavar='TYPE',
    help='Type of robot; may be repeated.',
)
@_key
@_signs
@as_json
def withdraw(*, name: str, robot_types: tuple[str, ...], key: Path | None, folder: Path | None, as_json: bool) -> ExitCode:
    """Sign that a version may no longer run.

    Robots roll back to their last good version.
    """
    policy_name, _, version = name.partition('@')
    if not version.isdecimal():
        raise BadUsage(f'{name!r} is not a version', 'such as go2_patrol@7')
    with _signing(folder) as signing:
        is_told = signing.withdraw([target_of(kind, policy_name, int(version)) for kind in robot_types], key)
    text = f'{name} is no longer listed{"" if is_told else "; robots learn of it after policy refresh, where online.key is"}'
    told = {'withdrawn': name, 'robot_types': list(robot_types), 'refreshed': is_told}
    print_json(told) if as_json else click.echo(text)
    return ExitCode.FINE


# -- on the robot --------------------------------------------------------------------------------------------------------------


_isolation = click.option(
    '--isolation', envvar='SHADOWHOUND_POLICY_ISOLATION', type=click.Choice(ISOLATIONS), default=SANDBOX, show_default=True,
    help='The least that a smoke run has to be in; limits: it may run with the rights of this user.',
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
@click.option('--interval', type=click.FloatRange(0.1, 86_400.0), default=30.0, show_default=True, metavar='S',
              help='Seconds between two rounds.')  # fmt: skip
@_follows
@as_json
def run(*, interval: float, as_json: bool, **given: Any) -> ExitCode:
    """Follow the registry until interrupted.

    With --json, each change is one line of JSON on standard output.

    A Tower that is away changes nothing: what is active goes on. Where there is ROS, the node shadowhound_policy publishes the
    active version as ~/policy (std_msgs/String, latched), and takes word of its health on ~/health.
    """
    logging.basicConfig(level=logging.INFO, format='%(message)s')
    logging.getLogger('tuf').setLevel(logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM):  # also in the middle of a download: whatever is cut off is done again
        signal.signal(number, signal.default_int_handler)
    said = ''
    with suppress(KeyboardInterrupt), _syncing(given) as one, _telling():
        while True:
            try:
                result = one.run(again=False)
                text, told = _sentence(result), _told(result)
            except (DataLoggerError, OSError) as error:
                text, told = f'{error}', {'error': f'{error}'}
            if text != said:
                said = text
                print_json(told, is_line=True) if as_json else print(text, file=sys.stderr, flush=True)
            time.sleep(interval * random.uniform(1.0 - JITTER, 1.0 + JITTER))
    return ExitCode.FINE


@policy.command(name='list', epilog=examples('policy list', 'policy list --json'))
@as_json
def list_(*, as_json: bool) -> ExitCode:
    """List the versions on this robot."""
    folder = _policies()
    state, now = folder.state(), folder.current()
    why_not = {**state.bad, **dict.fromkeys(state.withdrawn, 'no signer lists it any longer')}
    rows = [{'policy': name, 'active': name == now, 'pinned': name == state.pin, 'why_not': why_not.get(name, ''),
             'isolation': state.verified.get(name)}
            for name in folder.installed()]  # fmt: skip
    stale = why_stale(folder.path, time.time_ns())
    if as_json:
        print_json({'policies': rows, 'stale': stale})
    else:
        table = plain_table('', ('policy', '', 'tried in', 'why not'), ('policy', '', 'tried in', 'why not'))
        for row in rows:
            marks = [word for word in ('active', 'pinned') if row[word]]
            table.add_row(str(row['policy']), ' '.join(marks), str(row['isolation'] or '-'), str(row['why_not']))
        print_page(table)
        if stale:
            click.echo(f'no new version is taken: {stale}')
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
            'isolation': folder.state().verified.get(found), 'stale': why_stale(folder.path, time.time_ns())}  # fmt: skip
    if manifest is not None:
        told |= {'robot_types': list(manifest.robot_types), 'fps': manifest.fps,
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
@click.option('--now', is_flag=True, help='Activate it even while a mission is active.')
@_isolation
@as_json
def use(*, name: str, now: bool, isolation: str, as_json: bool) -> ExitCode:
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
    print_json({'active': found, 'pinned': found}) if as_json else click.echo(f'{found} is active and pinned')
    return ExitCode.FINE


@policy.command(epilog=examples('policy rollback'))
@as_json
def rollback(*, as_json: bool) -> ExitCode:
    """Go back to the last good version, at once.

    What was active is not taken again, unless policy use brings it back.
    """
    active = _policies().roll_back()
    print_json({'active': active}) if as_json else click.echo(f'active: {active or "none"}')
    return ExitCode.FINE


@policy.command(epilog=examples('policy pin'))
@as_json
def pin(*, as_json: bool) -> ExitCode:
    """Stay with the active version, whatever the registry says."""
    pinned = _policies().pin()
    print_json({'pinned': pinned}) if as_json else click.echo(f'pinned: {pinned}')
    return ExitCode.FINE


@policy.command(epilog=examples('policy unpin'))
@as_json
def unpin(*, as_json: bool) -> ExitCode:
    """Follow the registry again."""
    _policies().unpin()
    print_json({'pinned': None}) if as_json else click.echo('follows the registry again')
    return ExitCode.FINE


@policy.command(epilog=examples('policy report --failures 4', 'policy report --p99-ms 180'))
@click.option('--failures', type=click.IntRange(0), default=0, help='Failed steps among the last 100.')
@click.option('--p99-ms', type=click.FloatRange(0.0), default=0.0, help='p99 of a step.')
@as_json
def report(*, failures: int, p99_ms: float, as_json: bool) -> ExitCode:
    """Report how the active version does.

    Beyond the limits of its manifest it is rolled back.
    """
    folder = _policies()
    name = folder.current()
    if name is None:
        raise PolicyError('no policy is active')
    is_good = running.judge(folder, name, folder.check(name, folder.state(), hashes=False), failures, p99_ms)
    active = folder.current()
    if as_json:
        print_json({'policy': name, 'rolled_back': not is_good, 'active': active})
    elif not is_good:
        click.echo(f'{name} is rolled back; active: {active or "none"}')
    return exit_code(finding=not is_good)


def _keys_folder(folder: Path | None) -> Path:
    return folder or the_home() / 'policy-keys'


@contextmanager
def _signing(folder: Path | None, days: float = FRESH_DAYS) -> Iterator[Any]:
    with the_store() as store:
        yield _signers()[1].Repository(_keys_folder(folder), store, _passphrase, days=days)


def _signers() -> tuple[Any, Any]:
    """The modules ``keys`` and ``repository``, which need packages of the extra."""
    try:
        from shadowhound_data_logger.policies import keys, repository  # noqa: PLC0415 - see above
    except ImportError as error:
        raise PolicyError(f'signatures need a package that is missing: {error}', remedy=MISSING_PACKAGE) from error
    return keys, repository


def _passphrase(path: Path) -> str:
    """Of a key that is encrypted."""
    return os.environ.get('SHADOWHOUND_KEY_PASSPHRASE') or str(click.prompt(f'passphrase of {path}', hide_input=True, err=True))


def _new_passphrase() -> str:
    told = os.environ.get('SHADOWHOUND_KEY_PASSPHRASE')
    return told or str(click.prompt('passphrase of the new keys', hide_input=True, confirmation_prompt=True, err=True))


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
    missions = MissionFinder(the_home(), the_robot(robot or None))
    return lambda: missions.active() is None


def _registry() -> MlflowRegistry:
    url = os.environ.get('MLFLOW_TRACKING_URI', '')
    if not url.startswith(('http://', 'https://')) or '@' in url:
        raise BadUsage('the registry is an MLflow server, and MLFLOW_TRACKING_URI names none', 'set it: http://TOWER_IP:5001')
    return MlflowRegistry(MlflowRest(url.rstrip('/'), os.environ, Path.home()))


def _told(result: SyncResult) -> dict[str, object]:
    return {'wanted': result.wanted, 'active': result.active, 'done': result.done, 'p99_ms': result.p99_ms,
            'fetched_bytes': result.fetched_bytes, 'begun_anew': result.begun_anew, 'stale': result.stale,
            'isolation': result.isolation}  # fmt: skip


def _sentence(result: SyncResult) -> str:
    words: dict[str, Sequence[str]] = {
        'unchanged': ('active, as before: ', result.wanted), 'activated': ('active now: ', result.wanted),
        'waiting': ('waits for the end of the mission: ', result.wanted), 'pinned': ('pinned: ', result.wanted),
        'withdrawn': ('no signer lists the active version any longer; active now: ', result.active or 'none'),
        'none': ('the registry names no version for this robot; active: ', result.active or 'none'),
    }  # fmt: skip
    return ''.join(words[result.done]) + (f'; no new version is taken: {result.stale}' if result.stale else '')
