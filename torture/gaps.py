"""Loses messages on purpose and compares the gap journal with what was sent: when, how many, and why.

A publisher numbers and stamps its messages on four topics, RELIABLE and BEST_EFFORT, small and large, and the node stores all
of them. The node is stopped for seconds, starved, paused, and killed and restarted; files of its objects are damaged before
upload, so that they are quarantined, and some are repaired and retried. A second node has no store and space for few objects,
which it evicts, and its disk is filled up. Messages that are not in the store, between two messages that are, are a gap: the
journal must have it from the one message to the other, within a period and after a kill within the open batch, with its count
and its cause, and nothing else. Rows with the times of the lost messages themselves may be further off while the publisher was
stalled, which its other topics show. The timeline of the live page, read in a Chromium, must show the same. During all this
another process reads the ledger, which must balance at every commit.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from domains import free_domain
from e2e.numbered import parse_numbered
from e2e.processes import Node, Processes, Publisher, until

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.control import connect
from shadowhound_data_logger.spool.gaps import OBJECTS, Gap
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.listing import retry
from shadowhound_data_logger.spool.topic_account import WRONG_TYPE
from torture._command import Check, parser, progress, verdict, workshop
from torture._disks import Disk, NotAllowed, small_disk
from torture.losses import quiet

DISTURBANCES: Final = 200
SHORT_DISTURBANCES: Final = 8
ROBOT: Final = 'torture'
STRING: Final = 'std_msgs/msg/String'
NO_STORE: Final = {'AWS_ENDPOINT_URL': 'http://127.0.0.1:9', 'AWS_ACCESS_KEY_ID': 'a', 'AWS_SECRET_ACCESS_KEY': 'b'}
STOPPED_S: Final = 3.0
STARVED_S: Final = 4.5
STARVED_EACH_S: Final = 1.5
STARVED_TURN_S: Final = 0.05
PAUSED_S: Final = 1.5
KILLED_S: Final = 1.0
EVICTED_S: Final = 8.0
STEADY_S: Final = 2.5
BATCH_S: Final = 0.5
SMALL_ROOM: Final = 4_000_000
BESIDE_S: Final = 0.5
"""A loss this close to a disturbance may be caused by it: a commit, a poll."""
LATE_NS: Final = 40_000_000
"""Maximum delay of the publisher: its machine does other work as well."""
FILLED_S: Final = 3.0
DISK_MB: Final = 96
RETRIED: Final = 0.5
"""Share of the damaged files that are repaired and retried."""
FLAGS: Final = ('--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-sandbox')
KINDS: Final = ('stopped', 'killed', 'paused', 'starved', 'filled', 'damaged')
RESTARTED_S: Final = 10.0
"""A kill's loss ends with the first message of the next start."""


class Stream(NamedTuple):
    """One topic."""

    topic: str
    reliable: bool
    size: int
    period_s: float


STREAMS: Final = tuple(
    Stream(f'/{what}_{"reliable" if reliable else "best_effort"}', reliable, size, period_s)
    for what, size, period_s in (('small', 40, 0.02), ('large', 60_000, 0.1))
    for reliable in (True, False)
)
ALLOWED: Final = {
    'stopped': {'transport'}, 'starved': {'transport'}, 'paused': {'paused', 'transport'}, 'killed': {'restart', 'transport'},
    'evicted': {'no_room'}, 'filled': {'no_room', 'queue_full'}, 'damaged': {'damaged'},
}  # fmt: skip
"""By disturbance, the causes that its losses may have."""


class Loss(NamedTuple):
    """Consecutive messages that are not in the store, between two that are; or a row of the journal."""

    from_ns: int
    to_ns: int
    count: int
    cause: str = ''


class Done(NamedTuple):
    """A disturbance."""

    what: str
    from_ns: int
    to_ns: int


@dataclass(slots=True)
class Found:
    """The result of the audit; ``wrong`` by bar."""

    done: list[Done] = field(default_factory=list)
    wrong: dict[str, list[str]] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)
    """Messages by cause."""
    gaps: int = 0
    shown: int = 0
    """Rows on the timeline of the live page."""
    commits: int = 0
    counts: Counter[str] = field(default_factory=Counter)

    def fail(self, bar: str, text: str, *, holds: bool) -> None:
        self.wrong.setdefault(bar, [])
        if not holds:
            self.wrong[bar].append(text)

    def bars(self) -> list[Check]:
        return [Check(what, not reported, '; '.join(reported[:3])) for what, reported in self.wrong.items()]


