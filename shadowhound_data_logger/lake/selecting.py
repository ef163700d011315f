"""From a query to the tracks of a dataset: the only part of datasets that reads the tables."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.stamps import BY_STAMP
from shadowhound_data_logger.core.untrusted import MAX_MEMBERS
from shadowhound_data_logger.formats.rows.catalog import SENSOR
from shadowhound_data_logger.lake import labels, query
from shadowhound_data_logger.lake.bucket import Bucket, default_source
from shadowhound_data_logger.lake.decode import ARCHIVES, CLOUDS, IMAGES
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.names import check_names
from shadowhound_data_logger.lake.prefetch import Place
from shadowhound_data_logger.lake.pull import request_and_wait
from shadowhound_data_logger.lake.samples import Near, Selection, Window
from shadowhound_data_logger.lake.tables import among, narrow
from shadowhound_data_logger.lake.track import NEEDED, Track, packed

log = logging.getLogger(__name__)


def place(source: Bucket | Path | str | None) -> tuple[Place, Bucket]:
    """Where contents and rows are read from. Raises LakeError for a folder without rows."""
    if isinstance(source, (str, Path)):
        if not any(Path(source).glob(f'*/{SENSOR}')):
            raise LakeError(
                f'{source} has no catalog',
                remedy='fetch with a query, such as --since yesterday: fetching by prefix includes no rows',
            )
        return Place(StoreSettings(), Path(source).absolute()), fetched(Path(source))
    found = source or default_source()
    return Place(found.settings), found


def fetched(folder: Path) -> Bucket:
    """A folder of fetched objects as a bucket: it also has their rows (``fetched.keep_rows``)."""
    whole = folder.absolute()
    return Bucket(StoreSettings(directory=whole.parent), whole.name)


def pull(
    lake: Bucket, source: Bucket | Path | str | None, sensors: Sequence[str], flags: Mapping[str, Any], findings: Findings
) -> None:
    """Request what robots keep of these sensors. Raises SettingError for a folder, and the errors of ``request_and_wait``."""
    if isinstance(source, (str, Path)):
        raise SettingError('pull', True, 'a store as the source, because robots receive requests through the store')
    request_and_wait(lake, flags, sensors=sensors, say=log.info, findings=findings)


def labels_of(lake: Bucket, objects: Sequence[tuple[Track, int]], findings: Findings) -> list[list[str]]:
    """The labels of each message in these objects of tracks. Raises StoreError."""
    names: dict[str, list[Any]] = {name: [] for name in ('robot', 'bucket', 'key', 't_start_ns')}
    for track, number in objects:
        stamps = [int(stamp) for stamp in track.stamps_ns(number)]
        names['t_start_ns'] += stamps
        for name, value in (('robot', track.robot), ('bucket', track.bucket[number].as_py()), ('key', track.key[number].as_py())):
            names[name] += [value] * len(stamps)
    found = [label for robot in sorted(set(names['robot'])) for label in labels.read(lake, robot, findings=findings)]
    return labels.column(pa.table({**names, 't_end_ns': names['t_start_ns']}), found)


def select(source: Bucket, anchor: str, aligned: Mapping[str, Near | Window], size: tuple[int, int] | None,
           flags: Mapping[str, Any], findings: Findings) -> Selection:  # fmt: skip
    """Select the objects of a dataset.

    Raises SettingError for an invalid query, UnknownName for an anchor or a name in ``flags`` that the catalog does not have,
    LakeError if an aligned sensor has no objects, StoreError.
    """
    for name, how in aligned.items():
        if min(how.reach_ns) < 0 or not sum(how.reach_ns):
            raise SettingError(f'align[{name!r}]', how, 'a time of more than 0 s')
    found = _rows(query.object_batches(source, columns=NEEDED, findings=findings, sensor=anchor, **flags))
    ends = pc.utf8_lower(pc.replace_substring_regex(found['key'], r'^.*\.([^./]*)$', r'\1'))
    found = _kept(found, pc.is_in(ends, value_set=pa.array(sorted(IMAGES | CLOUDS | ARCHIVES))))
    anchors = tracks_of(_possible(found, findings))
    del found, ends
    if not anchors:
        check_names(source, findings, sensor=anchor, **flags)
    sides = _sides(source, list(anchors.values()), aligned, findings, flags) if anchors else {}
    pa.default_memory_pool().release_unused()  # 1 GB for a million rows
    return Selection(tuple(anchors.values()), dict(aligned), sides, size, flags.get('by', BY_STAMP))


def _sides(source: Bucket, anchors: list[Track], aligned: Mapping[str, Near | Window], findings: Findings,
           flags: Mapping[str, Any]) -> dict[tuple[str, str], Track]:  # fmt: skip
    if not aligned:
        return {}
    reach = max(max(how.reach_ns) for how in aligned.values()) + SECOND
    longest_ns = 3600 * SECOND  # a batch that started this long before a time can overlap it (sensor.batch_s)
    since = utc(min(int(track.start_ns[0]) for track in anchors) - reach - longest_ns)
    until = utc(max(int(track.latest_ns[-1]) for track in anchors) + reach)
    where = among('sensor', aligned)
    same = {name: flags[name] for name in ('as_of', 'by') if name in flags}
    found = _rows(query.object_batches(source, columns=NEEDED, findings=findings, since=since, until=until, where=where, **same))
    for name in aligned:
        kinds = {*pc.unique(found.filter(pc.equal(found['sensor'], name))['type']).to_pylist()}
        if not kinds:
            raise LakeError(f'{name} has no object in the time of {anchors[0].sensor}',
                            remedy='check that it is the name of a sensor and was fetched, or remove it from align')  # fmt: skip
        if len(kinds) > 1:
            raise LakeError(
                f'{name} has messages of several types: {", ".join(sorted(map(str, kinds)))}', remedy='restrict the time'
            )
    return {key: _near(track, anchors, reach) for key, track in tracks_of(found).items()}


def _near(track: Track, anchors: list[Track], reach: int) -> Track:
    """The rows near the times of the same robot's anchors: there can be months between two anchors."""
    same = [anchor for anchor in anchors if anchor.robot == track.robot]
    first = min((int(anchor.start_ns[0]) for anchor in same), default=0) - reach
    last = max((int(anchor.latest_ns[-1]) for anchor in same), default=0) + reach
    return track.only(track.within(first, last))


