"""Conditions on the numbers in the objects: compared with a loop over all messages, for any numbers."""

from __future__ import annotations

import hashlib
import json
import math
import operator
from contextlib import closing, suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import orjson
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lake.making import NOON_NS, add, folder_store, merge

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.statistics import STATISTICS, statistic_rows
from shadowhound_data_logger.formats.statistics import MAX_FIELDS, FieldStatistics
from shadowhound_data_logger.lake import query, values
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.stores import open_store

SIGNS = {'<': operator.lt, '<=': operator.le, '>': operator.gt, '>=': operator.ge, '=': operator.eq, '!=': operator.ne}
NUMBERS = st.sampled_from([0.0, -1.0, 2.5, 7.038531e-26, 1e308, -1e308, math.inf, -math.inf, math.nan, 15.0, 0.1])
"""Few, so that they often equal the thresholds."""
MESSAGES = st.lists(
    st.fixed_dictionaries({}, optional={'a': NUMBERS, 'n': st.fixed_dictionaries({'b': NUMBERS}),
                                        'l': st.lists(NUMBERS, max_size=3), 'w': st.lists(NUMBERS, min_size=21, max_size=22)}),
    min_size=1, max_size=5,
)  # fmt: skip
"""A batch: fields that some messages lack, nested ones, lists of changing length, and long ones."""
FIELDS = st.sampled_from(['a', 'n.b', 'n', 'l', 'l.1', 'w', 'z'])
LEAVES = st.builds(
    '{0}s.{1}{2} {3} {4}'.format,
    st.sampled_from(['', '', '', 'min(', 'max(', 'mean(', 'first(', 'last(', 'count(', 'nan_count(']), FIELDS, st.just(''),
    st.sampled_from(sorted(SIGNS)), st.sampled_from([0, -1.0, 2.5, 15, 0.1, 3]),
).map(lambda text: text.replace(' ', ') ', 1) if '(' in text else text)  # fmt: skip
CONDITIONS = st.recursive(LEAVES, lambda inner: st.builds('({}) {} ({})'.format, inner, st.sampled_from(['and', 'or']), inner),
                          max_leaves=3)  # fmt: skip


