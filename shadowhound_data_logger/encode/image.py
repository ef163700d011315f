"""Camera messages to image files: compressed ones pass through byte for byte, raw ones are encoded.

``jpeg`` makes JPEGs of 8-bit colours and greys, ``png`` PNGs without loss. Depth fits in neither JPEG nor, as float, in PNG:
with both formats 16-bit images become 16-bit PNGs, and float32 images become TIFFs with every value as it was, NaN included.
The sizes of JPEG and PNG files are read from their headers, without decoding them.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import simplejpeg

from shadowhound_data_logger.encode.payload import Fact, Job, Payload
from shadowhound_data_logger.encode.statistics import ALL, NONE, Statistic, of_number, of_whole, packed
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Sample
from shadowhound_data_logger.options import ARCHIVES, COMPRESSED_IMAGE, IMAGE
from shadowhound_data_logger.untrusted import check_pixels

if TYPE_CHECKING:
    from numpy.typing import NDArray
JPEG_MAGIC: Final = b'\xff\xd8\xff'
PNG_MAGIC: Final = b'\x89PNG\r\n\x1a\n'
_SOF: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that begin a frame header; C4, C8 and CC in their midst are something else (ITU-T T.81, table B.1)."""
_SOS: Final = 0xDA
_CHUNK: Final = struct.Struct('>I4s')
_IHDR: Final = struct.Struct('>I4sII')
_PNG_SIDE: Final = (1 << 31) - 1


class _Pixel(NamedTuple):
    """How a ROS encoding is said to the libraries."""

    size: int
    """Bytes a pixel."""
    word: int
    """Bytes a value, which big-endian machines have in the other order."""
    mode: str
    """Pillow's mode: https://pillow.readthedocs.io/en/stable/handbook/concepts.html#modes"""
    raw: str
    """The layout that Pillow's ``raw`` decoder reads."""
    colorspace: str = ''
    """simplejpeg's name for it; empty where no JPEG can hold it."""


_DEPTH16: Final = _Pixel(2, 2, 'I;16', 'I;16')
_PIXELS: Final = {
    'bgr8': _Pixel(3, 1, 'RGB', 'BGR', 'BGR'),
    'rgb8': _Pixel(3, 1, 'RGB', 'RGB', 'RGB'),
    'bgra8': _Pixel(4, 1, 'RGBA', 'BGRA', 'BGRA'),
    'rgba8': _Pixel(4, 1, 'RGBA', 'RGBA', 'RGBA'),
    'mono8': _Pixel(1, 1, 'L', 'L', 'GRAY'),
    'mono16': _DEPTH16,
    '16UC1': _DEPTH16,
    '32FC1': _Pixel(4, 4, 'F', 'F;32F'),
}
"""By ROS encoding (sensor_msgs/image_encodings.hpp)."""
_MAX_SIDE: Final = 65_500
"""libjpeg's limit (JPEG_MAX_DIMENSION)."""
_PNG_LEVEL: Final = 1
"""zlib's fastest: the default 6 takes five times as long to save a tenth of a depth image, and 30 a second have to be made."""
_DEPTH: Final = 'compressedDepth'
"""In the ``format`` of what compressed_depth_image_transport publishes, such as ``16UC1; compressedDepth png``."""
_CONFIG_HEADER: Final = struct.Struct('<iff')
"""Its struct before the PNG: a format number without meaning, and the two parameters of the inverse depth
(compressed_depth_image_transport/compression_common.hpp, codec.cpp)."""


def encode_jpeg(job: Job, sample: Sample) -> Payload:
    """The image of one CompressedImage or Image, JPEG where it can be.

    Raises Rejected: ``wrong_type``, ``unknown_type``, ``malformed``, ``empty``, ``unsupported_encoding``,
    ``size_mismatch`` (width, height, step and data contradict each other), ``too_large`` (for a JPEG).
    """
    return _encode(job, sample, lossless=False)


def encode_png(job: Job, sample: Sample) -> Payload:
    """The image of one CompressedImage (as it is) or Image (without loss). Raises Rejected as ``encode_jpeg`` does."""
    return _encode(job, sample, lossless=True)


