"""One line of facts a bag, put together from the store, the spool and the folder of what is being recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.contents import NOT_READ, described
from shadowhound_data_logger.bags.description import of_metadata
from shadowhound_data_logger.bags.local import UnsentFile, given_up, local_files
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, METADATA
from shadowhound_data_logger.bags.remote import (
    ARCHIVE,
    GROWING,
    RemoteBag,
    RemoteFile,
    document,
    find_bags,
    missing_of,
    read_manifest,
    state_of,
)
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.ranges import StoredFile
from shadowhound_data_logger.stores.base import ObjectStore

THREADS: Final = 8
STORE: Final = 'store'


@dataclass(frozen=True, slots=True)
class BagRow:
    """A bag at a glance; None for what is not known without opening its slices."""

    robot: str
    bag: str
    state: str
    slices: int
    bytes: int
    messages: int | None
    topics: int | None
    t_start_ns: int | None
    t_end_ns: int | None
    where: Mapping[str, int]
    """Place -> files of the bag there: ``store``, ``spool``, ``recording``, ``quarantine``."""
    finding: str
    """What is wrong with it; empty when nothing is."""
    remark: str
    """Where its metadata.yaml contradicts its files; empty when it does not."""


@dataclass(frozen=True, slots=True)
class _Facts:
    messages: int | None = None
    topics: int | None = None
    t_start_ns: int | None = None
    t_end_ns: int | None = None
    finding: str = ''
    remark: str = ''


def bag_overview(store: ObjectStore, robot: str, home: Path, *, since_ns: int = 0) -> list[BagRow]:
    """All bags of a robot that began at ``since_ns`` or later, the newest last. Raises StoreError, SpoolError."""
    remote = {bag.name: bag for bag in find_bags(store, robot)}
    local: dict[str, list[UnsentFile]] = {}
    for file in local_files(home, robot).values():
        local.setdefault(file.bag, []).append(file)
    lost = given_up(home, robot)
    names = [name for name in sorted({*remote, *local}) if (named_ns(name) or since_ns) >= since_ns - SECOND]

    def row(name: str) -> BagRow:
        return _row(store, remote.get(name) or RemoteBag(robot, name, ()), local.get(name, []), lost[name])

    with ThreadPoolExecutor(THREADS, 'bag-list') as pool:
        rows = [each for each in pool.map(row, names) if each.t_start_ns is None or each.t_start_ns >= since_ns]
    return sorted(rows, key=lambda each: (each.t_start_ns or named_ns(each.bag) or 0, each.bag))


def named_ns(bag: str) -> int | None:
    """The time in the name of a bag, ``..._YYYYMMDD_HHMMSS``; None where there is none."""
    stamp = '_'.join(bag.removesuffix(ARCHIVE).split('_')[-2:])
    try:
        when = datetime.strptime(stamp, '%Y%m%d_%H%M%S').replace(tzinfo=timezone.utc)
    except ValueError:
        return None
    return int(when.timestamp()) * SECOND


def _row(store: ObjectStore, bag: RemoteBag, local: list[UnsentFile], given_up: int) -> BagRow:
    kept = [file for file in local if bag.file(file.name) is None]  # delivered already: the spool is about to let go of it
    files = RemoteBag(bag.robot, bag.name, (*bag.files, *(RemoteFile(file.name, '', file.size) for file in kept)))
    finding = '; '.join(f'{file.name} is refused by the store' for file in kept if file.where == 'quarantine')
    manifest, tags, facts = None, {}, _Facts()
    try:
        manifest = _manifest(store, bag, kept)
        if manifest is None:
            tags = _tags(store, bag, kept)
        facts = _facts(store, bag, manifest, tags.values())
        finding = finding or facts.finding
    except BagDamaged as error:
        finding = str(error)
    state = state_of(files, manifest, next(iter(tags.values()), {}))
    if manifest is not None and (missing := missing_of(files, manifest)):
        why = f'; {given_up} were given up by the full spool of this machine' if given_up else ' yet'
        finding = finding or f'{len(missing)} of {len(manifest.slices)} slices are not here{why}'
    places: dict[str, int] = {STORE: len(bag.files)} if bag.files else {}
    for file in kept:
        places[file.where] = places.get(file.where, 0) + 1
    slices = len(files.slices) + sum(file.is_open for file in kept)
    return BagRow(bag.robot, bag.name, GROWING if any(file.is_open for file in kept) else state, slices, files.size,
                  facts.messages, facts.topics, facts.t_start_ns, facts.t_end_ns, places, finding, facts.remark)  # fmt: skip


def _manifest(store: ObjectStore, bag: RemoteBag, local: Iterable[UnsentFile]) -> Manifest | None:
    for file in local:
        if file.name == MANIFEST and file.path is not None:
            try:
                return Manifest.from_json(file.path.read_bytes(), str(file.path))
            except OSError:
                continue  # on its way out of the spool
    return read_manifest(store, bag)


def _tags(store: ObjectStore, bag: RemoteBag, local: Iterable[UnsentFile]) -> dict[str, Mapping[str, str]]:
    """What was written beside each slice, by its name; of a foreign bag nothing is, so one of its slices is asked for."""
    found: dict[str, Mapping[str, str]] = {file.name: file.metadata for file in local if file.metadata}
    for file in bag.slices:
        held = store.head(BUCKET, file.key)
        if held is None or words.BAG not in held.metadata:
            break
        found[file.name] = held.metadata
    return found


def _facts(store: ObjectStore, bag: RemoteBag, manifest: Manifest | None, tags: Iterable[Mapping[str, str]]) -> _Facts:
    if manifest is not None:
        filled = [each for each in manifest.slices if each.messages]
        topics, messages = {topic for each in manifest.slices for topic in each.counts}, sum(each.messages for each in filled)
        step_ns = manifest.clock.offset_ns if manifest.clock is not None else 0
        if step_ns is None:
            return _Facts(messages, len(topics))
        return _span(messages, len(topics), [(each.t_start_ns + step_ns, each.t_end_ns + step_ns) for each in filled])
    if file := bag.file(METADATA):
        sources = {each.name: StoredFile(store, BUCKET, each.key, each.size) for each in bag.files}
        found = described(sources, of_metadata(document(store, file), file.key, sources), None, scans=False)
        if found is not None:
            wrong = [f'{name} is not there' for name in found.absent]
            wrong += [f'{name} {why}' for name, why in found.damaged.items()]
            return _Facts(found.messages, len({topic.name for topic in found.topics}), found.t_start_ns, found.t_end_ns,
                          '; '.join(wrong), '; '.join(each for each in found.remarks if each != NOT_READ))  # fmt: skip
    try:
        told_of = [tuple(int(tag[word]) for word in (words.MESSAGES, words.T_START_NS, words.T_END_NS)) for tag in tags]
    except (KeyError, ValueError):
        return _Facts()
    if not all(0 <= value < 1 << 64 for each in told_of for value in each):
        return _Facts()
    spans = [(start_ns, end_ns) for messages, start_ns, end_ns in told_of if messages]
    return _span(sum(messages for messages, _, _ in told_of), None, spans) if told_of else _Facts()


def _span(messages: int, topics: int | None, spans: list[tuple[int, int]]) -> _Facts:
    if not messages:
        return _Facts(messages, topics)
    return _Facts(messages, topics, min(start for start, _ in spans), max(end for _, end in spans))