def body(begin_ns: int, messages: list[dict[str, Any]]) -> bytes:
    samples = [{'stamp_ns': begin_ns + place * SECOND // 10, **message} for place, message in enumerate(messages)]
    return orjson.dumps({'robot': 'thor', 'sensor': 's', 'count': len(samples), 'samples': samples})


def filled(root: Path, batches: list[list[dict[str, Any]]], with_statistics: list[bool], chosen: tuple[str, ...] = ()) -> Bucket:
    """A lake with a batch every minute; ``told`` selects those with statistics."""
    store_settings = folder_store(root)
    with closing(open_store(store_settings, UploadSettings())) as store:
        rows, statistics = [], []
        for number, (messages, is_told) in enumerate(zip(batches, with_statistics, strict=True)):
            begin_ns = NOON_NS + number * 60 * SECOND
            content = body(begin_ns, messages)
            key = f'thor/s/20261028/{number:06d}_s.json'
            add(store, root, key, content)
            metadata = {'robot': 'thor', 'sensor': 's', 'topic': '/s', 'type': 'x/msg/S', 'count': str(len(messages)),
                        'sha256': hashlib.sha256(content).hexdigest(), 't_start_ns': str(begin_ns),
                        't_end_ns': str(begin_ns + (len(messages) - 1) * SECOND // 10)}  # fmt: skip
            row = catalog.row_of(catalog.BUCKET, key, len(content), 'application/json', metadata)
            rows.append(row)
            if is_told:
                found = FieldStatistics(chosen)
                found.add(orjson.loads(content)['samples'])
                statistics += statistic_rows(row, found.result())
        add(store, root, catalog.OBJECTS.part_key('thor', '2026-10-28', '20261028T120000_a'), parts.encode(rows))
        for name in 'ab' if statistics else '':  # delivered twice, as after a power cut
            key = STATISTICS.part_key('thor', '2026-10-28', f'20261028T12000{"ab".index(name)}_{name}')
            add(store, root, key, parts.encode(statistics, STATISTICS))
    return Bucket(store_settings, catalog.BUCKET)


# -- the oracle: a loop that does not use statistics ---------------------------------------------------------------------------


def numbers(value: Any, path: list[str]) -> list[float]:
    """The meaning of a path in a message: all finite numbers below it; in long lists elements have no separate numbers."""
    if isinstance(value, dict):
        below = [value[path[0]]] if path and path[0] in value else [] if path else list(value.values())
        return [number for each in below for number in numbers(each, path[1:])]
    if isinstance(value, list):
        if not path:
            return [number for each in value for number in numbers(each, [])]
        place = int(path[0])
        return numbers(value[place], path[1:]) if place < len(value) <= 20 else []
    return [value] if not path and value is not None and math.isfinite(value) else []


def fields(messages: list[dict[str, Any]], path: str) -> dict[str, list[float | None]]:
    """The numbers of each field that a path selects, in message order; None for those not finite."""
    found: dict[str, list[float | None]] = {}

    def walk(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, each in value.items():
                walk(f'{name}.{key}'.lstrip('.'), each)
        elif isinstance(value, list):
            for place, each in enumerate(value):
                walk(f'{name}.{place}' if len(value) <= 20 else f'{name}.*', each)
        elif name == path or name.startswith(f'{path}.'):
            found.setdefault(name, []).append(value if value is not None and math.isfinite(value) else None)

    for message in messages:
        walk('', message)
    return found


def met(text: str, messages: list[dict[str, Any]]) -> list[bool]:
    """For each message, by splitting the condition at its outermost operator."""
    if text.startswith('('):
        depth = next(at for at in range(1, len(text)) if text[: at + 1].count('(') == text[: at + 1].count(')'))
        word, right = text[depth + 1 :].strip().split(' ', 1)
        pairs = zip(met(text[1:depth], messages), met(right.strip()[1:-1], messages), strict=True)
        return [all(pair) if word == 'and' else any(pair) for pair in pairs]
    left, sign, number = text.split()
    function, _, name = left.rstrip(')').rpartition('(')
    path = name.partition('.')[2]
    if not function:
        return [any(SIGNS[sign](each, float(number)) for each in numbers(message, path.split('.'))) for message in messages]
    holds = False
    for each in fields(messages, path).values():
        finite = [value for value in each if value is not None]
        values: dict[str, Any] = {'count': len(finite), 'nan_count': len(each) - len(finite)}
        if finite:
            values |= {'min': min(finite), 'max': max(finite), 'first': finite[0], 'last': finite[-1]}
            with suppress(OverflowError):
                values['mean'] = math.fsum(finite) / len(finite)
        holds |= function in values and SIGNS[sign](values[function], float(number))
    return [holds] * len(messages)


def expected(text: str, batches: list[list[dict[str, Any]]]) -> list[tuple[int, int, int]]:
    """Runs of messages that meet the condition: first and last stamp, and their number."""
    runs = []
    for number, messages in enumerate(batches):
        begin_ns = NOON_NS + number * 60 * SECOND
        run: list[int] = []
        for place, holds in enumerate([*met(text, messages), False]):
            if holds:
                run.append(begin_ns + place * SECOND // 10)
            elif run:
                runs.append((run[0], run[-1], len(run)))
                run = []
    return runs


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('values')


LATER = datetime.fromtimestamp(NOON_NS // SECOND, timezone.utc) + timedelta(days=9)
examples = [0]


@given(st.lists(MESSAGES, min_size=1, max_size=4), st.lists(CONDITIONS, min_size=4, max_size=4), st.data())
@settings(max_examples=5, deadline=None, suppress_health_check=list(HealthCheck))
def test_the_answer_is_what_a_loop_over_all_messages_finds(
    folder: Path, batches: list[list[dict[str, Any]]], conditions: list[str], data: st.DataObject
) -> None:
    """With statistics of all objects, of some, or of selected fields; before files of tables are merged and after it."""
    report = data.draw(st.lists(st.booleans(), min_size=len(batches), max_size=len(batches)))
    examples[0] += 1
    root = folder / str(examples[0])
    source = filled(root, batches, report, data.draw(st.sampled_from([(), ('a', 'n')])))
    if data.draw(st.booleans()):
        merge(source.settings)
    seen = [[json.loads(orjson.dumps(message)) for message in messages] for messages in batches]
    for text in conditions:
        found = values.ranges(text, source, scan=True, join_s=0.0)
        assert [(each.since_ns, each.until_ns, each.messages) for each in found.ranges] == expected(text, seen), text
        assert found.unknown == 0


BATCHES = [[{'a': 1.0 * number + place} for place in range(5)] for number in range(10)]
"""Ten batches: 0 to 4, 1 to 5, ... 9 to 13."""


def test_only_objects_that_may_match_are_opened(tmp_path: Path) -> None:
    """A batch is not opened if all or none of its messages meet the condition; for a statistic, none is."""
    source = filled(tmp_path, BATCHES, [True] * 10)
    found = values.ranges('s.a > 11', source)
    assert (found.objects, found.opened, found.unknown) == (10, 2, 0)
    assert [(each.since_ns - NOON_NS) / SECOND for each in found.ranges] == [480.4, 540.3]
    assert values.ranges('s.a >= 0', source).opened == 0
    assert values.ranges('s.b > 1', source).fields == ('a',)
    assert values.ranges('s.a > 99', source).fields == ()
    assert [values.ranges('max(s.a) > 12', source).opened, len(values.ranges('max(s.a) > 12', source).ranges)] == [0, 1]


def test_objects_without_statistics_are_unknown_until_scanned(tmp_path: Path) -> None:
    """A result has the number of unknown objects; with ``scan`` they are opened."""
    source = filled(tmp_path, BATCHES, [True] * 5 + [False] * 5)
    found = values.ranges('s.a > 11', source)
    assert (len(found.ranges), found.opened, found.unknown) == (0, 0, 5)
    found = values.ranges('s.a > 11', source, scan=True)
    assert (len(found.ranges), found.opened, found.unknown) == (2, 5, 0)


def test_the_ranges_of_an_answer_choose_objects(tmp_path: Path) -> None:
    """An object counts if it overlaps one of them, and a result within them is clipped to them."""
    source = filled(tmp_path, BATCHES, [True] * 10)
    found = values.ranges('s.a > 11', source)
    chosen = [{'robot': each.robot, 'since_ns': each.since_ns, 'until_ns': each.until_ns} for each in found.ranges]
    keys = query.objects(source, ranges=chosen).to_pydict()['key']
    assert sorted(keys) == ['thor/s/20261028/000008_s.json', 'thor/s/20261028/000009_s.json']
    assert query.objects(source, ranges=[]).to_pydict()['key'] == []
    assert query.objects(source, ranges=[{**chosen[0], 'robot': 'tachi'}]).to_pydict()['key'] == []
    within = values.ranges('s.a > 0', source, ranges=chosen)
    assert [(each.since_ns, each.until_ns) for each in within.ranges] == [(each['since_ns'], each['until_ns']) for each in chosen]


def test_other_readers_read_the_statistics(tmp_path: Path) -> None:
    """DuckDB reads the robot's files directly."""
    duckdb = pytest.importorskip('duckdb')
    filled(tmp_path, BATCHES, [True] * 10)
    files = f'{tmp_path}/store/sensor-data/thor/_stats/*/*.jsonl.zst'
    rows = f"read_json('{files}', format='newline_delimited', compression='zstd')"
    found = duckdb.sql(f"SELECT DISTINCT key FROM {rows} WHERE field = 'a' AND max > 11 ORDER BY key").fetchall()  # noqa: S608
    assert found == [('thor/s/20261028/000008_s.json',), ('thor/s/20261028/000009_s.json',)]


def test_fields_beyond_the_bound_are_unknown(tmp_path: Path) -> None:
    """The first fields have statistics; for the others, the condition may have been true."""
    wide = [[{f'f{place:03d}': 1.0 for place in range(MAX_FIELDS + 1)}]]
    source = filled(tmp_path, wide, [True])
    last = f's.f{MAX_FIELDS:03d} = 1'
    assert (values.ranges('s.f063 = 1', source).unknown, len(values.ranges('s.f063 = 1', source).ranges)) == (0, 1)
    assert (values.ranges(last, source).unknown, len(values.ranges(last, source).ranges)) == (1, 0)
    assert len(values.ranges(last, source, scan=True).ranges) == 1


@pytest.mark.parametrize('text', [
    's.a >', 's.a > x', 'max(s.a > 1', 's.a > 1 and', '(s.a > 1', 's.a > 1 t.b > 2', 's.a > 1 and t.b > 2', 's.a', '(' * 99,
    ' or '.join(['s.a > 1'] * 33), '(' + ' or '.join(['(s.a > 1 or s.a > 2)'] * 20) + ')', 's.a > ' + '1' * 10_000,
])  # fmt: skip
def test_an_invalid_condition_is_reported(text: str) -> None:
    """With what is allowed instead."""
    with pytest.raises(SettingError, match='when') as refused:
        values.parse(text)
    assert len(str(refused.value)) < 600


LIES: list[dict[str, Any]] = [
    {'min': 99.0}, {'max': 1.0}, {'max': None}, {'min': math.nan}, {'max': math.nan}, {'min': -math.inf}, {'max': math.inf},
    {'min': None, 'max': None}, {'min': None, 'max': None, 'count': 0}, {'first': 1e9}, {'last': None}, {'mean': 1e9},
    *({name: count} for name in ('count', 'nan_count') for count in (-1, 10**15)),
]  # fmt: skip


def test_inconsistent_statistics_are_reported(tmp_path: Path) -> None:
    """Their object counts as one without statistics, never as one without the field, and the others are evaluated as usual."""
    source = filled(tmp_path, [BATCHES[-1]] * (len(LIES) + 3), [True] * (len(LIES) + 3))
    first, second = sorted(tmp_path.glob('store/sensor-data/thor/_stats/*/*.jsonl.zst'))
    second.unlink()
    rows = parts.read_rows(first.read_bytes(), 'thor').rows['_stats']
    lies = {f'thor/s/20261028/{number:06d}_s.json': lie for number, lie in enumerate(LIES)}
    rows = [{**row, **(lies.get(row['key'], {}) if row['field'] else {})} for row in rows]
    first.write_bytes(parts.encode(rows, STATISTICS))
    left_out = Findings(lambda _: None)
    found = values.ranges('s.a > 12', source, findings=left_out)
    assert [one.key for one in left_out] == sorted(lies)
    assert (len(found.ranges), found.unknown) == (3, len(LIES))
    assert len(values.ranges('s.a > 12', source, scan=True, findings=left_out).ranges) == len(LIES) + 3


def test_absurd_counts_of_messages_hide_nothing(tmp_path: Path) -> None:
    """Objects with an impossible row are unknown, or are opened if the rows of their fields give a reason to."""
    source = filled(tmp_path, [BATCHES[-1]] * 5, [True] * 5)
    first, second = sorted(tmp_path.glob('store/sensor-data/thor/_stats/*/*.jsonl.zst'))
    second.unlink()
    rows = parts.read_rows(first.read_bytes(), 'thor').rows['_stats']
    for row, lie in zip((row for row in rows if not row['field']), LIES[-4:], strict=False):
        row.update(lie)
    first.write_bytes(parts.encode(rows, STATISTICS))
    left_out = Findings(lambda _: None)
    found = values.ranges('s.a > 12', source, findings=left_out)
    assert (len(found.ranges), found.opened, found.unknown, len(left_out)) == (5, 5, 0, 4)
    assert values.ranges('s.b > 12', source, findings=left_out).unknown == 4


def test_hostile_statistics_are_ignored(tmp_path: Path) -> None:
    """An invalid file, and rows of another robot, are reported; their objects are unknown, not absent."""
    source = filled(tmp_path, BATCHES, [True] * 10)
    for number, path in enumerate(sorted(tmp_path.glob('store/sensor-data/thor/_stats/*/*.jsonl.zst'))):
        if number:
            path.unlink()
        else:
            rows = parts.read_rows(path.read_bytes(), 'thor').rows['_stats']
            path.write_bytes(parts.encode([{**row, 'robot': 'tachi'} for row in rows], STATISTICS))
    folder = tmp_path / 'store/sensor-data/thor/_stats/date=2026-10-28'
    (folder / 'thor_20261028T999999_x.jsonl.zst').write_bytes(b'nothing')
    left_out = Findings(lambda _: None)
    found = values.ranges('s.a > 11', source, findings=left_out)
    assert (len(found.ranges), found.unknown, len(left_out)) == (0, 10, 2)
    assert len(values.ranges('s.a > 11', source, scan=True, findings=left_out).ranges) == 2


def test_only_questions_about_values_read_statistics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are in a separate folder, which other queries do not list."""
    source = filled(tmp_path, BATCHES, [True] * 10)
    asked: list[str] = []
    for name in ('list', 'get', 'ranges', 'folders'):
        call = getattr(Bucket, name)

        def count_call(of: Bucket, key: str, *more: Any, call: Any = call) -> Any:
            asked.append(key)
            return call(of, key, *more)

        monkeypatch.setattr(Bucket, name, count_call)
    assert len(query.objects(source, sensor='s').to_pydict()['key']) == 10
    assert (len(asked) > 0, [key for key in asked if '_stats' in key]) == (True, [])
    values.ranges('s.a > 11', source)
    assert [key for key in asked if '_stats' in key] != []


def slow(root: Path, stamps_s: list[float], values_: list[float]) -> Bucket:
    """A lake with an object of one message at each of these times."""
    settings_ = folder_store(root)
    with closing(open_store(settings_, UploadSettings())) as store:
        rows = []
        for second, value in zip(stamps_s, values_, strict=True):
            stamp_ns = NOON_NS + round(second * SECOND)
            content, key = body(stamp_ns, [{'a': value}]), f'thor/s/20261028/{round(second * 1000):09d}_s.json'
            add(store, root, key, content)
            metadata = {'robot': 'thor', 'sensor': 's', 'topic': '/s', 'type': 'x/msg/S', 'count': '1',
                        'sha256': hashlib.sha256(content).hexdigest(), 't_start_ns': str(stamp_ns),
                        't_end_ns': str(stamp_ns)}  # fmt: skip
            rows.append(catalog.row_of(catalog.BUCKET, key, len(content), 'application/json', metadata))
        add(store, root, catalog.OBJECTS.part_key('thor', '2026-10-28', '20261028T120000_a'), parts.encode(rows))
    return Bucket(settings_, catalog.BUCKET)


@pytest.mark.parametrize('period_s', [1.0, 5.0])
def test_jittered_samples_of_a_slow_sensor_are_one_range(tmp_path: Path, period_s: float) -> None:
    """The sensor's period determines what is joined; a real pause still separates two ranges, and --join is respected."""
    stamps = [period_s * (place + 0.35 * math.sin(7 * place) + (60 if place >= 50 else 0)) for place in range(100)]
    lake = slow(tmp_path, stamps, [20.0] * 100)
    found = values.ranges('s.a > 15', lake, scan=True)
    assert [each.messages for each in found.ranges] == [50, 50]
    assert len(values.ranges('s.a > 15', lake, scan=True, join_s=period_s).ranges) > 20
    assert len(values.ranges('s.a > 15', lake, scan=True, join_s=100 * period_s).ranges) == 1


def test_a_fast_sensor_joins_what_is_a_second_apart(tmp_path: Path) -> None:
    """Batches of many messages: the period is that of messages, not of objects."""
    high, low = [{'a': 20.0}] * 5, [{'a': 1.0}] * 5
    lake = filled(tmp_path, [high, low, high], [True] * 3)
    assert [each.messages for each in values.ranges('s.a > 15', lake).ranges] == [5, 5]
