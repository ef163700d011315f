"""The new objects of one group commit: their rows, and their files, which are parts until the transaction is durable.

All content is written and synced next to the parts before the transaction begins; whole files even before anything is locked,
because a copy may take long. A file on the spool's own file system is linked, any other is copied. Its source is removed only
when the object is durable, so a crash at any moment leaves the source, the object, or both.
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

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import DataObject, FileBody, SpooledObject, State, waits_for
from shadowhound_data_logger.spool.files import Tree, content_sha256, describe, description, facts
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.object_table import MISSING
from shadowhound_data_logger.spool.repeats import Repeats
from shadowhound_data_logger.spool.retention import NO_ROOM

log = logging.getLogger(__name__)

_NO_LINK: Final = frozenset({errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS})
"""Another file system, one without links, or a file of another user: the file is copied."""
_WITH_FILE: Final = frozenset({State.PENDING, State.HELD, State.KEPT})
"""States of a new object whose file is stored."""
_UNREADABLE: Final = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EACCES, errno.EIO})
"""Errors of the source itself: retrying would block everything that is committed with it."""


@contextmanager
def staged(tree: Tree, session: int, objects: Sequence[DataObject]) -> Iterator[list[DataObject]]:
    """The objects with their files staged for a commit; staged files that no commit took are removed at the end.

    An object whose source cannot be read keeps its source. Raises OSError if the spool's disk cannot be written.
    """
    paths: list[Path] = []
    try:
        yield [_with_file(tree, session, item, item.body, paths) if isinstance(item.body, FileBody) else item for item in objects]
    finally:
        for path in paths:
            tree.remove(path)


def is_staged(tree: Tree, body: bytes | FileBody) -> bool:
    """Whether a commit can take the body: bytes, or a staged file."""
    return isinstance(body, bytes) or (body.path.parent == tree.incoming and tree.size(body.path) is not None)


def remove_sources(tree: Tree, before: Sequence[DataObject], after: Sequence[DataObject]) -> None:
    """Remove the sources of staged files, because the objects are durable."""
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
        log.error('cannot read the file of %s/%s: %s', item.bucket, item.key, error)  # noqa: TRY400 - no defect of this program
        return item
    return replace(item, body=replace(body, path=path))


def link_or_copy(source: Path, target: Path) -> None:
    """Create a synced file with the same content; a link if the file system supports it. Raises OSError."""
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise
        shutil.copyfile(source, target)
    sync(target)  # cheap if its writer has synced it


class NewObjects:
    """The new objects of one commit: their rows and files.

    Lifecycle: new for each commit, under the spool's lock; ``stage`` before the transaction; ``add`` and ``take`` in it, and
    ``discard`` if it is rolled back; ``name_files`` after it; ``close`` in any case. Nothing is written or synced inside the
    transaction, because other processes wait for it.
    """

    def __init__(self, index: Index, tree: Tree, repeats: Repeats, session: int, now_ns: int) -> None:
        self._index = index
        self._tree = tree
        self._repeats = repeats
        self._session = session
        self._now_ns = now_ns
        self._bodies: list[Path] = []
        """Files written for this commit."""
        self._descriptions: dict[str, Mapping[str, object]] = {}
        """Those attached to the staged files, by name: a Path takes longer to look up than to unlink."""
        self._unsynced: list[Path] = []
        self._added: list[tuple[SpooledObject, State]] = []
        self._new_parts: list[tuple[int, Path, Mapping[str, object] | None]] = []
        """(id, staged file, its description if it changes)."""
        repeats.begin()

    def stage(self, objects: Sequence[DataObject], not_stored: Collection[int]) -> list[DataObject]:
        """The objects with their content in durable files next to the parts.

        Skips those with indexes in ``not_stored``, and those that look like repeats. Raises OSError; then ``close`` cleans up.
        """
        expected = self._repeats.expected(objects)
        taken = [
            item if (index in not_stored and not item.protected) or index in expected else self._staged(item)
            for index, item in enumerate(objects)
        ]
        self._sync()
        return taken

    def add(self, item: DataObject, *, fits: bool) -> None:
        """Insert the row of one object."""
        state, reason = (State.HELD, item.held) if item.held else (State.KEPT if item.is_on_request else State.PENDING, None)
        if not fits and not item.protected:
            state, reason = State.EVICTED, NO_ROOM
        elif not is_staged(self._tree, item.body):
            state, reason = State.QUARANTINED, MISSING
        key = self._index.objects.free_key(item.bucket, check_key(item.key))
        sha256 = content_sha256(item.body)
        metadata = {**facts(item), meta.SHA256: sha256}
        if state is State.PENDING and item.dedup:
            holder = self._repeats.holder(self._index, item, sha256)
            if holder is not None:
                self._add_repeat(replace(item, body=holder.body), key, {**metadata, **holder.metadata})
                return
            metadata |= self._repeats.stored(item, key, sha256)
        if state in _WITH_FILE and isinstance(item.body, bytes):
            item = self._staged(item)  # it looked like a repeat of an object that another process has evicted
            self._sync()
        number = self._index.states.insert(item, key, sha256, state, reason, metadata, self._now_ns)
        if meta.GAP_VERSION in item.metadata:
            self._index.gaps.set_reported(item.metadata[meta.ROBOT], int(item.metadata[meta.GAP_VERSION]))
        path = self._tree.part(number)
        if state in _WITH_FILE and isinstance(item.body, FileBody):
            new = description(item, key, sha256, metadata)
            is_changed = new != self._descriptions.get(str(item.body.path))
            self._new_parts.append((number, item.body.path, new if is_changed else None))
            path = self._tree.path(state, reason, item.bucket, key)
        added = SpooledObject(number, item.bucket, key, path, len(item.body), sha256, item.content_type, metadata, item.priority,
                              self._now_ns, waits_for(item.sensor, metadata, protected=item.protected))  # fmt: skip
        self._added.append((added, state))

    def take(self) -> None:
        """Rename the staged files to parts, immediately before the commit.

        The new names need not be durable: after a power cut, recovery finds the content under either name.
        """
        for number, path, changed in self._new_parts:
            self._tree.take_part(number, path, changed)

    def discard(self) -> None:
        """Undo ``take`` before a rollback, because the same files may be committed again."""
        for number, path, _ in self._new_parts:
            if not path.exists():
                self._tree.move(self._tree.part(number), path)

    def close(self) -> None:
        """Remove files that were written but not taken, which would keep a full disk full."""
        for path in self._bodies:
            self._tree.remove(path)

    def name_files(self) -> list[SpooledObject]:
        """After the commit: give the files their final names. Returns the objects that may be shipped."""
        self._repeats.keep()
        taken = {str(path) for _, path, _ in self._new_parts}
        self._bodies = [path for path in self._bodies if str(path) not in taken]
        pending: list[SpooledObject] = []
        for item, state in self._added:
            if state is State.PENDING:
                path = self._tree.place_pending(item.id, item.bucket, item.key)
                pending.append(item if path == item.path else replace(item, path=path))
            elif state in {State.HELD, State.KEPT}:
                self._tree.move(self._tree.part(item.id), item.path)
        return pending

    def _staged(self, item: DataObject) -> DataObject:
        """The object with its content in a file with a description, not synced yet; unchanged if its file is missing."""
        if not is_staged(self._tree, item.body):
            return item
        sha256 = content_sha256(item.body)
        attached = description(item, item.key, sha256, {**facts(item), meta.SHA256: sha256})
        if isinstance(item.body, bytes):
            path = self._tree.new_body(self._session)
            self._bodies.append(path)
            self._tree.write_body(path, item.body, attached)
            item = replace(item, body=FileBody(path, len(item.body), sha256))
        else:
            path = item.body.path
            describe(path, attached)
        self._descriptions[str(path)] = attached
        self._unsynced.append(path)
        return item

    def _sync(self) -> None:
        """Sync the files after all were written: the first sync then writes most of the others, too."""
        for path in self._unsynced:
            sync(path)
        if self._unsynced:
            self._tree.sync_incoming()
        self._unsynced.clear()

    def _add_repeat(self, item: DataObject, key: str, metadata: Mapping[str, str]) -> None:
        sha256 = content_sha256(item.body)
        metadata = {**metadata, meta.SHA256: sha256}
        number = self._index.states.insert(item, key, sha256, State.PENDING, None, metadata, self._now_ns)
        self._index.states.move([number], State.DEDUPLICATED, None, self._now_ns)
