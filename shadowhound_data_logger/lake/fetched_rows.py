"""The rows of fetched objects, kept in the folder as a robot keeps them in the bucket: the folder is a lake of its own.

So ``MissionDataset('DIR')`` needs no store any more. Rows that two fetches brought are shown once (they count as mended parts).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shadowhound_data_logger.catalogue import parts
from shadowhound_data_logger.catalogue.schema import COLUMNS
from shadowhound_data_logger.disk import replacing
from shadowhound_data_logger.errors import LakeError
from shadowhound_data_logger.keys import is_name
from shadowhound_data_logger.lake.fetched import PARTS
from shadowhound_data_logger.lake.standing import mended_key


def keep(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One part for each robot and date among rows as Daft gives them. Raises LakeError where it cannot be written.

    A row whose robot is no name is left out: anybody may have written it, and the name becomes a folder's.
    """
    plain = [
        {**{name: row[name] for name in COLUMNS}, **{name: _micros(row, name) for name in ('t_start', 't_end')}} for row in rows
    ]
    for robot, date, found in parts.by_folder(enumerate(plain)):
        if robot is None or not is_name(robot):
            continue
        ours = [row for _, row in found]
        path = folder / mended_key(robot, date, [f'{row["bucket"]}/{row["key"]} {row["t_start_ns"]}' for row in ours])
        if path.is_file():
            continue
        try:
            part = folder / PARTS / f'rows-{os.getpid()}'  # where the next fetch clears away what a kill left
            for place in (part.parent, path.parent):
                place.mkdir(parents=True, exist_ok=True)
            with replacing(path, part=part) as file:
                file.write(parts.encode(ours))
        except OSError as error:
            raise LakeError(f'{path} cannot be written: {error.strerror}', folder=str(folder)) from error


def _micros(row: Mapping[str, Any], name: str) -> int | None:
    """As a robot writes them: of what has no date there is none."""
    return None if row[name] is None else int(row[f'{name}_ns']) // 1000
