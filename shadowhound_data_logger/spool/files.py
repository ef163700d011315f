"""The spool's tree: a file's folder says what it is. ``ready/<bucket>/<key>`` can be rescued with ``aws s3 sync``.

    incoming/<session>-<any>.body      written, synced and about to become a part (adding.py)
    incoming/<id>.part                 its row not yet committed or its rename not yet done
    ready/<bucket>/<key>               waits for delivery under its final name
    held/<reason>/<bucket>/<key>       has no final name yet
    quarantine/<reason>/<bucket>/<key> will not be delivered as it is
    kept/<bucket>/<key>                stays here until somebody asks for it

Each file carries its description as the extended attribute ``user.shadowhound`` where the file system has such, so that
a lost index can be rebuilt from the tree.
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
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.model import DataObject, FileBody, State

log = logging.getLogger(__name__)

ATTRIBUTE: Final = 'user.shadowhound'
_NO_ATTRIBUTES: Final = frozenset({errno.ENOTSUP, errno.EPERM, errno.E2BIG, errno.ERANGE, errno.ENOSPC, errno.EDQUOT})
"""Why a file goes without a description. ext4 says ENOSPC for one of more than a block; a disk that is full says it
of the bytes, too.
"""
_UNSAFE: Final = re.compile(r'^\.+|[^A-Za-z0-9_.-]+')
_PART: Final = re.compile(r'[1-9][0-9]{0,17}\.part')
_SESSION: Final = re.compile(r'[1-9][0-9]{0,17}')
_BODY: Final = re.compile(r'([1-9][0-9]{0,17})-[0-9a-f]{32}\.body')
"""Of a file at a time: it may be larger than the memory."""
_FOLDERS: Final = {State.PENDING: 'ready', State.HELD: 'held', State.QUARANTINED: 'quarantine', State.KEPT: 'kept'}
_WITHOUT_REASON: Final = frozenset({State.PENDING, State.KEPT})


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

    def sessions(self) -> Iterator[int]:
        """Those that are alive, and those that did not end."""
        return (int(path.name) for path in (self.root / 'sessions').iterdir() if _SESSION.fullmatch(path.name))

    def part(self, number: int) -> Path:
        return self.incoming / f'{number}.part'

    def path(self, state: State, reason: str | None, bucket: str, key: str) -> Path:
        """Where the bytes of an object in this state lie; they lie nowhere once it is delivered or evicted."""
        reasons = () if state in _WITHOUT_REASON else (_UNSAFE.sub('_', reason or '') or 'unknown',)
        return self.root.joinpath(_FOLDERS[state], *reasons, bucket, key)

    def new_body(self, session: int) -> Path:
        """A name for a file that is about to become a part."""
        return self.incoming / f'{session}-{uuid.uuid4().hex}.body'

    @staticmethod
    def write_body(path: Path, body: bytes, said: Mapping[str, Any]) -> None:
        """Write a new file, to be synced; raises OSError (a full disk, say) and then leaves nothing behind."""
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            rest = memoryview(body)
            while rest:
                rest = rest[os.write(descriptor, rest) :]
            describe(descriptor, said)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)

    def take_part(self, number: int, body: Path, said: Mapping[str, Any] | None) -> None:
        """Make a whole and synced file the part; ``said`` where it has to say something else. Raises OSError."""
        path = self.part(number)
        self._clear(path)
        if said is not None:
            describe(body, said)
        os.replace(body, path)

    def sync_incoming(self) -> None:
        """Make the names of the written files durable."""
        sync(self.incoming)

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

    def remove(self, path: Path) -> bool:
        """Unlink; False when nothing was there. Never raises OSError, since recovery removes what stays."""
        try:
            os.unlink(path)  # noqa: PTH108 - once for each object delivered
        except FileNotFoundError:
            return False
        except OSError as error:
            log.warning('cannot remove %s: %s', path, error)
        return True

    def set_aside(self, path: Path) -> None:
        """Move a file that is none of the spool's to ``foreign/``, over no other one."""
        self.place(path, self._foreign(path))

    def _foreign(self, path: Path) -> Path:
        target = wanted = self.root / 'foreign' / path.relative_to(self.root)
        number = 0
        while os.path.lexists(target):
            number += 1
            target = wanted.with_name(f'{wanted.name}.{number}')
        return target

    def _clear(self, part: Path) -> None:
        """What lies where a part is to be is none of ours, or failed on a disk that then became read-only; raises OSError."""
        if os.path.lexists(part):
            target = self._foreign(part)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(part, target)

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

    def staged(self) -> Iterator[tuple[int, Path]]:
        """(session, path) of every file that is about to become a part."""
        return ((int(found[1]), path) for path in sorted(self.incoming.iterdir()) if (found := _BODY.fullmatch(path.name)))

    def is_in_place(self, state: State, bucket: str, key: str, size: int) -> bool:
        """Whether the file of a pending or kept object lies whole in its place; without a Path: a start asks it of each one."""
        try:
            status = os.lstat(f'{self.root}/{_FOLDERS[state]}/{bucket}/{key}')
        except (FileNotFoundError, NotADirectoryError):
            return False
        return status.st_size == size and stat.S_ISREG(status.st_mode)

    def waiting(self, number: int, bucket: str, key: str) -> Path:
        """The file of a pending object, placed if it was not yet; the part where its place is barred."""
        path, part = self.path(State.PENDING, None, bucket, key), self.part(number)
        if not os.path.isfile(path) and not self.place(part, path) and os.path.exists(part):  # noqa: PTH110, PTH113 - these never raise
            return part
        return path

    def objects(self, known: Callable[[str, str], Collection[str]]) -> Iterator[tuple[State, str | None, str, str, Path]]:
        """(state, reason, bucket, key, path) of every regular file that lies where objects lie.

        ``known`` gives keys to leave out, asked once a folder with the bucket and what the keys there begin with.
        """
        for state, name in _FOLDERS.items():
            folder = self.root / name
            depth = 1 if state in _WITHOUT_REASON else 2
            for parent, _, names in os.walk(folder):
                relative = Path(parent).relative_to(folder).parts
                if not names or len(relative) < depth:
                    continue
                reason, bucket = None if depth == 1 else relative[0], relative[depth - 1]
                prefix = ''.join(f'{part}/' for part in relative[depth:])
                left_out = known(bucket, prefix)
                for key in (key for file in names if (key := prefix + file) not in left_out):
                    path = folder.joinpath(*relative[:depth], key)
                    if self.size(path) is not None:
                        yield state, reason, bucket, key, path

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


