"""Requests for kept objects, as durable state: each request with what it found, what was released, and what it was answered.

A request may be for very many objects, so nothing here changes more than ``request_table.PIECE`` rows in one transaction.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.connections import Connections
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.request_table import (
    PIECE,
    KeptObject,
    KeptSlice,
    Progress,
    RequestRow,
    RequestTable,
    WaitingObject,
)


class Requests:
    """The requests of a spool. Thread-safe while the spool is open.

    Methods that read wait for no commit and raise sqlite3.Error; methods that write raise as ``Spool.commit``.
    """

    def __init__(self, connections: Connections, tree: Tree, robot: str) -> None:
        self._connections = connections
        self._tree = tree
        self._robot = robot

    def rows(self) -> list[RequestRow]:
        """All known requests, open and closed."""
        return self._connections.reading.requests.rows()

    def is_any_open(self) -> bool:
        """Whether a requester waits for an answer."""
        return bool(self._connections.reading.requests.open_ids())

    def progress(self, request: str) -> Progress:
        """What became of the objects that a request found."""
        return self._connections.reading.requests.progress(request)

    def is_over(self, request: str) -> bool:
        """Whether a request waits for nothing."""
        return self._connections.reading.requests.is_over(request)

    def waiting(self, request: str, limit: int) -> list[WaitingObject]:
        """Objects that a request waits for and that no request has released, oldest first."""
        return self._connections.reading.requests.waiting(request, limit)

    def to_cut(self, request: str) -> list[KeptSlice]:
        """Kept slices of which a request wants a part, oldest first."""
        return [KeptSlice(number, key, self._tree.path(State.KEPT, None, bucket, key), sha256, metadata)
                for number, bucket, key, sha256, metadata in self._connections.reading.requests.to_cut(request)]  # fmt: skip

    def released(self) -> tuple[int, int]:
        """Requested objects that wait for delivery: how many, and their bytes."""
        return self._connections.reading.requests.released()

    def awaited(self) -> tuple[int, int]:
        """Open requests, and the bytes that they wait for and that are not released yet."""
        return self._connections.reading.requests.awaited()

    def selectable(self) -> Iterator[KeptObject]:
        """What a request may select of this robot: objects kept, released but not delivered, or lost within the last hour."""
        with self._connections.snapshot() as index:
            yield from index.requests.known(self._robot)

    def accept(self, row: RequestRow, chosen: Sequence[tuple[int, int]]) -> RequestRow:
        """Record a request with the (id, bytes) of the kept objects that it selected; returns its row as recorded.

        Fewer bytes than an object has mean a slice that is to be cut. Until its row is written the request does not count.
        """
        self._in_pieces(lambda table: table.clear(row.id))
        for begin in range(0, len(chosen), PIECE):
            with self._connections.transaction() as index:
                index.requests.add(row.id, chosen[begin : begin + PIECE])
        with self._connections.transaction() as index:
            return index.requests.accept(row)

    def close(self, request: str, state: str, why: str = '') -> None:
        """End a request; objects that it has not released may be evicted again."""
        with self._connections.transaction() as index:
            index.requests.close(request, state, why)
        self.let_go(request)

    def let_go(self, request: str) -> None:
        """Let the objects that a closed request has not released be evicted again."""
        self._in_pieces(lambda table: table.let_go(request))

    def set_complete(self, request: str, ids: Collection[int]) -> None:
        """These slices cannot be cut: the request wants all of each."""
        with self._connections.transaction() as index:
            index.requests.set_complete(request, ids)

    def set_cut(self, request: str, ids: Collection[int], places: Iterable[tuple[str, str]]) -> int:
        """Replace slices that a request waits for by the objects cut out of them, at (bucket, key); returns their bytes."""
        with self._connections.transaction() as index:
            rows = [row for bucket, key in places if (row := index.objects.row(bucket, key)) is not None]
            index.requests.set_cut(request, ids, [(row['id'], row['bytes'], row['state']) for row in rows])
        return sum(row['bytes'] for row in rows)

    def forget(self, before_ns: int, most: int | None = None) -> None:
        """Delete the rows of requests answered before then (Unix nanoseconds), oldest first, ``most`` at most."""
        for request in self._connections.reading.requests.answered(before_ns, most):
            self._in_pieces(lambda table: table.clear(request))  # noqa: B023 - called before the loop continues
            with self._connections.transaction() as index:
                index.requests.forget(request)

    def clear_unfinished(self) -> None:
        """Delete what was left by a process that was killed while it accepted a request."""
        self._in_pieces(RequestTable.clear_unfinished)

    def _in_pieces(self, step: Callable[[RequestTable], bool]) -> None:
        """Repeat a step until it reports that nothing is left; other threads get the lock between two steps."""
        more = True
        while more:
            with self._connections.transaction() as index:
                more = step(index.requests)
