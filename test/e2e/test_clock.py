"""A robot that starts in 1970 and gets the time later: objects stored before that are dated then, also after a restart."""

from __future__ import annotations

import calendar
import json
import os
import shutil
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from e2e.bag_reading import bags
from e2e.processes import HERE, Node, Processes, until
from e2e.reading import STRING, Objects, texts

from shadowhound_data_logger.stores.directory import DirectoryStore

PARAMETERS = {
    'sensors': ['talk', 'slow'], 'talk.topics': ['talk'], 'talk.types': [STRING], 'talk.rate_hz': 0.0, 'talk.batch_s': 0.2,
    'slow.topics': ['slow'], 'slow.types': [STRING], 'slow.rate_hz': 20.0,
}  # fmt: skip
GROUP = 40
SECOND = 10**9
RIGHT_NS = SECOND
"""The required accuracy of a date."""


class Robot:
    """A node with a clock in 1970 until it is set."""

    def __init__(self, processes: Processes, folder: Path) -> None:
        self._processes = processes
        self._behind = folder / 'behind'
        self._behind.write_text(str(time.time_ns() - 60 * SECOND))
        shutil.copy(HERE / 'wrong_clock.py', folder / 'sitecustomize.py')
        path = os.pathsep.join(filter(None, (str(folder), os.environ.get('PYTHONPATH'))))
        self._environ = {'PYTHONPATH': path, 'WRONG_CLOCK': str(self._behind)}
        self.publisher = processes.publisher()
        self.publisher.create('/talk', STRING)
        self.publisher.create('/slow', STRING)
        self.spans: list[tuple[int, int]] = []
        self.node = self.start()

    def start(self, **parameters: Any) -> Node:
        self.node = self._processes.node(None, {**PARAMETERS, **parameters}, environ=self._environ)
        for topic in ('/talk', '/slow'):
            self.publisher.matched(topic)
        return self.node

    def publish(self) -> None:
        """Publish the next group on both topics."""
        numbers = range(len(self.spans) * GROUP, len(self.spans) * GROUP + GROUP)
        began_ns = time.time_ns()
        self.publisher.publish('/talk', texts(numbers))
        self.publisher.publish('/slow', texts(numbers))
        self.spans.append((began_ns, time.time_ns()))
        for topic in ('/talk', '/slow'):
            self.node.received(topic, len(self.spans) * GROUP)
            until(lambda topic=topic: not self.node.topic(topic)['open'], f'{topic} is stored')  # type: ignore[misc]

    def set_clock(self) -> None:
        self._behind.unlink()

    def settled(self) -> None:
        """Wait until nothing is held, open or pending."""
        for topic in ('/talk', '/slow'):
            self.node.settled(topic, len(self.spans) * GROUP)
        until(lambda: not self.node.ledger()['objects']['held'], 'nothing is held')
        self.node.delivered()

    def objects(self) -> Objects:
        store = DirectoryStore(self.node.home / 'store')
        store.open()
        return Objects.of(store, 'sensor-data', self.node.robot)

    def clocks_of(self, sensor: str) -> set[str]:
        """The sources of the dates in its objects."""
        with closing(DirectoryStore(self.node.home / 'store')) as store:
            store.open()
            found = store.list('sensor-data', f'{self.node.robot}/{sensor}/')
            infos = [store.head('sensor-data', info.key) for info in found]
        return {info.metadata['clock'] for info in infos if info}

    def keys(self) -> list[str]:
        folder = self.node.home / 'store' / 'sensor-data'
        return [str(path.relative_to(folder)) for path in folder.rglob('*') if path.is_file()]


@pytest.fixture
def robot(processes: Processes, tmp_path: Path) -> Robot:
    folder = tmp_path / 'clock'
    folder.mkdir()
    return Robot(processes, folder)