def content_sha256(body: bytes | FileBody) -> str:
    """Hex; that of a file is known."""
    return hashlib.sha256(body).hexdigest() if isinstance(body, bytes) else body.sha256


def facts(item: DataObject) -> dict[str, str]:
    """What an object says of itself in the store, in its own words first: enough to make its row of the catalog again."""
    said = {words.SENSOR: item.sensor}
    if item.topic is not None:
        said |= {words.TOPIC: item.topic, words.TYPE: item.type, words.COUNT: str(item.samples)}
    if item.t_start_ns >= EARLIEST_SANE_NS:
        said |= {words.T_START_NS: str(item.t_start_ns), words.T_END_NS: str(item.t_end_ns)}
    return {**said, **item.metadata}


def description(item: DataObject, key: str, sha256: str, metadata: Mapping[str, str]) -> dict[str, object]:
    """What a file must say of itself so that its row can be made again."""
    return {
        'bucket': item.bucket, 'key': key, 'sha256': sha256, 'content_type': item.content_type, 'sensor': item.sensor,
        'topic': item.topic, 'type': item.type, 'samples': item.samples, 't_start_ns': item.t_start_ns,
        't_end_ns': item.t_end_ns, 'priority': item.priority, 'protected': item.protected, 'held': item.held,
        'metadata': dict(metadata), **({'counts': dict(item.counts)} if item.counts else {}),
    }  # fmt: skip


def describe(target: int | Path, said: Mapping[str, Any]) -> None:
    """Attach a description to a file; where the file system has no attributes the index alone knows it."""
    try:
        os.setxattr(target, ATTRIBUTE, json.dumps(said).encode())
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
