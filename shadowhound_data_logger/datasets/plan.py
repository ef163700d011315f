"""Which missions are selected, what the store has of each, and whether their gaps are known."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.stamps import BY_RECEIVED
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.datasets.clocks import NEAR_NS, ClockOffset, measured
from shadowhound_data_logger.datasets.features import (
    ARM_ACTION,
    ARM_CLOCK,
    ARM_COMMAND,
    ARM_COMMANDS,
    ARM_JOINTS,
    ARM_STATE,
    ARM_TOPICS,
    AUTO,
    COMMAND,
    ExportOptions,
    StatePart,
)
from shadowhound_data_logger.datasets.series import Interval, RecordedSensor, Recordings, read_manifests, select_bags
from shadowhound_data_logger.datasets.ticks import whole_fps
from shadowhound_data_logger.formats.rows.catalog import Row
from shadowhound_data_logger.lake import labels, query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import OBJECTS, Known, downsampled_times, newest, of_rows, watermarks
from shadowhound_data_logger.lake.labels import Label
from shadowhound_data_logger.lake.prefetch import Place
from shadowhound_data_logger.lake.tables import among, narrow
from shadowhound_data_logger.lake.track import NEEDED, RECEIVED, Track
from shadowhound_data_logger.stores.base import ObjectStore

BEFORE_NS: Final = 10 * SECOND
"""Messages published up to this long before a mission's start may be held at its first tick."""
LONGEST_BATCH_NS: Final = 3600 * SECOND
"""An object that starts this long before a mission may extend into it (sensor.batch_s)."""
RECORDED: Final = ('odom', 'joints')
"""Sensors with messages that are exported unchanged, in addition to the frames (mobile.py)."""
DETECTIONS: Final = frozenset({'vision_msgs/msg/Detection2DArray', 'vision_msgs/msg/Detection3DArray'})
END_SLACK_NS: Final = 2 * SECOND
"""A topic's last message may be this long before the end of a mission if the robot is switched off; for a slow topic, two
periods.
"""


@dataclass(frozen=True, slots=True)
class ChosenMission:
    """A selected mission."""

    robot: str
    mission_id: str
    run_id: str
    mission_type: str
    task: str
    """The mission's command; otherwise its type."""
    begin_ns: int
    end_ns: int
    """0 while the mission is active, or until its end has reached the store."""


@dataclass(frozen=True, slots=True)
class StreamPlan:
    """One column group of a dataset in one mission: its name, its source, and its known gaps."""

    name: str
    part: StatePart | None
    """None for a camera."""
    recording: RecordedSensor
    known: Known
    downsampled: tuple[tuple[int, int], ...]
    complete_ns: int
    """The robot has reported its gaps up to here; 0 if it has reported none."""
    is_final: bool = False
    """Whether it will report no more: it only counts received messages, or the topic ended and the node was restarted."""

    def is_known(self, end_ns: int) -> bool:
        """Whether the gaps are known up to that time."""
        period_ns = round(SECOND / self.recording.rate_hz) if self.recording.rate_hz else 0
        return self.complete_ns + max(END_SLACK_NS, 2 * period_ns) >= end_ns

    def known_until(self, end_ns: int) -> str:
        """Up to when the robot has reported gaps, as part of a sentence."""
        return f'up to {(end_ns - self.complete_ns) / SECOND:.1f} s before its end' if self.complete_ns else 'for no part of it'


@dataclass(frozen=True, slots=True)
class ArmPlan:
    """An arm in one mission, and how its times are converted to the robot's."""

    tracks: Mapping[str, Track]
    topics: Mapping[str, str]
    clock: ClockOffset | None
    why: str = ''
    """Why its clock is unknown."""

    def span_ns(self, begin_ns: int, end_ns: int) -> tuple[int, int]:
        """By both clocks: bags have the arrival times, by the robot's."""
        if self.clock is None:
            return begin_ns, end_ns
        begin, end = self.clock.other_ns(np.array([begin_ns, end_ns]))
        return min(begin_ns, int(begin)), max(end_ns, int(end))


