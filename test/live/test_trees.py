"""A message of any type as a tree, and individual numbers of it."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from live.test_kinds import cdr, header, new

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.live.trees import MAX_CHARACTERS, MAX_NODES, MAX_SHOWN, MAX_TEXT, number, tree

SCAN, STRING, STATUSES = 'sensor_msgs/msg/LaserScan', 'std_msgs/msg/String', 'diagnostic_msgs/msg/DiagnosticArray'
TYPES = MessageTypes()


def scan(count: int) -> Any:
    figures = dict.fromkeys(('angle_min', 'angle_max', 'angle_increment', 'time_increment', 'scan_time', 'range_min'), 0.5)
    ranges = np.arange(count, dtype=np.float32)
    message = new(SCAN, header=header(), range_max=math.inf, ranges=ranges, intensities=ranges[:0], **figures)
    return TYPES.deserialize(SCAN, cdr(message, SCAN))


def test_a_tree_has_names_types_and_values() -> None:
    """Arrays with their lengths and first elements, numbers without a JSON representation as text."""
    found = tree(TYPES, SCAN, scan(500))
    assert found['t'] == SCAN
    assert found['f']['angle_min'] == 0.5
    assert found['f']['range_max'] == 'inf'
    assert found['f']['header']['f']['stamp']['t'] == 'builtin_interfaces/msg/Time'
    assert found['f']['ranges'] == {'t': 'float32', 'n': 500, 'a': [float(each) for each in range(MAX_SHOWN)]}
    json.dumps(found, allow_nan=False)


def test_a_tree_is_small() -> None:
    """For a text of a megabyte, and for a thousand statuses with a thousand values each."""
    text = TYPES.deserialize(STRING, cdr(new(STRING, data='x' * 1_000_000), STRING))
    assert len(tree(TYPES, STRING, text)['f']['data']) == MAX_TEXT + 1
    values = [new('diagnostic_msgs/msg/KeyValue', key='k' * 400, value='v' * 400) for _ in range(100)]
    status = new('diagnostic_msgs/msg/DiagnosticStatus', level=0, name='n', message='m', hardware_id='h', values=values)
    message = TYPES.deserialize(STATUSES, cdr(new(STATUSES, header=header(), status=[status] * 100), STATUSES))
    assert len(json.dumps(tree(TYPES, STATUSES, message))) < MAX_CHARACTERS + 100 * MAX_NODES


def test_a_number_is_found_by_its_path() -> None:
    """In messages and arrays; NaN beyond the end of an array."""
    message = scan(10)
    assert number(message, 'ranges[7]') == 7.0
    assert number(message, 'angle_min') == 0.5
    assert number(message, 'header.stamp.sec') == message.header.stamp.sec
    assert math.isnan(number(message, 'ranges[10]'))


@pytest.mark.parametrize('path', [
    '', 'header', 'ranges', 'header.frame_id', 'nothing', 'angle_min.real', '__class__', 'header.__class__', 'ranges.dtype',
    '[0]', '.angle_min', 'ranges[-1]', 'ranges[0', 'ranges[99999999]', 'angle_min ', 'a.' * 200 + 'b', 'header[0]',
])  # fmt: skip
def test_a_path_to_no_number_is_rejected(path: str) -> None:
    """Attributes that are not message fields do not count."""
    with pytest.raises(Rejected):
        number(scan(10), path)
