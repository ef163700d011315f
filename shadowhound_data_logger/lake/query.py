"""Catalogue and gap journal as Daft DataFrames, and as SQL over ``objects missions topics gaps watermarks``.

A frame is lazy: it looks which parts there are when it is computed, and of other days than the asked ones not even for the names.
"""

from __future__ import annotations

import asyncio
import os
import re
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import and_
from typing import Any, Final, TypeVar

import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused, PolicyRefused, StoreError
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.untrusted import MOST_SUMMARY_BYTES, from_json
from shadowhound_data_logger.formats.rows.gaps import GAP, GAPS
from shadowhound_data_logger.formats.rows.labels import LABELS
from shadowhound_data_logger.lake import labels
from shadowhound_data_logger.lake.bucket import THREADS, Bucket, default_source
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.forgotten import forgotten
from shadowhound_data_logger.lake.gaps import newest, watermarks
from shadowhound_data_logger.lake.names import misspelled
from shadowhound_data_logger.lake.reading import arrow_schema, narrow
from shadowhound_data_logger.lake.scan import PartGroup, catalogue_rows, planned
from shadowhound_data_logger.lake.select import Wanted, wanted
from shadowhound_data_logger.policies.manifest import MANIFEST, MOST_MANIFEST_BYTES, parse_manifest, split_id
from shadowhound_data_logger.policies.registry import BUCKET as POLICIES
from shadowhound_data_logger.policies.registry import PREFIX

os.environ.setdefault('DAFT_ANALYTICS_ENABLED', '0')  # else it tells its makers of each run, over the network
os.environ.setdefault('DAFT_PROGRESS_BAR', '0')

import daft
from daft import DataFrame, Expression, col, lit
from daft.io.pushdowns import Pushdowns
from daft.io.source import DataSource, DataSourceTask
from daft.recordbatch import RecordBatch

_Answer = TypeVar('_Answer')

_MISSIONS: Final = re.compile(r'\bmissions\b', re.IGNORECASE)
_LABELS: Final = re.compile(r'\blabels\b', re.IGNORECASE)
_FORGOTTEN: Final = re.compile(r'\bforgotten\b', re.IGNORECASE)
_GAPS: Final = re.compile(r'\b(gaps|watermarks)\b', re.IGNORECASE)
_OF_OBJECTS: Final = ('near', 'mission_type', 'success', 'policy', 'where', 'label')
"""Flags that gaps know nothing of."""
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
LONGEST_NS: Final = 24 * 3600 * SECOND
"""For so long after a time that is asked for a mission may go on before one of its objects knows its run."""
PIECE_BYTES: Final = 4 << 20
"""Of parts that are one frame of several; some 50,000 compacted rows."""
_SUMMARY: Final[Mapping[str, tuple[str, pa.DataType]]] = {
    'command': ('mission_command', pa.string()),
    'started': ('start', pa.string()),
    'ended': ('end', pa.string()),
    'result': ('result', pa.string()),
    'success': ('success', pa.bool_()),
    'distance_m': ('distance_m', pa.float64()),
    'duration_s': ('duration_s', pa.float64()),
    'battery_consumed_pct': ('battery_consumed_pct', pa.float64()),
    'policy': ('policy', pa.string()),
    'policies': ('policies', pa.string()),
}
"""Columns of ``missions`` that come from ``summary.json``, null for a mission that has none yet: name there, type."""


@dataclass(frozen=True, slots=True)
class _Asked:
    """A query, and where it reports what it leaves out."""

    source: Bucket
    findings: Findings

    @classmethod
    def of(cls, source: Bucket | None, findings: Findings | None) -> _Asked:
        return cls(source or default_source(), Findings() if findings is None else findings)


def objects(source: Bucket | None = None, *, findings: Findings | None = None, **flags: Any) -> DataFrame:
    """One row an object, with the columns of ``formats/rows/schema.py``.

    ``flags`` are those of ``select.wanted``: ``sensor topic robot since until near mission mission_type success where``.
    Without a source, of the store that the environment names. Parts that are none are left out: ``findings`` has them once
    the frame is computed, in this process; without it the log warns. Raises SettingError, LakeError for what is not a question.
    """
    return _objects(_Asked.of(source, findings), wanted(time.time_ns(), **flags))


