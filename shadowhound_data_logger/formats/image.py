"""Converts camera messages to image files: compressed images are stored byte for byte, raw images are encoded.

``jpeg`` encodes 8-bit color, gray and YUV images as JPEG; ``png`` encodes them as lossless PNG. Measurements are never compressed
with loss: 16-bit images, ``8UC1`` (labels, masks) and Bayer mosaics become PNGs, float32 images become TIFFs that preserve every
value, NaN included. Images with other encodings are stored as CDR. The sizes of JPEG and PNG files are read from their headers,
without decoding the files.
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Mapping
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import simplejpeg

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Sample
from shadowhound_data_logger.core.options import ARCHIVES, COMPRESSED_IMAGE, IMAGE
from shadowhound_data_logger.core.untrusted import check_pixels
from shadowhound_data_logger.formats.payload import Fact, Job, Payload, verbatim
from shadowhound_data_logger.formats.rvl import decode_rvl
from shadowhound_data_logger.formats.statistics import ALL, NONE, Statistic, object_row, pack_statistics, single_value
from shadowhound_data_logger.formats.yuv import Planes, is_yuv, read_planes, upsample_chroma

if TYPE_CHECKING:
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

JPEG_MAGIC: Final = b'\xff\xd8\xff'
PNG_MAGIC: Final = b'\x89PNG\r\n\x1a\n'
TIFF_MAGICS: Final = b'II*\0', b'MM\0*'
_FRAME_MARKERS: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of frame headers; C4, C8 and CC have other meanings (ITU-T T.81, table B.1)."""
_SCAN_MARKER: Final = 0xDA
_CHUNK: Final = struct.Struct('>I4s')
_IHDR: Final = struct.Struct('>I4sII')
_PNG_SIDE: Final = (1 << 31) - 1
RGB16: Final = 'rgb16'
"""16-bit colors, for which Pillow has no mode."""


class _Pixel(NamedTuple):
    """A ROS encoding in the terms of the libraries."""

    size: int
    """Bytes per pixel."""
    word: int
    """Bytes per value, for the byte order."""
    mode: str
    """Pillow's mode: https://pillow.readthedocs.io/en/stable/handbook/concepts.html#modes"""
    raw: str
    """The layout that Pillow's ``raw`` decoder reads."""
    colorspace: str = ''
    """simplejpeg's name; empty if a JPEG cannot represent the pixels."""


_DEPTH16: Final = _Pixel(2, 2, 'I;16', 'I;16')
_GRAY: Final = _Pixel(1, 1, 'L', 'L')
_BGR: Final = _Pixel(3, 1, 'RGB', 'BGR', 'BGR')
_BGRA: Final = _Pixel(4, 1, 'RGBA', 'BGRA', 'BGRA')
_PIXELS: Final = {
    'bgr8': _BGR,
    'rgb8': _Pixel(3, 1, 'RGB', 'RGB', 'RGB'),
    'bgra8': _BGRA,
    'rgba8': _Pixel(4, 1, 'RGBA', 'RGBA', 'RGBA'),
    'mono8': _Pixel(1, 1, 'L', 'L', 'GRAY'),
    '8UC1': _GRAY,
    '8UC3': _BGR,  # OpenCV's order, which RViz assumes too
    '8UC4': _BGRA,
    'mono16': _DEPTH16,
    '16UC1': _DEPTH16,
    'rgb16': _Pixel(6, 2, RGB16, 'RGB'),
    'bgr16': _Pixel(6, 2, RGB16, 'BGR'),
    '16UC3': _Pixel(6, 2, RGB16, 'BGR'),
    'rgba16': _Pixel(8, 2, RGB16, 'RGBA'),
    'bgra16': _Pixel(8, 2, RGB16, 'BGRA'),
    '16UC4': _Pixel(8, 2, RGB16, 'BGRA'),
    '32FC1': _Pixel(4, 4, 'F', 'F;32F'),
    **{f'bayer_{order}8': _GRAY for order in ('rggb', 'bggr', 'gbrg', 'grbg')},
    **{f'bayer_{order}16': _DEPTH16 for order in ('rggb', 'bggr', 'gbrg', 'grbg')},
}
"""Pixels by ROS encoding (sensor_msgs/image_encodings.hpp)."""
_MAX_SIDE: Final = 65_500
"""libjpeg's limit (JPEG_MAX_DIMENSION)."""
_PNG_LEVEL: Final = 1
"""zlib's fastest level, for 30 depth images per second: the default, 6, takes five times as long to save a tenth of the size."""
_COMPRESSED_DEPTH: Final = 'compressedDepth'
"""compressed_depth_image_transport sets this in ``format``, as in ``16UC1; compressedDepth png``; old versions omit ``png``, or
set only the encoding."""
_RVL: Final = 'rvl'
_CONFIG_HEADER: Final = struct.Struct('<iff')
"""The struct that it puts before the PNG: an unused format number and the two parameters of the inverse depth
(compressed_depth_image_transport/compression_common.hpp, codec.cpp)."""


