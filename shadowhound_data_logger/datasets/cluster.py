"""Builds episodes in parallel on a Ray cluster, one mission per worker. Only this machine writes the dataset.

A worker reads the store, builds the episode in a local folder, and returns its files in pieces: the machines need no shared disk.
This uses Ray's actors instead of Daft's DataFrame, whose row would be a complete episode with its videos in memory; here each
mission is retried, kept or reported separately.
"""

from __future__ import annotations

import json
import os
import platform
import socket
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from shutil import rmtree
from tempfile import gettempdir, mkdtemp
from typing import Any, Final
from urllib.parse import urlsplit

import shadowhound_data_logger
from shadowhound_data_logger.core.durable_files import fingerprint, flock, lock, replacing
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.datasets.episodes import EPISODE_JSON, build
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.plan import EpisodePlan

ATTEMPTS: Final = 3
"""Workers that may fail on a mission before the export gives up."""
PREFIX: Final = 'shadowhound-export-'
REACH_S: Final = 10.0
PIECE_BYTES: Final = 8 << 20
LIBRARIES: Final = ('av', 'numpy', 'pillow', 'pyarrow', 'simplejpeg')
"""Libraries that determine the bytes of an episode."""

EpisodeJob = tuple[EpisodePlan, ExportOptions, int, StoreSettings, Path]
"""The arguments of ``build``; the folder is on this machine."""
Files = Mapping[str, tuple[int, str]]
"""Name -> bytes and SHA-256."""


class Builder:
    """Runs in a worker. For each mission: ``build``, ``read`` its files, ``close``."""

    def __init__(self) -> None:
        """Removes the folders of killed workers of this machine: a running one has a lock on its folder."""
        for left in Path(gettempdir()).glob(f'{PREFIX}*'):
            with suppress(OSError), flock(left / 'lock', wait=False) as is_dead:
                if is_dead:
                    rmtree(left)

    def build(self, job: tuple[EpisodePlan, ExportOptions, int, StoreSettings], wanted: Mapping[str, str]) -> Files:
        """Raises LakeError if this machine would produce other bytes, StoreError, OSError."""
        here = library_versions()
        if other := [name for name in wanted if here[name] != wanted[name]]:
            differences = ', '.join(f'{name} {here[name]} instead of {wanted[name]}' for name in other)
            raise LakeError(f'the worker {platform.node()} has {differences}: its episodes would have other bytes',
                            remedy='install the same versions on all machines of the cluster')  # fmt: skip
        new = Path(mkdtemp(prefix=f'new-{PREFIX}'))
        self._lock = (new / 'lock').open('wb')
        lock(self._lock)
        self._folder = new.rename(new.with_name(new.name.removeprefix('new-'))) / 'episode'
        build(*job, self._folder)
        return {path.name: fingerprint(path) for path in sorted(self._folder.iterdir())}

    def read(self, name: str, begin: int) -> bytes:
        """A piece of a file."""
        with (self._folder / name).open('rb') as file:
            file.seek(begin)
            return file.read(PIECE_BYTES)

    def close(self) -> None:
        """Delete the files."""
        rmtree(self._folder.parent, ignore_errors=True)
        self._lock.close()


def library_versions() -> dict[str, str]:
    """Versions that must be equal on all machines for equal bytes."""
    return {'architecture': platform.machine(), **{name: version(name) for name in LIBRARIES}}


@dataclass(frozen=True, slots=True)
class Cluster:
    """A Ray cluster that builds episodes."""

    address: str | None = None
    """``ray://HEAD:10001`` or ``HEAD:6379``; None: the cluster of this machine, otherwise a Ray started for the export."""

    def built(self, jobs: Sequence[EpisodeJob], workers: int | None, say: Callable[[str], None]) -> list[dict[str, Any]]:
        """The ``episode.json`` of each job, in order; the files are in the folders of the jobs.

        ``workers`` episodes are built at a time, by default one per core of the cluster. A mission whose worker dies is given
        to another one. Raises LakeError if that fails too or there is no such cluster, StoreError, OSError.
        """
        todo = [job for job in jobs if not (job[-1] / EPISODE_JSON).is_file()]
        if todo:
            with _joined(self.address) as cores, redirect_stdout(sys.stderr):  # where Ray reports failed workers
                _build_all(todo, workers or cores, say)
        return [json.loads((job[-1] / EPISODE_JSON).read_text(encoding='utf-8')) for job in jobs]


