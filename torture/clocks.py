"""Publishes with known clock skews and compares everything that contains a time with what was published then.

Publishers stamp with constant offsets (1 ms to 1 h), drift, steps, a stuck stamp, a delayed queue, two clocks on one topic and
simulated time that restarts. One node stores every message as an object and records a bag; it is killed (SIGKILL) once and
restarted, so that messages are lost. A witness file records what was published when. Then:

- each stored message has the right pair of times, or is dated by its arrival if its stamps are not trusted, and is counted so;
- each loss is in the gap journal, at the right place on both clocks;
- at random moments of each clock, the past of the live page, the query and the dataset show what was published then;
- ``status`` and the ledger report the topics whose stamps are off, with offset and cause, and no others.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from domains import free_domain
from e2e.bag_reading import bags
from e2e.processes import Node, Process, Processes
from e2e.reading import decode as from_cdr

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import store_settings
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP, CLOCKS
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.bucket import default_source
from shadowhound_data_logger.live.history import PastReader
from shadowhound_data_logger.live.kept import KeptSource, SpoolKept, StoreKept
from shadowhound_data_logger.live.past import PastSource, SpoolPast, StorePast
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.estimator import RESTART
from shadowhound_data_logger.spool.gaps import BAGS, OBJECTS
from shadowhound_data_logger.spool.status import read as read_status
from shadowhound_data_logger.stores import open_store
from torture._command import Check, parser, progress, some, verdict, workshop
from torture._skewed import BORDER, IMAGE, STREAMS, Skewed, number_in, witnessed

ROBOT: Final = 'torture'
SECONDS: Final = 300.0
SHORT_SECONDS: Final = 60.0
MOMENTS: Final = 100
"""On each clock."""
SPOOL_MOMENTS: Final = 25
"""Of these, also read from the spool, as by the live page on the robot."""
BATCH_S: Final = 1.0
KILLED: Final = (0.45, 0.55)
"""Times of the kill, as fractions of the run."""
KILLED_S: Final = 1.5
LATEST_NS: Final = SECOND
"""Maximum time from sending to arrival, even if the machine pauses; the results have the maximum."""
ARRIVED_NS: Final = SECOND // 2
"""The tolerance of everything else on the clock of arrival, compared with the arrivals in the bags.

Within an object, arrivals are estimated from its first and last, and on a loaded machine a message arrived 0.28 s late.
"""
EXACT_NS: Final = SECOND // 1000
"""The tolerance of displayed stamps; in objects and bags they are exact."""
OPEN_NS: Final = round((BATCH_S + 1.5) * SECOND)
"""Maximum age of messages lost in a kill; gap rows may start or end this far from the loss."""
SHOWN_NS: Final = 8 * SECOND
"""A message this new must be shown at a moment; the page omits messages older than ten seconds."""
IN_BAG_NS: Final = SECOND
"""The page reads bags for 1.5 s before a moment."""
AROUND_NS: Final = 3 * SECOND
NEAR_S: Final = 0.5
REPORTED_S: Final = 0.5
"""Maximum error of a reported offset."""
Name = tuple[str, int, int]
"""Topic, publisher, number."""


class Stored(NamedTuple):
    """A message in the store, by both clocks."""

    stamp_ns: int
    """The time that dates it."""
    received_ns: int
    """From the bag if it has the message, otherwise the time of sending."""

    def on(self, by: str) -> int:
        return self.stamp_ns if by == BY_STAMP else self.received_ns


@dataclass
class Run:
    """What was published and stored."""

    node: Node
    published: dict[Name, tuple[int, int]]
    """(stamp, time of sending)."""
    node_reports: dict[str, Any]
    """The ledger's ``stamps`` of each topic at the end of the publishers."""
    findings: Sequence[str]
    """Of ``status``, at the same time."""
    objects: dict[Name, Stored] = field(default_factory=dict)
    keys: dict[str, list[Name]] = field(default_factory=dict)
    """The messages of each object, by its key."""
    bag: dict[Name, tuple[int, int]] = field(default_factory=dict)
    """(publish time, log time) of each message in the bags."""

    def __post_init__(self) -> None:
        self.began_ns = min(sent_ns for _, sent_ns in self.published.values())