def _encode(job: Job, sample: Sample, *, lossless: bool) -> Payload:
    if job.batch.type not in (COMPRESSED_IMAGE, IMAGE):
        raise Rejected('wrong_type', f'{job.batch.type} is not an image')
    message = job.types.deserialize(job.batch.type, memoryview(sample.cdr))
    if job.batch.type == COMPRESSED_IMAGE:
        return _published(job, sample, message)
    pixel = _layout(message)
    facts = {'width': message.width, 'height': message.height, 'encoding': message.encoding}
    if pixel.colorspace and not lossless:
        body = _jpeg(message, pixel, job.sensor.quality)
        return Payload(body, (sample,), 'jpg', 'image/jpeg', facts, _statistics(job, body))
    if pixel.mode == 'F':
        return Payload(_pillow(message, pixel, 'TIFF'), (sample,), 'tiff', 'image/tiff', facts)
    return Payload(_pillow(message, pixel, 'PNG', compress_level=_PNG_LEVEL), (sample,), 'png', 'image/png', facts)


def _published(job: Job, sample: Sample, message: Any) -> Payload:
    """A CompressedImage's own bytes, if they are a JPEG or a PNG."""
    data: Any = message.data
    facts: dict[str, Fact] = {}
    if _DEPTH in message.format:
        data, facts = _depth(message)
    body = data.tobytes()
    if body.startswith(JPEG_MAGIC):
        (width, height), ext, content_type = jpeg_size(body), 'jpg', 'image/jpeg'
    elif body.startswith(PNG_MAGIC):
        (width, height), ext, content_type = png_size(body), 'png', 'image/png'
    elif not body:
        raise Rejected('empty', 'no image data')
    else:
        text = f'neither JPEG nor PNG: format {message.format[:40]!r}, data begins with {body[:4].hex()}'
        raise Rejected('unsupported_encoding', text)
    found = _statistics(job, body) if ext == 'jpg' else b''
    return Payload(body, (sample,), ext, content_type, {'width': width, 'height': height, **facts}, found)


def _statistics(job: Job, body: bytes) -> bytes:
    """Of a picture that is an object of its own."""
    return packed(of_jpeg(body)) if job.sensor.statistics != (NONE,) and job.sensor.format not in ARCHIVES else b''


def _depth(message: Any) -> tuple[Any, dict[str, Fact]]:
    """The PNG of a compressed depth image, and what its header says.

    With encoding 32FC1 the PNG holds the inverse depth: metres are ``depth_quant_a / (pixel - depth_quant_b)``, 0 is NaN.
    """
    encoding, _, rest = message.format.partition(';')
    if encoding not in ('16UC1', 'mono16', '32FC1') or rest.strip() not in (_DEPTH, f'{_DEPTH} png'):
        raise Rejected('unsupported_encoding', f'{message.format[:40]!r} is not a depth image as PNG')
    data = message.data
    if data.size <= _CONFIG_HEADER.size or data[_CONFIG_HEADER.size :][: len(PNG_MAGIC)].tobytes() != PNG_MAGIC:
        raise Rejected('malformed', f'no PNG behind the header of {message.format[:40]!r}')
    _, quant_a, quant_b = _CONFIG_HEADER.unpack_from(data)
    return data[_CONFIG_HEADER.size :], {'encoding': encoding, 'depth_quant_a': quant_a, 'depth_quant_b': quant_b}


def _layout(message: Any) -> _Pixel:
    """What the pixels are, once it is certain that all of them are there."""
    pixel = _PIXELS.get(message.encoding)
    if pixel is None:
        raise Rejected('unsupported_encoding', f'{message.encoding[:40]!r} is none of {", ".join(_PIXELS)}')
    width, height, step = message.width, message.height, message.step
    if not width or not height:
        raise Rejected('empty', f'{width} x {height} pixels')
    if step < width * pixel.size or message.data.size != step * height:
        raise Rejected('size_mismatch', f'{width} x {height} {message.encoding}, step {step}, {message.data.size} bytes of data')
    return pixel


