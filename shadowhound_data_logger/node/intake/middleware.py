"""Chooses the RMW for the node's subscriptions, from the robot's environment and before ROS is loaded, and configures it.

RTPS numbers every sample. Fast DDS passes on the number, whatever the sender; Cyclone DDS does not. So the node listens to a
robot with Cyclone DDS through Fast DDS, if that receives at least as much (docs/decisions/0017).
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
"""Makes rmw_fastrtps take the memory policy of readers and writers from the profile."""
MEASURED: Final = {(6, 2): 'Humble', (8, 4): 'Jazzy', (9, 3): 'Kilted'}
"""Versions of rmw_fastrtps_cpp that were measured to receive as much from a robot with Cyclone DDS as its own RMW."""
FAST_DDS_3: Final = (9, 0)
HAS_RANGE: Final = (7, 0)
"""Versions of rmw_fastrtps_cpp: the first with Fast DDS 3, and the first that supports ROS_AUTOMATIC_DISCOVERY_RANGE."""
MAX_BUFFER: Final = 32 * MEBI
"""Maximum useful receive buffer, bytes: two seconds of raw images. The kernel allocates it only as it fills."""
SEGMENT: Final = 32 * MEBI
"""Bytes of shared memory, as in the profile for drivers: programs next to the node may publish images."""
MEMORY: Final = '/dev/shm'  # noqa: S108 - where Fast DDS keeps its segments, too
SO_MEMINFO: Final = 55
MEMINFO: Final = struct.Struct('9I')
RECEIVE, DROPS = 1, 8
"""asm-generic/socket.h and linux/sock_diag.h (SK_MEMINFO_RCVBUF, SK_MEMINFO_DROPS)."""


@dataclass(frozen=True, slots=True)
class Middleware:
    """How the node listens. Made by ``choose``; ``enter`` once, before ROS is loaded; create the node within ``profiled``."""

    asked: str
    """The parameter ``capture.rmw``."""
    robot: str
    """The RMW of the robot's environment."""
    rmw: str
    """The RMW of the node."""
    why: str
    network: Network | None = None
    """Where it looks for publishers; None if the RMW decides."""
    domain: int = 0
    variables: Mapping[str, str | None] = field(default_factory=dict)
    """Variables that differ between the node and the robot's environment; None means unset."""
    profile_variable: str = ''
    """The variable that names our profile; empty if it is not used."""
    has_robot: bool = True
    """Whether the robot's RMW is installed here as well, so that a front process can use it."""

    @property
    def is_foreign(self) -> bool:
        """Whether the robot uses another RMW: topics interoperate, services and parameters do not."""
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
        """While a participant is created: our profile is in a private file, and named in the environment."""
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
    """The kernel's view of this process's UDP sockets."""

    receive_bytes: int
    """The largest receive buffer that one of them obtained; DDS uses one size for all its sockets."""
    dropped: int
    """Datagrams that they dropped."""


def requested_rmw(arguments: Sequence[str]) -> str:
    """The parameter ``capture.rmw`` on the command line. Errors in it are reported when ROS reads it."""
    try:
        given = parameter(arguments, SETTING)
    except ParametersUnreadable:
        given = None
    return str(given or CaptureSettings().rmw)


def choose(asked: str, environ: Mapping[str, str]) -> Middleware:
    """Choose the RMW. Raises SettingError if the requested one cannot be used."""
    versions = dict(_installed(environ))
    robot = environ.get(RMW) or (FAST_DDS if FAST_DDS in versions or len(versions) != 1 else next(iter(versions)))
    version = versions.get(FAST_DDS, (0, 0))
    domain = int(given) if (given := environ.get('ROS_DOMAIN_ID', '')).isdecimal() else 0
    if robot.startswith('rmw_fastrtps'):
        ours = _profile_variable(environ, version)
        variables: dict[str, str | None] = _memory_variables(version) if ours else {}
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
    ours = _profile_variable(environ, version)
    if ours:
        variables |= _memory_variables(version) | {
            LOCALHOST_ONLY: None,
            PEERS: None,
            RANGE: 'OFF' if network.is_off else 'SYSTEM_DEFAULT',
        }
    measured = (
        f', by {SETTING}, though {problem}' if problem else f', and was measured with {MEASURED[version]} to receive as much'
    )
    why = 'Fast DDS reports the sequence numbers of its messages' + measured
    return Middleware(asked, robot, FAST_DDS, why, network if ours else None, domain, variables, ours, robot in versions)


def possible_buffer() -> int:
    """The largest receive buffer that the kernel grants here (net.core.rmem_max), at most MAX_BUFFER."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, MAX_BUFFER)
        return probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2  # the kernel doubles it, socket(7)


def sockets() -> Sockets:
    """The sockets at present: what the middleware obtained, not what it requested."""
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
        except OSError:  # closed since
            continue


def _folder() -> str:
    """A folder for a short-lived file: in memory if possible, in case the disk is full, otherwise for temporary files."""
    return MEMORY if os.access(MEMORY, os.W_OK | os.X_OK) else tempfile.gettempdir()


def _installed(environ: Mapping[str, str]) -> Iterator[tuple[str, tuple[int, int]]]:
    """(RMW, major and minor version) of the RMWs in the sourced prefixes; the effective one is last."""
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


def _profile_variable(environ: Mapping[str, str], version: tuple[int, int]) -> str:
    """The variable for our profile; empty if the operator configured Fast DDS transports."""
    name = PROFILE_FILES[version >= FAST_DDS_3]
    theirs = environ.get(name)
    return '' if environ.get(TRANSPORTS) or (theirs and Path(theirs).name != SHIPPED) else name


def _memory_variables(version: tuple[int, int]) -> dict[str, str | None]:
    """Lets the profile decide about memory; only measured with Fast DDS 3."""
    return {FROM_PROFILE: '1'} if version >= FAST_DDS_3 else {}


def _impossible(robot: str, versions: Mapping[str, tuple[int, int]], environ: Mapping[str, str]) -> str:
    """Why Fast DDS cannot listen to this robot; empty if it can."""
    if robot != CYCLONE_DDS:
        return f'Fast DDS does not interoperate with {robot}'
    if FAST_DDS not in versions:
        return f'{FAST_DDS} is not installed'
    if environ.get('ROS_SECURITY_ENABLE', '').lower() == 'true':
        return 'ROS_SECURITY_ENABLE is true, and secured messages between the two have not been tested'
    return ''
