"""Dates objects whose time was taken while the clock of this machine was not set.

A time before 2024 is that of the boot clock (``stamps.StampRule`` sees to that). An object that begins at such a time is held
under ``<robot>/_unsynced/<boot_id>/<sensor>/<seconds since boot>``, with all that its final name is made of in its metadata,
where it survives a restart and a lost index. Once the clock is set the offset between the clocks is known, and key, times and
metadata are those of UTC; content stays as it is. Which offset that is, and how long an object waits for it, is decided in
``dating.py``; those that go without a date ship under the names that they have.

Every object says when it was by both clocks: ``boot_id``, ``boot_start_ns``, ``boot_end_ns``, and as ``clock`` how its date is
known: ``set`` (this machine's clock was right), ``publisher`` (it was not, but that of the publisher's machine),
``set_later`` (re-dated; ``clock_offset_ns`` is to be added to times in the content), ``unset`` (it has none).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.dating import Dating
from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.keys import dated, unsynced
from shadowhound_data_logger.core.model import Binding, DataObject, HeldObject, SpooledObject
from shadowhound_data_logger.spool.clock_record import ClockRecord
from shadowhound_data_logger.spool.spool import Spool

log = logging.getLogger(__name__)

CLOCK: Final = 'clock'
"""Why an object is held."""
STEP: Final = 256
"""Objects named in one go: some 30 ms."""
_TIMES: Final = (words.T_START_NS, words.T_END_NS)


class Redating:
    """Holds objects while the clock is not set, and gives them their dates once it is.

    New; ``date`` every object on its way to the spool, on any thread; ``step`` once a second, on one.
    """

    def __init__(self, spool: Spool, watch: ClockWatch, record: ClockRecord, robot: str) -> None:
        self._spool = spool
        self._watch = watch
        self._dating = Dating(watch, watch.hold_s, record.offsets)
        self._record = record
        self._robot = robot

    def mark(self, item: DataObject) -> DataObject:
        """The object with what is known of its time; held, or under another key, where that is not UTC."""
        boot_id = self._watch.boot_id
        offset_ns = self._offset_of(boot_id)
        start_ns, end_ns = item.t_start_ns, item.t_end_ns
        if start_ns >= EARLIEST_SANE_NS:
            away_ns = offset_ns or end_ns - self._watch.boot_ns()
            clock = words.SET if offset_ns else words.PUBLISHER
            return replace(
                item, metadata={**item.metadata, **_boot(boot_id, start_ns - away_ns, end_ns - away_ns), words.CLOCK: clock}
            )
        known = {name: value for name, value in item.metadata.items() if name not in _TIMES}
        metadata = {**known, **_boot(boot_id, start_ns, end_ns), words.CLOCK: words.UNSET}
        metadata[words.KEY_PATTERN] = item.key_pattern or item.key
        if offset_ns:
            key, metadata = _final(metadata, start_ns, end_ns, offset_ns)
            return replace(item, key=key, metadata=metadata, t_start_ns=start_ns + offset_ns, t_end_ns=end_ns + offset_ns)
        key = unsynced(self._robot, boot_id, item.sensor, start_ns, item.key)
        return replace(item, key=key, metadata=metadata, held=CLOCK if offset_ns is None else None)

    def step(self) -> list[SpooledObject]:
        """Look at the clock and name what can be named now; returns what may be shipped. Raises OSError or sqlite3.Error."""
        if self._watch.look() or not self._record.knows(self._watch.boot_id, self._watch.offset_ns()):
            self._record.note(self._watch)
        bindings = [binding for item in self._spool.held(CLOCK, STEP) if (binding := self._binding(item)) is not None]
        if not bindings:
            return []
        bound = self._spool.bind(bindings)
        dates = sum(binding.t_start_ns >= EARLIEST_SANE_NS for binding in bindings)
        log.info('%d objects of before the clock was set are dated, %d go without a date', dates, len(bindings) - dates)
        return bound

    def _binding(self, item: HeldObject) -> Binding | None:
        """What becomes of a held object now; None where it has to wait."""
        offset_ns = self._offset_of(item.metadata.get(words.BOOT_ID, ''))
        if offset_ns is None:
            return None
        if offset_ns and item.t_start_ns < EARLIEST_SANE_NS:
            try:
                key, metadata = _final(item.metadata, item.t_start_ns, item.t_end_ns, offset_ns)
                return Binding(item.id, key, metadata, item.t_start_ns + offset_ns, item.t_end_ns + offset_ns)
            except (NameRefused, LookupError, ValueError) as error:
                log.warning('%s cannot be dated: %s', item.key, error)
        return Binding(item.id, item.key, item.metadata, item.t_start_ns, item.t_end_ns)

    def _offset_of(self, boot_id: str) -> int | None:
        """As of ``Dating``. Objects wait since the clock is known not to be set: once that is too long, none waits any more."""
        return self._dating.offset_ns(boot_id, self._watch.unset_since_ns)


def _boot(boot_id: str, start_ns: int, end_ns: int) -> dict[str, str]:
    return {words.BOOT_ID: boot_id, words.BOOT_START_NS: str(start_ns), words.BOOT_END_NS: str(end_ns)}


def _final(metadata: Mapping[str, str], start_ns: int, end_ns: int, offset_ns: int) -> tuple[str, dict[str, str]]:
    """Key and metadata of an object that is re-dated. Raises NameRefused, LookupError or ValueError where they make no sense."""
    times = {words.T_START_NS: str(start_ns + offset_ns), words.T_END_NS: str(end_ns + offset_ns)}
    rest = {name: value for name, value in metadata.items() if name != words.KEY_PATTERN}
    key = dated(metadata[words.KEY_PATTERN], start_ns + offset_ns)
    return key, {**rest, **times, words.CLOCK: words.SET_LATER, words.CLOCK_OFFSET_NS: str(offset_ns)}
