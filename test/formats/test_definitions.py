"""Message definitions and type hashes: as rosbag2 writes them, and readable by other parsers as the same type."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.types import MessageTypes

LINE = '=' * 80
HAS_ROS = any(Path(one, 'share/sensor_msgs/msg/Imu.msg').is_file() for one in os.environ.get('AMENT_PREFIX_PATH', '').split(':'))


def workspace(folder: Path, files: dict[str, str]) -> str:
    """Installed packages: ``package/Type.msg`` -> text."""
    for name, content in files.items():
        package, _, file = name.partition('/')
        path = folder / 'share' / package / 'msg' / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return str(folder)


def parsed(idl: str) -> Any:
    """As `rosbags` parses the definitions of a bag (rosbags/highlevel/anyreader.py)."""
    found: dict[str, Any] = {}
    for section in idl.split(f'{LINE}\n')[1:]:
        found.update(get_types_from_idl(section.partition('\n')[2]))
    return found


def test_a_definition_includes_every_nested_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """rosbag2's order: each type before those it uses, these by name, none twice, a line and `MSG:` above each but the first."""
    files = {
        'zoo/Cage.msg': '# a cage\nAnimal[] animals\nstring<=10 label\nfood/Meal meal 1\nuint8 BIG=1\n',
        'zoo/Animal.msg': 'Name name\nfood/Meal[2] meals\n',
        'zoo/Name.msg': 'wstring text\n',
        'food/Meal.msg': 'float64 calories\n',
    }
    monkeypatch.setenv('AMENT_PREFIX_PATH', workspace(tmp_path, files))
    assert describe('zoo/msg/Cage') == ('ros2msg', '\n'.join([
        files['zoo/Cage.msg'],
        f'{LINE}\nMSG: food/Meal\n{files["food/Meal.msg"]}',
        f'{LINE}\nMSG: zoo/Animal\n{files["zoo/Animal.msg"]}',
        f'{LINE}\nMSG: zoo/Name\n{files["zoo/Name.msg"]}',
    ]), '')  # fmt: skip


def test_idl_is_used_where_there_is_no_msg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package with .idl alone is described by that, with a title above it as well, in a form that `rosbags` parses."""
    include = '#include "zoo/msg/Animal.idl"\n'
    cage = 'module zoo { module msg { struct Cage { zoo::msg::Animal animal; }; }; };\n'
    animal = 'module zoo { module msg { struct Animal { long legs; }; }; };\n'
    files = {'zoo/Cage.idl': include + cage, 'zoo/Animal.idl': animal, 'zoo/Cage.msg': 'Animal animal\n'}
    monkeypatch.setenv('AMENT_PREFIX_PATH', workspace(tmp_path, files))
    encoding, definition, _ = describe('zoo/msg/Cage')
    assert (encoding, definition) == (
        'ros2idl', f'{LINE}\nIDL: zoo/msg/Cage\n{cage}\n{LINE}\nIDL: zoo/msg/Animal\n{animal}',
    )  # fmt: skip
    assert parsed(definition).keys() == {'zoo/msg/Cage', 'zoo/msg/Animal'}
    assert MessageTypes([tmp_path]).deserialize('zoo/msg/Cage', b'\0\1\0\0\4\0\0\0').animal.legs == 4


def test_the_type_hash_is_that_of_the_installed_definition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hash is that of the type itself, from its .json; a broken or missing one is not a hash."""
    fields = {
        'type_hashes': [
            {'type_name': 'zoo/msg/Other', 'hash_string': 'no'},
            {'type_name': 'zoo/msg/A', 'hash_string': 'RIHS01_1'},
        ]
    }
    files = {
        'zoo/A.msg': '',
        'zoo/A.json': json.dumps(fields),
        'zoo/B.msg': '',
        'zoo/B.json': '{',
        'zoo/C.msg': '',
        'zoo/C.json': '[]',
    }
    monkeypatch.setenv('AMENT_PREFIX_PATH', workspace(tmp_path, files))
    assert [describe(f'zoo/msg/{name}')[2] for name in 'ABC'] == ['RIHS01_1', '', '']


def test_the_first_workspace_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An overlay's definition is taken, not that of the workspace under it; a change of the environment is seen."""
    over = workspace(tmp_path / 'over', {'zoo/A.msg': 'int8 new\n'})
    under = workspace(tmp_path / 'under', {'zoo/A.msg': 'int8 old\n'})
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{over}:{under}')
    assert describe('zoo/msg/A')[1] == 'int8 new\n'
    monkeypatch.setenv('AMENT_PREFIX_PATH', under)
    assert describe('zoo/msg/A')[1] == 'int8 old\n'


