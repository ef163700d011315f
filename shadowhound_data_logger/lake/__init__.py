"""The lake: Delta tables of all stored objects, built from the rows that robots write, and queries over them (docs/lake.md).

``lake.objects(sensor='camera', since='yesterday')`` returns a pyarrow table; ``lake.MissionDataset`` is a dataset to train on;
``lake.known('thor', '/imu', '2h')`` returns what is stored of a time, what is missing and why, and what is unknown;
``lake.log_dataset(run, DIR)`` records in MLflow which dataset a model was trained on.
These names load deltalake on first use: a robot, which writes the rows, does not need it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.dataset import MissionDataset
    from shadowhound_data_logger.lake.gaps import Known, StatedGap, Stretch, known
    from shadowhound_data_logger.lake.query import missions, objects, sql, topics
    from shadowhound_data_logger.lake.samples import Near, Window
    from shadowhound_data_logger.lake.training import log_dataset

__all__ = [
    'Known', 'MissionDataset', 'Near', 'StatedGap', 'Stretch', 'Window', 'known', 'log_dataset', 'missions', 'objects', 'sql',
    'topics',
]  # fmt: skip
_MODULES = {'MissionDataset': 'dataset', 'log_dataset': 'training', 'Near': 'samples', 'Window': 'samples'}
_MODULES |= dict.fromkeys(('Known', 'StatedGap', 'Stretch', 'known'), 'gaps')


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module(f'{__name__}.{_MODULES.get(name, "query")}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
