"""Dataclasses written as JSON and read again."""

from __future__ import annotations

import json

import pytest

from shadowhound_data_logger.core.dataclass_json import as_plain, dumps, parse
from shadowhound_data_logger.core.stamps import StampReport
from shadowhound_data_logger.core.status import (
    BagStatus,
    EventStatus,
    MiddlewareStatus,
    MissionStatus,
    NodeStatus,
    OtherType,
    StoreStatus,
    TopicStatus,
    Totals,
    Trigger,
    UndiscoveredTopic,
    WorkerStatus,
)

FULL = NodeStatus(
    robot='thor',
    mission=MissionStatus('patrol_1', None, 'patrol', '2026-11-21T06:36:05Z'),
    middleware=MiddlewareStatus(undiscovered={'/odom': UndiscoveredTopic(1, ('/go2_driver',), 40, 'text')}),
    bag=BagStatus(recording=True, topics={'/imu': Totals(received=3)}),
    events=EventStatus(enabled=True, last=Trigger('fall', 'page', '2026-11-21T06:36:05Z', 'event_fall')),
    topics={
        '/imu': TopicStatus(
            received=3,
            age_s=0.5,
            other_types={'x/msg/Y': OtherType(('/a', '/b'), None)},
            stamps=StampReport('p', 'offset', 146.0, 0.1, 7, 'late'),
        )
    },
    store=StoreStatus(state='waiting', waits_for={'upload.when': 'why'}),
    workers={'intake': WorkerStatus(patience_s=5.0)},
)


@pytest.mark.parametrize('status', [NodeStatus(), FULL])
def test_a_status_is_read_as_it_was_written(status: NodeStatus) -> None:
    """With all fields set, and with none."""
    assert parse(NodeStatus, json.loads(dumps(status))) == status
    assert json.loads(dumps(status)) == as_plain(status)


def test_a_false_dataclass_is_an_empty_object() -> None:
    """A missing mission or trigger has no fields."""
    plain = as_plain(NodeStatus())
    assert (plain['mission'], plain['events']['last']) == ({}, {})


@pytest.mark.parametrize(
    ('given', 'error'),
    [
        (3, 'NodeStatus is not an object, but 3'),
        ({'pid': '3'}, "pid is not int, but '3'"),
        ({'pid': None}, 'pid is not int, but None'),
        ({'pid': True}, 'pid is not int, but True'),
        ({'uptime_s': 'long'}, "uptime_s is not float, but 'long'"),
        ({'topics': []}, r'topics is not .*, but \[\]'),
        ({'topics': {'/imu': {'age_s': '1'}}}, "age_s is not float, but '1'"),
    ],
)
def test_a_value_of_another_type_is_an_error(given: object, error: str) -> None:
    """It names the field."""
    with pytest.raises(ValueError, match=error):
        parse(NodeStatus, given)
