"""Chooses the RMW by which the node listens, from the robot's environment and before ROS is loaded, and configures it.

RTPS numbers every sample, and Fast DDS hands the number on whoever sent it; Cyclone DDS keeps it to itself. So a robot with
Cyclone DDS is listened to through Fast DDS, where that hears at least as much (docs/decisions/0017).
"""

from __future__ import annotations

import os
import re
import socket
import struct
import tempfile
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Final

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.options import MEBI, RMW_AUTO, RMW_FASTRTPS, RMW_ROBOT, CaptureSettings
from shadowhound_data_logger.core.ros_arguments import ParametersUnreadable, parameter
from shadowhound_data_logger.core.status import MiddlewareStatus
from shadowhound_data_logger.node.intake.dds_network import LOCALHOST_ONLY, PEERS, RANGE, Network, profile, robot_network
from shadowhound_data_logger.ros.fast_dds_profile import PROFILE_FILES, SHIPPED, TRANSPORTS

RMW: Final = 'RMW_IMPLEMENTATION'
FAST_DDS, CYCLONE_DDS = 'rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp'
SETTING: Final = 'capture.rmw'
FROM_PROFILE: Final = 'RMW_FASTRTPS_USE_QOS_FROM_XML'
"""Has rmw_fastrtps leave to the profile how readers and writers keep memory."""
MEASURED: Final = {(6, 2): 'Humble', (8, 4): 'Jazzy', (9, 3): 'Kilted'}
"""Versions of rmw_fastrtps_cpp through which all was heard of a robot with Cyclone DDS that its own RMW hears."""
FAST_DDS_3: Final = (9, 0)
HAS_RANGE: Final = (7, 0)
"""Versions of rmw_fastrtps_cpp: the first with Fast DDS 3, and the first that knows ROS_AUTOMATIC_DISCOVERY_RANGE."""
MAX_BUFFER: Final = 32 * MEBI
"""Bytes of a receive buffer beyond which more is no use: two seconds of raw images. The kernel takes it only as it is filled."""
SEGMENT: Final = 32 * MEBI
"""Bytes of shared memory, as in the profile for drivers: what runs beside the node may publish images."""
MEMORY: Final = '/dev/shm'  # noqa: S108 - where Fast DDS keeps its segments, too
SO_MEMINFO: Final = 55
MEMINFO: Final = struct.Struct('9I')
RECEIVE, DROPS = 1, 8
"""asm-generic/socket.h and linux/sock_diag.h (SK_MEMINFO_RCVBUF, SK_MEMINFO_DROPS)."""


@dataclass(frozen=True, slots=True)
class Middleware:
    """How the node listens. Made by ``choose``; ``enter`` once, before ROS is loaded; the node is made while ``profiled``."""

    asked: str
    """Of the parameter ``capture.rmw``."""
    robot: str
    """The RMW of the robot's environment."""
    rmw: str
    """The RMW of the node."""
    why: str
    network: Network | None = None
    """Where it looks for publishers; None where that is the RMW's own business."""
    domain: int = 0
    variables: Mapping[str, str | None] = field(default_factory=dict)
    """What differs for the node from the robot's environment; None is not set."""
    profile_variable: str = ''
    """What names our profile; empty where there is none of ours."""
    has_robot: bool = True
    """Whether the RMW of the robot is installed here as well, so that a front can speak it."""

    @property
    def is_foreign(self) -> bool:
        """Whether the robot speaks another RMW: topics cross, services and parameters do not."""
        return self.rmw != self.robot

    def enter(self, environ: MutableMapping[str, str]) -> None:
        """Set the variables that differ."""
        for name, value in self.variables.items():
            if value is None:
                environ.pop(name, None)
            else:
                environ[name] = value

    @contextmanager
    def profiled(self, environ: MutableMapping[str, str]) -> Iterator[None]:
        """While a participant is made: our profile is in a file of this user alone, and named in the environment."""
        if not self.profile_variable:
            yield
            return
        text = profile(possible_buffer(), self.network, self.domain, segment_bytes=0 if self.is_foreign else SEGMENT)
        before = environ.get(self.profile_variable)
        with NamedTemporaryFile('w', prefix='fastdds-', suffix='.xml', dir=_folder(), encoding='utf-8') as file:
            file.write(text)
            file.flush()
            environ[self.profile_variable] = file.name
            try:
                yield
            finally:
                if before is None:
                    environ.pop(self.profile_variable)
                else:
                    environ[self.profile_variable] = before

    def status(self) -> MiddlewareStatus:
        found, network = sockets(), self.network.describe() if self.network is not None else ''
        return MiddlewareStatus(self.rmw, self.robot, self.why, self.asked, network, found.receive_bytes, found.dropped)

    def describe(self) -> str:
        """``rmw_fastrtps_cpp (the robot's is rmw_cyclonedds_cpp: ...), on all interfaces, receive buffer 4.0 MB``."""
        whose = f"the robot's is {self.robot}: {self.why}" if self.is_foreign else self.why
        where = f', {self.network.describe()}' if self.network is not None else ''
        return f'{self.rmw} ({whose}){where}, receive buffer {sockets().receive_bytes / MEBI:.1f} MB'


@dataclass(frozen=True, slots=True)
class Sockets:
    """What the kernel says of the UDP sockets of this process."""

    receive_bytes: int
    """The largest receive buffer that one of them asked for and got; DDS gives all that it listens on the same."""
    dropped: int
    """Datagrams that found no room in them."""


