"""The lake: what is stored, as a catalogue of Parquet files beside the objects themselves, and how to ask it.

``lake.objects(sensor='camera', since='yesterday')`` is a Daft DataFrame (docs/lake.md). The names below load Daft when they are
used: a robot, which writes the catalogue, needs none of it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.query import missions, objects, sql, topics

__all__ = ['missions', 'objects', 'sql', 'topics']


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module('shadowhound_data_logger.lake.query'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
