"""Many bad days, each with a seed: in virtual time, or over real sockets to a real server."""

from __future__ import annotations

import logging
import os
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from faults import live_day, simulated_day
from faults.report import Report, Summary
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.stores.s3 import S3Store

MEMORY: Final = Path('/dev/shm')  # noqa: S108 - folders with random names are made in it
Tell = Callable[[str], None]


def simulated(seeds: Iterable[int], tell: Tell = lambda _: None) -> Summary:
    """Days in virtual time."""
    return _days(seeds, lambda seed, folder: simulated_day.Day(seed, folder).run(), tell)


def live(seeds: Iterable[int], tower: Tower, tell: Tell = lambda _: None) -> Summary:
    """Days over real sockets, with a shared bucket on the server."""
    settings = tower.store_settings()
    direct = S3Store(settings, UploadSettings())
    direct.open()
    try:
        return _days(seeds, lambda seed, folder: live_day.Day(seed, folder, settings, direct).run(), tell)
    finally:
        direct.close()


def _days(seeds: Iterable[int], run: Callable[[int, Path], Report], tell: Tell) -> Summary:
    """Run all of them, even if one fails."""
    summary = Summary()
    with _quiet():
        for seed in seeds:
            with tempfile.TemporaryDirectory(dir=MEMORY if os.access(MEMORY, os.W_OK) else None) as folder:
                try:
                    summary.add(run(seed, Path(folder)))
                except Exception as error:  # noqa: BLE001 - whatever it is, the seed is the finding
                    place = traceback.extract_tb(error.__traceback__)[-1]
                    summary.failures[seed] = f'{type(error).__name__} in {place.name} line {place.lineno}: {error}'
                    tell(f'seed {seed}: {summary.failures[seed]}')
    return summary


@contextmanager
def _quiet() -> Iterator[None]:
    """Outages are intended here and need not be logged."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)
