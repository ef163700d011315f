"""A Ray cluster of two nodes in two networks returns the same from the tables as one process, also when a node is killed."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import boto3
import pytest
from e2e.machines import OTHER, ROBOT, Machines, inside
from e2e.processes import until
from lake.gap_parts import lost
from lake.making import NOON_NS, add, add_part, row
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest
from shadowhound_data_logger.lake.tables import Tables
from shadowhound_data_logger.stores import open_store

ROBOTS, SECONDS = 8, 300
PORT = 6399
HEAD = f'{ROBOT}:{PORT}'
NEAR = 6.0, 0.0, 1.5
DRIVER = Path(__file__).with_name('cluster_driver.py')
pytestmark = [
    pytest.mark.seaweedfs,
    pytest.mark.slow,
    pytest.mark.long('a Ray cluster'),
    pytest.mark.skipif(importlib.util.find_spec('ray') is None, reason='Ray is not installed here: pip install "ray[data]"'),
]


class Cluster:
    """Two nodes with one core each."""

    def __init__(self, stack: ExitStack, machines: Machines) -> None:
        self._machines = machines
        self._environ = {**os.environ, 'RAY_AUTH_MODE': 'token', 'RAY_AUTH_TOKEN': secrets.token_hex(32)}
        self._folder = tempfile.mkdtemp(prefix='ray', dir='/tmp')  # Ray's sockets need a short path
        stack.callback(shutil.rmtree, self._folder, ignore_errors=True)
        for pid in (machines.robot, machines.other):
            stack.callback(kill_all, pid)
        common = '--num-cpus=1', '--disable-usage-stats', '--object-store-memory=80000000'
        self._ray(machines.robot, 'start', '--head', f'--node-ip-address={ROBOT}', f'--port={PORT}', '--include-dashboard=false',
                  f'--temp-dir={self._folder}', *common)  # fmt: skip
        self._ray(machines.other, 'start', f'--address={HEAD}', f'--node-ip-address={OTHER}', *common)

    def _ray(self, pid: int, *arguments: str) -> None:
        command = [*inside(pid), sys.executable, '-m', 'ray.scripts.scripts', *arguments]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=self._environ)
        assert ran.returncode == 0, ran.stdout + ran.stderr

    def ask(self, table: str, options: dict[str, str], mark: Path | None = None) -> subprocess.Popen[str]:
        """The driver on the first node. With ``mark``, tasks of the second one create that file and take longer."""
        given = {'runner': HEAD, 'table': table, 'options': options, 'near': NEAR, 'mark': mark and str(mark)}
        return drive(given, inside(self._machines.robot), self._environ)


def drive(given: dict[str, Any], prefix: Sequence[str] = (), environ: dict[str, str] | None = None) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [*prefix, sys.executable, str(DRIVER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environ,
    )  # fmt: skip
    assert process.stdin is not None
    process.stdin.write(json.dumps(given))
    process.stdin.close()
    process.stdin = None
    return process


def answer(process: subprocess.Popen[str]) -> Any:
    """The last line that the driver prints."""
    output, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors[-5000:]
    return json.loads(output.splitlines()[-1])


def kill_all(pid: int) -> None:
    """Kill each other process in the network of this one."""
    network = Path(f'/proc/{pid}/ns/net').readlink()
    for each in Path('/proc').iterdir():
        with suppress(OSError):
            if each.name.isdigit() and int(each.name) != pid and (each / 'ns' / 'net').readlink() == network:
                os.kill(int(each.name), signal.SIGKILL)


@contextmanager
def relayed(listener: socket.socket, url: str) -> Iterator[str]:
    """Forward connections to that server."""
    target = urlsplit(url)
    loop = asyncio.new_event_loop()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while block := await reader.read(1 << 16):
                writer.write(block)
                await writer.drain()
        writer.close()

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(target.hostname, target.port)
        await asyncio.gather(pump(reader, back), pump(there, writer))

    async def end() -> None:
        server.close()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    server = loop.run_until_complete(asyncio.start_server(relay, sock=listener))
    thread = threading.Thread(target=loop.run_forever, name='relay')
    thread.start()
    try:
        yield f'http://{ROBOT}:{listener.getsockname()[1]}'
    finally:
        asyncio.run_coroutine_threadsafe(end(), loop).result(60)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.fixture
def source(tower: Tower, tmp_path: Path) -> tuple[Bucket, str]:
    """Rows and gaps of eight robots, and the address of their tables."""
    settings, findings = tower.store_settings(), Findings()
    keys = {'aws_access_key_id': settings.access_key_id, 'aws_secret_access_key': settings.secret_access_key}
    with closing(boto3.client('s3', endpoint_url=settings.endpoint_url, region_name=settings.region, **keys)) as client:
        for name in {'lake', BUCKET} - {each['Name'] for each in client.list_buckets()['Buckets']}:
            client.create_bucket(Bucket=name)
    with closing(open_store(settings, UploadSettings())) as store:
        for number in range(ROBOTS):
            robot = f'node-{number}'
            rows = [row(sensor, NOON_NS + second * SECOND, robot) for second in range(SECONDS) for sensor in ('camera', 'odom')]
            add_part(store, rows, 'a', tmp_path / 'tmp')
            gaps = [{**lost(str(place), place, place + 1), 'robot': robot} for place in range(number)]
            if gaps:
                add(store, tmp_path / 'tmp', GAPS.part_key(robot, '2026-10-28', 'a'), parts.encode(gaps, GAPS))
    bucket = Bucket(settings, BUCKET)
    tables = Tables.for_ingest(bucket)
    ingest(bucket, tables, findings)
    return bucket, tables.root


def test_two_nodes_answer_as_one_process(source: tuple[Bucket, str], tmp_path: Path) -> None:
    """As Daft in one process, and as ``query``; then again while the second node is killed during its work."""
    bucket, root = source
    settings = bucket.settings
    options = {'endpoint_url': settings.endpoint_url, 'key_id': settings.access_key_id, 'access_key': settings.secret_access_key,
               'region_name': settings.region}  # fmt: skip
    expected = answer(drive({'runner': None, 'table': root, 'options': options, 'near': NEAR, 'mark': None}))
    ours = query.sql("SELECT robot, count(*) AS n FROM objects WHERE robot LIKE 'node-%' GROUP BY robot ORDER BY robot", bucket)
    assert expected['objects'] == [[one['robot'], one['n']] for one in ours.to_pylist()]
    assert expected['gaps'] == [[f'node-{number}', number] for number in range(1, ROBOTS)]
    assert expected['near'] > 0
    with ExitStack() as stack:
        machines = Machines(stack)
        there = stack.enter_context(relayed(machines.listener(), str(settings.endpoint_url)))
        cluster = Cluster(stack, machines)
        options['endpoint_url'] = there
        assert answer(cluster.ask(root, options)) == expected
        mark = tmp_path / 'mark'
        asking = cluster.ask(root, options, mark)
        until(lambda: mark.exists() or asking.poll() is not None, 'the second node works')
        assert asking.poll() is None, asking.communicate()
        kill_all(machines.other)
        assert answer(asking) == expected
