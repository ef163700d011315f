"""Samples come in order, none left out."""

from __future__ import annotations

from itertools import islice, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shadowhound_sim.sim_go2_node import count, schedule


@pytest.mark.parametrize(
    ('rate', 'duration', 'expected'),
    [(100.0, 60.0, 6000), (30.0, 0.1, 3), (0.1, 30.0, 3), (3.0, 1 / 3, 1), (30.0, 0.11, 4), (10.0, 0.05, 1)],
)
def test_the_number_of_samples_is_rate_times_duration(rate: float, duration: float, expected: int) -> None:
    """A whole product is exactly that many, whatever floating point makes of it; the rest of a period counts as one."""
    assert count(rate, duration) == expected


@given(
    st.dictionaries(st.sampled_from('abcdef'), st.floats(0.2, 200), min_size=1),
    st.floats(0.01, 5),
)
def test_every_sample_comes_once_and_in_order(rates: dict[str, float], duration: float) -> None:
    """Times never go back, stay below the duration, and are the multiples of each period."""
    due = list(schedule(rates, duration))
    assert all(a[0] <= b[0] for a, b in pairwise(due))
    for name, rate in rates.items():
        times = [t for t, of in due if of == name]
        assert times == [k / rate for k in range(count(rate, duration))]


def test_without_a_duration_it_never_ends_and_never_drifts() -> None:
    """The millionth sample is due exactly where it belongs."""
    last = list(islice(schedule({'a': 30.0}, 0.0), 300_001))[-1]
    assert last == (10_000.0, 'a')