def _rows(message: Any, pixel: _Pixel) -> NDArray[Any]:
    """The pixels without padding, little-endian, a row a line; not copied where they are so already."""
    rows = np.ascontiguousarray(message.data.reshape(message.height, message.step)[:, : message.width * pixel.size])
    # Not left to Pillow: that of Ubuntu 22.04 (9.0) reads big-endian 16 bits wrongly.
    return rows.view(f'u{pixel.word}').byteswap() if message.is_bigendian and pixel.word > 1 else rows


def _jpeg(message: Any, pixel: _Pixel, quality: int) -> bytes:
    width, height = message.width, message.height
    if max(width, height) > _MAX_SIDE:
        raise Rejected('too_large', f'{width} x {height} pixels, a JPEG has at most {_MAX_SIDE} a side')
    pixels = _rows(message, pixel).reshape(height, width, pixel.size)
    # Half-resolution colour is what OpenCV and libjpeg write by default, and takes half the time of full.
    subsampling = 'Gray' if pixel.size == 1 else '420'
    return bytes(simplejpeg.encode_jpeg(pixels, quality=quality, colorspace=pixel.colorspace, colorsubsampling=subsampling))


def _pillow(message: Any, pixel: _Pixel, kind: str, **options: int) -> bytes:
    # Loaded when the first such image comes: most robots have none, and it takes 0.1 s and 9 MB.
    from PIL import Image  # noqa: PLC0415

    size = message.width, message.height
    image = Image.frombuffer(pixel.mode, size, _rows(message, pixel), 'raw', pixel.raw, 0, 1)
    file = BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def of_jpeg(body: bytes) -> dict[str, Statistic]:
    """Brightness, 0 to 255, and sharpness, the variance of the Laplacian, both of its grey at an eighth of the size.

    Empty where it cannot be decoded.
    """
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(body)
        check_pixels(width, height)
        grey = simplejpeg.decode_jpeg(body, 'GRAY', fastdct=True, fastupsample=True, min_height=1, min_width=1)
        grey = grey[:, :, 0].astype(np.float32)
    except (ValueError, MemoryError):
        return {}
    found = {'brightness': float(grey.mean(dtype=np.float64))}
    if min(grey.shape) > 2:
        edges = 4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
        found['sharpness'] = float(edges.var(dtype=np.float64))
    return {ALL: of_whole(1), **{name: of_number(value) for name, value in found.items()}}


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height of a JPEG whose headers are whole, in pixels; raises Rejected ``malformed`` for anything else.

    Walks the marker segments up to the scan (ITU-T T.81, annex B). The scan itself is not judged: cameras do leave out
    the EOI marker, and a decoder shows what there is.
    """
    size = None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte; any number may precede a marker
            at += 1
            continue
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], 'big')
        if marker in _SOF and at + 9 <= end <= len(data):
            size = int.from_bytes(data[at + 7 : at + 9], 'big'), int.from_bytes(data[at + 5 : at + 7], 'big')
        elif marker == _SOS and size is not None and all(size) and end < len(data):
            return size
        at = end
    raise Rejected('malformed', f'broken JPEG header at byte {at} of {len(data)}')


def png_size(data: bytes) -> tuple[int, int]:
    """Width and height of a PNG whose header is whole and whose image data has begun; raises Rejected ``malformed``.

    Walks the chunks up to the first IDAT (https://www.w3.org/TR/png-3/#5Chunk-layout); the image data is not judged.
    """
    at = len(PNG_MAGIC)
    if len(data) < at + _IHDR.size:
        raise Rejected('malformed', f'a PNG of {len(data)} bytes')
    length, kind, width, height = _IHDR.unpack_from(data, at)
    if (length, kind) != (13, b'IHDR') or not 0 < width <= _PNG_SIDE or not 0 < height <= _PNG_SIDE:
        raise Rejected('malformed', f'broken PNG header, {width} x {height} pixels')
    while at + _CHUNK.size < len(data):
        length, kind = _CHUNK.unpack_from(data, at)
        if kind == b'IDAT':
            return width, height
        at += _CHUNK.size + length + 4  # the checksum
    raise Rejected('malformed', f'a PNG of {len(data)} bytes without image data')
