"""The new objects of one group commit: their rows, and their files as parts until the transaction is durable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.keys import check_key
from shadowhound_data_logger.model import DataObject, SpooledObject, State
from shadowhound_data_logger.spool.binding import free_key
from shadowhound_data_logger.spool.files import Tree, content_sha256, description, facts
from shadowhound_data_logger.spool.index import MISSING, Index
from shadowhound_data_logger.spool.repeats import Repeats
from shadowhound_data_logger.spool.retention import NO_ROOM
from shadowhound_data_logger.spool.staging import is_staged


class Adding:
    """New for each commit, under the spool's lock; ``add`` inside its transaction, then ``place``, or ``discard`` inside it."""

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