class Bars:
    """The requirements, and the problems found."""

    def __init__(self) -> None:
        self._wrong: dict[str, list[str]] = {}
        self.counts: Counter[str] = Counter()

    def check(self, bar: str, text: str, *, holds: bool) -> bool:
        wrong = self._wrong.setdefault(bar, [])
        self.counts[bar] += 1
        if not holds:
            wrong.append(text)
        return holds

    def all(self) -> list[Check]:
        return [Check(f'{what} ({self.counts[what]:,} checks)', not wrong, some(wrong)) for what, wrong in self._wrong.items()]


BY_TOPIC: Final = {stream.topic: stream for stream in STREAMS}


def run(folder: Path, seconds: float, rng: random.Random) -> Run:
    """Publish, kill the node, restart it, and stop it cleanly."""
    with free_domain() as domain:
        processes = Processes(folder, domain, ROBOT)
        try:
            node = start(processes)
            witness = folder / 'witness.jsonl'
            command = ['-m', 'torture._skewed', str(witness), f'{seconds}']
            publishers = Process('skewed', command, folder / 'skewed.log', processes.environ)
            processes.started.append(publishers)
            began_s = time.monotonic()
            while not (witness.exists() and witness.stat().st_size):
                if publishers.popen.poll() is not None or time.monotonic() - began_s > 2 * seconds + 60:
                    raise RuntimeError(f'nothing is published: {publishers.log}')
                time.sleep(0.05)
            killed_s = seconds * rng.uniform(*KILLED)
            time.sleep(killed_s)
            node.kill()
            time.sleep(KILLED_S)
            node = start(processes)
            progress(f'killed after {killed_s:.1f} s, started again')
            code = publishers.wait(2 * seconds)
            if code:
                raise RuntimeError(f'the publishers failed: {publishers.log}')
            time.sleep(1.0)
            reports = {topic: row['stamps'] for topic, row in node.ledger()['topics'].items()}
            findings = read_status(node.home / 'spool', ROBOT, SystemClock.of_this_machine()).findings
            (folder / 'reports.json').write_text(
                json.dumps({'stamps': reports, 'findings': list(findings)}, indent=1), encoding='utf-8'
            )
            node.stop()
        finally:
            processes.end()
    published = {(each.topic, each.publisher, each.number): (each.stamp_ns, each.sent_ns) for each in witnessed(witness)}
    return Run(node, published, reports, findings)


def start(processes: Processes) -> Node:
    """A node that stores and records every message."""
    given: dict[str, Any] = {'sensors': [stream.name for stream in STREAMS], 'bag.record': 'always', 'bag.slice_s': 20.0,
                             'catalog.period_s': 5.0}  # fmt: skip
    for stream in STREAMS:
        given |= {f'{stream.name}.topics': [stream.name], f'{stream.name}.types': [stream.type], f'{stream.name}.rate_hz': 0.0}
        given |= {f'{stream.name}.format': 'jpeg'} if stream.type == IMAGE else {f'{stream.name}.batch_s': BATCH_S}
    return processes.node(None, given)


# -- what is stored ------------------------------------------------------------------------------------------------------------


def read_bags(found: Run, folder: Path, bars: Bars) -> None:
    """Publish time is the stamp, log time the arrival."""
    bar = 'bags: publish time is the stamp, or the time of sending where stamps are not trusted; log time is the arrival'
    with closing(open_store(store_settings(os.environ, found.node.home), UploadSettings())) as store:
        for bag in bags(store, ROBOT, folder / 'bags'):
            for message in bag.messages():
                if (stream := BY_TOPIC.get(message.topic)) is None:
                    continue
                name = _name(stream, from_cdr(stream.type, message.cdr))
                stamp_ns, sent_ns = found.published[name]
                late_ns = message.log_ns - sent_ns
                text = f'{name}: {message.publish_ns - stamp_ns} ns from its stamp, {late_ns} ns after it was sent'
                is_sent = stream.by_arrival and 0 <= message.publish_ns - sent_ns <= LATEST_NS
                bars.check(bar, text, holds=(message.publish_ns == stamp_ns or is_sent) and 0 <= late_ns <= LATEST_NS)
                bars.check('bags: no message twice', str(name), holds=name not in found.bag)
                found.bag[name] = message.publish_ns, message.log_ns


