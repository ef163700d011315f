"""Transport of large messages from the driver to the logger: shared memory, or socket buffers that are large enough."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.options import IMAGE, POINT_CLOUD
from shadowhound_data_logger.core.status import MiddlewareStatus
from shadowhound_data_logger.doctor.machine import Process, number, processes
from shadowhound_data_logger.doctor.model import Context, Result, error, info, ok, warning
from shadowhound_data_logger.doctor.ros_environment import DRIVERS, middleware, running
from shadowhound_data_logger.ros.fast_dds_profile import PROFILE_FILES, SHIPPED
from shadowhound_data_logger.ros.port_guard import settle
from shadowhound_data_logger.ros.shared_memory import orphans

NAME: Final = 'sockets'
PROFILE_FILE: Final = f'$(ros2 pkg prefix shadowhound_data_logger)/share/shadowhound_data_logger/launch_configs/{SHIPPED}'
MIN_BUFFER: Final = 1 << 20
"""With this many bytes, all of 105 raw images at 15 Hz arrived; the kernel's default, 208 KB, does not fit one of them."""
ENOUGH_BUFFER: Final = 8 << 20
"""net.core.rmem_max: two seconds of clouds of 320 KB at 10 Hz, or eight raw images (docs/thor.md, Middleware)."""
ENOUGH_SEGMENT: Final = 4 << 20
"""Four raw images of 921 KB; Fast DDS's default (512 KB) does not fit one."""
ENOUGH_SHM: Final = 128 << 20
"""Three participants with the segment of our profile."""
LARGE: Final = frozenset({IMAGE, POINT_CLOUD})
_SEGMENT: Final = re.compile(r'<segment_size>\s*(\d+)\s*</segment_size>')
_MIN_BUFFER: Final = re.compile(r'<SocketReceiveBufferSize\b[^>]*\bmin=["\']\s*(\d+)\s*([a-z]*)', re.IGNORECASE)
_UNITS: Final = {'k': 10, 'm': 20, 'g': 30}
"""kB, MB and MiB in powers of 2; https://cyclonedds.io/docs/cyclonedds/0.10.5/config/config_file_reference.html"""
SYSCTL: Final = (
    "echo 'net.core.rmem_max = 16777216' | sudo tee /etc/sysctl.d/60-dds.conf && sudo sysctl --system # docs/thor.md, Middleware"
)


def check(context: Context) -> Iterator[Result]:
    """Check buffers, shared memory and the driver's profile."""
    large = [sensor.name for sensor in context.settings.sensors if sensor.enabled and LARGE.intersection(sensor.types)]
    if not large:
        yield ok('sockets.need', 'no sensor with large messages is logged')
        return
    driver = processes(context.root, *DRIVERS)
    robot = context.environ.get('RMW_IMPLEMENTATION', '')
    node = running(context)
    rmw = node.rmw if node is not None else _rmw(context)
    if 'cyclone' in robot or 'cyclone' in rmw:
        yield _receive_buffer(context, node)
        yield from _cyclone(context, listens='cyclone' in rmw)
        return
    yield _profile(context)
    yield from _memory(context, driver)
    if driver:
        yield from _user(driver)
        yield from _driver_profile(context, driver)
        found = _kernel_buffer(context, '')
        yield ok(found.check, f'{found.seen}; not needed, because the driver runs here') if found.is_finding else found
    else:
        yield _kernel_buffer(context, 'if the driver is on another machine, everything arrives over UDP', needed=False)


def _rmw(context: Context) -> str:
    """The RMW that a node would listen with; empty if it would not start, which ros.listener reports."""
    try:
        return middleware(context).rmw
    except SettingError:
        return ''


