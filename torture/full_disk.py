"""Fills the disk under a recording node for a minute, then breaks it: it must keep running, evict by priority, and
recover.

The spool is on a separate small file system; the store is down. First the node fills it itself and must keep the reserve of free
space; then another process writes until nothing is free at all; then there is space again. Finally, on ext4, the kernel makes it
read-only as it does after an error, and it is repaired.
"""

from __future__ import annotations

import hashlib
import random
import re
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from e2e.bag_reading import Bag, bags
from e2e.processes import Node, Processes, is_accounted, published, until
from e2e.wire import PASS, REFUSE, Wire
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.bags.objects import EVICTED
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.retention import NO_ROOM
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parser, progress, verdict, workshop
from torture._disks import MEBI, Disk, NotAllowed, inside, small_disk
from torture.kills import PARAMETERS, ROBOT, running

SIZE_MB: Final = 96
RESERVE: Final = 24 * MEBI
"""``spool.min_free_bytes``."""
WITHIN: Final = 4 * MEBI
"""How much of the reserve the index's log and one commit may use temporarily."""
FULL_S: Final = 60.0
SHORT_FULL_S: Final = 8.0
EVENTS: Final = 8
SLICE_S: Final = 3.0
RECORDED_S: Final = 300.0
"""Slices have the lowest priority: on a machine too busy to send everything that the robot publishes, they wait."""
BUCKET: Final = 'sensor-data'


@dataclass(slots=True)
class Findings:
    """What was observed during the run."""

    wrong: dict[str, list[str]] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)

    def check(self, what: str, holds: object, found: object = '') -> None:
        """It must be true at each check."""
        lines = self.wrong.setdefault(what, [])
        if not holds:
            lines.append(str(found))

    def bars(self) -> list[Check]:
        return [Check(what, not lines, '; '.join(lines[:3])) for what, lines in self.wrong.items()]


