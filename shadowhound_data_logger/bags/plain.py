"""The slices of an MCAP bag as one row of messages. A slice is opened when something of it is wanted, by its summary first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Final

from shadowhound_data_logger.bags.description import BagPart, Description
from shadowhound_data_logger.mcap.index import McapIndex, read_index
from shadowhound_data_logger.mcap.messages import MessageFilter, RecordedMessage, read_messages
from shadowhound_data_logger.mcap.ranges import Ranged

THREADS: Final = 8


def is_plain(told: Description | None, slices: Sequence[str]) -> bool:
    """Whether a bag is of MCAP files that can be read as they lie."""
    if told is None:
        return bool(slices) and all(name.endswith('.mcap') for name in slices)
    return told.storage == 'mcap' and not told.compression


class Plain:
    """Life: New; used by one thread. ``told`` saves opening slices of which it says that they are of another time."""

    def __init__(self, sources: Sequence[Ranged], told: Description | None) -> None:
        self._sources = sources
        self._told = told
        self._times = _times(told, sources)
        self._index: Callable[[int], McapIndex] = cache(lambda place: read_index(sources[place]))

    def span(self) -> tuple[int, int]:
        if self._told is not None and self._told.messages:
            return self._told.t_start_ns, self._told.t_end_ns
        self._open(range(len(self._sources)))
        found = [index for index in map(self._index, range(len(self._sources))) if index.messages]
        return min((index.t_start_ns for index in found), default=0), max((index.t_end_ns for index in found), default=0)

    def topics(self) -> set[str]:
        if self._told is not None:
            return {topic.name for topic in self._told.topics}
        places = range(len(self._sources))
        self._open(places)
        return {channel.topic for place in places for channel in self._index(place).channels.values()}

    def messages(self, wanted: MessageFilter) -> Iterator[RecordedMessage]:
        places = [place for place in range(len(self._sources)) if self._may_have(place, wanted)]
        self._open(places)
        for place in places:
            yield from read_messages(self._sources[place], self._index(place), wanted)

    def _open(self, places: Sequence[int]) -> None:
        """Several at a time."""
        with ThreadPoolExecutor(THREADS, 'bag-open') as pool:
            list(pool.map(self._index, places))

    def _may_have(self, place: int, wanted: MessageFilter) -> bool:
        part = self._times[place]
        if part is None or part.t_start_ns is None or part.t_end_ns is None:
            return part is None or part.messages != 0
        return part.t_start_ns < wanted.end_ns and part.t_end_ns >= wanted.start_ns


def _times(told: Description | None, sources: Sequence[Ranged]) -> list[BagPart | None]:
    parts = {part.name: part for part in told.parts} if told else {}
    return [parts.get(source.name.rpartition('/')[2]) for source in sources]
