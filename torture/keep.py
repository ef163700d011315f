"""Kills robot, requester and Tower while many requests for kept data are open, and the disk is short of space or full.

A node keeps images, clouds, batches and slices, more than keep.max_bytes allows, on a small disk that another process fills at
times. Requesters request random seconds of it, some with a short expiry, some cancel, a hundred at the same time; any process
may be killed. What happens next depends on the answers, never on the time: a slow machine makes the campaign longer, not
easier. Afterwards every request has its last answer, every object seen at the time of the request is in the store, verified, or
accounted for, of slices the messages of the requested time, and the ledger balances. A campaign that served few requests, or in
which some kind of fault never happened while requests were open, has failed.
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
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final

from domains import free_domain
from e2e.processes import Node, Processes, until
from e2e.wire import HANG, PASS, REFUSE, Wire
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.bags.verify import verify_remote
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.core.mailbox import KeptFilter, RequestAnswer
from shadowhound_data_logger.core.model import LOST
from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Ranged, StoredFile
from shadowhound_data_logger.formats.rows.catalog import KEPT, OBJECTS
from shadowhound_data_logger.lake import pull
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import RowFile, read
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop
from torture._disks import Disk, NotAllowed, inside, small_disk

ROBOT: Final = 'thor'
KILLS, SHORT_KILLS = 30, 5
AT_ONCE: Final = 100
COUNT: Final = 10
"""Requests per requester; another one starts when few are open."""
FEW: Final = 6
ANSWERED: Final = 5
"""Requests that get an object between a fault and the next kill."""
SERVED_A_KILL, SERVED_SHARE = 3, 1 / 3
"""Minimum number of requests that must get an object: with fewer, a campaign has verified nothing."""
AT_THE_START: Final = 0.2
"""Share of the nodes that are killed once more before they listen."""
ABOVE: Final = 20
"""Objects that are spooled, or evicted, while a store is down, or the disk full."""
FULL_S: Final = 60.0
"""With a full disk not even an eviction can be recorded: then the kill comes after this."""
WAIT_S: Final = 900.0
"""Longer than any working operation takes on a busy machine."""
EXPIRY_S: Final = 15.0
"""Expiry of a request that must expire during its upload; longer if nothing was sent by then."""
MUCH: Final = 100
"""Kept objects, more than are released at a time."""
TRIES: Final = 5
PARAMETERS: Final[dict[str, Any]] = {
    'camera.rate_hz': 5.0, 'camera.ship': 'on_request', 'lidar.ship': 'on_request', 'imu.ship': 'on_request',
    'bag.record': 'always', 'bag.topics': ['/odom', '/imu', '/point_cloud2'], 'bag.slice_s': 5.0, 'bag.compression': 'none',
    'bag.ship': 'on_request',
    'keep.max_bytes': 64 << 20, 'keep.poll_s': 0.5, 'catalog.period_s': 2.0,
    'upload.max_mbps': 8.0, 'upload.read_timeout_s': 3.0, 'upload.max_backoff_s': 2.0,
}  # fmt: skip
NO_ROOM: Final = {'spool.min_free_bytes': 1 << 60}
"""A reserve that no disk has: everything that may be evicted is."""
DISK_MB: Final = 256
HOME: Final = 'disk/home'
KILL, REQUESTER, TOWER, REFUSED, HUNG, FULL, EXPIRY, CROWD, EVICTION = KINDS = (
    'kill of the robot', 'kill of a requester', 'kill of Tower', 'outage', 'outage that hangs', 'full disk',
    'expiry in the middle of a pull', f'{AT_ONCE} requests at once', 'eviction of what was asked for',
)  # fmt: skip
"""Each must happen while requests are open."""


class Campaign:
    """One robot, its Tower behind a wire, and the requesters. Lifecycle: New; run once."""

    def __init__(self, folder: Path, disk: Disk, tower: Tower, wire: Wire, processes: Processes,
                 rng: random.Random) -> None:  # fmt: skip
        self._folder, self._tower, self._wire, self._processes, self._rng = folder, tower, wire, processes, rng
        self._environ = tower.environment() | {'AWS_ENDPOINT_URL': wire.url}
        self._requesters: list[subprocess.Popen[bytes]] = []
        self._record = folder / 'asked.jsonl'
        self._source = Bucket(tower.store_settings(), 'sensor-data')
        self._node: Node
        self.unbalanced: list[str] = []
        self.failed = 0
        """Number of requests that were not sent because the store was down."""
        self.exercised = Counter[str]()
        """Kind of fault -> how often it happened while requests were open."""
        self.home = folder / HOME
        self._filler = disk.path / 'filler'

    def run(self, kills: int) -> None:
        """Everything except the audit; the node is stopped then."""
        self._start()
        sim = self._processes.sim('rate_scale:=0.2', 'image_raw:=false')
        self._await(lambda: self._objects('kept') > ABOVE, 'something is kept')
        plan = self._plan(kills)
        for number, kinds in enumerate(plan, 1):
            for kind in kinds:
                self._fault(kind)
            if FULL in kinds:  # a full disk, on which a delivery may not be recorded any more
                self._kill_robot()
                self.exercised[KILL] += self._open() > 0
            else:
                self._await_served(ANSWERED)
                self._exercise(KILL, self._kill_robot)
            self._filler.unlink(missing_ok=True)
            self._wire.set(PASS)
            if self._rng.random() < AT_THE_START:
                self._node = self._new_node()
                time.sleep(self._rng.uniform(0.0, 2.0))  # a random life span, not a wait for a condition
                self._kill_robot()
            self._start()
            progress(f'{number} kills, {self._served()} requests served, {self._open()} open: {", ".join(kinds)}')
        for requester in self._requesters:
            requester.wait(WAIT_S)
        sim.signal(signal.SIGINT)
        self._await_last_answers()
        progress('all requests are answered')
        self._node.delivered(1, WAIT_S)
        self._node.stop(seconds=WAIT_S)

    def _plan(self, kills: int) -> list[list[str]]:
        """What happens before each kill: every kind about equally often, but one crowd; a full disk comes last."""
        others = [kind for kind in KINDS if kind not in {KILL, CROWD}]
        deck: list[str] = []
        while len(deck) < max(kills, len(others)):
            deck += self._rng.sample(others, len(others))
        deck.insert(len(deck) // 2, CROWD)
        return [sorted(deck[number::kills], key=FULL.__eq__) for number in range(kills)]

    # -- faults ----------------------------------------------------------------------------------------------------

    def _fault(self, kind: str) -> None:
        if kind == REQUESTER:
            requester = self._make_requester()
            self._exercise(kind, requester.kill)
        elif kind == TOWER:
            self._exercise(kind, self._tower.stop_s3)
            self._await_more('spooled')
            self._tower.start_s3()
        elif kind in {REFUSED, HUNG}:
            self._exercise(kind, lambda: self._wire.set(REFUSE if kind == REFUSED else HANG))
            self._await_more('spooled')
            self._wire.set(PASS)
        elif kind == FULL:
            self._exercise(kind, self._fill)
            with suppress(AssertionError):
                self._await_more('evicted', FULL_S)
        elif kind == EXPIRY:
            self._expire()
        elif kind == CROWD:
            before = len(self.asked())
            self._ask(threads=20, count=AT_ONCE)
            self._await(lambda: len(self.asked()) >= before + AT_ONCE // 2, 'many ask at once')
            self._exercise(kind, lambda: None)
        else:
            self._evict()

    def _exercise(self, kind: str, fault: Callable[[], object]) -> None:
        """The fault, at a moment when requests are open: those still open after it count."""
        target = self._objects('delivered') + self._rng.randrange(12)
        self._await(lambda: self._objects('delivered') >= target and self._open() > 1, f'requests are open: {kind}')
        fault()
        self.exercised[kind] += self._open() > 0

    def _kill_robot(self) -> None:
        self._node.kill()
        found = ledger.imbalances(ledger.read(self.home / 'spool', ROBOT))
        self.unbalanced += [f'after kill {self.exercised[KILL]}: {line}' for line in found]

    def _make_requester(self) -> subprocess.Popen[bytes]:
        """A requester that has sent a request, and continues."""
        name, requester = f'r{len(self._requesters)}-', self._ask(threads=1, count=1000)
        self._await(
            lambda: any(each['by'].startswith(name) for reported in self.asked().values() for each in reported), 'one asks'
        )
        return requester

    def _fill(self) -> None:
        """Fill the disk until the next kill."""
        with suppress(OSError), self._filler.open('wb', buffering=0) as file:
            while file.write(bytes(64 << 10)):
                pass

    def _expire(self) -> None:
        """Request everything, and cut the wire after some of it has arrived, until the request has ended."""
        for attempt in range(TRIES):
            self._await(lambda: self._objects('kept') > MUCH, 'much is kept')
            name = self._ask_here(round(EXPIRY_S * (attempt + 1) * SECOND))
            self._await(lambda name=name: self._has(name, 'delivered') or self._is_over(name), 'some of it has come')
            self._wire.set(REFUSE)
            self._await(lambda name=name: self._is_over(name), 'the request is over')
            is_cut = self._has(name, 'delivered') and (self._has(name, 'kept') or self._has(name, 'unsent'))
            self._wire.set(PASS)
            if is_cut:
                self.exercised[EXPIRY] += 1
                return

    def _evict(self) -> None:
        """Send a request to a robot that does not receive it, and that must evict objects before it does."""
        for _ in range(TRIES):
            self._await(lambda: self._objects('kept') > ABOVE and self._open() > 0, 'something is kept')
            self._wire.set(REFUSE)
            self._kill_robot()
            name = self._ask_here(3600 * SECOND)
            self._start(NO_ROOM)
            self._await_more('evicted')
            is_open = self._open() > 0
            self._wire.set(PASS)
            self._await(lambda name=name: self._is_over(name), 'what is gone is answered')
            found = self._rows("SELECT unavailable FROM requests WHERE id = ? AND unavailable <> '{}'", name)
            self._kill_robot()
            self._start()
            if is_open and found:
                self.exercised[EVICTION] += 1
                return

    def _await_more(self, state: str, seconds: float = WAIT_S) -> None:
        """Wait until this many more objects are in that state."""
        target = self._objects(state) + ABOVE
        self._await(lambda: self._objects(state) >= target, f'more are {state}', seconds)

    # -- requests and the robot's answers --------------------------------------------------------------------------

    def asked(self) -> dict[str, list[dict[str, Any]]]:
        """Request -> what its requester recorded."""
        found: dict[str, list[dict[str, Any]]] = {}
        self.failed = 0
        if not self._record.exists():
            return found
        for line in self._record.read_text(encoding='utf-8').splitlines():
            try:
                reported = json.loads(line)
            except ValueError:  # its writer was killed
                continue
            self.failed += 'failed' in reported
            if 'id' in reported:
                found.setdefault(reported['id'], []).append(reported)
        return found

    def _ask(self, *, threads: int, count: int) -> subprocess.Popen[bytes]:
        """One in three is affected by the robot's outages."""
        command = [sys.executable, '-m', 'torture._requester', ROBOT, str(self._record), f'r{len(self._requesters)}', str(count),
                   str(threads), str(self._rng.randrange(1 << 30))]  # fmt: skip
        environ = {**os.environ, **(self._environ if self._rng.random() < 1 / 3 else self._tower.environment())}
        with (self._folder / 'requesters.log').open('ab') as log:
            self._requesters.append(subprocess.Popen(command, env=environ, stdout=log, stderr=log))
        return self._requesters[-1]

    def _ask_here(self, expiry_ns: int) -> str:
        """For everything that is kept."""
        now_ns = time.time_ns()
        want = KeptFilter(since_ns=now_ns - 3600 * SECOND, until_ns=now_ns)
        seen = pull.kept(self._source, ROBOT, want, Findings(lambda _: None))['key'].to_pylist()
        with closing(S3Store(self._tower.store_settings(), UploadSettings())) as store:
            store.open()
            asked = pull.put_request(store, self._source, ROBOT, want, by='here', priority=0, expiry_ns=expiry_ns)
        with self._record.open('a', encoding='utf-8') as file:
            file.write(json.dumps({'id': asked.id, 'by': 'here', 'made_ns': asked.made_ns, 'keys': seen}) + '\n')
        return asked.id

    def _await(self, condition: Callable[[], bool], what: str, seconds: float = WAIT_S) -> None:
        """Start other requesters while waiting, so that requests are open."""

        def looked() -> bool:
            time.sleep(0.1)
            if self._open() < FEW and all(each.poll() is not None for each in self._requesters):
                self._ask(threads=3, count=COUNT)
            return condition()

        until(looked, lambda: f'{what}; of the node: {self._node.log[-2000:]}', seconds)

    def _await_served(self, count: int) -> None:
        target = self._served() + count
        self._await(lambda: self._served() >= target, f'{count} more requests are served')

    def _rows(self, query: str, *values: str) -> list[tuple[Any, ...]]:
        """From the robot's index, without changing it, whether the robot runs or not."""
        with closing(sqlite3.connect(f'file:{self.home}/spool/index.db?mode=ro', uri=True, timeout=60.0)) as db:
            return db.execute(query, values).fetchall()

    def _open(self) -> int:
        return int(self._rows("SELECT count(*) FROM requests WHERE state = 'active'")[0][0])

    def _served(self) -> int:
        """Requests that have their last answer, and got an object."""
        got = "SELECT * FROM requested WHERE request = requests.id AND outcome = 'delivered'"
        query = f"SELECT count(*) FROM requests WHERE state <> 'active' AND answered_state = state AND EXISTS ({got})"  # noqa: S608 - own text
        return int(self._rows(query)[0][0])

    def _is_over(self, request: str) -> bool:
        return bool(self._rows("SELECT * FROM requests WHERE id = ? AND state <> 'active'", request))

    def _has(self, request: str, outcome: str) -> bool:
        """Whether any object of a request had this outcome."""
        return bool(self._rows('SELECT * FROM requested WHERE request = ? AND outcome = ? LIMIT 1', request, outcome))

    def _objects(self, state: str) -> int:
        return int(self._rows('SELECT ifnull(sum(objects), 0) FROM tally WHERE state = ?', state)[0][0])

    # -- the robot -------------------------------------------------------------------------------------------------

    def _new_node(self, more: dict[str, Any] | None = None) -> Node:
        return self._processes.node(self._environ, {**PARAMETERS, **(more or {})}, ready=False, home=HOME)

    def _start(self, more: dict[str, Any] | None = None) -> None:
        self._node = self._new_node(more)
        self._node.await_log('logging ', WAIT_S)

    def _await_last_answers(self) -> None:
        made = {name: max(each['made_ns'] for each in reported) for name, reported in self.asked().items()}

        def are_answered() -> bool:
            for name, made_ns in list(made.items()):
                answer = pull.newest_answer(self._source, ROBOT, name)
                if answer is not None and answer.state in pull.FINAL and answer.made_ns >= made_ns:
                    del made[name]
            return not made

        until(are_answered, lambda: f'{len(made)} requests are answered: {sorted(made)[:3]} {self._node.log[-2000:]}', WAIT_S)


