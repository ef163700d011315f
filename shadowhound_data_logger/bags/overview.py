"""A row of facts for each bag, from the store, the spool and the folders of current recordings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.contents import NOT_READ, describe_bag
from shadowhound_data_logger.bags.description import describe_metadata
from shadowhound_data_logger.bags.local import UnsentFile, evicted_files, local_files
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
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.formats.mcap.ranges import StoredFile
from shadowhound_data_logger.stores.base import ObjectStore

THREADS: Final = 8
STORE: Final = 'store'


@dataclass(frozen=True, slots=True)
class BagRow:
    """The facts about a bag; None if they are unknown without opening its slices."""

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
    """Location (``store``, ``spool``, ``recording``, ``quarantine``) -> number of the bag's files there."""
    finding: str
    """What is wrong with the bag; empty if nothing is."""
    remark: str
    """Contradictions between its metadata.yaml and its files; empty if there are none."""


@dataclass(frozen=True, slots=True)
class _Facts:
    messages: int | None = None
    topics: int | None = None
    t_start_ns: int | None = None
    t_end_ns: int | None = None
    finding: str = ''
    remark: str = ''


def bag_overview(store: ObjectStore, robot: str, home: Path, *, since_ns: int = 0, is_local: bool = False) -> list[BagRow]:
    """All bags of a robot that started at ``since_ns`` or later, newest last; ``is_local``: only those on this machine.

    Raises StoreError, SpoolError.
    """
    remote = {} if is_local else {bag.name: bag for bag in find_bags(store, robot)}
    local: dict[str, list[UnsentFile]] = {}
    for file in local_files(home, robot).values():
        local.setdefault(file.bag, []).append(file)
    lost = evicted_files(home, robot)
    names = [name for name in sorted({*remote, *local}) if (time_in_name(name) or since_ns) >= since_ns - SECOND]

    def row(name: str) -> BagRow:
        return _row(store, remote.get(name) or RemoteBag(robot, name, ()), local.get(name, []), lost[name])

    with ThreadPoolExecutor(THREADS, 'bag-list') as pool:
        rows = [each for each in pool.map(row, names) if each.t_start_ns is None or each.t_start_ns >= since_ns]
    return sorted(rows, key=lambda each: (each.t_start_ns or time_in_name(each.bag) or 0, each.bag))


def time_in_name(bag: str) -> int | None:
    """The time in the name of a bag, ``..._YYYYMMDD_HHMMSS``, in ns; None if it has none."""
    stamp = '_'.join(bag.removesuffix(ARCHIVE).split('_')[-2:])
    try:
        when = datetime.strptime(stamp, '%Y%m%d_%H%M%S').replace(tzinfo=timezone.utc)
    except ValueError:
        return None
    return int(when.timestamp()) * SECOND


def _row(store: ObjectStore, bag: RemoteBag, local: list[UnsentFile], evicted_files: int) -> BagRow:
    kept = [file for file in local if bag.file(file.name) is None]  # the spool is about to delete files that were delivered
    files = RemoteBag(bag.robot, bag.name, (*bag.files, *(RemoteFile(file.name, '', file.size) for file in kept)))
    finding = '; '.join(f'{file.name} was rejected by the store' for file in kept if file.where == 'quarantine')
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
        why = f'; the full spool of this machine evicted {evicted_files}' if evicted_files else ' yet'
        finding = finding or f'{len(missing)} of {len(manifest.slices)} slices are not available{why}'
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
                continue  # the spool has just delivered it
    return read_manifest(store, bag)


def _tags(store: ObjectStore, bag: RemoteBag, local: Iterable[UnsentFile]) -> dict[str, Mapping[str, str]]:
    """The object metadata of each slice, by its name. A foreign bag has none, so only one of its slices is looked up."""
    found: dict[str, Mapping[str, str]] = {file.name: file.metadata for file in local if file.metadata}
    for file in bag.slices:
        held = store.head(BUCKET, file.key)
        if held is None or meta.BAG not in held.metadata:
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
        found = describe_bag(sources, describe_metadata(document(store, file), file.key, sources), None, scans=False)
        if found is not None:
            wrong = [f'{name} is missing' for name in found.absent]
            wrong += [f'{name} {why}' for name, why in found.damaged.items()]
            return _Facts(found.messages, len({topic.name for topic in found.topics}), found.t_start_ns, found.t_end_ns,
                          '; '.join(wrong), '; '.join(each for each in found.remarks if each != NOT_READ))  # fmt: skip
    try:
        numbers = [tuple(int(tag[word]) for word in (meta.MESSAGES, meta.T_START_NS, meta.T_END_NS)) for tag in tags]
    except (KeyError, ValueError):
        return _Facts()
    if not all(0 <= value < 1 << 64 for each in numbers for value in each):
        return _Facts()
    spans = [(start_ns, end_ns) for messages, start_ns, end_ns in numbers if messages]
    return _span(sum(messages for messages, _, _ in numbers), None, spans) if numbers else _Facts()


def _span(messages: int, topics: int | None, spans: list[tuple[int, int]]) -> _Facts:
    if not messages:
        return _Facts(messages, topics)
    return _Facts(messages, topics, min(start for start, _ in spans), max(end for _, end in spans))