def objects_in_pieces(source: Bucket | None = None, *, findings: Findings | None = None, **flags: Any) -> Iterator[DataFrame]:
    """The rows of ``objects`` in several frames: Daft holds all that one has in memory, and more than once."""
    lake = _Asked.of(source, findings)
    asked, condition = _understood(lake, wanted(time.time_ns(), **flags))
    piece: list[PartGroup] = []
    for parts in (*planned(lake.source, asked, lake.findings), None):
        if parts is not None:
            piece.append(parts)
        if piece and (parts is None or sum(entry.size for each in piece for entry in each.entries) > PIECE_BYTES):
            yield _where(_Catalogue(lake.source, asked, lake.findings, piece), asked, condition)
            piece = []


def missions(source: Bucket | None = None, *, findings: Findings | None = None, **flags: Any) -> DataFrame:
    """One row a mission that has objects among the wanted ones, and how it ended. Reads catalogue and summaries at once."""
    return _missions(_Asked.of(source, findings), wanted(time.time_ns(), **flags))


def topics(source: Bucket | None = None, *, findings: Findings | None = None, **flags: Any) -> DataFrame:
    """One row a robot and topic: how many objects, bytes and messages, from when to when."""
    return _topics(_objects(_Asked.of(source, findings), wanted(time.time_ns(), **flags)))


def sql(query: str, source: Bucket | None = None, *, findings: Findings | None = None, **flags: Any) -> DataFrame:
    """SQL over the views, each restricted by the flags. Raises LakeError for what is not SQL or names no column."""
    chosen, asked = _Asked.of(source, findings), wanted(time.time_ns(), **flags)
    rows = _objects(chosen, asked)
    views = {'objects': rows, 'topics': _topics(rows)}
    if _MISSIONS.search(query):  # it has to look first
        views['missions'] = _missions(chosen, asked)
    if _LABELS.search(query):
        views['labels'] = _labels(chosen, asked)
    if _FORGOTTEN.search(query):
        views['forgotten'] = _forgotten(chosen, asked)
    if _GAPS.search(query):
        views.update(_gaps(chosen, asked))
    with answering(query, views):
        return daft.sql(query, register_globals=False, **views)


def chosen(rows: pa.Table, where: str) -> pa.Table:
    """The rows for which a condition holds. Raises LakeError for what is not SQL or names no column."""
    frame = daft.from_arrow(rows)
    with answering(where, {'': frame}):
        return frame.where(daft.sql_expr(where)).to_arrow()


@contextmanager
def answering(query: str = '', views: Mapping[str, DataFrame] | None = None) -> Iterator[None]:
    """Raises LakeError for what Daft cannot answer, with the nearest names in the views; use it around computing a frame, too."""
    try:
        yield
    except Exception as error:  # Daft's error for SQL has no name that could be imported
        if type(error).__module__ != 'daft.exceptions':
            raise
        text, views = ' '.join(str(error).split()), views or {}
        known = {*filter(None, views), *(name for view in views.values() for name in view.column_names)}
        raise LakeError(f'the query cannot be answered: {text}', remedy=misspelled(query, text, known)) from error


def _objects(lake: _Asked, asked: Wanted) -> DataFrame:
    asked, condition = _understood(lake, asked)
    return _where(_Catalogue(lake.source, asked, lake.findings), asked, condition)


def _where(catalog: _Catalogue, asked: Wanted, condition: Expression) -> DataFrame:
    rows = catalog.read()
    with answering(asked.where or '', {'': rows}):
        return rows.where(condition)


def _understood(lake: _Asked, asked: Wanted) -> tuple[Wanted, Expression]:
    """What is asked for as the catalogue can tell it, and the condition for a row."""
    asked = labels.labelled(lake.source, asked, lake.findings)
    with answering():
        conditions = list(_conditions(asked))
        if asked.mission is not None:
            runs = {} if '_' in asked.mission else _runs(lake, asked)  # no id of a run has one, every one of a mission
            of_run = [mission for mission, run in runs.items() if run.startswith(asked.mission)]
            conditions.append(col('mission_id').startswith(asked.mission) | col('mission_id').is_in(of_run or ['']))
        if asked.success is not None or asked.policy is not None:
            ids = _missions_of(lake, asked)
            conditions.append(col('mission_id').is_in(ids) if ids else lit(False))
    return asked, reduce(and_, conditions, lit(True))


