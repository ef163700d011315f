"""Follows the registry on the robot: finds the version to run, downloads, verifies, tests and activates it.

If anything fails, the active version stays active. One process does this at a time (``sync.lock``); a rollback does not wait for
it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import DataLoggerError, ObjectRefused, PolicyError, PolicyRefused, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.options import GIBI
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.policies import trust
from shadowhound_data_logger.policies.content import files_of
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.manifest import (
    BUCKET,
    MANIFEST,
    MAX_MANIFEST_BYTES,
    PolicyManifest,
    parse_manifest,
    split_id,
)
from shadowhound_data_logger.policies.registry import PolicyRegistry, RegisteredVersion, choose, folder_of
from shadowhound_data_logger.policies.smoke import SANDBOX, is_enough, run_smoke
from shadowhound_data_logger.policies.state import newest_of
from shadowhound_data_logger.stores.bandwidth import BYTES_PER_MEGABIT
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import UNFINISHED, download

log = logging.getLogger(__name__)

REFUSAL_S: Final = 3600.0
"""A refused version is tried again after this time, because its smoke run may have been slow on a busy machine."""
RETRIED_AT_ONCE: Final = frozenset({'unlisted', 'untrusted', 'expired', 'clock'})
"""Reasons that a signer can resolve at any time, and whose check requires no download."""
MAX_CATCH_UP_S: Final = 0.1
"""After a pause of the download, this much of the unused bandwidth, and that of two chunks, may be used up: chunks are requested
one after another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySettings:
    """Which policy a robot follows, and the limits for downloads and disk."""

    name: str
    """Name of the registered model."""
    robot: str
    robot_type: str = 'go2'
    max_mbps: float = 0.0
    """Bandwidth limit in megabits per second; 0 for none."""
    max_bytes: int = 8 * GIBI
    """Limit for all versions on disk."""
    min_free_bytes: int = 2 * GIBI
    """Bytes of the disk that stay free."""
    keep: int = 3
    """Number of versions kept on disk."""
    isolation: str = SANDBOX
    """Required isolation of the smoke run (``smoke.ISOLATIONS``): a version that was run with less is not activated."""


@dataclass(frozen=True, slots=True)
class SyncResult:
    """The result of one sync."""

    wanted: str
    """``NAME@7``, or the id if known; empty if the registry selects no version."""
    active: str | None
    """The id of the active version."""
    done: str
    """``unchanged`` ``activated`` ``waiting`` (a mission is active) ``pinned`` ``none``, or ``withdrawn``: the previously active
    version was deactivated, because no signer lists it any longer."""
    p99_ms: float | None = None
    """99th percentile of a step in the smoke run; None if there was no smoke run."""
    fetched_bytes: int = 0
    """Downloaded bytes, including repeated ones."""
    restarted_files: int = 0
    """Files whose partial download was discarded, because it was damaged or the object had changed."""
    stale: str = ''
    """Why no new versions are accepted now; empty if they are."""
    isolation: str | None = None
    """The isolation in which the active version was tested (``smoke.ISOLATIONS``)."""