def read_objects(found: Run, bars: Bars) -> None:
    """The times in content, metadata and rows."""
    rows = {row['key']: row for row in lake.objects(default_source(), robot=ROBOT).to_pylist()}
    with closing(open_store(store_settings(os.environ, found.node.home), UploadSettings())) as store:
        for info in store.list(BUCKET, f'{ROBOT}/'):
            sensor = info.key.split('/')[1]
            if (stream := BY_TOPIC.get(f'/{sensor}')) is None:
                continue
            head, body = store.head(BUCKET, info.key), store.get(BUCKET, info.key)
            assert head is not None
            _check_object(found, bars, stream, info.key, head.metadata, body)
            row = rows.get(info.key)
            same = ('t_start_ns', 't_end_ns', 'received_start_ns', 'received_end_ns', 'by_arrival')
            reported = {name: None if row is None else row[name] for name in same}
            held = {name: int(head.metadata[name]) if name in head.metadata else None for name in same}
            bars.check('rows: the times of each object', f'{info.key}: {reported} instead of {held}', holds=reported == held)


def _check_object(found: Run, bars: Bars, stream: Skewed, key: str, metadata: Mapping[str, str], body: bytes) -> None:
    messages: list[tuple[Name, int]] = []
    if stream.type == IMAGE:
        number = number_in(decode.image(body))
        messages.append(((stream.topic, 0, number), int(metadata['t_start_ns'])))
    else:
        for sample in decode.records(body):
            position = sample['pose']['pose']['position'] if 'pose' in sample else sample['position']
            messages.append(((stream.topic, int(position['y']), int(position['x'])), sample['stamp_ns']))
    arrivals, by_arrival = [], 0
    for name, dated_ns in messages:
        stamp_ns, sent_ns = found.published[name]
        log_ns = found.bag.get(name, (0, sent_ns))[1]
        arrivals.append(log_ns)
        is_by_arrival = dated_ns != stamp_ns
        by_arrival += is_by_arrival
        text = f'{name} in {key}: dated {dated_ns - stamp_ns} ns from its stamp, {dated_ns - sent_ns} ns from when it was sent'
        bars.check('objects: each message is dated by its stamp, or by its arrival where stamps are not trusted', text,
                   holds=not is_by_arrival or (stream.by_arrival and 0 <= dated_ns - sent_ns <= LATEST_NS))  # fmt: skip
        bars.check('objects: no message twice', str(name), holds=name not in found.objects)
        found.objects[name] = Stored(dated_ns, log_ns)
    found.keys[key] = [name for name, _ in messages]
    dates = [dated_ns for _, dated_ns in messages]
    reported = [int(metadata.get(word, 0)) for word in ('t_start_ns', 't_end_ns', 'received_start_ns', 'received_end_ns')]
    off = max(abs(reported[2] - min(arrivals)), abs(reported[3] - max(arrivals)))
    text = f'{key}: {reported} instead of {[min(dates), max(dates), min(arrivals), max(arrivals)]}'
    bars.check('objects: the pair of times of each', text, holds=reported[:2] == [min(dates), max(dates)] and off <= ARRIVED_NS)
    reported_by_arrival = int(metadata.get('by_arrival', 0))
    bars.check('objects: messages that are dated by their arrival are counted', f'{key}: {reported_by_arrival} of {by_arrival}',
               holds=reported_by_arrival == by_arrival)  # fmt: skip


