"""Builds one episode from one mission, in a separate folder: rows, videos, the source of each value, and gaps.

The folder is complete once it has ``episode.json``; a rebuild produces the same bytes. The episode's numbers in its dataset are
assigned later (``lerobot_writer.py``), when it is known which earlier missions were rejected.
"""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.errors import BagDamaged, LakeError, ObjectRefused, Rejected
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.core.stamps import SAME_NS
from shadowhound_data_logger.datasets.clocks import ClockOffset
from shadowhound_data_logger.datasets.features import ARM_ACTION, ARM_TOPICS, LABEL_FEATURE, LINEAR, ExportOptions, StatePart
from shadowhound_data_logger.datasets.plan import BEFORE_NS, ArmPlan, EpisodePlan, StreamPlan, refusal
from shadowhound_data_logger.datasets.series import Recordings, Series
from shadowhound_data_logger.datasets.ticks import (
    LATE,
    UNKNOWN,
    Sampled,
    cause_of,
    interpolated,
    motion,
    phase_of,
    sample,
    ticks_of,
)
from shadowhound_data_logger.datasets.video import VideoWriter
from shadowhound_data_logger.formats.rows import labels as catalogue_labels
from shadowhound_data_logger.formats.rows.gaps import GAPS as STATEMENTS
from shadowhound_data_logger.lake import decode, labels
from shadowhound_data_logger.lake.prefetch import Place
from shadowhound_data_logger.lake.tables import arrow_schema, narrow
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROWS, SOURCES, GAPS, LABELS, EPISODE_JSON = 'rows.parquet', 'sources.parquet', 'gaps.parquet', 'labels.parquet', 'episode.json'
"""Files of an episode's folder, in addition to ``<camera>.mp4``."""
BATCH: Final = 128
"""Rows with images that are written at a time."""
AHEAD: Final = 4
"""Images that are decoded ahead of the encoder."""
OF_JOINTS: Final = frozenset({'position', 'velocity', 'effort'})
"""Lists of a JointState with a number per joint."""
EPISODE: Final = 'episode_mission'
"""The column with the mission of a row; rows of gaps have a separate ``mission_id``."""
SOURCE_SCHEMA: Final = pa.schema([
    pa.field(EPISODE, pa.string(), nullable=False), pa.field('frame', pa.int64(), nullable=False),
    pa.field('stream', pa.string(), nullable=False), pa.field('bucket', pa.string(), nullable=False),
    pa.field('key', pa.string(), nullable=False), pa.field('sha256', pa.string(), nullable=False),
    pa.field('stamp_ns', pa.int64(), nullable=False), pa.field('received_ns', pa.int64()),
    pa.field('held_s', pa.float64(), nullable=False),
])  # fmt: skip
"""One row per frame and source message: its stamp, its arrival (null if unknown), and its age at the tick."""
GAP_SCHEMA: Final = arrow_schema(STATEMENTS).insert(0, pa.field(EPISODE, pa.string(), nullable=False))
"""The rows of the gap journal that were used (formats/rows/gaps.py)."""
LABEL_SCHEMA: Final = narrow(labels.FIELDS, catalogue_labels.LABELS).insert(0, GAP_SCHEMA.field(EPISODE))
"""The labels that apply, with their boxes (formats/rows/labels.py)."""
PICTURE: Final = pa.struct([('bytes', pa.binary()), ('path', pa.string())])


@dataclass(frozen=True, slots=True)
class _Stream:
    """A stream after reading and sampling."""

    plan: StreamPlan
    series: Series
    sampled: Sampled
    values: NDArray[np.float64]


