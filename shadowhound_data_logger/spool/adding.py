"""The new objects of one group commit: their rows, and their files as parts until the transaction is durable.

Whole files come beside the parts before anything is locked, however long a copy takes. A file of the spool's own file system
is linked, any other copied. Its source is nobody's to remove until the object that it is the content of is durable, so a death
at any moment leaves the source, the object, or both.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.disk import sync
from shadowhound_data_logger.keys import check_key
from shadowhound_data_logger.model import DataObject, FileBody, SpooledObject, State
from shadowhound_data_logger.spool.binding import free_key
from shadowhound_data_logger.spool.files import Tree, content_sha256, description, facts
from shadowhound_data_logger.spool.index import MISSING, Index
from shadowhound_data_logger.spool.repeats import Repeats
from shadowhound_data_logger.spool.retention import NO_ROOM

log = logging.getLogger(__name__)

_NO_LINK: Final = frozenset({errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS})
"""Another file system, one without links, or a file of another user: copied."""
_UNREADABLE: Final = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EACCES, errno.EIO})
"""The source's own fault: tried again it would bar the way to all that is committed with it."""


@contextmanager
def staged(tree: Tree, session: int, objects: Sequence[DataObject]) -> Iterator[list[DataObject]]:
    """The objects with their files where a commit can take them; what was not taken is gone again at the end.

    Where a file cannot be had the object keeps its source. Raises OSError where this disk takes nothing.
    """
    paths: list[Path] = []
    try:
        yield [_with_file(tree, session, item, item.body, paths) if isinstance(item.body, FileBody) else item for item in objects]
    finally:
        for path in paths:
            tree.remove(path)


def is_staged(tree: Tree, body: bytes | FileBody) -> bool:
    """Whether a commit can take the body: bytes, or a file that is there."""
    return isinstance(body, bytes) or (body.path.parent == tree.incoming and tree.size(body.path) is not None)


def remove_sources(tree: Tree, before: Sequence[DataObject], after: Sequence[DataObject]) -> None:
    """The objects are durable: what their files were made from is not needed any more."""
    for old, new in zip(before, after, strict=True):
        if isinstance(old.body, FileBody) and new is not old:
            tree.remove(old.body.path)


def _with_file(tree: Tree, session: int, item: DataObject, body: FileBody, paths: list[Path]) -> DataObject:
    path = tree.incoming / f'{session}-{uuid.uuid4().hex}.body'
    paths.append(path)
    try:
        _link_or_copy(body.path, path)
    except OSError as error:
        if error.errno not in _UNREADABLE:
            raise
        log.error('the file of %s/%s cannot be had: %s', item.bucket, item.key, error)  # noqa: TRY400 - an operator's matter
        return item
    return replace(item, body=replace(body, path=path))


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise
        shutil.copyfile(source, target)
    sync(target)  # its writer has synced it: then this costs nothing


class Adding:
    """The new objects of one commit: their rows and files.

    New for each commit, under the spool's lock; ``add`` inside its transaction, then ``place``, or ``discard`` inside it.
    """

    def __init__(self, index: Index, tree: Tree, repeats: Repeats, now_ns: int) -> None:
        self._index = index
        self._tree = tree
        self._repeats = repeats
        self._now_ns = now_ns
        self._added: list[tuple[SpooledObject, State]] = []
        repeats.begin()

    def add(self, item: DataObject, *, fits: bool) -> None:
        """Row and part of one object."""
        state, reason = (State.HELD, item.held) if item.held else (State.PENDING, None)
        if not fits and not item.protected:
            state, reason = State.EVICTED, NO_ROOM
        elif not is_staged(self._tree, item.body):
            state, reason = State.QUARANTINED, MISSING
        key = free_key(self._index, item.bucket, check_key(item.key))
        sha256 = content_sha256(item.body)
        metadata = {**facts(item), words.SHA256: sha256}
        if state is State.PENDING:
            holder = self._repeats.holder(self._index, item, sha256)
            if holder is not None:
                self._add_repeat(replace(item, body=holder.body), key, {**metadata, **holder.said})
                return
            metadata |= self._repeats.stored(item, key, sha256)
        number = self._index.insert(item, key, sha256, state, reason, metadata, self._now_ns)
        if words.GAP_VERSION in item.metadata:
            self._index.gaps.set_told(item.metadata[words.ROBOT], int(item.metadata[words.GAP_VERSION]))
        path = self._tree.part(number)
        if state in {State.PENDING, State.HELD}:
            said = description(item, key, sha256, metadata)
            if isinstance(item.body, bytes):
                self._tree.write_part(number, item.body, said)
            else:
                self._tree.take_part(number, item.body.path, said)
            path = self._tree.path(state, reason, item.bucket, key)
        added = SpooledObject(number, item.bucket, key, path, len(item.body), sha256, item.content_type, metadata, item.priority,
                              self._now_ns)  # fmt: skip
        self._added.append((added, state))

    def sync(self) -> None:
        """Make the names of the parts durable."""
        if self._added:
            self._tree.sync_incoming()

    def discard(self) -> None:
        """Remove the parts of a transaction that is rolled back: on a full disk they would keep it full."""
        for item, _ in self._added:
            self._tree.remove(self._tree.part(item.id))

    def place(self) -> list[SpooledObject]:
        """It is durable: give the files their names; returns the objects that may be shipped."""
        self._repeats.keep()
        pending: list[SpooledObject] = []
        for item, state in self._added:
            if state is State.PENDING:
                pending.append(replace(item, path=self._tree.waiting(item.id, item.bucket, item.key)))
            elif state is State.HELD:
                self._tree.place(self._tree.part(item.id), item.path)
        return pending

    def _add_repeat(self, item: DataObject, key: str, metadata: Mapping[str, str]) -> None:
        sha256 = content_sha256(item.body)
        said = {**metadata, words.SHA256: sha256}
        number = self._index.insert(item, key, sha256, State.PENDING, None, said, self._now_ns)
        self._index.move([number], State.DEDUPLICATED, None, self._now_ns)