@dataclass(frozen=True, slots=True)
class EpisodePlan:
    """A mission, and everything needed to build an episode from it. It can be sent to another process."""

    mission: ChosenMission
    streams: tuple[StreamPlan, ...]
    tracks: Mapping[str, Track]
    topics: Mapping[str, str]
    bags: tuple[Manifest, ...]
    gaps: pa.Table
    """The rows of the gap journal that were used."""
    missing: tuple[str, ...] = ()
    """Requested sensors without data."""
    arm: ArmPlan | None = None
    detections: tuple[Track, ...] = ()
    """Topics with detections of objects."""
    labels: tuple[Label, ...] = ()
    """The labels of its time, if requested."""

    @property
    def span_ns(self) -> tuple[int, int]:
        return self.mission.begin_ns - BEFORE_NS, self.mission.end_ns

    @property
    def waits_for(self) -> str:
        """Why its gaps are not known yet; empty if they are."""
        if not self.mission.end_ns:
            return 'it is active, or its summary has not arrived'
        end = self.mission.end_ns
        for stream in self.streams:
            if not stream.is_final and not stream.is_known(end):
                return f'the gaps of {stream.recording.topic} are reported {stream.known_until(end)} so far'
        return ''

    @property
    def never_complete(self) -> str:
        """Why its gaps will never be known; empty if they are known, or will be."""
        end = self.mission.end_ns
        for stream in self.streams:
            if stream.is_final and not stream.is_known(end):
                return f'the gaps of {stream.recording.topic} are reported {stream.known_until(end)}'
        return ''

    @property
    def camera_hz(self) -> float:
        """The rate of the slowest camera."""
        return min((each.recording.rate_hz for each in self.streams if each.part is None), default=0.0)


def chosen(source: Bucket, flags: Mapping[str, Any], findings: Findings) -> list[ChosenMission]:
    """Sorted by start time. Raises LakeError, SettingError, StoreError."""
    rows = query.missions(source, findings=findings, **flags).to_pylist()
    return sorted(map(_mission, rows), key=lambda each: (each.begin_ns, each.mission_id))


def _mission(row: Mapping[str, Any]) -> ChosenMission:
    now_ns = time.time_ns()
    begin = moment('start', row['started'], now_ns) if row['started'] else _ns(row['first'])
    end = moment('end', row['ended'], now_ns) if row['ended'] else 0
    kind = row['mission_type'] or 'mission'
    return ChosenMission(row['robot'], row['mission_id'], row['run_id'] or '', kind, row['command'] or kind, begin, end)


def _ns(stamp: Any) -> int:
    return int(stamp.timestamp() * 1_000_000) * 1000


def planned(source: Bucket, store: ObjectStore, missions: Sequence[ChosenMission], options: ExportOptions, action: str,
            work: Path, findings: Findings) -> Iterator[EpisodePlan]:  # fmt: skip
    """A plan of each mission from what the store has. ``action`` is ``cmd_vel``, ``odometry``, or ``auto`` for the first one's.

    Raises LakeError, StoreError.
    """
    for robot in sorted({mission.robot for mission in missions}):
        ours = [mission for mission in missions if mission.robot == robot]
        stated = newest(
            source, robot=robot, since_ns=min(mission.begin_ns for mission in ours) - BEFORE_NS, findings=findings, by=options.by
        )
        labelled = labels.read(source, robot, findings=findings) if options.labels or options.validation_label else []
        recorded = read_manifests(store, robot)
        for mission in ours:
            made = _planned(source, store, mission, options, action=action, stated=stated, recorded=recorded, work=work,
                            findings=findings)  # fmt: skip
            first, last = made.span_ns
            yield replace(made, labels=tuple(each for each in labelled if each.since_ns <= last and each.until_ns >= first))


