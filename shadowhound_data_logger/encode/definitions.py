"""Where definitions of messages are found, and what readers that know nothing of the robot are told: rosbag2's form of them.

They come from the ``share/`` folders of the sourced workspaces, as rosbag2 takes them (rosbag2_cpp,
local_message_definition_source.cpp): the ``.msg`` text, then that of every type it uses, or the same of the ``.idl``
where one of them has no ``.msg``. The hash (REP-2016) is in the ``.json`` that rosidl installs since Iron; Humble knows none.
Where nothing is sourced, the type store of ``rosbags`` knows the common types.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

SEPARATOR: Final = '=' * 80
_TYPE: Final = re.compile(r'([A-Za-z0-9_]+)/(?:msg/)?([A-Za-z0-9_]+)')
_MSG_FIELD: Final = re.compile(r'(?:^|\n)\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+')
_IDL_INCLUDE: Final = re.compile(r'(?:^|\n)#include\s+["<]([a-zA-Z0-9_/]+)\.idl[">]')
_PRIMITIVES: Final = frozenset({
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64', 'uint64',
    'string', 'wstring',
})  # fmt: skip


def find(prefixes: Iterable[str | Path], type_name: str, extension: str = 'msg') -> Path:
    """The file that defines a type, of the first workspace that has it. Raises FileNotFoundError.

    ``prefixes`` are the entries of AMENT_PREFIX_PATH, in their order; empty ones are none.
    """
    named = _TYPE.fullmatch(type_name)
    if named is not None:
        for prefix in prefixes:
            path = Path(prefix, 'share', named[1], 'msg', f'{named[2]}.{extension}')
            if str(prefix) and path.is_file():
                return path
    raise FileNotFoundError(f'{type_name} has no .{extension}')


def describe(type_name: str) -> tuple[str, str, str]:
    """(encoding, definition, type hash) of a message type such as ``sensor_msgs/msg/Imu``.

    The encoding is ``ros2msg`` or ``ros2idl``; all three are empty where nothing is known. Reads files: once for each type.
    """
    return _describe(type_name, os.environ.get('AMENT_PREFIX_PATH', ''))


@lru_cache(maxsize=1024)
def _describe(type_name: str, prefixes: str) -> tuple[str, str, str]:
    named = _TYPE.fullmatch(type_name)
    if named is None:
        return '', '', ''
    places = prefixes.split(os.pathsep)
    for extension, encoding in (('msg', 'ros2msg'), ('idl', 'ros2idl')):
        try:
            definition = _collected(places, type_name, extension)
        except FileNotFoundError:
            continue
        return encoding, definition, _hash(places, type_name)
    return _from_rosbags(f'{named[1]}/msg/{named[2]}')


def _collected(prefixes: Sequence[str], type_name: str, extension: str) -> str:
    """The text of a type and of all that it uses. Raises FileNotFoundError where one of them has none."""
    seen: set[str] = set()

    def collect(name: str) -> str:
        text = find(prefixes, name, extension).read_text(encoding='utf-8', errors='replace')
        package = name.partition('/')[0]
        for used in sorted(_used(text, package, extension) - seen):
            if used not in seen:  # by one before it in this very loop
                seen.add(used)
                text += f'\n{_title(used, extension)}{collect(used)}'
        return text

    return (_title(type_name, extension) if extension == 'idl' else '') + collect(type_name)


def _title(name: str, extension: str) -> str:
    return f'{SEPARATOR}\n{extension.upper()}: {name}\n'


def _used(text: str, package: str, extension: str) -> set[str]:
    if extension == 'idl':
        return set(_IDL_INCLUDE.findall(text))
    names = set(_MSG_FIELD.findall(text)) - _PRIMITIVES
    return {name if '/' in name else f'{package}/{name}' for name in names}


def _hash(prefixes: Sequence[str], type_name: str) -> str:
    try:
        content = json.loads(find(prefixes, type_name, 'json').read_bytes())
        hashes = {one['type_name']: str(one['hash_string']) for one in content['type_hashes']}
    except (OSError, ValueError, LookupError, TypeError) as error:
        log.debug('%s has no type hash: %s', type_name, error)
        return ''
    return hashes.get(type_name, '')


def _from_rosbags(type_name: str) -> tuple[str, str, str]:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - half a second, for machines without ROS alone

    store = get_typestore(Stores.LATEST)
    if type_name not in store.fielddefs:
        return '', '', ''
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return 'ros2msg', definition, store.hash_rihs01(type_name)