def build(plan: EpisodePlan, options: ExportOptions, fps: int, settings: StoreSettings, folder: Path) -> dict[str, Any]:
    """Build the episode, or find out why that is impossible; returns ``episode.json``. Raises StoreError, OSError."""
    path = folder / EPISODE_JSON
    if path.is_file():
        return dict(json.loads(path.read_text(encoding='utf-8')))
    rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    store = open_store(settings, UploadSettings())
    try:
        place, work = Place(settings), folder / 'tmp'
        with ExitStack() as stack:
            of_robot = Recordings(place, store, plan.tracks, plan.topics, plan.span_ns, plan.bags, work, early_ns=BEFORE_NS,
                                   by=options.by)  # fmt: skip
            recordings = {False: stack.enter_context(of_robot)}
            if plan.arm is not None:
                span = plan.arm.span_ns(*plan.span_ns)
                of_arm = Recordings(place, store, plan.arm.tracks, plan.arm.topics, span, plan.bags, work, early_ns=BEFORE_NS)
                recordings[True] = stack.enter_context(of_arm)
            found = _built(plan, options, fps, recordings, folder)
    except (LakeError, BagDamaged, Rejected, ObjectRefused) as error:
        found = {'refused': error.what}
    finally:
        store.close()
        rmtree(folder / 'tmp', ignore_errors=True)
    with replacing(path, is_synced=True) as file:
        file.write(json.dumps(found, indent=1).encode())
    return found


def _built(
    plan: EpisodePlan, options: ExportOptions, fps: int, recordings: Mapping[bool, Recordings], folder: Path
) -> dict[str, Any]:
    """``recordings`` are those of the robot, and under True those of the arm."""
    if why := refusal(plan, options, fps):
        raise LakeError(why)
    series = _read(plan, options, recordings)
    ticks = _ticks(plan, series, fps)
    streams = [_sampled(each, one, ticks, fps, options) for each, one in zip(plan.streams, series, strict=True)]
    causes = [_causes(each, ticks, plan.arm) for each in streams]
    episode = _description(plan, streams, causes, ticks, fps)
    labelled = _labels(plan, streams, ticks)
    episode |= {'labels': sorted(set().union(*labelled))} if options.labels or options.validation_label else {}
    if (why := _refusal(episode, options)) and not options.allow_gaps:
        return {**episode, 'refused': why}
    pictures = [each for each in streams if each.plan.part is None]
    episode |= {'histograms': {}, 'sizes': {}}
    for each in pictures:
        histogram, size = _write_images(each, fps, options, folder)
        episode['histograms'][each.plan.name], episode['sizes'][each.plan.name] = histogram, size
    _write_rows(streams, causes, ticks, fps, options, folder, labelled)
    _write_sources(plan, streams, ticks, folder / SOURCES)
    gaps = plan.gaps.add_column(0, EPISODE, pa.array([plan.mission.mission_id] * len(plan.gaps), pa.string()))
    pq.write_table(gaps.cast(GAP_SCHEMA), folder / GAPS, compression='zstd')
    if options.labels:
        rows = [{EPISODE: plan.mission.mission_id, **asdict(each)} for each in plan.labels]
        pq.write_table(pa.Table.from_pylist(rows, schema=LABEL_SCHEMA), folder / LABELS, compression='zstd')
    return episode


def _labels(plan: EpisodePlan, streams: Sequence[_Stream], ticks: NDArray[np.int64]) -> list[set[str]]:
    """The labels of each frame: those of its time, and of the objects with its images."""
    found: list[set[str]] = [set() for _ in ticks]
    for each in (each for each in streams if each.plan.part is None and plan.labels):
        files = [each.series.files[int(each.series.file[message])] for message in each.sampled.message]
        rows = pa.table({
            'robot': [plan.mission.robot] * len(ticks), 'bucket': [file.bucket for file in files],
            'key': [file.key for file in files], 't_start_ns': ticks, 't_end_ns': ticks,
        })  # fmt: skip
        for frame, names in zip(found, labels.column(rows, plan.labels), strict=True):
            frame.update(names)
    return found


def _belongs_to_arm(stream: StreamPlan) -> bool:
    return stream.recording.sensor in ARM_TOPICS


