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
"""Of what is being recorded, in SHADOWHOUND_HOME."""
RECORDING: Final = 'recording'
"""What a bag of no mission is called by."""
UNSYNCED: Final = '_unsynced_'
"""Stands in the name of a bag that has no date, or none yet."""
METADATA, MANIFEST = 'metadata.yaml', 'manifest.json'
MCAP, SQLITE, PACKED = '.mcap', '.db3', '.zstd'
"""What the names of files with messages end with; rosbag2 appends the last to one that it compressed."""
UNSAFE: Final = re.compile(r'[^A-Za-z0-9_.-]+')
"""What is replaced in the name of a folder or file that becomes part of a key."""
SLICES: Final = (MCAP, SQLITE, MCAP + PACKED, SQLITE + PACKED)


def bag_name(what: str, now_ns: int, is_taken: Callable[[str], bool]) -> str:
    """``patrol_20251018_120000``, in UTC; ``_1``, ``_2``, ... when it is taken: two bags may begin in a second.

    ``what`` is a mission's type, as it stands in the mission's own name where it cannot be part of a key.
    """
    return _free(f'{_safe(what)}_{utc(now_ns):%Y%m%d_%H%M%S}', is_taken)


def unsynced_name(what: str, boot_id: str, boot_ns: int, is_taken: Callable[[str], bool]) -> str:
    """``patrol_unsynced_<boot id>_00000012``: of a bag whose time is known by the boot clock alone, seconds since boot.

    The same is told of an object without a date (``keys.unsynced``); no other boot has the id.
    """
    return _free(f'{_safe(what)}{unsynced_mark(boot_id, boot_ns)}', is_taken)


def unsynced_mark(boot_id: str, boot_ns: int) -> str:
    """What such a name has in place of a date."""
    return f'{UNSYNCED}{boot_id}_{boot_ns // SECOND:08d}'


def _safe(what: str) -> str:
    return safe_type(what) if what else RECORDING


def _free(wanted: str, is_taken: Callable[[str], bool]) -> str:
    names = (f'{wanted}_{number}' if number else wanted for number in count())
    return next(name for name in names if not is_taken(name))


def safe_bag(name: str) -> str:
    """The nearest name that a bag in a store can have, of a folder that may have any."""
    if is_name(name, MAX_BAG_BYTES):
        return name
    return UNSAFE.sub('_', name.replace('..', '_')).strip('_.-')[:MAX_BAG_BYTES] or 'bag'


def slice_file(bag: str, number: int) -> str:
    """The name of a slice."""
    return f'{bag}_{number}.mcap'


def slice_number(bag: str, file: str) -> int | None:
    """Of ``<bag>_<N>.mcap``, whatever follows; None for another file."""
    head, found, _ = file.removeprefix(f'{bag}_').partition('.mcap')
    return int(head) if found and file.startswith(f'{bag}_') and head.isascii() and head.isdigit() else None


def prefix_of(robot: str, bag: str = '') -> str:
    """Of the keys of a robot's bags, or of one of them."""
    return f'{robot}/rosbags/{bag}/' if bag else f'{robot}/rosbags/'


def key_of(robot: str, bag: str, file: str) -> str:
    """In the bucket of the bags."""
    return f'{prefix_of(robot, bag)}{file}'


def natural(name: str) -> list[str | int]:
    """A sort key in which ``bag_10`` comes after ``bag_9``."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r'(\d+)', name, flags=re.ASCII))]