def _missions_of(lake: _Asked, asked: Wanted) -> list[str]:
    """The missions that ended so, and in which that policy was active."""
    columns = ('mission_id', 'success', 'policy', 'policies')
    found = _missions(lake, replace(asked, success=None, policy=None)).select(*columns).to_pydict()
    return [mission for mission, success, policy, policies in zip(*(found[name] for name in columns), strict=True)
            if asked.success in {None, success}
            and (asked.policy is None or _has_policy(policies or policy or '', asked.policy))]  # fmt: skip


def _has_policy(names: str, wanted: str) -> bool:
    """Whether one of ids such as ``go2_patrol@7#0123456789abcdef`` is meant: by its name, name and version, or as it begins."""
    for name in names.split(', '):
        version, is_one, _ = name.partition('#')
        if is_one and (wanted in {version, version.partition('@')[0]} or ('#' in wanted and name.startswith(wanted))):
            return True
    return False


def _conditions(asked: Wanted) -> Iterator[Expression]:
    for name in ('robot', 'sensor', 'topic', 'mission_type'):
        if (value := getattr(asked, name)) is not None:
            yield col(name) == lit(value)
    if asked.since_ns is not None or asked.until_ns is not None:
        yield col('t_start').not_null()
    if asked.since_ns is not None:
        yield col('t_start_ns') >= lit(asked.since_ns)
    if asked.until_ns is not None:
        yield col('t_start_ns') < lit(asked.until_ns)
    if asked.near is not None:
        x, y, radius = asked.near
        for name, middle in (('x', x), ('y', y)):  # a box first: statistics can rule parts of a file out by it
            yield (col(name) >= lit(middle - radius)) & (col(name) <= lit(middle + radius))
        east, north = col('x') - lit(x), col('y') - lit(y)
        yield east * east + north * north <= lit(radius * radius)
    if asked.where is not None:
        yield daft.sql_expr(asked.where)


def _topics(rows: DataFrame) -> DataFrame:
    known = rows.where(col('topic').not_null())
    return known.groupby('robot', 'topic', 'sensor', 'type').agg(
        col('key').count().alias('objects'), col('bytes').sum().alias('bytes'), col('count').sum().alias('messages'),
        col('t_start').min().alias('first'), col('t_end').max().alias('last'),
    )  # fmt: skip


def _missions(lake: _Asked, asked: Wanted) -> DataFrame:
    """Which there are by the catalogue; how they ended by their summaries, which lie under the id of the run."""
    rows = _objects(lake, asked).where(col('mission_id').not_null())
    with answering():
        found = rows.groupby('robot', 'mission_id').agg(
            col('run_id').max(), col('mission_type').max(), col('key').count().alias('objects'),
            col('bytes').sum().alias('bytes'), col('t_start').min().alias('first'), col('t_end').max().alias('last'),
        ).sort('first').to_arrow()  # fmt: skip
    runs = found['run_id'].to_pylist()
    if None in runs:
        known = _runs(lake, asked)
        runs = [run or known.get(mission) for mission, run in zip(found['mission_id'].to_pylist(), runs, strict=True)]
        found = found.set_column(found.column_names.index('run_id'), 'run_id', pa.array(runs, pa.string()))
    with ThreadPoolExecutor(THREADS) as pool:
        told = list(pool.map(lambda pair: _summary(lake.source, *pair), zip(found['robot'].to_pylist(), runs, strict=True)))
    types = found['mission_type'].to_pylist()
    kinds = [kind or _value(one.get('mission_type'), pa.string()) for kind, one in zip(types, told, strict=True)]
    found = found.set_column(found.column_names.index('mission_type'), 'mission_type', pa.array(kinds, pa.string()))
    for column, (name, kind) in _SUMMARY.items():
        found = found.append_column(column, pa.array([_value(one.get(name), kind) for one in told], kind))
    policies = found['policy'].to_pylist()
    datasets = {each: _dataset_of(lake.source, each) for each in {*policies} - {None}}
    return daft.from_arrow(found.append_column('policy_dataset', pa.array(map(datasets.get, policies), pa.string())))


