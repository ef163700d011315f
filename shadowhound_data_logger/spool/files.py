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
import logging
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.model import State

log = logging.getLogger(__name__)

ATTRIBUTE: Final = 'user.shadowhound'
_NO_ATTRIBUTES: Final = frozenset({errno.ENOTSUP, errno.EPERM, errno.E2BIG, errno.ERANGE, errno.ENOSPC, errno.EDQUOT})
"""Why a file goes without a description. ext4 says ENOSPC for one of more than a block; a disk that is full says it
of the bytes, too.
"""
_UNSAFE: Final = re.compile(r'^\.+|[^A-Za-z0-9_.-]+')
_PART: Final = re.compile(r'[1-9][0-9]{0,17}\.part')
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

    def session(self, number: int) -> Path:
        """The file that a live session keeps locked."""
        return self.root / 'sessions' / str(number)

    def part(self, number: int) -> Path:
        return self.incoming / f'{number}.part'

    def path(self, state: State, reason: str | None, bucket: str, key: str) -> Path:
        """Where the bytes of an object in this state lie; they lie nowhere once it is delivered or evicted."""
        reasons = () if state is State.PENDING else (_UNSAFE.sub('_', reason or '') or 'unknown',)
        return self.root.joinpath(_FOLDERS[state], *reasons, bucket, key)

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
        """Rename, making the folders it takes; False when the file is not at its target now.

        Never raises OSError, since the row is committed: someone else placed or removed the source, or the way is barred
        (no space for a folder, a file where a folder has to be) and it stays where it is.
        """
        try:
            os.replace(source, target)
        except FileNotFoundError:
            if not source.exists():
                return False
            try:
                target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                os.replace(source, target)
            except OSError as error:
                log.warning('cannot move %s to %s: %s', source, target, error)
                return False
        except OSError as error:
            log.warning('cannot move %s to %s: %s', source, target, error)
            return False
        return True

    def remove(self, path: Path) -> None:
        """Unlink; never raises OSError, since recovery removes what stays."""
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            log.warning('cannot remove %s: %s', path, error)

    def set_aside(self, path: Path) -> None:
        """Move a file that is none of the spool's to ``foreign/``, over no other one."""
        target = wanted = self.root / 'foreign' / path.relative_to(self.root)
        number = 0
        while os.path.lexists(target):
            number += 1
            target = wanted.with_name(f'{wanted.name}.{number}')
        self.place(path, target)

    @staticmethod
    def size(path: Path) -> int | None:
        """Bytes of a regular file; None where none lies (nothing, a folder, a link)."""
        try:
            status = path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        return status.st_size if stat.S_ISREG(status.st_mode) else None

    def parts(self) -> Iterator[tuple[int, Path]]:
        """(object id, path) of every part; whatever else lies in incoming is not ours."""
        for path in sorted(self.incoming.iterdir()):
            if _PART.fullmatch(path.name) and self.size(path) is not None:
                yield int(path.stem), path

    def objects(self) -> Iterator[tuple[State, str | None, str, str, Path]]:
        """(state, reason, bucket, key, path) of every regular file that lies where objects lie."""
        for state, name in _FOLDERS.items():
            folder = self.root / name
            depth = 1 if state is State.PENDING else 2
            for parent, _, names in os.walk(folder):
                relative = Path(parent).relative_to(folder).parts
                for file in names:
                    path = Path(parent, file)
                    if len(relative) >= depth and self.size(path) is not None:
                        reason = None if depth == 1 else relative[0]
                        yield state, reason, relative[depth - 1], '/'.join((*relative[depth:], file)), path

    def prune(self) -> None:
        """Remove empty folders of past days."""
        for name in _FOLDERS.values():
            for parent, _, _ in os.walk(self.root / name, topdown=False):
                if Path(parent) != self.root / name:
                    with suppress(OSError):  # not empty, or not ours to remove
                        os.rmdir(parent)

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
    """What ``describe`` attached, empty when there is none, it cannot be read or it is not ours."""
    try:
        found = json.loads(os.getxattr(path, ATTRIBUTE))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
