"""Makes the node's threads crash on request: copied as sitecustomize.py to a folder on Python's path.

A file ``NAME.round`` in the folder ORDERS makes the next round of that worker raise SystemExit, ``NAME.thread`` ends its thread
permanently. The file is renamed to ``.done``, and contains the boot clock of that moment in ns. ``main.round`` is the main loop.
"""

import os
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.node.pipeline import Pipeline

orders = Path(os.environ['ORDERS'])
clock = SystemClock.of_this_machine()
make, tick = Worker.__init__, Pipeline.tick


def obey(name: str) -> str | None:
    """The requested crash, if any."""
    for way in ('round', 'thread'):
        order = orders / f'{name}.{way}'
        if order.exists():
            order.write_text(str(clock.boot_ns()))
            order.rename(order.with_suffix(f'.{way}.done'))
            return way
    return None


def make_mortal(worker: Worker, name: str, step: Any, **options: Any) -> None:
    def mortal() -> None:
        way = obey(name)
        if way:
            if way == 'thread':
                worker._fail = without_memory  # type: ignore[method-assign]
            raise SystemExit(f'on order of {name}')
        step()

    def without_memory(*_: Any) -> None:
        del worker._fail  # type: ignore[misc]
        raise MemoryError(f'on order of {name}')

    make(worker, name, mortal, **options)


def mortal_tick(pipeline: Pipeline) -> None:
    if obey('main'):
        raise SystemExit(0)
    tick(pipeline)


Worker.__init__ = make_mortal  # type: ignore[method-assign]
Pipeline.tick = mortal_tick  # type: ignore[method-assign]
