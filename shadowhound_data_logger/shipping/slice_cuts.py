"""Cuts the requested range of time out of kept slices, a little at a time, and spools the result for its request."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Collection, Generator, Sequence
from typing import Final, NamedTuple, Protocol

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.mailbox import LATEST_NS
from shadowhound_data_logger.core.model import DataObject, SpooledObject
from shadowhound_data_logger.spool.request_table import KeptSlice, RequestRow
from shadowhound_data_logger.spool.spool import Spool

log = logging.getLogger(__name__)

CUT_S: Final = 0.05
"""Of cutting, at each step: a fifth of the time."""


class SliceCut(Protocol):
    """A range of time from kept slices, as a separate bag (``bags/kept.py``)."""

    @property
    def slices(self) -> Sequence[KeptSlice]: ...

    @property
    def places(self) -> Sequence[tuple[str, str]]:
        """(bucket, key) of the objects that it becomes, which no other content has."""

    def work(self) -> Generator[None, None, list[DataObject]]:
        """Cut, and yield after each piece of work; at last the objects. Raises DataLoggerError, OSError."""

    def clear(self) -> None:
        """Remove what it wrote and the spool did not take."""


Cutter = Callable[[Sequence[KeptSlice], int, int, int], SliceCut]
"""From slices of one bag and a range in Unix nanoseconds, with a priority."""


class _Cutting(NamedTuple):
    """The cut that is being made."""

    row: RequestRow
    cut: SliceCut
    work: Generator[None, None, list[DataObject]]


class SliceCuts:
    """Makes one cut at a time. Used by one thread."""

    def __init__(self, spool: Spool, cutter: Cutter, released: Callable[[Sequence[SpooledObject]], None],
                 served: Callable[[RequestRow, int], None], monotonic: Callable[[], float]) -> None:  # fmt: skip
        """``released`` receives objects that may be shipped, ``served`` how many bytes a request gets of them."""
        self._spool = spool
        self._cutter = cutter
        self._released = released
        self._served = served
        self._monotonic = monotonic
        self._cutting: _Cutting | None = None

    def begin(self, row: RequestRow) -> None:
        """Start a cut, unless one is being made, of the oldest bag from which a request wants parts of slices."""
        if self._cutting is not None or not (slices := self._spool.requests.to_cut(row.id)):
            return
        folder = slices[0].key.rpartition('/')[0]
        wanted = json.loads(row.selection)
        cut = self._cutter([each for each in slices if each.key.rpartition('/')[0] == folder], wanted.get('since_ns', 0),
                           wanted.get('until_ns', LATEST_NS), row.priority)  # fmt: skip
        if self._spool.reading.objects.row(*cut.places[-1]) is not None:  # cut for another request, or before the node was killed
            self._set_cut(row, cut, cut.places)
        else:
            self._cutting = _Cutting(row, cut, cut.work())

    def work(self, open_ids: Collection[str]) -> bool:
        """Do some of the work; whether there is any. Slices that cannot be cut are sent whole."""
        if self._cutting is None:
            return False
        row, cut, work = self._cutting
        if row.id not in open_ids:
            self._cutting = None
            work.close()
            return False
        end_s = self._monotonic() + CUT_S
        try:
            while self._monotonic() < end_s:
                next(work)
        except StopIteration as done:
            self._cutting = None
            self._spool_cut(row, cut, done.value)
        except (DataLoggerError, OSError) as error:
            self._cutting = None
            self._send_whole(row, cut, error)
        return True

    def _spool_cut(self, row: RequestRow, cut: SliceCut, made: Sequence[DataObject]) -> None:
        """First the spool has what was cut, then the request does: a kill between the two leaves it to be found."""
        try:
            placed = self._spool.commit(made)
        except OSError as error:
            self._send_whole(row, cut, error)
            return
        finally:
            cut.clear()
        self._set_cut(row, cut, [(item.bucket, item.key) for item in made])
        self._released(placed)

    def _set_cut(self, row: RequestRow, cut: SliceCut, places: Sequence[tuple[str, str]]) -> None:
        self._served(row, self._spool.requests.set_cut(row.id, [each.id for each in cut.slices], places))

    def _send_whole(self, row: RequestRow, cut: SliceCut, error: Exception) -> None:
        log.warning('%d slices are sent whole, since they cannot be cut: %s', len(cut.slices), error)
        self._spool.requests.set_complete(row.id, [each.id for each in cut.slices])
