"""The policies of a robot on its disk, which of them is active, and how that changes.

    policies/
      root.json         what this robot trusts, installed by a person (``trust.py``)
      metadata/         what was verified since then, by python-tuf
      versions/ID/      whole, verified versions, read-only; ID is go2_patrol@7#0123456789abcdef
      incoming/ID/      a version that is being downloaded
      current           the link to the active version; renaming another one over it is the activation
      state.json        what was active before, what is refused from now on, what is pinned

Whoever runs a policy needs the link and the version alone. ``state.json`` is written before the link is changed, so a crash
between the two leaves the version of before. ``lock`` is held only while both change: a rollback waits for no download.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import orjson

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.untrusted import from_strict_json
from shadowhound_data_logger.policies.content import check_files
from shadowhound_data_logger.policies.manifest import (
    MANIFEST,
    MOST_MANIFEST_BYTES,
    PolicyManifest,
    parse_manifest,
    split_id,
)
from shadowhound_data_logger.policies.trust import ROOT

MOST_STATE_BYTES: Final = 4 << 20
MOST_REMEMBERED: Final = 1000
"""Versions of which a robot knows that they were verified here, or misbehaved."""
BY_HAND: Final = 'rolled back by hand'


@dataclass(slots=True)
class PolicyState:
    """What ``state.json`` has."""

    pin: str | None = None
    """The id that stays active, whatever the registry says."""
    history: list[str] = field(default_factory=list)
    """Ids that were active before, the newest last."""
    verified: dict[str, str] = field(default_factory=dict)
    """Id -> the isolation of its smoke run, of all versions that passed every check here, also of those that are gone from the
    disk."""
    bad: dict[str, str] = field(default_factory=dict)
    """Id -> why it was taken out; such a version comes back by ``use`` alone."""
    withdrawn: list[str] = field(default_factory=list)
    """Ids of versions that were verified here and that no signer lists any longer: they do not run."""


class PolicyFolder:
    """The folder ``policies`` of a robot's home. Any number of processes may use it."""

    def __init__(self, home: Path) -> None:
        self.path = home / 'policies'
        self.versions = self.path / 'versions'
        self.incoming = self.path / 'incoming'
        self._current = self.path / 'current'

    def __repr__(self) -> str:
        return f'PolicyFolder({str(self.path)!r})'

    def make(self) -> None:
        """Make what is missing. Raises PolicyError for a folder in which others may write."""
        for folder in (self.path, self.path / 'metadata', self.versions, self.incoming):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.check_owner()

    def check_owner(self) -> None:
        """Raises PolicyError for a folder that is a link, or in which others may write: they could change what was verified.

        So could they with a root that they may write, or that is a link, and where anybody may rename the folder itself.
        """
        for parent in self.path.parents:
            if parent.stat().st_mode & (stat.S_IWOTH | stat.S_ISVTX) == stat.S_IWOTH:
                raise PolicyError(f'{parent} is a folder in which others may write', remedy=f'chmod o-w {parent}')
        for place in (self.path, self.path / 'metadata', self.versions, self.incoming, *self.path.glob(ROOT)):
            found = place.lstat()
            is_right = stat.S_ISDIR(found.st_mode) if place.name != ROOT else stat.S_ISREG(found.st_mode)
            if not is_right or found.st_uid not in {os.getuid(), 0} or found.st_mode & 0o022:
                what = f'{place} is a link, belongs to another user, or others may write in it'
                raise PolicyError(what, remedy=f'ls -ld {place}; chmod go-w {place}')

    # -- what is there ---------------------------------------------------------------------------------------------

    def current(self) -> str | None:
        """The id of the active version; None where there is none."""
        try:
            folder, _, name = str(self._current.readlink()).rpartition('/')
        except OSError:
            return None
        return name if folder == self.versions.name and split_id(name) else None

    def installed(self) -> list[str]:
        """The ids of all versions, by name and number."""
        names = [path.name for path in self.versions.iterdir()] if self.versions.is_dir() else []
        return sorted((name for name in names if split_id(name)), key=lambda name: split_id(name) or ('', 0, ''))

    def find(self, wanted: str) -> str:
        """The id of the installed version that ``NAME@7`` names, or an id. Raises PolicyError."""
        found = [name for name in self.installed() if name == wanted or name.partition('#')[0] == wanted]
        if len(found) != 1:
            raise PolicyError(f'there is no version {wanted!r} on this robot' if not found else f'{wanted!r} names {len(found)}')
        return found[0]

    def check(self, name: str, state: PolicyState, *, folder: Path | None = None, hashes: bool = True) -> PolicyManifest:
        """The manifest of a version that was verified and is still listed, with exactly its files. Raises PolicyRefused."""
        place = folder or self.versions / name
        content = _read(place / MANIFEST, MOST_MANIFEST_BYTES)
        if not hashlib.sha256(content).hexdigest().startswith(name.partition('#')[2]):
            raise PolicyRefused('damaged', f'{MANIFEST} of {name} has another SHA-256 than its id says')
        manifest = parse_manifest(content)
        if manifest.id != name:
            raise PolicyRefused('damaged', f'the folder of {name} has the policy {manifest.id}')
        if name in state.withdrawn:
            raise PolicyRefused('withdrawn', f'{name} was verified here, and no signer lists it any longer')
        check_files(place, manifest, hashes=hashes)
        return manifest

    def state(self) -> PolicyState:
        """Raises PolicyError for one that is damaged: nothing changes then, and what runs goes on."""
        path = self.path / 'state.json'
        try:
            told = from_strict_json(_read(path, MOST_STATE_BYTES), MOST_STATE_BYTES)
            return _state(told)
        except FileNotFoundError:
            return PolicyState()
        except (ValueError, TypeError, KeyError, PolicyRefused) as error:
            remedy = f'remove {path}: this robot then forgets which policies misbehaved, and what it may not go back to'
            raise PolicyError(f'{path} is damaged: {error}', remedy=remedy) from error

    # -- what changes ----------------------------------------------------------------------------------------------

    @contextmanager
    def changing(self) -> Iterator[PolicyState]:
        """The state, to be changed and written; nobody else changes it meanwhile."""
        with durable_files.flock(self.path / 'lock'):
            state = self.state()
            yield state
            self._write(state)

    def install(self, name: str, isolation: str) -> None:
        """Make a version of what is in ``incoming`` and was verified, with a smoke run in this isolation."""
        place = self.incoming / name
        for parent, _, files in os.walk(place):
            for file in files:
                path = Path(parent, file)
                durable_files.sync(path)
                path.chmod(0o400)
            durable_files.sync(Path(parent))
        self.note_tried(name, isolation)
        os.replace(place, self.versions / name)
        durable_files.sync(self.versions)

    def note_tried(self, name: str, isolation: str) -> None:
        """A smoke run of this version in this isolation went well."""
        with self.changing() as state:
            state.verified.pop(name, None)
            state.verified[name] = isolation
            state.verified = dict([*state.verified.items()][-MOST_REMEMBERED:])

    def activate(self, name: str) -> str | None:
        """Make this version the active one, unless another one was pinned meanwhile; its id. Raises PolicyRefused, OSError."""
        with durable_files.flock(self.path / 'lock'):
            state = self.state()
            if state.pin not in {None, name}:
                return state.pin
            manifest = self.check(name, state, hashes=False)
            self._activate(state, manifest)
            return None

    def use(self, name: str) -> None:
        """Activate and pin a version, also one that misbehaved. Raises PolicyRefused, OSError."""
        self.check(name, self.state())
        with durable_files.flock(self.path / 'lock'):  # for which a rollback does not wait long
            state = self.state()
            manifest = self.check(name, state, hashes=False)
            state.bad.pop(name, None)
            state.pin = name
            self._activate(state, manifest)

    def roll_back(self, why: str = BY_HAND, of: str | None = None) -> str | None:
        """Back to the last good version; the one that was active stays out from now on. Returns what is active now.

        ``of`` is the version that misbehaved: where another one is active meanwhile, that stays. Where there is no good one,
        none is active. Raises PolicyError where none was.
        """
        with durable_files.flock(self.path / 'lock'):
            state, now = self.state(), self.current()
            if now is None:
                raise PolicyError('no policy is active')
            if of not in {None, now}:
                state.bad[str(of)] = why
                self._write(state)
                return now
            state.bad[now] = why
            if state.pin == now:
                state.pin = None
            target = self._last_good(state, now)
            state.history = [name for name in state.history if name != now]  # with the target: this may end here, and be repeated
            try:
                self._write(state)
            finally:  # also where the disk is full: then it is out, and nobody remembers why
                self._link(target)
            return target

    def withdraw(self, names: Collection[str]) -> bool:
        """These may no longer run, all others may. Whether the active one was among them: the last good one is active then."""
        with durable_files.flock(self.path / 'lock'):
            state, now = self.state(), self.current()
            if sorted(names) == state.withdrawn and now not in state.withdrawn:
                return False
            state.withdrawn = sorted(names)
            if state.pin in state.withdrawn:
                state.pin = None
            if now not in state.withdrawn:
                self._write(state)
                return False
            target = self._last_good(state, str(now))
            state.history = [name for name in state.history if name != now]
            try:
                self._write(state)
            finally:  # also where the disk is full: the next look writes it down
                self._link(target)
            return True

    def pin(self) -> str:
        """Stay with the active version. Raises PolicyError where there is none."""
        with self.changing() as state:
            state.pin = self.current()
            if state.pin is None:
                raise PolicyError('no policy is active')
            return state.pin

    def unpin(self) -> None:
        """Follow the registry again."""
        with self.changing() as state:
            state.pin = None

    def clean(self, keep: int) -> list[str]:
        """Remove the oldest versions beyond ``keep``, but none that is active, pinned, next to roll back to, or in use."""
        with durable_files.flock(self.path / 'lock'):
            state, now = self.state(), self.current()
            wanted = {now, state.pin, self._last_good(state, now or '')}
            spare = [name for name in self.installed() if name not in wanted]
            spare.sort(key=lambda name: (self.versions / name).lstat().st_mtime)
            most = max(0, keep - len(wanted - {None}))
            gone = [name for name in spare[: max(0, len(spare) - most)] if self._set_aside(name)]
        for name in gone:  # gigabytes take their time, and a rollback does not wait for them
            shutil.rmtree(self._gone(name))
        return gone

    def _set_aside(self, name: str) -> bool:
        """Unless somebody uses it (``active``)."""
        place = self.versions / name
        descriptor = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            if not durable_files.lock(descriptor, wait=False):
                return False
            os.replace(place, self._gone(name))
        finally:
            os.close(descriptor)
        return True

    def _gone(self, name: str) -> Path:
        return self.incoming / f'{name}.gone'

    def _activate(self, state: PolicyState, manifest: PolicyManifest) -> None:
        now = self.current()
        if manifest.id in state.bad:
            remedy = f'shadowhound-data policy use {manifest.name}@{manifest.version} brings it back'
            raise PolicyRefused('bad', f'{manifest.id} was taken out here: {state.bad[manifest.id]}', remedy=remedy)
        if now != manifest.id:
            state.history = [*(name for name in state.history if name not in {now, manifest.id}), *([now] if now else [])]
        self._write(state)
        if now != manifest.id:
            self._link(manifest.id)

    def _last_good(self, state: PolicyState, now: str) -> str | None:
        for name in reversed(state.history):
            if name == now or name in state.bad:
                continue
            with suppress(PolicyRefused, OSError):
                self.check(name, state, hashes=False)
                return name
        return None

    def _link(self, name: str | None) -> None:
        if name is None:
            self._current.unlink(missing_ok=True)
        else:
            part = self.path / 'current.part'
            part.unlink(missing_ok=True)
            part.symlink_to(f'{self.versions.name}/{name}')
            os.replace(part, self._current)
        durable_files.sync(self.path)

    def _write(self, state: PolicyState) -> None:
        state.history = state.history[-MOST_REMEMBERED:]
        state.bad = dict([*state.bad.items()][-MOST_REMEMBERED:])
        told = {'format': 1, **{name: getattr(state, name) for name in PolicyState.__slots__}}
        with durable_files.replacing(self.path / 'state.json', is_synced=True, mode=0o600) as file:
            file.write(orjson.dumps(told, option=orjson.OPT_INDENT_2) + b'\n')
        durable_files.sync(self.path)


def newest_of(state: PolicyState, name: str) -> int:
    """The highest version of a policy that was verified here and may still run; 0 for none."""
    known = (split_id(each) for each in state.verified if each not in state.withdrawn)
    return max((each[1] for each in known if each and each[0] == name), default=0)


def _state(told: Mapping[str, Any]) -> PolicyState:
    if told['format'] != 1:
        raise ValueError('it is of another version of this package')
    state = PolicyState(**{name: told[name] for name in PolicyState.__slots__})
    kinds: dict[str, Any] = {'history': list, 'verified': dict, 'bad': dict, 'withdrawn': list}
    if any(not isinstance(getattr(state, name), kind) for name, kind in kinds.items()):
        raise ValueError('its fields have other types')
    return state


def _read(path: Path, most: int) -> bytes:
    """A plain file, of which no more than that is read. Raises PolicyRefused, FileNotFoundError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise PolicyRefused('link', f'{path} is not a plain file: {error.strerror}') from error
    with os.fdopen(descriptor, 'rb') as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise PolicyRefused('link', f'{path} is not a plain file')
        content = file.read(most + 1)
    if len(content) > most:
        raise PolicyRefused('size', f'{path} has more than {most:,} bytes')
    return content
