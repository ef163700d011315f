"""Simulated weeks of a robot that keeps its recordings: shifts, a dock, two WiFi networks, a disk that others fill, requests.

Time is virtual; spool, rules, thinning, requests, catalog and the store, a folder, are real. Each minute of a shift the robot
records an archive of images, every ten minutes a slice of a bag, now and then an event. Every hour the ledger is compared with
the gap journal, at the end of a day with the files, the catalog and the store: nothing is thinned, evicted, sent or deleted
unless a rule says so, and of the last day at least one image per second is left. At the end ``lake prune`` keeps half.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import sqlite3
import sys
import time
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final
from unittest import mock

import orjson
from spool.making import FakeClock, assert_whole, make, receive

from shadowhound_data_logger.bags.kept import KeptCut
from shadowhound_data_logger.bags.naming import BUCKET as BAGS
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.config import CatalogSettings, KeepSettings, SpoolSettings, StoreSettings
from shadowhound_data_logger.core.mailbox import MAILBOX_BUCKET, KeptFilter, PullRequest, encode_inbox, inbox_key
from shadowhound_data_logger.core.model import (
    EVENTS_WHEN,
    UPLOAD_WHEN,
    DataObject,
    FileBody,
    Outcome,
    SpooledObject,
    State,
    waits_for,
)
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE
from shadowhound_data_logger.core.rules import read_rule
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake import gaps, prune, pull
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.prune import forgotten
from shadowhound_data_logger.node.encoding.halver import Halver
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.shipping.requests import RequestServer
from shadowhound_data_logger.shipping.thinning import Thinner
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.directory import DirectoryStore
from torture._command import Check, parser, progress, verdict, workshop

WEEKS, SHORT_DAYS = 2, 3
MONDAY_NS: Final = 1_759_708_800 * SECOND
"""2025-10-06 00:00 UTC."""
MINUTE_NS, HOUR_NS, DAY_NS = 60 * SECOND, 3600 * SECOND, 24 * 3600 * SECOND
ROBOT: Final = 'thor'
FRAMES: Final = 120
"""Images per minute: two per second."""
LEAST: Final = 60
"""Images left of a minute of the last day."""
PICTURE: Final = 96
KEEP: Final = KeepSettings(max_bytes=80_000_000, days=6.0, thin_to_hz=1.0, poll_s=10.0)
DISK: Final = 160_000_000
"""Bytes of the robot's disk."""
FREE: Final = 20_000_000
RULE: Final = 'wifi.ssid == "lab" and lowstate:bms_state.soc > 30'
EVENTS_RULE: Final = 'not wifi.ssid == "guest"'
RATE: Final = 40
"""Objects that the link carries per minute."""
SHIP: Final = {meta.ROBOT: ROBOT, meta.SHIP: meta.ON_REQUEST}
CAMERA = Channel('/front', COMPRESSED_IMAGE, '', '', '', '')
IMU = Channel('/imu', 'sensor_msgs/msg/Imu', '', '', '', '')