@contextmanager
def _joined(address: str | None) -> Iterator[int]:
    """Connect to the cluster, with this version of the package on its workers; yields its number of cores."""
    _reach(address or os.environ.get('RAY_ADDRESS', ''))
    import ray  # noqa: PLC0415 - only here it is needed

    ours = {'py_modules': [os.fspath(Path(shadowhound_data_logger.__file__).parent)]}
    os.environ.setdefault('RAY_USAGE_STATS_ENABLED', '0')  # otherwise it reports each run over the network
    try:
        ray.init(address, log_to_driver=False, logging_level='ERROR', runtime_env=ours)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise _no_cluster(address or 'this machine', error) from error
    try:
        yield max(1, int(ray.cluster_resources().get('CPU', 1)))
    finally:
        ray.shutdown()


def _reach(address: str) -> None:
    """Check the connection first, because Ray keeps trying for minutes if nothing answers. Raises LakeError."""
    try:
        place = urlsplit(address if '//' in address else f'//{address}')
        if place.hostname and place.port:
            socket.create_connection((place.hostname, place.port), REACH_S).close()
    except (OSError, ValueError) as error:
        raise _no_cluster(address, error) from error


def _no_cluster(place: str, error: Exception) -> LakeError:
    return LakeError(f'there is no Ray cluster at {place}: {error}', remedy='name its head: --ray ray://HEAD:10001')


def _build_all(jobs: Sequence[EpisodeJob], workers: int, say: Callable[[str], None]) -> None:
    import ray  # noqa: PLC0415
    from ray.exceptions import RayError, RayTaskError  # noqa: PLC0415

    new_builder = ray.remote(num_cpus=1)(Builder)
    wanted = library_versions()
    waiting, running, idle = deque((job, 1) for job in jobs), dict[Any, tuple[Any, EpisodeJob, int]](), list[Any]()
    failed: dict[str, str] = {}
    done = 0
    while waiting or running:
        while waiting and len(running) < workers:
            job, attempt = waiting.popleft()
            builder = idle.pop() if idle else new_builder.remote()
            running[builder.build.remote(job[:-1], wanted)] = builder, job, attempt
        ready = ray.wait(list(running))[0][0]
        builder, job, attempt = running.pop(ready)
        mission = job[0].mission.mission_id
        try:
            _download(builder, ray.get(ready), job[-1])
        except RayTaskError as error:
            raise error.cause from None
        except RayError as error:
            ray.kill(builder)
            why = f'{mission}: its worker was killed ({type(error).__name__})'
            if attempt < ATTEMPTS:
                say(f'{why}, another one starts again')
                waiting.append((job, attempt + 1))
            else:
                failed[mission] = why
            continue
        if waiting:
            idle.append(builder)
        else:
            ray.kill(builder)  # its core may be needed by another one, after a machine failed
        done += 1
        say(f'episode {done} of {len(jobs)}: {mission}')
    if failed:
        reasons = ', '.join(failed.values())
        raise LakeError(f'{reasons}, {ATTEMPTS} times; nothing was added to the dataset',
                        remedy=f'run it again: the {done} finished episodes are kept')  # fmt: skip


def _download(builder: Any, files: Files, folder: Path) -> None:
    """Download a worker's files, ``episode.json`` last. Raises RayError, and LakeError if their content differs."""
    import ray  # noqa: PLC0415

    rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, written in sorted(files.items(), key=lambda each: each[0] == EPISODE_JSON):
        with replacing(folder / name, is_synced=name == EPISODE_JSON) as file:
            for begin in range(0, written[0], PIECE_BYTES):
                file.write(ray.get(builder.read.remote(name, begin)))
        if fingerprint(folder / name) != tuple(written):
            raise LakeError(f'{name} of a worker arrived with different content', remedy='run it again')
    ray.get(builder.close.remote())
