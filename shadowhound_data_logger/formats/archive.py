"""All messages of a batch in one zip or tar: one file per message, and next to it a JSON that describes it.

With ``dedup``, a file equal to the previous one is omitted: its JSON remains and names that file in ``repeat_of``.

The layout is WebDataset's: files of one sample share their name up to the first dot and are adjacent
(https://github.com/webdataset/webdataset). Here that name is the message's time in ns since 1970, so samples are sorted by time,
and names differ between objects unless two publishers share a stamp. The same batch always gives the same bytes.
"""

from __future__ import annotations

import tarfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from itertools import pairwise
from typing import Final, NamedTuple
from zipfile import ZIP_STORED, ZipFile, ZipInfo

import orjson

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Sample
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from shadowhound_data_logger.formats.image import encode_jpeg
from shadowhound_data_logger.formats.payload import Encoder, Job, OneMessage, Payload, Rejections, encode_cdr
from shadowhound_data_logger.formats.pointcloud import encode_cloud
from shadowhound_data_logger.formats.types import header_frame_id

_ENCODE: Final[Mapping[str, OneMessage]] = {COMPRESSED_IMAGE: encode_jpeg, IMAGE: encode_jpeg, POINT_CLOUD: encode_cloud}
"""Type -> encoder of its file; all other types are stored as CDR."""
_MODE: Final = 0o644
_DOS_YEARS: Final = (315_532_800, 4_354_819_198)
"""First and last time that a zip can represent, in seconds since 1970: 1980 to 2107."""
_USTAR_SECONDS: Final = 8**11 - 1
"""Eleven octal digits."""


class ArchiveFile(NamedTuple):
    """One file of an archive."""

    name: str
    stamp_ns: int
    body: bytes


def archive(pack: Callable[[Iterable[ArchiveFile]], bytes], ext: str, content_type: str) -> Encoder:
    """An encoder that packs all messages of a batch except those that cannot be encoded, which are rejected."""

    def encoder(job: Job, rejections: Rejections) -> Payload | None:
        encode = _ENCODE.get(job.batch.type, encode_cdr)
        files: list[Payload] = []
        for sample in job.batch.samples:
            try:
                files.append(encode(job, sample))
                rejections.add_corrected(files[-1])
            except Rejected as error:
                rejections.add(error, sample)
        if not files:
            return None
        kept = tuple(sample for file in files for sample in file.kept)
        repeats = _repeats(files) if job.sensor.dedup else 0
        return Payload(pack(_members(job, files)), kept, ext, content_type, {'repeats': repeats} if repeats else {})

    return encoder


def _members(job: Job, files: Sequence[Payload]) -> Iterator[ArchiveFile]:
    """Each file and its JSON, sorted by time; further messages with the same time get a number."""
    seen: Counter[int] = Counter()
    has_header = job.types.has_header(job.batch.type)
    last, last_name = b'', ''
    for file in _in_order(files):
        sample = file.kept[0]
        stamp_ns = sample.stamp_ns
        name = f'{stamp_ns:019d}' + (f'_{seen[stamp_ns]}' if seen[stamp_ns] else '')
        seen[stamp_ns] += 1
        described = _description(job, sample, file, has_header=has_header)
        if job.sensor.dedup and last_name and file.body == last:
            described |= {'repeat_of': last_name}
        else:
            last, last_name = file.body, f'{name}.{file.ext}'
            yield ArchiveFile(last_name, stamp_ns, file.body)
        yield ArchiveFile(f'{name}.json', stamp_ns, orjson.dumps(described))


def _in_order(files: Sequence[Payload]) -> list[Payload]:
    return sorted(files, key=lambda file: file.kept[0].stamp_ns)


def _repeats(files: Sequence[Payload]) -> int:
    """The number of files that equal the previous one."""
    return sum(one.body == next_one.body for one, next_one in pairwise(_in_order(files)))


def _description(job: Job, sample: Sample, file: Payload, *, has_header: bool) -> dict[str, object]:
    frame = {'frame_id': header_frame_id(sample.cdr)} if has_header else {}
    return {'stamp_ns': sample.stamp_ns, **frame, 'topic': job.batch.topic, 'type': job.batch.type, **file.facts}


def pack_tar(members: Iterable[ArchiveFile]) -> bytes:
    """An uncompressed POSIX tar (ustar), which every reader supports; a file's time is its message's."""
    file = BytesIO()
    with tarfile.open(fileobj=file, mode='w', format=tarfile.USTAR_FORMAT) as packed:
        for member in members:
            entry = tarfile.TarInfo(member.name)
            entry.size, entry.mode = len(member.body), _MODE
            entry.mtime = min(max(member.stamp_ns // SECOND, 0), _USTAR_SECONDS)
            packed.addfile(entry, BytesIO(member.body))
    return file.getvalue()


def pack_zip(members: Iterable[ArchiveFile]) -> bytes:
    """A zip without compression, which would hardly shrink images and clouds; a file's time is its message's, in UTC."""
    file = BytesIO()
    with ZipFile(file, 'w', ZIP_STORED, allowZip64=True) as packed:
        for member in members:
            first, last = _DOS_YEARS
            when = utc(min(max(member.stamp_ns // SECOND, first), last) * SECOND)
            entry = ZipInfo(member.name, (when.year, when.month, when.day, when.hour, when.minute, when.second))
            entry.external_attr = _MODE << 16
            packed.writestr(entry, member.body)
    return file.getvalue()
