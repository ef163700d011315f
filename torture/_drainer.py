"""Program of long_outage.py: uploads a spool as the node does while new objects keep arriving, and reports its progress.

``python -m torture._drainer HOME LOG`` with the environment that names the store. Each line on standard output is
``{"s": seconds, "rss_mb": ..., "delivered": ...}``; the file LOG gets a line for each object, in the order of delivery.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import IO

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings, store_settings
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.base import ObjectStore
from torture._profile import LIVE, arrivals, make, receive

TELL_EVERY_S = 0.5


class Noting:
    """A store that writes down what it was given, and when."""

    def __init__(self, store: ObjectStore, log: IO[str]) -> None:
        self._store, self._log = store, log
        self._lock = threading.Lock()

    @property
    def pace(self) -> Pace:
        return self._store.pace

    def put(self, item: SpooledObject) -> Put:
        answer = self._store.put(item)
        now_ns = time.time_ns()
        sensor = item.key.split('/')[1]
        line = json.dumps([now_ns, sensor, item.priority, item.created_ns, LIVE in item.key, item.size])
        with self._lock:
            self._log.write(line + '\n')
        return answer


def spool_profile(spool: Spool, writer: SpoolWriter, stop: threading.Event) -> None:
    """Spool the objects of the profile in real time."""
    began, number = time.monotonic(), itertools.count()
    for moment, sensor in arrivals(24 * 3600.0):
        if stop.wait(max(0.0, began + moment - time.monotonic())):
            return
        receive(spool, item := make(sensor, f'{LIVE}{next(number):06d}'))
        writer.put(item)


def rss_mb() -> float:
    lines = Path('/proc/self/status').read_text().splitlines()
    return round(int(next(line for line in lines if line.startswith('VmRSS')).split()[1]) / 1024, 1)


def main(home: str, log_path: str) -> None:
    upload = UploadSettings()
    store = open_store(store_settings(os.environ, Path(home)), upload)
    spool = Spool(Path(home, 'spool'), SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
    spool.open()
    backlog = spool.pending_count()
    stop = threading.Event()
    with Path(log_path).open('w', encoding='utf-8') as log:
        writer = SpoolWriter(spool)
        uploader = Uploader(spool, Noting(store, log), upload, writer.settle)
        writer.on_commit(spooled=uploader.wake, settled=uploader.settled)
        live = threading.Thread(target=spool_profile, args=(spool, writer, stop))
        began = time.monotonic()
        writer.open()
        uploader.open()
        live.start()
        while (delivered := uploader.status().delivered) < backlog:
            print(json.dumps({'s': round(time.monotonic() - began, 2), 'rss_mb': rss_mb(), 'delivered': delivered}), flush=True)
            time.sleep(TELL_EVERY_S)
        print(json.dumps({'s': round(time.monotonic() - began, 2), 'rss_mb': rss_mb(), 'delivered': delivered}), flush=True)
        stop.set()
        live.join()
        writer.flush(10.0)
        uploader.drain(120.0)
        uploader.close(10.0)
        writer.close(10.0)
    spool.close()
    store.close()


if __name__ == '__main__':
    main(*sys.argv[1:])
