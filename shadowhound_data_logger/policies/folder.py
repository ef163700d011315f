"""The policies of a robot: which version is active, and how that changes.

    policies/
      root.json         the root that this robot trusts, installed by a person (``trust.py``)
      metadata/         verified metadata, kept by python-tuf
      versions/ID/      complete, verified versions, read-only; an ID is go2_patrol@7#0123456789abcdef
      incoming/ID/      a version that is being downloaded
      current           a link to the active version; renaming another link over it activates a version
      state.json        previously active, refused and pinned versions

A program that runs a policy needs only the link and the version. ``state.json`` is written before the link is changed, so after
a crash between the two the previous version is active. ``lock`` is held only while both change: a rollback never waits for a
download.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import orjson

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.untrusted import from_strict_json
from shadowhound_data_logger.policies.manifest import PolicyManifest, split_id
from shadowhound_data_logger.policies.trust import ROOT
from shadowhound_data_logger.policies.versions import Versions, read_file

MAX_STATE_BYTES: Final = 4 << 20
MAX_REMEMBERED: Final = 1000
"""Versions for which a robot remembers that they were verified here, or misbehaved."""
BY_HAND: Final = 'rolled back by hand'


@dataclass(slots=True)
class PolicyState:
    """The content of ``state.json``."""

    pin: str | None = None
    """The id that stays active, regardless of the registry."""
    history: list[str] = field(default_factory=list)
    """Previously active ids, the newest last."""
    verified: dict[str, str] = field(default_factory=dict)
    """Id -> the isolation of its smoke run, for all versions that passed every check here, including deleted ones."""
    bad: dict[str, str] = field(default_factory=dict)
    """Id -> why it was rolled back; only ``use`` activates such a version again."""
    withdrawn: list[str] = field(default_factory=list)
    """Ids of versions that were verified here and that no signer lists any longer: they must not run."""


class PolicyFolder:
    """The folder ``policies`` of a robot's home. Any number of processes may use it."""

    def __init__(self, home: Path) -> None:
        self.path = home / 'policies'
        self.versions = Versions(self.path)
        self._current = self.path / 'current'

    def __repr__(self) -> str:
        return f'PolicyFolder({str(self.path)!r})'

    def make(self) -> None:
        """Create missing folders. Raises PolicyError if other users can write to them."""
        for folder in (self.path, self.path / 'metadata', self.versions.path, self.versions.incoming):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.check_owner()

    def check_owner(self) -> None:
        """Raises PolicyError if other users could change verified files.

        They could if a folder or the root is a link or writable for them, or if they could rename the folder itself.
        """
        for parent in self.path.parents:
            if parent.stat().st_mode & (stat.S_IWOTH | stat.S_ISVTX) == stat.S_IWOTH:
                raise PolicyError(f'other users can write to {parent}', remedy=f'chmod o-w {parent}')
        for path in (self.path, self.path / 'metadata', self.versions.path, self.versions.incoming, *self.path.glob(ROOT)):
            found = path.lstat()
            is_expected = stat.S_ISDIR(found.st_mode) if path.name != ROOT else stat.S_ISREG(found.st_mode)
            if not is_expected or found.st_uid not in {os.getuid(), 0} or found.st_mode & 0o022:
                problem = f'{path} is a link, belongs to another user, or is writable for other users'
                raise PolicyError(problem, remedy=f'ls -ld {path}; chmod go-w {path}')

    # -- reading ---------------------------------------------------------------------------------------------------

    def current(self) -> str | None:
        """The id of the active version; None if no policy is active."""
        try:
            folder, _, name = str(self._current.readlink()).rpartition('/')
        except OSError:
            return None
        return name if folder == self.versions.path.name and split_id(name) else None

    def check(self, name: str, state: PolicyState, *, folder: Path | None = None, hashes: bool = True) -> PolicyManifest:
        """The manifest of a version that is still listed and has exactly its files (``Versions.check``). Raises PolicyRefused."""
        if name in state.withdrawn:
            raise PolicyRefused('withdrawn', f'{name} was verified here, but no signer lists it any longer')
        return self.versions.check(name, folder, hashes=hashes)

    def state(self) -> PolicyState:
        """Raises PolicyError for a damaged file: then nothing changes, and the active policy keeps running."""
        path = self.path / 'state.json'
        try:
            return _parse_state(from_strict_json(read_file(path, MAX_STATE_BYTES), MAX_STATE_BYTES))
        except FileNotFoundError:
            return PolicyState()
        except (ValueError, TypeError, KeyError, PolicyRefused) as error:
            remedy = f'remove {path}: this robot then forgets which policies misbehaved and which older versions it must refuse'
            raise PolicyError(f'{path} is damaged: {error}', remedy=remedy) from error

    # -- changing --------------------------------------------------------------------------------------------------

    @contextmanager
    def changing(self) -> Iterator[PolicyState]:
        """Lock the state, yield it to be changed, and write it."""
        with self._lock():
            state = self.state()
            yield state
            self._write(state)

    def install(self, name: str, isolation: str) -> None:
        """Install a version from ``incoming`` that was verified, with a smoke run in this isolation."""
        self.versions.seal(name)
        self.record_smoke_run(name, isolation)
        self.versions.add(name)

    def record_smoke_run(self, name: str, isolation: str) -> None:
        """Record that a version passed its smoke run in this isolation."""
        with self.changing() as state:
            state.verified.pop(name, None)
            state.verified[name] = isolation
            state.verified = dict([*state.verified.items()][-MAX_REMEMBERED:])

    def activate(self, name: str) -> str | None:
        """Activate a version, unless another one is pinned: then return the pinned id. Raises PolicyRefused, OSError."""
        with self._lock():
            state = self.state()
            if state.pin not in {None, name}:
                return state.pin
            self._activate(state, self.check(name, state, hashes=False))
            return None

    def use(self, name: str) -> None:
        """Activate and pin a version, even one that misbehaved. Raises PolicyRefused, OSError."""
        self.check(name, self.state())  # the hashes outside the lock, so that a rollback does not wait for them
        with self._lock():
            state = self.state()
            manifest = self.check(name, state, hashes=False)
            state.bad.pop(name, None)
            state.pin = name
            self._activate(state, manifest)

    def roll_back(self, why: str = BY_HAND, of: str | None = None) -> str | None:
        """Activate the last good version, and refuse the active one from now on. Returns the id that is active now.

        ``of`` is the version that misbehaved: if another version is active by now, it stays active. If there is no good version,
        none is active afterwards. Raises PolicyError if none was active before.
        """
        with self._lock():
            state, active = self.state(), self.current()
            if active is None:
                raise PolicyError('no policy is active')
            if of not in {None, active}:
                state.bad[str(of)] = why
                self._write(state)
                return active
            state.bad[active] = why
            if state.pin == active:
                state.pin = None
            return self._replace_active(state, active)

    def withdraw(self, names: Collection[str]) -> bool:
        """Refuse exactly these versions as no longer listed.

        Returns whether the active one was among them; then the last good version is active.
        """
        with self._lock():
            state, active = self.state(), self.current()
            if sorted(names) == state.withdrawn and active not in state.withdrawn:
                return False
            state.withdrawn = sorted(names)
            if state.pin in state.withdrawn:
                state.pin = None
            if active is None or active not in state.withdrawn:
                self._write(state)
                return False
            self._replace_active(state, active)
            return True

    def pin(self) -> str:
        """Pin the active version. Raises PolicyError if no policy is active."""
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
        """Delete the oldest versions beyond ``keep``, except the active, the pinned, the rollback target and those in use."""
        with self._lock():
            state, active = self.state(), self.current()
            needed = {active, state.pin, self._last_good(state, active or '')}
            candidates = [name for name in self.versions.ids() if name not in needed]
            candidates.sort(key=lambda name: (self.versions.path / name).lstat().st_mtime)
            kept = max(0, keep - len(needed - {None}))
            removed = [name for name in candidates[: max(0, len(candidates) - kept)] if self.versions.set_aside(name)]
        for name in removed:  # outside the lock: deleting gigabytes takes time, and a rollback must not wait
            self.versions.delete(name)
        return removed

    def _lock(self) -> AbstractContextManager[bool]:
        return durable_files.flock(self.path / 'lock')

    def _activate(self, state: PolicyState, manifest: PolicyManifest) -> None:
        active = self.current()
        if manifest.id in state.bad:
            remedy = f'shadowhound-data policy use {manifest.name}@{manifest.version} activates it anyway'
            raise PolicyRefused('bad', f'{manifest.id} was rolled back here: {state.bad[manifest.id]}', remedy=remedy)
        if active != manifest.id:
            history = [name for name in state.history if name not in {active, manifest.id}]
            state.history = [*history, *([active] if active else [])]
        self._write(state)
        if active != manifest.id:
            self._link(manifest.id)

    def _replace_active(self, state: PolicyState, active: str) -> str | None:
        """Write the state and activate the last good version, even if the disk is too full for the state."""
        target = self._last_good(state, active)
        state.history = [name for name in state.history if name != active]  # keeps the target: a crash repeats this
        try:
            self._write(state)
        finally:
            self._link(target)
        return target

    def _last_good(self, state: PolicyState, active: str) -> str | None:
        for name in reversed(state.history):
            if name == active or name in state.bad:
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
            part.symlink_to(f'{self.versions.path.name}/{name}')
            os.replace(part, self._current)
        durable_files.sync(self.path)

    def _write(self, state: PolicyState) -> None:
        state.history = state.history[-MAX_REMEMBERED:]
        state.bad = dict([*state.bad.items()][-MAX_REMEMBERED:])
        content = {'format': 1, **{name: getattr(state, name) for name in PolicyState.__slots__}}
        with durable_files.replacing(self.path / 'state.json', is_synced=True, mode=0o600) as file:
            file.write(orjson.dumps(content, option=orjson.OPT_INDENT_2) + b'\n')
        durable_files.sync(self.path)


def newest_of(state: PolicyState, name: str) -> int:
    """The highest version of a policy that was verified here and is still listed; 0 if there is none."""
    known = (split_id(each) for each in state.verified if each not in state.withdrawn)
    return max((each[1] for each in known if each and each[0] == name), default=0)


def _parse_state(given: Mapping[str, Any]) -> PolicyState:
    if given['format'] != 1:
        raise ValueError('it was written by another version of this package')
    state = PolicyState(**{name: given[name] for name in PolicyState.__slots__})
    types: dict[str, Any] = {'history': list, 'verified': dict, 'bad': dict, 'withdrawn': list}
    if any(not isinstance(getattr(state, name), type_) for name, type_ in types.items()):
        raise ValueError('its fields have the wrong types')
    return state
