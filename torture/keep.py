"""Kills robot, requester and Tower while much is asked for of what the robot keeps, and the disk is short of room or full.

A node keeps pictures, clouds, batches and slices, more than keep.max_bytes lets it, on a small disk that somebody else fills at
times. Requesters ask for random seconds of it, some for a moment only, some take it back, a hundred at once; any of the others
may be killed. Afterwards every request has its last answer, everything that was seen at the asking is in the store, verified, or
accounted for, of slices the messages of the time that was asked for, and the ledger closes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final

from domains import free_domain
from e2e.processes import Node, Processes, until
from e2e.wire import HANG, PASS, REFUSE, Wire

from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.bags.verify import verify_remote
from shadowhound_data_logger.catalogue.schema import KEPT, OBJECTS
from shadowhound_data_logger.clock import SystemClock
from shadowhound_data_logger.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.lake import pull
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.reading import tables
from shadowhound_data_logger.mcap.index import read_index
from shadowhound_data_logger.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.mcap.ranges import LocalFile, Ranged, StoredFile
from shadowhound_data_logger.model import LOST
from shadowhound_data_logger.sim.tower import Tower
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Bar, asked_kills, parser, progress, verdict, workshop
from torture._disks import Disk, NotAllowed, inside, small_disk

ROBOT: Final = 'thor'
KILLS, SHORT_KILLS = 30, 5
AT_ONCE: Final = 100
UP_S: Final = (3.0, 8.0)
AT_THE_START: Final = 0.2
"""Share of the nodes that are killed whether or not they listen yet."""
ANSWER_S: Final = 240.0
LEAST_SERVED: Final = 3
"""A campaign in which fewer than one request of so many got an object has proved nothing."""
PARAMETERS: Final[dict[str, Any]] = {
    'camera.rate_hz': 5.0, 'camera.ship': 'on_request', 'lidar.ship': 'on_request', 'imu.ship': 'on_request',
    'bag.record': 'always', 'bag.topics': ['/odom', '/imu', '/point_cloud2'], 'bag.slice_s': 5.0, 'bag.compression': 'none',
    'bag.ship': 'on_request',
    'keep.max_bytes': 24 << 20, 'keep.poll_s': 0.5, 'catalogue.period_s': 2.0,
    'upload.max_mbps': 8.0, 'upload.read_timeout_s': 3.0, 'upload.backoff_s': 2.0,
}  # fmt: skip
NO_ROOM: Final = {'spool.min_free_bytes': 1 << 60}
"""A reserve that no disk has: whatever may go has to."""
DISK_MB: Final = 160
HOME: Final = 'disk/home'


class Campaign:
    """One robot, its Tower behind a wire, and those who ask. Life: New; run once."""

    def __init__(self, folder: Path, disk: Disk, tower: Tower, wire: Wire, processes: Processes,
                 rng: random.Random) -> None:  # fmt: skip
        self._folder, self._tower, self._wire, self._processes, self._rng = folder, tower, wire, processes, rng
        self._environ = tower.environment() | {'AWS_ENDPOINT_URL': wire.url}
        self._requesters: list[subprocess.Popen[bytes]] = []
        self._crowd: subprocess.Popen[bytes] | None = None
        self._said = folder / 'asked.jsonl'
        self.unbalanced: list[str] = []
        self.failed = 0
        """Times that nothing was asked for, since the store was away."""
        self.kills = Counter[str]()
        self.home = folder / HOME
        self._filler = disk.path / 'filler'

    def run(self, kills: int) -> None:
        """Everything but the judgement; the node has stopped then."""
        node = self._start()
        node.said('logging ')
        sim = self._processes.sim('rate_scale:=0.5', 'image_raw:=false')
        until(lambda: node.ledger()['objects']['kept'] > 20, 'something is kept')
        for number in range(1, kills + 1):
            self._turn_store()
            self._ask(threads=1, count=4)
            if number == kills // 2:
                self._wire.set(PASS)
                self._crowd = self._ask(threads=20, count=AT_ONCE)
            if self._rng.random() > AT_THE_START:
                node.said('logging ')
            time.sleep(self._rng.uniform(*UP_S))  # the moment of death, not a wait for anything
            self._kill_requester()
            node.kill()
            self.kills['robot'] += 1
            self._filler.unlink(missing_ok=True)
            found = ledger.imbalances(ledger.read(self.home / 'spool', ROBOT))
            self.unbalanced += [f'after kill {number}: {line}' for line in found]
            if number % 4 == 1:
                self._fill()
            node = self._start(NO_ROOM if number % 8 == 3 else {})
            if number % 5 == 0:
                self._tower.stop_s3()
                self.kills['Tower'] += 1
                self._tower.start_s3()
                progress(f'{number} kills')
        node.kill()
        node = self._start()
        self._wire.set(PASS)
        node.said('logging ')
        for requester in self._requesters:
            requester.wait(240)
        sim.signal(signal.SIGINT)
        progress('all requests are answered')
        self._await_answers(node)
        node.delivered(1, ANSWER_S)
        node.stop(seconds=60.0)

    def asked(self) -> dict[str, list[dict[str, Any]]]:
        """Request -> what those wrote down who asked for it."""
        found: dict[str, list[dict[str, Any]]] = {}
        self.failed = 0
        for line in self._said.read_text(encoding='utf-8').splitlines():
            try:
                said = json.loads(line)
            except ValueError:  # its writer was killed
                continue
            self.failed += 'failed' in said
            if 'id' in said:
                found.setdefault(said['id'], []).append(said)
        return found

    def _await_answers(self, node: Node) -> None:
        source, ids = Bucket(self._tower.store_settings(), 'sensor-data'), set(self.asked())

        def are_answered() -> bool:
            for name in list(ids):
                answer = pull.newest_answer(source, ROBOT, name)
                made_ns = max(each['made_ns'] for each in self.asked()[name])
                if answer is not None and answer['state'] in pull.FINAL and answer['made_ns'] >= made_ns:
                    ids.discard(name)
            return not ids

        until(are_answered, lambda: f'{len(ids)} requests are answered: {sorted(ids)[:3]} {node.log[-2000:]}', ANSWER_S)

    def _start(self, more: dict[str, Any] | None = None) -> Node:
        return self._processes.node(self._environ, {**PARAMETERS, **(more or {})}, ready=False, home=HOME)

    def _ask(self, *, threads: int, count: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, '-m', 'torture._requester', ROBOT, str(self._said), f'r{len(self._requesters)}', str(count),
                   str(threads), str(self._rng.randrange(1 << 30))]  # fmt: skip
        environ = {**os.environ, **self._environ}
        with (self._folder / 'requesters.log').open('ab') as log:
            self._requesters.append(subprocess.Popen(command, env=environ, stdout=log, stderr=log))
        return self._requesters[-1]

    def _fill(self) -> None:
        """Take all that is left of the disk, until the next kill."""
        self.kills['of these on a full disk'] += 1
        with suppress(OSError), self._filler.open('wb', buffering=0) as file:
            while file.write(bytes(64 << 10)):
                pass

    def _kill_requester(self) -> None:
        living = [each for each in self._requesters if each.poll() is None and each is not self._crowd]
        if living and self._rng.random() < 0.5:
            self._rng.choice(living).kill()
            self.kills['requester'] += 1

    def _turn_store(self) -> None:
        if self._crowd is not None and self._crowd.poll() is None:
            return
        if self._rng.random() < 0.5:
            self._wire.set(self._rng.choice((PASS, PASS, PASS, REFUSE, HANG)))


def judge(campaign: Campaign, tower: Tower) -> tuple[dict[str, Any], list[Bar]]:
    """What was found."""
    wrong: dict[str, list[str]] = {name: [] for name in (
        'unbalanced', 'unanswered or contradictory', 'seen and neither stored nor accounted for', 'not what was spooled',
        'cut out of slices and not their messages',
        'too few requests served to prove anything',
        'twice in the catalogue', 'protected and evicted', 'quarantined or renamed', 'to be recovered after a clean stop',
    )}  # fmt: skip
    wrong['unbalanced'] += campaign.unbalanced
    source = Bucket(tower.store_settings(), 'sensor-data')
    store = S3Store(tower.store_settings(), UploadSettings())
    store.open()
    with closing(store), closing(sqlite3.connect(campaign.home / 'spool' / 'index.db')) as db:
        in_store = {info.key for info in store.list('sensor-data', f'{ROBOT}/')}
        lost = {row['key'] for row in _rows(source, in_store, KEPT.folder) if row['where'] == LOST}
        catalogued = Counter(row['key'] for row in _rows(source, in_store, OBJECTS.folder))
        figures = _answers(campaign, source, store, in_store, lost, wrong)
        query = "SELECT DISTINCT key, sha256 FROM requested JOIN objects USING (id) WHERE state = 'delivered'"
        for key, sha256 in db.execute(query):
            if key not in in_store or hashlib.sha256(store.get('sensor-data', key)).hexdigest() != sha256:
                wrong['not what was spooled'].append(key)
        wrong['twice in the catalogue'] += [key for key, count in catalogued.items() if count > 1]
        wrong['protected and evicted'] += [
            key for (key,) in db.execute("SELECT key FROM objects WHERE state = 'evicted' AND protected")
        ]
        wrong['quarantined or renamed'] += [key for (key,) in db.execute(
            "SELECT key FROM objects WHERE state = 'quarantined' OR key GLOB '*/_answers/*_*.json'")]  # fmt: skip
        served, requests = figures['answered']['served'], sum(figures['requests'].values())
        if served * LEAST_SERVED < requests:
            wrong['too few requests served to prove anything'].append(f'{served} of {requests}')
        figures['objects'] = dict(db.execute('SELECT state, sum(objects) FROM tally GROUP BY state').fetchall())
    wrong['unbalanced'] += ledger.imbalances(ledger.read(campaign.home / 'spool', ROBOT))
    spool = Spool(campaign.home / 'spool', SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), ROBOT)
    spool.open()
    wrong['to be recovered after a clean stop'] += [spool.recovery.describe()] if spool.recovery.found_anything else []
    spool.close()
    figures['kills'] = dict(campaign.kills)
    figures['asked in vain, for the store was away'] = campaign.failed
    bars = [Bar(f'{len(found)} {what}', not found, '; '.join(found[:3])) for what, found in wrong.items()]
    return figures, bars


def _answers(campaign: Campaign, source: Bucket, store: S3Store, in_store: set[str], lost: set[str],
             wrong: dict[str, list[str]]) -> dict[str, Any]:  # fmt: skip
    states, objects, cut = Counter[str](), Counter[str](), Counter[str]()
    answered = Counter[str](served=0)
    for name, askings in campaign.asked().items():
        answer = pull.newest_answer(source, ROBOT, name)
        if answer is None or answer['state'] not in pull.FINAL:
            wrong['unanswered or contradictory'].append(name)
            continue
        states[answer['state']] += 1
        outcomes = {state: each['objects'] for state, each in answer['outcomes'].items()}
        objects.update(outcomes)
        answered.update({
            'served': bool(outcomes.get('delivered')), 'found nothing': not answer['objects'] and not answer['gone'],
            'found that some is gone': bool(answer['gone']) or bool(answer['lost']),
            'expired or taken back in the middle': answer['state'] in {'expired', 'cancelled'} and 'delivered' in outcomes,
        })  # fmt: skip
        is_over = set(outcomes) <= (
            {'delivered', 'quarantined'} if answer['state'] == 'done' else {'delivered', 'quarantined', 'unsent'}
        )
        if not is_over or sum(outcomes.values()) != answer['objects']:
            wrong['unanswered or contradictory'].append(f'{name} {answer["state"]} {answer["objects"]} {outcomes}')
        if answer['state'] == 'done':
            missing = {key for each in askings for key in each['keys']} - in_store - lost
            slices = {key for key in missing if key.endswith('.mcap')}
            missing -= slices
            cut.update(bags=len(answer['bags']), slices=len(slices))
            wrong['cut out of slices and not their messages'] += _miscut(campaign, store, answer, slices)
            wrong['seen and neither stored nor accounted for'] += sorted(missing)
    return {'requests': dict(states), 'answered': dict(answered), 'asked for': dict(objects), 'cut': dict(cut)}


def _miscut(campaign: Campaign, store: S3Store, answer: dict[str, Any], slices: set[str]) -> list[str]:
    """Slices of which a request wanted a part that is not in the bags that were cut for it; as far as they are kept still."""
    wanted = MessageFilter(answer['want'].get('since_ns', 0), answer['want'].get('until_ns', 1 << 62), lambda _: True)
    there = Counter[tuple[str, int, bytes]]()
    for bag in answer['bags']:
        remote = find_bag(store, ROBOT, bag)
        if not verify_remote(store, remote, deep=True).is_sound:
            return [f'{bag} is not sound']
        sources: list[Ranged] = [StoredFile(store, 'sensor-data', each.key, each.size) for each in remote.slices]
        there += Counter(message for each in sources for message in _messages(each, wanted))
    found = []
    for key in sorted(slices):
        path = campaign.home / 'spool' / 'kept' / 'sensor-data' / key
        if path.exists() and Counter(_messages(LocalFile(path), wanted)) - there:
            found.append(f'{answer["id"]}: {key}')
    return found


def _messages(source: Ranged, wanted: MessageFilter) -> list[tuple[str, int, bytes]]:
    return [(message.channel.topic, message.log_ns, hashlib.sha256(message.cdr).digest())
            for message in read_messages(source, read_index(source), wanted)]  # fmt: skip


def _rows(source: Bucket, in_store: set[str], folder: str) -> list[dict[str, Any]]:
    of = {KEPT.folder: KEPT, OBJECTS.folder: OBJECTS}[folder]
    entries = [info for info in source.list(of.prefix(ROBOT)) if info.key in in_store]
    columns = ('key', 'where') if of is KEPT else ('key',)
    return [row for table in tables(source, entries, columns, Findings(lambda _: None), of=of) for row in table.to_pylist()]


def main(argv: Sequence[str] | None = None) -> int:
    """The command line."""
    given = asked_kills(parser('keep', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    try:
        return _run(given)
    except NotAllowed:
        inside('torture.keep', list(sys.argv[1:] if argv is None else argv))
        progress('this machine lets nobody mount anything: nothing was tried')
        return 0


def _run(given: argparse.Namespace) -> int:
    with workshop(given) as shop:
        with small_disk(shop.folder, DISK_MB) as disk, Tower(shop.folder / 'tower') as tower:
            with Wire(tower.endpoint_url) as wire, free_domain() as domain:
                processes = Processes(shop.folder, domain, ROBOT)
                try:
                    campaign = Campaign(shop.folder, disk, tower, wire, processes, random.Random(given.seed))
                    campaign.run(given.kills)
                finally:
                    processes.end()
            figures, bars = judge(campaign, tower)
        if not given.json:
            print(json.dumps(figures, indent=1))
        code = verdict(figures, bars, as_json=given.json)
        shop.passed = not code
    return code


if __name__ == '__main__':
    sys.exit(main())