class Reader:
    """Reads the ledger of a home repeatedly, and records when it does not balance. New; open; close."""

    def __init__(self, home: Path) -> None:
        self._spool = home / 'spool'
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self.unbalanced: list[str] = []
        self.count = 0

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()

    def _read(self) -> None:
        while not self._over.wait(0.05):
            try:
                found = ledger.read(self._spool, ROBOT)
            except SpoolError:
                continue  # it does not exist yet
            self.count += 1
            self.unbalanced += ledger.imbalances(found)


def began(node: Node) -> dict[str, int]:
    """By topic, the number of the first message received; DDS counts from 1."""
    with closing(Index(node.home / 'spool' / 'index.db', read_only=True)) as index:
        index.open()
        return {row.topic: (row.first or 1) - 1 for row in reversed(index.accounts.publishers()) if row.publisher != WRONG_TYPE}


Came = dict[str, dict[int, int]]
"""Number -> stamp of the messages in the store, by topic."""


def stored(roots: Iterable[Path]) -> tuple[Came, set[int]]:
    """The messages in the objects below these folders; and the stamps of those that arrived after a greater number."""
    came: dict[str, dict[int, int]] = {stream.topic: {} for stream in STREAMS}
    late: set[int] = set()
    for root in roots:
        for path in root.rglob('*.json'):
            if '_ledger' not in path.parts:
                document = json.loads(path.read_bytes())
                greatest = 0
                for sample in document['samples']:
                    number = parse_numbered(sample['data'])[1]
                    came[document['topic']][number] = sample['stamp_ns']
                    if number < greatest:
                        late.add(sample['stamp_ns'])
                    greatest = max(greatest, number)
    return came, late


def in_time(came: Mapping[int, int], late: set[int], stamp_ns: int, step: int) -> int:
    """The nearest stamp from there, later (1) or earlier (-1), of a message in order: late ones do not affect a row's times."""
    number = next((number for number, stamp in came.items() if stamp == stamp_ns), None)
    while number is not None and stamp_ns in late and number + step in came:
        number += step
        stamp_ns = came[number]
    return stamp_ns


def absent(came: Came, first: Mapping[str, tuple[int, int]]) -> dict[str, list[Loss]]:
    """Missing messages, by topic, in order of time.

    ``first`` are number and time of the first message received: it may be missing.
    """
    for topic, (number, stamp_ns) in first.items():
        if number not in came[topic]:
            came[topic][number - 1] = stamp_ns
    return {
        topic: [Loss(numbers[one], numbers[two], two - one - 1) for one, two in pairwise(sorted(numbers)) if two > one + 1]
        for topic, numbers in came.items()
    }


def stalls(publisher: Publisher) -> list[tuple[int, int]]:
    """When the publisher sent nothing although messages were due."""
    found: list[tuple[int, int]] = []
    for stream in STREAMS:
        period_ns = round(stream.period_s * SECOND)
        found += [(begin + period_ns, end) for begin, end in publisher.pauses_numbered(stream.topic, period_ns + LATE_NS)]
    return sorted(found)


def stalled_ns(stalls: Sequence[tuple[int, int]], from_ns: int, to_ns: int) -> int:
    """How much of this time the publisher was stalled."""
    total, at_ns = 0, from_ns
    for begin_ns, end_ns in stalls:
        if min(end_ns, to_ns) > max(begin_ns, at_ns):
            total += min(end_ns, to_ns) - max(begin_ns, at_ns)
            at_ns = min(end_ns, to_ns)
    return total


def journaled(rows: Sequence[Gap]) -> dict[str, list[Loss]]:
    """The journal's rows of objects, by topic."""
    found: dict[str, list[Loss]] = {stream.topic: [] for stream in STREAMS}
    for row in rows:
        found[row.topic].append(Loss(row.from_ns or 0, row.to_ns or 0, row.count or 0, row.cause))
    return {topic: sorted(losses) for topic, losses in found.items()}


def together(real: Sequence[Loss], reported: Sequence[Loss], near_ns: int) -> list[tuple[list[Loss], list[Loss]]]:
    """Actual and reported losses, in groups that are apart."""
    groups: list[tuple[list[Loss], list[Loss]]] = []
    end_ns = 0
    for loss in sorted((*real, *reported)):
        if not groups or loss.from_ns > end_ns + near_ns:
            groups.append(([], []))
            end_ns = 0
        groups[-1][bool(loss.cause)].append(loss)
        end_ns = max(end_ns, loss.to_ns)
    return groups


