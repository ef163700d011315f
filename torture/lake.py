"""Ingests, compacts and queries a lake while robots deliver rows and processes are killed: every row must be there exactly once.

An embedded Tower with a bucket ``lake``; a writer delivers row files of several robots, some rows twice. Two ingesters add
them, merge files and expire row files; each is killed (SIGKILL) at random moments and restarted, and the S3 server is stopped
and started. A reader queries all the time: every row delivered before its query started must be in the answer, and no row
twice. At the end the tables alone must have everything delivered.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import boto3
from lake.making import NOON_NS, add_part, row
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest
from shadowhound_data_logger.lake.tables import OBJECT_ROWS, Tables, answer, engine
from shadowhound_data_logger.stores import open_store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop

KILLS: Final = 100
SHORT_KILLS: Final = 12
ROBOTS: Final = ('thor', 'tachi', 'odin')
ROWS: Final = 12
REPEATED: Final = 3
"""Rows of the previous file that each file repeats."""
EXPIRE_S: Final = 20.0
SERVER_EVERY: Final = 10
"""After this many kills the server is stopped for a moment, too."""
INGESTER: Final = """
import sys, time
from datetime import timedelta
from shadowhound_data_logger.lake.bucket import default_source
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest, maintain
from shadowhound_data_logger.lake.tables import OBJECT_ROWS, Tables, answer, engine
from shadowhound_data_logger.core.errors import DataLoggerError
source = default_source()
while True:
    try:
        tables = Tables.for_ingest(source)
        ingest(source, tables, Findings())
        maintain(source, tables, Findings(), grace=timedelta(seconds=float(sys.argv[1])))
    except DataLoggerError as error:
        print(error, file=sys.stderr)
        time.sleep(0.5)
"""


class Writer(threading.Thread):
    """Delivers row files of all robots until it is stopped."""

    def __init__(self, tower: Tower, folder: Path) -> None:
        super().__init__(name='writer')
        self._tower = tower
        self._folder = folder
        self.over = threading.Event()
        self.delivered: list[str] = []
        """Keys of objects whose rows are in the store; it only grows."""

    def run(self) -> None:
        before: dict[str, list[catalog.Row]] = {}
        number = 0
        with closing(open_store(self._tower.store_settings(), UploadSettings())) as store:
            while not self.over.is_set():
                robot = ROBOTS[number % len(ROBOTS)]
                start_ns = NOON_NS + number * 60 * SECOND
                rows = [row('camera', start_ns + second * SECOND, robot) for second in range(ROWS)]
                try:
                    add_part(store, [*before.get(robot, [])[-REPEATED:], *rows], f'part{number:06d}', self._folder / robot)
                except DataLoggerError:  # the server is stopped: a robot retries, too
                    time.sleep(0.2)
                    continue
                before[robot] = rows
                self.delivered += [each['key'] for each in rows]
                number += 1


class Campaign:
    """The killed processes, and the problems found."""

    def __init__(self, folder: Path, kills: int, seed: int) -> None:
        self._folder, self._kills, self._rng = folder, kills, random.Random(seed)
        self._others: list[subprocess.Popen[bytes]] = []
        self.queries = self.absent = self.twice = 0
        self.interrupted = 0
        """Queries that ended with an error because the server was stopped."""

    def run(self) -> tuple[Check, ...]:
        with Tower(self._folder / 'tower') as tower:
            self._make_buckets(tower)
            os.environ.update(tower.environment(), SHADOWHOUND_HOME=str(self._folder / 'home'))
            source = Bucket(tower.store_settings(), catalog.BUCKET)
            Tables.for_ingest(source)
            writer = Writer(tower, self._folder / 'work')
            writer.start()
            try:
                self._others = [self._ingester() for _ in range(2)]
                for number in range(1, self._kills + 1):
                    self._query(source, writer, self._rng.uniform(0.3, 2.0))
                    self._kill_one()
                    if number % SERVER_EVERY == 0:
                        tower.stop_s3()
                        time.sleep(self._rng.uniform(0.2, 1.5))
                        tower.start_s3()
                    progress(f'{number} of {self._kills} kills, {len(writer.delivered):,} rows, {self.queries} queries')
            finally:
                writer.over.set()
                writer.join()
                for other in self._others:
                    other.kill()
                    other.wait()
            return self._bars(source, writer)

    def _query(self, source: Bucket, writer: Writer, seconds: float) -> None:
        """Query repeatedly for this long."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            before = list(writer.delivered)
            try:
                found = Counter(lake.objects(source, columns=('key',))['key'].to_pylist())
            except DataLoggerError:
                self.interrupted += 1
                continue
            self.queries += 1
            self.absent += sum(key not in found for key in before)
            self.twice += sum(count > 1 for count in found.values())

    def _kill_one(self) -> None:
        place = self._rng.randrange(len(self._others))
        self._others[place].kill()
        self._others[place].wait()
        self._others[place] = self._ingester()

    def _ingester(self) -> subprocess.Popen[bytes]:
        with (self._folder / 'ingester.log').open('ab') as log:
            return subprocess.Popen([sys.executable, '-c', INGESTER, str(EXPIRE_S)], stdout=log, stderr=log)

    @staticmethod
    def _make_buckets(tower: Tower) -> None:
        settings = tower.store_settings()
        client = boto3.client('s3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
                              aws_secret_access_key=settings.secret_access_key, region_name=settings.region)  # fmt: skip
        for name in (catalog.BUCKET, 'lake'):
            client.create_bucket(Bucket=name)
        client.close()

    def _bars(self, source: Bucket, writer: Writer) -> tuple[Check, ...]:
        tables = Tables.for_ingest(source)
        ingest(source, tables, Findings())
        with engine({'objects': tables.open(OBJECT_ROWS)}) as ready:
            found = Counter(answer(ready, 'SELECT key FROM objects')['key'].to_pylist())
        expected = Counter(writer.delivered)
        lost, more = sum((expected - found).values()), sum((found - expected).values())
        return (
            Check(f'{self.queries} queries were answered', self.queries > 0, f'{self.interrupted} ended with an error'),
            Check('no query lacks a row', not self.absent, str(self.absent or '')),
            Check('no query sees a row twice', not self.twice, str(self.twice or '')),
            Check(f'the tables have all {len(writer.delivered):,} rows', not lost, str(lost or '')),
            Check('and no row twice, and no other', not more, str(more or '')),
        )


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    given = parse_kills(parser('lake', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    began = time.monotonic()
    with workshop(given) as shop:
        campaign = Campaign(shop.folder, given.kills, given.seed)
        bars = campaign.run()
        shop.passed = all(bar.holds for bar in bars)
    figures = {'seed': given.seed, 'seconds': round(time.monotonic() - began), 'kills': given.kills, 'queries': campaign.queries}
    return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
