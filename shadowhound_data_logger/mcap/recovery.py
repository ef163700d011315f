"""Makes whole slices of those that were not closed, and tells what a whole one holds.

A slice whose writer was killed, or whose disk lost power, ends where it was last synced or somewhere after: with a torn
chunk, zeros, anything. What is kept is every chunk whose CRC-32 holds, up to the last of them; the file is mended where it
lies, so a large slice takes neither memory nor a second copy. Every step can be cut short and done again.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from shadowhound_data_logger.disk import fingerprint, sync
from shadowhound_data_logger.mcap.index import read_index
from shadowhound_data_logger.mcap.messages import Wanted, read_messages
from shadowhound_data_logger.mcap.ranges import LocalFile
from shadowhound_data_logger.mcap.rosbag2_metadata import bagfile_information, to_yaml
from shadowhound_data_logger.mcap.slice_info import SliceInfo
from shadowhound_data_logger.mcap.survey import survey
from shadowhound_data_logger.mcap.writer import OPEN

log = logging.getLogger(__name__)

_EVER = (0, 1 << 64)


def recover(path: Path, *, ros_distro: str = '') -> SliceInfo:
    """Turn ``<name>.mcap.open`` into ``<name>.mcap``; what had to be left out stands in its ``damage``.

    Never fails for what the file holds: of one with nothing whole in it an empty slice is left. Raises OSError when it cannot
    be read or written, FileExistsError when a file has its final name already.
    """
    if not path.name.endswith(OPEN):
        raise ValueError(f'{path} is not an open slice')
    final = path.with_name(path.name.removesuffix(OPEN))
    if final.exists():
        raise FileExistsError(f'{final} is there already, beside {path}')
    file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        found = survey(file)
        for at, content in found.repairs:
            _write(file, at, content)
        os.ftruncate(file, found.end)
        said = bagfile_information([found.contents.info(final)], ros_distro=ros_distro)
        _write(file, found.end, found.contents.ending(found.end, to_yaml(said)))
        os.fsync(file)
    finally:
        os.close(file)
    size, sha256 = fingerprint(path)
    os.replace(path, final)
    sync(final.parent)
    info = found.contents.info(final, size, sha256, found.damage)
    log.info('recovered %s: %d messages; left out %s', final, info.messages, found.damage)
    return info


def read_info(path: Path, *, digest: bool = False) -> SliceInfo:
    """Of a whole MCAP file, ours or another's, by its summary; by all its messages where it has none.

    ``sha256`` is computed when ``digest`` is set. Raises BagDamaged for what is no whole MCAP file.
    """
    source = LocalFile(path)
    index = read_index(source)
    sha256 = fingerprint(path)[1] if digest else ''
    channels, messages, span = list(index.channels.values()), index.messages, (index.t_start_ns, index.t_end_ns)
    counts = {channel.topic: 0 for channel in channels}
    told = messages and sum(index.counts.values()) == messages and index.counts.keys() <= index.channels.keys()
    if index.is_indexed or told:
        for number, count in index.counts.items():
            counts[index.channels[number].topic] += count
    else:
        channels, messages, span, counts = [], 0, (0, 0), {}
        for message in read_messages(source, index, Wanted(*_EVER, lambda _: True)):
            if message.channel.topic not in counts:
                channels.append(message.channel)
            counts[message.channel.topic] = counts.get(message.channel.topic, 0) + 1
            span = (min(span[0], message.log_ns), max(span[1], message.log_ns)) if messages else (message.log_ns, message.log_ns)
            messages += 1
    return SliceInfo(path, source.size, sha256, *(span if messages else (0, 0)), messages, counts, tuple(channels))


def _write(file: int, at: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(file, view, at)
        view, at = view[written:], at + written