def refusal(plan: EpisodePlan, options: ExportOptions, fps: int) -> str:
    """Why it cannot become an episode, as far as is known before its messages are read; otherwise empty.

    ``fps`` 0: the rate of the frames is not chosen yet.
    """
    if plan.missing:
        missing = sorted(set(plan.missing))
        images = [name for name in missing if name in options.images.values()]
        why = f'the store has no data of {", ".join(missing)} in it'
        return (
            f'{why}; a LeRobot dataset needs images: name a topic with some under images in the file of --config'
            if images
            else why
        )
    if plan.arm is not None and plan.arm.clock is None:
        return plan.arm.why
    if plan.never_complete and not options.allow_gaps:
        return f'{plan.never_complete}, and no more reports will arrive: --allow-gaps accepts it'
    if not fps:
        return ''
    if plan.arm is not None and plan.arm.clock is not None and plan.arm.clock.uncertainty_ns > SECOND // fps // 2:
        return (f"the offset of the arm's clock is known to {plan.arm.clock.uncertainty_ns / 1e6:.1f} ms, "
                f'half a tick is {SECOND / fps / 2e6:.1f} ms')  # fmt: skip
    cameras = [each.recording for each in plan.streams if each.part is None]
    slow = min(cameras, key=lambda each: each.rate_hz, default=None)
    if slow is not None and fps > whole_fps(slow.rate_hz):
        return f'{slow.topic} has {slow.rate_hz:.3g} Hz in the {slow.sink}, less than {fps} frames per second'
    return ''


def settled_action(plans: Sequence[EpisodePlan], action: str) -> str:
    """``cmd_vel`` or ``odometry``: with ``auto`` the command topic if a mission has one."""
    if action != AUTO:
        return action
    return 'cmd_vel' if any(stream.part == COMMAND for plan in plans for stream in plan.streams) else 'odometry'


def _planned(source: Bucket, store: ObjectStore, mission: ChosenMission, options: ExportOptions, *, action: str,  # noqa: PLR0913
             stated: pa.Table, recorded: Sequence[Manifest], work: Path, findings: Findings) -> EpisodePlan:  # fmt: skip
    """``recorded`` are the robot's bags."""
    if not mission.end_ns:
        return EpisodePlan(mission, (), {}, {}, (), stated.slice(0, 0))
    arm = None
    since, until = mission.begin_ns - BEFORE_NS, mission.end_ns
    parts, actions = options.state_parts, options.actions(action)
    sensors = [*options.images.values(), *(part.sensor for part in (*parts, *actions))]
    named = {each for each in sensors if each.startswith('/')}
    used = f'{among("sensor", sorted({*sensors, *RECORDED} - named))} OR {among("type", sorted(DETECTIONS))}'
    used += f' OR {among("topic", sorted(named))}' if named else ''
    span: dict[str, Any] = {'since': utc(since - LONGEST_BATCH_NS), 'until': utc(until + 1000)}
    if options.by == BY_RECEIVED:  # stamps can be anywhere then, and so can the dates of rows
        arrival = 'coalesce(received_start_ns, t_start_ns)'
        used, span = f'({used}) AND {arrival} >= {since - LONGEST_BATCH_NS} AND {arrival} <= {until} AND t_start IS NOT NULL', {}
    found = query.objects(
        source, findings=findings, columns=(*NEEDED, *RECEIVED, 'topic'), where=used, robot=mission.robot, **span
    ).to_pylist()
    seen = _tracks([row for row in found if row['type'] in DETECTIONS], mission)[0]
    rows = [row for row in found if row['type'] not in DETECTIONS]
    tracks, topics = _tracks(rows, mission)
    for topic in sorted(named):
        mine = [{**row, 'sensor': topic} for row in rows if row['topic'] == topic]
        tracks |= _tracks(mine, mission)[0]
        topics[topic] = topic
    if options.by == BY_RECEIVED:
        tracks = {sensor: track.by_arrival() for sensor, track in tracks.items()}
    bags = tuple(select_bags(recorded, mission.mission_id, mission.run_id, Interval(mission.begin_ns, until)))
    place = Place(source.settings)
    with Recordings(place, store, tracks, topics, (since, until), bags, work, early_ns=BEFORE_NS, by=options.by) as recordings:
        best = {sensor: recordings.best(sensor) for sensor in set(sensors)}
    streams, missing = [], []
    wanted: list[tuple[str, StatePart | None, str]] = [
        (f'images.{name}', None, sensor) for name, sensor in options.images.items()
    ]
    wanted += [(f'state.{part.name}', part, part.sensor) for part in parts]
    commands = [part for part in actions if best[part.sensor] is not None]
    if commands:
        wanted.append(('action', commands[0], commands[0].sensor))
    else:
        missing.append(actions[-1].sensor)
    for name, part, sensor in wanted:
        recording = best[sensor]
        if recording is None:
            missing.append(sensor)
            continue
        last = int(tracks[sensor].end_ns.max()) if recording.sink == OBJECTS else mission.end_ns
        streams.append(_stream(name, part, recording, mission, stated, last))
    if options.arm:
        arm, more = _arm_streams(source, store, mission, options, bags=bags, stated=stated, recorded=recorded, work=work,
                                 findings=findings)  # fmt: skip
        streams = (
            [each for each in more if each.name != ARM_ACTION] + streams + [each for each in more if each.name == ARM_ACTION]
        )
        missing += [] if more or arm.why else [f'/{options.arm}/{ARM_TOPICS[ARM_JOINTS]}']
    topics_used = pa.array(sorted({stream.recording.topic for stream in streams}), pa.string())
    return EpisodePlan(mission, tuple(streams), tracks, topics, bags, _about(stated, topics_used, since, until),
                       tuple(missing), arm, tuple(seen.values()))  # fmt: skip