@dataclass(slots=True)
class PolicySync:
    """Makes a robot follow the registry. Lifecycle: New; ``run`` any number of times, from one thread."""

    folder: PolicyFolder
    store: ObjectStore
    registry: PolicyRegistry
    settings: PolicySettings
    may_activate: Callable[[], bool] = lambda: True
    """Whether no mission is active."""
    pause: Callable[[float], object] = time.sleep
    monotonic: Callable[[], float] = time.monotonic
    wall_ns: Callable[[], int] = time.time_ns
    _refused: dict[str, tuple[float, PolicyRefused]] = field(default_factory=dict)

    def run(self, *, again: bool = True) -> SyncResult:
        """Sync once. Raises DataLoggerError and OSError, and then leaves the active version unchanged.

        Unless ``again``, a version that was refused less than an hour ago is refused without trying it again.
        """
        self.folder.make()
        with durable_files.flock(self.folder.path / 'sync.lock', wait=False) as is_ours:
            if not is_ours:
                raise PolicyError('another process is syncing the policies of this robot', remedy='wait until it has finished')
            state, active = self.folder.state.read(), self.folder.current()
            if active is not None and active in state.bad:  # a rollback was interrupted
                self.folder.roll_back(state.bad[active], of=active)
            traffic = _Traffic(self.settings.max_mbps, self.pause, self.monotonic)
            listing = self._listing(traffic)
            if isinstance(listing, trust.Trust):
                if self.folder.withdraw(self._withdrawn(listing)):
                    log.warning('the active policy was withdrawn by its signers; active is now %s', self.folder.current())
                    return self._finished(SyncResult('', self.folder.current(), 'withdrawn'))
                if why := trust.why_stale(self.folder.path, self.wall_ns()):
                    listing = PolicyRefused('clock', why)
            result = self._follow(listing, traffic, again=again)
            return self._finished(result if isinstance(listing, trust.Trust) else replace(result, stale=f'{listing}'))

    def _finished(self, result: SyncResult) -> SyncResult:
        return replace(result, isolation=self.folder.state.read().verified.get(result.active) if result.active else None)

    def _listing(self, traffic: _Traffic) -> trust.Trust | DataLoggerError:
        """The verified lists, or why they cannot be verified: then no new version is accepted."""
        try:
            return trust.refresh(self.folder.path, self.store, traffic.count, self.pause)
        except PolicyRefused as error:
            why = trust.why_stale(self.folder.path, self.wall_ns()) if error.reason == 'expired' else ''
            return PolicyRefused('expired', why) if why else error
        except DataLoggerError as error:
            return error

    def _withdrawn(self, listing: trust.Trust) -> list[str]:
        """The versions that were verified here and are no longer listed. If that is unknown for a version, nothing changes."""
        state = self.folder.state.read()
        return [name for name in sorted({*state.verified, *self.folder.versions.ids()})
                if not self._is_listed(listing, name, unknown=name not in state.withdrawn)]  # fmt: skip

    def _is_listed(self, listing: trust.Trust, name: str, *, unknown: bool) -> bool:
        policy, version, sha256 = split_id(name) or ('', 0, '')
        try:
            target = listing.listed(trust.target_of(self.settings.robot_type, policy, version))
        except DataLoggerError as error:
            log.warning('cannot determine whether %s is still listed: %s', name, error)
            return unknown
        return target is not None and target.hashes.get('sha256', '').startswith(sha256)

    def _follow(self, listing: trust.Trust | DataLoggerError, traffic: _Traffic, *, again: bool) -> SyncResult:
        """Activate the pinned version, otherwise the one that the registry selects."""
        state = self.folder.state.read()
        if state.pin is not None:
            if state.pin != self.folder.current():
                if not self.may_activate():
                    return SyncResult(state.pin, self.folder.current(), 'waiting')
                self._ensure_tested(state.pin)
                self.folder.activate(state.pin)
            return SyncResult(state.pin, self.folder.current(), 'pinned')
        chosen = choose(self.registry, self.settings.name, self.settings.robot)
        if chosen is None:
            return SyncResult('', self.folder.current(), 'none')
        wanted = f'{chosen.name}@{chosen.version}'
        prefix = folder_of(chosen, self.settings.name)
        now = self.folder.current()
        if now is not None and now.partition('#')[0] == wanted:
            self.folder.check(now, self.folder.state.read(), hashes=False)
            return SyncResult(now, now, 'unchanged')
        since, refusal = self._refused.get(wanted, (float('-inf'), None))
        if refusal is not None and not again and self.monotonic() - since < REFUSAL_S:
            raise refusal
        known = [name for name in self.folder.versions.ids() if name.partition('#')[0] == wanted]
        try:
            return self._install_and_activate(chosen, prefix, known, listing, traffic)
        except PolicyRefused as error:
            if error.reason not in RETRIED_AT_ONCE:
                self._refused[wanted] = self.monotonic(), error
            raise

    def _install_and_activate(self, chosen: RegisteredVersion, prefix: str, known: Sequence[str],
                              listing: trust.Trust | DataLoggerError, traffic: _Traffic) -> SyncResult:  # fmt: skip
        p99_ms = None
        if known:
            name = known[0]
            self._ensure_tested(name)
        elif isinstance(listing, DataLoggerError):
            raise listing
        else:
            manifest = self._fetch(chosen, prefix, listing, traffic)
            name = manifest.id
            try:
                run = run_smoke(self.folder.versions.incoming / name, manifest, self.settings.isolation)
            except PolicyRefused:
                shutil.rmtree(self.folder.versions.incoming / name)
                raise
            p99_ms = run.p99_ms
            self.folder.install(name, run.isolation)
        if not self.may_activate():
            return SyncResult(name, self.folder.current(), 'waiting', p99_ms, traffic.fetched_bytes, traffic.restarted_files)
        if pinned := self.folder.activate(name):
            return SyncResult(pinned, self.folder.current(), 'pinned', p99_ms, traffic.fetched_bytes, traffic.restarted_files)
        log.info('the policy %s is active', name)
        self.folder.clean(self.settings.keep)
        return SyncResult(name, name, 'activated', p99_ms, traffic.fetched_bytes, traffic.restarted_files)

    # -- download --------------------------------------------------------------------------------------------------

    def _fetch(self, chosen: RegisteredVersion, prefix: str, listing: trust.Trust, traffic: _Traffic) -> PolicyManifest:
        """Download a version to ``incoming`` and verify it, except for the smoke run."""
        state, wanted = self.folder.state.read(), f'{chosen.name}@{chosen.version}'
        target = listing.listed(trust.target_of(self.settings.robot_type, chosen.name, chosen.version))
        if target is None:
            raise PolicyRefused('unlisted', f'no authorized signer lists {wanted} for a {self.settings.robot_type}',
                                remedy='run policy publish, then policy refresh on the machine with online.key')  # fmt: skip
        content = self._get(f'{prefix}/{MANIFEST}', min(target.length, MAX_MANIFEST_BYTES), traffic)
        if len(content) != target.length or hashlib.sha256(content).hexdigest() != target.hashes.get('sha256'):
            raise PolicyRefused('damaged', f'{prefix}/{MANIFEST} is not the one that was signed')
        manifest = parse_manifest(content)
        if f'{manifest.name}@{manifest.version}' != wanted:
            raise PolicyRefused('source', f'according to the registry {prefix} has {wanted}, but it has {manifest.id}')
        if self.settings.robot_type not in manifest.robot_types:
            types = ', '.join(manifest.robot_types)
            raise PolicyRefused('robot_type', f'{manifest.id} is for {types}, but this robot is a {self.settings.robot_type}')
        if manifest.id not in state.verified and manifest.version < (newest := newest_of(state, manifest.name)):
            raise PolicyRefused('old', f'{manifest.id} was never verified here and is older than version {newest}, which was',
                                remedy='policy use or rollback activates a version that was on this robot')  # fmt: skip
        if manifest.id in state.bad:
            raise PolicyRefused('bad', f'{manifest.id} was rolled back here: {state.bad[manifest.id]}')
        place = self._incoming(manifest)
        self._check_disk(manifest, place)
        for file in manifest.files:
            self._download(ObjectInfo(BUCKET, f'{prefix}/{file.path}', file.size, file.sha256), place / file.path, traffic)
        (place / MANIFEST).write_bytes(content)
        return self.folder.check(manifest.id, state, folder=place)

    def _get(self, key: str, limit: int, traffic: _Traffic) -> bytes:
        try:
            content = with_retries(lambda: self.store.get(BUCKET, key, limit), pause=self.pause)
        except ObjectRefused as error:
            reason = 'size' if error.data.get('reason') == 'size' else 'missing'
            raise PolicyRefused(reason, f'{error.what}') from error
        traffic.count(len(content))
        return content

    def _incoming(self, manifest: PolicyManifest) -> Path:
        """The folder of a download, which continues an interrupted one of the same version. Deletes everything else."""
        place = self.folder.versions.incoming / manifest.id
        for other in self.folder.versions.incoming.iterdir():
            if other != place or not _is_begun(place, manifest):
                _remove(other)
        place.mkdir(mode=0o700, exist_ok=True)
        return place

    def _check_disk(self, manifest: PolicyManifest, place: Path) -> None:
        used = sum(_size(self.folder.versions.path / name) for name in self.folder.versions.ids())
        if manifest.size <= self.settings.max_bytes < used + manifest.size:
            self.folder.clean(1)
            used = sum(_size(self.folder.versions.path / name) for name in self.folder.versions.ids())
        free = shutil.disk_usage(place).free + _size(place) - self.settings.min_free_bytes
        available = min(free, self.settings.max_bytes - used)
        if manifest.size > available:
            text = f'{manifest.id} has {manifest.size:,} bytes, but {self.folder.path} may use only {max(0, available):,} more'
            raise PolicyRefused('disk', text, remedy='free space, or change --max-bytes and --min-free-bytes')

    def _download(self, wanted: ObjectInfo, path: Path, traffic: _Traffic) -> None:
        """Download a file, and continue after interruptions as long as each attempt makes progress. Skips a complete file.

        Gives up on a store that sends damaged data and then disconnects, after discarding the file twice.
        """
        if path.is_file() and durable_files.fingerprint(path) == (wanted.size, wanted.sha256):
            return
        fetched_before, max_restarted = -1, traffic.restarted_files + 1
        while True:
            try:
                download(self.store, wanted, path, on_progress=traffic.count, pause=self.pause)
                return
            except StoreUnavailable:
                if traffic.fetched_bytes <= fetched_before or traffic.restarted_files > max_restarted:
                    raise
                fetched_before = traffic.fetched_bytes
            except ObjectRefused as error:
                reason = 'damaged' if error.data.get('reason') == 'damaged' else 'missing'
                raise PolicyRefused(reason, f'{error.what}: {error.data.get("why", "")}') from error

    def _ensure_tested(self, name: str) -> None:
        """Repeat the smoke run of an installed version if it had less isolation than is required now."""
        state = self.folder.state.read()
        if not is_enough(state.verified.get(name), self.settings.isolation):
            manifest = self.folder.check(name, state)
            run = run_smoke(self.folder.versions.path / name, manifest, self.settings.isolation)
            self.folder.record_smoke_run(name, run.isolation)