@pytest.mark.parametrize('name', ['nowhere/msg/Thing', 'no type', '', '../../etc/passwd', 'std_msgs/srv/X', 'a/b/c/d'])
def test_an_unknown_type_has_an_empty_definition(name: str) -> None:
    """An unknown type has an empty definition, which readers treat as missing."""
    assert describe(name) == ('', '', '')


def test_common_types_are_described_without_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """If nothing is sourced, common types are described anyway."""
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)
    encoding, definition, type_hash = describe('sensor_msgs/msg/Imu')
    assert encoding == 'ros2msg'
    assert type_hash == get_typestore(Stores.LATEST).hash_rihs01('sensor_msgs/msg/Imu')
    assert 'sensor_msgs/msg/Imu' in get_types_from_msg(definition, 'sensor_msgs/msg/Imu')


@pytest.mark.skipif(not HAS_ROS, reason='no messages are installed')
@pytest.mark.parametrize('name', [
    'sensor_msgs/msg/Imu', 'sensor_msgs/msg/PointCloud2', 'nav_msgs/msg/Odometry', 'diagnostic_msgs/msg/DiagnosticArray',
    'go2_interfaces/msg/LowState', 'std_msgs/msg/String',
])  # fmt: skip
def test_another_parser_comes_to_the_same_type(name: str) -> None:
    """From the definition alone, `rosbags` computes the type hash that rosidl installed."""
    _, definition, type_hash = describe(name)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    assert type_hash in {store.hash_rihs01(name), ''}  # Humble has none


DERIVED = [
    'std_srvs/srv/Trigger_Event', 'std_srvs/srv/Empty_Event', 'std_srvs/srv/Trigger_Response', 'action_msgs/srv/CancelGoal_Event',
    'rcl_interfaces/srv/SetParameters_Event', 'test_msgs/srv/Arrays_Event',
    *(f'test_msgs/action/Fibonacci_{part}' for part in (
        'FeedbackMessage', 'SendGoal_Event', 'GetResult_Event', 'SendGoal_Request', 'SendGoal_Response', 'GetResult_Request',
        'GetResult_Response', 'Goal', 'Result', 'Feedback')),
    'test_msgs/action/NestedMessage_FeedbackMessage', 'test_msgs/action/NestedMessage_GetResult_Event',
]  # fmt: skip


@pytest.mark.skipif(not HAS_ROS, reason='no messages are installed')
@pytest.mark.parametrize('name', DERIVED)
def test_parts_of_services_and_actions_have_definitions(name: str) -> None:
    """The definition of an event or a feedback message gives the type hash that rosidl computed for it."""
    encoding, definition, type_hash = describe(name)
    if not encoding:
        pytest.skip('its package, or service_msgs, is not installed')
    store = get_typestore(Stores.EMPTY)
    store.register(parsed(definition))
    assert encoding == 'ros2idl'
    assert type_hash in {store.hash_rihs01(name), ''}  # Humble has none


def test_an_action_is_described_where_there_are_no_service_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On Humble, which has no service_msgs, feedback is defined, and events are not."""
    wash = 'module zoo { module action { struct Wash_Feedback { long wet; }; }; };\n'
    uuid = 'module unique_identifier_msgs { module msg { struct UUID { octet uuid[16]; }; }; };\n'
    for path, text in {'zoo/action/Wash.idl': wash, 'unique_identifier_msgs/msg/UUID.idl': uuid}.items():
        file = tmp_path / 'share' / path
        file.parent.mkdir(parents=True)
        file.write_text(text)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    encoding, definition, _ = describe('zoo/action/Wash_FeedbackMessage')
    assert encoding == 'ros2idl'
    assert 'zoo/action/Wash_FeedbackMessage' in parsed(definition)
    assert describe('zoo/action/Wash_SendGoal_Event') == ('', '', '')
    assert describe('zoo/action/Other_FeedbackMessage') == ('', '', '')
    feedback = MessageTypes([tmp_path]).deserialize('zoo/action/Wash_FeedbackMessage', b'\0\1\0\0' + bytes(range(20)))
    assert feedback.feedback.wet == 0x13121110
