"""Camera messages to JPEG: compressed ones pass through byte for byte, raw ones are encoded at the sensor's quality."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import simplejpeg

from shadowhound_data_logger.encode.payload import Job, Payload
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Sample
from shadowhound_data_logger.options import COMPRESSED_IMAGE, IMAGE

_COLORSPACES: Final = {'bgr8': ('BGR', 3), 'rgb8': ('RGB', 3), 'mono8': ('GRAY', 1), 'bgra8': ('BGRA', 4), 'rgba8': ('RGBA', 4)}
"""ROS encoding (sensor_msgs/image_encodings.hpp) -> colour space for the encoder and bytes a pixel; alpha is dropped."""
_MAX_SIDE: Final = 65_500
"""libjpeg's limit (JPEG_MAX_DIMENSION)."""
_JPEG_MAGIC: Final = b'\xff\xd8\xff'
_PNG_MAGIC: Final = b'\x89PNG'
_SOF: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that begin a frame header; C4, C8 and CC in their midst are something else (ITU-T T.81, table B.1)."""
_SOS: Final = 0xDA


def encode_image(job: Job, sample: Sample) -> Payload:
    """The JPEG of one CompressedImage or Image.

    Raises Rejected: ``wrong_type``, ``unknown_type``, ``malformed``, ``empty``, ``not_jpeg``, ``unsupported_encoding``,
    ``size_mismatch`` (width, height, step and data contradict each other), ``too_large`` (for a JPEG).
    """
    if job.batch.type not in (COMPRESSED_IMAGE, IMAGE):
        raise Rejected('wrong_type', f'{job.batch.type} is no image')
    message = job.types.deserialize(job.batch.type, memoryview(sample.cdr))
    if job.batch.type == COMPRESSED_IMAGE:
        body = message.data.tobytes()
        width, height = jpeg_size(body)
    else:
        body = _compress(message, job.sensor.quality)
        width, height = message.width, message.height
    return Payload(body, (sample,), 'jpg', 'image/jpeg', {'width': str(width), 'height': str(height)})


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height of a JPEG whose headers are whole, in pixels; raises Rejected for anything else.

    Walks the marker segments up to the scan (ITU-T T.81, annex B). The scan itself is not judged: cameras do leave out
    the EOI marker, and a decoder shows what there is.
    """
    if not data:
        raise Rejected('empty', 'no image data')
    if not data.startswith(_JPEG_MAGIC):
        reason = 'unsupported_encoding' if data.startswith(_PNG_MAGIC) else 'not_jpeg'
        raise Rejected(reason, f'data begins with {data[:4].hex()}')
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


def _compress(message: Any, quality: int) -> bytes:
    if message.encoding not in _COLORSPACES:
        raise Rejected('unsupported_encoding', f'{message.encoding[:40]!r} cannot become a JPEG')
    colorspace, channels = _COLORSPACES[message.encoding]
    width, height, step = message.width, message.height, message.step
    if not width or not height:
        raise Rejected('empty', f'{width} x {height} pixels')
    if step < width * channels or message.data.size != step * height:
        raise Rejected('size_mismatch', f'{width} x {height} {message.encoding}, step {step}, {message.data.size} bytes of data')
    if max(width, height) > _MAX_SIDE:
        raise Rejected('too_large', f'{width} x {height} pixels, a JPEG has at most {_MAX_SIDE} a side')
    rows = message.data.reshape(height, step)[:, : width * channels]
    pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
    # Half-resolution colour is what OpenCV and libjpeg write by default, and takes half the time of full.
    subsampling = 'Gray' if channels == 1 else '420'
    return bytes(simplejpeg.encode_jpeg(pixels, quality=quality, colorspace=colorspace, colorsubsampling=subsampling))