def on_page(processes: Processes, node: Node) -> list[Gap] | None:
    """Today's rows on the timeline of the live page, in a Chromium; None if there is none."""
    chromium = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
    if chromium is None or find_spec('playwright') is None:
        progress('there is no Chromium here: the live page is not looked at')
        return None
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - for this alone

    _, url = processes.page(node)
    with sync_playwright() as playwright, closing(playwright.chromium.launch(executable_path=chromium, args=FLAGS)) as browser:
        page = browser.new_page()
        page.goto(url)
        gaps = page.locator('rect.gap')
        with page.expect_response(lambda answer: answer.url.endswith('/api/gaps')) as today:  # without a time: the whole day
            page.get_by_role('button', name='Today', exact=True).dispatch_event('click')
        count = len(today.value.json()['gaps'])
        until(lambda: gaps.count() == count, lambda: f'the page shows the {count} gaps of today: {gaps.count()}')
        report = gaps.evaluate_all('gaps => gaps.map(gap => ({...gap.dataset}))')
    return [
        Gap(OBJECTS, gap['topic'], None, None, gap['kind'], gap['cause'], round(float(gap['from']) * 1e6),
            round(float(gap['to']) * 1e6), None, None, int(gap['count']), 1, '', None)
        for gap in report
    ]  # fmt: skip


def audit(found: Found, node: Node, roots: Iterable[Path], who: str, still: Sequence[tuple[int, int]],
          rows: Sequence[Gap]) -> None:  # fmt: skip
    """Compare one node's journal, or the page's view of it, with what it stored; ``still`` is when the publisher was stalled."""
    found.fail('every loss has a time', f'{who}: {[row for row in rows if row.from_ns is None]}',
              holds=all(row.from_ns is not None for row in rows))  # fmt: skip
    reported = journaled([row for row in rows if row.from_ns is not None])
    came, late = stored(roots)
    real = absent(
        came, {topic: (first, reported[topic][0].from_ns) for topic, first in began(node).items() if reported.get(topic)}
    )
    for stream in STREAMS:
        near_ns = round(stream.period_s * SECOND) + LATE_NS
        found.gaps += len(real[stream.topic])
        for lost, journal in together(real[stream.topic], reported[stream.topic], near_ns):
            text = f'{who} {stream.topic}: in truth {lost}, in the journal {journal}'
            found.fail('every loss is in the journal, and nothing else', text, holds=bool(lost) and bool(journal))
            if not (lost and journal):
                continue
            numbers = came[stream.topic]
            begin_ns = in_time(numbers, late, min(loss.from_ns for loss in lost), -1)
            end_ns = in_time(numbers, late, max(loss.to_ns for loss in lost), 1)
            counts = [sum(loss.count for loss in each) for each in (lost, journal)]
            found.fail('with its count', text, holds=counts[0] == counts[1])
            causes = {loss.cause for loss in journal}
            reported_ns = min(loss.from_ns for loss in journal), max(loss.to_ns for loss in journal)
            off_ns = max(abs(reported_ns[0] - begin_ns) - stalled_ns(still, begin_ns, reported_ns[0]),
                         abs(reported_ns[1] - end_ns) - stalled_ns(still, reported_ns[1], end_ns))  # fmt: skip
            bound_ns = near_ns + (round(BATCH_S * SECOND) if 'restart' in causes else 0)
            found.fail('within a period of its time, after a kill within the open batch', text, holds=off_ns <= bound_ns)
            for loss in journal:
                found.lost[loss.cause] += loss.count
            why = [each.what for each in found.done if each.from_ns <= end_ns and each.to_ns >= begin_ns]
            allowed = set[str]().union(*(ALLOWED[what] for what in why))
            found.fail('with its cause', f'{text}, after {why}', holds=causes <= allowed)


def _audit_both(found: Found, node: Node, roots: Sequence[Path], who: str, still: Sequence[tuple[int, int]],
                shown: Mapping[Path, Sequence[Gap] | None]) -> None:  # fmt: skip
    """The journal, and the timeline of the page, by the same bars."""
    audit(found, node, roots, who, still, ledger.journal(node.home / 'spool', ROBOT))
    on_page = shown[node.home]
    if on_page is not None:
        seen = Found(done=found.done)
        audit(seen, node, roots, f'{who}, on the page,', still, on_page)
        found.shown += len(on_page)
        for bar, wrong in seen.wrong.items():
            found.fail(f'on the page: {bar}', '; '.join(wrong[:3]), holds=not wrong)


