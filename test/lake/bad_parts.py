"""Row files that none of our robots would write."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final

from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.zstd import ZstdFile, compress
from shadowhound_data_logger.formats.rows import catalog

DATE: Final = '2026-10-28'


def put(settings: StoreSettings, body: bytes, name: str = 'thor_bad', robot: str = 'thor',
        of: catalog.TableSchema = catalog.OBJECTS) -> str:  # fmt: skip
    """Put it as a robot with permission for its prefix does; returns its key."""
    key = of.part_key(robot, DATE, name)
    path = settings.directory / catalog.BUCKET / key
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(body)
    return key


def lines(rows: Sequence[Mapping[str, Any]], kind: str = 'object', **changed: Any) -> bytes:
    """Row files of these rows, with some columns replaced: nothing is validated."""
    reports = [{'row': kind, **{name: value for name, value in {**row, **changed}.items() if value is not None}} for row in rows]
    return compress(''.join(f'{json.dumps(each)}\n' for each in reports).encode(), 3)


@cache
def bomb() -> bytes:
    """A gigabyte of one line in some kilobytes."""
    target = io.BytesIO()
    with ZstdFile(target, 'wb', level=3) as file:
        file.write(b'{"row":"object"')
        for _ in range(1024):
            file.write(b' ' * (1 << 20))
    return target.getvalue()


def mutated(body: bytes, rng: random.Random) -> bytes:
    """With some bytes changed, removed or added."""
    found = bytearray(body)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        place = rng.randrange(len(found) or 1)
        change = rng.randrange(4)
        if change == 0:
            found[place : place + 1] = bytes((rng.randrange(256),))
        elif change == 1:
            found[place : place + 1] = bytes((found[min(place, len(found) - 1)] ^ (1 << rng.randrange(8)),)) if found else b''
        elif change == 2:
            del found[place : place + rng.randrange(1, 9)]
        else:
            found[place:place] = rng.randbytes(rng.randrange(1, 9))
    return bytes(found)
