"""Several processes read a dataset without shared state: each sample once per epoch, however they were started."""

from __future__ import annotations

import multiprocessing
import pickle
import subprocess
import sys
import threading
import time
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from lake.making import folder_store
from lake.training import FRAMES_HZ, Drive, in_a_child

from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake import MissionDataset, dataset, prefetch, shards
from shadowhound_data_logger.lake.bucket import Bucket

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

SECONDS = 10
CHILD_S = 60


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Bucket:
    """Ten archives of four frames each."""
    tmp = tmp_path_factory.mktemp('drive')
    Drive(folder_store(tmp), tmp).record(SECONDS, frames='tar', without=['imu', 'joints', 'lidar', 'lowstate'])
    return Bucket(folder_store(tmp), BUCKET)


@pytest.fixture
def in_worker(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The worker information that torch provides, and that torch is loaded."""
    told = types.SimpleNamespace(id=0, num_workers=1)
    module: Any = types.ModuleType('torch.utils.data')
    module.get_worker_info = lambda: told
    module.IterableDataset = type('IterableDataset', (), {'register': classmethod(lambda _, kind: kinds.append(kind))})
    kinds: list[type] = module.__dict__.setdefault('kinds', [])
    monkeypatch.setitem(sys.modules, 'torch.utils.data', module)

    def be(number: int, count: int) -> Any:
        told.id, told.num_workers = number, count
        return module

    return be


def stamps(stream: Any) -> list[int]:
    return [int(sample['stamp_ns']) for sample in stream]


def test_workers_cover_all_shards_completely(source: Bucket, in_worker: Any) -> None:
    """Three workers: no archive is read by two, every frame comes once; a DataLoader takes the stream for an IterableDataset."""
    frames = MissionDataset(source)
    got = []
    for number in range(3):
        module = in_worker(number, 3)
        got.append(stamps(frames.stream(shuffle=True)))
    assert dataset.MissionStream in module.kinds
    archives = [{stamp // 10**9 for stamp in mine} for mine in got]
    assert sum(map(len, archives)) == SECONDS
    assert len(set().union(*archives)) == SECONDS
    in_worker(0, 1)
    assert sorted(stamp for mine in got for stamp in mine) == stamps(frames.stream())


def test_ranks_split_what_their_workers_split(source: Bucket, in_worker: Any) -> None:
    """Two processes of two workers each: four shares of one whole."""
    frames, got = MissionDataset(source), []
    for rank in range(2):
        for number in range(2):
            in_worker(number, 2)
            got += stamps(frames.stream(shuffle=True, rank=rank, ranks=2))
    in_worker(0, 1)
    assert sorted(got) == stamps(frames.stream())


def test_epochs_differ_and_can_be_had_again(source: Bucket) -> None:
    """Each iteration is another epoch's order, ``set_epoch`` names one, and seeds differ."""
    frames = MissionDataset(source)
    stream = frames.stream(shuffle=True, seed=7)
    first, second = stamps(stream), stamps(stream)
    assert first != second
    assert sorted(first) == sorted(second) == stamps(frames.stream())
    stream.set_epoch(1)
    assert stamps(stream) == second
    assert stamps(frames.stream(shuffle=True, seed=8)) != first
    assert stamps(pickle.loads(pickle.dumps(frames.stream(shuffle=True, seed=7)))) == first  # noqa: S301 - our own


def test_a_shuffled_stream_mixes_archives_and_reads_each_once(source: Bucket) -> None:
    """Neighbors in the stream come from several archives, and no object is fetched twice."""
    frames = MissionDataset(source)
    asked: list[str] = []
    read = frames._place.read

    class Place:
        def read(self, bucket: str, key: str, most: int) -> bytes:
            asked.append(key)
            return read(bucket, key, most)

    frames._place = Place()  # type: ignore[assignment]
    mixed = [stamp // 10**9 for stamp in stamps(frames.stream(shuffle=True))]
    assert len(set(mixed[: 2 * FRAMES_HZ])) > 2
    assert sorted(asked) == sorted(set(asked))
    assert len(asked) == SECONDS


def test_a_shard_of_single_objects_is_bounded() -> None:
    """A track of single frames is cut every 64 objects, an archive is one shard."""
    counts = np.array([1] * 70 + [30, 30] + [1] * 2)
    track = types.SimpleNamespace(count=counts)
    cut = shards.shards([track], [np.arange(len(counts))])  # type: ignore[list-item]
    assert [(each.first, each.last) for each in cut] == [(0, 64), (64, 70), (70, 71), (71, 72), (72, 74)]


def test_what_is_read_ahead_is_bounded(source: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the first sample, no more than the limit and one object is requested."""
    frames = MissionDataset(source)
    size = int(frames._selection.anchors[0].size[0])
    monkeypatch.setattr(dataset, 'PREFETCH_BYTES', 3 * size)
    asked: list[str] = []
    read = frames._place.read
    frames._place = types.SimpleNamespace(read=lambda bucket, key, most: (asked.append(key), read(bucket, key, most))[1])  # type: ignore[assignment]
    streamed = iter(frames.stream())
    next(streamed)
    streamed.close()  # type: ignore[attr-defined]
    assert len(asked) <= 5


@pytest.mark.long('a second of CPU or more')
@pytest.mark.seaweedfs
@pytest.mark.parametrize('way', ['fork', 'spawn'])
def test_a_process_that_was_started_after_reading(tmp_path: Path, seaweed: Tower, way: str) -> None:
    """Forked or spawned, it reads from the server what its parent reads, though the parent has connections and threads."""
    robot = f'worker{way}'
    Drive(seaweed.store_settings(), tmp_path, robot).record(4)
    frames = MissionDataset(Bucket(seaweed.store_settings(), BUCKET), robot=robot)
    expected = [int(sample['stamp_ns']) for sample in frames.__getitems__(range(4))]
    context: Any = multiprocessing.get_context(way)
    out = context.SimpleQueue()
    child = context.Process(target=in_a_child, args=(frames, range(4), out))
    child.start()
    try:
        child.join(CHILD_S)
        assert child.exitcode == 0
        assert out.get() == expected
    finally:
        child.kill()
        child.join()
        frames.close()


def test_a_pickled_data_set_is_a_value(source: Bucket) -> None:
    """No thread, lock or connection goes along, and neither does what was read."""
    frames = MissionDataset(source)
    before = len(pickle.dumps(frames))
    frames.__getitems__(range(len(frames)))
    assert len(pickle.dumps(frames)) == before
    frames.close()


@pytest.mark.long('a process of its own')
def test_importing_it_loads_no_torch() -> None:
    """Nor is it needed to make a data set of nothing."""
    load = 'import sys; from shadowhound_data_logger.lake import MissionDataset'
    program = f'{load}; print("torch" in sys.modules, MissionDataset.__name__)'
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.split() == ['False', 'MissionDataset']


@pytest.mark.parametrize('style', ['number', 'stream'])
def test_with_the_real_data_loader(source: Bucket, style: str) -> None:
    """Two forked workers give every frame once, as tensors."""
    data = pytest.importorskip('torch.utils.data', reason='torch is not installed (the extra "train")')
    frames = MissionDataset(source, align={'odom': 0.5})
    given = frames if style == 'number' else frames.stream(shuffle=True)
    loader = data.DataLoader(given, batch_size=3, num_workers=2, shuffle=True if style == 'number' else None)
    batches = list(loader)
    assert sorted(int(stamp) for batch in batches for stamp in batch['stamp_ns']) == sorted(stamps(frames.stream()))
    assert tuple(batches[0]['image'].shape[1:]) == (24, 32, 3)
    assert tuple(batches[0]['odom'].shape[1:]) == (13,)


def test_the_threads_of_a_process_open_one_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads that start at the same time share one store: a client of S3 takes half a second and megabytes."""
    opened: list[object] = []
    begin = threading.Barrier(8)

    def open_slowly(*_: object) -> object:
        opened.append(object())
        time.sleep(0.05)  # a client takes longer
        return opened[-1]

    def ask(_: int) -> object:
        begin.wait()
        return prefetch._of_this_process(StoreSettings(directory=tmp_path))

    monkeypatch.setattr(prefetch, 'open_store', open_slowly)
    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(ask, range(8)))
    assert [*found] == opened