def _arm_streams(source: Bucket, store: ObjectStore, mission: ChosenMission, options: ExportOptions, *, bags: Sequence[Manifest],  # noqa: PLR0913
                 stated: pa.Table, recorded: Sequence[Manifest], work: Path,
                 findings: Findings) -> tuple[ArmPlan, list[StreamPlan]]:  # fmt: skip
    """What an arm recorded during the mission, by its own clock; no streams if the clock is unknown."""
    since, until = mission.begin_ns - BEFORE_NS, mission.end_ns
    topics = {sensor: f'/{options.arm}/{name}' for sensor, name in ARM_TOPICS.items()}

    def tracks(begin: int, end: int, *sensors: str) -> dict[str, Track]:
        wanted = [topics[sensor] for sensor in sensors]
        mine = f'{among("topic", wanted)} AND {among("robot", sorted({mission.robot, options.arm}))}'
        found = query.objects(
            source, findings=findings, columns=(*NEEDED, *RECEIVED, 'topic'), where=mine, since=utc(begin - LONGEST_BATCH_NS),
            until=utc(end + 1000),
        ).to_pylist()  # fmt: skip
        rows_of = {sensor: [row for row in found if row['topic'] == topics[sensor]] for sensor in sensors}
        return {sensor: _best_track(some, begin, end) for sensor, some in rows_of.items() if some}

    place, wide = Place(source.settings), (since - NEAR_NS, until + NEAR_NS)
    pairs = [np.array(options.clock_pairs, np.int64).reshape(-1, 2)]
    near = select_bags(recorded, mission.mission_id, mission.run_id, Interval(*wide))
    with Recordings(place, store, tracks(*wide, ARM_CLOCK), topics, wide, near, work) as recordings:
        if (events := recordings.best(ARM_CLOCK)) is not None:
            series = recordings.series(events, ('time_ref.sec', 'time_ref.nanosec'))
            times = series.values.astype(np.int64)
            pairs.append(np.column_stack([series.stamps, times[:, 0] * SECOND + times[:, 1]]))
    try:
        clock = measured(np.concatenate(pairs), mission.begin_ns, mission.end_ns)
    except LakeError as error:
        return ArmPlan({}, topics, None, error.what), []
    begin, end = (int(each) for each in clock.other_ns(np.array([since, until])))
    arm = ArmPlan(tracks(begin, end, ARM_JOINTS, ARM_COMMANDS), topics, clock)
    streams = []
    span = arm.span_ns(since, until)
    with Recordings(place, store, arm.tracks, topics, span, bags, work, early_ns=BEFORE_NS) as recordings:
        joints = recordings.best(ARM_JOINTS)
        commands = recordings.best(ARM_COMMANDS)
    if joints is None:
        return arm, []
    parts = [(f'state.{ARM_STATE.name}', ARM_STATE, joints)]
    parts.append((ARM_ACTION, ARM_COMMAND, commands) if commands else (ARM_ACTION, ARM_STATE, joints))
    for name, part, recording in parts:
        track = arm.tracks.get(recording.sensor)
        if recording.sink == OBJECTS and track is not None and track.robot != mission.robot:  # an import is complete
            known = of_rows(track.robot, OBJECTS, recording.topic, begin, end + SECOND, ())
            streams.append(StreamPlan(name, part, recording, known, (), mission.end_ns))
        else:
            moved = replace(mission, begin_ns=begin + BEFORE_NS, end_ns=end)
            last = int(track.end_ns.max()) if recording.sink == OBJECTS and track is not None else end
            streams.append(_stream(name, part, recording, moved, stated, last))
    return arm, streams


