"""PNGs pass through untouched, and what is made without loss (PNG, TIFF) reads back bit for bit, depth among it."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
IMAGE = 'sensor_msgs/msg/Image'
HEIGHT, WIDTH = 5, 7
PIXELS = np.random.default_rng(11).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
"""RGBA"""
DEPTH = np.random.default_rng(12).integers(0, 65536, (HEIGHT, WIDTH), np.uint16)


def png(pixels: Any = PIXELS) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, 'PNG')
    return file.getvalue()


def compressed(ros: Any, data: bytes, format_name: str = 'png', **changes: Any) -> Any:
    return ros.encode(COMPRESSED, ros.cdr(COMPRESSED, format=format_name, data=np.frombuffer(data, np.uint8)), **changes)


def raw(ros: Any, pixels: Any, encoding: str, *, padding: int = 0, bigendian: bool = False, **changes: Any) -> Any:
    """The object of an Image of these pixels, with ``padding`` bytes at the end of each row."""
    rows = np.ascontiguousarray(pixels).reshape(HEIGHT, -1).view(np.uint8)
    rows = np.hstack((rows, np.full((HEIGHT, padding), 0xEE, np.uint8)))
    fields = {'height': HEIGHT, 'width': WIDTH, 'step': rows.shape[1], 'data': rows.reshape(-1), 'is_bigendian': int(bigendian)}
    return ros.encode(IMAGE, ros.cdr(IMAGE, encoding=encoding, **fields), **changes).object


def pixels_of(made: Any) -> Any:
    return np.asarray(Image.open(io.BytesIO(made.body)))


@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize('pixels', [PIXELS, PIXELS[:, :, :3], PIXELS[:, :, 0], DEPTH], ids=['rgba', 'rgb', 'gray', '16 bit'])
def test_a_png_passes_through(ros: Any, format_name: str, pixels: Any) -> None:
    """The object is the published PNG byte for byte, under its own extension and content type, and knows its size."""
    data = png(np.ascontiguousarray(pixels))
    made = compressed(ros, data, format=format_name).object
    assert made.body == data
    assert (made.key, made.content_type) == ('thor/camera/20251018/120000_front.png', 'image/png')
    assert (made.metadata['width'], made.metadata['height']) == ('7', '5')


def test_a_jpeg_is_not_made_a_png(ros: Any) -> None:
    """What was published with loss stays as it was published."""
    file = io.BytesIO()
    Image.fromarray(PIXELS[:, :, :3]).save(file, 'JPEG')
    made = compressed(ros, file.getvalue(), 'jpeg', format='png').object
    assert made.body == file.getvalue()
    assert made.key.endswith('_front.jpg')


def test_a_png_cut_in_its_headers(ros: Any) -> None:
    """A PNG that ends before its first byte of image data is malformed at every length, and kept at every greater one."""
    data = png()
    start = data.index(b'IDAT') + 4
    reasons = {length: compressed(ros, data[:length]).rejected for length in range(8, len(data))}
    assert all(reasons[length] == {'malformed': 1} for length in range(8, start + 1))
    assert all(not reasons[length] for length in range(start + 1, len(data)))


@pytest.mark.parametrize('changes', [{16: 0x80}, {12: 0x4A}, {11: 12}, {16: 0, 17: 0, 18: 0, 19: 0}], ids=str)
def test_a_png_with_a_false_header(ros: Any, changes: dict[int, int]) -> None:
    """Impossible sizes and a first chunk that is not the header are malformed."""
    data = bytearray(png())
    for at, value in changes.items():
        data[at] = value
    assert compressed(ros, bytes(data)).rejected == {'malformed': 1}


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize(('encoding', 'order'), [('rgb8', [0, 1, 2]), ('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 3]),
                                                 ('bgra8', [2, 1, 0, 3]), ('mono8', [0])])  # fmt: skip
def test_colors_without_loss(ros: Any, encoding: str, order: list[int], padding: int) -> None:
    """With format png, every 8-bit image reads back unchanged, alpha included, for any channel order and padding."""
    made = raw(ros, PIXELS[:, :, order], encoding, padding=padding, format='png')
    wanted = PIXELS[:, :, sorted(order)]
    np.testing.assert_array_equal(pixels_of(made), wanted[:, :, 0] if encoding == 'mono8' else wanted)
    assert (made.key, made.content_type) == ('thor/camera/20251018/120000_front.png', 'image/png')
    assert made.metadata['encoding'] == encoding


@pytest.mark.parametrize('padding', [0, 2])
@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16'])
@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
def test_sixteen_bits(ros: Any, format_name: str, encoding: str, bigendian: bool, padding: int) -> None:
    """16-bit images are 16-bit PNGs, with both formats, and every value is as it was published."""
    data = DEPTH.astype('>u2' if bigendian else '<u2')
    made = raw(ros, data, encoding, padding=padding, bigendian=bigendian, format=format_name)
    np.testing.assert_array_equal(pixels_of(made), DEPTH)
    assert (made.key[-4:], made.content_type, made.metadata['encoding']) == ('.png', 'image/png', encoding)


@pytest.mark.parametrize('padding', [0, 4])
@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
def test_floats(ros: Any, format_name: str, bigendian: bool, padding: int) -> None:
    """float32 images are TIFFs with both formats, and every bit is preserved, also in NaN and infinities."""
    meters = np.random.default_rng(13).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    meters[0, :4] = np.nan, np.inf, -np.inf, -0.0
    meters[1, 0] = np.frombuffer(b'\1\2\xc0\x7f', np.float32)[0]  # a NaN with something in it
    data = meters.astype('>f4' if bigendian else '<f4')
    made = raw(ros, data, '32FC1', padding=padding, bigendian=bigendian, format=format_name)
    assert pixels_of(made).tobytes() == meters.tobytes()
    assert (made.key, made.content_type) == ('thor/camera/20251018/120000_front.tiff', 'image/tiff')


@pytest.mark.parametrize('format_name', ['16UC1; compressedDepth png', '16UC1; compressedDepth', '32FC1; compressedDepth png'])
def test_compressed_depth(ros: Any, format_name: str) -> None:
    """The PNG behind the header of compressedDepth is the object; what the header says is in the metadata."""
    data = png(DEPTH)
    made = compressed(ros, struct.pack('<iff', 0, 10100.0, -100.5) + data, format_name).object
    assert made.body == data
    assert made.key.endswith('_front.png')
    assert made.metadata.items() >= {'encoding': format_name[:5], 'depth_quant_a': '10100.0', 'depth_quant_b': '-100.5'}.items()


@pytest.mark.parametrize(('format_name', 'data', 'reason'), [
    ('16UC1; compressedDepth png', b'', 'empty'), ('16UC1; compressedDepth png', bytes(12), 'malformed'),
    ('16UC1; compressedDepth', bytes(400), 'malformed'), ('16UC1; compressedDepth png', bytes(12) + png()[:30], 'malformed'),
])  # fmt: skip
def test_compressed_depth_that_is_broken(ros: Any, format_name: str, data: bytes, reason: str) -> None:
    """What has no PNG although it says so is rejected."""
    encoding = compressed(ros, data, format_name)
    assert encoding.object is None
    assert encoding.rejected == {reason: 1}


def test_pillow_is_loaded_late() -> None:
    """A robot without depth images does not pay for the library that writes them."""
    program = 'import sys, shadowhound_data_logger.formats; print("PIL" in sys.modules)'
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.strip() == 'False'