def _read(plan: EpisodePlan, options: ExportOptions, recordings: Mapping[bool, Recordings]) -> list[Series]:
    """The series of each stream; a sensor that two streams need is read once."""
    known: dict[tuple[str, tuple[str, ...]], Series] = {}
    found = []
    for each in plan.streams:
        fields = each.part.fields if each.part else ()
        name = each.recording.sensor, fields
        if name not in known:
            known[name] = recordings[_belongs_to_arm(each)].series(each.recording, fields)
            if _belongs_to_arm(each) and plan.arm is not None and plan.arm.clock is not None:
                known[name] = _moved(known[name], plan.arm.clock, plan.span_ns)
        one = known[name]
        if not len(one):
            raise LakeError(f'{each.recording.topic} has no message')
        if each.part is None:
            found.append(one)
            continue
        good = np.isfinite(one.values).all(axis=1)
        if not good.any():
            raise LakeError(f'{each.recording.topic} has no finite numbers')
        one = one.only(np.flatnonzero(good))
        found.append(_derived(one, options) if each.part.is_derived else one)
    return found


def _moved(series: Series, clock: ClockOffset, span: tuple[int, int]) -> Series:
    """Convert the stamps to the robot's clock."""
    stamps = clock.robot_ns(series.stamps)
    inside = (stamps >= span[0]) & (stamps <= span[1])
    return replace(series, stamps=stamps, own_stamps=series.stamps).only(inside)


def _derived(poses: Series, options: ExportOptions) -> Series:
    later, values = motion(poses.stamps, poses.values, round(options.max_gap_s * SECOND))
    if not len(later):
        raise LakeError(f'{poses.recording.topic} has no two poses from which a velocity could be derived')
    own = poses.stamps if poses.own_stamps is None else poses.own_stamps
    previous = np.column_stack([each[later - 1] for each in (poses.stamps, own, poses.received, poses.file)])
    return replace(poses.only(later), values=values, names=(), previous=previous)


def _ticks(plan: EpisodePlan, series: Sequence[Series], fps: int) -> NDArray[np.int64]:
    """The ticks from the first image after all streams have started to the end of the mission."""
    cameras = [one for each, one in zip(plan.streams, series, strict=True) if each.part is None]
    slowest = min(cameras, key=len)
    bound = max(plan.mission.begin_ns, *(int(one.stamps[0]) for one in series))
    later = slowest.stamps[slowest.stamps >= bound]
    if not len(later):
        raise LakeError('there is no time at which all of its streams had started')
    first = int(later[0])
    return ticks_of(first + phase_of(later, first, fps), plan.mission.end_ns, fps)