def encode_jpeg(job: Job, sample: Sample) -> Payload:
    """The image of one CompressedImage or Image, as JPEG where possible.

    Raises Rejected: ``wrong_type``, ``unknown_type``, ``malformed``, ``empty``, ``size_mismatch`` (width, height, step and data
    are inconsistent), ``too_large`` (for a JPEG).
    """
    return _encode(job, sample, lossless=False)


def encode_png(job: Job, sample: Sample) -> Payload:
    """The image of one CompressedImage (unchanged) or Image (lossless). Raises Rejected as ``encode_jpeg`` does."""
    return _encode(job, sample, lossless=True)


def _encode(job: Job, sample: Sample, *, lossless: bool) -> Payload:
    if job.batch.type not in (COMPRESSED_IMAGE, IMAGE):
        raise Rejected('wrong_type', f'{job.batch.type} is not an image')
    message = job.types.deserialize(job.batch.type, memoryview(sample.cdr))
    if job.batch.type == COMPRESSED_IMAGE:
        return _encode_compressed(job, sample, message)
    facts: dict[str, Fact] = {'width': message.width, 'height': message.height, 'encoding': printable_ascii(message.encoding)}
    if is_yuv(message.encoding):
        return _encode_yuv(job, sample, message, facts, lossless=lossless)
    pixel = _PIXELS.get(message.encoding)
    if pixel is None:
        return verbatim(sample, 'unsupported_encoding', facts)
    _check_size(message, pixel)
    if pixel.colorspace and not lossless:
        body = _encode_raw_jpeg(message, pixel, job.sensor.quality)
        return Payload(body, (sample,), 'jpg', 'image/jpeg', facts, _statistics(job, body))
    if pixel.mode == 'F':
        return Payload(_encode_with_pillow(message, pixel, 'TIFF'), (sample,), 'tiff', 'image/tiff', facts)
    body = (
        _encode_png16(message, pixel)
        if pixel.mode == RGB16
        else _encode_with_pillow(message, pixel, 'PNG', compress_level=_PNG_LEVEL)
    )
    return Payload(body, (sample,), 'png', 'image/png', facts)


def _encode_yuv(job: Job, sample: Sample, message: Any, facts: Mapping[str, Fact], *, lossless: bool) -> Payload:
    """A JPEG with the camera's planes, or a PNG with their colors."""
    _check_not_empty(message)
    planes = read_planes(message)
    if planes is None:
        return verbatim(sample, 'unknown_layout', facts)
    if lossless:
        return Payload(_encode_planes_png(planes), (sample,), 'png', 'image/png', facts)
    _check_sides(message)
    if message.width % 2 or message.height % 2:  # libjpeg-turbo would read past the end of a plane
        planes = upsample_chroma(planes)
    body = bytes(simplejpeg.encode_jpeg_yuv_planes(*map(np.ascontiguousarray, planes), quality=job.sensor.quality))
    return Payload(body, (sample,), 'jpg', 'image/jpeg', facts, _statistics(job, body))


def _encode_compressed(job: Job, sample: Sample, message: Any) -> Payload:
    """The bytes of a CompressedImage if they are a JPEG, PNG or TIFF; compressed depth becomes a PNG."""
    data: Any = message.data
    facts: dict[str, Fact] = {}
    if not data.size:
        raise Rejected('empty', 'no image data')
    if _COMPRESSED_DEPTH in message.format or _has_png(data, _CONFIG_HEADER.size):
        data, facts = _read_depth(message)
    if data is None:
        return verbatim(sample, 'unsupported_encoding', facts)
    body = data.tobytes()
    if body.startswith(JPEG_MAGIC):
        (width, height), ext, content_type = jpeg_size(body), 'jpg', 'image/jpeg'
    elif body.startswith(PNG_MAGIC):
        (width, height), ext, content_type = png_size(body), 'png', 'image/png'
    elif body.startswith(TIFF_MAGICS):
        return Payload(body, (sample,), 'tiff', 'image/tiff', facts)
    else:
        return verbatim(sample, 'unsupported_encoding', {'encoding': printable_ascii(message.format)})
    found = _statistics(job, body) if ext == 'jpg' else b''
    return Payload(body, (sample,), ext, content_type, {'width': width, 'height': height, **facts}, found)


