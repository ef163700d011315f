"""``lake sink`` of a million rows to a server that accepts everything immediately: the duration of our half, and its memory.

Run it as ``python bench/sink.py [--days 30] [--folder F] [--json]``: 30 days are 720 parts of an hour in a folder store, a
million rows, as in ``bench/lake.py``. The memory is that of the sending process, sampled a few times per second.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

from _proc import memory as process_memory
from _report import Bar, Report, main, progress
from lake import rows

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake.bucket import put_part
from shadowhound_data_logger.stores import open_store

HOURS: Final = 24
LIMIT_S: Final = 300.0
FLAT: Final = 1.25
"""Maximum memory of the second half, relative to the first."""
LOOK_S: Final = 0.2
PROGRAM: Final = 'from shadowhound_data_logger.cli.main import main; main()'


def fill(folder: Path, days: int) -> int:
    """The parts of these days in a folder store; returns the number of rows."""
    count = 0
    with closing(open_store(StoreSettings(directory=folder / 'store'), UploadSettings())) as store:
        for hour in range(days * HOURS):
            made = [row for minute in range(hour * 60, hour * 60 + 60) for row in rows(minute)]
            stamp = utc(made[0]['t_start_ns'])
            key = catalog.OBJECTS.part_key('thor', f'{stamp:%Y-%m-%d}', f'{stamp:%Y%m%dT%H}0000_b007')
            put_part(store, key, 'thor', parts.encode(made), len(made))
            count += len(made)
            if hour % HOURS == HOURS - 1:
                progress(f'{hour + 1:,} parts, {count:,} rows')
    return count


def run(url: str, folder: Path) -> tuple[float, list[float], dict[str, Any]]:
    """Seconds, its private memory (MB), and its output."""
    environ = {'SHADOWHOUND_HOME': str(folder), 'PATH': '/usr/bin:/bin'}
    began = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, '-c', PROGRAM, 'lake', 'sink', url, '--json'], env=environ, stdout=subprocess.PIPE
    ) as child:
        memory: list[float] = []
        done = threading.Event()

        def poll() -> None:
            while not done.wait(LOOK_S):
                memory.append(process_memory(child.pid).anon)

        watcher = threading.Thread(target=poll, name='memory')
        watcher.start()
        assert child.stdout is not None
        reported = child.stdout.read()
        took = time.perf_counter() - began
        done.set()
        watcher.join()
    return took, memory, json.loads(reported)


class AcceptAll(BaseHTTPRequestHandler):
    """Answers like a server with empty indexes, and only reads the lines."""

    protocol_version = 'HTTP/1.1'

    def _serve(self) -> None:
        body = self.rfile.read(int(self.headers.get('Content-Length', 0)))
        told: Any = {'acknowledged': True}
        if self.path == '/_bulk':
            told = {'errors': False, 'items': [{'create': {'status': 201}}] * (body.count(b'\n') // 2)}
        elif self.path.endswith('/_settings'):
            told = {name: {'settings': {'index': {'uuid': name}}} for name in self.path.split('/')[1].split(',')}
        elif self.path == '/':
            told = {'version': {'number': '3.0.0', 'distribution': 'opensearch'}}
        content = json.dumps(told).encode()
        self.send_response(200)
        self.send_header('Content-Length', str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    do_GET = do_PUT = do_POST = _serve  # noqa: N815 - as the library calls them

    def log_message(self, *_: Any) -> None:
        """Suppresses the log."""


@contextmanager
def accepting_server() -> Iterator[str]:
    """Such a server, in a thread of this process."""
    server = ThreadingHTTPServer(('127.0.0.1', 0), AcceptAll)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, name='taking')
    thread.start()
    try:
        yield f'http://127.0.0.1:{server.server_port}'
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def measure(options: argparse.Namespace) -> Report:
    """Send everything once, then again what is already there."""
    shutil.rmtree(options.folder / 'sink_home', ignore_errors=True)
    home = options.folder / 'sink_home'
    home.mkdir(parents=True)
    count = fill(home, options.days)
    with accepting_server() as url:
        took, memory, reported = run(url, home)
        again_s, _, again = run(url, home)
    half = len(memory) // 2
    growth = max(memory[half:]) / max(memory[:half])
    figures = {
        'rows': count, 'added': reported['added'], 'seconds': took, 'rows_per_s': count / took, 'again_s': again_s,
        'again_added': again['added'], 'memory_mb': max(memory), 'memory_growth': growth,
    }  # fmt: skip
    limit_s = LIMIT_S * count / 1_000_000
    wrong = abs(reported['added'] - count) + again['added']
    return Report((
        Bar('all rows sent', f'at most {limit_s:.0f}', took, 's', took <= limit_s),
        Bar('memory of the second half, of the first', f'at most {FLAT}', growth, 'times', growth <= FLAT),
        Bar('documents missing, or sent as new again', '0', wrong, 'documents', wrong == 0),
    ), figures)  # fmt: skip


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--days', type=int, default=30)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0.0, more=_more)