def _name(stream: Skewed, message: Any) -> Name:
    if stream.type == IMAGE:
        return stream.topic, 0, number_in(decode.image(bytes(message.data)))
    place = message.pose.pose.position
    return stream.topic, int(place.y), int(place.x)


# -- what was lost -------------------------------------------------------------------------------------------------------------


class Loss(NamedTuple):
    """Consecutive messages of a publisher that are not stored, from the one before to the one after, on one clock."""

    from_ns: int
    to_ns: int
    count: int


def check_losses(found: Run, bars: Bars) -> None:
    """The journal must have every loss on both clocks, and nothing else."""
    journal = ledger.journal(found.node.home / 'spool', ROBOT)
    bars.check('the kill cost messages', f'{Counter(row.cause for row in journal)}',
               holds=any(row.cause == RESTART for row in journal))  # fmt: skip
    recorded = {name: Stored(*times) for name, times in found.bag.items()}
    for sink, stream in product((OBJECTS, BAGS), STREAMS):
        held = found.objects if sink == OBJECTS else recorded
        real = {by: list(_losses(held, stream, by)) for by in CLOCKS}
        rows = [row for row in journal if (row.sink, row.topic) == (sink, stream.topic)]
        counts = sum(loss.count for loss in real[BY_STAMP]), sum(row.count or 0 for row in rows)
        bars.check('journal: the count of each topic', f'{sink} {stream.topic}: {counts[1]} instead of {counts[0]}',
                   holds=counts[0] == counts[1])  # fmt: skip
        for by in CLOCKS:
            spans = [(row.from_ns, row.to_ns) if by == BY_STAMP else (row.received_from_ns, row.received_to_ns) for row in rows]
            text = f'{sink} {stream.topic} by {by}: {_spans(spans, found)} instead of {_spans(real[by], found)}'
            bars.check('journal: every row has both times', text, holds=all(None not in span for span in spans))
            known = [(begin, end) for begin, end in spans if begin is not None and end is not None]
            is_known = sink == OBJECTS or by == BY_RECEIVED or not stream.by_arrival  # bags have stamps that are not trusted
            bars.check(f'journal: the place of each loss by {by}', text, holds=not is_known or _match(real[by], known))


def _match(real: Sequence[Loss], rows: Sequence[tuple[int, int]]) -> bool:
    """Whether each row is within a loss, and each loss is covered by rows from start to end."""
    inside = all(any(loss.from_ns - OPEN_NS <= begin and end <= loss.to_ns + OPEN_NS for loss in real) for begin, end in rows)
    return inside and all(_covers(loss, rows) for loss in real)


def _covers(loss: Loss, rows: Sequence[tuple[int, int]]) -> bool:
    near = [(begin, end) for begin, end in rows if end >= loss.from_ns - OPEN_NS and begin <= loss.to_ns + OPEN_NS]
    if not near:
        return False
    first, last = min(begin for begin, _ in near), max(end for _, end in near)
    return abs(first - loss.from_ns) <= OPEN_NS and abs(last - loss.to_ns) <= ARRIVED_NS


def _losses(held: Mapping[Name, Stored], stream: Skewed, by: str) -> Iterator[Loss]:
    for publisher in range(len(stream.stamps)):
        numbers = sorted(number for topic, of, number in held if (topic, of) == (stream.topic, publisher))
        for one, two in pairwise(numbers):
            if two > one + 1:
                before, after = (held[stream.topic, publisher, number].on(by) for number in (one, two))
                yield Loss(before, after, two - one - 1)


def _spans(spans: Sequence[tuple[Any, ...]], found: Run) -> list[list[Any]]:
    """In seconds from the first message, readable."""
    return [
        [None if at is None else round((at - found.began_ns) / SECOND, 2) for at in span[:2]] + list(span[2:]) for span in spans
    ]


# -- what is shown -------------------------------------------------------------------------------------------------------------


