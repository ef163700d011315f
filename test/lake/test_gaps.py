"""The gap journal in the store: the newest statement counts, in any order of arrival; and what is known about a time."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lake.gap_parts import IMU, counting, lost, mark, tell
from lake.making import DAY_NS, MINUTE_NS, NOON_NS, folder_store, merge

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.formats.rows.gaps import GAP, WITHDRAWN, Statement, statement
from shadowhound_data_logger.lake import gaps
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.gaps import MAX_CAUSES, Stretch, coverage, known, of_rows
from shadowhound_data_logger.stores import open_store


@pytest.fixture
def store(tmp_path: Path) -> StoreSettings:
    return folder_store(tmp_path)


def ask(store: StoreSettings, first_s: float, last_s: float, topic: str = '/imu') -> lake.Known:
    first_ns, last_ns = (NOON_NS + int(at_s * SECOND) for at_s in (first_s, last_s))
    return known('thor', topic, first_ns, last_ns, source=Bucket(store, BUCKET))


def seconds(found: lake.Known) -> list[tuple[float, float, tuple[str, ...], str]]:
    return [((each.begin_ns - NOON_NS) / SECOND, (each.end_ns - NOON_NS) / SECOND, each.causes, each.grade)
            for each in found.stretches]  # fmt: skip


def test_without_a_watermark_gaps_are_unknown(store: StoreSettings) -> None:
    """Without statements, the absence of gaps means nothing: for a robot that never reported, and for a topic."""
    found = ask(store, 0, 10)
    assert seconds(found) == [(0, 10, (), '')]
    assert (found.is_whole, found.stretches[0].is_open, found.complete_ns) == (False, True, NOON_NS)


def test_by_received_a_gap_has_arrival_times(store: StoreSettings, tmp_path: Path) -> None:
    """A gap without a time of arrival is untimed on that clock, and no watermark extends into it."""
    late = {'received_from_ns': NOON_NS + 120 * SECOND, 'received_to_ns': NOON_NS + 123 * SECOND}
    whole = {'received_from_ns': NOON_NS + 100 * SECOND, 'received_to_ns': NOON_NS + 160 * SECOND}
    tell(store, tmp_path, mark(60, **whole), lost('1', 20, 23, **late), lost('2', 30, 31))
    first_ns, last_ns = NOON_NS + 90 * SECOND, NOON_NS + 170 * SECOND
    found = known('thor', '/imu', first_ns, last_ns, source=Bucket(store, BUCKET), by='received')
    assert seconds(found) == [
        (90, 100, (), ''), (100, 120, (), 'exact'), (120, 123, ('transport',), 'exact'), (123, 160, (), 'exact'),
        (160, 170, (), ''),
    ]  # fmt: skip
    assert [gap.from_ns for gap in found.untimed] == [None]
    (covered,) = coverage(first_ns, last_ns, source=Bucket(store, BUCKET), by='received')
    assert covered.known.stretches == found.stretches


def test_no_row_means_no_gap_only_below_the_watermark(store: StoreSettings, tmp_path: Path) -> None:
    """Complete, a gap, complete, and then a time that is not reported yet."""
    tell(store, tmp_path, mark(60), lost('1', 20, 23))
    found = ask(store, 10, 90)
    assert seconds(found) == [
        (10, 20, (), 'exact'), (20, 23, ('transport',), 'exact'), (23, 60, (), 'exact'), (60, 90, (), ''),
    ]  # fmt: skip
    assert found.complete_ns == NOON_NS + 60 * SECOND
    assert [(gap.cause, gap.count) for gap in found.gaps] == [('transport', 5)]
    assert ask(store, 25, 60).is_whole
    assert not ask(store, 25, 61).is_whole


def test_a_reported_gap_above_the_watermark_is_known(store: StoreSettings, tmp_path: Path) -> None:
    """Like a gap without times: it is listed, but belongs to no time."""
    untimed = statement('thor', GAP, 'j/9', 1, **IMU, kind='dropped', cause='queue_full', count=7)
    tell(store, tmp_path, mark(10), lost('1', 8, 14), untimed)
    found = ask(store, 5, 20)
    assert seconds(found) == [
        (5, 8, (), 'exact'),
        (8, 10, ('transport',), 'exact'),
        (10, 14, ('transport',), ''),
        (14, 20, (), ''),
    ]
    assert [gap.count for gap in found.untimed] == [7]


def test_with_received_only_accounts_gaps_are_unknown(store: StoreSettings, tmp_path: Path) -> None:
    """Without sequence numbers or a regular rate, a watermark accounts for received messages, but not for lost ones."""
    tell(store, tmp_path, mark(60, grade='received-only'), mark(60, grade='estimated', topic='/odom'))
    assert seconds(ask(store, 0, 60)) == [(0, 60, (), '')]
    assert seconds(ask(store, 0, 60, '/odom')) == [(0, 60, (), 'estimated')]


def test_messages_of_another_type_do_not_count(store: StoreSettings, tmp_path: Path) -> None:
    """They are listed, and the time is complete."""
    tell(store, tmp_path, mark(60), lost('1', 0, 60, kind='rejected', cause='wrong_type'))
    found = ask(store, 0, 60)
    assert (found.is_whole, len(found.gaps)) == (True, 1)


def test_the_time_between_sessions_is_unknown_unless_reported(store: StoreSettings, tmp_path: Path) -> None:
    """After a node was off, consecutive sequence numbers show what was lost, as soon as they arrive."""
    tell(store, tmp_path, mark(60), mark(300, 2, 200, session=2))
    assert seconds(ask(store, 0, 300)) == [(0, 60, (), 'exact'), (60, 200, (), ''), (200, 300, (), 'exact')]
    tell(store, tmp_path, lost('2', 60, 200, 3, cause='restart', session=2), name='b')
    assert seconds(ask(store, 0, 300)) == [(0, 60, (), 'exact'), (60, 200, ('restart',), ''), (200, 300, (), 'exact')]


def test_a_watermark_goes_back_when_an_object_waits_again(store: StoreSettings, tmp_path: Path) -> None:
    """The newest counts, not the latest time: a retried quarantined object is in no row, and not in the store yet."""
    tell(store, tmp_path, mark(3000), lost('1', 30, 31, kind='quarantined', cause='AccessDenied'))
    tell(store, tmp_path, mark(30, 2), lost('1', 30, 31, 2, WITHDRAWN), name='b')
    assert seconds(ask(store, 0, 60)) == [(0, 30, (), 'exact'), (30, 60, (), '')]
    tell(store, tmp_path, mark(3100, 3), name='c')
    assert ask(store, 0, 60).is_whole


def test_a_gap_over_midnight_is_found_from_either_day(store: StoreSettings, tmp_path: Path) -> None:
    """It is stored under the date of its end, and found by any time that it overlaps."""
    day_s = DAY_NS // SECOND
    tell(store, tmp_path, lost('1', 100, 2 * day_s), mark(2 * day_s + 50))
    for first_s in (100, day_s, 2 * day_s - 5):
        assert seconds(ask(store, first_s, first_s + 1))[0][2] == ('transport',)
    assert ask(store, 0, 100).is_whole


def test_a_gap_that_moves_to_another_day_is_reported_once(store: StoreSettings, tmp_path: Path) -> None:
    """Its withdrawal stays under the old date; a query of both days returns it once, one of either day the valid one."""
    day_s = DAY_NS // SECOND
    tell(store, tmp_path, lost('1', 100, day_s + 100), mark(day_s + 200))
    tell(store, tmp_path, lost('1', 100, day_s + 100, 2, WITHDRAWN), lost('1', 100, 200, 2), name='b')
    assert [gap.to_ns for gap in ask(store, 0, day_s + 200).gaps] == [NOON_NS + 200 * SECOND]
    assert ask(store, day_s, day_s + 200).is_whole


def test_a_part_read_for_one_time_is_not_read_again(store: StoreSettings, tmp_path: Path) -> None:
    """``between`` returns the same as ``known``; a time outside is an error."""
    tell(store, tmp_path, mark(60), *(lost(str(at), at, at + 0.5) for at in range(0, 60, 3)))
    found = ask(store, 0, 90)
    for first_s, last_s in ((0, 90), (3.2, 3.4), (3.5, 6), (59, 61), (70, 80), (5, 5)):
        first_ns, last_ns = NOON_NS + int(first_s * SECOND), NOON_NS + int(last_s * SECOND)
        assert found.between(first_ns, last_ns) == ask(store, first_s, last_s)
    with pytest.raises(ValueError, match='is not within'):
        found.between(NOON_NS, NOON_NS + 91 * SECOND)


def test_the_newest_statement_of_a_gap_counts(store: StoreSettings, tmp_path: Path) -> None:
    """In any file."""
    for part in range(30):
        tell(store, tmp_path, *(lost(str(gap), gap, gap + 1, part + 1, count=part + 1) for gap in range(5)), name=f'{part:02}')
    assert gaps.newest(Bucket(store, BUCKET))['count'].to_pylist() == [30] * 5


def test_an_invalid_time_range_is_refused(store: StoreSettings) -> None:
    """The error gives the reason, and what is allowed."""
    with pytest.raises(SettingError, match='sink'):
        known('thor', '/imu', 0, 1, sink='tape', source=Bucket(store, BUCKET))
    with pytest.raises(SettingError, match='until'):
        known('thor', '/imu', 5, 1, source=Bucket(store, BUCKET))


STATEMENTS = st.builds(
    lambda name, revision, what, first: lost(str(name), first, first + 1, revision, what, count=first),
    st.integers(0, 4), st.integers(0, 4), st.sampled_from([GAP, WITHDRAWN]), st.integers(0, 90),
) | st.builds(
    lambda last, revision, session: mark(last, revision, session=session),
    st.integers(1, 5000), st.integers(0, 4), st.integers(1, 2),
)  # fmt: skip


@settings(max_examples=20, deadline=None)
@given(st.lists(STATEMENTS, max_size=14), st.randoms(use_true_random=False))
def test_the_order_of_statements_does_not_matter(rows: list[Statement], random: Any) -> None:
    """Shuffled or repeated, the same ones count."""
    at_once = counting(rows)
    shuffled = [*rows, *rows[:3]]
    random.shuffle(shuffled)
    of = 'thor', 'objects', '/imu', NOON_NS, NOON_NS + 100 * SECOND
    assert counting(shuffled) == at_once
    assert of_rows(*of, at_once) == of_rows(*of, counting(shuffled))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 9), st.sampled_from('ab')), max_size=12),
       st.lists(st.tuples(st.integers(0, 50), st.integers(1, 30)), max_size=4))  # fmt: skip
def test_stretches_partition_time_and_match_the_rows(gaps: list[tuple[int, int, str]],
                                                                     marks: list[tuple[int, int]]) -> None:  # fmt: skip
    """Compared with a query for each second."""
    rows = [lost(str(number), first, first + size, cause=cause) for number, (first, size, cause) in enumerate(gaps)]
    rows += [mark(first + size, first_s=first, session=number) for number, (first, size) in enumerate(marks)]
    found = of_rows('thor', 'objects', '/imu', NOON_NS, NOON_NS + 60 * SECOND, rows)
    for second in range(60):
        (each,) = [each for each in seconds(found) if each[0] <= second < each[1]]
        assert set(each[2]) == {cause for first, size, cause in gaps if first <= second < first + size}
        assert each[3] == ('exact' if any(first <= second < first + size for first, size in marks) else '')
    ends = [NOON_NS, *(each.end_ns for each in found.stretches)]
    assert [each.begin_ns for each in found.stretches] == ends[:-1]
    assert ends[-1] == NOON_NS + 60 * SECOND


def test_a_merged_day_gives_the_same_answers_and_keeps_withdrawals(store: StoreSettings, tmp_path: Path) -> None:
    """A row file that arrives late with an older statement changes nothing."""
    for number in range(20):
        rows = [lost('1', 5, 6, number), lost('2', 7, 8, number, GAP if number < 19 else WITHDRAWN), mark(number + 1, number)]
        tell(store, tmp_path, *rows, lost(f'x{number}', number, number + 0.5), name=f'p{number:02}')
    before = ask(store, 0, 30)
    merge(store)
    assert ask(store, 0, 30) == before
    tell(store, tmp_path, lost('2', 7, 8, 3), name='late')
    assert ask(store, 0, 30) == before


def test_sql_sees_gaps_and_watermarks(store: StoreSettings, tmp_path: Path) -> None:
    """Restricted by the flags; withdrawn gaps are not included; flags of objects are refused."""
    tell(store, tmp_path, mark(60), lost('1', 5, 6), lost('2', 7, 8, 2, WITHDRAWN), lost('3', 9, 12, cause='restart', count=None))
    tell(store, tmp_path, lost('4', 7, 8, topic='/odom'), mark(90, topic='/odom'), name='b')
    source = Bucket(store, BUCKET)
    found = lake.sql('SELECT topic, cause, count FROM gaps ORDER BY topic, from_ns', source).to_pylist()
    assert [tuple(row.values()) for row in found] == [
        ('/imu', 'transport', 5), ('/imu', 'restart', None), ('/odom', 'transport', 5),
    ]  # fmt: skip
    since = utc(NOON_NS + 10 * SECOND)
    (row,) = lake.sql('SELECT kind, t_to FROM gaps', source, topic='/imu', since=since).to_pylist()
    assert (row['kind'], row['t_to']) == ('missed', utc(NOON_NS + 12 * SECOND))
    marks = lake.sql('SELECT topic, to_ns FROM watermarks ORDER BY topic', source).to_pydict()
    assert marks == {'topic': ['/imu', '/odom'], 'to_ns': [NOON_NS + 60 * SECOND, NOON_NS + 90 * SECOND]}
    with pytest.raises(LakeError, match='where'):
        lake.sql('SELECT * FROM gaps', source, where='x > 1')


def test_the_catalog_does_not_include_the_gap_journal(store: StoreSettings, tmp_path: Path) -> None:
    """Its files are not part of the catalog, and not objects without a row."""
    tell(store, tmp_path, mark(60))
    source = Bucket(store, BUCKET)
    assert len(lake.objects(source)) == 0
    with closing(open_store(store, UploadSettings())) as target:
        from shadowhound_data_logger.lake.reindex import reindex

        assert (reindex(source, target, 'thor').listed, len(source.list('thor/'))) == (0, 1)


def test_coverage_by_the_hour(store: StoreSettings, tmp_path: Path) -> None:
    """Each second of an hour is stored, downsampled, lost by a cause, or unknown so far."""
    hour = 3600
    marks = [mark(60 * minute, minute, skipped=0 if minute <= 30 else minute) for minute in range(1, 91)]
    tell(store, tmp_path, *marks, lost('1', 600, 630), lost('2', 620, 640, cause='restart'))
    tell(store, tmp_path, mark(hour, topic='/odom', skipped=0), name='b')
    imu, odom = coverage(NOON_NS, NOON_NS + 2 * hour * SECOND, robot='thor', source=Bucket(store, BUCKET))
    assert dict(imu.hours) == {
        NOON_NS: {'restart': 20.0, 'stored': 1700.0, 'transport': 20.0, 'downsampled': 1860.0},  # a watermark in ten minutes
        NOON_NS + hour * SECOND: {'downsampled': 1800.0, 'not known yet': 1800.0},
    }  # fmt: skip
    assert dict(odom.hours) == {NOON_NS: {'stored': 3600.0}, NOON_NS + hour * SECOND: {'not known yet': 3600.0}}
    half = NOON_NS + 30 * MINUTE_NS
    (part,) = coverage(half, half + MINUTE_NS, robot='thor', topic='/imu', source=Bucket(store, BUCKET))
    assert dict(part.hours) == {NOON_NS: {'downsampled': 60.0}}


def test_many_causes_are_summarized() -> None:
    """A part may be hostile: a list of all causes at each time would take hours, and all memory."""
    rows = [lost(f'{number}', number, 5000 - number, cause=f'cause-{number}') for number in range(1000)]
    found = of_rows('thor', 'objects', '/imu', NOON_NS, NOON_NS + 5000 * SECOND, rows)
    assert max(len(each.causes) for each in found.stretches) == MAX_CAUSES + 1
    assert found.stretches[0].causes == ('cause-0',)
    assert found.stretches[-1].causes == ('cause-0',)


def test_a_stretch_has_a_state() -> None:
    """Complete, open, or neither."""
    kinds = [Stretch(0, 1, (), 'exact'), Stretch(0, 1, (), ''), Stretch(0, 1, ('restart',), ''), Stretch(0, 1, ('a',), 'exact')]
    assert [(each.is_whole, each.is_open) for each in kinds] == [(True, False), (False, True), (False, False), (False, False)]