def _sampled(plan: StreamPlan, series: Series, ticks: NDArray[np.int64], fps: int, options: ExportOptions) -> _Stream:
    sensor = plan.recording.sensor
    given = options.max_age_s.get(sensor)
    most = round(given * SECOND) if given is not None else int(LATE * max(series.period_ns, SECOND // fps))
    found = sample(series.stamps, ticks, most)
    if plan.part is None:
        return _Stream(plan, series, found, np.empty((len(ticks), 0)))
    if options.resample.get(sensor) != LINEAR or plan.part.is_derived:
        return _Stream(plan, series, found, series.values[found.message])
    values, earlier = interpolated(series.stamps, series.values, ticks, round(options.max_gap_s * SECOND), plan.part.turns)
    return _Stream(plan, series, Sampled(found.message, earlier, found.age_s, found.stale), values)


def _causes(stream: _Stream, ticks: NDArray[np.int64], arm: ArmPlan | None) -> dict[int, str]:
    """Tick -> why its newest message is too old. The journal uses the clock of the messages."""
    stamps = stream.series.stamps[stream.sampled.message]
    if arm is not None and arm.clock is not None and _belongs_to_arm(stream.plan):
        stamps, ticks = arm.clock.other_ns(stamps), arm.clock.other_ns(ticks)
    return {
        int(tick): cause_of(stream.plan.known, stream.plan.downsampled, int(stamps[tick]), int(ticks[tick]))
        for tick in np.flatnonzero(stream.sampled.stale)
    }


def _description(plan: EpisodePlan, streams: Sequence[_Stream], causes: Sequence[Mapping[int, str]], ticks: NDArray[np.int64],
          fps: int) -> dict[str, Any]:  # fmt: skip
    mission = plan.mission
    return {
        'mission_id': mission.mission_id, 'run_id': mission.run_id, 'robot': mission.robot, 'mission_type': mission.mission_type,
        'task': mission.task, 'frames': len(ticks), 'fps': fps, 'first_tick_ns': int(ticks[0]),
        **({'clock': plan.arm.clock.as_json()} if plan.arm is not None and plan.arm.clock is not None else {}),
        'last_tick_ns': int(ticks[-1]), 'begins_late_s': round((int(ticks[0]) - mission.begin_ns) / SECOND, 3),
        'streams': {
            each.plan.name: {
                'sensor': each.plan.recording.sensor, 'topic': each.plan.recording.topic, 'from': each.plan.recording.sink,
                'type': each.plan.recording.type, 'messages': len(each.series), 'rate_hz': round(each.plan.recording.rate_hz, 3),
                'stale_share': round(float(each.sampled.stale.mean()), 6),
                'longest_gap_s': round(float(each.sampled.age_s[each.sampled.stale].max(initial=0.0)), 3),
                'causes': dict(sorted(Counter(why.values()).items())), 'names': list(_names(each)),
                'known': _grades(each, plan.arm, ticks), **_offsets(each),
            }
            for each, why in zip(streams, causes, strict=True)
        },
    }  # fmt: skip


def _offsets(stream: _Stream) -> dict[str, Any]:
    """The minimum and maximum offset between stamp and arrival of the messages in the episode, and whether it changed.

    Null if no arrival is known. A change of more than a second means that the stream was aligned by two clocks, or arrived late.
    """
    series, used = stream.series, stream.sampled.message
    inside = slice(int(used.min()), int(used.max()) + 1)
    stamps, received = (series.stamps if series.own_stamps is None else series.own_stamps)[inside], series.received[inside]
    offsets = (received - stamps)[received > 0]
    if not len(offsets):
        return {'offset_min_s': None, 'offset_max_s': None, 'offset_changed': False}
    low, high = int(offsets.min()), int(offsets.max())
    return {
        'offset_min_s': round(low / SECOND, 3),
        'offset_max_s': round(high / SECOND, 3),
        'offset_changed': high - low > SAME_NS,
    }


def _grades(stream: _Stream, arm: ArmPlan | None, ticks: NDArray[np.int64]) -> list[str]:
    """The accounting grades of the gaps, from the first tick to the last."""
    if arm is not None and arm.clock is not None and _belongs_to_arm(stream.plan):
        ticks = arm.clock.other_ns(ticks)
    return sorted({each.grade or UNKNOWN for each in stream.plan.known.between(int(ticks[0]), int(ticks[-1])).stretches})


def _names(stream: _Stream) -> tuple[str, ...]:
    part, width = stream.plan.part, stream.values.shape[1]
    if part is None:
        return ()
    if len(part.names) == width:
        return part.names
    if part.sensor.startswith('/'):
        return _field_names(part, stream.series.names, width)
    named = stream.series.names if len(stream.series.names) == width else tuple(f'joint_{index}' for index in range(width))
    prefix = 'arm_' if _belongs_to_arm(stream.plan) else ''
    return tuple(f'{prefix}{name}.pos' for name in named)


def _field_names(part: StatePart, joints: Sequence[str], width: int) -> tuple[str, ...]:
    """Names of the numbers of a topic. Raises LakeError if the file gives another number of names."""
    if part.names:
        text = f'{part.sensor} has {width} numbers in {", ".join(part.fields)}, and {len(part.names)} names are given'
        raise LakeError(text, remedy='correct names in the file of --config')
    if len(part.fields) == width and not (joints and part.fields[0] in OF_JOINTS):
        return part.fields
    last = 'pos' if part.fields == ('position',) else part.fields[0]
    if len(joints) == width:
        return tuple(f'{name}.{last}' for name in joints)
    return tuple(f'{part.fields[0]}.{number}' for number in range(width))


def _refusal(episode: Mapping[str, Any], options: ExportOptions) -> str:
    for name, each in episode['streams'].items():
        share, longest_s = each['stale_share'], each['longest_gap_s']
        if share > options.max_stale:
            why = ', '.join(f'{cause} {count}' for cause, count in each['causes'].items())
            return f'{name} is stale in {share:.1%} of the frames ({why}), more than max_stale {options.max_stale:g}'
        if longest_s > options.max_gap_s:
            return f'{name} was last received {longest_s:.1f} s before a frame, more than max_gap_s {options.max_gap_s:g}'
    return ''


# -- files ---------------------------------------------------------------------------------------------------------------------


def _write_images(stream: _Stream, fps: int, options: ExportOptions, folder: Path) -> tuple[list[list[int]], list[int]]:
    """Write the video, unless images are kept unchanged; returns ((3, 256) pixels per value and color, (height, width))."""
    histogram = np.zeros((3, 256), np.int64)
    numbers, counts = np.unique(stream.sampled.message, return_counts=True)
    size = _read_image(stream, int(numbers[0])).shape[:2]
    with ExitStack() as stack:
        writer = None
        if not options.is_lossless:
            writer = stack.enter_context(VideoWriter(folder / f'{stream.plan.name}.mp4', fps, size, options.codec))
        for (pixels, colors), count in zip(_images_ahead(stream, numbers.tolist()), counts.tolist(), strict=True):
            _check_size(stream, pixels, size)
            histogram += colors * count
            for _ in range(count if writer else 0):
                assert writer is not None
                writer.add(pixels)
    return histogram.tolist(), list(size)


def _images_ahead(stream: _Stream, numbers: Sequence[int]) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.int64]]]:
    """Each image and its histogram, (3, 256); images are decoded on a separate thread ahead of the encoder."""

    def decoded(number: int) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        pixels = _read_image(stream, number)
        return pixels, np.array(Image.fromarray(pixels[..., :3]).histogram(), np.int64).reshape(3, 256)

    waiting: deque[Future[tuple[NDArray[np.uint8], NDArray[np.int64]]]] = deque()
    with ThreadPoolExecutor(1, 'export-decode') as pool:
        for number in numbers:
            waiting.append(pool.submit(decoded, number))
            if len(waiting) > AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _check_size(stream: _Stream, pixels: NDArray[np.uint8], size: tuple[int, int]) -> None:
    if pixels.shape[:2] != size:
        raise LakeError(f'the images of {stream.plan.recording.topic} change their size')


