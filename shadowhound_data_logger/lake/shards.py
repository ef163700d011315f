"""In which order a data set is streamed, and which of it by whom: whole shards, so that a worker reads an object once.

A shard is an archive, or some objects of one message each that follow each other in time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shadowhound_data_logger.lake.track import Track

SHARD: Final = 64
"""Objects of one message each: neighbours share the batches of the sensors beside them."""
MIXED: Final = 4
"""Shards of which the samples are shuffled among each other."""


class Reference(NamedTuple):
    """One sample: which anchor's track, which object of it, which message in that."""

    track: int
    number: int
    member: int


class Shard(NamedTuple):
    """Objects ``first`` to ``last`` (exclusive) of a track."""

    track: int
    first: int
    last: int


def shards(tracks: Sequence[Track], chosen: Sequence[NDArray[np.intp]]) -> list[Shard]:
    """All of them, in the order of time of each robot; their bounds count the ``chosen`` objects of a track."""
    found: list[Shard] = []
    for number, (track, objects) in enumerate(zip(tracks, chosen, strict=True)):
        first = 0
        for place in range(len(objects)):
            is_archive = track.count[objects[place]] > 1
            if is_archive and place > first:
                found.append(Shard(number, first, place))
                first = place
            if is_archive or place + 1 - first == SHARD:
                found.append(Shard(number, first, place + 1))
                first = place + 1
        if first < len(objects):
            found.append(Shard(number, first, len(objects)))
    return found


def order(tracks: Sequence[Track], chosen: Sequence[NDArray[np.intp]], *, share: tuple[int, int], seed: int | None,
          epoch: int) -> Iterator[Reference]:  # fmt: skip
    """The samples of one share of (share, shares); without a seed in the order of time. All shares together are all samples."""
    every = shards(tracks, chosen)
    rng = None if seed is None else np.random.default_rng((seed, epoch))
    if rng is not None:
        every = [every[place] for place in rng.permutation(len(every))]
    mine = every[share[0] :: share[1]]
    mixed = None if seed is None else np.random.default_rng((seed, epoch, share[0]))
    for begin in range(0, len(mine), MIXED if mixed is not None else 1):
        group = [reference for shard in mine[begin : begin + (MIXED if mixed is not None else 1)]
                 for reference in _references(shard, tracks, chosen)]  # fmt: skip
        places = range(len(group)) if mixed is None else mixed.permutation(len(group))
        yield from (group[int(place)] for place in places)


def _references(shard: Shard, tracks: Sequence[Track], chosen: Sequence[NDArray[np.intp]]) -> Iterator[Reference]:
    for number in chosen[shard.track][shard.first : shard.last]:
        for member in range(int(tracks[shard.track].count[number])):
            yield Reference(shard.track, int(number), member)


def worker_share() -> tuple[int, int]:
    """(this worker, workers) of a torch DataLoader's process; (0, 1) elsewhere, and without torch."""
    loading = sys.modules.get('torch.utils.data')
    told = loading.get_worker_info() if loading is not None else None
    return (0, 1) if told is None else (int(told.id), int(told.num_workers))
