"""The robot follows the registry: asks which version to run, fetches it, verifies it, tries it, and activates it.

Whatever fails leaves what is active as it is. One process does this at a time (``sync.lock``); a rollback need not wait for it.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from shadowhound_data_logger import disk
from shadowhound_data_logger.bandwidth import BYTES_PER_MEGABIT
from shadowhound_data_logger.errors import ObjectRefused, PolicyError, PolicyRefused, StoreUnavailable
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.options import GIBI
from shadowhound_data_logger.policies import signing
from shadowhound_data_logger.policies.folder import PolicyFolder, id_refused_as_old
from shadowhound_data_logger.policies.manifest import (
    MANIFEST,
    MOST_MANIFEST_BYTES,
    SIGNATURE,
    PolicyManifest,
    parse_manifest,
)
from shadowhound_data_logger.policies.packing import revocation_key
from shadowhound_data_logger.policies.registry import BUCKET, PolicyRegistry, RegisteredVersion, choose, folder_of
from shadowhound_data_logger.policies.smoke import run_smoke
from shadowhound_data_logger.retry import steadily
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import download

log = logging.getLogger(__name__)

REFUSED_AGAIN_S: Final = 3600.0
"""A version that was refused is not fetched again sooner: a smoke run may have been slow because the machine was busy."""
MOST_LISTS: Final = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySettings:
    """What a robot follows, and what that may cost."""

    name: str
    """Of the registered model."""
    robot: str
    robot_type: str = 'go2'
    max_mbps: float = 0.0
    """Most megabits a second that are downloaded; 0 is no limit."""
    max_bytes: int = 8 * GIBI
    """Of all versions on the disk."""
    min_free_bytes: int = 2 * GIBI
    keep: int = 3
    """Versions on the disk."""


@dataclass(frozen=True, slots=True)
class SyncResult:
    """What one look at the registry came to."""

    wanted: str
    """``NAME@7``, or an id where it is known; empty where nobody says."""
    active: str | None
    done: str
    """``unchanged`` ``activated`` ``waiting`` (a mission is active) ``rolled_back`` (a key was revoked) ``pinned`` ``none``."""
    p99_ms: float | None = None
    """Of the smoke run, where there was one."""


@dataclass(slots=True)
class PolicySync:
    """Life: New; ``run`` any number of times, from one thread."""

    folder: PolicyFolder
    store: ObjectStore
    registry: PolicyRegistry
    settings: PolicySettings
    may_activate: Callable[[], bool] = lambda: True
    """Whether no mission is active."""
    pause: Callable[[float], object] = time.sleep
    _refused: dict[str, tuple[float, PolicyRefused]] = field(default_factory=dict)

    def run(self, *, again: bool = True) -> SyncResult:
        """One look, and what follows from it. Raises DataLoggerError and OSError; what is active is as it was then.

        A version that was refused within the last hour is refused again, without a look at it, unless ``again``.
        """
        self.folder.make()
        with disk.flock(self.folder.path / 'sync.lock', wait=False) as is_ours:
            if not is_ours:
                raise PolicyError('another process is looking for policies here', remedy='wait until it is done')
            if self._revoke():
                return SyncResult('', self.folder.current(), 'rolled_back')
            state = self.folder.state()
            if state.pin is not None:
                if state.pin != self.folder.current():
                    self.folder.activate(state.pin)
                return SyncResult(state.pin, self.folder.current(), 'pinned')
            chosen = choose(self.registry, self.settings.name, self.settings.robot)
            if chosen is None:
                return SyncResult('', self.folder.current(), 'none')
            return self._follow(chosen, again=again)

    def _follow(self, chosen: RegisteredVersion, *, again: bool) -> SyncResult:
        wanted = f'{chosen.name}@{chosen.version}'
        prefix = folder_of(chosen, self.settings.name)
        now = self.folder.current()
        if now is not None and now.partition('#')[0] == wanted:
            return SyncResult(now, now, 'unchanged')
        since, refusal = self._refused.get(wanted, (float('-inf'), None))
        if refusal is not None and not again and time.monotonic() - since < REFUSED_AGAIN_S:
            raise refusal
        try:
            return self._take(wanted, prefix)
        except PolicyRefused as error:
            self._refused[wanted] = time.monotonic(), error
            raise

    def _take(self, wanted: str, prefix: str) -> SyncResult:
        known = [name for name in self.folder.installed() if name.partition('#')[0] == wanted]
        p99_ms = None
        if known:
            name = known[0]
        else:
            manifest = self._fetch(wanted, prefix)
            name = manifest.id
            p99_ms = self._try(manifest)
            self.folder.install(name)
        if not self.may_activate():
            return SyncResult(name, self.folder.current(), 'waiting', p99_ms)
        self.folder.activate(name)
        log.info('the policy %s is active', name)
        self.folder.clean(self.settings.keep)
        return SyncResult(name, name, 'activated', p99_ms)

    # -- what came -------------------------------------------------------------------------------------------------

    def _fetch(self, wanted: str, prefix: str) -> PolicyManifest:
        """The whole version into ``incoming``, verified as far as it can be without running it."""
        state = self.folder.state()
        content = self._get(f'{prefix}/{MANIFEST}', MOST_MANIFEST_BYTES)
        signature = self._get(f'{prefix}/{SIGNATURE}', signing.MOST_SIGNATURE_BYTES)
        signing.check_signature(content, signature, signing.FOR_POLICY, self.folder.keys(), state.revoked)
        manifest = parse_manifest(content)
        if f'{manifest.name}@{manifest.version}' != wanted:
            raise PolicyRefused('source', f'the registry says that {wanted} is at {prefix}, and {manifest.id} is there')
        if self.settings.robot_type not in manifest.robot_types:
            types = ', '.join(manifest.robot_types)
            raise PolicyRefused('robot_type', f'{manifest.id} is for {types}, and this is a {self.settings.robot_type}')
        if id_refused_as_old(state, manifest):
            raise PolicyRefused('serial', f'{manifest.id} has the serial {manifest.serial}, and a newer one ran here already',
                                remedy='a version that was on this robot comes back by policy use or rollback')  # fmt: skip
        if manifest.id in state.bad:
            raise PolicyRefused('bad', f'{manifest.id} was taken out here: {state.bad[manifest.id]}')
        place = self._incoming(manifest.id)
        self._check_room(manifest, place)
        for file in manifest.files:
            self._download(f'{prefix}/{file.path}', file.size, file.sha256, place / file.path)
        (place / MANIFEST).write_bytes(content)
        (place / SIGNATURE).write_bytes(signature)
        return self.folder.check(manifest.id, state, folder=place)

    def _get(self, key: str, most: int) -> bytes:
        try:
            return steadily(lambda: self.store.get(BUCKET, key, most), pause=self.pause)
        except ObjectRefused as error:
            reason = 'size' if error.data.get('reason') == 'size' else 'missing'
            raise PolicyRefused(reason, f'{error.what}') from error

    def _incoming(self, name: str) -> Path:
        """The folder of a download, which goes on where an earlier one of the same version ended; others go."""
        self.folder.incoming.mkdir(exist_ok=True)
        for other in self.folder.incoming.iterdir():
            if other.name != name:
                shutil.rmtree(other)
        place = self.folder.incoming / name
        place.mkdir(mode=0o700, exist_ok=True)
        return place

    def _check_room(self, manifest: PolicyManifest, place: Path) -> None:
        there = sum(_size(self.folder.versions / name) for name in self.folder.installed())
        if there + manifest.size > self.settings.max_bytes:
            self.folder.clean(1)
            there = sum(_size(self.folder.versions / name) for name in self.folder.installed())
        free = shutil.disk_usage(place).free + _size(place) - self.settings.min_free_bytes
        room = min(free, self.settings.max_bytes - there)
        if manifest.size > room:
            text = f'{manifest.id} has {manifest.size:,} bytes, and there is room for {max(0, room):,} in {self.folder.path}'
            raise PolicyRefused('disk', text, remedy='--max-gib and --min-free-gib say how much policies may take')

    def _download(self, key: str, size: int, sha256: str, path: Path) -> None:
        """Goes on for as long as each attempt brings something; what an earlier one brought whole is not fetched again."""
        if path.is_file() and disk.fingerprint(path) == (size, sha256):
            return
        wanted = ObjectInfo(BUCKET, key, size, sha256)
        had = -1
        cap = _Cap(self.settings.max_mbps, self.pause)
        while True:
            try:
                download(self.store, wanted, path, tell=cap.count, pause=self.pause)
                return
            except StoreUnavailable:
                if cap.counted <= had:
                    raise
                had = cap.counted
            except ObjectRefused as error:
                reason = 'damaged' if error.data.get('reason') == 'damaged' else 'missing'
                raise PolicyRefused(reason, f'{error.what}: {error.data.get("why", "")}') from error

    def _try(self, manifest: PolicyManifest) -> float:
        try:
            return run_smoke(self.folder.incoming / manifest.id, manifest)
        except PolicyRefused:
            shutil.rmtree(self.folder.incoming / manifest.id)
            raise

    # -- keys ------------------------------------------------------------------------------------------------------

    def _revoke(self) -> bool:
        """Read the lists of revoked keys that are new; whether the active version went because of them."""
        is_whole = True  # a list that was exchanged on its way is asked for again, and so are all after it
        for number in range(self.folder.state().revocations + 1, MOST_LISTS + 1):
            key = revocation_key(number)
            try:
                content = steadily(lambda key=key: self.store.get(BUCKET, key, signing.MOST_REVOCATION_BYTES),  # type: ignore[misc]
                                   pause=self.pause)  # fmt: skip
            except ObjectRefused as error:
                if error.data.get('reason') != 'missing':
                    raise
                break
            try:
                found = signing.read_revocation(content, number, self.folder.keys(), self.folder.state().revoked)
            except PolicyRefused as error:
                log.warning('a list of revoked keys counts for nothing: %s', error)
                is_whole = False
                continue
            with self.folder.changing() as state:
                state.revoked = sorted({*state.revoked, *found})
                state.revocations = number if is_whole else state.revocations
        return self._drop_revoked()

    def _drop_revoked(self) -> bool:
        now = self.folder.current()
        if now is None:
            return False
        try:
            self.folder.check(now, self.folder.state(), hashes=False)
        except PolicyRefused as error:
            if error.reason != 'revoked':
                raise
            log.warning('the policy %s goes: %s', now, error)
            self.folder.roll_back(f'{error.what}', of=now)
            return True
        return False


class _Cap:
    """Counts what arrives, and waits so that it is no faster than the cap."""

    def __init__(self, max_mbps: float, pause: Callable[[float], object]) -> None:
        self._bytes_s = max_mbps * BYTES_PER_MEGABIT
        self._pause = pause
        self._free_at = time.monotonic()
        self.counted = 0

    def count(self, size: int) -> None:
        self.counted += abs(size)
        if self._bytes_s and size > 0:
            now = time.monotonic()
            self._free_at = max(self._free_at, now - 0.1) + size / self._bytes_s
            if self._free_at > now:
                self._pause(self._free_at - now)


def _size(folder: Path) -> int:
    """Bytes of the files in it."""
    return sum(os.lstat(os.path.join(parent, name)).st_size for parent, _, names in os.walk(folder) for name in names)  # noqa: PTH118
