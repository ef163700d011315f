"""Recorded bags in a store, read by libraries other than the one that wrote them."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bags.slices import Recorded
from e2e.witness import Heard
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from shadowhound_data_logger.stores.base import ObjectStore

BUCKET = 'sensor-data'


@dataclass(slots=True)
class Bag:
    """One bag of a store, copied to a folder."""

    folder: Path
    manifest: dict[str, Any] = field(default_factory=dict)

    @property
    def slices(self) -> list[Path]:
        """Sorted by number."""
        return sorted(self.folder.glob('*.mcap'), key=lambda path: int(path.stem.rpartition('_')[2]))

    def messages(self) -> Iterator[Recorded]:
        """All messages, read by the mcap package, which verifies the chunks' checksums."""
        for path in self.slices:
            yield from in_slice(path)

    def check(self) -> Counter[str]:
        """All readers find the same, in agreement with the manifest; topic -> messages."""
        counts: Counter[str] = Counter()
        for report in self.manifest['slices']:
            path = self.folder / report['file']
            assert hashlib.sha256(path.read_bytes()).hexdigest() == report['sha256'], path
            found = Counter(message.topic for message in in_slice(path))
            assert found == Counter(report['counts']), path
            counts += found
        assert [report['file'] for report in self.manifest['slices']] == [path.name for path in self.slices]
        with AnyReader([self.folder]) as reader:
            assert {topic: info.msgcount for topic, info in reader.topics.items()} == counts
            assert sum(1 for _ in reader.messages()) == counts.total()
        return counts


def in_slice(path: Path) -> Iterator[Recorded]:
    with path.open('rb') as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            yield Recorded(channel.topic, message.log_time, message.publish_time, message.sequence, message.data)


def bags(store: ObjectStore, robot: str, folder: Path) -> list[Bag]:
    """Every bag of the robot, oldest first."""
    found: dict[str, Bag] = {}
    for info in store.list(BUCKET, f'{robot}/rosbags/'):
        name, _, file = info.key.removeprefix(f'{robot}/rosbags/').partition('/')
        bag = found.setdefault(name, Bag(folder / name))
        bag.folder.mkdir(parents=True, exist_ok=True)
        body = store.get(BUCKET, info.key)
        (bag.folder / file).write_bytes(body)
        if file == 'manifest.json':
            bag.manifest = json.loads(body)
    return [found[name] for name in sorted(found)]


def by_topic(messages: Iterable[Recorded | Heard]) -> dict[str, list[Any]]:
    """In recorded order."""
    found: dict[str, list[Any]] = {}
    for message in messages:
        found.setdefault(message.topic, []).append(message)
    return found
