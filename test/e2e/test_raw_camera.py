"""A camera with a driver that publishes raw images only, and one that is compressed later: neither misses any.

That holds for shared memory. Raw images lost over UDP, on a robot with another RMW, are counted.
"""

from __future__ import annotations

import signal
from collections.abc import Callable

import numpy as np
import pytest
import simplejpeg
from e2e.processes import Node, Processes, until
from e2e.reading import Objects, cdr
from shadowhound_tower.embedded import Tower

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
RAW_TOPIC, JPEG_TOPIC = '/camera/image_raw', '/camera/compressed'
FRAMES = 60
"""Two seconds at 30 Hz, 55 MB."""


def switched(node: Node, topic: str, times: int) -> None:
    words = f'camera: taken from {topic} now'
    until(lambda: node.log.count(words) >= times, f'{words}, {times} times')


@pytest.mark.long('twelve seconds of raw images')
def test_raw_images_are_not_missed(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """30 raw images per second arrive, BEST_EFFORT and 921 KB each; compressed ones are used while they exist."""
    node = processes.node(seaweed.environment(), {'sensors': ['camera']})
    sim = processes.sim('compressed:=false')
    switched(node, RAW_TOPIC, 1)
    node.received(RAW_TOPIC, FRAMES)
    republisher = processes.publisher()
    republisher.create(JPEG_TOPIC, COMPRESSED, depth=10)
    switched(node, JPEG_TOPIC, 1)
    before = node.topic(RAW_TOPIC)['received']
    jpeg = simplejpeg.encode_jpeg(np.zeros((48, 64, 3), np.uint8))
    republisher.matched(JPEG_TOPIC)
    republisher.publish(JPEG_TOPIC, [cdr(COMPRESSED, format='jpeg', data=jpeg)] * 60, 1 / 30)
    node.received(JPEG_TOPIC, 60)
    assert node.topic(RAW_TOPIC)['received'] <= before + 60  # from before it left, and not durably counted yet
    republisher.destroy(JPEG_TOPIC)
    switched(node, RAW_TOPIC, 2)
    node.received(RAW_TOPIC, before + FRAMES // 2)
    sim.signal(signal.SIGINT)
    assert sim.wait() == 0
    ledger = node.stop()
    raw, compressed = ledger['topics'][RAW_TOPIC], ledger['topics'][JPEG_TOPIC]
    if node.is_beside:
        assert raw['missed'] == raw['published'] - raw['received']
    else:
        assert raw['missed'] == node.known(0)
    assert (raw['rejected'], raw['dropped']) == ({}, {})
    assert (raw['accounting'] == 'exact') is node.hears_numbers
    assert (compressed['missed'], compressed['received'], compressed['published']) == (node.known(0), 60, node.known(60))
    objects = stored(processes.robot)
    assert objects.counted() == {RAW_TOPIC: raw['stored'], JPEG_TOPIC: compressed['stored']}
    sizes = {RAW_TOPIC: (480, 640), JPEG_TOPIC: (48, 64)}
    for key, body in objects.sensor('camera').items():
        assert simplejpeg.decode_jpeg_header(body)[:2] == sizes[objects.infos[key].metadata['topic']]


@pytest.mark.slow
@pytest.mark.long('a minute of raw images')
def test_a_minute_of_raw_images_is_accounted_for(processes: Processes, seaweed: Tower) -> None:
    """Of 1,800 raw images the node receives all except what a busy machine loses, and counts the loss."""
    node = processes.node(seaweed.environment(), {'sensors': ['camera']})
    sim = processes.sim('compressed:=false', 'duration_s:=60.0')
    assert sim.wait(90) == 0
    row = node.stop()['topics'][RAW_TOPIC]
    assert row['missed'] <= 90
    # In the first second the sensor waits for a compressed topic.
    assert row['published'] == row['received'] + row['missed'] >= 1700