def _receive_buffer(context: Context, node: MiddlewareStatus | None) -> Result:
    """The receive buffer of the running node, otherwise the kernel's limit, for a driver with Cyclone DDS."""
    name, limit = 'sockets.buffer', number(context.root / 'proc/sys/net/core/rmem_max')
    cause = 'Cyclone DDS sends clouds and raw images over UDP in fragments, and one dropped fragment loses the message'
    size = (node.receive_bytes if node is not None else None) or limit
    if size is None:
        return info(name, 'net.core.rmem_max cannot be read here')
    figures: dict[str, Any] = {'rmem_max': limit}
    if node is not None and node.receive_bytes:
        seen = f'the node has a receive buffer of {size:,} bytes ({node.rmw})'
        figures |= {'receive_bytes': size, 'dropped_datagrams': node.dropped_datagrams}
        if node.dropped_datagrams:
            seen += f', and dropped {node.dropped_datagrams:,} datagrams since its start'
    else:
        seen = f'net.core.rmem_max is {size:,} bytes'
    if size < MIN_BUFFER <= (limit or 0):
        remedy = f'restart the node: sudo systemctl restart shadowhound-data-logger  # net.core.rmem_max is {limit:,} now'
        return warning(name, seen, cause, remedy, **figures)
    if size < MIN_BUFFER:
        return warning(name, seen, cause, f'{SYSCTL} ; then restart the node', **figures)
    return ok(name, seen, **figures) if size >= ENOUGH_BUFFER else info(name, seen, cause, SYSCTL, **figures)


def _kernel_buffer(context: Context, why: str, *, needed: bool = True) -> Result:
    size = number(context.root / 'proc/sys/net/core/rmem_max')
    if size is None:
        return info('sockets.buffer', 'net.core.rmem_max cannot be read here')
    seen = f'net.core.rmem_max is {size:,} bytes'
    if size >= ENOUGH_BUFFER:
        return ok('sockets.buffer', seen, rmem_max=size)
    cause = f'{why}: clouds and raw images are split into fragments, and one dropped fragment loses the message'
    if not needed:
        return info('sockets.buffer', seen, cause, SYSCTL, rmem_max=size)
    return warning('sockets.buffer', seen, cause, SYSCTL, rmem_max=size)


def _cyclone(context: Context, *, listens: bool) -> Iterator[Result]:
    """Whether Cyclone DDS starts here, for the node or for its front.

    The requested buffer matters if the node ``listens`` through it: a high kernel limit does not help if the default is
    requested.
    """
    uri = context.environ.get('CYCLONEDDS_URI', '')
    try:
        text = Path(uri.removeprefix('file://')).read_text(encoding='utf-8') if uri and '<' not in uri else uri
    except OSError as problem:
        yield error(
            'sockets.cyclone',
            f'CYCLONEDDS_URI={uri} cannot be read: {problem.strerror}',
            'Cyclone DDS then does not start',
            f'ls -l {uri.removeprefix("file://")}',
        )
        return
    minimum, limit = _min_buffer(text), number(context.root / 'proc/sys/net/core/rmem_max')
    if limit is not None and minimum > 2 * limit:  # the kernel reports twice the requested value, see socket(7)
        yield error(
            'sockets.cyclone',
            f'CYCLONEDDS_URI requests a receive buffer of at least {minimum:,} bytes, twice net.core.rmem_max is {2 * limit:,}',
            'Cyclone DDS then does not start',
            f'{SYSCTL}  # or: SocketReceiveBufferSize min="default" max="10MB"',
        )
    elif not listens:
        return
    elif 'SocketReceiveBufferSize' in text:
        yield ok('sockets.cyclone', 'CYCLONEDDS_URI requests a receive buffer')
    else:
        yield warning(
            'sockets.cyclone',
            'CYCLONEDDS_URI requests no receive buffer',
            'Cyclone DDS takes 1 MB by default',
            'export CYCLONEDDS_URI=file:///etc/shadowhound/cyclonedds.xml  # with SocketReceiveBufferSize max="10MB": '
            'docs/thor.md',
        )


def _min_buffer(text: str) -> int:
    """The receive buffer, bytes, that Cyclone DDS needs with these settings in order to start."""
    found = _MIN_BUFFER.search(text)
    return int(found[1]) << _UNITS.get(found[2][:1].lower(), 0) if found else 0


