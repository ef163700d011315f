"""Cuts a time range out of slices that the robot keeps into a small separate bag, which answers a request for a few seconds.

The bag's name is derived from its content, so the same range is cut and sent only once, even for several requests.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import COMPLETE, Manifest, MissionOf, SliceEntry, topics_of
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA, key_of, natural_key, slice_file
from shadowhound_data_logger.bags.objects import SENSOR, ros_distro
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES
from shadowhound_data_logger.core.model import DataObject, FileBody
from shadowhound_data_logger.formats.mcap.index import read_summary
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.spool.request_table import KeptSlice

CUTTING: Final = 'cutting'
"""Folder for cuts in progress, by robot, in SHADOWHOUND_HOME."""


def sweep(home: Path, robot: str) -> None:
    """Remove unfinished cuts of a process of this robot that crashed."""
    shutil.rmtree(home / CUTTING / robot, ignore_errors=True)


class KeptCut:
    """A cut out of kept slices of one bag.

    Lifecycle: new; ``work`` once. The only files that remain are those of the objects it returned, which the spool takes over.
    """

    def __init__(self, home: Path, slices: Sequence[KeptSlice], since_ns: int, until_ns: int, priority: int) -> None:
        """From ``since_ns``, before ``until_ns``, Unix nanoseconds. ``slices`` has at least one slice; all are of one bag."""
        self.slices = sorted(slices, key=lambda each: natural_key(each.key))
        self._span = since_ns, until_ns
        self._priority = priority
        self.robot, _, self._of, _ = slices[0].key.split('/')
        content = '\n'.join((*(each.sha256 for each in self.slices), str(since_ns), str(until_ns)))
        mark = f'_cut_{hashlib.sha256(content.encode()).hexdigest()[:8]}'
        self.bag = f'{self._of[: MAX_BAG_BYTES - len(mark)]}{mark}'
        self._folder = home / CUTTING / self.robot / self.bag

    @property
    def places(self) -> list[tuple[str, str]]:
        """(bucket, key) of its objects."""
        return [(BUCKET, key_of(self.robot, self.bag, file)) for file in (slice_file(self.bag, 0), METADATA, MANIFEST)]

    def work(self) -> Generator[None, None, list[DataObject]]:
        """Cut, and yield after each chunk; returns the objects, or none if the range has no messages.

        Raises BagDamaged for an unreadable slice, OSError.
        """
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(mode=0o700, parents=True)
        writer = SliceWriter(self._folder / slice_file(self.bag, 0), ros_distro=ros_distro())
        try:
            for each in self.slices:
                yield from self._copy(each, writer)
            info = writer.close()
        except BaseException:
            writer.abort()
            self.clear()
            raise
        if not info.messages:
            self.clear()
            return []
        return self._objects(info)

    def clear(self) -> None:
        """Delete its files."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _copy(self, each: KeptSlice, writer: SliceWriter) -> Generator[None, None, None]:
        """Copy one chunk at a time, because ``read_messages`` would read several ahead."""
        source = LocalFile(each.path)
        index = read_summary(source)
        if index is None or index.chunks is None:
            raise BagDamaged(f'{source.name} has no index', path=source.name)
        wanted = MessageFilter(*self._span, lambda _: True)
        for chunk in index.chunks:
            for message in read_messages(source, replace(index, chunks=(chunk,)), wanted):
                writer.copy(message.channel, message.log_ns, message.publish_ns, message.sequence, message.cdr)
            yield

    def _objects(self, info: SliceInfo) -> list[DataObject]:
        source = self.slices[0].metadata
        copied = (meta.ROBOT, meta.MISSION_ID, meta.RUN_ID, meta.MISSION_TYPE)
        marks = {name: source[name] for name in copied if name in source} | {meta.BAG: self.bag, meta.CUT_OF: self._of}
        mission = MissionOf(source.get(meta.MISSION_TYPE, ''), source.get(meta.MISSION_ID), source.get(meta.RUN_ID))
        manifest = Manifest(
            bag=self.bag, robot=self.robot, mission=mission if mission.mission_id or mission.run_id else None, state=COMPLETE,
            missing=(), topics=topics_of([info]), slices=(SliceEntry.of(info, self.places[0][1]),),
        )  # fmt: skip
        times = {meta.T_START_NS: str(info.t_start_ns), meta.T_END_NS: str(info.t_end_ns)}
        bodies: tuple[tuple[FileBody | bytes, str, dict[str, str]], ...] = (
            (FileBody(info.path, info.bytes, info.sha256), 'application/octet-stream',
             {meta.SLICE: '0', meta.MESSAGES: str(info.messages), **times}),
            (metadata_yaml([info], ros_distro=ros_distro()), 'application/yaml', {}),
            (manifest.to_json(), 'application/json', {}),
        )  # fmt: skip
        return [
            DataObject(
                bucket=bucket, key=key, body=body, content_type=kind, sensor=SENSOR, topic=None, type='', samples=0,
                t_start_ns=info.t_start_ns, t_end_ns=info.t_end_ns, priority=self._priority, protected=True,
                metadata={**marks, **more},
            )
            for (bucket, key), (body, kind, more) in zip(self.places, bodies, strict=True)
        ]  # fmt: skip
