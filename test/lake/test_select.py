"""A query's arguments become times, a circle, and the dates of the parts to read."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lake.making import DAY_NS, NOON_NS

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.formats.rows.catalog import UNDATED
from shadowhound_data_logger.lake.select import Wanted, wanted

MIDNIGHT_NS = NOON_NS - DAY_NS // 2


@pytest.mark.parametrize('near', ['1,2', '1,2,0', '1,2,-3', 'a,b,c', '1,2,nan', '1,2,3,4'])
def test_an_invalid_circle_is_refused(near: str) -> None:
    """A radius must be positive and all three must be numbers."""
    with pytest.raises(SettingError, match='near'):
        wanted(NOON_NS, near=near)


@given(st.integers(0, 40 * DAY_NS), st.integers(1, 40 * DAY_NS), st.integers(0, 80 * DAY_NS))
def test_dates_cover_the_range_exactly(since: int, span: int, at: int) -> None:
    """A time is selected only if its date is included; the first and the last date contain a selected time."""
    asked = Wanted(since_ns=MIDNIGHT_NS + since, until_ns=MIDNIGHT_NS + since + span)
    dates = asked.dates(NOON_NS)
    assert dates is not None
    moment_ns = MIDNIGHT_NS + at
    date = f'{utc(moment_ns):%Y-%m-%d}'
    if since <= at < since + span:
        assert date in dates
        assert asked.has_date(date)
    assert asked.has_date(date) == (date in dates)
    assert dates[0] == f'{utc(MIDNIGHT_NS + since):%Y-%m-%d}'
    assert dates[-1] == f'{utc(MIDNIGHT_NS + since + span - 1):%Y-%m-%d}'


def test_without_an_end_the_range_extends_to_tomorrow() -> None:
    """A robot's clock may be a day ahead (clock.FUTURE_SLACK_NS)."""
    assert Wanted(since_ns=NOON_NS).dates(NOON_NS) == ['2026-10-28', '2026-10-29']


def test_nothing_is_between_an_end_and_a_later_beginning() -> None:
    """No folder is listed."""
    assert Wanted(since_ns=NOON_NS, until_ns=NOON_NS).dates(NOON_NS) == []


def test_a_long_time_is_looked_up_instead() -> None:
    """Years of folders are not requested one by one; nor is everything before an end."""
    assert Wanted(since_ns=0, until_ns=NOON_NS).dates(NOON_NS) is None
    assert Wanted(until_ns=NOON_NS).dates(NOON_NS) is None
    assert not Wanted(until_ns=MIDNIGHT_NS).has_date('2026-10-28')
    assert Wanted(until_ns=MIDNIGHT_NS).has_date('2026-10-27')


def test_rows_without_a_date_are_selected_only_without_times() -> None:
    """Objects of a boot with a clock that was never set belong to no day."""
    assert Wanted().has_date(UNDATED)
    assert not Wanted(until_ns=NOON_NS).has_date(UNDATED)