class Timeline:
    """The stored messages of one topic in the order of one clock."""

    def __init__(self, held: Mapping[Name, Stored], topic: str, by: str) -> None:
        pairs = sorted((stored.on(by), name) for name, stored in held.items() if name[0] == topic)
        self.times = [at for at, _ in pairs]
        self.names = [name for _, name in pairs]
        self.of = dict(zip(self.names, self.times, strict=True))

    def newest(self, at_ns: int, objects: Container[Name]) -> int | None:
        """The time of the newest message at or before a moment; the page reads bags only shortly before it."""
        for place in range(bisect_right(self.times, at_ns) - 1, -1, -1):
            if self.names[place] in objects or at_ns - self.times[place] <= IN_BAG_NS:
                return self.times[place]
        return None

    def nearest_ns(self, at_ns: int) -> int:
        """Distance to the nearest message."""
        place = bisect_right(self.times, at_ns)
        return min((abs(each - at_ns) for each in self.times[max(0, place - 1) : place + 1]), default=1 << 62)


def moments(lines: Mapping[str, Timeline], rng: random.Random) -> list[int]:
    """Random moments at which something was published."""
    found = []
    for _ in range(MOMENTS):
        line = lines[rng.choice(sorted(lines))]
        found.append(rng.choice(line.times) + rng.randrange(SECOND))
    return found


def slack_of(by: str, stream: Skewed) -> int:
    """The tolerance of displayed times on a clock."""
    return EXACT_NS if by == BY_STAMP and not stream.by_arrival else ARRIVED_NS


def check_page(found: Run, where: str, reader: PastReader, by: str, lines: Mapping[str, Timeline], at_ns: int,
               bars: Bars) -> None:  # fmt: skip
    """The newest message of each topic at a moment, and its age."""
    head, body = reader.moment(ROBOT, at_ns, by)
    items = _items(body)
    shown = {topic: round(age_ms * 1e6) for topic, _, age_ms, _ in head['shown']}
    for topic, line in lines.items():
        slack_ns = slack_of(by, BY_TOPIC[topic])
        due_ns = line.newest(at_ns - slack_ns, found.objects)
        if topic not in shown:
            text = f'{where} at {_place(found, at_ns)} by {by}: {topic} has one {((at_ns - (due_ns or 0)) / SECOND):.3f} s before'
            bars.check('page: the newest message of each topic is shown', text, holds=due_ns is None or at_ns - due_ns > SHOWN_NS)
            continue
        name = _shown(topic, *items[topic])
        time_ns = line.of.get(name)
        text = f'{where} at {_place(found, at_ns)} by {by}: {name}'
        if not bars.check('page: what is shown was stored', text, holds=time_ns is not None) or time_ns is None:
            continue
        text += f' of {(time_ns - at_ns) / SECOND:.3f} s, said {-shown[topic] / SECOND:.3f} s'
        text += '' if due_ns is None else f', the newest is of {(due_ns - at_ns) / SECOND:.3f} s'
        bars.check('page: what is shown at a moment is of that moment', text,
                   holds=time_ns <= at_ns + slack_ns and (due_ns is None or time_ns >= due_ns - slack_ns))  # fmt: skip
        bars.check('page: ages are measured on the chosen clock', text,
                   holds=abs(at_ns - shown[topic] - time_ns) <= max(slack_ns, EXACT_NS))  # fmt: skip


def _items(body: bytes) -> dict[str, tuple[dict[str, Any], bytes]]:
    """By topic, parsed as by the page."""
    found = {}
    while body:
        size, head_size = int.from_bytes(body[:4], 'little'), int.from_bytes(body[4:8], 'little')
        head = json.loads(body[8 : 8 + head_size])
        found[head['topic']], body = (head, body[8 + head_size : 4 + size]), body[4 + size :]
    return found


def _shown(topic: str, head: Mapping[str, Any], body: bytes) -> Name:
    if BY_TOPIC[topic].type == IMAGE:
        return topic, 0, number_in(decode.image(body))
    rows, names = head['rows'], head['names']
    values = np.frombuffer(body, '<f4', offset=8 * rows).reshape(rows, len(names))
    return topic, int(values[-1][names.index('y')]), int(values[-1][names.index('x')])


