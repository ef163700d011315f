"""The state of a bag until it is complete is read back from the index and from a slice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from bags.slices import fill, messages

from shadowhound_data_logger.bags.manifest import ClockOf, EventOf, Missing, MissionOf, TriggerOf
from shadowhound_data_logger.bags.naming import slice_file
from shadowhound_data_logger.bags.state import MIN_ROWS_BYTES, RECORD, BagState
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.index import read_metadata
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import SliceWriter

IMU = Channel('/imu', 'x/msg/Y', 'ros2msg', 'float32 x', 'RIHS01_0', '- history: 1')
POSE = Channel('/pose', 'x/msg/Z', 'ros2msg', 'float32 z', 'RIHS01_1', '')
EVENT = EventOf(
    'fall', 5.0, 4.5, 2.0,
    (TriggerOf('fall', 'page', 7, None, 'operator at ::1'), TriggerOf('again', 'condition', 9, 'x > 1')),
)  # fmt: skip
CLOCK = ClockOf('unset', 'boot', 60, 70, None)


def info(folder: Path, number: int, size: int = 10, channels: tuple[Channel, ...] = (IMU,)) -> SliceInfo:
    counts = {channel: 3 * place for place, channel in enumerate(channels)}
    return SliceInfo(folder / slice_file(folder.name, number), size, 'ab' * 32, 1, 2, sum(counts.values()), counts)


@pytest.fixture
def state(tmp_path: Path) -> BagState:
    """A state with all fields."""
    made = BagState.begin(tmp_path / 'thor' / 'b', 'thor', MissionOf('patrol', 'patrol_1', None), EVENT, CLOCK)
    made.add_slice(info(made.folder, 0))
    made.add_slice(info(made.folder, 1, channels=(POSE, IMU)))
    made.add_missing(Missing('b_0.mcap', 'why', None), Missing('b_1.mcap', 'dropped: no_room', 7, '/imu', 'no_room'))
    made.mission, made.ended = MissionOf('patrol', 'patrol_1', 'r'), True
    return made


def test_state_round_trips(state: BagState) -> None:
    """From the index and from the next slice; the slices have the definitions, which are not repeated."""
    (_, rows) = state.all_rows()
    assert BagState.of_rows(state.folder, 'thor', rows) == state
    assert BagState.of_record(state.folder, 'thor', state.record('thor', 2)) == state
    assert state.slices['b_1.mcap'].channels == {replace(IMU, definition=''): 3, replace(POSE, definition=''): 0}
    assert state.slices['b_1.mcap'].counts == {'/pose': 0, '/imu': 3}


def test_each_record_has_only_changes(state: BagState) -> None:
    """Each loss has a number, so a loss that is stored twice counts once."""
    rows = state.add_missing(Missing('b_1.mcap', 'more', 1))
    assert ([one.place for one in rows.missing], rows.slices) == ([2], ())
    rows = state.add_slice(info(state.folder, 2))
    assert ([one.number for one in rows.slices], rows.missing) == ([2], ())


@pytest.mark.parametrize('size', [1 << 20, pytest.param(64 << 20, marks=pytest.mark.long('64 MB'))])
def test_a_record_takes_a_hundredth_of_a_slice(tmp_path: Path, size: int) -> None:
    """For any number of slices: the record has the newest ones, and the latest losses."""
    topics = tuple(replace(IMU, topic=f'/robot/topic_{number}', qos='q' * 400) for number in range(20))
    state = BagState(tmp_path / 'patrol_20251018_120000', 'patrol_20251018_120000', 'thor')
    for number in range(2000):
        state.add_slice(info(state.folder, number, size, topics))
        state.add_missing(Missing(slice_file(state.folder.name, number), 'dropped: queue_full', 7, '/imu', 'queue_full'))
    report = state.record('thor', 2000)
    assert sum(map(len, report.values())) < size // 100 + MIN_ROWS_BYTES
    found = BagState.of_record(state.folder, 'thor', report)
    assert list(found.slices) == list(state.slices)[-len(found.slices) :]
    assert len(found.slices) >= (1500 if size > 1 << 20 else 10)
    assert found.missing[1:] == state.missing[1 - len(found.missing) :]
    left_out = 4000 - len(found.slices) - len(found.missing[1:])
    assert found.missing[0].what == f'the index was lost: {left_out} earlier slices or losses are not listed here'


def test_the_last_record_of_a_slice_counts(tmp_path: Path) -> None:
    """For a trigger or a run id that became known while it was written."""
    state = BagState.begin(tmp_path / 'b', 'thor', MissionOf('patrol', 'patrol_1', None))
    writer = SliceWriter(tmp_path / 'b' / 'b_0.mcap')
    writer.add_metadata(RECORD, state.record('thor', 0))
    fill(writer, messages(10))
    state.mission = MissionOf('patrol', 'patrol_1', 'r')
    writer.add_metadata(RECORD, state.news())
    path = writer.close().path
    first, second = read_metadata(path, RECORD)
    assert BagState.of_record(state.folder, 'thor', {**first, **second}) == state


@pytest.mark.parametrize('change', [
    {'facts': ''}, {'facts': '[]'}, {'facts': '{"bag": "../x"}'}, {'channels': '{}'}, {'channels': '[[1, 2, 3, 4, 5]]'},
    {'channels': '[["a"]]'}, {'slices': '[[1]]'}, {'slices': '[["0", 1, "", 1, 2, 3, "[]"]]'},
    {'slices': '[[0, 1, "", 1, 2, 3, "[-1]"]]'}, {'slices': '[[0, 1, 7, 1, 2, 3, "[]"]]'}, {'slices': '[[0, 1, "", 1, 2, 3, 7]]'},
    {'missing': '[[0, 7, "what", null, null, null]]'}, {'missing': '[' * 100_000}, {'slices': 'x'},
])  # fmt: skip
def test_an_implausible_state_is_refused(state: BagState, change: dict[str, str]) -> None:
    """From a flipped bit or another program."""
    with pytest.raises(BagDamaged):
        BagState.of_record(state.folder, 'thor', {**state.record('thor', 2), **change})
