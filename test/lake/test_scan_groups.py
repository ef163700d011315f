"""Small parts are read in groups of limited number and size."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.lake import scan


@pytest.mark.parametrize(('sizes', 'groups'), [
    ([], []), ([1] * 7, [3, 3, 1]), ([6, 5, 5, 1], [1, 2, 1]), ([20, 1, 20], [1, 1, 1]), ([4, 4, 2], [3]),
])  # fmt: skip
def test_groups_are_limited_and_in_order(sizes: list[int], groups: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """At most three entries and ten bytes each here; one that is larger by itself is a group of its own."""
    monkeypatch.setattr(scan, 'PARTS_AT_A_TIME', 3)
    monkeypatch.setattr(scan, 'GROUP_BYTES', 10)
    entries = [ObjectInfo('sensor-data', f'{number}', size, None) for number, size in enumerate(sizes)]
    found = list(scan._grouped(entries))
    assert [len(group) for group in found] == groups
    assert [entry for group in found for entry in group] == entries