class FullDisk:
    """One node, one robot, one disk. Lifecycle: New; run once."""

    def __init__(self, processes: Processes, wire: Wire, tower: Tower, disk: Disk, seed: int) -> None:
        self._processes, self._wire, self._tower, self._disk = processes, wire, tower, disk
        self._environ = tower.environment() | {'AWS_ENDPOINT_URL': wire.url}
        self._home = disk.path / 'home'
        self._events = {f'{ROBOT}/_events/{n}.bin': random.Random(seed + n).randbytes(300_000) for n in range(EVENTS)}
        self.found = Findings()

    def run(self, full_s: float) -> Findings:
        self._protect()
        self._wire.set(REFUSE)
        node = self._node()
        sim = self._processes.sim('image_raw:=false')
        self._fills_itself(node, full_s / 2)
        self._is_filled(node, full_s)
        self._has_space_again(node)
        sim.signal(2)
        reported = published(sim)
        node.delivered(1, 120.0)
        self._at_the_end(node.stop(seconds=60.0), reported)
        if self._disk.kind == 'ext4':
            self._breaks()
        return self.found

    def _node(self) -> Node:
        parameters = PARAMETERS | {'spool.min_free_bytes': RESERVE, 'bag.record': 'always', 'bag.slice_s': SLICE_S}
        return self._processes.node(self._environ, parameters, home=str(self._home))

    def _protect(self) -> None:
        """Preserved events, as from a mission."""
        clock = SystemClock.of_this_machine()
        spool = Spool(self._home / 'spool', SpoolSettings(min_free_bytes=0), clock, ROBOT)
        spool.open()
        now_ns = clock.wall_ns()
        spool.commit([
            DataObject(bucket=BUCKET, key=key, body=body, content_type='application/octet-stream', sensor='_events', topic=None,
                       type='', samples=0, t_start_ns=now_ns, t_end_ns=now_ns, priority=9, protected=True)
            for key, body in self._events.items()
        ])  # fmt: skip
        spool.close()

    def _watch(self, node: Node, seconds: float, *, reserve: bool = False) -> int:
        """Check repeatedly; returns the minimum free space."""
        least, end = self._disk.free(), time.monotonic() + seconds
        while time.monotonic() < end:
            least = min(least, self._disk.free())
            self.found.check('the node is alive', node.popen.poll() is None, node.log[-500:])
            try:
                lines = ledger.imbalances(ledger.read(self._home / 'spool', ROBOT))
            except SpoolError as error:
                lines = [str(error)]
            self.found.check('the ledger balances at any time', not lines, lines)
            time.sleep(0.2)
        if reserve:
            self.found.check('the reserve of free space is kept', least >= RESERVE - WITHIN, f'{least / MEBI:.1f} MiB')
        return least

    def _fills_itself(self, node: Node, seconds: float) -> None:
        progress('the node fills the disk')
        until(lambda: node.ledger()['objects']['evicted'] > 0, 'something is evicted', 90.0)
        least = self._watch(node, seconds, reserve=True)
        self.found.figures['least_free_mb'] = round(least / MEBI, 1)

    def _is_filled(self, node: Node, seconds: float) -> None:
        progress('somebody else fills it')
        filler = self._disk.path / 'filler'
        end = time.monotonic() + seconds
        with filler.open('wb', buffering=0) as file:
            while time.monotonic() < end:
                try:
                    while file.write(bytes(4096)):
                        pass
                except OSError:
                    pass
                self._watch(node, 0.5)
        before = node.ledger()
        self.found.figures['filler_mb'] = round(filler.stat().st_size / MEBI, 1)
        self.found.figures['evicted_while_full'] = before['objects']['evicted']
        self.found.figures['memory_while_full_mb'] = rss_mb(node)
        filler.unlink()

    def _has_space_again(self, node: Node) -> None:
        progress('there is space again')
        began, before = time.monotonic(), node.topic('/imu')['stored']
        until(lambda: node.topic('/imu')['stored'] > before, 'it stores again', 30.0)
        self.found.figures['stores_again_after_s'] = round(time.monotonic() - began, 2)
        lines = [line for line in node.log.splitlines() if 'spool-writer failed' in line]
        self.found.check('a full disk is told at its beginning', len(lines) <= 2, lines)
        self.found.figures['log_lines'] = len(node.log.splitlines())
        self._watch(node, 2.0)
        self._wire.set(PASS)

        def is_recorded() -> bool:
            return bool(node.ledger()['bags']['/imu']['stored_in']['delivered'])

        until(is_recorded, 'a slice of after it is delivered', RECORDED_S)

    def _at_the_end(self, reported: dict[str, Any], published: dict[str, int]) -> None:
        found, objects = self.found, reported['objects']
        found.figures |= {'objects': objects, 'topics': {
            topic: {name: row[name] for name in ('published', 'received', 'missed', 'dropped', 'stored', 'stored_in')}
            for topic, row in reported['topics'].items()
        }}  # fmt: skip
        found.check('objects were evicted, and counted', objects['evicted'] > 0)
        found.check('everything else is delivered', objects['spooled'] == objects['evicted'] + objects['delivered'], objects)
        for topic, row in reported['topics'].items():
            fine = is_accounted(row['published'], published[topic]) and row['open'] == 0
            found.check('every message is accounted for', fine, (topic, f'{published[topic]} published', row))
        self._are_safe('protected objects are delivered whole')
        self._are_recorded(reported['bags'], published)

    def _are_safe(self, what: str) -> None:
        store = S3Store(self._tower.store_settings(), UploadSettings())
        store.open()
        try:
            for key, body in self._events.items():
                info = store.head(BUCKET, key)
                held = store.get(BUCKET, key) if info else b''
                self.found.check(what, hashlib.sha256(held).digest() == hashlib.sha256(body).digest(), key)
        finally:
            store.close()

    def _are_recorded(self, rows: dict[str, Any], published: dict[str, int]) -> None:
        """Each existing slice opens, and each message that is in none is in the manifest, and in the ledger."""
        store = S3Store(self._tower.store_settings(), UploadSettings())
        store.open()
        try:
            (bag,) = bags(store, ROBOT, self._processes.folder / 'bags')
        finally:
            store.close()
        self._set_aside(bag)
        counts, lost = bag.check(), Counter[str]()
        for each in bag.manifest['missing']:
            lost[each['topic'] or 'slices'] += each['messages']
        self.found.figures['bag'] = {'slices': len(bag.slices), 'messages': counts.total(), 'missing': dict(lost)}
        self.found.check('the bag says that it has gaps', bag.manifest['state'] == 'gaps', bag.manifest['state'])
        self.found.check('the bag went on after it', bag.slices)
        for topic, row in rows.items():
            dropped = sum(row['dropped'].values())
            fine = is_accounted(row['published'], published[topic]) and row['open'] == 0 and set(row['dropped']) <= {NO_ROOM}
            self.found.check('every message of the bag is accounted for', fine, (topic, f'{published[topic]} published', row))
            in_store = row['stored'] - row['stored_in']['evicted']
            fine = (counts[topic], lost[topic]) == (in_store, dropped)
            self.found.check('bag, manifest and ledger agree', fine, (topic, counts[topic], lost[topic], row))
        evicted = sum(row['stored_in']['evicted'] for row in rows.values())
        self.found.check('bag, manifest and ledger agree', lost['slices'] == evicted, (lost['slices'], evicted))

    def _set_aside(self, bag: Bag) -> None:
        """Slices that were evicted during their upload, and arrived anyway: the manifest lists them as missing."""
        report = {each['file'] for each in bag.manifest['slices']}
        evicted = {each['file'] for each in bag.manifest['missing'] if each['what'] == EVICTED}
        with closing(Index(self._home / 'spool' / 'index.db', read_only=True)) as index:
            index.open()
            states = {row['key']: row['state'] for row in index.objects.with_prefix(BUCKET, f'{ROBOT}/rosbags/')}
        others = {path.name: states.get(f'{ROBOT}/rosbags/{bag.folder.name}/{path.name}') for path in bag.slices
                  if path.name not in report}  # fmt: skip
        fine = all(name in evicted and state == 'evicted' for name, state in others.items())
        self.found.check('a slice of the store is in the manifest, or was evicted on its way', fine, others)
        self.found.figures['slices_evicted_on_their_way'] = len(others)
        for name in others:
            (bag.folder / name).unlink()

    def _breaks(self) -> None:
        """Read-only: the node keeps running and reports it, and the next one continues from the disk."""
        progress('the disk becomes read-only')
        node = self._node()
        sim = self._processes.sim('image_raw:=false')
        node.received('/imu', node.topic('/imu').get('received', 0) + 100)
        self._disk.break_down()
        time.sleep(5.0)  # its behavior during this time is checked
        self.found.check('the node is alive', node.popen.poll() is None, node.log[-500:])
        report = re.findall('spool-writer failed.*', node.log)  # the commit at that instant fails differently from the next
        kinds = Counter(line.partition(' cannot be written: ')[2] for line in report)
        self.found.check('a read-only disk is told, each kind of error once', bool(report) and set(kinds.values()) == {1}, report)
        sim.signal(2)
        published(sim)
        node.signal(2)
        code = node.wait(30.0)
        self.found.check('a stop with a read-only disk is told by its exit code', code == 1, code)
        self._disk.repair()
        node = self._node()
        sim = self._processes.sim('image_raw:=false', 'duration_s:=3.0')
        before = node.topic('/imu')['received']
        node.received('/imu', before + 200, 30.0)
        published(sim)
        node.delivered(1, 60.0)
        reported = node.stop(seconds=60.0)
        fine = not ledger.imbalances(reported) and not reported['objects']['pending']
        self.found.check('after the repair it goes on', fine, reported['objects'])