def _profile(context: Context) -> Result:
    """The Fast DDS profile of this shell."""
    read = _variable(context.environ)
    name = next((each for each in (read, *PROFILE_FILES) if context.environ.get(each)), '')
    file = context.environ.get(name, '')
    remedy = f'export {read}={PROFILE_FILE}  # for the driver, and here'
    if not file:
        return warning(
            'sockets.profile',
            'Fast DDS uses its small default shared memory (512 KB)',
            'a raw image or a cloud does not fit, is sent over UDP in fragments, and is mostly lost',
            remedy,
        )
    try:
        sizes = [int(size) for size in _SEGMENT.findall(Path(file).read_text(encoding='utf-8'))]
    except OSError as problem:
        return error(
            'sockets.profile', f'{name}={file} cannot be read: {problem.strerror}', 'Fast DDS then uses its defaults', remedy
        )
    if max(sizes, default=0) < ENOUGH_SEGMENT:
        return warning(
            'sockets.profile',
            f'{file} has no shared-memory segment of {ENOUGH_SEGMENT >> 20} MB or more',
            'raw images do not fit',
            remedy,
        )
    return ok('sockets.profile', f'shared memory of {max(sizes) >> 20} MB by {file}')


def _memory(context: Context, driver: list[Process]) -> Iterator[Result]:
    found = orphans(folder := context.root / 'dev/shm')
    if found:
        size = sum(each.bytes for each in found)
        yield warning(
            'sockets.orphans',
            f'killed processes have left {size / 1e6:.0f} MB in {folder} ({len(found)} segments)',
            'Fast DDS frees its shared memory only if a process exits normally',
            'shadowhound-data doctor --fix  # the node frees it as well when it starts',
            fix=('segments', str(folder)),
            segments=len(found),
            bytes=size,
        )
    if stuck := settle(folder, dry_run=True):
        yield warning(
            'sockets.ports',
            f'leftovers of killed processes in {folder} can block others: {", ".join(stuck)}',
            'they mark a message as being processed, or a port as being created, and Fast DDS may wait forever for that',
            'shadowhound-data doctor --fix  # the node does the same when it starts; a blocked publisher then continues',
            fix=('ports', str(folder)),
            ports=stuck,
        )
    try:
        disk = os.statvfs(context.root / 'dev/shm')
    except OSError:
        return
    free = disk.f_bavail * disk.f_frsize
    if free < ENOUGH_SHM:
        yield warning(
            'sockets.memory',
            f'/dev/shm has {free >> 20} MB free',  # noqa: S108 - it is only named
            'Fast DDS shares memory there; docker gives 64 MB by default',
            'fastdds shm clean ; in a container: --ipc=host or --shm-size=1g',
            free_bytes=free,
            driver=bool(driver),
        )


def _user(driver: list[Process]) -> Iterator[Result]:
    others = [each for each in driver if each.uid != os.getuid()]
    if others:
        yield warning(
            'sockets.user',
            f'the driver (process {others[0].pid}) runs as user {others[0].uid}, this shell as {os.getuid()}',
            'Fast DDS shares memory within one user only: it finds the other process but delivers nothing',
            'run the node as the same user: User= in shadowhound-data-logger.service',
        )


def _driver_profile(context: Context, driver: list[Process]) -> Iterator[Result]:
    """Check the driver's profile: the segment belongs to the publisher."""
    without = [each for each in driver if each.environ and not any(each.environ.get(name) for name in PROFILE_FILES)]
    if without and any(context.environ.get(name) for name in PROFILE_FILES):
        yield warning(
            'sockets.driver',
            f'the driver (process {without[0].pid}) was started without the shared-memory profile',
            "the memory is the publisher's: setting it only here changes nothing",
            f'restart the driver with: export {_variable(without[0].environ)}={PROFILE_FILE}',
        )


def _variable(environ: Mapping[str, str]) -> str:
    """The variable that names the profile for the Fast DDS version of this environment."""
    return PROFILE_FILES[environ.get('ROS_DISTRO') not in {'humble', 'iron', 'jazzy'}]
