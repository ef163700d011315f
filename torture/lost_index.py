"""Deletes, cuts and overwrites the spool's index under a node, ``bag record`` and a mission agent, while all three are at work.

Afterwards any of them is killed or stopped, and restarted as by a supervisor; so is one that exits on its own. A publisher
numbers its messages. At the end each message must be in the store once for each of the three that took it; a missing one must
belong to the exit of a process, or be listed with its reason. No object may be overwritten, no bag may lack a manifest or claim
more than it has, no watermark may cover an unlisted loss, and each mission must be one run with each of its points and frames.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import signal
import statistics
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from e2e.bag_reading import Bag, bags, in_slice
from e2e.numbered import parse_numbered
from e2e.processes import Node, Process, Processes, Publisher, until
from e2e.wire import Wire
from missions.server import Server, complete
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.bags.local import RECORDS
from shadowhound_data_logger.bags.naming import BAGS
from shadowhound_data_logger.bags.record import PROGRAM
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows.gaps import GAP
from shadowhound_data_logger.lake import gaps as lake_gaps
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.s3 import S3Store
from torture import joined
from torture._command import Check, parser, progress, some, verdict, workshop
from torture._kill_audit import DISCOVERY_S, LOSS_S, SLACK_S
from torture.gaps import STRING, Loss, Stream, together
from torture.kills import ROBOT, running

ROUNDS: Final = 50
SHORT_ROUNDS: Final = 4
DELETED, CUT, NOISE = 'deleted', 'cut', 'noise'
NODE, RECORDER, AGENT, SENDER = 'node', 'recorder', 'agent', 'sender'
BUCKET: Final = 'sensor-data'
STREAMS: Final = (Stream('/small', True, 40, 0.02), Stream('/large', True, 20_000, 0.1))
BESIDE: Final = 'beside'
"""The name of the bags of ``bag record``."""
NOTICED_S: Final = (0.0, 3.0)
"""From a damage to the first kill."""
UNTOUCHED: Final = 0.2
"""Share of the damages after which no process is killed."""
REOPENED_S: Final = 5.0
"""How long ``bag record`` may need to open the spool again once it finds that the index is lost ..."""
FOUND_S: Final = 30.0
"""... and how long that may take: overwritten pages may be read late."""
GO_ON_S: Final = 90.0
STEADY_S: Final = 1.0
DELIVER_S: Final = 300.0
AGENT_PERIOD_S: Final = 0.05
PERIODS: Final = 2
READERS: Final = 4
PARAMETERS: Final[dict[str, Any]] = {
    'sensors': [stream.topic.strip('/') for stream in STREAMS], 'bag.record': 'always', 'bag.slice_s': 3.0,
    'catalog.period_s': 5.0, 'upload.max_backoff_s': 2.0,
    **{f'{stream.topic.strip("/")}.{name}': value for stream in STREAMS
       for name, value in (('topics', [stream.topic.strip('/')]), ('types', [STRING]), ('rate_hz', 0.0), ('batch_s', 1.0))},
}  # fmt: skip


class Death(NamedTuple):
    """Since when a process may have recorded in vain, and when the next one did its work again, ns since 1970.

    If it was stopped after a damage, since the damage: the index has what it did in between.
    """

    at_ns: int
    ready_ns: int


@dataclass(slots=True)
class Happened:
    """What was done, and what was observed."""

    damages: list[tuple[str, int]] = field(default_factory=list)
    deaths: dict[str, list[Death]] = field(default_factory=lambda: {NODE: [], RECORDER: []})
    killed: Counter[str] = field(default_factory=Counter)
    ended_by_itself: Counter[str] = field(default_factory=Counter)
    hung: list[str] = field(default_factory=list)
    overwritten: list[str] = field(default_factory=list)
    etags: dict[str, str] = field(default_factory=dict)
    puts: Counter[str] = field(default_factory=Counter)
    """Requests by key."""
    published: dict[str, int] = field(default_factory=dict)

    def heard(self, data: bytes) -> None:
        """Count what is sent to the store."""
        self.puts.update(key.decode() for key in _PUT.findall(data))


_PUT: Final = re.compile(rb'PUT /([^ ?]+) HTTP/1')


class Robot(joined.Killer):
    """A node, a recorder and an agent in one home. Lifecycle: New; run once."""

    def __init__(self, processes: Processes, environ: dict[str, str], rng: random.Random, store: ObjectStore,
                 happened: Happened) -> None:  # fmt: skip
        super().__init__(processes, (), environ, rng, AGENT_PERIOD_S)
        self._store, self._happened = store, happened
        self._recorder: Process | None = None
        self._damaged_ns = 0

    def run_rounds(self, rounds: int, publisher: Publisher) -> None:
        self.node.await_log('logging ')
        self._start_recorder()
        self._start_agent()
        for stream in STREAMS:
            publisher.matched(stream.topic, 2)
            publisher.begin_numbered(stream.topic, 'p', stream.size, stream.period_s)
        for number in range(1, rounds + 1):
            self._await_progress(time.time_ns())
            self._sleep(self._rng.uniform(STEADY_S, 2 * STEADY_S))  # a node may detect the last damage only now
            what = self._damage()
            progress(f'{number}: {what}, {self._disturb()}')
        self._await_progress(time.time_ns())
        self._damaged_ns = 0
        for stream in STREAMS:
            self._happened.published[stream.topic] = publisher.halt_numbered(stream.topic)

    def finish(self) -> None:
        """Stop all of them; a last node delivers what is left."""
        recorder = self._recorder
        assert recorder is not None
        recorder.signal(signal.SIGINT)
        with suppress(Exception):
            recorder.wait()
        recorder.kill()
        self._kill_agent()
        self._restart_node(signal.SIGINT)
        self.node.await_log('logging ')

    # -- disturbances --------------------------------------------------------------------------------------------------

    def _damage(self) -> str:
        index, rng = self.home / 'spool' / 'index.db', self._rng
        what = rng.choice((DELETED, CUT, NOISE))
        self._damaged_ns = time.time_ns()
        self._happened.damages.append((what, self._damaged_ns))
        if what == DELETED:
            for path in (index, *(Path(f'{index}{end}') for end in ('-wal', '-shm') if rng.random() < 0.5)):
                path.unlink(missing_ok=True)
            return what
        with suppress(FileNotFoundError), index.open('r+b') as file:
            size = os.fstat(file.fileno()).st_size
            begin, end = (0, size) if rng.random() < 0.5 else sorted(rng.randrange(size + 1) for _ in range(2))
            if what == CUT:
                file.truncate(rng.randrange(size + 1))
            else:
                file.seek(begin)
                file.write(rng.randbytes(end - begin))
        return what

    def _disturb(self) -> str:
        """Let them run with it, then stop some of them."""
        rng = self._rng
        self._sleep(rng.uniform(*NOTICED_S))
        if rng.random() < UNTOUCHED:
            return 'nobody is killed'
        chosen = [name for name in (NODE, RECORDER, AGENT, SENDER) if rng.random() < 0.5] or [rng.choice((NODE, RECORDER))]
        rng.shuffle(chosen)
        reported = []
        for name in chosen:
            self._restart_exited()
            number = rng.choice((signal.SIGKILL, signal.SIGINT))
            self._happened.killed[f'{name} {number.name}' if name in {NODE, RECORDER} else name] += 1
            reported.append(f'{name} {number.name}')
            if name == NODE:
                self._restart_node(number)
            elif name == RECORDER:
                self._restart_recorder(number)
            else:
                self._kill({AGENT: joined.AGENT, SENDER: joined.SENDER}[name])
        return ', '.join(reported)

    def _doubtful_ns(self) -> int:
        """The start of the doubtful time for an exit that is found now."""
        return self._damaged_ns or time.time_ns()

    def _restart_node(self, number: int) -> None:
        at_ns = self._doubtful_ns()
        _end(self.node, number)
        self._node_died(at_ns)

    def _node_died(self, at_ns: int) -> None:
        self.node = self._start_node()
        self._happened.deaths[NODE].append(Death(at_ns, 0))

    def _restart_recorder(self, number: int) -> None:
        at_ns, recorder = self._doubtful_ns(), self._recorder
        assert recorder is not None
        _end(recorder, number)
        self._recorder_died(at_ns)

    def _recorder_died(self, at_ns: int) -> None:
        self._start_recorder()
        self._happened.deaths[RECORDER].append(Death(at_ns, 0))

    def _start_node(self) -> Node:
        return self._processes.node(self._environ, PARAMETERS, ready=False)

    def _start_recorder(self) -> None:
        processes = self._processes
        own = {'SHADOWHOUND_HOME': str(self.home), 'SHADOWHOUND_ROBOT': ROBOT}
        command = ['-m', PROGRAM, '--duration=86400', '--deadline=10', f'--robot={ROBOT}',
                   *(f'--topic={stream.topic}' for stream in STREAMS), '--', BESIDE]  # fmt: skip
        name = f'recorder-{len(processes.started)}'
        log = processes.folder / f'{name}.log'
        self._recorder = Process(name, command, log, {**processes.environ, **self._environ, **own})
        processes.started.append(self._recorder)

    # -- as a supervisor does ------------------------------------------------------------------------------------------

    def _restart_exited(self) -> None:
        """Restart processes that exited on their own."""
        if self.node.popen.poll() is not None:
            self._happened.ended_by_itself[f'node, exit code {self.node.popen.returncode}'] += 1
            self._node_died(self._doubtful_ns())
        recorder = self._recorder
        assert recorder is not None
        if recorder.popen.poll() is not None:
            self._happened.ended_by_itself[f'recorder, exit code {recorder.popen.returncode}'] += 1
            self._recorder_died(self._doubtful_ns())
        assert self._agent is not None
        if self._agent.poll() is not None:
            self._happened.ended_by_itself['agent'] += 1
            self._happened.hung.append('the agent ended by itself')
            self._kill_agent()
            self._start_agent()

    def _sleep(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._restart_exited()
            time.sleep(min(0.05, seconds))

    def _await_progress(self, since_ns: int) -> None:
        """Wait until each of them has done more, and restart the one that does not."""
        restart: dict[str, tuple[Callable[[], bool], Callable[[], None]]] = {
            NODE: (lambda: self._stores(since_ns), lambda: self._restart_node(signal.SIGKILL)),
            RECORDER: (lambda: self._records(since_ns), lambda: self._restart_recorder(signal.SIGKILL)),
        }
        for name, (is_at_work, again) in restart.items():
            for last in (False, True):
                if self._waits(is_at_work):
                    break
                self._happened.hung.append(f'{name} after damage {len(self._happened.damages)}{", restarted" if last else ""}')
                progress(self._happened.hung[-1])
                again()
            now_ns = time.time_ns()
            deaths = self._happened.deaths[name]
            self._happened.deaths[name] = [death if death.ready_ns else Death(death.at_ns, now_ns) for death in deaths]
        size = self._reported.stat().st_size
        if not self._waits(lambda: self._reported.stat().st_size > size):
            self._happened.hung.append(f'agent after damage {len(self._happened.damages)}')
        self._note_overwritten()

    def _waits(self, condition: Callable[[], bool]) -> bool:
        end_s = time.monotonic() + GO_ON_S
        while not condition():
            if time.monotonic() > end_s:
                return False
            self._sleep(0.2)
        return True

    def _stores(self, since_ns: int) -> bool:
        """Whether the store has an object of a later second: leftovers of an earlier node are not its work."""
        name = STREAMS[0].topic.strip('/')
        prefix, first = (
            f'{ROBOT}/{name}/{utc(time.time_ns()):%Y%m%d/%H}',
            f'{ROBOT}/{name}/{utc(since_ns + SECOND):%Y%m%d/%H%M%S}',
        )
        return any(info.key > first for info in self._store.list(BUCKET, prefix))

    def _records(self, since_ns: int) -> bool:
        times = []
        for path in (self.home / RECORDS / ROBOT).glob('*/*.open'):
            with suppress(FileNotFoundError):
                times.append(path.stat())
        return any(status.st_mtime_ns > since_ns and status.st_size > 4096 for status in times)

    def _note_overwritten(self) -> None:
        etags = self._happened.etags
        for info in self._store.list(BUCKET, f'{ROBOT}/'):
            if etags.setdefault(info.key, info.etag) != info.etag:
                self._happened.overwritten.append(info.key)


def _end(process: Process, number: int) -> None:
    """SIGINT with a timeout of one minute, as a service manager gives."""
    if number == signal.SIGINT:
        process.signal(number)
        with suppress(Exception):
            process.wait(60.0)
    process.kill()


@dataclass(slots=True)
class Found:
    """Violations, by bar, and results."""

    wrong: defaultdict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    figures: dict[str, Any] = field(default_factory=dict)
    looked: Counter[str] = field(default_factory=Counter)


Stamps = dict[str, dict[int, int]]
"""Topic -> number -> stamp of stored messages, ns."""


def stamps_in_objects(found: Found, store: ObjectStore, objects: Mapping[str, ObjectInfo]) -> Stamps:
    """The messages in the sensors' objects; every object's content must match its metadata."""
    stamps: Stamps = {stream.topic: {} for stream in STREAMS}
    folders = tuple(f'{ROBOT}/{stream.topic.strip("/")}/' for stream in STREAMS)
    with ThreadPoolExecutor(READERS) as pool:
        bodies = pool.map(lambda key: store.get(BUCKET, key), objects)
        for (key, info), body in zip(objects.items(), bodies, strict=True):
            if info.sha256 is not None and hashlib.sha256(body).hexdigest() != info.sha256:
                found.wrong['overwritten'].append(f'{key} is not what it says')
            elif key.startswith(folders):
                document = json.loads(body)
                for sample in document['samples']:
                    number = parse_numbered(sample['data'])[1]
                    if number in stamps[document['topic']]:
                        found.wrong['twice'].append(f'objects {document["topic"]} {number} again in {key}')
                    stamps[document['topic']][number] = sample['stamp_ns']
    return stamps


def stamps_in_bags(found: Found, stored: Sequence[Bag], who: str) -> Stamps:
    """The messages in the bags of the node or of the recorder; every bag must match its manifest."""
    stamps: Stamps = {stream.topic: {} for stream in STREAMS}
    for bag in stored:
        if not bag.manifest:
            found.wrong['manifests'].append(f'{bag.folder.name} has none')
        else:
            try:
                bag.check()
            except Exception as error:  # noqa: BLE001 - whatever a reader says of it is a finding
                found.wrong['manifests'].append(f'{bag.folder.name}: {type(error).__name__} {error}')
        own: Stamps = {stream.topic: {} for stream in STREAMS}
        for path in bag.slices:
            for message in in_slice(path):
                number = parse_numbered(message.cdr[8:-1].decode())[1]
                if number in stamps[message.topic]:
                    found.wrong['twice'].append(f'{who} {message.topic} {number} again in {path.name}')
                stamps[message.topic][number] = own[message.topic][number] = message.publish_ns
        _claims(found, bag, own)
    return stamps


def _claims(found: Found, bag: Bag, own: Stamps) -> None:
    """No message within a bag may be missing without being listed."""
    if not bag.manifest:
        return
    reported = Counter[str]()
    unknown = False
    for each in bag.manifest['missing']:
        unknown |= each['messages'] is None and 'in memory' not in each['what']
        reported[each['topic'] or ''] += each['messages'] or 0
    for topic, stamps in own.items():
        holes = max(stamps) - min(stamps) + 1 - len(stamps) if stamps else 0
        found.looked['holes in bags'] += holes
        if holes > reported[topic] + reported[''] and not unknown:
            found.wrong['claims'].append(
                f'{bag.folder.name} {topic}: {holes} are missing in it, its manifest says {dict(reported)}'
            )


def absent(stamps: Stamps, published: Mapping[str, int]) -> dict[str, list[Loss]]:
    """Missing messages, by topic, from the last message before to the first after; messages before the first do not count."""
    return {
        topic: [Loss(numbers[one], numbers[two], two - one - 1) for one, two in pairwise(sorted(numbers)) if two > one + 1]
        + ([Loss(numbers[max(numbers)], (1 << 62), published[topic] - max(numbers) - 1)]
           if numbers and published[topic] > max(numbers) + 1 else [])
        for topic, numbers in stamps.items()
    }  # fmt: skip


def spans(deaths: Iterable[Death], loss_s: float) -> list[tuple[int, int]]:
    """Times in which messages may be lost without a record, because the accounts were lost with the index and then the process
    exited.
    """
    found: list[tuple[int, int]] = []
    for death in sorted(deaths):
        begin_ns, end_ns = death.at_ns - round(loss_s * SECOND), death.ready_ns + round(DISCOVERY_S * SECOND)
        if found and begin_ns <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], end_ns)
        else:
            found.append((begin_ns, end_ns))
    return found


def audit_losses(found: Found, sink: str, lost: Mapping[str, Sequence[Loss]], reported: Mapping[str, Sequence[Loss]],
                 deaths: Sequence[Death], reopened: Sequence[int] = ()) -> None:  # fmt: skip
    """Losses must be listed, or belong to an exit; ``reopened`` are times after which a process may have reopened the spool."""
    allowed = spans(deaths, LOSS_S + SLACK_S)
    unlisted: list[int] = []
    longest = 0
    for stream in STREAMS:
        near_ns = round(PERIODS * stream.period_s * SECOND)
        for real, journal in together(lost[stream.topic], reported.get(stream.topic, ()), near_ns):
            count, known = (sum(each.count for each in group) for group in (real, journal))
            found.looked[f'{sink}: lost'] += count
            found.looked[f'{sink}: listed'] += min(count, known)
            found.looked[f'{sink}: listed, but stored'] += max(0, known - count)
            if count <= known:
                continue
            begin_ns, end_ns = min(each.from_ns for each in real), max(each.to_ns for each in real)
            unlisted.append(count - known)
            longest = max(longest, end_ns - begin_ns)
            length_s = (end_ns - begin_ns) / SECOND
            is_own = length_s <= REOPENED_S and any(at_ns <= end_ns <= at_ns + FOUND_S * SECOND for at_ns in reopened)
            found.looked[f'{sink}: times that it opened the spool anew'] += is_own
            if not is_own and not any(low - near_ns <= begin_ns and end_ns <= high + near_ns for low, high in allowed):
                text = f'{stream.topic}: {count - known} of {count} from {utc(begin_ns):%H:%M:%S.%f} for {length_s:.2f} s'
                found.wrong[f'lost: {sink}'].append(text)
    found.figures[sink] = {
        'lost': found.looked[f'{sink}: lost'], 'listed': found.looked[f'{sink}: listed'],
        'listed_but_stored': found.looked[f'{sink}: listed, but stored'], 'not_listed': sum(unlisted),
        'times': len(unlisted), 'median': statistics.median(unlisted or [0]), 'worst': max(unlisted, default=0),
        'longest_s': round(longest / SECOND, 2), 'beyond_the_bound': len(found.wrong[f'lost: {sink}']),
    }  # fmt: skip


def stated(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, list[Loss]]]:
    """Losses by sink and topic, from the gap parts in the store."""
    reported: dict[str, dict[str, list[Loss]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row['what'] == GAP and row['count'] and row['from_ns'] is not None:
            reported[row['sink']][row['topic']].append(
                Loss(row['from_ns'], row['to_ns'], row['count'], row['cause'] or row['kind'])
            )
    return reported


def audit_watermarks(found: Found, rows: Sequence[Mapping[str, Any]], lost: Mapping[str, Mapping[str, Sequence[Loss]]]) -> None:
    """No watermark may cover a loss that no row lists."""
    for sink, topics in lost.items():
        for topic, losses in topics.items():
            own = [row for row in rows if (row['sink'], row['topic']) == (sink, topic)]
            for loss in losses:
                end_ns = min(loss.to_ns, time.time_ns())
                stretches = lake_gaps.of_rows(ROBOT, sink, topic, loss.from_ns + 1, end_ns, own).stretches
                found.looked['losses under watermarks'] += 1
                if stretches and all(each.is_whole for each in stretches):
                    found.wrong['watermarks'].append(f'{sink} {topic}: {loss.count} at {utc(loss.from_ns):%H:%M:%S.%f}')


WHAT: Final = {
    'lost: objects': 'objects: what is lost is listed, or was in memory at a death, or came before the next one listened',
    'lost: bags': "the same in the node's bags", 'lost: beside': 'the same in the bags of bag record',
    'twice': 'no message is stored twice', 'overwritten': 'no object is overwritten',
    'manifests': 'each bag has a manifest, and readers find what it says', 'claims': 'no manifest claims more than is there',
    'watermarks': 'no watermark covers a loss that is not listed',
    'imbalances': 'the ledger balances at the end',
    'hung': 'node, recorder and agent go on, after a restart at most', 'left': 'nothing is left on the robot',
    **{f'missions: {name}': text for name, text in joined.WHAT.items()},
}  # fmt: skip


def audit(found: Found, happened: Happened, tower: Tower, wire: Wire, robot: Robot, store: ObjectStore, folder: Path) -> None:
    """Compare everything in the store with what was published and done."""
    objects = joined.stored(tower)
    found.looked['objects'] = len(objects)
    stored = bags(store, ROBOT, folder / 'bags')
    found.looked['bags'] = len(stored)
    own = [bag for bag in stored if not bag.folder.name.startswith(f'{BESIDE}_')]
    beside = [bag for bag in stored if bag.folder.name.startswith(f'{BESIDE}_')]
    rows = lake_gaps.newest(Bucket(tower.store_settings(), BUCKET), robot=ROBOT).to_pylist()
    reported = stated(rows)
    in_bags: dict[str, list[Loss]] = defaultdict(list)
    with suppress(SpoolError):
        for row in ledger.journal(robot.home / 'spool', ROBOT):
            if row.sink == BAGS and row.robot == f'{ROBOT} {RECORDS}' and row.count and row.from_ns is not None:
                in_bags[row.topic].append(Loss(row.from_ns, row.to_ns or 0, row.count, row.cause))
    lost = {
        'objects': absent(stamps_in_objects(found, store, objects), happened.published),
        'bags': absent(stamps_in_bags(found, own, NODE), happened.published),
        'beside': absent(stamps_in_bags(found, beside, RECORDER), happened.published),
    }
    audit_losses(found, 'objects', lost['objects'], reported['objects'], happened.deaths[NODE])
    audit_losses(found, 'bags', lost['bags'], reported['bags'], happened.deaths[NODE])
    damaged = [at_ns for _, at_ns in happened.damages]
    audit_losses(found, 'beside', lost['beside'], in_bags, happened.deaths[RECORDER], damaged)
    audit_watermarks(found, rows, {sink: lost[sink] for sink in ('objects', 'bags')})
    found.wrong['overwritten'] += happened.overwritten
    found.wrong['hung'] += happened.hung
    left = [path for name in ('spool/ready', 'spool/held', 'spool/quarantine', 'spool/foreign', 'spool/incoming', BAGS, RECORDS)
            for path in (robot.home / name).rglob('*') if path.is_file() and path.suffix != '.lock']  # fmt: skip
    found.wrong['left'] += [str(path.relative_to(robot.home)) for path in left]
    missions = joined.Found()
    server = Server(tower, wire)
    of_missions = {key: info for key, info in objects.items() if not key.startswith(f'{ROBOT}/rosbags/')}
    for flight in robot.flights:
        joined.audit(missions, server, flight, of_missions)
    joined.audit_marks(missions, robot.flights, of_missions)
    found.looked.update({f'mission {name}': count for name, count in missions.looked.items()})
    for name, lines in missions.wrong.items():
        found.wrong[f'missions: {name}'] += lines
    twice = sum(count - 1 for count in happened.puts.values())
    found.figures |= {'put': happened.puts.total(), 'put_again': twice, 'missions': len(robot.flights)}


def campaign(folder: Path, rounds: int, seed: int) -> tuple[Found, Happened]:
    """Run and audit."""
    found, happened = Found(), Happened()
    with Tower(folder / 'tower', mlflow=True) as tower, Wire(tower.endpoint_url, happened.heard) as s3:
        environ = tower.environment() | {'AWS_ENDPOINT_URL': s3.url}
        store = S3Store(tower.store_settings(), UploadSettings())
        store.open()
        try:
            with running(folder) as processes:
                publisher = processes.publisher()
                for stream in STREAMS:
                    publisher.create(stream.topic, STRING, reliable=stream.reliable, depth=1000)
                robot = Robot(processes, environ, random.Random(seed), store, happened)
                robot.run_rounds(rounds, publisher)
                progress('everything ends, and what is left is sent')
                robot.finish()
                os.environ |= environ | {'SHADOWHOUND_ROBOT': ROBOT}
                logger = MissionDataLogger(home=robot.home)
                try:
                    _try(found, lambda: complete(robot.home, len(robot.flights)), 'every mission is sent')
                finally:
                    logger.close()
                _try(found, lambda: _is_delivered(robot.home), 'everything is delivered')
                _end(robot.node, signal.SIGINT)
            found.wrong['imbalances'] += _imbalances(robot.home)
            progress('everything is read back')
            report = {'damages': happened.damages, 'deaths': happened.deaths, 'published': happened.published}
            (folder / 'happened.json').write_text(json.dumps(report, indent=1), encoding='utf-8')
            audit(found, happened, tower, s3, robot, store, folder)
        finally:
            store.close()
    return found, happened


def _try(found: Found, condition: Callable[[], bool], what: str) -> None:
    try:
        until(condition, what, DELIVER_S)
    except AssertionError as error:
        found.wrong['left'].append(str(error))


def _is_delivered(home: Path) -> bool:
    try:
        return not ledger.read(home / 'spool', ROBOT)['objects']['pending']
    except SpoolError:
        return False


def _imbalances(home: Path) -> list[str]:
    try:
        return ledger.imbalances(ledger.read(home / 'spool', ROBOT))
    except SpoolError as error:
        return [str(error)]


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('lost_index', __doc__ or '')
    options.add_argument('--rounds', type=int, default=0, help=f'how many damages (default {ROUNDS})')
    given = options.parse_args(argv)
    rounds = given.rounds or (SHORT_ROUNDS if given.short else ROUNDS)
    progress(f'{rounds} damages, seed {given.seed}')
    began = time.monotonic()
    with workshop(given) as shop:
        found, happened = campaign(shop.folder, rounds, given.seed)
        bars = [Check(text, not found.wrong[name], some(found.wrong[name])) for name, text in WHAT.items()]
        shop.passed = all(bar.holds for bar in bars)
    figures = {
        'seed': given.seed, 'seconds': round(time.monotonic() - began), 'damages': Counter(what for what, _ in happened.damages),
        'killed': happened.killed, 'ended_by_itself': happened.ended_by_itself,
        'deaths': {name: len(deaths) for name, deaths in happened.deaths.items()}, 'published': happened.published,
        **found.figures, 'looked': found.looked,
    }  # fmt: skip
    if not given.json:
        for name, value in figures.items():
            print(f'{name}: {value if not isinstance(value, Counter) else dict(value)}')
    return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
