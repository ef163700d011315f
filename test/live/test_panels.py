"""What the page draws in addition to images, clouds and plots: bounded, whatever a message contains."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from live.test_kinds import cdr, header, new

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.live.kinds import LiveItem
from shadowhound_data_logger.live.panels import MAX_CELLS, MAX_FRAMES, MAX_LINES, MAX_MODEL, MAX_RAYS, MAX_STATUSES, panel_of

SCAN, MAP, TF = 'sensor_msgs/msg/LaserScan', 'nav_msgs/msg/OccupancyGrid', 'tf2_msgs/msg/TFMessage'
STATUSES, LOG, STRING = 'diagnostic_msgs/msg/DiagnosticArray', 'rcl_interfaces/msg/Log', 'std_msgs/msg/String'
TYPES = MessageTypes()


def made(topic: str, type_name: str, *messages: Any) -> LiveItem:
    """The item made from messages that arrive together."""
    panel = panel_of(topic, type_name)
    assert panel is not None
    return panel.maker()(topic, TYPES, type_name, [(float(at), cdr(each, type_name)) for at, each in enumerate(messages)])


def head(item: LiveItem) -> dict[str, Any]:
    assert item.head is not None
    return dict(item.head)


def scan(ranges: Any) -> Any:
    return new(
        SCAN, header=header(), angle_min=-1.0, angle_max=1.0, angle_increment=0.01, time_increment=0.0, scan_time=0.1,
        range_min=0.1, range_max=12.0, ranges=np.array(ranges, np.float32), intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def test_a_scan_has_its_ranges() -> None:
    """Within 1/65,535 of the maximum; 0 for unmeasured ones."""
    item = made('/scan', SCAN, scan([1.0, 0.05, math.nan, math.inf, 12.0, 13.0, -1.0, 0.1]))
    values = np.frombuffer(item.body, '<u2') * head(item)['step']
    assert np.allclose(values, [1, 0, 0, 0, 12, 0, 0, 0.1], atol=1e-3)
    assert head(item)['first'] == -1.0


def test_a_large_scan_is_thinned() -> None:
    """Its rays keep their angles."""
    item = made('/scan', SCAN, scan(np.full(3 * MAX_RAYS, 2.0)))
    assert len(item.body) // 2 == MAX_RAYS
    assert head(item)['turn'] == pytest.approx(0.03)


def grid(width: int, height: int, cells: Any) -> Any:
    info = new(
        'nav_msgs/msg/MapMetaData', map_load_time=header().stamp, resolution=0.05, width=width, height=height,
        origin=new('geometry_msgs/msg/Pose', position=new('geometry_msgs/msg/Point', x=-1.0, y=2.0, z=0.0),
                   orientation=new('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=math.sin(0.1), w=math.cos(0.1))),
    )  # fmt: skip
    return new(MAP, header=header(), info=info, data=np.asarray(cells, np.int8).ravel())


def test_a_map_has_its_cells() -> None:
    """Unchanged, unknown ones as 255; a large one keeps its occupied cells."""
    item = made('/map', MAP, grid(3, 2, [0, 100, -1, 50, 0, 0]))
    assert list(zlib.decompress(item.body)) == [0, 100, 255, 50, 0, 0]
    assert (head(item)['x'], head(item)['y'], round(head(item)['yaw'], 6)) == (-1.0, 2.0, 0.2)
    cells = np.zeros((10, 3 * MAX_CELLS), np.int8)
    cells[4, 700] = 100
    item = made('/map', MAP, grid(3 * MAX_CELLS, 10, cells))
    reduced = np.frombuffer(zlib.decompress(item.body), np.uint8).reshape(head(item)['height'], head(item)['width'])
    assert reduced.shape == (4, MAX_CELLS)
    assert reduced[1, 233] == 100
    assert head(item)['resolution'] == pytest.approx(0.15)


@pytest.mark.parametrize('message', [grid(3, 3, [0, 0]), grid(0, 0, []), grid(4_000_000_000, 1, [0])])
def test_a_map_that_contradicts_itself_is_rejected(message: Any) -> None:
    """Nothing is allocated for the announced size."""
    with pytest.raises(Rejected):
        made('/map', MAP, message)


def transforms(*names: tuple[str, str], x: float = 1.0) -> Any:
    def one(parent: str, child: str) -> Any:
        place = new('geometry_msgs/msg/Vector3', x=x, y=2.0, z=3.0)
        turn = new('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)
        transform = new('geometry_msgs/msg/Transform', translation=place, rotation=turn)
        of_parent = new('std_msgs/msg/Header', stamp=header().stamp, frame_id=parent)
        return new('geometry_msgs/msg/TransformStamped', header=of_parent, child_frame_id=child, transform=transform)

    return new(TF, transforms=[one(*each) for each in names])


def test_transforms_are_collected() -> None:
    """The newest of each child, from all messages; read at CDR offsets as well as field by field."""
    item = made('/tf', TF, transforms(('map', 'odom'), ('odom', 'base')), transforms(('/base', 'lidar_of_odd_length')),
                transforms(('odom', 'base'), x=7.0))  # fmt: skip
    assert head(item)['frames'] == [['map', 'odom'], ['odom', 'base'], ['base', 'lidar_of_odd_length']]
    assert np.frombuffer(item.body, '<f4').reshape(3, 7)[:, 0].tolist() == [1.0, 7.0, 1.0]
    assert np.frombuffer(item.body, '<f4').reshape(3, 7)[2].tolist() == [1, 2, 3, 0, 0, 0, 1]


def test_transforms_are_bounded() -> None:
    """Frames with ever new names, and invalid numbers; a frame that is no longer published is dropped."""
    panel = panel_of('/tf', TF)
    assert panel is not None
    maker = panel.maker()
    for round_ in range(3):
        names = [('map', f'{round_}_{place}') for place in range(150)]
        item = maker('/tf', TYPES, TF, [(float(round_), cdr(transforms(*names), TF))])
    assert len(head(item)['frames']) == MAX_FRAMES
    item = maker('/tf', TYPES, TF, [(60_000.0, cdr(transforms(('map', 'odom'), x=math.nan), TF))])
    assert head(item)['frames'] == []


@pytest.mark.parametrize('size', [4, 8, 12, 20, 60])
def test_transforms_that_are_cut_off_are_rejected(size: int) -> None:
    """Whatever their lengths are."""
    whole = cdr(transforms(('map', 'odom')), TF)
    panel = panel_of('/tf', TF)
    assert panel is not None
    with pytest.raises(Rejected):
        panel.maker()('/tf', TYPES, TF, [(0.0, whole[:size])])
    with pytest.raises(Rejected):
        panel.maker()('/tf', TYPES, TF, [(0.0, whole[:4] + struct.pack('<I', 4_000_000_000) + whole[8:])])


def test_diagnostics_are_the_newest_of_each_name() -> None:
    """Limited in number and text."""

    def status(name: str, level: int, text: str) -> Any:
        values = [new('diagnostic_msgs/msg/KeyValue', key='load', value='7')]
        return new('diagnostic_msgs/msg/DiagnosticStatus', level=level, name=name, message=text, hardware_id='', values=values)

    first, second = (new(STATUSES, header=header(), status=each) for each in (
        [status('motor', 0, 'fine'), status('arm', 1, 'x' * 999)], [status('motor', 2, 'hot')]))  # fmt: skip
    rows = head(made('/diagnostics', STATUSES, first, second))['rows']
    assert [row[:3] for row in rows] == [['motor', 2, 'hot'], ['arm', 1, 'x' * 300]]
    assert rows[0][4] == [['load', '7']]
    many = new(STATUSES, header=header(), status=[status(str(number), 0, '') for number in range(500)])
    assert len(head(made('/diagnostics', STATUSES, many))['rows']) == MAX_STATUSES


def test_a_log_has_its_last_lines() -> None:
    """With level and node."""
    lines = [new(LOG, stamp=header().stamp, level=40, name='nav', msg=f'line {number}', file='', function='', line=1)
             for number in range(150)]  # fmt: skip
    rows = head(made('/rosout', LOG, *lines))['rows']
    assert len(rows) == MAX_LINES
    assert rows[-1][1:] == [40, 'nav', 'line 149']


def test_a_robot_description_is_sent_unchanged() -> None:
    """Only for a topic with that name, and up to a maximum size."""
    assert made('/robot_description', STRING, new(STRING, data='<robot/>')).body == b'<robot/>'
    assert panel_of('/chatter', STRING) is None
    with pytest.raises(Rejected, match='not drawn'):
        made('/robot_description', STRING, new(STRING, data=' ' * (MAX_MODEL + 1)))