class World:
    """Where the robot is and which networks it sees: the facts of its rules, minute by minute."""

    def __init__(self, chance: random.Random, clock: FakeClock) -> None:
        self._chance, self._clock = chance, clock
        self.soc = 90.0
        self.ssid = 'lab'
        self.others = 0
        """Bytes of the disk that other programs use."""
        self.shift = range(0)
        self.day = -1

    def passes(self) -> None:
        """One minute passes."""
        day, minute = divmod((self._clock.now_ns - MONDAY_NS) // MINUTE_NS, 24 * 60)
        if day != self.day:
            self.day = day
            begin = self._chance.randrange(7 * 60, 10 * 60)
            self.shift = range(begin, begin + (self._chance.randrange(3 * 60, 6 * 60) if day % 7 < 6 else 0))
            self.others = self._chance.randrange(0, DISK // 4)
        if minute in self.shift:
            self.soc = max(5.0, self.soc - 0.25)
            part = (minute - self.shift.start) // 20 % 3
            self.ssid = ('', 'guest', 'lab')[part]
        else:
            self.soc = min(100.0, self.soc + 0.5)
            self.ssid = 'lab' if self._chance.random() < 0.98 else ''

    @property
    def is_working(self) -> bool:
        return (self._clock.now_ns - MONDAY_NS) // MINUTE_NS % (24 * 60) in self.shift

    def number(self, topic: str, path: Sequence[str]) -> float | str:
        return (
            self.soc if (topic, tuple(path)) == ('lowstate', ('bms_state', 'soc')) else f'no message of {topic} was received yet'
        )

    def networks(self) -> Collection[str]:
        return {self.ssid} - {''}

    def minute(self) -> int:
        return self._clock.now_ns // MINUTE_NS % (24 * 60)

    def mission(self) -> str | None:
        return 'patrol' if self.is_working else None


class Weeks:
    """A robot, its store, and the expected state of both. New; ``run`` once."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.chance = random.Random(seed)
        self.clock = FakeClock(MONDAY_NS)
        self.world = World(self.chance, self.clock)
        self.settings = StoreSettings(directory=folder / 'store')
        self.store = DirectoryStore(self.settings.directory)
        self.source = Bucket(self.settings, BUCKET)
        self.rules = {UPLOAD_WHEN: read_rule(RULE, UPLOAD_WHEN), EVENTS_WHEN: read_rule(EVENTS_RULE, EVENTS_WHEN)}
        self.closed: dict[str, str] = {}
        self.figures: Counter[str] = Counter()
        self.faults: list[str] = []
        self.recorded: dict[str, tuple[int, int]] = {}
        """Key of an archive -> its start, and its images."""
        self.asked: dict[str, dict[str, int]] = {}
        """Request -> the archives that it must deliver, with their images at that time."""
        self.sent: dict[str, int] = {}
        """Key of an archive in the store -> its images."""
        self._open()

    def run(self, days: int) -> None:
        """This many days, then the pruning."""
        self._write_inbox([])
        with mock.patch.object(Tree, 'free_bytes', side_effect=self._free):
            for minute in range(days * 24 * 60):
                self.clock.now_ns = MONDAY_NS + minute * MINUTE_NS
                self.world.passes()
                self._minute(minute)
                if minute % 60 == 59:
                    is_last = minute % (24 * 60) == 24 * 60 - 1
                    self._audit(whole=is_last)
                    if is_last:
                        _print_day(minute // (24 * 60) + 1, days, self.figures)
            self.world.ssid, self.world.soc = 'lab', 100.0
            self.spool.close()
        self._prune(days)

    # -- a minute ---------------------------------------------------------------------------------------------------------

    def _minute(self, minute: int) -> None:
        if self.world.is_working:
            self._record(self._archive())
            if minute % 10 == 0:
                self._record(self._slice(minute), topics=('bag:/front', 'bag:/imu'))
            if self.chance.random() < 0.02:
                self._record(self._event())
        if self.chance.random() < 1 / 600:
            self._restart()
        if self.world.ssid and self.chance.random() < 1 / 240:
            self._ask()
        judged = {name: rule.evaluate(self.world, minute * 60.0) for name, rule in self.rules.items() if rule is not None}
        self.closed = {name: found.why for name, found in judged.items() if not found.holds}
        for _ in range(6):
            self.server.step()
        self._write_catalog()
        if self.world.ssid:
            self._send()

    def _record(self, item: DataObject, topics: Sequence[str] = ('/camera',)) -> None:
        for topic in topics:
            receive(self.spool, item.counts.get(topic, 0) if item.counts else item.samples, topic)
        self.spool.commit([item])
        self.figures['objects recorded'] += 1

    def _archive(self) -> DataObject:
        begin_ns = self.clock.now_ns
        stamps = [begin_ns + place * MINUTE_NS // FRAMES for place in range(FRAMES)]
        members = [
            file for stamp_ns in stamps for file in (
                ArchiveFile(f'{stamp_ns:019d}.jpg', stamp_ns, self.chance.randbytes(PICTURE)),
                ArchiveFile(f'{stamp_ns:019d}.json', stamp_ns, orjson.dumps({'stamp_ns': stamp_ns})),
            )
        ]  # fmt: skip
        key = f'{ROBOT}/camera/{_day(begin_ns)}/{begin_ns}.tar'
        self.recorded[key] = begin_ns, FRAMES
        return make(key, pack_tar(members), content_type='application/x-tar', samples=FRAMES, t_start_ns=stamps[0],
                    t_end_ns=stamps[-1], metadata=SHIP, topic='/camera')  # fmt: skip

    def _slice(self, minute: int) -> DataObject:
        begin_ns = self.clock.now_ns
        folder = self.folder / 'recording'
        folder.mkdir(exist_ok=True)
        writer = SliceWriter(folder / f'patrol_{minute}.mcap')
        pictures = ((begin_ns + place * SECOND // 10, 0) for place in range(50))
        stamps = sorted([*pictures, *((begin_ns + place * SECOND // 50, 1) for place in range(250))])
        for sequence, (stamp_ns, which) in enumerate(stamps):
            writer.write((CAMERA, IMU)[which], stamp_ns, stamp_ns, sequence, self.chance.randbytes((400, 48)[which]))
        info = writer.close()
        counts = {f'bag:{topic}': count for topic, count in info.counts.items()}
        return DataObject(
            bucket=BAGS, key=f'{ROBOT}/rosbags/patrol_{_day(begin_ns)}/patrol_{minute}.mcap',
            body=FileBody(info.path, info.bytes, info.sha256), content_type='application/octet-stream', sensor='bag',
            topic=None, type='', samples=info.messages, t_start_ns=info.t_start_ns, t_end_ns=info.t_end_ns, priority=5,
            protected=False, metadata={**SHIP, meta.MESSAGES: str(info.messages)}, counts=counts,
        )  # fmt: skip

    def _event(self) -> DataObject:
        now_ns = self.clock.now_ns
        self.figures['events'] += 1
        return make(f'{ROBOT}/camera/{_day(now_ns)}/event_{now_ns}.jpg', self.chance.randbytes(2000), t_start_ns=now_ns + 1,
                    t_end_ns=now_ns + 1, protected=True, metadata={meta.ROBOT: ROBOT, meta.EVENT: 'bump'})  # fmt: skip

    def _ask(self) -> None:
        """Request up to an hour of the camera, of the last three days."""
        since_ns = self.clock.now_ns - self.chance.randrange(3 * DAY_NS)
        want = KeptFilter(sensor='camera', since_ns=since_ns, until_ns=since_ns + self.chance.randrange(HOUR_NS))
        asked = PullRequest(robot=ROBOT, by=self.chance.choice(('ada', 'bob')), made_ns=self.clock.now_ns,
                            expires_ns=self.clock.now_ns + 5 * DAY_NS, priority=5, want=want)  # fmt: skip
        self._write_inbox([*self.entries[-50:], asked.to_json()])
        self.server.step()
        for _ in range(20):
            self.server._poll_at_s = 0.0  # it polls immediately
            self.server.step()
            if any(row.id == asked.id for row in self.spool.reading.requests.rows()):
                break
        else:
            self.faults.append(f'{iso(self.clock.now_ns)}: a request was not accepted')
        wanted = "state IN ('kept', 'pending') AND id IN (SELECT id FROM requested WHERE request = ?)"
        self.asked[asked.id] = {row['key']: row['samples'] for row in self._rows(wanted, asked.id)}
        self.figures['requests'] += 1
        self.figures['objects asked for'] += len(self.asked[asked.id])

    def _send(self) -> None:
        """Send what the link carries in a minute; objects that wait for a false rule must not be sent."""
        items = self.spool.pending(RATE, waiting_for=self.closed)
        for item in items:
            rule = waits_for(_sensor(item), item.metadata, protected=self._is_protected(item))
            if rule in self.closed:
                self.faults.append(f'{iso(self.clock.now_ns)}: {item.key} was sent, though {self.closed[rule]}')
            self.store.put(item)
            if item.key in self.recorded:
                self.sent[item.key] = int(item.metadata[meta.COUNT])
        self.spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])
        self.figures['objects sent'] += len(items)

    def _write_catalog(self) -> None:
        self.now_s = (self.clock.now_ns - MONDAY_NS) / SECOND
        self.spool.commit(self.catalog.due())

    def _restart(self) -> None:
        self.spool.close()
        self._open()
        self.figures['starts'] += 1

    def _open(self) -> None:
        spool = SpoolSettings(min_free_bytes=FREE, max_bytes=30_000_000)
        self.spool = Spool(self.folder / 'spool', spool, self.clock, ROBOT, KEEP)
        self.spool.open()
        self.now_s = (self.clock.now_ns - MONDAY_NS) / SECOND
        self.catalog = CatalogWriter(self.folder / 'spool', CatalogSettings(), ROBOT, self.clock, lambda: self.now_s, keeps=True)
        home = self.folder / 'home'
        thinner = Thinner(self.spool, KEEP.thin_to_hz, Halver(home, ROBOT, KEEP.thin_to_hz))
        self.server = RequestServer(
            self.spool, self.store, KEEP, ROBOT, self.clock, put=self._put, released=lambda _: None,
            cutter=partial(KeptCut, home), thin=thinner.step, monotonic=lambda: self.now_s,
        )  # fmt: skip

    def _put(self, item: DataObject) -> None:
        self.spool.commit([item])

    def _free(self) -> int:
        """Free space on a disk with other programs."""
        if not hasattr(self, 'spool'):
            return DISK
        kept = sum(size for (size,) in self._query("SELECT bytes FROM tally WHERE topic <> '' AND state IN ('kept', 'pending')"))
        return DISK - self.world.others - kept

    # -- audits -----------------------------------------------------------------------------------------------------------

    def _audit(self, *, whole: bool) -> None:
        """At the end of an hour; ``whole`` at the end of a day, when files are read and the store is checked as well."""
        now = iso(self.clock.now_ns)
        self.figures['hours'] += 1
        if whole:
            assert_whole(self.folder / 'spool')
        found = self._rows("sensor = 'camera' AND metadata LIKE '%on_request%'")
        causes = dict(self._query("SELECT cause, sum(count) FROM gaps WHERE kind IN ('evicted', 'quarantined') GROUP BY cause"))
        self.figures['messages thinned'] = causes.get('thinned', 0)
        self.figures['messages evicted'] = sum(causes.values()) - causes.get('thinned', 0)
        for cause in causes.keys() - {'thinned', 'keep_limit', 'keep_days'}:
            self.faults.append(f'{now}: {causes[cause]} messages are lost because of {cause}')
        self._check_last_day(now, found)
        self._check_requests(now)
        self._check_gaps(now)
        if whole and not self.closed and self._is_catalog_current():
            self._check_store(now)

    def _check_last_day(self, now: str, found: Sequence[dict[str, Any]]) -> None:
        """One image per second of each recorded minute, on the robot or in the store."""
        there = {row['key']: row['samples'] for row in found if row['state'] in {'kept', 'pending', 'delivered'}} | self.sent
        for key, (begin_ns, _) in self.recorded.items():
            if begin_ns >= self.clock.now_ns - DAY_NS and there.get(key, 0) < LEAST:
                self.faults.append(f'{now}: of {iso(begin_ns)} {there.get(key, 0)} pictures are left')

    def _check_requests(self, now: str) -> None:
        """Requested objects arrive with their content at the time of the request."""
        for request, wanted in list(self.asked.items()):
            late = [key for key, count in wanted.items() if key in self.sent and self.sent[key] != count]
            if late:
                self.faults.append(f'{now}: {len(late)} objects of a request were thinned after it was accepted')
            if all(key in self.sent for key in wanted):
                self.figures['requests served'] += bool(wanted)
                del self.asked[request]

    def _check_gaps(self, now: str) -> None:
        """The gap journal has each message that the ledger counts as evicted."""
        reported = dict(self._query("SELECT topic, sum(count) FROM gaps WHERE kind = 'evicted' GROUP BY topic"))
        tally = dict(self._query("SELECT topic, samples FROM tally WHERE state = 'evicted' AND topic <> '' AND samples > 0"))
        if {topic: count for topic, count in reported.items() if count} != tally:
            self.faults.append(f'{now}: the gap journal says {reported}, the ledger {tally}')

    def _is_catalog_current(self) -> bool:
        """Whether the catalog is up to date."""
        for _ in range(40):
            self.now_s += 60.0
            self.spool.commit(self.catalog.due())
            self._send()
            if not self._query('SELECT 1 FROM unreported LIMIT 1') and not self._query(
                "SELECT 1 FROM objects WHERE state = 'pending' LIMIT 1"
            ):
                return True
        return False

    def _check_store(self, now: str) -> None:
        """The store's list of kept and stored objects is correct."""
        self.figures['days held against the store'] += 1
        findings = Findings(lambda _: None)
        kept = {
            row['key']: (row['bytes'], row['count']) for row in pull.kept(self.source, ROBOT, KeptFilter(), findings).to_pylist()
        }
        own = {row['key']: (row['bytes'], json.loads(row['metadata']).get(meta.COUNT)) for row in self._rows("state = 'kept'")}
        for key in kept.keys() ^ own.keys():
            self.faults.append(
                f'{now}: {key} is {"kept, and the catalog does not say so" if key in own else "in the catalog alone"}'
            )
        for key in kept.keys() & own.keys():
            if kept[key][0] != own[key][0] or (own[key][1] is not None and kept[key][1] != int(own[key][1])):
                self.faults.append(f'{now}: {key} has {own[key]}, the catalog says {kept[key]}')
        for topic, sink in (('/camera', 'objects'), ('/front', 'bags')):
            report = gaps.newest(self.source, robot=ROBOT, topic=topic, sink=sink, findings=findings).to_pylist()
            reported = sum(row['count'] or 0 for row in report if row['kind'] == 'evicted')
            account = topic if sink == 'objects' else f'bag:{topic}'
            count = next(
                (count for (count,) in self._query("SELECT samples FROM tally WHERE state = 'evicted' AND topic = ?", account)), 0
            )
            if reported != count:
                self.faults.append(
                    f'{now}: the journal in the store has {reported} evicted messages of {topic}, the ledger {count}'
                )
        for key in self.sent:
            if self.store.head(BUCKET, key) is None:
                self.faults.append(f'{now}: {key} is not in the store')

    def _prune(self, days: int) -> None:
        """Keep half of the time of the camera; each deletion has its row."""
        now_ns = MONDAY_NS + days * DAY_NS
        findings = Findings(lambda _: None)
        since = max(1, days // 2)
        rules = prune.keep_rules(f'camera {since}d', now_ns)
        before = self._stored()
        made = prune.plan(self.source, rules, robot=ROBOT, exported={}, findings=findings)
        with mock.patch.object(time, 'time_ns', return_value=now_ns):
            prune.apply(self.source, self.store, made, now_ns=now_ns, findings=findings)
        after = self._stored()
        reported = {row['key'] for row in forgotten(self.source, ROBOT, findings).to_pylist()} if before != after else set()
        old = {key for key in before if self._ended(key) < now_ns - since * DAY_NS}
        self.figures['objects pruned'] = len(before - after)
        if before - after != old:
            self.faults.append(f'pruned: {len(before - after)} objects, where the rule names {len(old)}')
        if not (before - after) <= reported:
            self.faults.append(f'{len((before - after) - reported)} deleted objects have no row that says so')

    def _ended(self, key: str) -> int:
        """Time of the last message of a camera object; for an event its only one."""
        begin_ns, _ = self.recorded.get(key, (0, 0))
        return begin_ns + (FRAMES - 1) * MINUTE_NS // FRAMES if begin_ns else int(Path(key).stem.rpartition('_')[2])

    def _stored(self) -> set[str]:
        return {info.key for info in self.store.list(BUCKET, f'{ROBOT}/camera/')}

    def _is_protected(self, item: SpooledObject) -> bool:
        return bool(self._query('SELECT protected FROM objects WHERE id = ?', item.id)[0][0])

    def _write_inbox(self, entries: list[Any]) -> None:
        self.entries = entries
        body = encode_inbox(entries)
        if not hasattr(self, '_inbox'):
            path = self.folder / 'inbox'
            path.write_bytes(body)
            self.store.put(SpooledObject(0, MAILBOX_BUCKET, inbox_key(ROBOT), path, len(body), hashlib.sha256(body).hexdigest(),
                                        'application/json', {}, 0, 0))  # fmt: skip
            self._inbox = True
            return
        found = self.store.changed(MAILBOX_BUCKET, inbox_key(ROBOT), '', 1 << 30)
        if found is None or not self.store.replace(MAILBOX_BUCKET, inbox_key(ROBOT), body, found[1]):
            self.faults.append('the mailbox could not be written')

    def _query(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with closing(sqlite3.connect(f'file:{self.folder / "spool" / "index.db"}?mode=ro', uri=True)) as db:
            return db.execute(query, values).fetchall()

    def _rows(self, where: str, *values: object) -> list[dict[str, Any]]:
        with closing(sqlite3.connect(f'file:{self.folder / "spool" / "index.db"}?mode=ro', uri=True)) as db:
            db.row_factory = sqlite3.Row
            return [dict(row) for row in db.execute(f'SELECT * FROM objects WHERE {where}', values)]  # noqa: S608 - own constants only


def _print_day(day: int, days: int, figures: Counter[str]) -> None:
    reported = ('objects recorded', 'messages thinned', 'messages evicted', 'objects sent', 'requests', 'requests served')
    progress(f'day {day} of {days}: ' + ', '.join(f'{figures[name]:,} {name}' for name in reported))


def _day(time_ns: int) -> str:
    return iso(time_ns)[:10].replace('-', '')


def _sensor(item: SpooledObject) -> str:
    return item.metadata.get(meta.SENSOR, '')


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 1 if something was thinned, evicted, sent or deleted without a rule, or the records do not agree."""
    options = parser('weeks', 'Simulated weeks of a robot that keeps what it records.')
    options.add_argument('--weeks', type=float, help=f'how many (default {WEEKS}); in short {SHORT_DAYS} days')
    given = options.parse_args(arguments)
    days = SHORT_DAYS if given.short and given.weeks is None else math.ceil(7 * (given.weeks or WEEKS))
    progress(f'{days} days, seed {given.seed}')
    began = time.monotonic()
    with workshop(given) as shop:
        weeks = Weeks(shop.folder, given.seed)
        weeks.run(days)
        bars = [
            Check(
                'nothing happens that no rule names, and the books agree at every hour',
                not weeks.faults,
                '; '.join(weeks.faults[:5]),
            ),
            Check(
                'there was something to thin',
                weeks.figures['messages thinned'] > 100 * days,
                f'{weeks.figures["messages thinned"]:,} messages',
            ),
            Check('requests were served', weeks.figures['requests served'] > 0, f'{weeks.figures["requests served"]}'),
            Check('days ended with a look at the store', weeks.figures['days held against the store'] > 0),
        ]
        shop.passed = all(bar.holds for bar in bars)
        figures = {'seed': given.seed, 'days': days, 'took_s': round(time.monotonic() - began, 1), **weeks.figures}
        if not given.json:
            print(', '.join(f'{count:,} {what}' for what, count in weeks.figures.items()))
        return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