def _read_image(stream: _Stream, message: int) -> NDArray[np.uint8]:
    body, _ = stream.series.image(message)
    pixels = decode.image(body)
    if pixels.ndim != 3 or pixels.dtype != np.uint8:
        raise LakeError(f'the images of {stream.plan.recording.topic} are not color images with 8 bits')
    return np.asarray(pixels, np.uint8)


def vectors(values: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """A column of vectors as lerobot's reader expects it: fixed-length lists, or plain numbers for vectors of length one."""
    width = values.shape[1]
    flat = pa.array(np.ascontiguousarray(values).ravel(), kind)
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def _write_rows(streams: Sequence[_Stream], causes: Sequence[Mapping[int, str]], ticks: NDArray[np.int64], fps: int,
                options: ExportOptions, folder: Path, labelled: Sequence[set[str]]) -> None:  # fmt: skip
    count = len(ticks)
    state = np.hstack([each.values for each in streams if each.plan.name.startswith('state.')]).astype(np.float32)
    action = np.hstack([each.values for each in _action_streams(streams)]).astype(np.float32)
    texts = [''] * count
    for each, why in zip(streams, causes, strict=True):
        for tick, word in why.items():
            texts[tick] = f'{texts[tick]};{each.plan.name}={word}' if texts[tick] else f'{each.plan.name}={word}'
    columns: dict[str, pa.Array] = {
        'observation.state': vectors(state, pa.float32()),
        'action': vectors(action, pa.float32()),
        'shadowhound.stale': vectors(np.column_stack([each.sampled.stale for each in streams]).astype(np.float32), pa.float32()),
        'shadowhound.age_s': vectors(np.column_stack([each.sampled.age_s for each in streams]), pa.float32()),
        'shadowhound.cause': pa.array(texts, pa.string()),
        **({LABEL_FEATURE: pa.array([json.dumps(sorted(each)) for each in labelled], pa.string())} if options.labels else {}),
        'shadowhound.stamp_ns': pa.array(ticks, pa.int64()),
        'timestamp': pa.array((np.arange(count) / fps).astype(np.float32)),
        'frame_index': pa.array(np.arange(count), pa.int64()),
    }
    table = pa.table(columns)
    cameras = [each for each in streams if each.plan.part is None] if options.is_lossless else []
    schema = table.schema
    for each in cameras:
        schema = schema.append(pa.field(f'observation.{each.plan.name}', PICTURE))
    with pq.ParquetWriter(folder / ROWS, schema, compression='snappy') as writer:
        for begin in range(0, count, BATCH if cameras else count):
            some = table.slice(begin, BATCH if cameras else count)
            for each in cameras:
                some = some.append_column(f'observation.{each.plan.name}', _raw(each, begin, begin + len(some)))
            writer.write_table(some)


def _action_streams(streams: Sequence[_Stream]) -> list[_Stream]:
    """The arm's first, as in LeKiwi."""
    return sorted(
        (each for each in streams if each.plan.name in {'action', ARM_ACTION}), key=lambda each: each.plan.name == 'action'
    )


def _raw(stream: _Stream, begin: int, end: int) -> pa.Array:
    found = []
    for tick in range(begin, end):
        body, extension = stream.series.image(int(stream.sampled.message[tick]))
        found.append({'bytes': body, 'path': f'frame-{tick:06d}.{extension}'})
    return pa.array(found, PICTURE)


def _write_sources(plan: EpisodePlan, streams: Sequence[_Stream], ticks: NDArray[np.int64], path: Path) -> None:
    with pq.ParquetWriter(path, SOURCE_SCHEMA, compression='zstd') as writer:
        for each in streams:
            for table in _sources(plan.mission.mission_id, each, ticks):
                writer.write_table(table)


def _sources(mission_id: str, stream: _Stream, ticks: NDArray[np.int64]) -> Iterator[pa.Table]:
    series, sampled = stream.series, stream.sampled
    frames = np.arange(len(ticks))
    is_line = sampled.other >= 0
    used = np.where(is_line, sampled.other + 1, sampled.message)
    own = series.stamps if series.own_stamps is None else series.own_stamps
    held = (ticks - series.stamps[used]) / SECOND
    yield _source_rows(mission_id, stream, frames, own[used], series.received[used], series.file[used], held)
    if is_line.any():
        other = sampled.other[is_line]
        held = (ticks[is_line] - series.stamps[other]) / SECOND
        yield _source_rows(mission_id, stream, frames[is_line], own[other], series.received[other], series.file[other], held)
    if series.previous is not None:
        earlier = series.previous[sampled.message]
        held = (ticks - earlier[:, 0]) / SECOND
        _, own_stamps, received, files = earlier.T
        yield _source_rows(mission_id, stream, frames, own_stamps, received, files, held)


def _source_rows(mission_id: str, stream: _Stream, frames: NDArray[np.int64], stamps: NDArray[np.int64],
                 received: NDArray[np.int64], files: NDArray[np.int64], held: NDArray[np.float64]) -> pa.Table:  # fmt: skip
    known = stream.series.files
    named = {name: pa.array([getattr(known[int(number)], name) for number in files]) for name in ('bucket', 'key', 'sha256')}
    return pa.table({
        EPISODE: pa.array([mission_id] * len(frames)), 'frame': pa.array(frames, pa.int64()),
        'stream': pa.array([stream.plan.name] * len(frames)), **named, 'stamp_ns': pa.array(stamps, pa.int64()),
        'received_ns': pa.array(received, pa.int64(), mask=received == 0),
        'held_s': pa.array(held, pa.float64()),
    }, schema=SOURCE_SCHEMA)  # fmt: skip
