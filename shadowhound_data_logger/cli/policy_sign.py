"""``shadowhound-data policy keys`` to ``policy withdraw``: which versions may run, signed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from shadowhound_data_logger.cli.common import (
    DAY_NS,
    Age,
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_home,
    the_store,
)
from shadowhound_data_logger.cli.output import print_json
from shadowhound_data_logger.cli.policy import registry
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies import packing
from shadowhound_data_logger.policies.registry import CANARY, CHAMPION
from shadowhound_data_logger.policies.trust import FRESH_DAYS, MISSING_PACKAGE, ROOT, target_of

_Verb = TypeVar('_Verb', bound=Callable[..., Any])


_folder = click.Path(path_type=Path, file_okay=False, exists=True)
_file = click.Path(path_type=Path, dir_okay=False, exists=True)


def _signs(verb: _Verb) -> _Verb:
    """The option of where a signer works."""
    return click.option('--keys', 'folder', type=click.Path(path_type=Path, file_okay=False), envvar='SHADOWHOUND_POLICY_KEYS',
                        help='Folder of keys  [default: $SHADOWHOUND_POLICY_KEYS, or policy-keys in SHADOWHOUND_HOME]'
                        )(verb)  # fmt: skip


_robot_types = click.option(
    '--robot-type',
    'robot_types',
    multiple=True,
    default=('go2',),
    show_default=True,
    metavar='TYPE',
    help='Type of robot; may be repeated.',
)
_key = click.option(
    '--key', type=_file, metavar='FILE', help='Private key to sign with  [default: targets.key in the folder of keys]'
)
_root_keys = click.option('--root-key', 'publics', type=_file, multiple=True, metavar='PUB',
                          help='Public key of a person who holds a part of the root; may be repeated.')  # fmt: skip
_encrypt = click.option('--encrypt', is_flag=True, help='Protect the new keys, except online.key, with a passphrase.')


@click.command(epilog=examples('policy keys', 'policy keys --person alice',
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
    """Make the keys that sign policies.

    For one person it makes root.key (keep it offline), targets.key (signs versions), online.key (renews their dates) and
    root.json (for robots). With --root-key, several people hold the root: each signs root.json with policy sign-root.
    """
    place, passphrase = _keys_folder(folder), _new_passphrase() if encrypt else ''
    files, roots, _ = _signers()
    if person:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        private = place / f'{person}{files.PRIVATE}'
        keyid, public = files.make_key(private, passphrase).public_key.keyid, private.with_suffix(files.PUBLIC)
        report: dict[str, object] = {'key': keyid, 'private': str(private), 'public': str(public)}
        lines = [f'{private}: keep it', f'{public}: for who runs policy keys or policy delegate']
    else:
        found = roots.create(place, [files.load_public(path) for path in publics], threshold, passphrase)
        report = {'folder': str(place), 'root': str(place / ROOT), 'missing_signatures': found.missing}
        lines = [
            f'{place / roots.TARGETS_KEY}: signs versions; stays with who publishes',
            f'{place / roots.ONLINE_KEY}: dates what is signed, for policy publish and a daily policy refresh',
            f'{place / ROOT}: ' + (f'lacks {found.missing} signatures (policy sign-root)' if found.missing else
                                   'for each robot, as policies/root.json in its SHADOWHOUND_HOME'),
        ]  # fmt: skip
        if not publics:
            lines.insert(0, f'{place / roots.ROOT_KEY}: move it offline, to two places; it replaces all other keys')
    print_json(report) if as_json else click.echo('\n'.join(lines))
    return ExitCode.FINE


@click.command(name='sign-root', epilog=examples('policy sign-root root.json --key alice.key'))
@click.argument('root', type=_file)
@click.option('--key', type=_file, required=True, metavar='FILE', help='Private key to sign with.')
@as_json
def sign_root(*, root: Path, key: Path, as_json: bool) -> ExitCode:
    """Sign a new root with another key."""
    roots = _signers()[1]
    lines = [*roots.described(root)]
    if not as_json:
        click.echo('\n'.join(lines))  # before the prompt for the passphrase
    found = roots.sign_root(root, key, _passphrase)
    missing = f', {found.missing} missing' if found.missing else ': complete'
    report = {'root': str(root), 'content': lines, 'signatures': found.signed, 'missing_signatures': found.missing}
    print_json(report) if as_json else click.echo(f'{found.signed} signatures{missing}')
    return ExitCode.FINE


@click.command(epilog=examples('policy rotate', 'policy rotate root --key usb/root.key', 'policy rotate online'))
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

    By default it replaces targets.key and online.key. Robots get the new ones from the store. Versions that others signed
    with the old keys are no longer listed.
    """
    if (publics or threshold) and 'root' not in roles:
        raise BadUsage('--root-key and --threshold are of a new root', 'policy rotate root --root-key alice.pub')
    place, passphrase = _keys_folder(folder), _new_passphrase() if encrypt else ''
    files, roots, _ = _signers()
    new_root = [files.load_public(path) for path in publics]
    with _signing(folder) as signing:
        before = signing.listed()
        found = signing.rotate(roles or ('targets', 'online'), secrets, new_root, threshold, passphrase)
        listed = before if found.missing else signing.listed()
    gone = sorted({*before} - {*listed})
    if found.missing:
        lines = [f'{place / roots.PENDING} lacks {found.missing} signatures: policy sign-root, then policy refresh']
    else:
        lines = [f'root version {found.version} is in force; listed are: {", ".join(listed) or "no policies"}']
        if gone:
            lines.append(f'not signed in this folder, and no longer listed: {", ".join(gone)}; '
                         'policy publish lists what is yours again')  # fmt: skip
        if 'online' in roles or 'targets' in roles or not roles:
            lines.append(f'copy {place / roots.ONLINE_KEY} to where policy refresh runs')
        if (place / roots.ROOT_KEY).is_file():
            lines.append(f'move {place / roots.ROOT_KEY} offline')
    report = {'folder': str(place), 'root_version': found.version, 'missing_signatures': found.missing, 'listed': listed,
            'no_longer_listed': gone}  # fmt: skip
    print_json(report) if as_json else click.echo('\n'.join(lines))
    return ExitCode.FINE


