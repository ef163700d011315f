"""The objects of a bag for the spool: its slices one by one, then ``metadata.yaml`` and ``manifest.json``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import COMPLETE, GAPS, RECOVERED, Manifest, Missing, SliceEntry, topics_of
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA, key_of, prefix_of, slice_number
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo
from shadowhound_data_logger.spool.retention import NO_ROOM
from shadowhound_data_logger.spool.writer import SpoolWriter

SENSOR: Final = 'bag'
ENDING_PRIORITY: Final = 1
"""Metadata and manifest are small, and without them the bag appears unfinished."""
EVICTED: Final = 'the whole slice: the spool was full'
EVENT_PRIORITY: Final = 1
"""Priority of an event's slices: uploaded before sensor data, and never evicted, like metadata and manifest."""


def ros_distro() -> str:
    """The distribution as rosbag2 records it; empty if ROS is not sourced."""
    return os.environ.get('ROS_DISTRO', '')


def slice_object(state: BagState, info: SliceInfo, priority: int, *, is_kept: bool = False) -> DataObject:
    """The object of a closed slice. Its messages are in the accounts of bags or events; events ignore ``priority``.

    ``is_kept``: it stays on the robot until it is requested, unless it belongs to an event.
    """
    is_event = state.event is not None
    file, (start_ns, end_ns) = state.final(info.path.name), _times(state, info.t_start_ns, info.t_end_ns)
    metadata = {
        **_marks(state), meta.SLICE: str(slice_number(state.bag, file)), meta.MESSAGES: str(info.messages),
        **({meta.T_START_NS: str(start_ns), meta.T_END_NS: str(end_ns)} if _is_dated(state) else {}),
        **_clock_marks(state, info.t_start_ns, info.t_end_ns),
        **({meta.SHIP: meta.ON_REQUEST} if is_kept and not is_event else {}),
    }  # fmt: skip
    return DataObject(
        bucket=BUCKET, key=key_of(state.robot, state.bag, file), body=FileBody(info.path, info.bytes, info.sha256),
        content_type='application/octet-stream', sensor=SENSOR, topic=None, type='', samples=info.messages,
        t_start_ns=start_ns, t_end_ns=end_ns, priority=EVENT_PRIORITY if is_event else priority,
        protected=is_event, metadata=metadata,
        counts={f'{state.sink}{topic}': count for topic, count in info.recorded.items() if count},
    )  # fmt: skip


def finish(state: BagState, writer: SpoolWriter, deadline_s: float) -> bool:
    """Spool metadata and manifest, in one transaction with the removal of the bag's rows; then delete the folder.

    Returns False if the spool did not finish within ``deadline_s``. Raises OSError or sqlite3.Error.
    """
    if not writer.flush(deadline_s):
        return False
    if not state.is_ending:
        rows = writer.spool.reading.objects.with_prefix(BUCKET, prefix_of(state.robot, state.bag))
        states = {row['key']: State(row['state']) for row in rows}
        ending: Iterable[DataObject] = ()
        if (state.slices or (state.ended and state.missing)) and key_of(state.robot, state.bag, MANIFEST) not in states:
            _note_evicted(state, states)
            ending = ending_objects(state)
        writer.put(*ending, rows=[state.completed()], wait=False)
        state.is_ending = True
    if not writer.flush(deadline_s):
        return False
    state.remove()
    return True


def _note_evicted(state: BagState, states: Mapping[str, State]) -> None:
    """Add slices that the full spool evicted to the losses. Evictions after the manifest was written are not in it.

    ``states`` has the state of every object of the bag that is or was in the spool.
    """
    known = _evicted(state)
    evicted = [
        info for file, info in state.slices.items()
        if file not in known and states.get(key_of(state.robot, state.bag, state.final(file))) is State.EVICTED
    ]  # fmt: skip
    state.add_missing(*(Missing(info.path.name, EVICTED, info.messages, None, NO_ROOM) for info in evicted))


def ending_objects(state: BagState) -> Iterator[DataObject]:
    """Metadata and manifest; ``state`` must have all slices. The same state always gives the same bytes."""
    evicted = _evicted(state)
    found = [replace(info, path=Path(state.final(file))) for file, info in state.slices.items() if file not in evicted]
    slices = sorted(found, key=lambda info: slice_number(state.bag, info.path.name) or 0)
    entries = tuple(SliceEntry.of(info, key_of(state.robot, state.bag, info.path.name)) for info in slices)
    how = RECOVERED if not state.ended else GAPS if state.missing else COMPLETE
    manifest = Manifest(
        bag=state.bag, robot=state.robot, mission=state.mission, state=how,
        missing=tuple(replace(one, file=state.final(one.file)) for one in state.missing),
        topics=topics_of(slices), slices=entries, event=state.event, clock=state.clock,
    )  # fmt: skip
    span = _times(state, min((one.t_start_ns for one in slices), default=0), max((one.t_end_ns for one in slices), default=0))
    metadata = metadata_yaml(slices, ros_distro=ros_distro(), custom_data=_clock_marks(state))
    yield _document(state, METADATA, metadata, 'application/yaml', span)
    yield _document(state, MANIFEST, manifest.to_json(), 'application/json', span)


def _document(state: BagState, file: str, body: bytes, content_type: str, span: tuple[int, int]) -> DataObject:
    return DataObject(
        bucket=BUCKET, key=key_of(state.robot, state.bag, file), body=body, content_type=content_type, sensor=SENSOR, topic=None,
        type='', samples=0, t_start_ns=span[0], t_end_ns=span[1], priority=ENDING_PRIORITY, protected=True,
        metadata={**_marks(state), **_clock_marks(state)},
    )  # fmt: skip


def _marks(state: BagState) -> dict[str, str]:
    marks = {meta.ROBOT: state.robot, meta.BAG: state.bag}
    if state.event is not None:
        marks[meta.EVENT] = state.event.name
    if state.mission is not None:
        mission = {meta.MISSION_ID: state.mission.mission_id, meta.RUN_ID: state.mission.run_id,
                   meta.MISSION_TYPE: state.mission.type}  # fmt: skip
        marks |= {word: value for word, value in mission.items() if value}
    return marks


def _evicted(state: BagState) -> set[str]:
    return {one.file for one in state.missing if one.what == EVICTED}


def _is_dated(state: BagState) -> bool:
    return state.clock is None or state.clock.offset_ns is not None


def _times(state: BagState, start_ns: int, end_ns: int) -> tuple[int, int]:
    """Log times in UTC or, if that is unknown, by the boot clock, like those of other objects (``stamps.StampRule``)."""
    clock = state.clock
    if clock is None:
        return start_ns, end_ns
    step_ns = clock.boot_ns - clock.wall_ns if clock.offset_ns is None else clock.offset_ns
    return max(0, start_ns + step_ns), max(0, end_ns + step_ns)


def _clock_marks(state: BagState, *times_ns: int) -> dict[str, str]:
    """For a bag whose clock was not set: how its date is known, as in spool/unsynced_objects.py, and log times since boot."""
    clock = state.clock
    if clock is None:
        return {}
    marks = {meta.CLOCK: clock.known, meta.BOOT_ID: clock.boot_id}
    if clock.offset_ns is not None:
        marks[meta.CLOCK_OFFSET_NS] = str(clock.offset_ns)
    boot = (str(max(0, time_ns - clock.wall_ns + clock.boot_ns)) for time_ns in times_ns)
    return {**marks, **dict(zip((meta.BOOT_START_NS, meta.BOOT_END_NS), boot, strict=False))}
