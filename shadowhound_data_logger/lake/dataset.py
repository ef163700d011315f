"""Datasets of what robots stored, to train on: aligned samples of numpy arrays, by index or streamed, from a store or a folder.

Works with ``torch.utils.data.DataLoader`` without importing torch. The catalog is queried once, when a dataset is created; after
that, any number of processes, forked or spawned, only read objects.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.lake import shards
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.prefetch import Prefetch
from shadowhound_data_logger.lake.samples import POSE_GAP_NS, AlignedSample, Near, Samples, Window, is_complete
from shadowhound_data_logger.lake.track import Object, Track

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shadowhound_data_logger.lake.bucket import Bucket

THREADS: Final = 8
"""Concurrent requests per process."""
PREFETCH_BYTES: Final = 32 << 20
"""Limit for prefetched objects per process."""
PREFETCH_OBJECTS: Final = 64
"""The same limit in objects."""
CACHE_BYTES: Final = 32 << 20
"""Contents per process that are kept after use, because they may be needed again."""


class MissionDataset:
    """Messages of one sensor, the anchor, each with the messages of other sensors at that time. A map-style torch dataset.

    A sample is a dict of numpy arrays: ``image`` (height, width, 3) uint8 RGB or ``cloud`` (n, 4) float32, ``stamp_ns``, ``pose``
    (x, y, yaw), ``battery_pct``; for each aligned sensor NAME its values, ``NAME_ok`` (whether there is one; for a window one per
    row) and ``NAME_dt_s`` (how much later than the anchor it was). Missing values are NaN, a missing cloud has no points.

    It can be pickled for the workers of a DataLoader, without sockets, threads and contents.
    """

    def __init__(
        self, source: Bucket | Path | str | None = None, *, anchor: str = 'camera',
        align: Mapping[str, float | Near | Window] | None = None, size: tuple[int, int] | None = None,
        drop_incomplete: bool = False, causal: bool = False, pull: bool = False, **flags: Any,
    ) -> None:  # fmt: skip
        """Query the catalog once; samples are read when they are needed.

        Args:
            source: a store, or a folder that ``shadowhound-data fetch`` wrote; by default the store that the environment names.
            anchor: the sensor with images or clouds. Each of its messages is a sample.
            align: sensor -> how near in time its message must be: seconds for the nearest message, or ``Near`` or ``Window``.
            size: (height, width) to which images are scaled.
            drop_incomplete: skip objects for which the tables have no data of an aligned sensor at that time. A stream also skips
                single incomplete messages.
            causal: no aligned message is later than its anchor, as a robot would not have had it yet. ``pose`` and
                ``battery_pct`` come from the catalog, which interpolates.
            pull: request what robots keep of these sensors, and wait until it has arrived. The log shows the progress.
            flags: which objects of the anchor, as in ``lake.objects``, with ``as_of``. Objects without a date are never included.

        Raises:
            SettingError: an argument is invalid.
            StoreError: the store cannot be read.
            UnknownName: the catalog has no sensor of the anchor's name, or none of a name in ``flags``.
            LakeError: the catalog contradicts itself.
        """
        from shadowhound_data_logger.lake import selecting  # noqa: PLC0415 - workers need no tables

        if 'sensor' in flags:
            raise SettingError('sensor', flags['sensor'], 'anchor="camera" instead')
        self.aligned = {name: _alignment(name, how, causal=causal) for name, how in (align or {}).items()}
        self._place, asked = selecting.place(source)
        self._lake = asked
        self.skipped = Findings()
        """Rows and files of the catalog that were skipped because they are invalid. Empty in a worker process."""
        if pull:
            selecting.pull(asked, source, (anchor, *self.aligned), flags, self.skipped)
        self._selection = selecting.select(asked, anchor, self.aligned, size, flags, self.skipped)
        self._drop_incomplete = drop_incomplete
        self._chosen = [self._complete_objects(track) for track in self._selection.anchors]
        counts = [track.count[chosen] for track, chosen in zip(self._selection.anchors, self._chosen, strict=True)]
        self._ends = np.cumsum(np.concatenate([np.empty(0, np.int64), *counts]))
        self._reading: tuple[int, Prefetch, Samples] | None = None

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> AlignedSample:
        return self._samples().sample(*self._location(self._reference(index)))

    def __getitems__(self, indices: Sequence[int]) -> list[AlignedSample]:
        """Several at once, whose objects are read at the same time; torch's DataLoader asks for whole batches so."""
        wanted = [self._location(self._reference(index)) for index in indices]
        objects = [each for track, number, _ in wanted for each in self._selection.needed(track, number)]
        samples = self._samples()
        assert self._reading is not None
        prefetch = self._reading[1]
        prefetch.ahead(objects)
        try:
            return [samples.sample(*each) for each in wanted]
        finally:
            prefetch.discard(objects)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, '_reading': None}

    def __repr__(self) -> str:
        return f'MissionDataset({len(self):,} samples in {sum(map(len, self._chosen)):,} objects)'

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """The time of each sample by the catalog: exact for single messages, evenly spread within an archive."""
        found = [
            track.stamps_ns(int(number))
            for track, chosen in zip(self._selection.anchors, self._chosen, strict=True)
            for number in chosen
        ]
        return np.concatenate([np.empty(0, np.int64), *found])

    @property
    def poses(self) -> NDArray[np.float64]:
        """(samples, 3): x, y and yaw by the catalog at the times of ``stamps_ns``; NaN where unknown."""
        found: list[NDArray[np.float64]] = []
        for track, chosen in zip(self._selection.anchors, self._chosen, strict=True):
            if (track.count[chosen] == 1).all():
                found.append(track.pose[chosen])
            else:
                found += [track.pose_at(int(number), int(stamp_ns), POSE_GAP_NS)[None]
                          for number in chosen for stamp_ns in track.stamps_ns(int(number))]  # fmt: skip
        return np.concatenate([np.empty((0, 3)), *found])

    def labels(self) -> list[list[str]]:
        """The current labels of each sample: those of its time and of its object. A folder has none. Raises StoreError."""
        from shadowhound_data_logger.lake import selecting  # noqa: PLC0415 - workers need no tables

        tracks = zip(self._selection.anchors, self._chosen, strict=True)
        return selecting.labels_of(
            self._lake, [(track, int(number)) for track, chosen in tracks for number in chosen], self.skipped
        )

    def stream(self, *, shuffle: bool = False, seed: int = 0, rank: int = 0, ranks: int = 1) -> MissionStream:
        """The same samples as an iterable torch dataset, which reads ahead.

        Args:
            shuffle: in random order, by shards.
            seed: of that order.
            rank: of this process among those that train together; each gets other samples.
            ranks: how many processes train together.
        """
        return MissionStream(self, seed if shuffle else None, (rank, ranks))

    def streamed(self, share: tuple[int, int], seed: int | None, epoch: int) -> Iterator[AlignedSample]:
        """One share (number, total) of one epoch; ``MissionStream`` calls it."""
        references = shards.order(self._selection.anchors, self._chosen, share=share, seed=seed, epoch=epoch)
        with Prefetch(self._place.read, CACHE_BYTES, THREADS) as prefetch:
            samples = Samples(self._selection, prefetch)
            waiting: deque[tuple[shards.Reference, tuple[Object, ...]]] = deque()
            while True:
                self._prefetch(references, waiting, prefetch)
                if not waiting:
                    return
                reference, objects = waiting.popleft()
                sample = samples.sample(*self._location(reference))
                if not waiting or waiting[0][0][:2] != reference[:2]:
                    prefetch.discard(objects)
                if not self._drop_incomplete or is_complete(sample, self.aligned):
                    yield sample

    def _prefetch(self, references: Iterator[shards.Reference], waiting: deque[tuple[shards.Reference, tuple[Object, ...]]],
                  prefetch: Prefetch) -> None:  # fmt: skip
        """Request objects in advance; at least one reference waits afterwards, unless there are no more."""
        while not waiting or (len(waiting) < PREFETCH_OBJECTS and prefetch.waiting_bytes < PREFETCH_BYTES):
            reference = next(references, None)
            if reference is None:
                return
            if waiting and waiting[-1][0][:2] == reference[:2]:
                objects = waiting[-1][1]
            else:
                objects = tuple(self._selection.needed(*self._location(reference)[:2]))
            prefetch.ahead(objects)
            waiting.append((reference, objects))

    def close(self) -> None:
        """Stop the threads of this process; the next sample starts them again."""
        if self._reading is not None:
            self._reading[1].close()
            self._reading = None

    def _complete_objects(self, track: Track) -> NDArray[np.intp]:
        every = np.arange(len(track))
        if not self._drop_incomplete:
            return every
        return np.array([number for number in every if self._selection.has_aligned_data(track, int(number))], np.intp)

    def _reference(self, index: int) -> shards.Reference:
        if not -len(self) <= index < len(self):
            raise IndexError(f'{index} of {len(self)} samples')
        index %= len(self)
        place = int(np.searchsorted(self._ends, index, 'right'))
        member = index - (int(self._ends[place - 1]) if place else 0)
        for number, chosen in enumerate(self._chosen):
            if place < len(chosen):
                return shards.Reference(number, int(chosen[place]), member)
            place -= len(chosen)
        raise AssertionError('unreachable')

    def _location(self, reference: shards.Reference) -> tuple[Track, int, int]:
        return self._selection.anchors[reference.track], reference.number, reference.member

    def _samples(self) -> Samples:
        """The reader of this process: a child cannot use its parent's."""
        if self._reading is None or self._reading[0] != os.getpid():
            prefetch = Prefetch(self._place.read, CACHE_BYTES, THREADS)
            self._reading = os.getpid(), prefetch, Samples(self._selection, prefetch)
        return self._reading[2]


