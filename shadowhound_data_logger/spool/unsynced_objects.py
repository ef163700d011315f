"""Dates objects that were recorded while the clock of this machine was not set.

A time before 2024 is a time of the boot clock (``stamps.StampRule`` ensures that). An object that begins at such a time is held
under ``<robot>/_unsynced/<boot_id>/<sensor>/<seconds since boot>``. Its metadata contain everything needed for its final name,
so it survives a restart and a lost index. Once the clock is set, the offset between the clocks is known, and key, times and
metadata are converted to UTC; the content is unchanged. ``UtcOffsets`` decides on the offset and on how long an object waits for
it; objects without a date are shipped under their current names.

The metadata of every object contain its times by the boot clock (``boot_id``, ``boot_start_ns``, ``boot_end_ns``), and in
``clock`` how its date is known: ``set`` (this machine's clock was set), ``publisher`` (only the clock of the publisher's machine
was), ``set_later`` (dated afterwards; add ``clock_offset_ns`` to times in the content), ``unset`` (it has no date).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.clock_watch import ClockWatch, UtcOffsets
from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.keys import dated, unsynced
from shadowhound_data_logger.core.model import Binding, DataObject, HeldObject, SpooledObject
from shadowhound_data_logger.spool.clock_record import ClockRecord
from shadowhound_data_logger.spool.spool import Spool

log = logging.getLogger(__name__)

CLOCK: Final = 'clock'
"""Why an object is held."""
STEP: Final = 256
"""Objects dated at a time: some 30 ms."""
_TIMES: Final = (meta.T_START_NS, meta.T_END_NS)


class UnsyncedObjects:
    """Holds objects while the clock is not set, and dates them once it is.

    Lifecycle: new; ``mark`` every object before it is spooled, on any thread; ``step`` once per second, on one thread.
    """

    def __init__(self, spool: Spool, watch: ClockWatch, record: ClockRecord, robot: str) -> None:
        self._spool = spool
        self._watch = watch
        self._offsets = UtcOffsets(watch, watch.hold_s, record.offsets)
        self._record = record
        self._robot = robot

    def mark(self, item: DataObject) -> DataObject:
        """The object with the metadata about its time; held, or under another key, if its time is not UTC."""
        boot_id = self._watch.boot_id
        offset_ns = self._offset_of(boot_id)
        start_ns, end_ns = item.t_start_ns, item.t_end_ns
        if start_ns >= EARLIEST_SANE_NS:
            away_ns = offset_ns or end_ns - self._watch.boot_ns()
            clock = meta.SET if offset_ns else meta.PUBLISHER
            return replace(
                item, metadata={**item.metadata, **_boot(boot_id, start_ns - away_ns, end_ns - away_ns), meta.CLOCK: clock}
            )
        known = {name: value for name, value in item.metadata.items() if name not in _TIMES}
        metadata = {**known, **_boot(boot_id, start_ns, end_ns), meta.CLOCK: meta.UNSET}
        metadata[meta.KEY_PATTERN] = item.key_pattern or item.key
        if offset_ns:
            key, metadata = _final(metadata, start_ns, end_ns, offset_ns)
            return replace(item, key=key, metadata=metadata, t_start_ns=start_ns + offset_ns, t_end_ns=end_ns + offset_ns)
        key = unsynced(self._robot, boot_id, item.sensor, start_ns, item.key)
        return replace(item, key=key, metadata=metadata, held=CLOCK if offset_ns is None else None)

    def step(self) -> list[SpooledObject]:
        """Check the clock and date the objects that can be dated. Returns those that may be shipped now.

        Raises OSError or sqlite3.Error.
        """
        if self._watch.poll() or not self._record.knows(self._watch.boot_id, self._watch.offset_ns()):
            self._record.note(self._watch)
        held = self._spool.reading.objects.held(CLOCK, STEP)
        bindings = [binding for item in held if (binding := self._binding(item)) is not None]
        if not bindings:
            return []
        bound = self._spool.bind(bindings)
        dates = sum(binding.t_start_ns >= EARLIEST_SANE_NS for binding in bindings)
        log.info('dated %d objects from before the clock was set; %d are shipped without a date', dates, len(bindings) - dates)
        return bound

    def _binding(self, item: HeldObject) -> Binding | None:
        """The final key and times of a held object; None if it must wait."""
        offset_ns = self._offset_of(item.metadata.get(meta.BOOT_ID, ''))
        if offset_ns is None:
            return None
        if offset_ns and item.t_start_ns < EARLIEST_SANE_NS:
            try:
                key, metadata = _final(item.metadata, item.t_start_ns, item.t_end_ns, offset_ns)
                return Binding(item.id, key, metadata, item.t_start_ns + offset_ns, item.t_end_ns + offset_ns)
            except (NameRefused, LookupError, ValueError) as error:
                log.warning('cannot date %s, which is shipped without a date: %s', item.key, error)
        return Binding(item.id, item.key, item.metadata, item.t_start_ns, item.t_end_ns)

    def _offset_of(self, boot_id: str) -> int | None:
        """As ``UtcOffsets.of``. All objects stop waiting once the clock has been unset for too long."""
        return self._offsets.of(boot_id, self._watch.unset_since_ns)


def _boot(boot_id: str, start_ns: int, end_ns: int) -> dict[str, str]:
    return {meta.BOOT_ID: boot_id, meta.BOOT_START_NS: str(start_ns), meta.BOOT_END_NS: str(end_ns)}


def _final(metadata: Mapping[str, str], start_ns: int, end_ns: int, offset_ns: int) -> tuple[str, dict[str, str]]:
    """Key and metadata of an object that is dated now. Raises NameRefused, LookupError or ValueError for invalid metadata."""
    times = {meta.T_START_NS: str(start_ns + offset_ns), meta.T_END_NS: str(end_ns + offset_ns)}
    rest = {name: value for name, value in metadata.items() if name != meta.KEY_PATTERN}
    key = dated(metadata[meta.KEY_PATTERN], start_ns + offset_ns)
    return key, {**rest, **times, meta.CLOCK: meta.SET_LATER, meta.CLOCK_OFFSET_NS: str(offset_ns)}