def check_query(found: Run, by: str, begins: Mapping[str, int], at_ns: int, bars: Bars) -> None:
    """The objects that start around a moment; ``begins`` has the start of each by this clock."""
    since_ns, until_ns = at_ns - AROUND_NS, at_ns + AROUND_NS
    rows = lake.objects(default_source(), robot=ROBOT, columns=('key',), by=by, since=_time(since_ns), until=_time(until_ns))
    reported = {key for key in rows['key'].to_pylist() if key in found.keys}
    for key, begin_ns in begins.items():
        slack_ns = slack_of(by, BY_TOPIC[found.keys[key][0][0]])
        text = f'at {_place(found, at_ns)} by {by}: {key} begins {(begin_ns - at_ns) / SECOND:.3f} s after'
        if min(abs(begin_ns - since_ns), abs(begin_ns - until_ns)) > slack_ns:
            bars.check('query: the objects of a time', text, holds=(key in reported) == (since_ns <= begin_ns < until_ns))


def check_dataset(found: Run, by: str, rng: random.Random, bars: Bars) -> None:
    """Random samples: the image is of their time, and data aligned with it was published then."""
    lines = {stream.topic: Timeline(found.objects, stream.topic, by) for stream in STREAMS}
    for anchor in ('camera_fine', 'camera_late'):
        first_ns, *_, last_ns = lines[f'/{anchor}'].times
        aligned = {
            stream.name: NEAR_S for stream in STREAMS
            if stream.type != IMAGE and any(first_ns <= each <= last_ns for each in lines[stream.topic].times)
        }  # fmt: skip
        dataset = lake.MissionDataset(default_source(), anchor=anchor, align=aligned, robot=ROBOT, by=by)
        bars.check('dataset: it has all pictures', f'{anchor} by {by}: {len(dataset)}',
                   holds=len(dataset) == len(lines[f'/{anchor}'].times))  # fmt: skip
        for index in rng.sample(range(len(dataset)), min(MOMENTS // 2, len(dataset))):
            sample = dataset[index]
            name = f'/{anchor}', 0, number_in(sample['image'])
            at_ns = lines[f'/{anchor}'].of[name]
            bars.check('dataset: pictures have the time of the chosen clock', f'{name} by {by}',
                       holds=abs(int(sample['stamp_ns']) - at_ns) <= slack_of(by, BY_TOPIC[f'/{anchor}']))  # fmt: skip
            for sensor in aligned:
                _check_aligned(sample, sensor, at_ns, by, lines[f'/{sensor}'], bars)
        dataset.close()


def _check_aligned(sample: Mapping[str, Any], sensor: str, at_ns: int, by: str, line: Timeline, bars: Bars) -> None:
    slack_ns = slack_of(by, BY_TOPIC[f'/{sensor}'])
    near_ns = line.nearest_ns(at_ns)
    bar = 'dataset: what is aligned was published then'
    if not sample[f'{sensor}_ok']:
        text = f'{sensor} by {by}: there is one within {near_ns / SECOND:.3f} s'
        bars.check(bar, text, holds=near_ns >= NEAR_S * SECOND - 2 * slack_ns)
        return
    name = f'/{sensor}', int(sample[sensor][1]), int(sample[sensor][0])
    away_ns = line.of[name] - at_ns
    text = f'{name} by {by}: {away_ns / SECOND:.3f} s from the picture, said {sample[f"{sensor}_dt_s"]:.3f} s'
    is_near = abs(away_ns) <= near_ns + 2 * slack_ns
    bars.check(bar, text, holds=is_near and abs(away_ns - sample[f'{sensor}_dt_s'] * SECOND) <= 2 * slack_ns)


def _time(at_ns: int) -> str:
    seconds, rest = divmod(at_ns, SECOND)
    return f'{time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))}.{rest:09d}Z'


def _place(found: Run, at_ns: int) -> str:
    return f'{(at_ns - found.began_ns) / SECOND:.3f} s'


# -- what is reported ----------------------------------------------------------------------------------------------------------


def check_reports(found: Run, bars: Bars) -> None:
    """Topics whose stamps are off are reported with offset and cause, others are not."""
    text = '\n'.join(line for line in found.findings if ': stamps ' in line)
    named = {topic for line in text.splitlines() for topic in line.partition(':')[0].split(', ')}
    for stream in STREAMS:
        report = found.node_reports[stream.topic]
        is_named = stream.topic in named
        if stream.name in BORDER:
            continue
        stated = f'{stream.topic}: {report}'
        bars.check('ledger: topics whose stamps are off are reported, and no others', stated,
                   holds=(report is not None) == bool(stream.causes))  # fmt: skip
        bars.check('status: the same topics are findings', f'{stream.topic}: {text}', holds=is_named == bool(stream.causes))
        if report is not None and stream.causes:
            bars.check('ledger: with their cause', stated, holds=report['cause'] in stream.causes)
            bars.check('ledger: with their offset', stated, holds=not stream.offset_s or (report['offset_s'] is not None and any(
                abs(report['offset_s'] - each) <= REPORTED_S for each in stream.offset_s)))  # fmt: skip


def audit(found: Run, folder: Path, rng: random.Random, bars: Bars) -> None:
    """Everything that the store, the journal and the reports state."""
    read_bags(found, folder, bars)
    read_objects(found, bars)
    stored: Counter[str] = Counter(topic for topic, _, _ in found.objects)
    for stream in STREAMS:
        bars.check('messages of every topic are stored', stream.topic, holds=stored[stream.topic] > 0)
    check_losses(found, bars)
    check_reports(found, bars)
    sources: dict[str, tuple[PastSource, KeptSource]] = {
        'the store': (StorePast(), StoreKept()),
        'the spool': (SpoolPast(found.node.home / 'spool', ROBOT), SpoolKept(found.node.home / 'spool', ROBOT)),
    }
    both = {name: Stored(*times) for name, times in found.bag.items()} | found.objects
    for by in CLOCKS:
        lines = {stream.topic: Timeline(both, stream.topic, by) for stream in STREAMS}
        at = moments(lines, rng)
        for where, (source, kept) in sources.items():
            with closing(PastReader(source, kept)) as reader:
                for at_ns in at if where == 'the store' else at[:SPOOL_MOMENTS]:
                    check_page(found, where, reader, by, lines, at_ns, bars)
        begins = {key: min(found.objects[name].on(by) for name in names) for key, names in found.keys.items()}
        for at_ns in at:
            check_query(found, by, begins, at_ns, bars)
        check_dataset(found, by, rng, bars)
        progress(f'looked at {len(at)} moments by {by}')


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('clocks', __doc__ or '')
    options.add_argument('--seconds', type=float, default=0.0, help=f'how long is published, {SECONDS:g} by default')
    given = options.parse_args(argv)
    seconds = given.seconds or (SHORT_SECONDS if given.short else SECONDS)
    progress(f'{seconds:g} s, seed {given.seed}')
    rng, bars = random.Random(given.seed), Bars()
    with workshop(given) as shop:
        found = run(shop.folder, seconds, rng)
        for name in [name for name in os.environ if name.startswith('AWS_')]:
            del os.environ[name]
        os.environ['SHADOWHOUND_HOME'] = str(found.node.home)
        audit(found, shop.folder, rng, bars)
        shop.passed = all(bar.holds for bar in bars.all())
    latest = [log_ns - found.published[name][1] for name, (_, log_ns) in found.bag.items()]
    figures = {
        'seed': given.seed, 'seconds': seconds, 'published': len(found.published), 'stored': len(found.objects),
        'in_bags': len(found.bag), 'objects': len(found.keys), 'latest_arrival_ms': round(max(latest, default=0) / 1e6, 1),
    }  # fmt: skip
    if not given.json:
        print(figures)
    return verdict(figures, bars.all(), as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