def printable_ascii(text: str) -> str:
    """Text of a message in a form that is valid in object metadata."""
    return ascii(text[:40])[1:-1]


def _statistics(job: Job, body: bytes) -> bytes:
    """Statistics of a JPEG that is stored as a separate object."""
    return (
        pack_statistics(jpeg_statistics(body)) if job.sensor.statistics != (NONE,) and job.sensor.format not in ARCHIVES else b''
    )


def _read_depth(message: Any) -> tuple[Any, dict[str, Fact]]:
    """The PNG of a compressed depth image, and facts from its header; the PNG is None if the RVL data is invalid.

    With encoding 32FC1, the PNG contains inverse depth: meters are ``depth_quant_a / (pixel - depth_quant_b)``, 0 is NaN. Some
    publishers omit the header.
    """
    encoding, _, compression = message.format.partition(';')
    facts: dict[str, Fact] = {'encoding': printable_ascii(encoding)}
    if _has_png(message.data, 0):
        return message.data, facts
    if message.data.size <= _CONFIG_HEADER.size:
        raise Rejected('malformed', f'{message.data.size} bytes of {message.format[:40]!r}')
    _, quant_a, quant_b = _CONFIG_HEADER.unpack_from(message.data)
    facts |= {'depth_quant_a': quant_a, 'depth_quant_b': quant_b}
    body = message.data[_CONFIG_HEADER.size :]
    if _RVL in compression:
        try:
            return np.frombuffer(_encode_depth_png(decode_rvl(body.tobytes())), np.uint8), facts
        except ValueError as error:
            log.debug('%s', error)
            return None, facts
    if not _has_png(body, 0):
        raise Rejected('malformed', f'no PNG after the header of {message.format[:40]!r}')
    return body, facts


def _has_png(data: Any, at: int) -> bool:
    return bool(data[at : at + len(PNG_MAGIC)].tobytes() == PNG_MAGIC)


def _check_size(message: Any, pixel: _Pixel) -> None:
    """Raises Rejected unless the data has the size that width, height, step and encoding require."""
    _check_not_empty(message)
    width, height, step = message.width, message.height, message.step
    if step < width * pixel.size or message.data.size != step * height:
        raise Rejected('size_mismatch', f'{width} x {height} {message.encoding}, step {step}, {message.data.size} bytes of data')


def _check_not_empty(message: Any) -> None:
    if not message.width or not message.height:
        raise Rejected('empty', f'{message.width} x {message.height} pixels')


def _check_sides(message: Any) -> None:
    if max(message.width, message.height) > _MAX_SIDE:
        raise Rejected('too_large', f'{message.width} x {message.height} pixels, a JPEG has at most {_MAX_SIDE} a side')


def _rows(message: Any, pixel: _Pixel) -> NDArray[Any]:
    """The pixels without padding, little-endian, one line per row; copied only if necessary."""
    rows = np.ascontiguousarray(message.data.reshape(message.height, message.step)[:, : message.width * pixel.size])
    # Pillow 9.0 (Ubuntu 22.04) misreads big-endian 16-bit images, so we swap the bytes.
    return rows.view(f'u{pixel.word}').byteswap() if message.is_bigendian and pixel.word > 1 else rows


def _encode_raw_jpeg(message: Any, pixel: _Pixel, quality: int) -> bytes:
    _check_sides(message)
    pixels = _rows(message, pixel).reshape(message.height, message.width, pixel.size)
    # OpenCV and libjpeg write half-resolution color by default; it takes half the time of full resolution.
    subsampling = 'Gray' if pixel.size == 1 else '420'
    return bytes(simplejpeg.encode_jpeg(pixels, quality=quality, colorspace=pixel.colorspace, colorsubsampling=subsampling))


def _encode_with_pillow(message: Any, pixel: _Pixel, kind: str, **options: int) -> bytes:
    # Imported late: most robots have no such images, and the import takes 0.1 s and 9 MB.
    from PIL import Image  # noqa: PLC0415

    size = message.width, message.height
    image = Image.frombuffer(pixel.mode, size, _rows(message, pixel), 'raw', pixel.raw, 0, 1)
    return _save(image, kind, **options)


