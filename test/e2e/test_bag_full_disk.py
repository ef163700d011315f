"""The disk is really full while the node records: the intake goes on, what is lost has a reason, and the bag goes on after it."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from e2e.bag_reading import bags, in_slice
from e2e.processes import Processes, published, until
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.spool.retention import NO_ROOM
from shadowhound_data_logger.stores.s3 import S3Store

MEBI = 1 << 20
FULL_S = 3.0

pytestmark = pytest.mark.long('fills a disk for some seconds')


@pytest.fixture
def disk(processes: Processes) -> Iterator[Path]:
    """A file system of its own; gone before the processes' folder is."""
    path = processes.folder / 'disk'
    path.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', f'size={64 * MEBI}', 'none', str(path)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip('this user may not mount a file system')
    yield path
    subprocess.run(['umount', '--lazy', str(path)], check=True)


def fill(path: Path, seconds: float) -> None:
    """Take whatever is free, again and again."""
    end_s = time.monotonic() + seconds
    with path.open('ab', buffering=0) as file:
        while time.monotonic() < end_s:
            try:
                file.write(bytes(4096))
            except OSError:
                time.sleep(0.001)


def test_a_disk_that_is_full_for_a_while_costs_the_messages_of_that_time(
    processes: Processes, disk: Path, seaweed: Tower, tmp_path: Path
) -> None:
    """Nothing crashes, what was written before can be read at any moment, manifest and ledger name what is missing."""
    parameters = {'bag.record': 'always', 'bag.slice_s': 60.0, 'spool.min_free_bytes': 8 * MEBI}
    node = processes.node(seaweed.environment(), parameters, home='disk/home')
    sim = processes.sim('image_raw:=false')
    node.received('/imu', 150)
    before = node.topic('/imu')['received']
    filler = disk / 'filler'
    fill(filler, FULL_S)
    whole = []
    for path in (node.home / 'bags' / node.robot).glob('*/*.open'):
        recover(Path(shutil.copy(path, tmp_path)))
        whole.append(list(in_slice(tmp_path / path.name.removesuffix('.open'))))
    spooled = [list(in_slice(path)) for path in node.home.glob('spool/ready/*/*/rosbags/*/*.mcap')]
    assert all(whole), 'an open slice has what was written'
    assert node.popen.poll() is None
    filler.unlink()
    until(lambda: node.topic('/imu')['received'] >= before + FULL_S * 40, 'the intake went on')
    until(lambda: node.ledger()['bags']['/imu']['dropped'], 'the ledger says why')
    until(lambda: 'recording continues' in node.log, 'the recording continues')
    until(lambda: node.ledger()['bags']['/imu']['received'] > before + 300, 'more is recorded')
    sim.signal(2)
    said = published(sim)
    ledger = node.stop()
    assert node.log.count('nothing is recorded while the disk accepts no writes') == 1
    store = S3Store(seaweed.store_settings(), UploadSettings())
    store.open()
    try:
        (bag,) = bags(store, processes.robot, tmp_path / 'bags')
    finally:
        store.close()
    counts = bag.check()
    assert bag.manifest['state'] == 'gaps'
    missing = Counter[str]()
    for lost in bag.manifest['missing']:
        assert lost['reason'] == NO_ROOM
        missing[lost['topic']] += lost['messages']
    for topic, row in ledger['bags'].items():
        assert (row['published'], row['missed'], row['open']) == (said[topic], 0, 0)
        assert row['received'] == counts[topic] + missing[topic] == row['stored'] + sum(row['dropped'].values())
        assert set(row['dropped']) <= {NO_ROOM}
    last = [each.sequence for each in in_slice(bag.slices[-1]) if each.topic == '/imu']
    assert last == list(range(last[0], said['/imu'] + 1)), 'nothing was lost once there was room again'
    assert whole or spooled
