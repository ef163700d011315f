"""manifest.json is read back unchanged, and invalid ones are rejected with the name of the field."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from bags.slices import closed
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.bags.manifest import (
    EventOf,
    Manifest,
    Missing,
    MissionOf,
    RecordedTopic,
    SliceEntry,
    TriggerOf,
    topics_of,
)
from shadowhound_data_logger.core.errors import BagDamaged

ENTRY = SliceEntry('bag_0.mcap', 'thor/rosbags/bag/bag_0.mcap', 1000, 'ab' * 32, 5, 10, 20, {'/imu': 5}, {'/imu': 1})
WHOLE = Manifest(
    bag='patrol_20261121_120000', robot='thor', mission=MissionOf('patrol', 'm1', None), state='recovered',
    missing=(Missing('bag_0.mcap', 'the last second', None), Missing('bag_0.mcap', 'a broken chunk', 12)),
    topics=(RecordedTopic('/imu', 'sensor_msgs/msg/Imu', 5),), slices=(ENTRY,),
)  # fmt: skip


@pytest.mark.parametrize('manifest', [WHOLE, replace(WHOLE, mission=None, state='complete', missing=(), topics=(), slices=())])
def test_a_manifest_is_read_as_it_was_written(manifest: Manifest) -> None:
    """Every field survives, null included."""
    assert Manifest.from_json(manifest.to_json()) == manifest


def test_the_fields_that_other_programs_read_are_unchanged() -> None:
    """Names and positions are a contract with every reader of the store."""
    found = json.loads(WHOLE.to_json())
    assert list(found) == ['version', 'bag', 'robot', 'mission', 'state', 'missing', 'topics', 'slices', 'event',
                           'clock']  # fmt: skip
    assert found['version'] == 1
    assert list(found['slices'][0]) == ['file', 'key', 'bytes', 'sha256', 'messages', 't_start_ns', 't_end_ns', 'counts',
                                              'repeated']  # fmt: skip
    assert found['mission'] == {'type': 'patrol', 'mission_id': 'm1', 'run_id': None}
    assert found['missing'][0] == {
        'file': 'bag_0.mcap', 'what': 'the last second', 'messages': None, 'topic': None, 'reason': None,
    }  # fmt: skip


def test_the_cause_of_an_event_round_trips() -> None:
    """Each trigger has its time; a manifest without an event has none, and damage is reported with its field."""
    event = EventOf(
        'fall', 30.0, 12.5, 10.0,
        (TriggerOf('fall', 'page', 7, None, 'operator at ::1'), TriggerOf('low', 'condition', 8, 'soc < 20: 19')),
    )  # fmt: skip
    assert Manifest.from_json(replace(WHOLE, event=event).to_json()).event == event
    found = json.loads(replace(WHOLE, event=event).to_json())
    del found['event']['triggers'][0]['who']  # as versions without a requester wrote it
    before = Manifest.from_json(json.dumps(found).encode()).event
    assert before is not None
    assert before.triggers[0] == TriggerOf('fall', 'page', 7, None)
    found = json.loads(WHOLE.to_json())
    del found['event']
    assert Manifest.from_json(json.dumps(found).encode()).event is None
    for name, value in (('held_s', True), ('held_s', None), ('triggers', {}), ('name', 3)):
        found['event'] = {**asdict(event), name: value}
        with pytest.raises(BagDamaged, match=f'event.{name}'):
            Manifest.from_json(json.dumps(found).encode())


def test_a_manifest_is_made_from_its_slices(tmp_path: Path) -> None:
    """An entry and the topics are those that the slice writer returned."""
    one, _ = closed(tmp_path / 'bag_0.mcap', 10)
    two, _ = closed(tmp_path / 'bag_1.mcap', 4)
    entry = SliceEntry.of(one, 'key')
    assert (entry.file, entry.key, entry.bytes, entry.sha256, entry.counts) == (
        'bag_0.mcap',
        'key',
        one.bytes,
        one.sha256,
        one.counts,
    )
    assert [(each.topic, each.messages) for each in topics_of([one, two])] == [('/talk', 6), ('/echo', 4), ('/blob', 4)]


@pytest.mark.parametrize(('place', 'value'), [
    ('version', 2), ('version', None), ('robot', 7), ('state', 'growing'), ('mission', 'patrol'), ('missing', None),
    ('topics', {}), ('slices', [1]), ('slices[0].bytes', -1), ('slices[0].bytes', True), ('slices[0].messages', 1.5),
    ('slices[0].sha256', 'AB' * 32), ('slices[0].counts', []), ('slices[0].counts./imu', '5'), ('mission.type', None),
    ('missing[0].messages', -3),
])  # fmt: skip
def test_an_invalid_field_is_named(place: str, value: object) -> None:
    """One invalid field rejects the complete manifest, and the error names it."""
    found = json.loads(WHOLE.to_json())
    inner: Any = found
    *way, last = place.replace('[0]', '.0').split('.')
    for step in way:
        inner = inner[int(step) if step == '0' else step]
    inner[last] = value
    with pytest.raises(BagDamaged) as refused:
        Manifest.from_json(json.dumps(found).encode(), 'thor/rosbags/bag/manifest.json')
    assert str(refused.value).startswith('thor/rosbags/bag/manifest.json')
    assert place in str(refused.value)


def test_a_newer_manifest_may_have_more_fields() -> None:
    """Unknown fields are ignored."""
    found = {**json.loads(WHOLE.to_json()), 'color': 'blue'}
    assert Manifest.from_json(json.dumps(found).encode()) == WHOLE


@given(st.binary(max_size=50) | st.recursive(
    st.none() | st.integers() | st.text(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=5,
).map(lambda value: json.dumps(value).encode()))  # fmt: skip
def test_any_other_document_is_refused(content: bytes) -> None:
    """Whatever is not a manifest is BagDamaged, never another error."""
    with pytest.raises(BagDamaged):
        Manifest.from_json(content)
