"""Type supports made from definitions: equal to those that rosidl generates, and as good for receiving messages."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import profiles
import pytest
from e2e.processes import until
from node.participants import Participant
from std_msgs.msg import String

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.ros import reader, type_support
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.reader import (
    NotInstalled,
    PolledGroup,
    Reader,
    SubscriptionRefused,
    TypeUnavailable,
    endpoints,
    message_class,
    other_definition,
    rclpy_version,
    unavailable,
)

LOW_STATE = 'unitree_go/msg/LowState'
PROGRAM = Path(__file__).with_name('raw_types.py')
PREFIXES = [Path(each) for each in os.environ.get('AMENT_PREFIX_PATH', '').split(':') if each]
RMWS = [
    rmw
    for rmw in type_support.RMWS
    if (rclpy_version()[:1], rmw) in type_support.TESTED and any((each / 'lib' / f'lib{rmw}.so').is_file() for each in PREFIXES)
]


def installed_types() -> Iterator[str]:
    """Messages of all installed packages, with those of services and actions."""
    for prefix in PREFIXES:
        for path in sorted(prefix.glob('share/*/*/*.json')) or sorted(prefix.glob('share/*/msg/*.msg')):
            package, kind = path.parts[-3:-1]
            content = json.loads(path.read_text()) if path.suffix == '.json' else {}
            names = [each['type_name'] for each in content.get('type_hashes', [])] or [f'{package}/{kind}/{path.stem}']
            for name in names:
                if name.startswith(f'{package}/{kind}/') and not unavailable(name):
                    yield name


def maker() -> type_support.Maker:
    found, problem = type_support._maker()
    assert found is not None, problem
    return found


@pytest.mark.sampled
def test_each_installed_type_is_made_as_rosidl_made_it() -> None:
    """Names, sizes, offsets, kinds and bounds of all fields, hash and description, for hundreds of types."""
    names = list(dict.fromkeys(installed_types()))
    assert len(names) > 100
    names = names[:: 1 if profiles.LONG else 4]
    assert {name: difference for name in names if (difference := maker().difference(name))} == {}


@pytest.mark.parametrize('name', ['unitree_go/msg/LowState', 'unitree_hg/msg/LowState', 'go2_interfaces/msg/VoxelMapCompressed'])
def test_definitions_of_this_package_suffice(name: str) -> None:
    """A class for a type whose package is not installed; the same class each time."""
    assert type_support.make(name) is type_support.make(name)
    assert not unavailable(name)


@dataclass
class Workspace:
    """Definitions that no package has, in a folder of the environment."""

    share: Path

    def define(self, **texts: str) -> None:
        for name, text in texts.items():
            (self.share / f'{name}.msg').write_text(text)

    def make(self, name: str) -> type_support.Message:
        """As in a process that was started now."""
        fresh = copy(maker())
        fresh._types, fresh._made = MessageTypes([self.share.parents[2]]), {}
        fresh.support(f'odd/msg/{name}')
        return fresh.message(f'odd/msg/{name}')


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    share = tmp_path / 'share/odd/msg'
    share.mkdir(parents=True)
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path}:{os.environ["AMENT_PREFIX_PATH"]}')
    return Workspace(share)


class Text(ctypes.Structure):
    """``rosidl_runtime_c__String``, and any sequence."""

    _fields_ = [('data', ctypes.c_void_p), ('size', ctypes.c_size_t), ('capacity', ctypes.c_size_t)]


IN_C: Mapping[str, Any] = {
    'bool': ctypes.c_bool, 'byte': ctypes.c_uint8, 'char': ctypes.c_uint8, 'float32': ctypes.c_float, 'float64': ctypes.c_double,
    'string': Text, 'string<=7': Text, **{f'{sign}int{bits}': getattr(ctypes, f'c_{sign}int{bits}')
                                          for sign in ('', 'u') for bits in (8, 16, 32, 64)},
}  # fmt: skip


@pytest.mark.parametrize('seed', range(30))
def test_structures_are_laid_out_as_a_compiler_would(workspace: Workspace, seed: int) -> None:
    """Size of the message and offset of each field, also of nested messages, for random definitions."""
    random = Random(seed)
    in_c = dict(IN_C)
    for name in ('Inner', 'Middle', 'Outer'):
        kinds = random.choices([*in_c, *in_c], k=random.randint(1, 12))
        counts = [random.choice(['', '', f'[{random.randint(1, 5)}]', '[]', '[<=3]']) for _ in kinds]
        workspace.define(
            **{
                name: ''.join(
                    f'{kind}{count} f{number}\n' for number, (kind, count) in enumerate(zip(kinds, counts, strict=True))
                )
            }
        )
        fields = [
            (f'f{number}', in_c[kind] if not count else Text if not count[1:-1].isdecimal() else in_c[kind] * int(count[1:-1]))
            for number, (kind, count) in enumerate(zip(kinds, counts, strict=True))
        ]
        made, real = workspace.make(name), type(name, (ctypes.Structure,), {'_fields_': fields})
        assert (made.size, made.align) == (ctypes.sizeof(real), ctypes.alignment(real))
        assert [made.members.members[number].offset for number in range(len(fields))] == [
            getattr(real, each).offset for each, _ in fields
        ]
        in_c[f'odd/{name}'] = real


@pytest.mark.parametrize(('texts', 'why'), [
    ({'Top': 'uint8[2000000000] a'}, 'odd/msg/Top is too large'),
    ({'Top': 'Mid[900] a', 'Mid': 'Low[900] a', 'Low': 'uint64[900] a'}, 'odd/msg/Top is too large'),
    ({'Top': '\n'.join(f'Mid m{n}' for n in range(99)), 'Mid': '\n'.join(f'uint8 m{n}' for n in range(99))}, 'is too large'),
    ({'Top': '@key\nuint8 a'}, 'odd/msg/Top has a key'),
    ({'Top': 'Top[] a'}, 'contains itself'),
    ({'Top': 'Mid a', 'Mid': 'Top[] a'}, 'contains itself'),
    ({'Top': 'Missing a'}, 'no definition of odd/msg/Missing'),
    ({'Top': 'uint8'}, 'Could not parse'),
    ({'Top': 'uint8 a\nuint16 a'}, 'conflicting Python names'),
    ({'Top': '\0' * 99}, 'Could not parse'),
], ids=str)  # fmt: skip
def test_an_odd_definition_is_refused(workspace: Workspace, texts: Mapping[str, str], why: str) -> None:
    """With the reason, and nothing is passed to the middleware."""
    workspace.define(**texts)
    with pytest.raises((Rejected, type_support.Unsupported), match=why):
        workspace.make('Top')


def test_a_message_without_fields_has_the_one_that_rosidl_adds(workspace: Workspace) -> None:
    workspace.define(Top='# nothing\n', Outer='Top[2] all\nuint32 x\n')
    assert (workspace.make('Top').size, workspace.make('Outer').size) == (1, 8)


@pytest.mark.parametrize('version', [(), (4, 1, 0), (10, 0, 0)])
def test_an_untested_distribution_is_refused(version: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Its structures may be different, and a difference crashes the process."""
    monkeypatch.setattr(type_support, 'rclpy_version', lambda: version)
    made, why = type_support._maker.__wrapped__()
    assert made is None
    assert 'not tested with' in why


