"""Audits a run of kills: what was published (by a witness), what the store has, and the ledger.

From the code under test it only uses the rows of its index and its ledger; contents are read by other libraries.
"""

from __future__ import annotations

import hashlib
import io
import json
import sqlite3
import statistics
import struct
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
from e2e.reading import TYPES, assert_same, decode
from e2e.witness import recorded
from pypcd4.pypcd4 import PointCloud

from shadowhound_data_logger.stores.base import ObjectStore
from torture._command import Check, some

SECOND: Final = 10**9
BUCKET: Final = 'sensor-data'
CAMERA, CLOUDS, CALIBRATION = '/camera/compressed', '/point_cloud2', '/camera/camera_info'
HEADERLESS: Final = frozenset({'/imu', '/go2_states', '/lowstate'})
BEST_EFFORT: Final = (CLOUDS, CALIBRATION)
"""The witness may miss some of these."""
WHOLE: Final = tuple(topic for topic in TYPES if topic != CALIBRATION)
"""Topics whose messages are all stored; the calibration is stored when it changes."""
READERS: Final = 4
LOSS_S: Final = 1.25
"""Maximum loss per kill of received messages: a batch of one second and the commit window."""
SLACK_S: Final = 0.15
"""Two polls for a batch to be closed, and the commit itself."""
DISCOVERY_S: Final = 3.0
"""Time for the publishers to discover a new node on a busy machine."""


class Kill(NamedTuple):
    """When a node was killed, and when the next one listened (infinite if it never did), s since 1970."""

    at: float
    ready: float


class Gap(NamedTuple):
    """Consecutive messages that are not stored: their number before and after the kill, and the surrounding times, s."""

    before: int
    away: int
    before_s: float
    """Age of the oldest of them when the node was killed."""
    away_s: float
    """From the first kill to the first message that is stored again."""


@dataclass(slots=True)
class Audit:
    """The result; ``wrong`` has one sentence per problem."""

    wrong: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    objects: int = 0
    samples: int = 0
    gaps: dict[str, list[Gap]] = field(default_factory=dict)

    def bars(self) -> list[Check]:
        whats = ('torn', 'overwritten', 'duplicate', 'foreign', 'unequal', 'unaccounted', 'unbalanced', 'not delivered',
                 'lost without a kill', 'lost beyond the bar')  # fmt: skip
        return [Check(f'0 {what}', not self.wrong[what], some(self.wrong[what])) for what in whats]

    def losses(self) -> dict[str, dict[str, float]]:
        """By topic, over all gaps: samples and milliseconds, median and maximum."""
        table: dict[str, dict[str, float]] = {}
        for topic, gaps in self.gaps.items():
            figures: dict[str, Sequence[float]] = {
                'received_samples': [gap.before for gap in gaps],
                'received_ms': [round(gap.before_s * 1e3) for gap in gaps],
                'all_samples': [gap.before + gap.away for gap in gaps],
                'all_ms': [round((gap.before_s + gap.away_s) * 1e3) for gap in gaps],
            }
            table[topic] = {'gaps': len(gaps)} | {
                f'{name}_{word}': pick(values or [0])
                for name, values in figures.items()
                for word, pick in (('median', statistics.median), ('worst', max))
            }
        return table


class Heard:
    """What the witness received: topic -> stamp (the header's, otherwise the time of sending) -> message."""

    def __init__(self, recording: Path) -> None:
        self.sent_ns: dict[str, dict[int, int]] = defaultdict(dict)
        self.messages: dict[str, dict[int, bytes]] = defaultdict(dict)
        """Serialized; for large ones the SHA-256 of their data."""
        for topic, source_ns, cdr in recorded(recording):
            sec, nanosec = struct.unpack_from('<iI', cdr, 4)
            stamp = source_ns if topic in HEADERLESS else sec * SECOND + nanosec
            self.sent_ns[topic][stamp] = source_ns
            large = topic in {CAMERA, CLOUDS}
            self.messages[topic][stamp] = _digest(bytes(decode(TYPES[topic], cdr).data)) if large else cdr


