"""Requests for kept objects, as durable state: each request with the objects it selected, what was released, and its answers.

A request may be for very many objects, so one transaction changes at most ``request_table.PIECE`` rows.
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
    RequestedTable,
    RequestRow,
)


class Requests:
    """The requests of a spool. Thread-safe while the spool is open.

    Methods that read wait for no commit and raise sqlite3.Error; methods that write raise as ``Spool.commit``.
    """

    def __init__(self, connections: Connections, tree: Tree, robot: str) -> None:
        self._connections = connections
        self._tree = tree
        self._robot = robot

    def to_cut(self, request: str) -> list[KeptSlice]:
        """Kept slices that the request needs only partly, oldest first."""
        return [KeptSlice(number, key, self._tree.path(State.KEPT, None, bucket, key), sha256, metadata)
                for number, bucket, key, sha256, metadata in self._connections.reading.requested.to_cut(request)]  # fmt: skip

    def selectable(self) -> Iterator[KeptObject]:
        """What a request may select of this robot: objects kept, released but not delivered, or lost within the last hour."""
        with self._connections.snapshot() as index:
            yield from index.requested.selectable(self._robot)

    def accept(self, row: RequestRow, chosen: Sequence[tuple[int, int]]) -> RequestRow:
        """Record a request with the (id, bytes) of the kept objects that it selected; returns its row as recorded.

        Fewer bytes than an object has mean a slice that must be cut. The request counts once its row is written.
        """
        self._in_pieces(lambda table: table.clear(row.id))
        for begin in range(0, len(chosen), PIECE):
            with self._connections.transaction() as index:
                index.requested.add(row.id, chosen[begin : begin + PIECE])
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
        """Send these slices complete, because they cannot be cut."""
        with self._connections.transaction() as index:
            index.requested.set_complete(request, ids)

    def set_cut(self, request: str, ids: Collection[int], places: Iterable[tuple[str, str]]) -> int:
        """Replace slices that a request waits for by the objects cut out of them, at (bucket, key); returns their bytes."""
        with self._connections.transaction() as index:
            rows = [row for bucket, key in places if (row := index.objects.row(bucket, key)) is not None]
            index.requested.set_cut(request, ids, [(row['id'], row['bytes'], row['state']) for row in rows])
        return sum(row['bytes'] for row in rows)

    def forget(self, before_ns: int, limit: int | None = None) -> None:
        """Delete the rows of requests answered before then (Unix nanoseconds), oldest first, at most ``limit``."""
        for request in self._connections.reading.requests.answered(before_ns, limit):
            self._in_pieces(lambda table: table.clear(request))  # noqa: B023 - called before the loop continues
            with self._connections.transaction() as index:
                index.requests.forget(request)

    def clear_unfinished(self) -> None:
        """Delete the remains of requests that a killed process was accepting."""
        self._in_pieces(RequestedTable.clear_unfinished)

    def _in_pieces(self, step: Callable[[RequestedTable], bool]) -> None:
        """Repeat a step until it reports that nothing is left; other threads get the lock between two steps."""
        more = True
        while more:
            with self._connections.transaction() as index:
                more = step(index.requested)