def _is_folder(path: Path) -> bool:
    """Whether it is a folder and not a link to one."""
    return path.is_dir() and not path.is_symlink()


def _remove(path: Path) -> None:
    """Delete a file, link or folder."""
    if _is_folder(path):
        shutil.rmtree(path)
    else:
        path.unlink()


def _is_begun(place: Path, manifest: PolicyManifest) -> bool:
    """Whether the folder contains only files of this download."""
    names = {file.path for file in manifest.files}
    names |= {MANIFEST, *(f'{name}{UNFINISHED}' for name in names)}
    try:
        return _is_folder(place) and names.issuperset(files_of(place)) and not any((place / name).is_dir() for name in names)
    except PolicyRefused:
        return False


class _Traffic:
    """Counts the downloaded bytes of one sync, and limits the bandwidth."""

    def __init__(self, max_mbps: float, pause: Callable[[float], object], monotonic: Callable[[], float]) -> None:
        self._bytes_s = max_mbps * BYTES_PER_MEGABIT
        self._pause = pause
        self._now = monotonic
        self._free_at = monotonic()
        self.fetched_bytes = 0
        self.restarted_files = 0

    def count(self, size: int) -> None:
        """Count downloaded bytes, and wait as long as the limit requires. A negative size: a partial file was discarded."""
        if size < 0:
            self.restarted_files += 1
            return
        self.fetched_bytes += size
        if self._bytes_s and size:
            now, takes_s = self._now(), size / self._bytes_s
            self._free_at = max(self._free_at, now - MAX_CATCH_UP_S - 2.0 * takes_s) + takes_s
            if self._free_at > now:
                self._pause(self._free_at - now)


def _size(folder: Path) -> int:
    """The total bytes of the files in a folder."""
    return sum(os.lstat(os.path.join(parent, name)).st_size for parent, _, names in os.walk(folder) for name in names)  # noqa: PTH118