def test_unknown_structures_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The structures of Humble are not those of later distributions: the comparison with installed types detects it."""
    monkeypatch.setattr(type_support, 'FIRST_WITH_HASH', 99 if maker().hash(LOW_STATE) else 0)
    made, why = type_support._maker.__wrapped__()
    assert made is None
    assert 'the structures of this ROS are not as expected' in why


def test_it_can_be_turned_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the message package is needed, and the reason says so."""
    monkeypatch.setenv('SHADOWHOUND_TYPE_SUPPORT', 'off')
    monkeypatch.setattr(type_support, '_maker', type_support._maker.__wrapped__)
    monkeypatch.setattr(reader, 'installed_class', missing)
    with pytest.raises(TypeUnavailable, match=r'not here, and .* \(SHADOWHOUND_TYPE_SUPPORT is off\)'):
        message_class.__wrapped__('unitree_go/msg/LowState')


def missing(name: str) -> type:
    raise NotInstalled(f'{name} is not here')


@pytest.mark.ros
def test_a_publisher_with_another_definition_is_refused(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its messages would be decoded with the wrong fields. One without a hash, such as a program without ROS, is not."""
    if not maker().hash('std_msgs/msg/String'):
        pytest.skip('types have no hashes')
    kind = type('String', (), {'HASH': 'RIHS01_0'})
    monkeypatch.setattr(reader, 'message_class', lambda _: kind)
    talker = Participant('talker', domain)
    try:
        talker.create(String, '/said')
        until(lambda: endpoints(talker.node, '/said'), 'it is in the graph')
        with pytest.raises(SubscriptionRefused, match='std_msgs/msg/String is defined differently by /talker'):
            Reader(
                talker.node, Plan('/said', 'std_msgs/msg/String', reliable=True, transient_local=False, depth=5), PolledGroup()
            )
        kind.HASH = maker().hash('std_msgs/msg/String')
        assert not other_definition(talker.node, '/said', 'std_msgs/msg/String')
    finally:
        talker.end()


@pytest.mark.ros
@pytest.mark.parametrize('rmw', RMWS)
def test_messages_are_received_as_with_the_message_package(rmw: str, domain: int) -> None:
    """The same bytes as an ordinary subscription next to it, with the publisher's type hash in the graph, and no warning."""
    environ = {**os.environ, 'ROS_DOMAIN_ID': str(domain), 'RMW_IMPLEMENTATION': rmw}
    start = [sys.executable, str(PROGRAM)]
    pipes: Any = dict.fromkeys(('stdin', 'stdout', 'stderr'), subprocess.PIPE)
    programs = {
        role: subprocess.Popen([*start, role, '2'], env=environ, text=True, **pipes) for role in ('publish', 'installed', 'made')
    }
    found = {}
    for role in ('installed', 'made', 'publish'):
        out, err = programs[role].communicate(timeout=120)
        assert (programs[role].returncode, err) == (0, ''), (role, err)
        found[role] = json.loads(out)
    assert found['made'] == found['installed']
    assert all(len(set(hashes)) == 1 and len(hashes) == 3 for hashes in found['publish'].values()), found['publish']
