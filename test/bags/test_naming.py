"""Names of bags."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.bags.naming import bag_name, key_of, slice_file, slice_number, unsynced_name
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, check_key, check_name

NOON_NS = 1_760_788_800 * 10**9
BOOT = '3e2c1f6a-8a4e-4d0e-9d0a-0f6a5b7c9d11'


def test_names_are_sorted_by_their_numbers() -> None:
    """With the content and the time in UTC, and unique; the number of a slice can be parsed."""
    assert bag_name('', NOON_NS, lambda _: False) == 'recording_20251018_120000'
    assert bag_name('../../etc', NOON_NS, lambda _: False) == 'etc_20251018_120000'
    taken = {'patrol_20251018_120000', 'patrol_20251018_120000_1'}
    assert bag_name('patrol', NOON_NS, taken.__contains__) == 'patrol_20251018_120000_2'
    assert key_of('thor', 'b', slice_file('b', 12)) == 'thor/rosbags/b/b_12.mcap'
    files = ('b_1_0.mcap', 'b_1_10.mcap.open', 'b_0.mcap', 'manifest.json', 'b_1_x.mcap')
    assert [slice_number('b_1', file) for file in files] == [0, 10, None, None, None]


@pytest.mark.parametrize('what', ['a/b', '..', 'a..b', 'über den Berg', '\u202e\ud800', 'x' * 300, 'x.' * 40, '-', '\0\n', ' '])
def test_every_mission_gives_a_valid_bag_name(what: str) -> None:
    """For any mission name: one part of a key, a file name with its slices', and a valid argument of the commands."""
    for name in (bag_name(what, NOON_NS, lambda _: False), unsynced_name(f'event_{what}', BOOT, 12 * 10**9, lambda _: False)):
        assert check_name(name, 'the bag', MAX_BAG_BYTES) == name
        assert check_key(key_of('thor', name, slice_file(name, 100_000))).count('/') == 3
        assert not name.startswith('recording')
