"""Repairs a bag by any recorder: a folder or one file. Intact files are copied, damaged ones rewritten.

``formats/mcap/repair.py`` repairs MCAP; from SQLite, every readable row is kept; ``metadata.yaml`` is rebuilt from the files if
it is missing, invalid or contradicts them; a manifest is updated and lists the losses. Files that rosbag2 compressed as a whole
are copied if they are intact, and otherwise reported.

The result gets its name when it is complete and on the disk. In place, each file is replaced by a rename once all are repaired:
an interruption leaves every file either old or new.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.contents import SqliteFile, files_of, not_a_bag, open_bag_file, slices_of
from shadowhound_data_logger.bags.description import Description, describe_files, describe_metadata
from shadowhound_data_logger.bags.fetch import disk_errors
from shadowhound_data_logger.bags.manifest import RECOVERED, Manifest, Missing, SliceEntry, topics_of
from shadowhound_data_logger.bags.naming import MANIFEST, MCAP, METADATA, PACKED, SQLITE, natural_key
from shadowhound_data_logger.bags.sqlite_repair import LEFTOVERS, copy_readable_rows
from shadowhound_data_logger.core.durable_files import fingerprint, replacing, sync
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.core.progress import ProgressListener
from shadowhound_data_logger.core.untrusted import from_yaml
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, read_whole
from shadowhound_data_logger.formats.mcap.repair import Loss, McapRepair, examine, repair
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX

REPAIRED: Final = '_repaired'
"""Appended to the name of the bag or file, unless another output is requested."""
UNFINISHED: Final = '.repair'
"""Suffix of files and folders that are being written."""
NOTHING: Final = 'it cannot be repaired: no message in it is readable'
CHANGED: Final = 'the files that it describes have changed'
SILENT: Final = ProgressListener()


@dataclass(frozen=True, slots=True)
class FileRepair:
    """The result for one file of messages."""

    name: str
    bytes: int
    """Size of the damaged file."""
    messages: int | None
    """In the repaired file; None if it cannot be read."""
    losses: tuple[Loss, ...] = ()
    rebuilt: tuple[str, ...] = ()
    """Parts without messages that were missing or wrong."""
    lost_messages: int | None = 0
    """None if unknown."""
    unverified: int = 0
    """Messages of chunks with a wrong checksum: kept if they were requested, otherwise lost."""
    is_cut: bool = False
    """Whether its end is missing, so that more messages may have followed."""
    failed: str = ''
    """Why it cannot be repaired. Such a file is not in the result; in place, it is unchanged."""

    @property
    def is_damaged(self) -> bool:
        return bool(self.losses or self.rebuilt or self.failed)


@dataclass(frozen=True, slots=True)
class BagRepair:
    """The result of a repair; ``out`` is None if nothing had to be repaired."""

    path: Path
    out: Path | None
    files: tuple[FileRepair, ...]
    metadata: tuple[str, ...] = ()
    """Why metadata.yaml was rebuilt; empty if it is correct, or if one file was repaired."""
    absent: tuple[str, ...] = ()
    """Files that the metadata names but that do not exist."""

    @property
    def is_damaged(self) -> bool:
        return bool(self.metadata or self.absent or any(file.is_damaged for file in self.files))


@dataclass(slots=True)
class _Found:
    """One file while the bag is examined and repaired."""

    name: str
    path: Path
    out_name: str
    report: FileRepair
    info: SliceInfo | None = None
    """The contents, repaired or not."""
    new: Path | None = None
    """The repaired file."""
    size_and_time: tuple[int, int] = (0, 0)
    """Size and modification time when it was examined."""


def repair_bag(path: Path, output: Path | None = None, *, in_place: bool = False, unverified: bool = False,
               progress: ProgressListener = SILENT) -> BagRepair:  # fmt: skip
    """Raises BagError if the path is not a bag or the output exists, BagDamaged if nothing can be read."""
    if path.is_file():
        return _repair_file(path, output, in_place=in_place, unverified=unverified, progress=progress)
    if output is not None and path.resolve() in (output.absolute().resolve(), *output.absolute().resolve().parents):
        raise BagError(f'{output} is inside the bag', remedy='choose a folder outside the bag')
    out = path if in_place else output or path.with_name(f'{path.resolve().name}{REPAIRED}')
    if not in_place and out.exists():
        raise _name_taken(out)
    files = {name: each for name, each in files_of(path).items() if not name.endswith(UNFINISHED)}
    claimed, raw, remarks = _metadata(files)
    open_slices = [name for name in files if name.endswith(MCAP + OPEN_SUFFIX) and name.removesuffix(OPEN_SUFFIX) not in files]
    names = sorted({*slices_of(list(files), claimed), *open_slices}, key=natural_key)
    if not names:
        raise not_a_bag(path)
    progress.begin(sum(files[name].stat().st_size for name in names))
    found = [_examine(name, files[name], progress) for name in names]
    infos = {each.out_name: each.info for each in found if each.info is not None}
    absent: tuple[str, ...] = ()
    if claimed is not None:
        description = describe_files(infos, {each.out_name: '' for each in found if each.info is None}, claimed)
        absent, remarks = description.absent, (*remarks, *description.remarks)
    if all(each.report.failed for each in found):
        raise BagDamaged(found[0].report.failed, remedy=NOTHING, path=str(path))
    result = BagRepair(path, None, tuple(each.report for each in found), remarks, absent)
    if not result.is_damaged:
        return result
    progress.begin(sum(each.size_and_time[0] * (1 + each.report.is_damaged) for each in found))
    with _writing(out, in_place=in_place) as folder:
        for each in found:
            if each.report.is_damaged and not each.report.failed:
                each.new = folder / (each.name + UNFINISHED if in_place else each.out_name)
                each.new.parent.mkdir(parents=True, exist_ok=True)
                _repair(each, progress, unverified=unverified)
                each.report = _with_claimed_count(each.report, claimed)
        _check_unchanged(found)
        if not in_place:
            _copy_intact(files, {METADATA, MANIFEST, *(name for each in found for name in _replaced(each))}, folder)
        _describe(folder, raw, files, found)
    return replace(result, out=out, files=tuple(each.report for each in found), metadata=remarks or (CHANGED,))


def _repair_file(path: Path, output: Path | None, *, in_place: bool, unverified: bool, progress: ProgressListener) -> BagRepair:
    progress.begin(path.stat().st_size)
    found = _examine(path.name, path, progress)
    if found.report.failed:
        raise BagDamaged(found.report.failed, remedy=NOTHING, path=str(path))
    if not found.report.is_damaged:
        return BagRepair(path, None, (found.report,))
    out = path.with_name(found.out_name) if in_place else output or _repaired_name(path.with_name(found.out_name))
    if out.exists() and not (in_place and out == path):
        raise _name_taken(out)
    with disk_errors(out):
        found.new = out.with_name(out.name + UNFINISHED)
        found.new.unlink(missing_ok=True)
        _repair(found, progress, unverified=unverified)
        _check_unchanged([found])
        os.replace(found.new, out)
        if in_place:
            _remove_leftovers(found)
        if in_place and out != path:
            path.unlink()
        sync(out.absolute().parent)
    return BagRepair(path, out, (found.report,))


def _name_taken(out: Path) -> BagError:
    return BagError(f'{out} already exists', remedy='remove it, or choose another --to')


def _repaired_name(path: Path) -> Path:
    return path.with_name(f'{path.stem}{REPAIRED}{path.suffix}')


# -- one file ------------------------------------------------------------------------------------------------------------------


def _examine(name: str, path: Path, progress: ProgressListener) -> _Found:
    """Find the damage in a file, without writing anything."""
    size_and_time = _look(path)
    size, is_open = size_and_time[0], name.endswith(OPEN_SUFFIX)
    if name.endswith((SQLITE, PACKED)):
        try:
            info = open_bag_file(LocalFile(path)).check()
            report = FileRepair(name, size, info.messages)
        except BagDamaged as error:
            is_packed = name.endswith(PACKED)
            info, report = None, FileRepair(name, size, None, (), () if is_packed else ('the database',), None,
                                            failed=error.what if is_packed else '')  # fmt: skip
        progress.have(size)
    else:
        try:
            found = examine(path, progress.have)
            report = _report(name, found, *(['its name'] if is_open else []))
            info = None if report.is_damaged else found.info
        except BagDamaged as error:
            info, report = None, FileRepair(name, size, None, lost_messages=None, failed=error.what)
    return _Found(name, path, name.removesuffix(OPEN_SUFFIX), report, info, size_and_time=size_and_time)


def _look(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


def _check_unchanged(found: Sequence[_Found]) -> None:
    """Raises BagError if a file changed since it was examined, because a recorder still writes it."""
    for each in found:
        if _look(each.path) != each.size_and_time:
            for other in found:
                if other.new is not None:
                    other.new.unlink(missing_ok=True)
            raise BagError(f'{each.path} changed during the repair', remedy='stop its recorder first')


def _repair(found: _Found, progress: ProgressListener, *, unverified: bool) -> None:
    """Write ``found.new``."""
    assert found.new is not None
    mode = found.path.stat().st_mode & 0o777
    found.new.unlink(missing_ok=True)
    if found.name.endswith(SQLITE):
        lost = copy_readable_rows(found.path, found.new)
        found.new.chmod(mode)
        found.info = SqliteFile(found.new).info
        losses = (Loss(0, 0, lost, None, None, None),) if lost else ()
        found.report = replace(found.report, messages=found.info.messages, losses=losses, lost_messages=None if lost else 0)
        return
    result = repair(found.path, found.new, progress.have, unverified=unverified, mode=mode)
    found.info, found.report = result.info, _report(found.name, result)


def _with_claimed_count(report: FileRepair, claimed: Description | None) -> FileRepair:
    """Add the number of lost messages according to metadata.yaml, if the file itself does not have it."""
    known = next((part.messages for part in claimed.parts if part.name == report.name), None) if claimed is not None else None
    if known is None or report.messages is None or known < report.messages or not (report.is_cut or report.lost_messages is None):
        return report
    return replace(report, lost_messages=known - report.messages, is_cut=False)


def _report(name: str, found: McapRepair, *more: str) -> FileRepair:
    return FileRepair(name, found.bytes, found.info.messages, found.losses, (*found.rebuilt, *more), found.lost_messages,
                      found.unverified, found.is_cut)  # fmt: skip


def _replaced(found: _Found) -> Sequence[str]:
    """Names of the files that the repaired file replaces."""
    return [found.name, *(found.name + suffix for suffix in LEFTOVERS)] if found.report.is_damaged else []


def _remove_leftovers(found: _Found) -> None:
    """Delete the logs of a database that was not closed; the repaired one has their content."""
    for suffix in LEFTOVERS if found.name.endswith(SQLITE) else ():
        found.path.with_name(found.path.name + suffix).unlink(missing_ok=True)


def _copy_intact(files: Mapping[str, Path], skipped: Container[str], folder: Path) -> None:
    for name, source in files.items():
        if name not in skipped:
            _copy(source, folder / name)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    shutil.copymode(source, target)
    sync(target)


@contextmanager
def _writing(out: Path, *, in_place: bool) -> Iterator[Path]:
    """The folder to write into. A new folder is renamed at the end; in place, each repaired file is."""
    with disk_errors(out):
        if in_place:
            yield out
            return
        folder = out.with_name(out.name + UNFINISHED)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            yield folder
            for each in (folder, *(sub for sub in folder.rglob('*') if sub.is_dir())):
                sync(each)
            os.replace(folder, out)
            sync(out.absolute().parent)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


# -- metadata and manifest -----------------------------------------------------------------------------------------------------


def _metadata(files: Mapping[str, Path]) -> tuple[Description | None, Mapping[str, Any], tuple[str, ...]]:
    """The claims of metadata.yaml, its fields, and why it must be rebuilt."""
    if METADATA not in files:
        return None, {}, ('it is missing',)
    try:
        content = read_whole(LocalFile(files[METADATA]))
        claimed = describe_metadata(content, METADATA, files)
        return claimed, from_yaml(content.decode())['rosbag2_bagfile_information'], ()
    except BagDamaged as error:
        return None, {}, (error.what,)


def _describe(folder: Path, raw: Mapping[str, Any], files: Mapping[str, Path], found: Sequence[_Found]) -> None:
    """Write manifest.json and metadata.yaml of the result.

    In place, the files are renamed between the two: after an interruption, another repair finds what remains to be done.
    """
    infos = {each.out_name: each.info for each in found if each.info is not None}
    if MANIFEST in files:
        with suppress(BagDamaged):
            manifest = _manifest(Manifest.from_json(read_whole(LocalFile(files[MANIFEST])), MANIFEST), found)
            with replacing(folder / MANIFEST, is_synced=True) as file:
                file.write(manifest.to_json())
    for each in found:
        if each.new is not None and each.new.name.endswith(UNFINISHED):
            os.replace(each.new, folder / each.out_name)
            _remove_leftovers(each)
            if each.name != each.out_name:
                each.path.unlink()
    sync(folder)
    slices = [replace(info, path=Path(name)) for name, info in sorted(infos.items(), key=lambda each: natural_key(each[0]))]
    custom = raw.get('custom_data')
    information = bagfile_information(
        slices, ros_distro=str(raw.get('ros_distro') or ''),
        custom_data={str(key): str(value) for key, value in custom.items()} if isinstance(custom, Mapping) else None,
    )  # fmt: skip
    information |= {'relative_file_paths': list(infos)}
    if slices and all(name.endswith((SQLITE, SQLITE + PACKED)) for name in infos):
        information['storage_identifier'] = 'sqlite3'
    information |= {name: str(raw.get(name) or '') for name in ('compression_format', 'compression_mode')}
    content = to_yaml({'rosbag2_bagfile_information': information}).encode()
    with replacing(folder / METADATA, is_synced=True) as file:
        file.write(content)
    sync(folder)


def _manifest(manifest: Manifest, found: Sequence[_Found]) -> Manifest:
    """The manifest, updated with the repaired slices and their losses."""
    repaired = {each.out_name: each for each in found if each.report.is_damaged}
    slices, missing = [], list(manifest.missing)
    for entry in manifest.slices:
        each = repaired.get(entry.file)
        if each is None or each.info is None or each.new is None:
            slices.append(entry)
            continue
        size, sha256 = fingerprint(each.new)
        slices.append(replace(SliceEntry.of(replace(each.info, path=Path(entry.file)), entry.key), bytes=size, sha256=sha256))
        lost = entry.messages - each.info.messages
        if lost > 0:
            missing.append(Missing(entry.file, 'damaged after it was recorded, and repaired', lost))
    infos = {each.out_name: each.info for each in found if each.info is not None}
    state = RECOVERED if len(missing) > len(manifest.missing) else manifest.state
    return replace(manifest, state=state, slices=tuple(slices), missing=tuple(missing), topics=topics_of(list(infos.values())))