@dataclass(slots=True)
class Scene:
    """The disturbed node, and the publisher."""

    processes: Processes
    publisher: Publisher
    node: Node
    small: Node
    """Without a store, on a separate disk if possible."""
    done: list[Done]
    rng: random.Random
    disk: Disk | None
    counts: Counter[str] = field(default_factory=Counter)
    """Quarantined objects, and those of them that were retried."""

    def await_received(self) -> None:
        """Wait until more messages of each topic have arrived."""
        before = {stream.topic: self.node.topic(stream.topic).get('received', 0) for stream in STREAMS}
        for topic, count in before.items():
            self.node.received(topic, count + 1)

    def stopped(self) -> None:
        self.node.signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        self.node.signal(signal.SIGCONT)

    def starved(self) -> None:
        end_s = time.monotonic() + STARVED_S
        while time.monotonic() < end_s:
            self.node.signal(signal.SIGSTOP)
            time.sleep(STARVED_EACH_S - STARVED_TURN_S)
            self.node.signal(signal.SIGCONT)
            time.sleep(STARVED_TURN_S)

    def paused(self) -> None:
        self._ask(paused=True)
        time.sleep(PAUSED_S)
        self._ask(paused=False)

    def killed(self) -> None:
        self.node.kill()
        time.sleep(KILLED_S)
        self.node = start(self.processes)
        self.await_received()

    def filled(self) -> None:
        """Fill the disk of the other node."""
        assert self.disk is not None
        filler, end_s = self.disk.path / 'filler', time.monotonic() + FILLED_S
        with filler.open('wb', buffering=0) as file:
            while time.monotonic() < end_s:
                with suppress(OSError):
                    while file.write(bytes(1 << 16)):
                        pass
                time.sleep(0.02)
        filler.unlink()

    def damaged(self) -> None:
        """Change files while their objects wait for delivery; some are restored before they are retried."""
        spool, before = self.node.home / 'spool', self.node.ledger()['objects']['quarantined']
        bodies: dict[str, bytes] = {}
        names: list[str] = []

        def is_damaged() -> bool:
            new = self._damage(spool / 'ready')
            bodies.update(new)
            names.extend(name for name in new if self._is_quarantined(name))
            return bool(names)

        until(is_damaged, 'a damaged object is quarantined')
        self.counts['quarantined'] += len(names)
        again = [name for name in names if self.rng.random() < RETRIED]
        for name in again:
            with (spool / 'quarantine' / 'damaged' / name).open('r+b') as file:
                file.write(bodies[name][:1])
        assert self.node.ledger()['objects']['quarantined'] == before + len(names)
        assert not again or retry(spool, names=again).objects == len(again)
        self.counts['retried'] += len(again)
        until(lambda: all((self.node.home / 'store' / name).exists() for name in again), 'what was mended is delivered')

    def _damage(self, ready: Path) -> dict[str, bytes]:
        """Change the first byte of waiting files while the node is stopped; returns their original content, by bucket and key."""
        bodies: dict[str, bytes] = {}
        self.node.signal(signal.SIGSTOP)
        try:
            for path in ready.glob(f'sensor-data/{ROBOT}/*_*/*/*.json'):
                with (
                    suppress(FileNotFoundError),
                    path.open('r+b') as file,
                ):  # threads that were about to stop may have finished a step
                    body = file.read()
                    file.seek(0)
                    file.write(bytes([body[0] ^ 1]))
                    bodies[str(path.relative_to(ready))] = body
        finally:
            self.node.signal(signal.SIGCONT)
        return bodies

    def _is_quarantined(self, name: str) -> bool:
        """Or delivered: it had been read already."""
        quarantined = self.node.home / 'spool' / 'quarantine' / 'damaged' / name
        until(lambda: quarantined.exists() or (self.node.home / 'store' / name).exists(), f'{name} leaves')
        return quarantined.exists()

    def disturb(self, what: str) -> None:
        """Do it, and note when it was done."""
        begin_ns = time.time_ns()
        getattr(self, what)()
        after_s = BESIDE_S + (RESTARTED_S if what == 'killed' else STEADY_S)
        self.done.append(Done(what, begin_ns - round((BATCH_S + 2.0) * SECOND), time.time_ns() + round(after_s * SECOND)))
        time.sleep(STEADY_S)

    def _ask(self, *, paused: bool) -> None:
        with closing(connect(self.node.home / 'spool', ROBOT)) as connection:
            connection.ask('pause' if paused else 'resume')


