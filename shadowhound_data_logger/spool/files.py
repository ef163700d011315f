"""The spool's tree, in which a file's folder shows its state. ``ready/`` can be rescued with ``aws s3 sync``.

    incoming/<session>-<any>.body      staged: written, synced and about to become a part (new_objects.py)
    incoming/<id>.part                 its row is not committed, or its rename not done
    ready/<bucket>/<key>               pending under its final name
    held/<reason>/<bucket>/<key>       has no final name yet
    quarantine/<reason>/<bucket>/<key> cannot be delivered
    kept/<bucket>/<key>                stays on the robot until it is requested

If the file system supports extended attributes, each file has its description in ``user.shadowhound``, from which a lost index
can be rebuilt.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import re
import stat
import uuid
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.model import DataObject, FileBody, State

log = logging.getLogger(__name__)

ATTRIBUTE: Final = 'user.shadowhound'
_NO_ATTRIBUTES: Final = frozenset({errno.ENOTSUP, errno.EPERM, errno.E2BIG, errno.ERANGE, errno.ENOSPC, errno.EDQUOT})
"""A file without a description is acceptable after these errors. ext4 reports ENOSPC for an attribute larger than a block; on a
full disk, writing the content fails with ENOSPC, too.
"""
_UNSAFE: Final = re.compile(r'^\.+|[^A-Za-z0-9_.-]+')
_PART: Final = re.compile(r'[1-9][0-9]{0,17}\.part')
_BODY: Final = re.compile(r'([1-9][0-9]{0,17})-[0-9a-f]{32}\.body')
_FOLDERS: Final = {State.PENDING: 'ready', State.HELD: 'held', State.QUARANTINED: 'quarantine', State.KEPT: 'kept'}
_WITHOUT_REASON: Final = frozenset({State.PENDING, State.KEPT})


class Tree:
    """The paths of objects in a spool folder, and operations on their files; stateless."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.incoming = root / 'incoming'

    def create(self) -> None:
        """Create the folders, readable only by their owner, because sensor data is private."""
        self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in ('incoming', 'sessions', *_FOLDERS.values()):
            (self.root / name).mkdir(mode=0o700, exist_ok=True)

    def part(self, number: int) -> Path:
        return self.incoming / f'{number}.part'

    def path(self, state: State, reason: str | None, bucket: str, key: str) -> Path:
        """The file of an object in this state, which must not be delivered, deduplicated or evicted."""
        reasons = () if state in _WITHOUT_REASON else (_UNSAFE.sub('_', reason or '') or 'unknown',)
        return self.root.joinpath(_FOLDERS[state], *reasons, bucket, key)

    def new_body(self, session: int) -> Path:
        """A new path for a staged file."""
        return self.incoming / f'{session}-{uuid.uuid4().hex}.body'

    @staticmethod
    def write_body(path: Path, body: bytes, description: Mapping[str, Any]) -> None:
        """Write a new file, without syncing it. Raises OSError, and then leaves no file."""
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            rest = memoryview(body)
            while rest:
                rest = rest[os.write(descriptor, rest) :]
            describe(descriptor, description)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)

    def take_part(self, number: int, body: Path, description: Mapping[str, Any] | None) -> None:
        """Rename a complete, synced file to the part of an object, with a new description if given. Raises OSError."""
        path = self.part(number)
        if os.path.lexists(path):  # foreign, or left over from a disk that became read-only
            target = self._foreign(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
        if description is not None:
            describe(body, description)
        os.replace(body, path)

    def sync_incoming(self) -> None:
        """Make the names of staged files and parts durable."""
        sync(self.incoming)

    def move(self, source: Path, target: Path) -> bool:
        """Rename a file, creating folders as needed; False if it is not at its target afterwards.

        Never raises OSError, because the row is committed: another process moved or removed the source, or the target cannot be
        created (no space for a folder, a file in place of a folder) and the file stays where it is.
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

    def remove(self, path: Path) -> bool:
        """Remove a file; False if there was none. Never raises OSError, because recovery removes remaining files."""
        try:
            os.unlink(path)  # noqa: PTH108 - once for each object delivered
        except FileNotFoundError:
            return False
        except OSError as error:
            log.warning('cannot remove %s: %s', path, error)
        return True

    def set_aside(self, path: Path) -> None:
        """Move a file that does not belong to the spool to ``foreign/``, without overwriting another."""
        self.move(path, self._foreign(path))

    def _foreign(self, path: Path) -> Path:
        target = wanted = self.root / 'foreign' / path.relative_to(self.root)
        number = 0
        while os.path.lexists(target):
            number += 1
            target = wanted.with_name(f'{wanted.name}.{number}')
        return target

    @staticmethod
    def size(path: Path) -> int | None:
        """Bytes of a regular file; None for anything else (a missing file, a folder, a link)."""
        try:
            status = path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        return status.st_size if stat.S_ISREG(status.st_mode) else None

    def parts(self) -> Iterator[tuple[int, Path]]:
        """(object id, path) of every part; ignores other files."""
        for path in sorted(self.incoming.iterdir()):
            if _PART.fullmatch(path.name) and self.size(path) is not None:
                yield int(path.stem), path

    def staged(self) -> Iterator[tuple[int, Path]]:
        """(session, path) of every staged file."""
        return ((int(found[1]), path) for path in sorted(self.incoming.iterdir()) if (found := _BODY.fullmatch(path.name)))

    def is_in_place(self, state: State, bucket: str, key: str, size: int) -> bool:
        """Whether the file of a pending or kept object is complete and in place; fast, because startup checks every one."""
        try:
            status = os.lstat(f'{self.root}/{_FOLDERS[state]}/{bucket}/{key}')
        except (FileNotFoundError, NotADirectoryError):
            return False
        return status.st_size == size and stat.S_ISREG(status.st_mode)

    def place_pending(self, number: int, bucket: str, key: str) -> Path:
        """The file of a pending object, renamed from its part if necessary; the part if that fails."""
        path, part = self.path(State.PENDING, None, bucket, key), self.part(number)
        if not os.path.isfile(path) and not self.move(part, path) and os.path.exists(part):  # noqa: PTH110, PTH113 - these never raise
            return part
        return path

    def objects(self, known: Collection[tuple[str, str]]) -> Iterator[tuple[State, str | None, str, str, Path]]:
        """(state, reason, bucket, key, path) of every regular file in the folders of objects, except those of ``known`` keys."""
        for state, name in _FOLDERS.items():
            folder = self.root / name
            depth = 1 if state in _WITHOUT_REASON else 2
            for parent, _, names in os.walk(folder):
                relative = Path(parent).relative_to(folder).parts
                if not names or len(relative) < depth:
                    continue
                reason, bucket = None if depth == 1 else relative[0], relative[depth - 1]
                prefix = ''.join(f'{part}/' for part in relative[depth:])
                for key in (key for file in names if (bucket, (key := prefix + file)) not in known):
                    path = folder.joinpath(*relative[:depth], key)
                    if self.size(path) is not None:
                        yield state, reason, bucket, key, path

    def prune(self) -> None:
        """Remove empty folders, such as those of past days."""
        for name in _FOLDERS.values():
            for parent, _, _ in os.walk(self.root / name, topdown=False):
                if Path(parent) != self.root / name:
                    with suppress(OSError):  # not empty, or no permission
                        os.rmdir(parent)

    def free_bytes(self) -> int:
        """Bytes that an unprivileged user may still write to the file system."""
        status = os.statvfs(self.root)
        return status.f_bavail * status.f_frsize


def content_sha256(body: bytes | FileBody) -> str:
    """The SHA-256 of a body in hex; that of a file is known."""
    return hashlib.sha256(body).hexdigest() if isinstance(body, bytes) else body.sha256


def facts(item: DataObject) -> dict[str, str]:
    """An object's metadata in the store, from which its row of the catalog can be rebuilt; ``item.metadata`` take precedence."""
    found = {meta.SENSOR: item.sensor}
    if item.topic is not None:
        found |= {meta.TOPIC: item.topic, meta.TYPE: item.type, meta.COUNT: str(item.samples)}
    if item.t_start_ns >= EARLIEST_SANE_NS:
        found |= {meta.T_START_NS: str(item.t_start_ns), meta.T_END_NS: str(item.t_end_ns)}
    return {**found, **item.metadata}


def description(item: DataObject, key: str, sha256: str, metadata: Mapping[str, str]) -> dict[str, object]:
    """A file's description, from which its row can be rebuilt."""
    return {
        'bucket': item.bucket, 'key': key, 'sha256': sha256, 'content_type': item.content_type, 'sensor': item.sensor,
        'topic': item.topic, 'type': item.type, 'samples': item.samples, 't_start_ns': item.t_start_ns,
        't_end_ns': item.t_end_ns, 'priority': item.priority, 'protected': item.protected, 'held': item.held,
        'metadata': dict(metadata), **({'counts': dict(item.counts)} if item.counts else {}),
    }  # fmt: skip


def describe(target: int | Path, description: Mapping[str, Any]) -> None:
    """Attach a description to a file; without extended attributes, only the index has it."""
    try:
        os.setxattr(target, ATTRIBUTE, json.dumps(description).encode())
    except OSError as error:
        if error.errno not in _NO_ATTRIBUTES:
            raise


def description_of(path: Path) -> dict[str, Any]:
    """The description attached to a file; empty if it is missing, unreadable or not ours."""
    try:
        found = json.loads(os.getxattr(path, ATTRIBUTE))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
