"""The versions of policies on a robot's disk: complete, verified and read-only."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
from pathlib import Path

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.policies.content import check_files
from shadowhound_data_logger.policies.manifest import MANIFEST, MAX_MANIFEST_BYTES, PolicyManifest, parse_manifest, split_id


class Versions:
    """The folders ``versions`` and ``incoming``. Stateless; any number of processes may use them."""

    def __init__(self, policies: Path) -> None:
        self.path = policies / 'versions'
        self.incoming = policies / 'incoming'

    def ids(self) -> list[str]:
        """The ids of all installed versions, by name and number."""
        names = [path.name for path in self.path.iterdir()] if self.path.is_dir() else []
        return sorted((name for name in names if split_id(name)), key=lambda name: split_id(name) or ('', 0, ''))

    def find(self, wanted: str) -> str:
        """The id of the installed version with this id or ``NAME@7``. Raises PolicyError."""
        found = [name for name in self.ids() if name == wanted or name.partition('#')[0] == wanted]
        if len(found) != 1:
            problem = f'{wanted!r} matches {len(found)} versions' if found else f'version {wanted!r} is not on this robot'
            raise PolicyError(problem, remedy='policy list shows the versions on this robot')
        return found[0]

    def check(self, name: str, folder: Path | None = None, *, hashes: bool = True) -> PolicyManifest:
        """The manifest of a version, by default the installed one. Checks that it has exactly its files.

        Raises PolicyRefused. Without ``hashes`` only the sizes of the files are checked.
        """
        folder = folder or self.path / name
        content = read_file(folder / MANIFEST, MAX_MANIFEST_BYTES)
        if not hashlib.sha256(content).hexdigest().startswith(name.partition('#')[2]):
            raise PolicyRefused('damaged', f'the SHA-256 of {MANIFEST} of {name} does not match the id')
        manifest = parse_manifest(content)
        if manifest.id != name:
            raise PolicyRefused('damaged', f'the folder of {name} contains the policy {manifest.id}')
        check_files(folder, manifest, hashes=hashes)
        return manifest

    def seal(self, name: str) -> None:
        """Make the files of a version in ``incoming`` durable and read-only."""
        for parent, _, files in os.walk(self.incoming / name):
            for file in files:
                path = Path(parent, file)
                durable_files.sync(path)
                path.chmod(0o400)
            durable_files.sync(Path(parent))

    def add(self, name: str) -> None:
        """Move a sealed version from ``incoming`` to ``versions``."""
        os.replace(self.incoming / name, self.path / name)
        durable_files.sync(self.path)

    def set_aside(self, name: str) -> bool:
        """Move a version out of ``versions``, to be deleted later; False if a process is using it (``running.active``)."""
        descriptor = os.open(self.path / name, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            if not durable_files.lock(descriptor, wait=False):
                return False
            os.replace(self.path / name, self._aside(name))
        finally:
            os.close(descriptor)
        return True

    def delete(self, name: str) -> None:
        """Delete a version that was set aside."""
        shutil.rmtree(self._aside(name))

    def _aside(self, name: str) -> Path:
        return self.incoming / f'{name}.gone'


def read_file(path: Path, limit: int) -> bytes:
    """Read a regular file of at most ``limit`` bytes. Raises PolicyRefused (``link``, ``size``), FileNotFoundError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise PolicyRefused('link', f'{path} is not a regular file: {error.strerror}') from error
    with os.fdopen(descriptor, 'rb') as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise PolicyRefused('link', f'{path} is not a regular file')
        content = file.read(limit + 1)
    if len(content) > limit:
        raise PolicyRefused('size', f'{path} has more than {limit:,} bytes')
    return content