def _encode_png16(message: Any, pixel: _Pixel) -> bytes:
    """A PNG with 16-bit colors, which Pillow does not write: https://www.w3.org/TR/png-3/."""
    height, width = message.height, message.width
    colors = _rows(message, pixel).view(np.uint16).reshape(height, width, -1)
    order = [pixel.raw.index(channel) for channel in 'RGBA' if channel in pixel.raw]
    lines = np.zeros((height, 1 + width * pixel.size), np.uint8)  # the first byte of a line: no filter
    lines[:, 1:] = colors[:, :, order].astype('>u2').reshape(height, -1).view(np.uint8)
    kind = 6 if len(order) == 4 else 2
    header = struct.pack('>IIBBBBB', width, height, 16, kind, 0, 0, 0)
    chunks = ((b'IHDR', header), (b'IDAT', zlib.compress(lines.tobytes(), _PNG_LEVEL)), (b'IEND', b''))
    return PNG_MAGIC + b''.join(
        _CHUNK.pack(len(body), name) + body + struct.pack('>I', zlib.crc32(name + body)) for name, body in chunks
    )


def _encode_planes_png(planes: Planes) -> bytes:
    from PIL import Image  # noqa: PLC0415 - see _encode_with_pillow

    image = Image.merge('YCbCr', [Image.fromarray(np.ascontiguousarray(part)) for part in upsample_chroma(planes)])
    return _save(image.convert('RGB'), 'PNG', compress_level=_PNG_LEVEL)


def _encode_depth_png(pixels: NDArray[np.uint16]) -> bytes:
    from PIL import Image  # noqa: PLC0415 - see _encode_with_pillow

    height, width = pixels.shape
    image = Image.frombuffer('I;16', (width, height), pixels.astype('<u2', copy=False), 'raw', 'I;16', 0, 1)
    return _save(image, 'PNG', compress_level=_PNG_LEVEL)


def _save(image: Any, kind: str, **options: int) -> bytes:
    file = BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def jpeg_statistics(body: bytes) -> dict[str, Statistic]:
    """Brightness (0 to 255) and sharpness (variance of the Laplacian) of the gray image at an eighth of the size.

    Empty if the JPEG cannot be decoded.
    """
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(body)
        check_pixels(width, height)
        gray = simplejpeg.decode_jpeg(body, 'GRAY', fastdct=True, fastupsample=True, min_height=1, min_width=1)
        gray = gray[:, :, 0].astype(np.float32)
    except (ValueError, MemoryError):
        return {}
    found = {'brightness': float(gray.mean(dtype=np.float64))}
    if min(gray.shape) > 2:
        edges = 4 * gray[1:-1, 1:-1] - gray[:-2, 1:-1] - gray[2:, 1:-1] - gray[1:-1, :-2] - gray[1:-1, 2:]
        found['sharpness'] = float(edges.var(dtype=np.float64))
    return {ALL: object_row(1), **{name: single_value(value) for name, value in found.items()}}


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height of a JPEG in pixels. Raises Rejected ``malformed`` if its headers are invalid or incomplete.

    Walks the marker segments up to the scan (ITU-T T.81, annex B). The scan itself is not checked: some cameras omit the EOI
    marker, and decoders accept an incomplete scan.
    """
    size = None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # any number of fill bytes may precede a marker
            at += 1
            continue
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], 'big')
        if marker in _FRAME_MARKERS and at + 9 <= end <= len(data):
            size = int.from_bytes(data[at + 7 : at + 9], 'big'), int.from_bytes(data[at + 5 : at + 7], 'big')
        elif marker == _SCAN_MARKER and size is not None and all(size) and end < len(data):
            return size
        at = end
    raise Rejected('malformed', f'invalid JPEG header at byte {at} of {len(data)}')


def png_size(data: bytes) -> tuple[int, int]:
    """Width and height of a PNG in pixels. Raises Rejected ``malformed`` if its header is invalid or it has no image data.

    Walks the chunks up to the first IDAT (https://www.w3.org/TR/png-3/#5Chunk-layout); the image data is not checked.
    """
    at = len(PNG_MAGIC)
    if len(data) < at + _IHDR.size:
        raise Rejected('malformed', f'a PNG of {len(data)} bytes')
    length, kind, width, height = _IHDR.unpack_from(data, at)
    if (length, kind) != (13, b'IHDR') or not 0 < width <= _PNG_SIDE or not 0 < height <= _PNG_SIDE:
        raise Rejected('malformed', f'invalid PNG header, {width} x {height} pixels')
    while at + _CHUNK.size < len(data):
        length, kind = _CHUNK.unpack_from(data, at)
        if kind == b'IDAT':
            return width, height
        at += _CHUNK.size + length + 4  # the checksum
    raise Rejected('malformed', f'a PNG of {len(data)} bytes without image data')