class MissionStream:
    """The samples of a ``MissionDataset`` one after another, optionally shuffled.

    Each iteration is one epoch; a shuffled one has another order. Several iterations may run at the same time.
    """

    def __init__(self, dataset: MissionDataset, seed: int | None, part: tuple[int, int]) -> None:
        self._dataset = dataset
        self._seed = seed
        self._part = part
        self._epoch = 0
        _register_as_iterable()

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next iteration.

        Call it before each epoch if the DataLoader starts new workers for it; those of ``persistent_workers`` count on their own.
        """
        self._epoch = epoch

    def __iter__(self) -> Iterator[AlignedSample]:
        worker, workers = shards.worker_share()
        share = self._part[0] * workers + worker, self._part[1] * workers
        epoch, self._epoch = self._epoch, self._epoch + 1
        return self._dataset.streamed(share, self._seed, epoch)


def _alignment(name: str, how: float | Near | Window, *, causal: bool) -> Near | Window:
    """Raises SettingError for a window into the future of a causal dataset."""
    found = how if isinstance(how, (Near, Window)) else Near(float(how))
    if causal and isinstance(found, Window) and found.after_s > 0:
        raise SettingError(f'align[{name!r}]', how, 'a window with after_s=0 in a causal dataset')
    return replace(found, is_causal=True) if causal and isinstance(found, Near) else found


def _register_as_iterable() -> None:
    """A DataLoader recognizes iterable datasets by torch's class: register ours if torch is loaded."""
    loading = sys.modules.get('torch.utils.data')
    if loading is not None:
        loading.IterableDataset.register(MissionStream)
