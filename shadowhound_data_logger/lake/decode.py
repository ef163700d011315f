"""The contents of objects as numpy arrays: images, clouds, records and archives, in the formats of docs/formats.md.

Whatever cannot be read is a LakeError; nothing is unpacked to the disk.
"""

from __future__ import annotations

import tarfile
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import orjson
import simplejpeg

from shadowhound_data_logger.errors import LakeError
from shadowhound_data_logger.untrusted import MOST_MEMBERS, check_pixels, check_size, open_image

if TYPE_CHECKING:
    from numpy.typing import NDArray

IMAGES: Final = frozenset({'jpg', 'jpeg', 'png', 'tif', 'tiff'})
CLOUDS: Final = frozenset({'pcd'})
ARCHIVES: Final = frozenset({'tar', 'zip'})
POINT: Final = ('x', 'y', 'z', 'intensity')
_ZIP_ENTRY: Final = b'PK\x01\x02'
_JPEG: Final = b'\xff\xd8'
_DATA: Final = b'\nDATA '
_MOST_HEADER: Final = 1 << 16
_MOST_POINTS: Final = 1 << 22
"""Of a cloud; a lidar of the Go2 has some 20,000."""
_MOST_JSON_BYTES: Final = 32 << 20
"""A batch is closed after 4 MiB of messages; as objects of Python it is 24 times as large."""
_BROKEN: Final = (ValueError, KeyError, IndexError, TypeError, OSError, EOFError, tarfile.TarError, zipfile.BadZipFile,
                  NotImplementedError, RuntimeError, zlib.error, ArithmeticError, MemoryError, SyntaxError)  # fmt: skip
"""What the readers raise for content that is no such thing; RuntimeError is a zip with a password, SyntaxError Pillow's."""


class ArchiveMember(NamedTuple):
    """One message of an archive; that of a repeat has the content of the file that it repeats."""

    stamp_ns: int
    """As in the archive: ``clock_offset_ns`` is not in it."""
    body: bytes
    extension: str


def extension_of(key: str) -> str:
    """Of a key or a member, in lower case, without the dot."""
    return key.rpartition('/')[2].rpartition('.')[2].lower()


