"""A node that uploads only while a rule holds: waiting objects are reported, and are sent once the rule holds."""

from __future__ import annotations

import json
from typing import Any

import pytest
from e2e.processes import Node, Processes, until
from e2e.reading import STRING, Objects, texts
from e2e.station import Station
from rclpy.serialization import serialize_message
from shadowhound_tower.embedded import Tower
from std_msgs.msg import Bool

from shadowhound_data_logger.spool.status import file
from shadowhound_data_logger.stores.base import ObjectStore

TALK, DOCK = '/w_talk', '/w_dock'
PARAMETERS = {
    'sensors': ['talk'], 'talk.topics': [TALK], 'talk.rate_hz': 0.0, 'upload.when': f'{DOCK}:data == true',
    'events.topics': [TALK], 'events.pre_s': 5.0, 'events.post_s': 0.5,
}  # fmt: skip


def delivery(node: Node) -> dict[str, Any]:
    path = file(node.home / 'spool', node.robot)
    until(path.exists, 'the node has written its status')
    found: dict[str, Any] = json.loads(path.read_text())['store']
    return found


@pytest.mark.long('ten seconds of waiting for a dock')
def test_uploads_wait_for_the_dock(processes: Processes, seaweed: Tower, store: ObjectStore, station: Station) -> None:
    """A latched message counts however old it is, until its publisher is gone; an event is sent immediately."""
    node = processes.node(seaweed.environment(), PARAMETERS)
    unknown = f'{DOCK}:data == true is unknown: no message of {DOCK} was received yet'
    until(lambda: delivery(node)['waits_for'] == {'upload.when': unknown}, 'the status has what uploads wait for')
    publisher, dock = processes.publisher(), processes.publisher()
    dock.create(DOCK, 'std_msgs/msg/Bool', latched=True, depth=1)
    dock.publish(DOCK, [serialize_message(Bool(data=False))])
    publisher.create(TALK, STRING)
    publisher.matched(TALK)
    publisher.publish(TALK, texts(range(20)))
    until(lambda: delivery(node)['waits_for'].get('upload.when') == f'{DOCK}:data == true: it is 0', 'it is received')
    until(lambda: node.ledger()['objects']['pending'] == 20, 'all is spooled and none of it is sent')
    done, text = station.event()
    assert done, text
    until(
        lambda: any(info.key.endswith('manifest.json') for info in store.list('sensor-data', f'{processes.robot}/rosbags/')),
        'the event is sent',
    )
    assert not Objects.of(store, 'sensor-data', processes.robot).sensor('talk')
    until(lambda: delivery(node)['state'] == 'waiting', 'nothing else is sent')
    dock.publish(DOCK, [serialize_message(Bool(data=True))])
    node.delivered(20)
    assert len(Objects.of(store, 'sensor-data', processes.robot).sensor('talk')) == 20
    dock.end()
    until(lambda: f'{DOCK} is no longer published' in delivery(node)['waits_for'].get('upload.when', ''), 'the dock is gone')
    publisher.publish(TALK, texts(range(20, 25)))
    until(lambda: node.ledger()['objects']['pending'] >= 5, 'uploads wait again')
    ledger = node.stop()
    assert ledger['topics'][TALK]['received'] == 25