def requested_rmw(arguments: Sequence[str]) -> str:
    """The parameter ``capture.rmw`` of the command line. Whatever is wrong with it is told when ROS has read it as well."""
    try:
        given = parameter(arguments, SETTING)
    except ParametersUnreadable:
        given = None
    return str(given or CaptureSettings().rmw)


def choose(asked: str, environ: Mapping[str, str]) -> Middleware:
    """The decision. Raises SettingError where it is asked for what cannot be."""
    versions = dict(_installed(environ))
    robot = environ.get(RMW) or (FAST_DDS if FAST_DDS in versions or len(versions) != 1 else next(iter(versions)))
    version = versions.get(FAST_DDS, (0, 0))
    domain = int(given) if (given := environ.get('ROS_DOMAIN_ID', '')).isdecimal() else 0
    if robot.startswith('rmw_fastrtps'):
        ours = _ours(environ, version)
        variables: dict[str, str | None] = _of_memory(version) if ours else {}
        return Middleware(asked, robot, robot, "the robot's own", variables=variables, profile_variable=ours)
    if asked == RMW_ROBOT:
        return Middleware(asked, robot, robot, f"the robot's own, by {SETTING}")
    network = robot_network(environ, domain, has_range=version >= HAS_RANGE)
    problem = _impossible(robot, versions, environ)
    if asked == RMW_FASTRTPS and problem:
        raise SettingError(SETTING, asked, f'{RMW_AUTO} or {RMW_ROBOT} here: {problem}')
    problem = problem or network.problem
    if not problem and version not in MEASURED:
        problem = f'{FAST_DDS} {version[0]}.{version[1]} has not been tested with it'
    if asked != RMW_FASTRTPS and problem:
        return Middleware(asked, robot, robot, f"the robot's own: {problem}")
    variables = {RMW: FAST_DDS}
    ours = _ours(environ, version)
    if ours:
        variables |= _of_memory(version) | {
            LOCALHOST_ONLY: None,
            PEERS: None,
            RANGE: 'OFF' if network.is_off else 'SYSTEM_DEFAULT',
        }
    measured = f', by {SETTING}, though {problem}' if problem else f', and was measured with {MEASURED[version]} to hear as much'
    why = 'Fast DDS hands on the numbers of its messages' + measured
    return Middleware(asked, robot, FAST_DDS, why, network if ours else None, domain, variables, ours, robot in versions)


def possible_buffer() -> int:
    """Bytes of the largest receive buffer that the kernel gives a socket here (net.core.rmem_max), at most MAX_BUFFER."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, MAX_BUFFER)
        return probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2  # the kernel doubles it, socket(7)


def sockets() -> Sockets:
    """Of this process, now: what the middleware obtained, not what it was told to ask for."""
    rows = list(_memory())
    return Sockets(max((row[RECEIVE] // 2 for row in rows), default=0), sum(row[DROPS] for row in rows))


def _memory() -> Iterator[tuple[int, ...]]:
    """SK_MEMINFO_* of each UDP socket."""
    for path in Path('/proc/self/fd').iterdir():
        try:
            if not str(path.readlink()).startswith('socket:'):
                continue
            with socket.socket(fileno=os.dup(int(path.name))) as found:
                if found.type is socket.SOCK_DGRAM and found.family in {socket.AF_INET, socket.AF_INET6}:
                    yield MEMINFO.unpack(found.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size))
        except OSError:  # closed meanwhile
            continue


def _folder() -> str:
    """For a file of some seconds: memory, which is there when the disk is full, else where temporary files go."""
    return MEMORY if os.access(MEMORY, os.W_OK | os.X_OK) else tempfile.gettempdir()


def _installed(environ: Mapping[str, str]) -> Iterator[tuple[str, tuple[int, int]]]:
    """(RMW, version as major and minor) of what is in the sourced prefixes; the one that counts comes last."""
    for prefix in reversed(environ.get('AMENT_PREFIX_PATH', '').split(':')):
        folder = Path(prefix or '/nowhere') / 'share'
        for mark in folder.glob('ament_index/resource_index/rmw_typesupport/*'):
            if mark.name == 'rmw_implementation':  # it only loads the others
                continue
            try:
                text = (folder / mark.name / 'package.xml').read_text(encoding='utf-8')
            except OSError:
                text = ''
            match = re.search(r'<version>\s*(\d+)\.(\d+)', text)
            yield mark.name, (int(match[1]), int(match[2])) if match else (0, 0)


def _ours(environ: Mapping[str, str], version: tuple[int, int]) -> str:
    """The variable that is to name our profile; empty where the operator told Fast DDS its transports."""
    name = PROFILE_FILES[version >= FAST_DDS_3]
    theirs = environ.get(name)
    return '' if environ.get(TRANSPORTS) or (theirs and Path(theirs).name != SHIPPED) else name


def _of_memory(version: tuple[int, int]) -> dict[str, str | None]:
    """What has the profile decide of memory; measured with Fast DDS 3 alone."""
    return {FROM_PROFILE: '1'} if version >= FAST_DDS_3 else {}


def _impossible(robot: str, versions: Mapping[str, tuple[int, int]], environ: Mapping[str, str]) -> str:
    """Why Fast DDS cannot listen to this robot at all; empty where it can."""
    if robot != CYCLONE_DDS:
        return f'Fast DDS does not speak to {robot}'
    if FAST_DDS not in versions:
        return f'{FAST_DDS} is not installed'
    if environ.get('ROS_SECURITY_ENABLE', '').lower() == 'true':
        return 'ROS_SECURITY_ENABLE is true, and whether the two exchange secured messages has not been measured'
    return ''