def rss_mb(node: Node) -> float:
    """Resident memory of the node."""
    line = next(line for line in Path(f'/proc/{node.popen.pid}/status').read_text().splitlines() if line.startswith('VmRSS'))
    return round(int(line.split()[1]) / 1024, 1)


def campaign(folder: Path, seed: int, full_s: float) -> Findings:
    """Raises NotAllowed if mounting is not permitted."""
    with ExitStack() as stack:
        disk = stack.enter_context(small_disk(folder, SIZE_MB))
        progress(f'a disk of {SIZE_MB} MiB ({disk.kind})')
        tower = stack.enter_context(Tower(folder / 'tower'))
        wire = stack.enter_context(Wire(tower.endpoint_url))
        processes = stack.enter_context(running(folder))
        return FullDisk(processes, wire, tower, disk, seed).run(full_s)


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    given = parser('full_disk', __doc__ or '').parse_args(argv)
    try:
        with workshop(given) as shop:
            found = campaign(shop.folder, given.seed, SHORT_FULL_S if given.short else FULL_S)
            bars = found.bars()
            shop.passed = all(bar.holds for bar in bars)
    except NotAllowed:
        inside('torture.full_disk', list(sys.argv[1:] if argv is None else argv))
        progress('this machine lets nobody mount anything: nothing was tried (the tests inject the errors instead)')
        return 0
    if not given.json:
        for name, value in found.figures.items():
            print(f'{name}: {value}')
    return verdict({'seed': given.seed, **found.figures}, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