def audit(campaign: Campaign, tower: Tower, kills: int) -> tuple[dict[str, Any], list[Check]]:
    """The results and bars."""
    wrong: dict[str, list[str]] = {name: [] for name in (
        'unbalanced', 'unanswered or contradictory', 'seen and neither stored nor accounted for', 'not what was spooled',
        'cut out of slices and not their messages',
        'too few requests served to prove anything', 'kinds of fault that never fell while requests were open',
        'twice in the catalog', 'protected and evicted', 'quarantined or renamed', 'to be recovered after a clean stop',
    )}  # fmt: skip
    wrong['unbalanced'] += campaign.unbalanced
    source = Bucket(tower.store_settings(), 'sensor-data')
    store = S3Store(tower.store_settings(), UploadSettings())
    store.open()
    with closing(store), closing(sqlite3.connect(campaign.home / 'spool' / 'index.db')) as db:
        in_store = {info.key for info in store.list('sensor-data', f'{ROBOT}/')}
        lost = {row['key'] for row in _rows(source, in_store, KEPT.folder) if row['where'] == LOST}
        cataloged = Counter(row['key'] for row in _rows(source, in_store, OBJECTS.folder))
        figures = _answers(campaign, source, store, in_store, lost, wrong)
        query = "SELECT DISTINCT key, sha256 FROM requested JOIN objects USING (id) WHERE state = 'delivered'"
        for key, sha256 in db.execute(query):
            if key not in in_store or hashlib.sha256(store.get('sensor-data', key)).hexdigest() != sha256:
                wrong['not what was spooled'].append(key)
        wrong['twice in the catalog'] += [key for key, count in cataloged.items() if count > 1]
        wrong['protected and evicted'] += [
            key for (key,) in db.execute("SELECT key FROM objects WHERE state = 'evicted' AND protected")
        ]
        wrong['quarantined or renamed'] += [key for (key,) in db.execute(
            "SELECT key FROM objects WHERE state = 'quarantined' OR key GLOB '*/_answers/*_*.json'")]  # fmt: skip
        served, requests = figures['answered']['served'], sum(figures['requests'].values())
        if served < max(SERVED_A_KILL * kills, SERVED_SHARE * requests):
            wrong['too few requests served to prove anything'].append(f'{served} of {requests}')
        wrong['kinds of fault that never fell while requests were open'] += [
            kind for kind in KINDS if not campaign.exercised[kind]
        ]
        figures['objects'] = dict(db.execute('SELECT state, sum(objects) FROM tally GROUP BY state').fetchall())
    wrong['unbalanced'] += ledger.imbalances(ledger.read(campaign.home / 'spool', ROBOT))
    spool = Spool(campaign.home / 'spool', SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), ROBOT)
    spool.open()
    wrong['to be recovered after a clean stop'] += [spool.recovery.describe()] if spool.recovery.found_anything else []
    spool.close()
    figures['faults while requests were open'] = dict(campaign.exercised)
    figures['asked in vain, for the store was away'] = campaign.failed
    bars = [Check(f'{len(found)} {what}', not found, '; '.join(found[:3])) for what, found in wrong.items()]
    return figures, bars