def _best_track(rows: Sequence[Row], begin_ns: int, end_ns: int) -> Track:
    """Of one machine, the one with the most in this time: an arm may be recorded by its own computer and by the robot."""
    best = _most_frequent([row['robot'] for row in _within(rows, begin_ns, end_ns)] or [row['robot'] for row in rows])
    return Track.of(pa.Table.from_pylist([row for row in rows if row['robot'] == best], schema=narrow((*NEEDED, *RECEIVED))))


def _within(rows: Sequence[Row], begin_ns: int, end_ns: int) -> list[Row]:
    """The objects with messages of this time."""
    return [row for row in rows if row['t_start_ns'] <= end_ns and (row['t_end_ns'] or row['t_start_ns']) >= begin_ns]


def _most_frequent(values: Sequence[Any]) -> Any:
    return max(sorted(set(values)), key=values.count)


def _stream(name: str, part: StatePart | None, recording: RecordedSensor, mission: ChosenMission, stated: pa.Table,
            last_ns: int) -> StreamPlan:  # fmt: skip
    """``last_ns`` is the stamp of its last message in the store."""
    rows = stated.filter(pc.equal(stated['sink'], recording.sink)).to_pylist()
    mine = [row for row in rows if row['topic'] == recording.topic]
    begin, end = mission.begin_ns - BEFORE_NS, mission.end_ns + SECOND
    known = of_rows(mission.robot, recording.sink, recording.topic, begin, end, mine)
    marks = watermarks(mine)
    complete = [row['to_ns'] for row in marks if row['from_ns'] <= mission.end_ns and row['grade'] in {'exact', 'estimated'}]
    plan = StreamPlan(name, part, recording, known, tuple(downsampled_times(mine)), max(complete, default=0))
    arrived = last_ns + END_SLACK_NS >= mission.end_ns
    sessions = {row['session'] for row in watermarks(rows) if row['from_ns'] <= mission.end_ns <= row['to_ns'] + END_SLACK_NS}
    is_uncounted = arrived and bool(sessions) and not any(row['session'] in sessions for row in marks)
    return replace(plan, is_final=is_uncounted or any(row['from_ns'] > mission.end_ns for row in marks))


def _about(stated: pa.Table, topics: pa.Array, since: int, until: int) -> pa.Table:
    """The gap rows about these topics and this time, and those without a time, in a fixed order."""
    reaches = pc.and_(pc.less_equal(stated['from_ns'], until), pc.greater_equal(stated['to_ns'], since))
    kept = stated.filter(pc.and_(pc.is_in(stated['topic'], value_set=topics), pc.fill_null(reaches, fill_value=True)))
    return kept.sort_by([(name, 'ascending') for name in ('topic', 'sink', 'what', 'id')]).combine_chunks()


def _tracks(rows: Sequence[Row], mission: ChosenMission) -> tuple[dict[str, Track], dict[str, str]]:
    """By sensor, of the topic and type of most of the mission's objects: a sensor may have changed its topic."""
    tracks, topics = {}, {}
    for sensor in sorted({row['sensor'] for row in rows}):
        ours = [row for row in rows if row['sensor'] == sensor]
        counted = _within(ours, mission.begin_ns, mission.end_ns) or ours
        best = _most_frequent([_topic_and_type(row) for row in counted])
        mine = [row for row in ours if _topic_and_type(row) == best]
        tracks[sensor] = Track.of(pa.Table.from_pylist(mine, schema=narrow((*NEEDED, *RECEIVED))))
        topics[sensor] = best[0]
    return tracks, topics


def _topic_and_type(row: Row) -> tuple[str, str]:
    return row['topic'] or '', row['type'] or ''
