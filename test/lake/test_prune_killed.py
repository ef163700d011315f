"""``lake prune`` against a real server: killed repeatedly, with concurrent readers, a compaction and another prune."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from e2e.processes import until
from faults.front import Front
from faults.kinds import Fault
from faults.upstream import Request
from lake.making import DAY_NS, add, add_part, content, row

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.prune import forgotten
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower

ROBOT = 'pruned'
KEPT_DAYS = 4
A_DAY = 60
"""Objects of a sensor."""
KILLS = 5
MAIN = (sys.executable, '-m', 'shadowhound_data_logger.cli.main')


class Counting(Front):
    """Passes on so many deletions and then answers nothing more."""

    def __init__(self, url: str) -> None:
        super().__init__(url, lambda: Fault.HUNG if self.deleted >= self.limit else Fault.NONE)
        self.limit, self.deleted = sys.maxsize, 0

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        self.deleted += request.method == 'DELETE'
        return super().forward(request, slowly=slowly)


def command(tower: Tower, *arguments: str, url: str = '') -> subprocess.Popen[str]:
    environ = {**os.environ, **tower.environment(), **({'AWS_ENDPOINT_URL': url} if url else {})}
    return subprocess.Popen([*MAIN, *arguments], env=environ, text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE)  # fmt: skip


def ended(processes: Sequence[subprocess.Popen[str]]) -> list[str]:
    """The output of each, after all have succeeded."""
    said = [process.communicate(timeout=240) for process in processes]
    for process, (out, err) in zip(processes, said, strict=True):
        assert process.returncode == 0, f'{process.args}: {out}{err}'
    return [out for out, _ in said]


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('kills')
def test_killed_during_reads_a_compaction_and_another_prune(seaweed: Tower, tmp_path: Path) -> None:
    """In the end exactly what the rule names is deleted, with one row each; concurrent readers can read all the rest."""
    now_ns, chance = time.time_ns(), random.Random(7)
    ages = range(10)
    rows: dict[str, catalog.Row] = {}
    with closing(open_store(seaweed.store_settings(), UploadSettings())) as store:
        for age in ages:
            begin_ns = now_ns - age * DAY_NS - 6 * 3600 * SECOND
            of_day = [row(sensor, begin_ns + number * SECOND, ROBOT) for number in range(A_DAY) for sensor in ('camera', 'odom')]
            for each in of_day:
                add(store, tmp_path / 'bodies', each['key'], content(each['sensor'], each['t_start_ns']))
            add_part(store, of_day, f'day{age}', tmp_path / 'bodies')
            rows |= {each['key']: each for each in of_day}
    source = Bucket(seaweed.store_settings(), catalog.BUCKET)
    since_ns = now_ns - KEPT_DAYS * DAY_NS
    going = {key for key, each in rows.items() if each['sensor'] == 'camera' and each['t_start_ns'] < since_ns}
    assert len(going) == 6 * A_DAY

    def there() -> set[str]:
        return {info.key for info in source.list(f'{ROBOT}/') if info.key in rows}

    prune = ('lake', 'prune', '--keep', f'camera {KEPT_DAYS}d', '--yes', '--robot', ROBOT)
    with Counting(seaweed.endpoint_url) as front:
        for kill in range(KILLS):
            front.limit = front.deleted + 1 + chance.randrange(A_DAY)
            with command(seaweed, *prune, url=front.url) as process:
                until(lambda: front.deleted >= front.limit and front.is_quiet, f'the prune {kill} deletes')
                process.send_signal(signal.SIGKILL)
    assert 0 < len(rows) - len(there()) < len(going), 'it was killed in the middle of its work'
    reader = command(seaweed, 'fetch', '--robot', ROBOT, '--since', f'{KEPT_DAYS - 1}d', '--to', str(tmp_path / 'fetched'))
    ended([reader, command(seaweed, *prune), command(seaweed, *prune), command(seaweed, 'lake', 'ingest')])
    ended([command(seaweed, *prune)])
    assert rows.keys() - there() == going
    young = {key for key, each in rows.items() if each['t_start_ns'] >= now_ns - (KEPT_DAYS - 1) * DAY_NS}
    fetched = {str(path.relative_to(tmp_path / 'fetched')): path for path in (tmp_path / 'fetched').rglob('*_x.*')}
    assert fetched.keys() >= young
    for key in young:
        assert fetched[key].read_bytes() == content(rows[key]['sensor'], rows[key]['t_start_ns'])
    told = Counter(each['key'] for each in forgotten(source, ROBOT, Findings()).to_pylist())
    assert told == Counter(dict.fromkeys(going, 1))
    (asked,) = ended([command(seaweed, 'query', '--robot', ROBOT, '--since', '20d', '--json')])
    answer: list[dict[str, Any]] = json.loads(asked)
    assert {each['key'] for each in answer} == there()
