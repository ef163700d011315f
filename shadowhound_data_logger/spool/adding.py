"""The new objects of one group commit: their rows, and their files as parts until the transaction is durable.

All content is written and synced beside the parts before the transaction begins, whole files before anything is locked, however
long a copy takes. A file of the spool's own file system is linked, any other copied. Its source is nobody's to remove until the
object that it is the content of is durable, so a death at any moment leaves the source, the object, or both.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import DataObject, FileBody, SpooledObject, State, waits_for
from shadowhound_data_logger.spool.binding import free_key
from shadowhound_data_logger.spool.files import Tree, content_sha256, describe, description, facts
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.object_table import MISSING
from shadowhound_data_logger.spool.repeats import Repeats
from shadowhound_data_logger.spool.retention import NO_ROOM

log = logging.getLogger(__name__)

_NO_LINK: Final = frozenset({errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS})
"""Another file system, one without links, or a file of another user: copied."""
_STAYS: Final = frozenset({State.PENDING, State.HELD, State.KEPT})
"""States of a new object whose file stays."""
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
    path = tree.new_body(session)
    paths.append(path)
    try:
        link_or_copy(body.path, path)
    except OSError as error:
        if error.errno not in _UNREADABLE:
            raise
        log.error('the file of %s/%s cannot be had: %s', item.bucket, item.key, error)  # noqa: TRY400 - an operator's matter
        return item
    return replace(item, body=replace(body, path=path))


def link_or_copy(source: Path, target: Path) -> None:
    """A synced file of the same content; a link where the file system has such. Raises OSError."""
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise
        shutil.copyfile(source, target)
    sync(target)  # its writer has synced it: then this costs nothing


class Adding:
    """The new objects of one commit: their rows and files.

    New for each commit, under the spool's lock; ``stage`` before its transaction, ``add`` and ``take`` inside it, then ``place``,
    or ``discard`` inside it; ``close`` in any case. The transaction writes no file and syncs none: others wait for it.
    """

    def __init__(self, index: Index, tree: Tree, repeats: Repeats, session: int, now_ns: int) -> None:
        self._index = index
        self._tree = tree
        self._repeats = repeats
        self._session = session
        self._now_ns = now_ns
        self._bodies: list[Path] = []
        """Files that were written for this commit."""
        self._said: dict[str, Mapping[str, object]] = {}
        """What the staged files say of themselves, by their names: a Path takes longer to look up than to unlink."""
        self._unsynced: list[Path] = []
        self._added: list[tuple[SpooledObject, State]] = []
        self._taking: list[tuple[int, Path, Mapping[str, object] | None]] = []
        repeats.begin()

    def stage(self, objects: Sequence[DataObject], given_up: Collection[int]) -> list[DataObject]:
        """The objects with their content in files beside the parts, durable under these names.

        Not of those in these places of the group, nor of what looks like a repeat. Raises OSError; then ``close`` cleans up.
        """
        expected = self._repeats.expected(objects)
        taken = [
            item if (place in given_up and not item.protected) or place in expected else self._staged(item)
            for place, item in enumerate(objects)
        ]
        self._sync()
        return taken

    def add(self, item: DataObject, *, fits: bool) -> None:
        """Row of one object."""
        state, reason = (State.HELD, item.held) if item.held else (State.KEPT if item.is_on_request else State.PENDING, None)
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
        if state in _STAYS and isinstance(item.body, bytes):
            item = self._staged(item)  # it looked like a repeat, of what another process has evicted meanwhile
            self._sync()
        number = self._index.objects.insert(item, key, sha256, state, reason, metadata, self._now_ns)
        if words.GAP_VERSION in item.metadata:
            self._index.gaps.set_reported(item.metadata[words.ROBOT], int(item.metadata[words.GAP_VERSION]))
        path = self._tree.part(number)
        if state in _STAYS and isinstance(item.body, FileBody):
            said = description(item, key, sha256, metadata)
            self._taking.append((number, item.body.path, said if said != self._said.get(str(item.body.path)) else None))
            path = self._tree.path(state, reason, item.bucket, key)
        added = SpooledObject(number, item.bucket, key, path, len(item.body), sha256, item.content_type, metadata, item.priority,
                              self._now_ns, waits_for(item.sensor, metadata, protected=item.protected))  # fmt: skip
        self._added.append((added, state))

    def take(self) -> None:
        """Make parts of the staged files, last of all before the commit.

        These names need not be durable: after a power cut recovery finds the content under either name.
        """
        for number, path, said in self._taking:
            self._tree.take_part(number, path, said)

    def discard(self) -> None:
        """Undo ``take``, in a transaction that is rolled back: it may be tried again with the same files."""
        for number, path, _ in self._taking:
            if not path.exists():
                self._tree.place(self._tree.part(number), path)

    def close(self) -> None:
        """Remove what was written and not taken: on a full disk it would keep that full."""
        for path in self._bodies:
            self._tree.remove(path)

    def place(self) -> list[SpooledObject]:
        """It is durable: give the files their names; returns the objects that may be shipped."""
        self._repeats.keep()
        taken = {str(path) for _, path, _ in self._taking}
        self._bodies = [path for path in self._bodies if str(path) not in taken]
        pending: list[SpooledObject] = []
        for item, state in self._added:
            if state is State.PENDING:
                path = self._tree.waiting(item.id, item.bucket, item.key)
                pending.append(item if path == item.path else replace(item, path=path))
            elif state in {State.HELD, State.KEPT}:
                self._tree.place(self._tree.part(item.id), item.path)
        return pending

    def _staged(self, item: DataObject) -> DataObject:
        """With its content in a file that describes itself, not synced yet; as it is where its file is gone."""
        if not is_staged(self._tree, item.body):
            return item
        sha256 = content_sha256(item.body)
        said = description(item, item.key, sha256, {**facts(item), words.SHA256: sha256})
        if isinstance(item.body, bytes):
            path = self._tree.new_body(self._session)
            self._bodies.append(path)
            self._tree.write_body(path, item.body, said)
            item = replace(item, body=FileBody(path, len(item.body), sha256))
        else:
            path = item.body.path
            describe(path, said)
        self._said[str(path)] = said
        self._unsynced.append(path)
        return item

    def _sync(self) -> None:
        """After all were written: the first sync takes most of the others along."""
        for path in self._unsynced:
            sync(path)
        if self._unsynced:
            self._tree.sync_incoming()
        self._unsynced.clear()

    def _add_repeat(self, item: DataObject, key: str, metadata: Mapping[str, str]) -> None:
        sha256 = content_sha256(item.body)
        said = {**metadata, words.SHA256: sha256}
        number = self._index.objects.insert(item, key, sha256, State.PENDING, None, said, self._now_ns)
        self._index.objects.move([number], State.DEDUPLICATED, None, self._now_ns)
