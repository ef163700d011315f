"""The spool's tree: where a file lies says what it is. ``ready/<bucket>/<key>`` can be rescued with ``aws s3 sync``.

    incoming/<id>.part                 written and synced, its row not yet committed or its rename not yet done
    ready/<bucket>/<key>               waits for delivery under its final name
    held/<reason>/<bucket>/<key>       has no final name yet
    quarantine/<reason>/<bucket>/<key> will not be delivered as it is

Each file carries its description as the extended attribute ``user.shadowhound`` where the file system has such, so that
a lost index can be rebuilt from the tree.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.model import State

ATTRIBUTE: Final = 'user.shadowhound'
_NO_ATTRIBUTES: Final = frozenset({errno.ENOTSUP, errno.EPERM, errno.ENODATA, errno.E2BIG, errno.ERANGE})
_FOLDERS: Final = {State.PENDING: 'ready', State.HELD: 'held', State.QUARANTINED: 'quarantine'}


class Tree:
    """Paths and file operations below one spool folder; no state of its own."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.incoming = root / 'incoming'

    def create(self) -> None:
        """The folders, readable by their owner alone: sensor data is nobody else's business."""
        self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in ('incoming', 'sessions', *_FOLDERS.values()):
            (self.root / name).mkdir(mode=0o700, exist_ok=True)

    def part(self, number: int) -> Path:
        return self.incoming / f'{number}.part'

    def path(self, state: State, reason: str | None, bucket: str, key: str) -> Path:
        """Where the bytes of an object in this state lie; they lie nowhere once it is delivered or evicted."""
        folder = self.root / _FOLDERS[state]
        return (folder / bucket / key) if state is State.PENDING else (folder / (reason or 'unknown') / bucket / key)

    def write_part(self, number: int, body: bytes, description: Mapping[str, Any]) -> None:
        """Write and sync the bytes; raises OSError (a full disk, say) and then leaves nothing behind."""
        path = self.part(number)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        try:
            with os.fdopen(descriptor, 'wb') as file:
                file.write(body)
                describe(file.fileno(), description)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            path.unlink(missing_ok=True)
            raise

    def sync_incoming(self) -> None:
        """Make the names of the written parts durable."""
        descriptor = os.open(self.incoming, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def place(self, source: Path, target: Path) -> bool:
        """Rename, making the folders it takes; False when there is no source (someone else placed it)."""
        try:
            os.replace(source, target)
        except FileNotFoundError:
            target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            try:
                os.replace(source, target)
            except FileNotFoundError:
                return False
        return True

    def remove(self, path: Path) -> None:
        path.unlink(missing_ok=True)

    def parts(self) -> Iterator[tuple[int, Path]]:
        """(object id, path) of everything in incoming; -1 for a name that is none of ours."""
        for path in sorted(self.incoming.iterdir()):
            yield (int(path.stem) if path.suffix == '.part' and path.stem.isdecimal() else -1), path

    def objects(self) -> Iterator[tuple[State, str | None, str, str, Path]]:
        """(state, reason, bucket, key, path) of every regular file that lies where objects lie."""
        for state, name in _FOLDERS.items():
            folder = self.root / name
            depth = 1 if state is State.PENDING else 2
            for parent, _, names in os.walk(folder):
                relative = Path(parent).relative_to(folder).parts
                for file in names:
                    path = Path(parent, file)
                    if len(relative) >= depth and path.is_file() and not path.is_symlink():
                        reason = None if depth == 1 else relative[0]
                        yield state, reason, relative[depth - 1], '/'.join((*relative[depth:], file)), path

    def prune(self) -> None:
        """Remove empty folders of past days."""
        for name in _FOLDERS.values():
            for parent, _, _ in os.walk(self.root / name, topdown=False):
                if Path(parent) != self.root / name:
                    try:
                        os.rmdir(parent)
                    except OSError as error:
                        if error.errno not in {errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT}:
                            raise

    def free_bytes(self) -> int:
        """What an unprivileged writer may still use of the file system."""
        status = os.statvfs(self.root)
        return status.f_bavail * status.f_frsize


def describe(target: int | Path, description: Mapping[str, Any]) -> None:
    """Attach a description to a file; where the file system has no attributes the index alone knows it."""
    try:
        os.setxattr(target, ATTRIBUTE, json.dumps(description).encode())
    except OSError as error:
        if error.errno not in _NO_ATTRIBUTES:
            raise


def description_of(path: Path) -> dict[str, Any]:
    """What ``describe`` attached, empty when there is none or it is not ours."""
    try:
        found = json.loads(os.getxattr(path, ATTRIBUTE))
    except OSError as error:
        if error.errno not in _NO_ATTRIBUTES:
            raise
        return {}
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
