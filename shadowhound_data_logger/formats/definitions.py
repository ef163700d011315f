"""Finds message definitions, and builds the text that describes a type to readers without ROS, in rosbag2's format.

The definitions are read from the ``share/`` folders of the sourced workspaces, as rosbag2 does (rosbag2_cpp,
local_message_definition_source.cpp): the ``.msg`` of the type and of every type it uses. If one of them has no ``.msg``, all are
read from ``.idl``, without ``#include`` lines: every included section follows anyway, and ``rosbags`` cannot open a bag with such
a line. The hash (REP-2016) is in the ``.json`` that rosidl installs since Iron; Humble has none. If no workspace is sourced, the
type store of ``rosbags`` has the common types, and ``interfaces/`` those of Unitree's robots.

The messages of a service's event topic and of an action's topics have types too, such as ``std_srvs/srv/Trigger_Event`` and
``nav2_msgs/action/NavigateToPose_FeedbackMessage``, but no files: rosidl derives them from the service or action
(rosidl_parser/definition.py). This module derives them from its ``.idl``. rosbag2 stores the ``.srv`` text instead, from which
readers cannot decode an event (ros2/rosbag2, issue 2365).
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

VENDORED: Final = Path(__file__).with_name('interfaces')
"""Message packages as in ``share/``: go2_interfaces, unitree_go and unitree_hg."""
LEARNED: Final[dict[str, str]] = {}
"""Definitions that publishers gave to this process. Read by any thread, changed by ``learn``."""
SEPARATOR: Final = '=' * 80
_TYPE: Final = re.compile(r'([A-Za-z0-9_]+)/(?:(msg|srv|action)/)?([A-Za-z0-9_]+)', re.ASCII)
_MSG_FIELD: Final = re.compile(r'(?:^|\n)\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+')
_IDL_INCLUDE: Final = re.compile(r'(?:^|\n)#include\s+["<]([a-zA-Z0-9_/]+)\.idl[">]')
_IDL_LINE: Final = re.compile(r'^#include\b.*\n', re.MULTILINE)
_PRIMITIVES: Final = frozenset({
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64', 'uint64',
    'string', 'wstring',
})  # fmt: skip


_GOAL_ID: Final = 'unique_identifier_msgs/msg/UUID', 'goal_id'
_Fields = tuple[tuple[str, str], ...]


def _event_fields(of: str) -> _Fields:
    """The fields of a service's event message."""
    info = 'service_msgs/msg/ServiceEventInfo', 'info'
    return info, (f'sequence<{of}_Request, 1>', 'request'), (f'sequence<{of}_Response, 1>', 'response')


_DERIVED: Final[Mapping[str, Mapping[str, _Fields]]] = {
    'msg': {},
    'srv': {'Event': _event_fields('{0}')},
    'action': {
        'FeedbackMessage': (_GOAL_ID, ('{0}_Feedback', 'feedback')),
        'SendGoal_Request': (_GOAL_ID, ('{0}_Goal', 'goal')),
        'SendGoal_Response': (('boolean', 'accepted'), ('builtin_interfaces/msg/Time', 'stamp')),
        'SendGoal_Event': _event_fields('{0}_SendGoal'),
        'GetResult_Request': (_GOAL_ID,),
        'GetResult_Response': (('int8', 'status'), ('{0}_Result', 'result')),
        'GetResult_Event': _event_fields('{0}_GetResult'),
    },
}
"""Kind of interface -> suffix of a type's name -> its fields, with ``{0}`` for the service or action."""


def read_definition(prefixes: Iterable[str | Path], type_name: str, extension: str) -> str:
    """The text that defines a type, from the first workspace that has it. Raises FileNotFoundError.

    ``prefixes`` are the entries of AMENT_PREFIX_PATH, in their order; empty ones are ignored. ``extension`` is ``msg`` or
    ``idl``. Only ``idl`` defines the messages of services and actions: the text is that of the whole service or action,
    followed by the types that rosidl derives from it.
    """
    package, kind, name, part = _split_name(type_name)
    if kind != 'msg' and extension == 'msg':
        raise FileNotFoundError(f'{type_name} is part of a service or an action')
    try:
        text = _find_file(prefixes, type_name, extension).read_text(encoding='utf-8', errors='replace')
    except FileNotFoundError:
        learned = LEARNED.get(f'{package}/{kind}/{name}')
        if extension != 'msg' or learned is None:
            raise
        return learned
    derived = _DERIVED[kind]
    if part not in derived:
        return text
    service = part.rpartition('_')[0]
    parts = [each for each in derived if each.rpartition('_')[0] == service] if service else [part]
    includes, structs = [], []
    for each in parts:
        lines = [(of.format(f'{package}/{kind}/{name}'), field) for of, field in derived[each]]
        includes += [of for of, _ in lines if '/msg/' in of]
        fields = ''.join(f'      {of.replace("/", "::")} {field};\n' for of, field in lines)
        structs.append(f'    struct {name}_{each} {{\n{fields}    }};\n')
    head = ''.join(f'#include "{of}.idl"\n' for of in dict.fromkeys(includes))
    return f'{head}{text}\nmodule {package} {{\n  module {kind} {{\n{"".join(structs)}  }};\n}};\n'


