"""Definitions of types that are unknown here, from the nodes that publish them: ``~/get_type_description`` (since Jazzy).

Polled, like the subscriptions: one request at a time, which no thread waits for. What a node answers is accepted only if it has
the hash that its publisher announces (REP 2016), and is as limited as ``parse`` says.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from rclpy.exceptions import NameValidationException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.formats import definitions
from shadowhound_data_logger.formats.types import PLACEHOLDER
from shadowhound_data_logger.ros import reader
from shadowhound_data_logger.ros.type_support import ARRAY, BOUNDED_SEQUENCE, HASH_VERSION, MESSAGE, PRIMITIVES, SEQUENCE

log = logging.getLogger(__name__)

PATIENCE_S: Final = 5.0
"""How long a node has to offer the service and to answer."""
MAX_REQUESTS: Final = 100
"""Requests of a process: publishers decide how many types exist."""
MAX_TYPES: Final = 64
MAX_FIELDS: Final = 512
MAX_ARRAY: Final = 1024
MAX_OBJECTS: Final = 512
"""Elements of all arrays of strings and messages together: ``rosbags`` writes a line of code for each, which takes 0.6 ms."""
BOUNDED_STRING: Final = 21
_TYPE: Final = re.compile(r'[a-z][a-z0-9_]{0,99}/msg/[A-Z][A-Za-z0-9]{0,99}', re.ASCII)
_FIELD: Final = re.compile(r'[a-z][a-z0-9_]{0,99}', re.ASCII)
_OBJECTS: Final = {MESSAGE.description, PRIMITIVES['string'].description, BOUNDED_STRING}
_KINDS: Final = {each.description: name for name, each in PRIMITIVES.items() if name not in {'char', 'wstring'}}


class Question(NamedTuple):
    """A request to a node."""

    client: Any
    type_name: str
    type_hash: str
    node: str
    until_s: float


class TypeDescriptions:
    """New; ``poll`` while a topic cannot be received because its type is unknown; ``close`` once. All by one thread."""

    def __init__(self, node: Node, group: reader.PolledGroup) -> None:
        self._node, self._group = node, group
        self._asked: set[tuple[str, str]] = set()
        self._question: Question | None = None
        self._is_sent = False

    def poll(self, topic: str, type_name: str, now_s: float) -> bool:
        """Ask for the definition of a type, or look for the answer; whether there can still be one.

        A new definition is in ``formats.definitions``.
        """
        if self._question is not None and now_s > self._question.until_s:
            log.info('%s did not answer with the definition of %s', printable(self._question.node), self._question.type_name)
            self.close()
        if self._question is None:
            self._begin(topic, type_name, now_s)
        elif self._question.type_name != type_name:
            return self._next(topic, type_name) is not None
        question = self._question
        if question is None:
            return False
        if self._is_sent:
            return self._has_answer(question)
        if question.client.service_is_ready():
            request = question.client.srv_type.Request(type_name=type_name, type_hash=question.type_hash)
            request.include_type_sources = False
            question.client.call_async(request)
            self._is_sent = True
        return True

    def _has_answer(self, question: Question) -> bool:
        """Whether it answered with a definition, or has not answered yet."""
        with question.client.handle:
            _, answer = question.client.handle.take_response(question.client.srv_type.Response)
        if answer is None:
            return True
        self.close()
        return self._accept(question, answer)

    def close(self) -> None:
        """Forget the request. Idempotent."""
        if self._question is not None:
            self._node.destroy_client(self._question.client)
        self._question, self._is_sent = None, False

    def _begin(self, topic: str, type_name: str, now_s: float) -> None:
        asked = self._next(topic, type_name)
        if asked is not None:
            from type_description_interfaces.srv import GetTypeDescription  # noqa: PLC0415 - not on Humble

            self._asked.add(asked)
            type_hash, node = asked
            service = f'{node}/get_type_description'
            try:
                client = self._node.create_client(GetTypeDescription, service, callback_group=self._group)
            except (NameValidationException, rclpy_implementation.RCLError) as error:  # not every participant is a ROS node
                log.info('%s cannot be asked for the definition of %s: %s', printable(node), type_name, printable(str(error)))
                return
            self._question = Question(client, type_name, type_hash, node, now_s + PATIENCE_S)

    def _next(self, topic: str, type_name: str) -> tuple[str, str] | None:
        """The hash of the type and the node to ask next; None if each was asked."""
        for info in self._node.get_publishers_info_by_topic(topic) if len(self._asked) < MAX_REQUESTS else ():
            asked = str(getattr(info, 'topic_type_hash', '')), f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            is_node = info.node_name not in reader.UNKNOWN_NODES and asked[0].startswith(HASH_VERSION)
            if info.topic_type == type_name and is_node and asked not in self._asked:
                return asked
        return None

    def _accept(self, question: Question, answer: Any) -> bool:
        who = printable(question.node)
        if not answer.successful:
            log.warning('%s has no definition of %s: %s', who, question.type_name, printable(answer.failure_reason[:200]))
            return False
        try:
            found = parse(answer.type_description, question.type_name, question.type_hash)
        except ValueError as error:
            log.warning('%s has no usable definition of %s: %s', who, question.type_name, error)
            return False
        definitions.learn(found)
        reader.unavailable.cache_clear()
        log.info('%s has the definition of %s', who, question.type_name)
        return True


def parse(description: Any, type_name: str, type_hash: str) -> dict[str, str]:
    """The texts of ``.msg`` files by type name. Raises ValueError.

    Limited to messages (``package/msg/Name``), types and fields that are named as rosidl requires, MAX_TYPES, MAX_FIELDS, and
    arrays of MAX_ARRAY elements, MAX_OBJECTS of them strings or messages.
    """
    types = [description.type_description, *description.referenced_type_descriptions]
    kinds = [field.type for each in types for field in each.fields]
    objects = sum(
        kind.capacity for kind in kinds if ARRAY < kind.type_id <= BOUNDED_SEQUENCE and kind.type_id - ARRAY in _OBJECTS
    )
    if len(types) > MAX_TYPES or len(kinds) > MAX_FIELDS or objects > MAX_OBJECTS:
        raise ValueError('it has too many fields')
    names = [each.type_name for each in types]
    if names[0] != type_name or len(set(names)) < len(names) or not all(map(_TYPE.fullmatch, names)):
        raise ValueError('its types are not named as messages are')
    contents = [_content(each) for each in types]
    known = {'type_description': contents[0], 'referenced_type_descriptions': contents[1:]}
    if f'{HASH_VERSION}{hashlib.sha256(json.dumps(known).encode()).hexdigest()}' != type_hash:
        raise ValueError('it does not have the hash that its publisher announces')
    return {each.type_name: '\n'.join(_lines(each, names)) + '\n' for each in types}


def _content(individual: Any) -> Mapping[str, Any]:
    """As it is hashed."""
    fields = [
        {'name': field.name, 'type': {name: getattr(field.type, name) for name in (
            'type_id', 'capacity', 'string_capacity', 'nested_type_name')}}
        for field in individual.fields
    ]  # fmt: skip
    return {'type_name': individual.type_name, 'fields': fields}


def _lines(individual: Any, names: list[str]) -> Iterator[str]:
    """The fields of a type as in a ``.msg``. Raises ValueError."""
    for field in individual.fields:
        name, of = field.name, field.type
        if name == PLACEHOLDER:
            continue
        group = next((each for each in (SEQUENCE, BOUNDED_SEQUENCE, ARRAY) if of.type_id > each), 0)
        element = of.type_id - group
        if element == MESSAGE.description and of.nested_type_name in names:
            kind = of.nested_type_name.replace('/msg/', '/')
        elif element == BOUNDED_STRING:
            kind = f'string<={of.string_capacity}'
        elif element in _KINDS:
            kind = _KINDS[element]
        else:
            raise ValueError(f'{individual.type_name} has a field of a kind that is not supported: {of.type_id}')
        if _FIELD.fullmatch(name) is None:
            raise ValueError(f'{individual.type_name} has a field with an invalid name')
        if group == ARRAY and not 0 < of.capacity <= MAX_ARRAY:
            raise ValueError(f'{individual.type_name} has an array of {of.capacity} elements')
        bounds = {0: '', ARRAY: f'[{of.capacity}]', BOUNDED_SEQUENCE: f'[<={of.capacity}]', SEQUENCE: '[]'}[group]
        yield f'{kind}{bounds} {name}'
