"""The objects of a bag on their way into the spool: its slices one by one, then ``metadata.yaml`` and ``manifest.json``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.bags.manifest import COMPLETE, GAPS, RECOVERED, Manifest, SliceEntry, topics_of
from shadowhound_data_logger.bags.metadata import metadata_yaml
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA, key_of, slice_number
from shadowhound_data_logger.bags.notes import Notes
from shadowhound_data_logger.bags.slice_info import SliceInfo
from shadowhound_data_logger.model import DataObject, FileBody

SENSOR: Final = 'bag'
ENDING_PRIORITY: Final = 1
"""Metadata and manifest are small, and without them the bag seems to grow still."""
EVENT_PRIORITY: Final = 1
"""Of an event's slices: before whatever the sensors keep, and like the ending never evicted."""


def ros_distro() -> str:
    """What rosbag2 writes of the distribution; empty where ROS is not sourced."""
    return os.environ.get('ROS_DISTRO', '')


def slice_object(notes: Notes, info: SliceInfo, priority: int) -> DataObject:
    """A closed slice; its messages count in the accounts of the bags, or of the events, whose own priority goes first."""
    is_event = notes.event is not None
    metadata = {
        **_marks(notes), 'slice': str(slice_number(notes.bag, info.path.name)), 'messages': str(info.messages),
        't_start_ns': str(info.t_start_ns), 't_end_ns': str(info.t_end_ns),
    }  # fmt: skip
    return DataObject(
        bucket=BUCKET, key=key_of(notes.robot, notes.bag, info.path.name), body=FileBody(info.path, info.bytes, info.sha256),
        content_type='application/octet-stream', sensor=SENSOR, topic=None, type='', samples=info.messages,
        t_start_ns=info.t_start_ns, t_end_ns=info.t_end_ns, priority=EVENT_PRIORITY if is_event else priority,
        protected=is_event, metadata=metadata,
        counts={f'{notes.sink}{topic}': count for topic, count in info.counts.items() if count},
    )  # fmt: skip


def ending_objects(notes: Notes) -> Iterator[DataObject]:
    """What makes the bag whole; ``notes`` know all slices. The same notes give the same bytes."""
    slices = [notes.slices[file] for file in sorted(notes.slices, key=lambda file: slice_number(notes.bag, file) or 0)]
    entries = tuple(SliceEntry.of(info, key_of(notes.robot, notes.bag, info.path.name)) for info in slices)
    state = RECOVERED if not notes.ended else GAPS if notes.missing else COMPLETE
    manifest = Manifest(
        bag=notes.bag, robot=notes.robot, mission=notes.mission, state=state, missing=tuple(notes.missing),
        topics=topics_of(slices), slices=entries, event=notes.event,
    )  # fmt: skip
    span = min((one.t_start_ns for one in slices), default=0), max((one.t_end_ns for one in slices), default=0)
    yield _small(notes, METADATA, metadata_yaml(slices, ros_distro=ros_distro()), 'application/yaml', span)
    yield _small(notes, MANIFEST, manifest.to_json(), 'application/json', span)


def _small(notes: Notes, file: str, body: bytes, content_type: str, span: tuple[int, int]) -> DataObject:
    return DataObject(
        bucket=BUCKET, key=key_of(notes.robot, notes.bag, file), body=body, content_type=content_type, sensor=SENSOR, topic=None,
        type='', samples=0, t_start_ns=span[0], t_end_ns=span[1], priority=ENDING_PRIORITY, protected=True,
        metadata=_marks(notes),
    )  # fmt: skip


def _marks(notes: Notes) -> dict[str, str]:
    marks = {'robot': notes.robot, 'bag': notes.bag}
    if notes.event is not None:
        marks['event'] = notes.event.name
    if notes.mission is not None:
        marks |= {name: value for name in ('mission_id', 'run_id') if (value := getattr(notes.mission, name))}
    return marks