def learn(texts: Mapping[str, str]) -> None:
    """Add the texts of ``.msg`` files by type name, for types that have no definition here."""
    for type_name, text in texts.items():
        if not describe(type_name)[1]:
            LEARNED[type_name] = text
    _describe.cache_clear()


def _split_name(type_name: str) -> tuple[str, str, str, str]:
    """Package, kind, name and part of a type: ``std_srvs``, ``srv``, ``Trigger``, ``Event``. Raises FileNotFoundError."""
    named = _TYPE.fullmatch(type_name)
    if named is None:
        raise FileNotFoundError(f'{type_name!r} is not a type')
    package, kind, name = named[1], named[2] or 'msg', named[3]
    if kind == 'msg':
        return package, kind, name, ''
    return package, kind, *name.partition('_')[::2]


def _find_file(prefixes: Iterable[str | Path], type_name: str, extension: str) -> Path:
    package, kind, name, _ = _split_name(type_name)
    folders = [Path(prefix, 'share') for prefix in prefixes if str(prefix)]
    for folder in (*folders, VENDORED):
        path = folder / package / kind / f'{name}.{extension}'
        if path.is_file():
            return path
    raise FileNotFoundError(f'{type_name} has no .{extension}')


def describe(type_name: str) -> tuple[str, str, str]:
    """(encoding, definition, type hash) of a type such as ``sensor_msgs/msg/Imu``.

    The encoding is ``ros2msg`` or ``ros2idl``; all three are empty if the type is unknown. Reads files once per type.
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
            definition = _collect_text(places, type_name, extension)
        except FileNotFoundError:
            continue
        return encoding, definition, _hash(places, type_name)
    return _describe_from_rosbags(f'{named[1]}/msg/{named[3]}') if named[2] in (None, 'msg') else ('', '', '')


def _collect_text(prefixes: Sequence[str], type_name: str, extension: str) -> str:
    """The text of a type and of all types it uses. Raises FileNotFoundError if one of them has none."""
    seen: set[str] = set()

    def collect(name: str) -> str:
        text = read_definition(prefixes, name, extension)
        used = _referenced_types(text, name.partition('/')[0], extension) - seen
        if extension == 'idl':
            text = without_includes(text)
        for each in sorted(used):
            if each not in seen:  # a type before it in this loop may have added it
                seen.add(each)
                text += f'\n{_section_title(each, extension)}{collect(each)}'
        return text

    return (_section_title(type_name, extension) if extension == 'idl' else '') + collect(type_name)


def without_includes(idl: str) -> str:
    """The text of an ``.idl`` in the form that ``rosbags`` can parse."""
    return _IDL_LINE.sub('', idl)


def _section_title(name: str, extension: str) -> str:
    return f'{SEPARATOR}\n{extension.upper()}: {name}\n'


def _referenced_types(text: str, package: str, extension: str) -> set[str]:
    if extension == 'idl':
        return set(_IDL_INCLUDE.findall(text))
    names = set(_MSG_FIELD.findall(text)) - _PRIMITIVES
    return {name if '/' in name else f'{package}/{name}' for name in names}


def _hash(prefixes: Sequence[str], type_name: str) -> str:
    try:
        content = json.loads(_find_file(prefixes, type_name, 'json').read_bytes())
        hashes = {one['type_name']: str(one['hash_string']) for one in content['type_hashes']}
    except (OSError, ValueError, LookupError, TypeError) as error:
        log.debug('%s has no type hash: %s', type_name, error)
        return ''
    return hashes.get(type_name, '')


def _describe_from_rosbags(type_name: str) -> tuple[str, str, str]:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - half a second, needed only on machines without ROS

    store = get_typestore(Stores.LATEST)
    if type_name not in store.fielddefs:
        return '', '', ''
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return 'ros2msg', definition, store.hash_rihs01(type_name)