@pytest.mark.long('a second of CPU or more')
def test_objects_are_dated_when_the_clock_is_set(robot: Robot) -> None:
    """Nothing is stored under a date of 1970, everything under the correct one, and the ledger reports the clock's steps."""
    robot.publish()
    robot.node.stop()
    robot.start()
    robot.publish()
    until(lambda: robot.node.topic('/talk')['stored_in']['held'] >= 2, 'objects are held')
    assert [robot.node.topic(topic)['stored_in']['delivered'] for topic in ('/talk', '/slow')] == [0, 0]
    robot.set_clock()
    robot.publish()
    robot.settled()
    ledger = robot.node.stop()
    assert ledger['objects']['held'] == 0
    assert (ledger['clock']['is_set'], ledger['clock']['steps'], ledger['clock']['held']) == (True, 1, 0)
    keys = [key for key in robot.keys() if '/_' not in key]  # noqa: SIM118 - not the method of a dict
    today = {time.strftime('%Y%m%d', time.gmtime(when / SECOND)) for span in robot.spans for when in span}
    assert {key.split('/')[2] for key in keys} == today
    assert not [key for key in keys if '1970' in key or '_unsynced' in key]
    check_dates(robot, robot.objects())
    assert 'set_later' in robot.clocks_of('_ledger'), 'that of the stop in 1970'


@pytest.mark.long('ten seconds of a clock that is not set')
def test_bags_are_dated_when_the_clock_is_set(robot: Robot, tmp_path: Path) -> None:
    """Each has its start date, also one that ended before the date was known; none spans the change, nothing is lost."""
    robot.node.stop()
    began_ns = [time.time_ns()]
    robot.start(**{'bag.record': 'always'})
    robot.publish()
    first = robot.node.stop()['bags']['/talk']
    assert (first['stored'], first['open']) == (0, GROUP)
    began_ns.append(time.time_ns())
    robot.start(**{'bag.record': 'always'})
    robot.publish()
    until(
        lambda: {row['received'] for row in robot.node.ledger()['bags'].values()} == {2 * GROUP}, 'the bag has what was published'
    )
    robot.set_clock()
    began_ns.append(time.time_ns())
    until(lambda: robot.node.log.count('recording bag ') == 2, 'the next bag has begun')
    robot.publish()
    ledger = robot.node.stop()
    assert {row['open'] for row in ledger['bags'].values()} == {0}
    assert ledger['bags']['/talk']['stored'] == ledger['bags']['/slow']['stored'] == 3 * GROUP
    with closing(DirectoryStore(robot.node.home / 'store')) as store:
        store.open()
        found = bags(store, robot.node.robot, tmp_path / 'bags')
    assert [bag.check() for bag in found] == [{'/talk': GROUP, '/slow': GROUP}] * 3
    for bag, early_ns, span in zip(found, began_ns, robot.spans, strict=True):
        clock = bag.manifest['clock']
        assert (clock is None) == (bag is found[-1])
        time_in_name = calendar.timegm(time.strptime(bag.folder.name, 'recording_%Y%m%d_%H%M%S')) * SECOND
        assert early_ns - 2 * SECOND <= time_in_name <= span[0]
        for message in bag.messages():
            assert span[0] - RIGHT_NS <= message.log_ns + (clock['offset_ns'] if clock else 0) <= span[1] + RIGHT_NS
    assert not list((robot.node.home / 'bags' / robot.node.robot).iterdir())


def check_dates(robot: Robot, objects: Objects) -> None:
    """Each message's time, as the metadata of its object dates it, is that of its group."""
    found: dict[int, int] = {}
    for key, info in objects.infos.items():
        report = info.metadata
        start_ns, end_ns = int(report['t_start_ns']), int(report['t_end_ns'])
        assert key.split('/')[3].startswith(time.strftime('%H%M%S', time.gmtime(start_ns / SECOND)))
        assert start_ns - int(report['boot_start_ns']) == pytest.approx(end_ns - int(report['boot_end_ns']), abs=RIGHT_NS)
        assert start_ns - int(report['boot_start_ns']) == pytest.approx(offset_ns(), abs=RIGHT_NS)
        if key.split('/')[1] == 'talk':
            for sample in json.loads(objects.contents[key])['samples']:
                found[int(sample['data'])] = sample['stamp_ns'] + int(report.get('clock_offset_ns', 0))
    assert sorted(found) == list(range(len(robot.spans) * GROUP))
    for number, stamp_ns in found.items():
        began_ns, ended_ns = robot.spans[number // GROUP]
        assert began_ns - RIGHT_NS <= stamp_ns <= ended_ns + RIGHT_NS


def offset_ns() -> int:
    return time.time_ns() - time.clock_gettime_ns(time.CLOCK_BOOTTIME)