@click.command(epilog=examples("policy delegate alice.pub --for 'go2/go2_patrol/*'", 'policy delegate alice --revoke'))
@click.argument('who', metavar='PUB|NAME')
@click.option('--for', 'paths', multiple=True, metavar='PATTERN', help='ROBOT_TYPE/POLICY/VERSION, * for any; may be repeated.')
@click.option('--revoke', is_flag=True, help='Revoke the right of NAME: robots no longer run what only that key listed.')
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


@click.command(epilog=examples('policy refresh', 'policy refresh --expires 3d'))
@click.option('--expires', type=Age(365 * DAY_NS), metavar='AGE', default=f'{FRESH_DAYS:g}d', show_default=True,
              help='How long it is valid, such as 2h or 30d.')  # fmt: skip
@_signs
@as_json
def refresh(*, expires: int, folder: Path | None, as_json: bool) -> ExitCode:
    """Renew the signed timestamp; run it daily.

    It needs online.key and runs from cron. It includes what other signers have published, and activates a root once it has
    all its signatures.
    """
    with _signing(folder, expires / DAY_NS) as signing:
        state = signing.refresh()
        listed = signing.listed()
    report = {'expires': f'{state.expires:%Y-%m-%dT%H:%M:%SZ}', 'root_expires': f'{state.root.signed.expires:%Y-%m-%dT%H:%M:%SZ}',
            'listed': listed, 'soon': (soon := [*state.expiring()])}  # fmt: skip
    fresh = f'fresh until {report["expires"]}; the root until {report["root_expires"]}; {len(listed)} versions are listed'
    print_json(report) if as_json else click.echo('\n'.join((fresh, *soon)))
    return exit_code(finding=soon)


@click.command(epilog=examples('policy pack outputs/go2_patrol --name go2_patrol --smoke sample.npz --to packed'))
@click.argument('folder', metavar='DIR', type=_folder)
@click.option('--name', required=True, metavar='NAME', help='Name of the registered model.')
@click.option('--version', type=click.IntRange(1), help="Version of the policy  [default: the registry's next one]")
@click.option('--smoke', type=_file, required=True, metavar='NPZ', help='Sample arrays, one per input, for the smoke run.')
@click.option('--dataset', default='', metavar='DIGEST', help='Digest of the training set.')
@click.option('--run', 'run_id', default='', metavar='ID', help='MLflow run that trained it.')
@_robot_types
@click.option(
    '--fps', type=click.FloatRange(0.01, 1000.0), default=10.0, show_default=True, metavar='N', help='Frames per second.'
)
@click.option('--tolerance', type=click.FloatRange(0.0, min_open=True), default=1e-4, show_default=True,
              help="How much the sample's output may differ on a robot.")  # fmt: skip
@click.option('--max-p99-ms', 'p99_ms', type=click.FloatRange(0.0, min_open=True), default=100.0, show_default=True,
              help='Maximum p99 of the duration of a step.')  # fmt: skip
