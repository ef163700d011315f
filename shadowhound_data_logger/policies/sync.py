"""The robot follows the registry: asks which version to run, fetches it, verifies it, tries it, and activates it.

Whatever fails leaves what is active as it is. One process does this at a time (``sync.lock``); a rollback need not wait for it.
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
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.policies import trust
from shadowhound_data_logger.policies.content import files_of
from shadowhound_data_logger.policies.folder import PolicyFolder, newest_of
from shadowhound_data_logger.policies.manifest import (
    BUCKET,
    MANIFEST,
    MOST_MANIFEST_BYTES,
    PolicyManifest,
    parse_manifest,
    split_id,
)
from shadowhound_data_logger.policies.registry import PolicyRegistry, RegisteredVersion, choose, folder_of
from shadowhound_data_logger.policies.smoke import SANDBOX, SmokeRun, is_enough, run_smoke
from shadowhound_data_logger.stores.bandwidth import BYTES_PER_MEGABIT
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import UNFINISHED, download

log = logging.getLogger(__name__)

REFUSED_AGAIN_S: Final = 3600.0
"""A version that was refused is not fetched again sooner: a smoke run may have been slow because the machine was busy."""
ASKED_AGAIN: Final = frozenset({'unlisted', 'untrusted', 'expired', 'clock'})
"""Reasons that end when a signer does something, and cost no download."""
LATE_S: Final = 0.1
"""So much of the cap, and the time of two pieces, may be caught up with: while one arrives, no other is asked for."""


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
    isolation: str = SANDBOX
    """The least that a smoke run has to be in (``smoke.ISOLATIONS``): a version that was run in less is not activated."""


@dataclass(frozen=True, slots=True)
class SyncResult:
    """What one look at the registry came to."""

    wanted: str
    """``NAME@7``, or an id where it is known; empty where nobody says."""
    active: str | None
    done: str
    """``unchanged`` ``activated`` ``waiting`` (a mission is active) ``pinned`` ``none``, or ``withdrawn``: no signer lists any
    longer what was active, and it is not active now."""
    p99_ms: float | None = None
    """Of the smoke run, where there was one."""
    fetched_bytes: int = 0
    """That arrived, repeats among them."""
    begun_anew: int = 0
    """Files of which what had arrived was thrown away: it was damaged, or the object changed meanwhile."""
    stale: str = ''
    """Why no new version is taken now; empty where one would be."""
    isolation: str | None = None
    """In which the active version was tried (``smoke.ISOLATIONS``)."""


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
    monotonic: Callable[[], float] = time.monotonic
    wall_ns: Callable[[], int] = time.time_ns
    _refused: dict[str, tuple[float, PolicyRefused]] = field(default_factory=dict)

    def run(self, *, again: bool = True) -> SyncResult:
        """One look, and what follows from it. Raises DataLoggerError and OSError; what is active is as it was then.

        A version that was refused within the last hour is refused again, without a look at it, unless ``again``.
        """
        self.folder.make()
        with durable_files.flock(self.folder.path / 'sync.lock', wait=False) as is_ours:
            if not is_ours:
                raise PolicyError('another process is looking for policies here', remedy='wait until it is done')
            self._end_rollback()
            traffic = _Traffic(self.settings.max_mbps, self.pause, self.monotonic)
            listing = self._listing(traffic)
            if isinstance(listing, trust.Trust):
                if self.folder.withdraw(self._withdrawn(listing)):
                    log.warning('no signer lists the policy that was active any longer; active is %s', self.folder.current())
                    return self._finished(SyncResult('', self.folder.current(), 'withdrawn'))
                if why := trust.why_stale(self.folder.path, self.wall_ns()):
                    listing = PolicyRefused('clock', why)
            result = self._followed(listing, traffic, again=again)
            return self._finished(result if isinstance(listing, trust.Trust) else replace(result, stale=f'{listing}'))

    def _finished(self, result: SyncResult) -> SyncResult:
        return replace(result, isolation=self.folder.state().verified.get(result.active) if result.active else None)

    def _listing(self, traffic: _Traffic) -> trust.Trust | DataLoggerError:
        """What signers list, or why that cannot be verified: then no new version is taken."""
        try:
            return trust.refresh(self.folder.path, self.store, traffic.count, self.pause)
        except PolicyRefused as error:
            why = trust.why_stale(self.folder.path, self.wall_ns()) if error.reason == 'expired' else ''
            return PolicyRefused('expired', why) if why else error
        except DataLoggerError as error:
            return error

    def _withdrawn(self, listing: trust.Trust) -> list[str]:
        """What was verified here and is listed no longer. Where that cannot be said, all stays as it is."""
        state = self.folder.state()
        return [name for name in sorted({*state.verified, *self.folder.installed()})
                if not self._is_listed(listing, name, unknown=name not in state.withdrawn)]  # fmt: skip

    def _is_listed(self, listing: trust.Trust, name: str, *, unknown: bool) -> bool:
        policy, version, sha256 = split_id(name) or ('', 0, '')
        try:
            target = listing.listed(trust.target_of(self.settings.robot_type, policy, version))
        except DataLoggerError as error:
            log.warning('whether %s is listed is unknown: %s', name, error)
            return unknown
        return target is not None and target.hashes.get('sha256', '').startswith(sha256)

    def _followed(self, listing: trust.Trust | DataLoggerError, traffic: _Traffic, *, again: bool) -> SyncResult:
        state = self.folder.state()
        if state.pin is not None:
            if state.pin != self.folder.current():
                if not self.may_activate():
                    return SyncResult(state.pin, self.folder.current(), 'waiting')
                self._ensure_tried(state.pin)
                self.folder.activate(state.pin)
            return SyncResult(state.pin, self.folder.current(), 'pinned')
        chosen = choose(self.registry, self.settings.name, self.settings.robot)
        if chosen is None:
            return SyncResult('', self.folder.current(), 'none')
        return self._follow(chosen, listing, traffic, again=again)

    def _end_rollback(self) -> None:
        """What was rolled back and is active all the same: that was cut off."""
        state, now = self.folder.state(), self.folder.current()
        if now in state.bad:
            self.folder.roll_back(state.bad[now], of=now)

    def _follow(self, chosen: RegisteredVersion, listing: trust.Trust | DataLoggerError, traffic: _Traffic, *, again: bool
                ) -> SyncResult:  # fmt: skip
        wanted = f'{chosen.name}@{chosen.version}'
        prefix = folder_of(chosen, self.settings.name)
        now = self.folder.current()
        if now is not None and now.partition('#')[0] == wanted:
            self.folder.check(now, self.folder.state(), hashes=False)
            return SyncResult(now, now, 'unchanged')
        since, refusal = self._refused.get(wanted, (float('-inf'), None))
        if refusal is not None and not again and self.monotonic() - since < REFUSED_AGAIN_S:
            raise refusal
        known = [name for name in self.folder.installed() if name.partition('#')[0] == wanted]
        try:
            return self._take(chosen, prefix, known, listing, traffic)
        except PolicyRefused as error:
            if error.reason not in ASKED_AGAIN:
                self._refused[wanted] = self.monotonic(), error
            raise

    def _take(self, chosen: RegisteredVersion, prefix: str, known: Sequence[str], listing: trust.Trust | DataLoggerError,
              traffic: _Traffic) -> SyncResult:  # fmt: skip
        p99_ms = None
        if known:
            name = known[0]
            self._ensure_tried(name)
        elif isinstance(listing, DataLoggerError):
            raise listing
        else:
            manifest = self._fetch(chosen, prefix, listing, traffic)
            name = manifest.id
            run = self._try(manifest)
            p99_ms = run.p99_ms
            self.folder.install(name, run.isolation)
        if not self.may_activate():
            return SyncResult(name, self.folder.current(), 'waiting', p99_ms, traffic.fetched_bytes, traffic.begun_anew)
        if pinned := self.folder.activate(name):
            return SyncResult(pinned, self.folder.current(), 'pinned', p99_ms, traffic.fetched_bytes, traffic.begun_anew)
        log.info('the policy %s is active', name)
        self.folder.clean(self.settings.keep)
        return SyncResult(name, name, 'activated', p99_ms, traffic.fetched_bytes, traffic.begun_anew)

    # -- what came -------------------------------------------------------------------------------------------------

    def _fetch(self, chosen: RegisteredVersion, prefix: str, listing: trust.Trust, traffic: _Traffic) -> PolicyManifest:
        """The whole version into ``incoming``, verified as far as it can be without running it."""
        state, wanted = self.folder.state(), f'{chosen.name}@{chosen.version}'
        target = listing.listed(trust.target_of(self.settings.robot_type, chosen.name, chosen.version))
        if target is None:
            raise PolicyRefused('unlisted', f'no signer who may lists {wanted} for a {self.settings.robot_type}',
                                remedy='policy publish lists it, then policy refresh, where online.key is')  # fmt: skip
        content = self._get(f'{prefix}/{MANIFEST}', min(target.length, MOST_MANIFEST_BYTES), traffic)
        if len(content) != target.length or hashlib.sha256(content).hexdigest() != target.hashes.get('sha256'):
            raise PolicyRefused('damaged', f'{prefix}/{MANIFEST} is not the one that was signed')
        manifest = parse_manifest(content)
        if f'{manifest.name}@{manifest.version}' != wanted:
            raise PolicyRefused('source', f'the registry says that {wanted} is at {prefix}, and {manifest.id} is there')
        if self.settings.robot_type not in manifest.robot_types:
            types = ', '.join(manifest.robot_types)
            raise PolicyRefused('robot_type', f'{manifest.id} is for {types}, and this is a {self.settings.robot_type}')
        if manifest.id not in state.verified and manifest.version < newest_of(state, manifest.name):
            raise PolicyRefused('old', f'{manifest.id} was never verified here, and {newest_of(state, manifest.name)} was',
                                remedy='a version that was on this robot comes back by policy use or rollback')  # fmt: skip
        if manifest.id in state.bad:
            raise PolicyRefused('bad', f'{manifest.id} was taken out here: {state.bad[manifest.id]}')
        place = self._incoming(manifest)
        self._check_room(manifest, place)
        for file in manifest.files:
            self._download(ObjectInfo(BUCKET, f'{prefix}/{file.path}', file.size, file.sha256), place / file.path, traffic)
        (place / MANIFEST).write_bytes(content)
        return self.folder.check(manifest.id, state, folder=place)

    def _get(self, key: str, most: int, traffic: _Traffic) -> bytes:
        try:
            content = steadily(lambda: self.store.get(BUCKET, key, most), pause=self.pause)
        except ObjectRefused as error:
            reason = 'size' if error.data.get('reason') == 'size' else 'missing'
            raise PolicyRefused(reason, f'{error.what}') from error
        traffic.count(len(content))
        return content

    def _incoming(self, manifest: PolicyManifest) -> Path:
        """The folder of a download, which goes on where an earlier one of the same version ended; whatever else is there goes."""
        place = self.folder.incoming / manifest.id
        for other in self.folder.incoming.iterdir():
            if other != place or not _is_begun(place, manifest):
                _remove(other)
        place.mkdir(mode=0o700, exist_ok=True)
        return place

    def _check_room(self, manifest: PolicyManifest, place: Path) -> None:
        there = sum(_size(self.folder.versions / name) for name in self.folder.installed())
        if manifest.size <= self.settings.max_bytes < there + manifest.size:
            self.folder.clean(1)
            there = sum(_size(self.folder.versions / name) for name in self.folder.installed())
        free = shutil.disk_usage(place).free + _size(place) - self.settings.min_free_bytes
        room = min(free, self.settings.max_bytes - there)
        if manifest.size > room:
            text = f'{manifest.id} has {manifest.size:,} bytes, and there is room for {max(0, room):,} in {self.folder.path}'
            raise PolicyRefused('disk', text, remedy='--max-bytes and --min-free-bytes limit what policies may take')

    def _download(self, wanted: ObjectInfo, path: Path, traffic: _Traffic) -> None:
        """Goes on for as long as each attempt brings something; what an earlier one brought whole is not fetched again.

        Not for ever: of a store that damages what it sends, and then breaks off, not more than twice the file is thrown away.
        """
        if path.is_file() and durable_files.fingerprint(path) == (wanted.size, wanted.sha256):
            return
        had, most_anew = -1, traffic.begun_anew + 1
        while True:
            try:
                download(self.store, wanted, path, tell=traffic.count, pause=self.pause)
                return
            except StoreUnavailable:
                if traffic.fetched_bytes <= had or traffic.begun_anew > most_anew:
                    raise
                had = traffic.fetched_bytes
            except ObjectRefused as error:
                reason = 'damaged' if error.data.get('reason') == 'damaged' else 'missing'
                raise PolicyRefused(reason, f'{error.what}: {error.data.get("why", "")}') from error

    def _ensure_tried(self, name: str) -> None:
        """Try a version again that is here, where its smoke run was in less isolation than is required now."""
        state = self.folder.state()
        if not is_enough(state.verified.get(name), self.settings.isolation):
            manifest = self.folder.check(name, state)
            run = run_smoke(self.folder.versions / name, manifest, self.settings.isolation)
            self.folder.note_tried(name, run.isolation)

    def _try(self, manifest: PolicyManifest) -> SmokeRun:
        try:
            return run_smoke(self.folder.incoming / manifest.id, manifest, self.settings.isolation)
        except PolicyRefused:
            shutil.rmtree(self.folder.incoming / manifest.id)
            raise


def _is_folder(path: Path) -> bool:
    """And no link to one."""
    return path.is_dir() and not path.is_symlink()


def _remove(path: Path) -> None:
    """Whatever it is."""
    if _is_folder(path):
        shutil.rmtree(path)
    else:
        path.unlink()


def _is_begun(place: Path, manifest: PolicyManifest) -> bool:
    """Whether what is there is of this download and nothing else."""
    names = {file.path for file in manifest.files}
    names |= {MANIFEST, *(f'{name}{UNFINISHED}' for name in names)}
    try:
        return _is_folder(place) and names.issuperset(files_of(place)) and not any((place / name).is_dir() for name in names)
    except PolicyRefused:
        return False


class _Traffic:
    """What arrives for one look: counted, and kept to the cap, which it reaches where the line carries more."""

    def __init__(self, max_mbps: float, pause: Callable[[float], object], monotonic: Callable[[], float]) -> None:
        self._bytes_s = max_mbps * BYTES_PER_MEGABIT
        self._pause = pause
        self._now = monotonic
        self._free_at = monotonic()
        self.fetched_bytes = 0
        self.begun_anew = 0

    def count(self, size: int) -> None:
        """So many bytes arrived, or were thrown away."""
        if size < 0:
            self.begun_anew += 1
            return
        self.fetched_bytes += size
        if self._bytes_s and size:
            now, takes_s = self._now(), size / self._bytes_s
            self._free_at = max(self._free_at, now - LATE_S - 2.0 * takes_s) + takes_s
            if self._free_at > now:
                self._pause(self._free_at - now)


def _size(folder: Path) -> int:
    """Bytes of the files in it."""
    return sum(os.lstat(os.path.join(parent, name)).st_size for parent, _, names in os.walk(folder) for name in names)  # noqa: PTH118
