"""The active policy, for the program that runs it: verified files that stay on disk, and reports of failures and latency."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import config, durable_files
from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.manifest import PolicyManifest

WINDOW: Final = 100
"""Number of steps over which failures and latency are measured."""
MIN_STEPS: Final = 20
"""With fewer steps the p99 is not checked."""


@dataclass(slots=True)
class ActivePolicy:
    """A verified version of a policy, which stays on disk until the ``with`` block of ``active`` ends. For one thread."""

    id: str
    """Such as ``go2_patrol@7#0123456789abcdef``."""
    path: Path
    """Its folder, with the files that the manifest names. They were verified when it was opened."""
    manifest: PolicyManifest
    _folder: PolicyFolder
    _steps: deque[tuple[bool, float]] = field(default_factory=lambda: deque(maxlen=WINDOW))

    @property
    def model(self) -> Path:
        """The path of the model file."""
        return self.path / self.manifest.model

    def is_current(self) -> bool:
        """Whether this version is still active. If not, leave the ``with`` block and call ``active`` again."""
        return self._folder.current() == self.id

    def report(self, latency_s: float, *, failed: bool = False) -> bool:
        """Report one step of the policy.

        Args:
            latency_s: how long it took.
            failed: whether it failed.

        Returns:
            Whether the policy may continue. A policy that exceeds the limits of its manifest is rolled back before this returns.
        """
        self._steps.append((failed, latency_s * 1000.0))
        failures = sum(failed for failed, _ in self._steps)
        slowest = sorted(ms for _, ms in self._steps)
        p99_ms = slowest[int(0.99 * (len(slowest) - 1))] if len(slowest) >= MIN_STEPS else 0.0
        return judge(self._folder, self.id, self.manifest, failures, p99_ms)


def judge(folder: PolicyFolder, name: str, manifest: PolicyManifest, failures: int, p99_ms: float) -> bool:
    """Whether a policy keeps its limits; otherwise roll it back, after which only ``policy use`` activates it again."""
    why = ''
    if failures > manifest.failures:
        why = f'{failures} steps failed, allowed are {manifest.failures}'
    elif not p99_ms <= manifest.p99_ms:
        why = f'a step took {p99_ms:.1f} ms (p99), allowed are {manifest.p99_ms:g} ms'
    if why:
        folder.roll_back(why, of=name)
    return not why


@contextmanager
def active(home: str | os.PathLike[str] | None = None, environ: Mapping[str, str] = os.environ) -> Iterator[ActivePolicy]:
    """The active policy as a context manager. Verifies all hashes again, and keeps the files on disk until the block ends.

    Args:
        home: the folder; by default SHADOWHOUND_HOME.
        environ: the environment variables.

    Raises:
        PolicyError: no policy is active.
        PolicyRefused: the files are not those that were signed.
    """
    folder = PolicyFolder(config.home({'SHADOWHOUND_HOME': os.fspath(home)} if home else environ))
    while True:
        name = folder.current()
        if name is None:
            raise PolicyError(f'no policy is active in {folder.path}')
        try:
            descriptor = os.open(folder.versions.path / name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            if folder.current() == name:
                raise
            continue
        try:
            durable_files.lock(descriptor, shared=True)
            if os.fstat(descriptor).st_nlink and (folder.versions.path / name).exists():
                folder.check_owner()
                manifest = folder.check(name, folder.state.read())
                yield ActivePolicy(name, folder.versions.path / name, manifest, folder)
                return
        finally:
            os.close(descriptor)