def _answers(campaign: Campaign, source: Bucket, store: S3Store, in_store: set[str], lost: set[str],
             wrong: dict[str, list[str]]) -> dict[str, Any]:  # fmt: skip
    states, objects, cut = Counter[str](), Counter[str](), Counter[str]()
    answered = Counter[str](served=0)
    for name, askings in campaign.asked().items():
        answer = pull.newest_answer(source, ROBOT, name)
        if answer is None or answer.state not in pull.FINAL:
            wrong['unanswered or contradictory'].append(name)
            continue
        states[answer.state] += 1
        outcomes = {state: each.objects for state, each in answer.outcomes.items()}
        objects.update(outcomes)
        answered.update({
            'served': bool(outcomes.get('delivered')), 'found nothing': not answer.objects and not answer.gone,
            'found that some is gone': bool(answer.gone) or bool(answer.lost),
            'expired or taken back in the middle': answer.state in {'expired', 'cancelled'} and 'delivered' in outcomes,
        })  # fmt: skip
        # Objects that an ended request did not get may be evicted from then on, before the last answer.
        is_over = set(outcomes) <= {'delivered', 'quarantined', *(() if answer.state == 'done' else ('unsent', 'evicted'))}
        went_early = answer.state == 'expired' and any(each.when and each.when < answer.expires for each in answer.lost)
        if not is_over or went_early or sum(outcomes.values()) != answer.objects:
            wrong['unanswered or contradictory'].append(f'{name} {answer.state} {answer.objects} {outcomes}')
        if answer.state == 'done':
            missing = {key for each in askings for key in each['keys']} - in_store - lost
            slices = {key for key in missing if key.endswith('.mcap')}
            missing -= slices
            cut.update(bags=len(answer.bags), slices=len(slices))
            wrong['cut out of slices and not their messages'] += _miscut(campaign, store, answer, slices)
            wrong['seen and neither stored nor accounted for'] += sorted(missing)
    return {'requests': dict(states), 'answered': dict(answered), 'asked for': dict(objects), 'cut': dict(cut)}