def _rows(batches: Iterable[pa.Table]) -> pa.Table:
    """Pack the rows batch by batch: unpacked, a million rows would take 0.5 GB."""
    found = [packed(batch.filter(pc.is_valid(batch['t_start']))) for batch in batches]
    return pa.concat_tables([packed(narrow(NEEDED).empty_table()), *found])


def _possible(rows: pa.Table, findings: Findings) -> pa.Table:
    """The rows without those that claim more messages than an object can have: they would dominate the dataset."""
    counts = pc.fill_null(rows['count'], 0)
    is_possible = pc.and_(pc.greater_equal(counts, 0), pc.less_equal(counts, MAX_MEMBERS))
    for row in rows.filter(pc.invert(is_possible)).select(['key', 'count']).to_pylist():
        findings.add(row['key'], f'its row claims {row["count"]:,} messages', 1)
    return _kept(rows, is_possible)


def _kept(rows: pa.Table, mask: pa.ChunkedArray) -> pa.Table:
    """The filtered rows; unchanged, without a copy, if all are kept."""
    return rows if pc.all(mask).as_py() else rows.filter(mask)


def tracks_of(rows: pa.Table) -> dict[tuple[str, str], Track]:
    """The tracks, by robot and sensor."""
    robots, sensors = (pc.fill_null(rows[name], '') for name in ('robot', 'sensor'))
    names = {(robot, sensor) for robot in pc.unique(robots).to_pylist() for sensor in pc.unique(sensors).to_pylist()}
    if len(names) == 1:  # without a copy, because the largest tables have one sensor
        return {names.pop(): Track.of(rows)}
    found = {}
    for robot, sensor in sorted(names):
        ours = rows.filter(pc.and_(pc.equal(robots, robot), pc.equal(sensors, sensor)))
        if len(ours):
            found[robot, sensor] = Track.of(ours)
    return found