def _dataset_of(source: Bucket, policy: str) -> str | None:
    """The digest of the data set that a policy was trained on, by its manifest in the store; None where that is not there.

    The id has the beginning of the manifest's hash: a mission cannot name another one.
    """
    name, version, sha256 = split_id(policy) or ('', 0, '')
    models = Bucket(source.settings, POLICIES)
    with suppress(StoreError, PolicyRefused):
        for robot_type in models.folders(f'{PREFIX}/') if name else ():
            key = f'{PREFIX}/{robot_type}/{name}_v{version}/{MANIFEST}'
            if is_name(robot_type) and models.head(key) is not None:
                manifest = parse_manifest(models.get(key, MOST_MANIFEST_BYTES))
                if manifest.sha256.startswith(sha256):
                    return manifest.dataset or None
    return None


def _labels(lake: _Asked, asked: Wanted) -> DataFrame:
    """Those that reach into the time."""
    found = labels.read(lake.source, asked.robot, label=asked.label, findings=lake.findings)
    since_ns, until_ns = asked.since_ns or 0, (1 << 63) - 1 if asked.until_ns is None else asked.until_ns
    rows = [asdict(each) for each in found if each.until_ns >= since_ns and each.since_ns < until_ns]
    names = [name for name in LABELS.columns if name not in _UNSEEN_OF_LABELS]
    return daft.from_arrow(pa.Table.from_pylist(rows, schema=narrow(names, LABELS)))


def _forgotten(lake: _Asked, asked: Wanted) -> DataFrame:
    """What was deleted on purpose, by its own time."""
    if refused := [name for name in (*_OF_OBJECTS, 'mission') if getattr(asked, name) is not None]:
        raise LakeError(f'forgotten cannot be selected by {" ".join(refused)}',
                        remedy='select by robot, sensor, topic, since or until')  # fmt: skip
    rows = forgotten(lake.source, asked.robot, lake.findings)
    for name in ('sensor', 'topic'):
        if (value := getattr(asked, name)) is not None:
            rows = rows.filter(pc.equal(rows[name], value))
    if asked.since_ns is not None:
        rows = rows.filter(pc.greater_equal(rows['t_start_ns'], asked.since_ns))
    if asked.until_ns is not None:
        rows = rows.filter(pc.less(rows['t_start_ns'], asked.until_ns))
    return daft.from_arrow(rows.select([name for name in rows.column_names if name != 'format_version']))


def _gaps(lake: _Asked, asked: Wanted) -> dict[str, DataFrame]:
    """The newest statements about gaps that reach into the time, and how far they are complete. Reads the journal at once."""
    if refused := [name for name in _OF_OBJECTS if getattr(asked, name) is not None]:
        raise LakeError(f'gaps and watermarks cannot be selected by {" ".join(refused)}',
                        remedy='select by robot, sensor, topic, since, until or mission, or join them with objects')  # fmt: skip
    rows = newest(lake.source, robot=asked.robot, topic=asked.topic, since_ns=asked.since_ns, findings=lake.findings)
    if asked.sensor is not None:
        with answering():
            topics = _objects(lake, asked).select('topic').distinct().to_pydict()['topic']
        rows = rows.filter(pc.is_in(rows['topic'], value_set=pa.array(topics, pa.string())))
    if asked.since_ns is not None:
        rows = rows.filter(pc.greater_equal(rows['to_ns'], asked.since_ns))
    if asked.until_ns is not None:
        rows = rows.filter(pc.less(rows['from_ns'], asked.until_ns))
    marks = pa.Table.from_pylist(watermarks(rows.to_pylist()), schema=rows.schema)
    gaps = rows.filter(pc.equal(rows['what'], GAP))
    if asked.mission is not None:
        gaps = gaps.filter(pc.starts_with(gaps['mission_id'], asked.mission))
    return {'gaps': daft.from_arrow(gaps.select(_GAP_COLUMNS)), 'watermarks': daft.from_arrow(marks.select(_WATERMARK_COLUMNS))}


