"""Names of bags, their files and their keys: ``<robot>/rosbags/<bag>/<bag>_<N>.mcap``, as rosbag2 numbers them."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import count
from typing import Final

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, is_name
from shadowhound_data_logger.missions.folder import safe_type

BUCKET: Final = 'sensor-data'
BAGS: Final = 'bags'
"""Folder of the bags that are being recorded, in SHADOWHOUND_HOME."""
RECORDING: Final = 'recording'
"""Name prefix of a bag without a mission."""
UNSYNCED: Final = '_unsynced_'
"""Part of the name of a bag that has no date, or not yet."""
METADATA, MANIFEST = 'metadata.yaml', 'manifest.json'
MCAP, SQLITE, PACKED = '.mcap', '.db3', '.zstd'
"""Suffixes of files with messages; rosbag2 appends the last one to a file that it compressed."""
UNSAFE: Final = re.compile(r'[^A-Za-z0-9_.-]+')
"""Characters that are replaced in names that become part of a key."""
SLICES: Final = (MCAP, SQLITE, MCAP + PACKED, SQLITE + PACKED)


def bag_name(what: str, now_ns: int, is_taken: Callable[[str], bool]) -> str:
    """``patrol_20251018_120000``, in UTC, with ``_1``, ``_2``, ... appended if taken: two bags may start in the same second.

    ``what`` is a mission's type; characters that are invalid in a key are replaced as in the mission's own name.
    """
    return _free(f'{_safe(what)}_{utc(now_ns):%Y%m%d_%H%M%S}', is_taken)


def unsynced_name(what: str, boot_id: str, boot_ns: int, is_taken: Callable[[str], bool]) -> str:
    """``patrol_unsynced_<boot id>_00000012``: the name of a bag whose time is only known in seconds since boot.

    Objects without a date have the same form (``keys.unsynced``). The boot id is unique.
    """
    return _free(f'{_safe(what)}{unsynced_mark(boot_id, boot_ns)}', is_taken)


def unsynced_mark(boot_id: str, boot_ns: int) -> str:
    """The part of such a name that replaces the date."""
    return f'{UNSYNCED}{boot_id}_{boot_ns // SECOND:08d}'


def _safe(what: str) -> str:
    return safe_type(what) if what else RECORDING


def _free(wanted: str, is_taken: Callable[[str], bool]) -> str:
    names = (f'{wanted}_{number}' if number else wanted for number in count())
    return next(name for name in names if not is_taken(name))


def safe_bag(name: str) -> str:
    """A valid bag name for a folder with any name, changed as little as possible."""
    if is_name(name, MAX_BAG_BYTES):
        return name
    return UNSAFE.sub('_', name.replace('..', '_')).strip('_.-')[:MAX_BAG_BYTES] or 'bag'


def slice_file(bag: str, number: int) -> str:
    """The name of a slice."""
    return f'{bag}_{number}.mcap'


def slice_number(bag: str, file: str) -> int | None:
    """The number N of ``<bag>_<N>.mcap``, with any suffix; None for other files."""
    head, found, _ = file.removeprefix(f'{bag}_').partition('.mcap')
    return int(head) if found and file.startswith(f'{bag}_') and head.isascii() and head.isdigit() else None


def prefix_of(robot: str, bag: str = '') -> str:
    """The key prefix of a robot's bags, or of one bag."""
    return f'{robot}/rosbags/{bag}/' if bag else f'{robot}/rosbags/'


def key_of(robot: str, bag: str, file: str) -> str:
    """The key of a bag's file."""
    return f'{prefix_of(robot, bag)}{file}'


def natural_key(name: str) -> list[str | int]:
    """A sort key in which ``bag_10`` comes after ``bag_9``."""
    return [int(part) if index % 2 else part for index, part in enumerate(re.split(r'(\d+)', name, flags=re.ASCII))]