def image(body: bytes, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """(height, width, 3) uint8 in the order RGB; 16-bit depth and float images (height, width) as they are.

    ``size`` is (height, width): a JPEG is then decoded no larger than need be, and averaged down. Raises LakeError.
    """
    try:
        return _jpeg(body, size) if body.startswith(_JPEG) else _pillow(body, size)
    except _BROKEN as error:
        raise LakeError(f'this is no image that can be read: {error}') from error


def _jpeg(body: bytes, size: tuple[int, int] | None) -> NDArray[Any]:
    height, width, _, _ = simplejpeg.decode_jpeg_header(body)
    check_pixels(width, height)
    if size is None:
        pixels: NDArray[Any] = simplejpeg.decode_jpeg(body, 'RGB')
        return pixels
    pixels = simplejpeg.decode_jpeg(body, 'RGB', min_height=size[0], min_width=size[1], min_factor=1)
    return pixels if pixels.shape[:2] == size else _resized(pixels, size)


def _resized(pixels: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    from PIL import Image  # noqa: PLC0415 - only for sizes that a JPEG does not come in

    return np.array(Image.fromarray(pixels).resize(size[::-1], Image.Resampling.BOX))


def _pillow(body: bytes, size: tuple[int, int] | None) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # of a damaged file Pillow warns before it raises
        with open_image(body) as opened:
            plain = opened.mode in {'I;16', 'I', 'F'}
            pixels = np.array(opened if plain else opened.convert('RGB'))
            if opened.mode == 'I':  # what older Pillows make of 16 bits
                pixels = pixels.astype(np.uint16)
    if size is None or pixels.shape[:2] == size:
        return pixels
    if not plain:
        return _resized(pixels, size)
    rows, columns = (np.arange(wish) * have // wish for wish, have in zip(size, pixels.shape[:2], strict=True))
    return np.array(pixels[rows][:, columns])  # a mean of depths lies on neither surface


def cloud(body: bytes) -> NDArray[np.float32]:
    """(n, 4) float32: x y z intensity, metres; a field that the cloud does not have is NaN. Raises LakeError."""
    try:
        return _cloud(body)
    except _BROKEN as error:
        raise LakeError(f'this is no PCD that can be read: {error}') from error


def _cloud(body: bytes) -> NDArray[np.float32]:
    at = body.index(_DATA, 0, _MOST_HEADER) + len(_DATA)
    end = body.index(b'\n', at, at + 64)
    if body[at:end].strip() != b'binary':
        raise ValueError(f'its data are {body[at:end][:30]!r}, not binary')
    lines = (line.split() for line in body[:at].decode('ascii').splitlines() if not line.startswith('#'))
    header = {line[0]: line[1:] for line in lines if line}
    points = int(header['POINTS'][0])
    if not 0 <= points <= _MOST_POINTS:
        raise ValueError(f'it claims {points:,} points')
    fields = zip(
        header['FIELDS'], header['TYPE'], header['SIZE'], header.get('COUNT', ['1'] * len(header['FIELDS'])), strict=True
    )
    layout = np.dtype([(f'{number}:{name}', f'<{kind.lower()}{int(size)}', (int(count),) if int(count) > 1 else ())
                       for number, (name, kind, size, count) in enumerate(fields)])  # fmt: skip
    data = np.frombuffer(body, layout, points, end + 1)
    found = np.full((points, len(POINT)), np.nan, np.float32)
    for name in layout.names or ():
        if (plain := name.partition(':')[2]) in POINT and data[name].ndim == 1:
            found[:, POINT.index(plain)] = data[name]
    return found


def records(body: bytes) -> list[dict[str, Any]]:
    """The samples of a batch, or the one document as a list. Raises LakeError."""
    try:
        check_size(len(body), _MOST_JSON_BYTES)
        document = orjson.loads(body)
        found = document.get('samples', [document])
        if not all(isinstance(each, dict) and _is_stamp(each['stamp_ns']) for each in found):
            raise ValueError('a sample has no stamp')
        return list(found)
    except (*_BROKEN, AttributeError) as error:
        raise LakeError(f'this is no JSON of a sensor: {error}') from error


def members(body: bytes, extension: str) -> list[ArchiveMember]:
    """The messages of a tar or zip in their order, repeats among them. Raises LakeError."""
    try:
        return list(_members(dict(_tar(body) if extension == 'tar' else _zip(body))))
    except _BROKEN as error:
        raise LakeError(f'this is no {extension} that can be read: {error}') from error


def _members(files: dict[str, bytes]) -> Iterator[ArchiveMember]:
    contents = {name.partition('.')[0]: name for name in files if not name.endswith('.json')}
    for name, body in files.items():
        if name.endswith('.json'):
            told = orjson.loads(body)
            if not isinstance(told, dict) or not _is_stamp(told['stamp_ns']):
                raise ValueError(f'{name} has no stamp')
            holder = told.get('repeat_of') or contents[name[:-5]]
            yield ArchiveMember(told['stamp_ns'], files[holder], extension_of(holder))


def _tar(body: bytes) -> Iterator[tuple[str, bytes]]:
    left = len(body)  # a sparse file claims more
    with tarfile.open(fileobj=BytesIO(body), mode='r:') as packed:
        for number, entry in enumerate(packed):
            left -= entry.size if entry.isreg() else 0
            if number >= MOST_MEMBERS or left < 0:
                raise ValueError('it claims more files, or larger ones, than there is room for in it')
            content = packed.extractfile(entry) if entry.isreg() else None
            if content is not None:
                yield entry.name, content.read()


def _zip(body: bytes) -> Iterator[tuple[str, bytes]]:
    if body.count(_ZIP_ENTRY) > MOST_MEMBERS:
        raise ValueError(f'it has more than {MOST_MEMBERS:,} files')
    with zipfile.ZipFile(BytesIO(body)) as packed:
        entries = packed.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError('its files are packed; those of a robot are stored as they are')
        check_size(sum(entry.file_size for entry in entries), len(body))
        for entry in entries:
            yield entry.filename, packed.read(entry)


def _is_stamp(value: object) -> bool:
    return type(value) is int and -(1 << 63) <= value < 1 << 63