def _runs(lake: _Asked, asked: Wanted) -> dict[str, str]:
    """The run of each mission of that time, by whichever object knows it: one that came before there was a run does not."""
    until_ns = None if asked.until_ns is None else asked.until_ns + LONGEST_NS
    rows = _Catalogue(lake.source, Wanted(robot=asked.robot, since_ns=asked.since_ns, until_ns=until_ns), lake.findings).read()
    with answering():
        known = rows.where(col('mission_id').not_null() & col('run_id').not_null())
        found = known.groupby('mission_id').agg(col('run_id').max()).to_pydict()
    return dict(zip(found['mission_id'], found['run_id'], strict=True))


def _summary(source: Bucket, robot: str, run_id: str | None) -> dict[str, Any]:
    """What a mission's summary says; empty where there is none yet, or none that can be read."""
    if run_id is None:
        return {}
    try:
        told = from_json(source.get(f'{robot}/missions/{run_id}/summary.json', MOST_SUMMARY_BYTES), MOST_SUMMARY_BYTES)
    except (ObjectRefused, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def _value(value: Any, kind: pa.DataType) -> Any:
    """Null for what is not of its kind: a summary may be of another version."""
    if kind == pa.float64():
        return float(value) if isinstance(value, (int, float)) and abs(value) <= sys.float_info.max else None
    if kind == pa.string():  # half a surrogate pair is not text
        return value.encode(errors='replace').decode() if isinstance(value, str) else None
    return value if isinstance(value, bool) else None


# -- the catalogue as a source of Daft's ---------------------------------------------------------------------------------------


class _Catalogue(DataSource):
    """Reads the rows of one bucket's catalogue that may match a query.

    Stateless, except for what it leaves out: each run lists anew.
    """

    def __init__(
        self, source: Bucket, wanted: Wanted, findings: Findings, parts: Sequence[PartGroup] | None = None,
    ) -> None:  # fmt: skip
        """``parts``: those to read, where they are known already."""
        self._source = source
        self._wanted = wanted
        self._findings = findings
        self._planned = parts
        self._schema = daft.Schema.from_pyarrow_schema(arrow_schema())

    @property
    def name(self) -> str:
        return f'the catalogue in {self._source.describe()}'

    @property
    def schema(self) -> daft.Schema:
        return self._schema

    async def get_tasks(self, pushdowns: Pushdowns) -> AsyncIterator[DataSourceTask]:
        columns = _columns(pushdowns)
        every = self._planned
        if every is None:
            every = await _apart(lambda: list(planned(self._source, self._wanted, self._findings)))
        for parts in every:
            yield _Parts(self._source, parts, columns, self._wanted, self._findings)


class _Parts(DataSourceTask):
    """Parts that are read together, from the store to batches of the columns that are needed."""

    def __init__(self, source: Bucket, parts: PartGroup, columns: Sequence[str], wanted: Wanted, findings: Findings) -> None:
        self._source = source
        self._parts = parts
        self._columns = tuple(columns)
        self._wanted = wanted
        self._findings = findings

    @property
    def schema(self) -> daft.Schema:
        return daft.Schema.from_pyarrow_schema(narrow(self._columns))

    async def read(self) -> AsyncIterator[RecordBatch]:
        found = catalogue_rows(self._source, self._parts, self._columns, self._wanted, self._findings)
        try:
            while (table := await _apart(lambda: next(found, None))) is not None:
                for batch in table.to_batches():
                    yield RecordBatch.from_arrow_record_batches([batch], batch.schema)
        finally:
            found.close()


async def _apart(work: Callable[[], _Answer]) -> _Answer:
    """In a thread of its own, which ends with it: Daft's loop serves all tasks."""
    with ThreadPoolExecutor(1) as pool:
        return await asyncio.get_running_loop().run_in_executor(pool, work)


def _columns(pushdowns: Pushdowns) -> tuple[str, ...]:
    """In the order of the schema: those of the answer, and those that a filter looks at."""
    names = arrow_schema().names
    if pushdowns.columns is None:
        return tuple(names)
    needed = {*pushdowns.columns, *pushdowns.filter_required_column_names()}
    return tuple(name for name in names if name in needed)
