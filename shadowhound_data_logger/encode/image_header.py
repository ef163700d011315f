"""The sizes of JPEG and PNG files from their headers, without decoding them. Whatever the bytes are, only Rejected is raised."""

from __future__ import annotations

import struct
from typing import Final

from shadowhound_data_logger.errors import Rejected

JPEG_MAGIC: Final = b'\xff\xd8\xff'
PNG_MAGIC: Final = b'\x89PNG\r\n\x1a\n'
_SOF: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that begin a frame header; C4, C8 and CC in their midst are something else (ITU-T T.81, table B.1)."""
_SOS: Final = 0xDA
_CHUNK: Final = struct.Struct('>I4s')
_IHDR: Final = struct.Struct('>I4sII')
_PNG_SIDE: Final = (1 << 31) - 1


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