def audit(heard: Heard, reported: Mapping[str, int], ledger: Mapping[str, Any], index: Path, store: ObjectStore,
          robot: str, kills: Sequence[Kill]) -> Audit:  # fmt: skip
    """The complete audit; ``reported`` are the robot's own counts, ``ledger`` the final one."""
    found = Audit()
    stored = _objects(found, heard, index, store, robot)
    _accounts(found, heard, reported, ledger, stored)
    for topic in WHOLE:
        found.gaps[topic] = _gaps(found, topic, heard.sent_ns[topic], stored[topic], kills)
    return found


def _objects(found: Audit, heard: Heard, index: Path, store: ObjectStore, robot: str) -> dict[str, set[int]]:
    """Compare every object of the store with its row and with what was published; returns the stored stamps by topic."""
    with sqlite3.connect(index) as db:
        columns = 'key, state, sha256, topic, t_start_ns, samples'
        rows = {row[0]: row[1:] for row in db.execute(f'SELECT {columns} FROM objects')}  # noqa: S608 - own constants
    db.close()
    keys = {info.key for info in store.list(BUCKET, f'{robot}/')}
    found.wrong['foreign'] += sorted(keys - set(rows))
    found.wrong['not delivered'] += sorted(key for key, row in rows.items() if row[0] != 'delivered' or key not in keys)
    stored: dict[str, set[int]] = defaultdict(set)
    with ThreadPoolExecutor(READERS) as pool:
        bodies = pool.map(lambda key: store.get(BUCKET, key), sorted(keys & set(rows)))
        for key, body in zip(sorted(keys & set(rows)), bodies, strict=True):
            _, sha256, topic, start_ns, samples = rows[key]
            found.objects += 1
            if hashlib.sha256(body).hexdigest() != sha256:
                found.wrong['overwritten' if _reads(topic, body) else 'torn'].append(key)
                continue
            if topic is None:
                continue
            stamps = _compare(found, key, topic, body, start_ns, heard)
            if len(stamps) != samples:
                found.wrong['unaccounted'].append(f'{key} holds {len(stamps)} samples, its row says {samples}')
            found.wrong['duplicate'] += [f'{topic} {stamp} again in {key}' for stamp in stamps if stamp in stored[topic]]
            stored[topic].update(stamps)
            found.samples += len(stamps)
    return stored


def _compare(found: Audit, key: str, topic: str, body: bytes, start_ns: int, heard: Heard) -> list[int]:
    """The stamps of an object's samples; each must match what the witness received with it."""
    stamps = [start_ns]
    if topic in BEST_EFFORT and start_ns not in heard.messages[topic]:
        return stamps
    try:
        if topic == CAMERA:
            assert _digest(body) == heard.messages[topic][start_ns]
        elif topic == CLOUDS:
            cloud = PointCloud.from_fileobj(cast('Any', io.BytesIO(body)))
            points = np.stack([cloud.pc_data[name] for name in ('x', 'y', 'z', 'intensity')], axis=1)
            assert _digest(points.tobytes()) == heard.messages[topic][start_ns]
        elif topic == CALIBRATION:
            own = {'robot', 'sensor', 'topic', 'type', 'timestamp', 'stamp_ns'}
            record = {name: value for name, value in json.loads(body).items() if name not in own}
            assert_same(record, decode(TYPES[topic], heard.messages[topic][start_ns]), TYPES[topic])
        else:
            samples = json.loads(body)['samples']
            stamps = [sample['stamp_ns'] for sample in samples]
            for sample in samples:
                assert_same(sample, decode(TYPES[topic], heard.messages[topic][sample['stamp_ns']]), TYPES[topic])
    except (AssertionError, KeyError) as error:
        found.wrong['unequal'].append(f'{key}: {type(error).__name__} {error}')
    return stamps


