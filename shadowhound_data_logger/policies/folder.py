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
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.policies.manifest import PolicyManifest, split_id
from shadowhound_data_logger.policies.state import PolicyState, StateFile
from shadowhound_data_logger.policies.trust import ROOT
from shadowhound_data_logger.policies.versions import Versions

BY_HAND: Final = 'rolled back by hand'


class PolicyFolder:
    """The folder ``policies`` of a robot's home. Any number of processes may use it."""

    def __init__(self, home: Path) -> None:
        self.path = home / 'policies'
        self.versions = Versions(self.path)
        self.state = StateFile(self.path)
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

    # -- changing --------------------------------------------------------------------------------------------------

    def install(self, name: str, isolation: str) -> None:
        """Install a version from ``incoming`` that was verified, with a smoke run in this isolation."""
        self.versions.seal(name)
        self.record_smoke_run(name, isolation)
        self.versions.add(name)

    def record_smoke_run(self, name: str, isolation: str) -> None:
        """Record that a version passed its smoke run in this isolation."""
        with self.state.changing() as state:
            state.verified.pop(name, None)
            state.verified[name] = isolation

    def activate(self, name: str) -> str | None:
        """Activate a version, unless another one is pinned: then return the pinned id. Raises PolicyRefused, OSError."""
        with self.state.lock():
            state = self.state.read()
            if state.pin not in {None, name}:
                return state.pin
            self._activate(state, self.check(name, state, hashes=False))
            return None

    def use(self, name: str) -> None:
        """Activate and pin a version, even one that misbehaved. Raises PolicyRefused, OSError."""
        self.check(name, self.state.read())  # the hashes outside the lock, so that a rollback does not wait for them
        with self.state.lock():
            state = self.state.read()
            manifest = self.check(name, state, hashes=False)
            state.bad.pop(name, None)
            state.pin = name
            self._activate(state, manifest)

    def roll_back(self, why: str = BY_HAND, of: str | None = None) -> str | None:
        """Activate the last good version, and refuse the active one from now on. Returns the id that is active now.

        ``of`` is the version that misbehaved: if another version is active by now, it stays active. If there is no good version,
        none is active afterwards. Raises PolicyError if none was active before.
        """
        with self.state.lock():
            state, active = self.state.read(), self.current()
            if active is None:
                raise PolicyError('no policy is active')
            if of not in {None, active}:
                state.bad[str(of)] = why
                self.state.write(state)
                return active
            state.bad[active] = why
            if state.pin == active:
                state.pin = None
            return self._replace_active(state, active)

    def withdraw(self, names: Collection[str]) -> bool:
        """Refuse exactly these versions as no longer listed.

        Returns whether the active one was among them; then the last good version is active.
        """
        with self.state.lock():
            state, active = self.state.read(), self.current()
            if sorted(names) == state.withdrawn and active not in state.withdrawn:
                return False
            state.withdrawn = sorted(names)
            if state.pin in state.withdrawn:
                state.pin = None
            if active is None or active not in state.withdrawn:
                self.state.write(state)
                return False
            self._replace_active(state, active)
            return True

    def pin(self) -> str:
        """Pin the active version. Raises PolicyError if no policy is active."""
        with self.state.changing() as state:
            state.pin = self.current()
            if state.pin is None:
                raise PolicyError('no policy is active')
            return state.pin

    def unpin(self) -> None:
        """Follow the registry again."""
        with self.state.changing() as state:
            state.pin = None

    def clean(self, keep: int) -> list[str]:
        """Delete the oldest versions beyond ``keep``, except the active, the pinned, the rollback target and those in use."""
        with self.state.lock():
            state, active = self.state.read(), self.current()
            needed = {active, state.pin, self._last_good(state, active or '')}
            candidates = [name for name in self.versions.ids() if name not in needed]
            candidates.sort(key=lambda name: (self.versions.path / name).lstat().st_mtime)
            kept = max(0, keep - len(needed - {None}))
            removed = [name for name in candidates[: max(0, len(candidates) - kept)] if self.versions.set_aside(name)]
        for name in removed:  # outside the lock: deleting gigabytes takes time, and a rollback must not wait
            self.versions.delete(name)
        return removed

    def _activate(self, state: PolicyState, manifest: PolicyManifest) -> None:
        active = self.current()
        if manifest.id in state.bad:
            remedy = f'shadowhound-data policy use {manifest.name}@{manifest.version} activates it anyway'
            raise PolicyRefused('bad', f'{manifest.id} was rolled back here: {state.bad[manifest.id]}', remedy=remedy)
        if active != manifest.id:
            history = [name for name in state.history if name not in {active, manifest.id}]
            state.history = [*history, *([active] if active else [])]
        self.state.write(state)
        if active != manifest.id:
            self._link(manifest.id)

    def _replace_active(self, state: PolicyState, active: str) -> str | None:
        """Write the state and activate the last good version, even if the disk is too full for the state."""
        target = self._last_good(state, active)
        state.history = [name for name in state.history if name != active]  # keeps the target: a crash repeats this
        try:
            self.state.write(state)
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