@click.option('--max-failures', 'failures', type=click.IntRange(0), default=3, show_default=True,
              help='Maximum of failed steps among the last 100.')  # fmt: skip
@click.option('--to', type=click.Path(path_type=Path), required=True, metavar='DIR', help='Where to write it.')
@as_json
def pack(*, folder: Path, name: str, version: int | None, smoke: Path, to: Path, run_id: str, as_json: bool, **given: Any
         ) -> ExitCode:  # fmt: skip
    """Pack the output of a training into a folder with a manifest.

    DIR has model.onnx as one file, and .json, .safetensors and .npy files. The model runs once, to record the expected output
    of the smoke run on a robot.
    """
    number = version or 1 + max((each.version for each in registry().versions(name)), default=0)
    manifest = packing.pack(folder, smoke, to, packing.Packing(name=name, version=number, run=run_id, **given))
    report = {'policy': manifest.id, 'folder': str(to), 'files': len(manifest.files), 'bytes': manifest.size}
    print_json(report) if as_json else click.echo(f'{manifest.id}: {len(manifest.files)} files, {manifest.size:,} bytes in {to}')
    return ExitCode.FINE


@click.command(
    epilog=examples('policy publish packed --alias champion', 'policy publish packed --alias canary --canary thor --canary tachi')
)
@click.argument('packed', type=_folder)
@click.option(
    '--alias',
    'aliases',
    multiple=True,
    help=f'Alias of the version, such as {CHAMPION}, {CANARY} or robot-NAME; may be repeated.',
)
@click.option('--canary', 'robots', multiple=True, metavar='ROBOT', help=f'Robot that takes it as {CANARY}; may be repeated.')
@_key
@_signs
@as_json
def publish(
    *, packed: Path, aliases: tuple[str, ...], robots: tuple[str, ...], key: Path | None, folder: Path | None, as_json: bool
) -> ExitCode:
    """Upload a packed policy, register it, and sign it.

    It can be repeated, also to give an existing version another alias. Nothing is overwritten.
    """
    with the_store() as store:
        signing = _signers()[2].Repository(_keys_folder(folder), store, _passphrase)
        manifest, is_refreshed = packing.publish(packed, store, registry(), signing, key=key, aliases=aliases, robots=robots)
    report = {'policy': manifest.id, 'aliases': list(aliases), 'robots': list(robots), 'refreshed': is_refreshed}
    text = f'published {manifest.id}{" as " if aliases else ""}{", ".join(aliases)}'
    print_json(report) if as_json else click.echo(
        text if is_refreshed else f'{text}; robots take it after policy refresh, where online.key is'
    )
    return ExitCode.FINE


@click.command(epilog=examples('policy withdraw go2_patrol@7'))
@click.argument('name', metavar='NAME@VERSION')
@_robot_types
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
        is_refreshed = signing.withdraw([target_of(kind, policy_name, int(version)) for kind in robot_types], key)
    text = f'{name} is no longer listed{"" if is_refreshed else "; robots learn of it after policy refresh, where online.key is"}'
    report = {'withdrawn': name, 'robot_types': list(robot_types), 'refreshed': is_refreshed}
    print_json(report) if as_json else click.echo(text)
    return ExitCode.FINE


# -- on the robot --------------------------------------------------------------------------------------------------------------


def _new_passphrase() -> str:
    passphrase = os.environ.get('SHADOWHOUND_KEY_PASSPHRASE')
    return passphrase or str(click.prompt('passphrase of the new keys', hide_input=True, confirmation_prompt=True, err=True))


def _keys_folder(folder: Path | None) -> Path:
    return folder or the_home() / 'policy-keys'


@contextmanager
def _signing(folder: Path | None, days: float = FRESH_DAYS) -> Iterator[Any]:
    with the_store() as store:
        yield _signers()[2].Repository(_keys_folder(folder), store, _passphrase, days=days)


def _signers() -> tuple[Any, Any, Any]:
    """The modules ``keys``, ``roots`` and ``repository``, which need packages of the extra."""
    try:
        from shadowhound_data_logger.policies import keys, repository, roots  # noqa: PLC0415 - see above
    except ImportError as error:
        raise PolicyError(f'signatures need a package that is missing: {error}', remedy=MISSING_PACKAGE) from error
    return keys, roots, repository


def _passphrase(path: Path) -> str:
    """Of a key that is encrypted."""
    return os.environ.get('SHADOWHOUND_KEY_PASSPHRASE') or str(click.prompt(f'passphrase of {path}', hide_input=True, err=True))