def _miscut(campaign: Campaign, store: S3Store, answer: RequestAnswer, slices: set[str]) -> list[str]:
    """Slices with a requested part that is missing in the bags cut for it, if they are still kept."""
    wanted = MessageFilter(answer.want.get('since_ns', 0), answer.want.get('until_ns', 1 << 62), lambda _: True)
    there = Counter[tuple[str, int, bytes]]()
    for bag in answer.bags:
        remote = find_bag(store, ROBOT, bag)
        if not verify_remote(store, remote, deep=True).is_intact:
            return [f'{bag} is not sound']
        sources: list[Ranged] = [StoredFile(store, 'sensor-data', each.key, each.size) for each in remote.slices]
        there += Counter(message for each in sources for message in _messages(each, wanted))
    found = []
    for key in sorted(slices):
        path = campaign.home / 'spool' / 'kept' / 'sensor-data' / key
        if path.exists() and Counter(_messages(LocalFile(path), wanted)) - there:
            found.append(f'{answer.id}: {key}')
    return found


def _messages(source: Ranged, wanted: MessageFilter) -> list[tuple[str, int, bytes]]:
    return [(message.channel.topic, message.log_ns, hashlib.sha256(message.cdr).digest())
            for message in read_messages(source, read_index(source), wanted)]  # fmt: skip


def _rows(source: Bucket, in_store: set[str], folder: str) -> list[dict[str, Any]]:
    of = {KEPT.folder: KEPT, OBJECTS.folder: OBJECTS}[folder]
    files = [RowFile(of, ROBOT, '', info) for info in source.list(of.prefix(ROBOT)) if info.key in in_store]
    return [row for found in read(source, files, Findings(lambda _: None)) for row in found.rows]


def main(argv: Sequence[str] | None = None) -> int:
    """The command line."""
    given = parse_kills(parser('keep', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
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
            figures, bars = audit(campaign, tower, given.kills)
        if not given.json:
            print(json.dumps(figures, indent=1))
        code = verdict(figures, bars, as_json=given.json)
        shop.passed = not code
    return code


if __name__ == '__main__':
    sys.exit(main())
