"""Whole files on their way into the spool: beside the parts before anything is locked, however long a copy takes.

A file of the spool's own file system is linked, any other copied. Its source is nobody's to remove until the object that it
is the content of is durable, so a death at any moment leaves the source, the object, or both.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.disk import sync
from shadowhound_data_logger.model import DataObject, FileBody
from shadowhound_data_logger.spool.files import Tree

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