def _reads(topic: str | None, body: bytes) -> bool:
    """Whether the content is a complete object, though not the one that was spooled."""
    ends: dict[str | None, Callable[[], bool]] = {CAMERA: lambda: body.endswith(b'\xff\xd9'), CLOUDS: lambda: bool(body)}
    return ends.get(topic, lambda: body.rstrip().endswith(b'}'))()


def _accounts(
    found: Audit, heard: Heard, reported: Mapping[str, int], ledger: Mapping[str, Any], stored: Mapping[str, set[int]]
) -> None:
    """Robot, store and ledger must agree on published, stored and lost messages; so must a witness that can receive all."""
    unaccounted = found.wrong['unaccounted']
    for topic in TYPES:
        row = ledger['topics'].get(topic)
        if row is None:
            unaccounted.append(f'{topic} is not in the ledger')
            continue
        lost, kept = (row['missed'] or 0) + sum(row['dropped'].values()), len(stored.get(topic, ()))
        pairs = {
            'robot and ledger': (reported[topic], row['published']), 'store and ledger': (kept, row['stored']),
            'robot and all outcomes': (reported[topic], kept + lost + row['skipped']),
            'open': (row['open'], 0), 'rejected': (sum(row['rejected'].values()), 0),
        }  # fmt: skip
        if topic not in BEST_EFFORT:
            pairs['robot and witness'] = reported[topic], len(heard.sent_ns[topic])
        unaccounted += [f'{topic}, {what}: {one} and {other}' for what, (one, other) in pairs.items() if one != other]
        if causes := (set(row['missed_by']) | set(row['dropped'])) - {'restart'}:
            found.wrong['lost without a kill'].append(f'{topic}: {causes}')


def _gaps(found: Audit, topic: str, sent_ns: Mapping[int, int], stored: set[int], kills: Sequence[Kill]) -> list[Gap]:
    """Each run of messages that are not stored must belong to a kill, or to several in close succession."""
    times = sorted(sent / SECOND for sent in sent_ns.values())
    kept = sorted(sent_ns[stamp] / SECOND for stamp in stored if stamp in sent_ns)
    gaps: list[Gap] = []
    start, place = float('-inf'), 0
    for end in [*kept, float('inf')]:
        first, place = place, bisect_left(times, end, place)
        if first < place:
            inside = [kill for kill in kills if start <= kill.at <= end]
            # An encoder may be killed with a message while the next message, of another encoder, is durable already.
            inside = inside or [kill for kill in kills if end < kill.at <= end + LOSS_S + SLACK_S][:1]
            if inside:
                gaps.append(_gap(found.wrong['lost beyond the bar'], topic, times[first:place], end, inside))
            else:
                found.wrong['lost without a kill'].append(f'{topic}: {place - first} messages at {times[first]:.2f}')
        start, place = end, place + 1
    return gaps


def _gap(beyond: list[str], topic: str, lost: Sequence[float], end: float, kills: Sequence[Kill]) -> Gap:
    """The gap of these kills; of the nodes started between them nothing is stored."""
    before, first, last = bisect_right(lost, kills[0].at), kills[0], kills[-1]
    gap = Gap(before, len(lost) - before, max(first.at - lost[0], 0.0), max(min(end, lost[-1]) - first.at, 0.0))
    if gap.before_s > LOSS_S + SLACK_S:
        beyond.append(f'{topic}: {gap.before_s:.2f} s of what was received, killed at {first.at:.2f}')
    lives = [after.at - kill.ready for kill, after in pairwise(kills)]
    beyond += [f'{topic}: all of a life of {life:.2f} s' for life in lives if life > DISCOVERY_S + LOSS_S + SLACK_S]
    if end - last.ready > DISCOVERY_S:
        beyond.append(f'{topic}: not heard for {end - last.ready:.2f} s after the restart at {last.ready:.2f}')
    return gap


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()
