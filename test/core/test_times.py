"""Times as users write them become nanoseconds, by one grammar everywhere."""

from __future__ import annotations

import subprocess
from datetime import datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lake.making import DAY_NS, NOON_NS

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.times import moment, moment_in_bag

MIDNIGHT_NS = NOON_NS - DAY_NS // 2
T0 = 1_760_788_800 * SECOND


@pytest.mark.parametrize(
    ('text', 'ns'),
    [
        ('now', NOON_NS), ('today', MIDNIGHT_NS), ('Yesterday', MIDNIGHT_NS - DAY_NS), ('2h', NOON_NS - 7200 * SECOND),
        ('30min', NOON_NS - 1800 * SECOND), ('1.5 d', NOON_NS - DAY_NS * 3 // 2), ('2W', NOON_NS - 14 * DAY_NS),
        ('90s', NOON_NS - 90 * SECOND), ('2026-10-28', MIDNIGHT_NS), ('20261028', MIDNIGHT_NS), ('2026-10-28T12', NOON_NS),
        ('2026-10-28T12:00', NOON_NS), (' 2026-10-28 12:00:00.000001 ', NOON_NS + 1000), ('2026-10-28T12:00:00Z', NOON_NS),
        ('2026-10-28t12:00:00z', NOON_NS), ('20261028T120000', NOON_NS), ('2026-10-28T12:00:00.000000001', NOON_NS + 1),
        ('2026-10-28T14:00:00+02:00', NOON_NS), ('2026-10-28T14:00+02', NOON_NS),
        (datetime(2026, 10, 28, 12, tzinfo=timezone.utc), NOON_NS), (datetime(2026, 10, 28, 12), NOON_NS),  # noqa: DTZ001
        (datetime(2026, 10, 28, 14, tzinfo=timezone(timedelta(hours=2))), NOON_NS),
    ],
)  # fmt: skip
def test_times_are_read_in_words(text: str | datetime, ns: int) -> None:
    """UTC unless a zone is given; a date is its start."""
    assert moment('since', text, NOON_NS) == ns


@pytest.mark.parametrize(
    'text', ['', 'tomorrow', '2 fortnights', '2026-13-01', '2026-10-28T25:00', '2026-1028', '-2h', '9e999d', 'h', '900000d',
             '999999999999w'],
)  # fmt: skip
def test_an_invalid_time_is_refused_by_name(text: str) -> None:
    """The error names the flag, the value and what is allowed."""
    with pytest.raises(SettingError, match='until') as caught:
        moment('until', text, NOON_NS)
    assert caught.value.data['value'] == text
    assert 'yesterday' in str(caught.value)


@pytest.mark.parametrize(('text', 'wanted'), [
    ('0', T0), ('1.5', T0 + 1_500_000_000), ('-2', T0 + 8 * SECOND), ('+3', T0 + 3 * SECOND),
    ('-0.000000001', T0 + 10 * SECOND - 1), ('2025-10-18T12:00:01.25Z', T0 + 1_250_000_000), ('2025-10-18 12:00', T0),
    ('2025-10-18T14:00:00.123456789+02:00', T0 + 123_456_789), ('2025-10-18T07:00:00-0500', T0),
    ('1760788801', T0 + SECOND), ('1760788801.5', T0 + 1_500_000_000), (str(T0 + 7), T0 + 7),
])  # fmt: skip
def test_a_time_in_a_bag_is_read_in_any_form(text: str, wanted: int) -> None:
    """In any of the forms, to the nanosecond."""
    assert moment_in_bag('--start', text, T0, T0 + 10 * SECOND) == wanted


@pytest.mark.parametrize(
    'text', ['', 'x', '12:00', '2025-13-01', '2025-10-18T25:00', '1e3', 'nan', '--1', '2025-10-18T12:00:00 ', 'yesterday']
)
def test_an_invalid_time_in_a_bag_is_refused(text: str) -> None:
    """With the option's name."""
    with pytest.raises(SettingError, match='--start'):
        moment_in_bag('--start', text, T0, T0)


@given(st.datetimes(min_value=datetime(1, 1, 2), max_value=datetime(9999, 12, 30)), st.integers(-14 * 60, 14 * 60))  # noqa: DTZ001
def test_times_that_python_writes_are_read(time: datetime, minutes: int) -> None:
    """``isoformat`` of any time in any zone, and the same time as an object."""
    zoned = time.replace(tzinfo=timezone(timedelta(minutes=minutes)))
    assert moment('since', zoned.isoformat(), NOON_NS) == moment('since', zoned, NOON_NS)


@pytest.mark.long('a process for each')
def test_times_agree_with_gnu_date() -> None:
    """For times that both can read."""
    for text in ('2026-10-28T14:00:00+02:00', '2025-02-28 23:59:59', '20240229', '1969-12-31T23:59:59Z'):
        done = subprocess.run(['date', '-u', '-d', text, '+%s'], capture_output=True, text=True, check=True)
        assert moment('since', text, NOON_NS) == int(done.stdout) * SECOND
