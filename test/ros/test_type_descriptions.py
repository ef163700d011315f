"""Definitions that publishers give: of types that this machine does not know, and nothing else."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest
from e2e.processes import until
from node.participants import Participant
from ros.unknown_type import NAME, hidden, publisher

from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.formats import definitions
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.ros import type_support
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.reader import PolledGroup, Reader, unavailable
from shadowhound_data_logger.ros.type_descriptions import MAX_ARRAY, PATIENCE_S, TypeDescriptions, parse


def content(name: str) -> tuple[Any, str]:
    """A description as a node answers, and its hash."""
    maker, _ = type_support._maker()
    if maker is None or not maker.hash('std_msgs/msg/String'):
        pytest.skip('types have no hashes')

    def objects(value: Any) -> Any:
        if isinstance(value, dict):
            return SimpleNamespace(**{name: objects(each) for name, each in value.items()})
        return [objects(each) for each in value] if isinstance(value, list) else value

    maker.support(name)
    return objects(dict(maker.description(name))), maker.hash(name)


@pytest.mark.parametrize(
    'name', ['nav_msgs/msg/Odometry', 'sensor_msgs/msg/CameraInfo', 'rcl_interfaces/msg/ParameterDescriptor']
)
def test_a_definition_is_as_in_the_package(name: str) -> None:
    """Read again, the text has the same hash; comments, constants and default values are not part of it."""
    description, announced = content(name)
    texts = parse(description, name, announced)
    assert len(texts) == 1 + len(description.referenced_type_descriptions)
    fields = [line for line in texts[name].splitlines() if line]
    assert len(fields) == len(description.type_description.fields)


@pytest.mark.parametrize('change', [
    lambda one: setattr(one.type_description, 'type_name', '../../msg/Odometry'),
    lambda one: setattr(one.type_description.fields[0], 'name', 'import os'),
    lambda one: setattr(one.type_description.fields[0], 'name', 'x\nuint8 y'),
    lambda one: setattr(one.type_description.fields[0].type, 'nested_type_name', 'std_msgs/msg/Missing'),
    lambda one: setattr(one.type_description.fields[0].type, 'type_id', 255),
    lambda one: setattr(one.type_description.fields[0].type, 'type_id', 0),
    lambda one: one.type_description.fields.extend(one.type_description.fields * 999),
    lambda one: one.referenced_type_descriptions.extend(one.referenced_type_descriptions * 99),
    lambda one: one.referenced_type_descriptions.append(one.type_description),
    lambda one: one.type_description.fields.clear(),
    lambda one: [setattr(one.type_description.fields[0].type, *each) for each in (('type_id', 49), ('capacity', 513))],
    lambda one: setattr(one.type_description.fields[1].type, 'type_id', 51),
])  # fmt: skip
def test_another_definition_is_refused(change: Callable[[Any], object]) -> None:
    """Whatever a hostile node changes: names, kinds, sizes. The hash alone would not suffice: it announces that too."""
    description, announced = content('nav_msgs/msg/Odometry')
    change(description)
    with pytest.raises(ValueError, match=r'it |its |nav_msgs'):
        parse(description, 'nav_msgs/msg/Odometry', announced)


def test_what_a_hostile_node_announces_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a correct hash: invalid names, unknown kinds and large arrays are refused, whichever field has them."""
    monkeypatch.setattr('shadowhound_data_logger.ros.type_descriptions.hashlib', SimpleNamespace(
        sha256=lambda _: SimpleNamespace(hexdigest=lambda: '0')))  # fmt: skip
    random = Random(1)
    accepted = 0
    for _ in range(2000):
        description, _ = content('sensor_msgs/msg/CameraInfo')
        field = random.choice([field for one in (description.type_description, *description.referenced_type_descriptions)
                               for field in one.fields])  # fmt: skip
        match random.randrange(4):
            case 0:
                field.name = ''.join(chr(random.choice([*range(128), 233, 0x4E00])) for _ in range(random.randint(0, 9)))
            case 1:
                field.type.type_id = random.randrange(256)
            case 2:
                field.type.capacity = random.choice([0, MAX_ARRAY + 1, 2**63])
            case _:
                field.type.nested_type_name = random.choice(['', 'x' * 999, 'os/msg/path', '../x/msg/Y'])
        try:
            texts = parse(description, 'sensor_msgs/msg/CameraInfo', 'RIHS01_0')
        except ValueError:
            continue
        accepted += 1
        for text in texts.values():
            assert printable(text.replace('\n', ' ')) == text.replace('\n', ' ')
            for line in text.splitlines():
                assert len(line.split()) == 2
    assert 0 < accepted < 1900


@pytest.mark.ros
@pytest.mark.parametrize('name', ['no such', '1', 'x' * 300, 'absent'])
def test_a_node_that_cannot_be_asked_is_asked_once(name: str, domain: int) -> None:
    """A name is invalid, as of a participant that is not a ROS node, or no node has it; afterwards no answer is awaited."""
    pytest.importorskip('type_description_interfaces')
    logger = Participant('asking', domain)
    info = SimpleNamespace(topic_type=NAME, topic_type_hash='RIHS01_0', node_namespace='/', node_name=name)
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda _: [info], create_client=logger.node.create_client,
        destroy_client=logger.node.destroy_client,
    )  # fmt: skip
    asking = TypeDescriptions(node, PolledGroup())  # type: ignore[arg-type]
    try:
        assert asking.poll('/arrays', NAME, 0.0) == (name == 'absent')
        assert asking.poll('/arrays', NAME, PATIENCE_S / 2) == (name == 'absent')
        assert not asking.poll('/arrays', NAME, 2 * PATIENCE_S)
    finally:
        asking.close()
        logger.end()


@pytest.mark.ros
def test_an_unknown_type_is_received(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its publisher is asked, the answer is verified, and its messages are received and decoded."""
    with hidden(monkeypatch), publisher(domain):
        receive(domain)


def receive(domain: int) -> None:
    logger = Participant('asking', domain)
    asking = TypeDescriptions(logger.node, PolledGroup())
    types = MessageTypes(os.environ['AMENT_PREFIX_PATH'].split(':'))
    try:
        assert unavailable(NAME)
        until(lambda: asking.poll('/arrays', NAME, time.monotonic()) or not unavailable(NAME), 'it is asked')
        until(lambda: not asking.poll('/arrays', NAME, time.monotonic()) and not unavailable(NAME), 'it answers')
        reader_ = Reader(logger.node, Plan('/arrays', NAME, reliable=True, transient_local=False, depth=5), PolledGroup())
        taken = until(reader_.drain, 'a message arrives')
        assert types.deserialize(NAME, taken[0].cdr).alignment_check == 7
        assert 'int32 alignment_check' in definitions.describe(NAME)[1]
        reader_.close()
    finally:
        asking.close()
        logger.end()
