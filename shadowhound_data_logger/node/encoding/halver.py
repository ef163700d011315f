"""Halves the rate of images and clouds in an object kept on the robot, for ``shipping/thinning.py``."""

from __future__ import annotations

import tarfile
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import orjson

from shadowhound_data_logger.bags.kept import CUTTING
from shadowhound_data_logger.bags.objects import ros_distro
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.model import FileBody
from shadowhound_data_logger.core.options import BULK
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar, pack_zip
from shadowhound_data_logger.formats.mcap.index import McapIndex, read_summary
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.shipping.thinning import may_halve, span_of
from shadowhound_data_logger.spool.kept_objects import ThinnableObject, Thinned

_PACK: Final = {'application/zip': pack_zip, 'application/x-tar': pack_tar}
_ALWAYS: Final = 1 << 63
_UNREADABLE: Final = (ValueError, LookupError, zipfile.BadZipFile, tarfile.TarError, NotImplementedError, EOFError)


class Halver:
    """Call it with an object; one thread. Its output exists until the next call, and is deleted by ``bags.kept.sweep``."""

    def __init__(self, home: Path, robot: str, min_hz: float) -> None:
        """No topic is thinned below ``min_hz``."""
        self._folder = home / CUTTING / robot / 'thinned'
        self._min_hz = min_hz

    def __call__(self, item: ThinnableObject) -> Thinned | None:
        """As ``ship.thinning.Halve``. Raises OSError, and BagDamaged for an unreadable object."""
        try:
            if item.path.suffix == '.mcap':
                return self._slice(item)
            return self._archive(item) if item.type in BULK and item.content_type in _PACK else None
        except _UNREADABLE as error:
            raise BagDamaged(str(error), path=str(item.path)) from error

    def _archive(self, item: ThinnableObject) -> Thinned | None:
        if not may_halve(item.samples, span_of(item.samples * item.step, item.t_start_ns, item.t_end_ns), self._min_hz):
            return None
        samples = list(_samples(item.path, item.content_type).items())
        if len(samples) != item.samples:
            return None
        body = _PACK[item.content_type](_members(dict(samples[::2]), dict(samples)))
        return Thinned(body, len(samples[::2])) if len(body) < item.bytes else None

    def _slice(self, item: ThinnableObject) -> Thinned | None:
        source = LocalFile(item.path)
        index = read_summary(source)
        numbers = self._halvable(index) if index is not None else set()
        if index is None or not numbers:
            return None
        bulk = {index.channels[number].topic for number in numbers}
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = self._folder / item.path.name
        path.unlink(missing_ok=True)
        path.with_name(f'{path.name}.open').unlink(missing_ok=True)
        seen, lost = Counter[str](), Counter[str]()
        writer = SliceWriter(path, ros_distro=ros_distro())
        try:
            for message in read_messages(source, index, MessageFilter(0, _ALWAYS, lambda _: True)):
                topic = message.channel.topic
                if topic in bulk and not message.channel.repeated:
                    seen[topic] += 1
                    if seen[topic] % 2 == 0:
                        lost[topic] += 1
                        continue
                writer.copy(message.channel, message.log_ns, message.publish_ns, message.sequence, message.cdr)
            info = writer.close()
        finally:
            writer.abort()
        if info.bytes >= item.bytes or info.messages + lost.total() != item.samples:
            path.unlink()
            return None
        return Thinned(FileBody(path, info.bytes, info.sha256), info.messages, dict(lost))

    def _halvable(self, index: McapIndex) -> set[int]:
        """Channels with images or clouds that can be halved."""
        return {
            number for number, channel in index.channels.items()
            if channel.type in BULK and may_halve(index.counts.get(number, 0), index.t_end_ns - index.t_start_ns, self._min_hz)
        }  # fmt: skip


def _samples(path: Path, content_type: str) -> dict[str, dict[str, bytes]]:
    """The files of each sample, by its name and theirs, in order."""
    found = defaultdict[str, dict[str, bytes]](dict)
    for name, body in _files(path, content_type):
        found[name.partition('.')[0]][name] = body
    return found


def _files(path: Path, content_type: str) -> Iterator[tuple[str, bytes]]:
    if content_type == 'application/zip':
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                yield name, archive.read(name)
        return
    with tarfile.open(path, mode='r:') as files:
        for member in files:
            file = files.extractfile(member)
            if file is not None:
                yield member.name, file.read()


def _members(kept: Mapping[str, Mapping[str, bytes]], samples: Mapping[str, Mapping[str, bytes]]) -> Iterator[ArchiveFile]:
    """Archive members as the encoder writes them: a repeat names its original; the first one left has the content."""
    first: dict[str, str] = {}
    for sample, files in kept.items():
        found = orjson.loads(files[f'{sample}.json'])
        stamp_ns = int(found['stamp_ns'])
        of = found.pop('repeat_of', None)
        if of is None:
            name, body = next((name, body) for name, body in files.items() if not name.endswith('.json'))
            origin = name
        else:
            origin, body = of, samples[of.partition('.')[0]][of]
            name = f'{sample}.{of.partition(".")[2]}'
        if origin in first:
            found['repeat_of'] = first[origin]
        else:
            first[origin] = name
            yield ArchiveFile(name, stamp_ns, body)
        yield ArchiveFile(f'{sample}.json', stamp_ns, orjson.dumps(found))
