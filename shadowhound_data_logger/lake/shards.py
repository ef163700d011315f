"""The order in which a dataset is streamed, and its distribution to workers: by whole shards, so that one worker reads an object.

A shard is an archive, or consecutive objects of one message each.
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
"""Objects of one message each in a shard: neighbors share the batches of the aligned sensors."""
MIXED: Final = 4
"""Shards whose samples are shuffled together."""


class Reference(NamedTuple):
    """One sample: the anchor's track, the object in the track, and the message in the object."""

    track: int
    number: int
    member: int


class Shard(NamedTuple):
    """Objects ``first`` to ``last`` (exclusive) of a track."""

    track: int
    first: int
    last: int


def shards(tracks: Sequence[Track], chosen: Sequence[NDArray[np.intp]]) -> list[Shard]:
    """All shards, ordered by time for each robot; their bounds are indices into the ``chosen`` objects of a track."""
    found: list[Shard] = []
    for number, (track, objects) in enumerate(zip(tracks, chosen, strict=True)):
        first = 0
        for index in range(len(objects)):
            is_archive = track.count[objects[index]] > 1
            if is_archive and index > first:
                found.append(Shard(number, first, index))
                first = index
            if is_archive or index + 1 - first == SHARD:
                found.append(Shard(number, first, index + 1))
                first = index + 1
        if first < len(objects):
            found.append(Shard(number, first, len(objects)))
    return found


def order(tracks: Sequence[Track], chosen: Sequence[NDArray[np.intp]], *, share: tuple[int, int], seed: int | None,
          epoch: int) -> Iterator[Reference]:  # fmt: skip
    """The samples of one share (number, total), ordered by time without a seed. Together, the shares contain all samples."""
    every = shards(tracks, chosen)
    rng = None if seed is None else np.random.default_rng((seed, epoch))
    if rng is not None:
        every = [every[index] for index in rng.permutation(len(every))]
    mine = every[share[0] :: share[1]]
    mixed = None if seed is None else np.random.default_rng((seed, epoch, share[0]))
    for start in range(0, len(mine), MIXED if mixed is not None else 1):
        group = [reference for shard in mine[start : start + (MIXED if mixed is not None else 1)]
                 for reference in _references(shard, tracks, chosen)]  # fmt: skip
        places = range(len(group)) if mixed is None else mixed.permutation(len(group))
        yield from (group[int(index)] for index in places)


def _references(shard: Shard, tracks: Sequence[Track], chosen: Sequence[NDArray[np.intp]]) -> Iterator[Reference]:
    for number in chosen[shard.track][shard.first : shard.last]:
        for member in range(int(tracks[shard.track].count[number])):
            yield Reference(shard.track, int(number), member)


def worker_share() -> tuple[int, int]:
    """(number of this worker, number of workers) in a worker of a torch DataLoader; otherwise (0, 1)."""
    loading = sys.modules.get('torch.utils.data')
    worker = loading.get_worker_info() if loading is not None else None
    return (0, 1) if worker is None else (int(worker.id), int(worker.num_workers))
