"""Hides from our package what Humble's rclpy lacks: copied as sitecustomize.py to a folder on Python's path.

The names of Humble are in ``rclpy_humble.json``, which ``rclpy_names.py`` generates from rclpy's source. Any other module,
function, class or class member raises AttributeError (ImportError) in our package; rclpy itself still uses it.
``HUMBLE_RMW`` is the RMW to imitate: rmw_cyclonedds_cpp provides less than rmw_fastrtps_cpp.

Sources of details other than names: rmw 6.1 (RMW_GID_STORAGE_SIZE), rmw_cyclonedds_cpp 1.3 (received_timestamp).
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import sys
from contextlib import suppress
from enum import Enum
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import rclpy

OURS = 'shadowhound_data_logger'
FACTS = json.loads(Path(os.environ['RCLPY_NAMES']).read_text(encoding='utf-8'))
RENAMED = {'rclpy.qos_event': 'rclpy.event_handler', 'QoSEvent': 'EventHandle'}
"""Names in Humble that are different now."""
GID_BYTES = 24
CYCLONE_DDS = os.environ['HUMBLE_RMW'] == 'rmw_cyclonedds_cpp'


def asked_by_us(depth: int = 2) -> bool:
    """Whether the caller of our caller is in our package."""
    return str(sys._getframe(depth).f_globals.get('__name__', '')).startswith(OURS)


class Hidden:
    """A class member that Humble does not have."""

    def __init__(self, name: str, hidden: Any) -> None:
        self.name, self.hidden = name, hidden

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        if asked_by_us():
            raise AttributeError(f'{self.name} is not in rclpy {FACTS["version"]}')
        get = getattr(type(self.hidden), '__get__', None)
        return get(self.hidden, instance, owner) if get else self.hidden


class HiddenProperty(Hidden):
    """A hidden member that can be assigned to."""

    def __set__(self, instance: Any, value: Any) -> None:
        type(self.hidden).__set__(self.hidden, instance, value)


class Guarded(ModuleType):
    """A module that only shows Humble's names to our package."""

    def __getattribute__(self, name: str) -> Any:
        get = super().__getattribute__
        if name.startswith('__') or not asked_by_us():
            return get(name)
        module = get('__name__')
        here = FACTS['modules'].get(module, {'names': ()})
        if name not in here['names'] and f'{module}.{name}' not in FACTS['modules']:
            raise AttributeError(f'{module}.{name} is not in rclpy {FACTS["version"]}')
        return get(RENAMED.get(name, name))


def members(cls: type) -> set[str]:
    """The members of a class in Humble, where it may be in another module; empty if Humble does not have it."""
    modules = FACTS['modules']
    places = (
        [modules[cls.__module__]] if cls.__name__ in modules.get(cls.__module__, {'classes': ()})['classes'] else modules.values()
    )
    return {name for each in places if cls.__name__ in each['classes'] for name in each['classes'][cls.__name__]['members']}


def hide_members(cls: type) -> None:
    """Hide the members that neither the class nor its bases have in Humble."""
    known = {name for each in cls.__mro__ for name in members(each)}
    for name, member in list(vars(cls).items()):
        if not name.startswith('__') and name not in known and not isinstance(member, type):
            kind = HiddenProperty if hasattr(type(member), '__set__') else Hidden
            setattr(cls, name, kind(f'{cls.__name__}.{name}', member))


def hide() -> None:
    """Hide everything, after all of rclpy is loaded."""
    for found in pkgutil.walk_packages(rclpy.__path__, 'rclpy.'):
        with suppress(ImportError):  # some exist for rclpy's tests
            importlib.import_module(found.name)
    for name, module in list(sys.modules.items()):
        if name.partition('.')[0] != 'rclpy' or not isinstance(module, ModuleType):
            continue
        for cls in vars(module).values():
            if isinstance(cls, type) and cls.__module__ == name and members(cls) and not special(cls):
                hide_members(cls)
    for name, module in list(sys.modules.items()):
        if name.partition('.')[0] == 'rclpy' and isinstance(module, ModuleType):
            module.__class__ = Guarded
    for name in FACTS['modules'].keys() - sys.modules.keys():
        if name in RENAMED:
            stand_in = sys.modules[name] = Guarded(name)
            vars(stand_in).update(vars(sys.modules[RENAMED[name]]) | {'__name__': name})


def special(cls: type) -> bool:
    """Enumerations and tuples generate their members."""
    return issubclass(cls, (Enum, tuple, BaseException)) or hasattr(cls, '__members__')


def behave() -> None:
    """Return from rclpy and the RMW what they return in Humble."""
    from rclpy import utilities
    from rclpy.impl.implementation_singleton import rclpy_implementation as compiled
    from rclpy.node import Node

    take, publishers, version = compiled.Subscription.take_message, Node.get_publishers_info_by_topic, metadata.version

    def take_message(subscription: Any, kind: Any, raw: bool) -> Any:
        taken = take(subscription, kind, raw)
        if taken is None:
            return None
        info = {name: taken[1][name] for name in FACTS['message_info']}
        return taken[0], info | {'received_timestamp': 0} if CYCLONE_DDS else info

    def publishers_info(node: Node, *arguments: Any) -> Any:
        found = publishers(node, *arguments)
        for info in found:
            info.endpoint_gid = [*info.endpoint_gid, *[0] * (GID_BYTES - len(info.endpoint_gid))]
        return found

    compiled.Subscription.take_message = take_message
    Node.get_publishers_info_by_topic = publishers_info
    metadata.version = lambda name: FACTS['version'] if name == 'rclpy' else version(name)
    if CYCLONE_DDS:
        utilities.get_rmw_implementation_identifier = lambda: 'rmw_cyclonedds_cpp'


behave()
hide()
