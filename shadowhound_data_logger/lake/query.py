"""Queries over what is stored: by flags, or by SQL over ``objects missions topics gaps watermarks labels forgotten``.

The results are Arrow tables. The engine (lake/tables.py) reads only the selected rows and columns into this process.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from itertools import groupby
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake import QueryBuilder

from shadowhound_data_logger.core import earth
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError, PolicyRefused, StoreError
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.stamps import BY_STAMP
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.formats.rows.catalog import COLUMNS, FORGOTTEN, OBJECTS
from shadowhound_data_logger.formats.rows.gaps import COMPLETE, GAP, GAPS
from shadowhound_data_logger.formats.rows.labels import LABELS
from shadowhound_data_logger.lake import labels
from shadowhound_data_logger.lake.bucket import Bucket, default_source
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import newest, watermarks
from shadowhound_data_logger.lake.names import misspelled
from shadowhound_data_logger.lake.select import Wanted, date_of, wanted
from shadowhound_data_logger.lake.summaries import SUMMARY, ended
from shadowhound_data_logger.lake.tables import (
    MISSION_ROWS,
    ROBOT,
    Tables,
    among,
    answer,
    batches,
    engine,
    literal,
    narrow,
    quoted,
)
from shadowhound_data_logger.lake.views import rows_of, views
from shadowhound_data_logger.policies.manifest import BUCKET as POLICIES
from shadowhound_data_logger.policies.manifest import MANIFEST, MAX_MANIFEST_BYTES, PREFIX, parse_manifest, split_id

ALL: Final = 'all_objects'
"""The view of the table; ``objects`` is restricted by the flags."""
_TOPICS: Final = (
    'CREATE VIEW topics AS SELECT robot, topic, sensor, type, count(key) AS objects, sum(bytes) AS bytes, '
    'sum("count") AS messages, min(t_start) AS first, max(t_end) AS last FROM objects WHERE topic IS NOT NULL '
    'GROUP BY robot, topic, sensor, type'
)
_MISSION_ROWS: Final = (
    'SELECT robot, mission_id, max(run_id) AS run_id, max(mission_type) AS mission_type, count(key) AS objects, '
    'sum(bytes) AS bytes, min(t_start) AS first, max(t_end) AS last FROM {} WHERE mission_id IS NOT NULL AND {} '
    'GROUP BY robot, mission_id ORDER BY first, mission_id'
)
_MISSIONS: Final = re.compile(r'\bmissions\b', re.IGNORECASE)
_LABELS: Final = re.compile(r'\blabels\b', re.IGNORECASE)
_FORGOTTEN: Final = re.compile(r'\bforgotten\b', re.IGNORECASE)
_GAPS: Final = re.compile(r'\b(gaps|watermarks)\b', re.IGNORECASE)
_OF_OBJECTS: Final = ('near', 'near_gps', 'mission_type', 'success', 'policy', 'where', 'label')
"""Flags that do not apply to gaps."""
_UNSEEN: Final = {'what', 'id', 'revision', 'received', 'skipped', 'format_version'}
_GAP_COLUMNS: Final = [name for name in GAPS.columns if name not in _UNSEEN]
_OF_WATERMARKS: Final = {
    'robot',
    'sink',
    'topic',
    'session',
    't_from',
    't_to',
    'from_ns',
    'to_ns',
    'grade',
    'received',
    'skipped',
}
_UNSEEN_OF_LABELS: Final = {'what', 'made', 'format_version'}
_WATERMARK_COLUMNS: Final = [name for name in GAPS.columns if name in _OF_WATERMARKS]
MAX_MISSION_NS: Final = 24 * 3600 * SECOND
"""How long after the requested time the objects of a mission are searched for the id of its run."""
_TIMES: Final = ('robot', 'bucket', 'key', 't_start_ns', 't_end_ns')
"""The columns that determine whether an object overlaps a selected time."""
_OF_SUMMARY: Final = [name for name in SUMMARY if name not in {'mission_id', 'mission_type', 'start_ns', 'end_ns'}]
"""Columns of ``missions`` that are null for a mission that has not ended."""


@dataclass(frozen=True, slots=True)
class _Asked:
    """The queried store, the receiver of reports about invalid files, and the past time at which to read the tables, if any."""

    source: Bucket
    findings: Findings
    as_of: datetime | None = None

    @classmethod
    def of(cls, source: Bucket | None, findings: Findings | None, as_of: str | datetime | None = None) -> _Asked:
        """Raises SettingError for an invalid time."""
        found = Findings() if findings is None else findings
        if isinstance(as_of, str):
            as_of = datetime.fromtimestamp(moment('as_of', as_of, time.time_ns()) / SECOND, timezone.utc)
        return cls(source or default_source(), found, as_of)


@dataclass(frozen=True, slots=True)
class Shape:
    """Which columns of the rows, in which order, and how many at most."""

    columns: Sequence[str] = tuple(COLUMNS)
    order: str | None = None
    limit: int | None = None
    is_distinct: bool = False

    def sql(self, of: str, condition: str = 'true') -> str:
        columns = ', '.join(map(quoted, self.columns))
        order = f' ORDER BY {self.order}' if self.order else ''
        limit = f' LIMIT {self.limit}' if self.limit is not None else ''
        return f'SELECT {"DISTINCT " * self.is_distinct}{columns} FROM {of} WHERE {condition}{order}{limit}'  # noqa: S608


def objects(source: Bucket | None = None, *, columns: Sequence[str] = tuple(COLUMNS), order: str | None = None,
            limit: int | None = None, distinct: bool = False, as_of: str | datetime | None = None,
            findings: Findings | None = None, **flags: Any) -> pa.Table:  # fmt: skip
    """The stored objects that match the flags, one row per object.

    Args:
        source: the store; by default the one that the environment names.
        columns: the columns of the result, by default all of [the catalog](../formats.md#the-catalog).
        order: SQL, such as ``t_start_ns DESC``.
        limit: the maximum number of rows.
        distinct: without repeated rows.
        as_of: a past time; answer from the tables of that time.
        findings: receives invalid rows and files, which are skipped; by default they are logged.
        flags: what to select, as in ``shadowhound-data query``: ``sensor topic robot since until near near_gps mission
            mission_type success policy label where by``, such as ``since='2h'``, ``near=(3.2, 1.5, 2)``, or
            ``where='battery_pct < 30'``.

    Returns:
        An Arrow table; ``.to_pandas()`` makes a DataFrame of it.

    Raises:
        SettingError: a flag is invalid.
        LakeError: the query is invalid.
        StoreError: the store cannot be read.
    """
    lake = _Asked.of(source, findings, as_of)
    return _objects(lake, wanted(time.time_ns(), **flags), Shape(columns, order, limit, distinct))


def object_batches(source: Bucket | None = None, *, columns: Sequence[str] = tuple(COLUMNS), findings: Findings | None = None,
                   as_of: str | datetime | None = None, **flags: Any) -> Iterator[pa.Table]:  # fmt: skip
    """The rows of ``objects`` in batches, for more rows than fit into memory."""
    lake = _Asked.of(source, findings, as_of)
    asked, condition = _understood(lake, wanted(time.time_ns(), **flags))
    with _opened(lake, asked) as ready:
        shape = Shape(columns) if not asked.chosen else Shape([*dict.fromkeys((*columns, *_TIMES))])
        for batch in batches(ready, shape.sql(ALL, condition)):
            yield within_chosen(pa.Table.from_batches([batch]), asked).select(columns)


def missions(source: Bucket | None = None, *, as_of: str | datetime | None = None, findings: Findings | None = None,
             **flags: Any) -> pa.Table:  # fmt: skip
    """The missions with objects that match the flags, one row per mission, and how it ended. Arguments as in ``objects``."""
    return _missions(_Asked.of(source, findings, as_of), wanted(time.time_ns(), **flags))


def topics(source: Bucket | None = None, *, findings: Findings | None = None, **flags: Any) -> pa.Table:
    """One row per robot and topic: objects, bytes, messages, first and last time. Arguments as in ``objects``."""
    return sql('SELECT * FROM topics', source, findings=findings, **flags)


def sql(query: str, source: Bucket | None = None, *, as_of: str | datetime | None = None, findings: Findings | None = None,
        **flags: Any) -> pa.Table:  # fmt: skip
    """The answer to a query in SQL over the views ``objects missions topics gaps watermarks labels forgotten``.

    Args:
        query: a SELECT in DataFusion's SQL.
        source: the store; by default the one that the environment names.
        as_of: a past time; answer from the tables of that time.
        findings: receives invalid rows and files, which are skipped; by default they are logged.
        flags: restrict each view, as in ``objects``.

    Raises:
        LakeError: invalid SQL, or an unknown column.
    """
    lake, asked = _Asked.of(source, findings, as_of), wanted(time.time_ns(), **flags)
    more: dict[str, pa.Table] = {}
    if _MISSIONS.search(query):
        more['missions'] = _missions(lake, asked)
    if _LABELS.search(query):
        more['labels'] = _labels(lake, asked)
    if _FORGOTTEN.search(query):
        more['forgotten'] = _forgotten(lake, asked)
    if _GAPS.search(query):
        more |= _gaps(lake, asked)
    asked, condition = _understood(lake, asked)
    names = {'objects', 'topics', *more, *COLUMNS, *(name for view in more.values() for name in view.column_names)}
    with answering(query, names):
        if asked.chosen:
            with engine({'objects': _objects(lake, asked, Shape()), **more}) as ready:
                answer(ready, _TOPICS)
                return answer(ready, query)
        with _opened(lake, asked, more) as ready:
            answer(ready, f'CREATE VIEW objects AS {Shape().sql(ALL, condition)}')
            answer(ready, _TOPICS)
            return answer(ready, query)


def chosen(rows: pa.Table, where: str) -> pa.Table:
    """The rows that satisfy a condition. Raises LakeError for invalid SQL or an unknown column."""
    with engine({'rows': rows}) as ready, answering(where, rows.column_names):
        return answer(ready, f'SELECT * FROM rows WHERE ({where}\n)')  # noqa: S608 - the condition is the caller's own SQL


def ordered(rows: pa.Table, order: str | None, limit: int | None) -> pa.Table:
    """The first rows in an order such as ``t_start DESC``. Raises LakeError for an unknown column."""
    with engine({'rows': rows}) as ready, answering(order or '', rows.column_names):
        return answer(ready, Shape(rows.column_names, order, limit).sql('rows'))


@contextmanager
def answering(query: str, known: Iterable[str]) -> Iterator[None]:
    """Add the most similar known names as the remedy of a LakeError about an unknown name."""
    try:
        yield
    except LakeError as error:
        remedy = misspelled(query, error.what, set(known))
        raise LakeError(error.what, remedy=remedy or error.remedy) from error


@contextmanager
def _opened(lake: _Asked, asked: Wanted, more: Mapping[str, pa.Table] | None = None) -> Iterator[QueryBuilder]:
    has_date = asked.has_date if asked.since_ns is not None or asked.until_ns is not None else None
    with views(lake.source, [OBJECTS], lake.findings, robot=asked.robot, has_date=has_date, as_of=lake.as_of, more=more,
               by=asked.by) as ready:  # fmt: skip
        yield ready


def _objects(lake: _Asked, asked: Wanted, shape: Shape) -> pa.Table:
    asked, condition = _understood(lake, asked)
    with _opened(lake, asked) as ready, answering(f'{asked.where or ""} {shape.order or ""}', COLUMNS):
        if not asked.chosen:
            return answer(ready, shape.sql(ALL, condition))
        wide = Shape() if shape.order else Shape([*dict.fromkeys((*shape.columns, *_TIMES))])
        found = within_chosen(answer(ready, wide.sql(ALL, condition)), asked)
    if not (shape.order or shape.limit is not None or shape.is_distinct):
        return found.select(shape.columns)
    with engine({'rows': found}) as ready:
        return answer(ready, shape.sql('rows'))


def within_chosen(table: pa.Table, asked: Wanted) -> pa.Table:
    """The rows that are in all of the query's selections of times and objects."""
    if not asked.chosen:
        return table
    first = pc.fill_null(table['t_start_ns'], -1).to_numpy()
    last = np.maximum(first, pc.fill_null(table['t_end_ns'], -1).to_numpy())
    kept = np.ones(len(table), bool)
    for some in asked.chosen:
        found = np.zeros(len(table), bool)
        for robot, each in groupby(some.spans, lambda span: span.robot):
            since, until = np.array([span[1:] for span in each], np.int64).T
            place = np.searchsorted(until, first)
            inside = (place < len(until)) & (since[np.minimum(place, len(until) - 1)] <= last)
            is_its = pc.fill_null(pc.equal(table['robot'], robot), fill_value=False).to_numpy() if robot else True
            found |= inside & is_its
        if some.keys:
            pairs = zip(table['bucket'].to_pylist(), table['key'].to_pylist(), strict=True)
            found |= np.fromiter((pair in some.keys for pair in pairs), bool, len(table))
        kept &= found
    return table.filter(pa.array(kept))


def _understood(lake: _Asked, asked: Wanted) -> tuple[Wanted, str]:
    """The query with labels and missions replaced by times and ids, and the condition for a row in SQL."""
    asked = labels.with_label_resolved(lake.source, asked, lake.findings)
    conditions = list(_conditions(asked))
    if asked.mission is not None:
        runs = {} if '_' in asked.mission else _runs(lake, asked)  # ids of runs have no underscore, ids of missions have
        of_run = [mission for mission, run in runs.items() if run.startswith(asked.mission)]
        begins = f'starts_with(mission_id, {literal(asked.mission)})'
        conditions.append(f'({begins} OR {among("mission_id", of_run)})' if of_run else begins)
    if asked.success is not None or asked.policy is not None:
        conditions.append(among('mission_id', _missions_of(lake, asked)))
    return asked, ' AND '.join(conditions) or 'true'


def _missions_of(lake: _Asked, asked: Wanted) -> list[str]:
    """The missions with the requested result in which the requested policy was active."""
    columns = ('mission_id', 'success', 'policy', 'policies')
    found = _missions(lake, replace(asked, success=None, policy=None)).select(columns).to_pydict()
    return [mission for mission, success, policy, policies in zip(*(found[name] for name in columns), strict=True)
            if asked.success in {None, success}
            and (asked.policy is None or _has_policy(policies or policy or '', asked.policy))]  # fmt: skip


def _has_policy(names: str, wanted: str) -> bool:
    """Whether one of ids such as ``go2_patrol@7#0123456789abcdef`` matches: by name, by name and version, or by its start."""
    for name in names.split(', '):
        version, is_one, _ = name.partition('#')
        if is_one and (wanted in {version, version.partition('@')[0]} or ('#' in wanted and name.startswith(wanted))):
            return True
    return False


def _conditions(asked: Wanted) -> Iterator[str]:
    for name in ('robot', 'sensor', 'topic', 'mission_type'):
        if (value := getattr(asked, name)) is not None:
            yield f'{name} = {literal(value)}'
    if asked.since_ns is not None:
        yield f't_start IS NOT NULL AND t_start_ns >= {asked.since_ns}'
        if asked.by == BY_STAMP:
            yield f'date >= {literal(date_of(asked.since_ns))}'
    if asked.until_ns is not None:
        yield f't_start IS NOT NULL AND t_start_ns < {asked.until_ns}'
        if asked.by == BY_STAMP:
            yield f'date <= {literal(date_of(asked.until_ns - 1))}'
    if asked.near is not None:
        x, y, radius = asked.near
        for name, middle in (('x', x), ('y', y)):  # a box first: by statistics, parts of a file can be skipped
            yield f'{name} BETWEEN {middle - radius!r} AND {middle + radius!r}'
        east, north = f'(x - {x!r})', f'(y - {y!r})'
        yield f'{east} * {east} + {north} * {north} <= {radius * radius!r}'
    if asked.near_gps is not None:
        yield from _on_earth(*asked.near_gps)
    if asked.where is not None:
        yield f'({asked.where}\n)'  # a comment at its end must not hide the parenthesis


def _on_earth(latitude: float, longitude: float, radius: float) -> Iterator[str]:
    """``earth.is_within`` in SQL."""
    around = min(radius / earth.RADIUS_M, math.pi)
    degrees = math.degrees(around) + 1e-6
    yield f'latitude BETWEEN {latitude - degrees!r} AND {latitude + degrees!r}'  # first: by statistics, files can be skipped
    north, east = (
        f'sin(radians({name} - {middle!r}) / 2)' for name, middle in (('latitude', latitude), ('longitude', longitude))
    )
    parallel = f'{math.cos(math.radians(latitude))!r} * cos(radians(latitude))'
    yield f'{north} * {north} + {parallel} * {east} * {east} <= {earth.haversine(around) + earth.TOLERANCE!r}'


def _missions(lake: _Asked, asked: Wanted) -> pa.Table:
    """The missions that have objects among these, and how they ended."""
    asked, condition = _understood(lake, asked)
    if asked.chosen:
        rows = _objects(lake, asked, Shape())
        with engine({'objects': rows}) as ready:
            found = answer(ready, _MISSION_ROWS.format('objects', 'true'))
    else:
        with _opened(lake, asked) as ready:
            found = answer(ready, _MISSION_ROWS.format(ALL, condition))
    columns = found.to_pydict()
    if None in columns['run_id']:
        known = _runs(lake, asked)
        columns['run_id'] = [run or known.get(name) for name, run in zip(columns['mission_id'], columns['run_id'], strict=True)]
    runs = [*zip(columns[ROBOT], columns['run_id'], strict=True)]
    by_run = ended(lake.source, {(robot, run) for robot, run in runs if run is not None}, Tables.of(lake.source), lake.as_of)
    ends = [by_run.get(run, {}) for run in runs]
    types = [kind or end.get('mission_type') for kind, end in zip(columns['mission_type'], ends, strict=True)]
    columns |= {'mission_type': types, **{name: [end.get(name) for end in ends] for name in _OF_SUMMARY}}
    datasets = {each: _dataset_of(lake.source, each) for each in {*columns['policy']} - {None}}
    columns['policy_dataset'] = [datasets.get(each) for each in columns['policy']]
    kinds = {**{field.name: field.type for field in MISSION_ROWS.schema}, **{field.name: field.type for field in found.schema}}
    return pa.table({name: pa.array(values, kinds.get(name, pa.string())) for name, values in columns.items()})


def _dataset_of(source: Bucket, policy: str) -> str | None:
    """The digest of the dataset that a policy was trained on, from its manifest in the store; None without a manifest.

    The id contains the start of the manifest's hash, so a mission cannot refer to a forged manifest.
    """
    name, version, sha256 = split_id(policy) or ('', 0, '')
    models = Bucket(source.settings, POLICIES)
    with suppress(StoreError, PolicyRefused):
        for robot_type in models.folders(f'{PREFIX}/') if name else ():
            key = f'{PREFIX}/{robot_type}/{name}_v{version}/{MANIFEST}'
            if is_name(robot_type) and models.head(key) is not None:
                manifest = parse_manifest(models.get(key, MAX_MANIFEST_BYTES))
                if manifest.sha256.startswith(sha256):
                    return manifest.dataset or None
    return None


def _labels(lake: _Asked, asked: Wanted) -> pa.Table:
    """The labels that overlap the requested time."""
    found = labels.read(lake.source, asked.robot, label=asked.label, findings=lake.findings)
    since_ns, until_ns = asked.since_ns or 0, (1 << 63) - 1 if asked.until_ns is None else asked.until_ns
    rows = [asdict(each) for each in found if each.until_ns >= since_ns and each.since_ns < until_ns]
    names = [name for name in LABELS.columns if name not in _UNSEEN_OF_LABELS]
    return pa.Table.from_pylist(rows, schema=narrow(names, LABELS))


def _forgotten(lake: _Asked, asked: Wanted) -> pa.Table:
    """The objects that were deleted by ``lake prune``, by the time of the data."""
    if refused := [name for name in (*_OF_OBJECTS, 'mission') if getattr(asked, name) is not None]:
        raise LakeError(f'forgotten cannot be selected by {" ".join(refused)}',
                        remedy='select by robot, sensor, topic, since or until')  # fmt: skip
    conditions = [f'{name} = {literal(getattr(asked, name))}' for name in ('sensor', 'topic') if getattr(asked, name) is not None]
    conditions += [] if asked.since_ns is None else [f't_start_ns >= {asked.since_ns}']
    conditions += [] if asked.until_ns is None else [f't_start_ns < {asked.until_ns}']
    columns = [name for name in FORGOTTEN.columns if name != 'format_version']
    where = ' AND '.join(conditions) or 'true'
    rows = rows_of(lake.source, FORGOTTEN, lake.findings, robot=asked.robot, where=where, columns=columns)
    return rows.sort_by([('t_start_ns', 'ascending'), ('forgotten_ns', 'ascending')])


def _gaps(lake: _Asked, asked: Wanted) -> dict[str, pa.Table]:
    """The newest statements about gaps that overlap the requested time, and the watermarks."""
    if refused := [name for name in _OF_OBJECTS if getattr(asked, name) is not None]:
        raise LakeError(f'gaps and watermarks cannot be selected by {" ".join(refused)}',
                        remedy='select by robot, sensor, topic, since, until or mission, or join them with objects')  # fmt: skip
    rows = newest(lake.source, robot=asked.robot, topic=asked.topic, since_ns=asked.since_ns, findings=lake.findings,
                  by=asked.by)  # fmt: skip
    if asked.sensor is not None:
        topics = _objects(lake, asked, Shape(['topic'], is_distinct=True))['topic'].to_pylist()
        rows = rows.filter(pc.is_in(rows['topic'], value_set=pa.array(topics, pa.string())))
    if asked.since_ns is not None:
        rows = rows.filter(pc.greater_equal(rows['to_ns'], asked.since_ns))
    if asked.until_ns is not None:
        rows = rows.filter(pc.less(rows['from_ns'], asked.until_ns))
    completes = rows.filter(pc.equal(rows['what'], COMPLETE)).to_pylist()
    marks = pa.Table.from_pylist(watermarks(completes), schema=rows.schema)
    gaps = rows.filter(pc.equal(rows['what'], GAP))
    if asked.mission is not None:
        gaps = gaps.filter(pc.starts_with(gaps['mission_id'], asked.mission))
    return {'gaps': gaps.select(_GAP_COLUMNS), 'watermarks': marks.select(_WATERMARK_COLUMNS)}


def _runs(lake: _Asked, asked: Wanted) -> dict[str, str]:
    """The run of each mission of that time, from any of its objects: those delivered before the run existed do not name it."""
    until_ns = None if asked.until_ns is None else asked.until_ns + MAX_MISSION_NS
    of_time = Wanted(robot=asked.robot, since_ns=asked.since_ns, until_ns=until_ns, by=asked.by)
    where = ' AND '.join((*_conditions(of_time), 'mission_id IS NOT NULL', 'run_id IS NOT NULL'))
    with _opened(lake, of_time) as ready:
        found = answer(ready, f'SELECT mission_id, max(run_id) AS run_id FROM {ALL} WHERE {where} GROUP BY mission_id')  # noqa: S608
    return dict(zip(found['mission_id'].to_pylist(), found['run_id'].to_pylist(), strict=True))