def start(processes: Processes, home: str = '', tower: dict[str, str] | None = None, **more: Any) -> Node:
    """A node that stores every message of each topic."""
    given: dict[str, Any] = {'sensors': [stream.topic.strip('/') for stream in STREAMS], 'robot': ROBOT,
                             'queue.max_bytes': 256 << 20, **more}  # fmt: skip
    for stream in STREAMS:
        name = stream.topic.strip('/')
        given |= {f'{name}.topics': [name], f'{name}.types': [STRING], f'{name}.rate_hz': 0.0, f'{name}.batch_s': BATCH_S}
    return processes.node(tower, given, home=home or 'home')


def _disk(folder: Path, opened: ExitStack) -> Disk | None:
    try:
        return opened.enter_context(small_disk(folder, DISK_MB))
    except NotAllowed:
        progress('this machine lets nobody mount anything: no disk is filled')
        return None


def campaign(folder: Path, disturbances: int, rng: random.Random) -> Found:
    """Run and audit."""
    found = Found()
    with free_domain() as domain, ExitStack() as opened:
        disk = _disk(folder, opened)
        processes = Processes(folder, domain, ROBOT)
        try:
            publisher = processes.publisher()
            for stream in STREAMS:
                publisher.create(stream.topic, STRING, reliable=stream.reliable, depth=10)
            node = start(processes)
            room = {'spool.max_bytes': SMALL_ROOM, 'shutdown.drain_s': 0.0}
            small = start(processes, str(disk.path / 'home') if disk else 'small', NO_STORE, **room)
            for stream in STREAMS:
                publisher.matched(stream.topic, 2)
                publisher.begin_numbered(stream.topic, 'p', stream.size, stream.period_s)
            readers = [Reader(each.home) for each in (node, small)]
            for reader in readers:
                reader.open()
            began_ns = time.time_ns()
            scene = Scene(processes, publisher, node, small, found.done, rng, disk)
            scene.await_received()
            time.sleep(STEADY_S)
            kinds = [kind for kind in KINDS if disk or kind != 'filled']
            for turn in range(disturbances):
                what = kinds[turn] if turn < len(kinds) else rng.choice(kinds)
                progress(f'{turn + 1}: {what}')
                scene.disturb(what)
            scene.await_received()
            time.sleep(max(STEADY_S, EVICTED_S - (time.time_ns() - began_ns) / SECOND))
            for stream in STREAMS:
                publisher.halt_numbered(stream.topic)
            still = stalls(publisher)
            quiet((scene.node, small))
            for each in (scene.node, small):
                each.stop()
            shown = {each.home: on_page(processes, each) for each in (scene.node, small)}
            for reader in readers:
                reader.close()
                found.commits += reader.count
                found.fail('the ledger balances at every commit', '; '.join(reader.unbalanced[:3]), holds=not reader.unbalanced)
        finally:
            processes.end()
        _audit_both(found, scene.node, [scene.node.home / 'store' / 'sensor-data' / ROBOT], 'disturbed', still, shown)
        own, filled = found.done, [each for each in found.done if each.what == 'filled']
        found.done = [Done('evicted', began_ns - 60 * SECOND, time.time_ns()), *filled]
        _audit_both(found, small, [small.home / 'spool' / 'ready' / 'sensor-data' / ROBOT], 'without room', still, shown)
        found.done = own
    found.counts = scene.counts
    for cause in ('transport', 'restart', 'paused', 'no_room', 'damaged'):
        found.fail(f'messages were lost by {cause}', f'{found.lost}', holds=found.lost[cause] > 0)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('gaps', __doc__ or '')
    options.add_argument('--disturbances', type=int, default=0, help=f'how many (default {DISTURBANCES})')
    given = options.parse_args(argv)
    count = given.disturbances or (SHORT_DISTURBANCES if given.short else DISTURBANCES)
    progress(f'{count} disturbances, seed {given.seed}')
    with workshop(given) as shop:
        found = campaign(shop.folder, count, random.Random(given.seed))
        shop.passed = all(bar.holds for bar in found.bars())
    figures = {'seed': given.seed, 'disturbances': Counter(each.what for each in found.done), 'gaps': found.gaps,
               'on_the_page': found.shown, 'lost': found.lost, **found.counts, 'readings': found.commits}  # fmt: skip
    if not given.json:
        print(figures)
    return verdict(figures, found.bars(), as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
