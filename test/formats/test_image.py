"""Images of every encoding look the same in other libraries, or are stored bit for bit."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
from typing import Any

import av
import numpy as np
import pytest
import simplejpeg
from av.video.reformatter import ColorRange, Colorspace
from PIL import Image

from shadowhound_data_logger.formats.rvl import decode_rvl
from shadowhound_data_logger.formats.statistics import ALL, unpack_statistics
from shadowhound_data_logger.lake.values import statistics_of

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
IMAGE = 'sensor_msgs/msg/Image'


def gradient(height: int = 48, width: int = 64) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A picture in RGB whose channels differ everywhere: swapped colors cannot go unnoticed."""
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack((rows * 255 // height, columns * 255 // width, np.full_like(rows, 40)), axis=-1).astype(np.uint8)


def jpeg(**options: Any) -> bytes:
    return bytes(simplejpeg.encode_jpeg(gradient(), **options))


def compressed(ros: Any, data: bytes, **changes: Any) -> Any:
    return ros.encode(COMPRESSED, ros.cdr(COMPRESSED, format='jpeg', data=np.frombuffer(data, np.uint8)), **changes)


def raw(ros: Any, rows: Any, *, encoding: str, sensor: dict[str, Any] | None = None, **lies: Any) -> Any:
    """Encode an Image of these bytes (height x step)."""
    rows = np.ascontiguousarray(rows)
    channels = {'mono8': 1, 'bgra8': 4, 'rgba8': 4}.get(encoding, 3)
    fields = {'height': len(rows), 'width': rows.shape[1] // channels, 'step': rows.shape[1], 'data': rows.reshape(-1)}
    return ros.encode(IMAGE, ros.cdr(IMAGE, encoding=encoding, **(fields | lies)), **(sensor or {}))


@pytest.mark.parametrize('subsampling', ['444', '422', '420', '440', '411', 'Gray'])
def test_a_jpeg_is_stored_unchanged(ros: Any, subsampling: str) -> None:
    """The object is the published JPEG byte for byte, whatever its chroma subsampling, and knows its size."""
    picture = gradient()[:, :, :1].copy() if subsampling == 'Gray' else gradient()
    colorspace = 'GRAY' if subsampling == 'Gray' else 'RGB'
    data = bytes(simplejpeg.encode_jpeg(picture, colorspace=colorspace, colorsubsampling=subsampling))
    encoding = compressed(ros, data)
    assert encoding.object.body == data
    assert encoding.object.content_type == 'image/jpeg'
    assert encoding.object.key == 'thor/camera/20251018/120000_front.jpg'
    assert (encoding.object.metadata['width'], encoding.object.metadata['height']) == ('64', '48')
    assert encoding.rejected == {}


def test_a_jpeg_in_big_endian_cdr_is_stored_unchanged(ros: Any) -> None:
    """A JPEG inside big-endian CDR comes out untouched too."""
    cdr = ros.cdr(COMPRESSED, data=np.frombuffer(jpeg(), np.uint8), little_endian=False)
    assert ros.encode(COMPRESSED, cdr).object.body == jpeg()


def test_a_jpeg_without_end_or_with_fill_bytes_is_stored(ros: Any) -> None:
    """Some cameras omit the EOI marker, append bytes or insert fill bytes before a marker: such frames are kept."""
    whole = jpeg()
    for data in (whole[:-2], whole + bytes(7), whole[:2] + b'\xff\xff' + whole[2:], whole[: len(whole) - 100]):
        assert compressed(ros, data).object.body == data


@pytest.mark.parametrize(
    ('data', 'reason'),
    [(b'', 'empty'), (b'\xff\xd8\xff', 'malformed'), (b'\xff\xd8\xff\xe0' + bytes(400), 'malformed')],
    ids=['nothing', 'magic only', 'zeros'],
)  # fmt: skip
def test_data_that_is_not_an_image_is_rejected(ros: Any, data: bytes, reason: str) -> None:
    """No data, and a JPEG without its headers, are rejected by reason."""
    encoding = compressed(ros, data)
    assert encoding.object is None
    assert encoding.rejected == {reason: 1}


def test_a_jpeg_truncated_in_its_headers_is_malformed(ros: Any) -> None:
    """A JPEG that ends before its first scan byte is malformed at every length, and kept at every greater one."""
    data = jpeg()
    scan = data.index(b'\xff\xda')
    scan += 2 + int.from_bytes(data[scan + 2 : scan + 4], 'big')
    reasons = {length: compressed(ros, data[:length]).rejected for length in range(3, scan + 40)}
    assert all(reasons[length] == {'malformed': 1} for length in range(3, scan + 1))
    assert all(not reasons[length] for length in range(scan + 1, scan + 40))


@pytest.mark.parametrize('padding', [0, 16])
@pytest.mark.parametrize('encoding', ['rgb8', 'bgr8', 'rgba8', 'bgra8'])
def test_a_raw_image_keeps_its_colors_whatever_its_padding(ros: Any, encoding: str, padding: int) -> None:
    """A raw color image, with or without padding at the end of its rows, decodes to the same picture."""
    picture = gradient()
    order = ['rgba'.index(channel) % 3 for channel in encoding.removesuffix('8')]
    rows = np.hstack((picture[:, :, order].reshape(48, -1), np.full((48, padding), 99, np.uint8)))
    body = raw(ros, rows, encoding=encoding, width=64).object.body
    decoded = simplejpeg.decode_jpeg(body).astype(int)
    assert decoded.shape == (48, 64, 3)
    assert np.abs(decoded - picture).max() <= 12
    assert np.abs(decoded - picture).mean() < 2


def test_a_gray_image_becomes_a_gray_jpeg(ros: Any) -> None:
    """A mono8 image becomes a gray JPEG."""
    gray = gradient()[:, :, 1]
    body = raw(ros, gray, encoding='mono8').object.body
    assert simplejpeg.decode_jpeg_header(body)[2:] == ('Gray', 'Gray')
    assert np.abs(simplejpeg.decode_jpeg(body, 'GRAY')[:, :, 0].astype(int) - gray).max() <= 6


def test_the_quality_setting_decides_the_size(ros: Any) -> None:
    """The sensor's quality decides the size of what is encoded."""
    noisy = np.random.default_rng(1).integers(0, 255, (48, 192), np.uint8)
    sizes = [len(raw(ros, noisy, encoding='bgr8', sensor={'quality': quality}).object.body) for quality in (10, 50, 85, 100)]
    assert sizes == sorted(sizes)
    assert sizes[0] * 3 < sizes[-1]


@pytest.mark.parametrize(
    ('lies', 'reason'),
    [
        ({'width': 65}, 'size_mismatch'),
        ({'height': 49}, 'size_mismatch'),
        ({'height': 47}, 'size_mismatch'),
        ({'step': 191}, 'size_mismatch'),
        ({'step': 193}, 'size_mismatch'),
        ({'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1}, 'size_mismatch'),
        ({'data': np.zeros(0, np.uint8)}, 'size_mismatch'),
        ({'width': 0}, 'empty'),
        ({'height': 0, 'data': np.zeros(0, np.uint8)}, 'empty'),
        ({'encoding': '32FC1'}, 'size_mismatch'),
    ],
)
def test_raw_images_with_false_sizes_are_rejected(ros: Any, lies: dict[str, Any], reason: str) -> None:
    """Inconsistent sizes and images without pixels have different reasons, for every format."""
    for format_name in ('jpeg', 'png'):
        result = raw(ros, gradient().reshape(48, -1), sensor={'format': format_name}, **({'encoding': 'bgr8'} | lies))
        assert result.object is None
        assert result.rejected == {reason: 1}


def test_an_image_too_large_for_jpeg_is_rejected(ros: Any) -> None:
    """An image with a side that JPEG cannot express is rejected before the encoder sees it."""
    assert raw(ros, np.zeros((1, 65_501), np.uint8), encoding='mono8').rejected == {'too_large': 1}
    assert raw(ros, np.zeros((1, 65_500), np.uint8), encoding='mono8').object is not None


def test_a_jpeg_has_brightness_and_sharpness(ros: Any) -> None:
    """Computed from its gray: an even image has its brightness and no edges; a reader of the object computes the same."""
    board = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((16, 16))) * 255
    fields = {}
    for name, gray in (('dark', np.full((96, 128), 20)), ('board', board)):
        picture = np.repeat(gray[:, :, None].astype(np.uint8), 3, axis=2)
        made = compressed(ros, bytes(simplejpeg.encode_jpeg(picture, quality=95))).object
        fields[name] = unpack_statistics(made.statistics)
        assert fields[name] == statistics_of(made.key, made.body)
        assert (set(fields[name]), fields[name][ALL].count) == ({ALL, 'brightness', 'sharpness'}, 1)
    assert fields['dark']['brightness'].mean == pytest.approx(20, abs=2)
    assert fields['board']['brightness'].max == pytest.approx(127, abs=3)
    assert fields['dark']['sharpness'].max < 1
    assert fields['board']['sharpness'].max > 100
    assert compressed(ros, jpeg(), statistics=('none',)).object.statistics == b''


HEIGHT, WIDTH = 48, 64
AV_FORMATS = {'yuv422': 'uyvy422', 'uyvy': 'uyvy422', 'yuv422_yuy2': 'yuyv422', 'yuyv': 'yuyv422', 'YUYV': 'yuyv422',
              'nv12': 'nv12', 'nv21': 'nv21', 'nv16': 'nv16', 'nv24': 'nv24', 'nv42': 'nv42'}  # fmt: skip
"""ROS encoding -> the same in FFmpeg."""
ORDERS = ['rggb', 'bggr', 'gbrg', 'grbg']


def picture() -> Any:
    """A picture in RGB whose channels differ everywhere: swapped colors cannot go unnoticed."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack((40 + rows * 3, 30 + columns * 3, np.full_like(rows, 60)), axis=-1).astype(np.uint8)


def image(ros: Any, encoding: str, data: bytes, *, width: int = WIDTH, height: int = HEIGHT, step: int, bigendian: bool = False,
          **changes: Any) -> Any:  # fmt: skip
    fields = {
        'height': height,
        'width': width,
        'step': step,
        'is_bigendian': int(bigendian),
        'data': np.frombuffer(data, np.uint8),
    }
    return ros.encode(IMAGE, ros.cdr(IMAGE, encoding=encoding, **fields), **changes)


def compressed_as(ros: Any, format_name: str, data: bytes, **changes: Any) -> Any:
    return ros.encode(COMPRESSED, ros.cdr(COMPRESSED, format=format_name, data=np.frombuffer(data, np.uint8)), **changes)


def by_ffmpeg(kind: str, *, padding: int = 0) -> bytes:
    """The picture as FFmpeg converts it, BT.601 in the limited range, with so many bytes at the end of each row of Y."""
    frame = av.VideoFrame.from_ndarray(picture(), 'rgb24').reformat(
        format=kind, dst_colorspace=Colorspace.ITU601, dst_color_range=ColorRange.MPEG, src_color_range=ColorRange.JPEG
    )
    parts = []
    for number, plane in enumerate(frame.planes):
        rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
        width = plane.width * (2 if number or kind.endswith('422') else 1)
        pad = padding * (2 if number and kind in {'nv24', 'nv42'} else 1)
        parts.append(np.hstack((rows[:, :width], np.full((plane.height, pad), 99, np.uint8))).tobytes())
    return b''.join(parts)


def step_of(encoding: str, padding: int = 0) -> int:
    return (2 * WIDTH if AV_FORMATS[encoding].endswith('422') else WIDTH) + padding


def looks_like(found: Any, wanted: Any, tolerance: float = 3.0) -> bool:
    difference = np.abs(found.astype(int) - wanted.astype(int))
    return found.shape == wanted.shape and float(difference.mean()) < tolerance and int(difference.max()) < 24


@pytest.mark.parametrize('padding', [0, 12])
@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize('encoding', AV_FORMATS)
def test_yuv_images_keep_their_colors(ros: Any, encoding: str, format_name: str, padding: int) -> None:
    """YUV images of cameras, converted by FFmpeg, are a JPEG or a PNG with the colors that they were made from."""
    made = image(
        ros, encoding, by_ffmpeg(AV_FORMATS[encoding], padding=padding), step=step_of(encoding, padding), format=format_name
    )
    assert made.rejected == {}
    found = np.asarray(Image.open(io.BytesIO(made.object.body)).convert('RGB'))
    assert looks_like(found, picture())
    assert made.object.metadata.items() >= {'encoding': encoding, 'width': '64', 'height': '48'}.items()
    assert made.object.content_type == f'image/{format_name}'
    assert 'verbatim' not in made.object.metadata


@pytest.mark.parametrize('encoding', ['yuv422', 'yuv422_yuy2'])
def test_the_planes_of_a_camera_are_not_resampled(ros: Any, encoding: str) -> None:
    """The JPEG has the camera's own resolution of colors, and the quality of the sensor."""
    data = by_ffmpeg(AV_FORMATS[encoding])
    made = [image(ros, encoding, data, step=2 * WIDTH, quality=quality).object.body for quality in (10, 95)]
    assert simplejpeg.decode_jpeg_header(made[1]) == (HEIGHT, WIDTH, 'YCbCr', '422')
    assert len(made[0]) < len(made[1])


@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize(('width', 'height'), [(5, 4), (5, 3), (1, 1), (1, 4), (2, 1), (3, 2)])
@pytest.mark.parametrize('encoding', ['yuv422', 'yuv422_yuy2', 'nv12', 'nv21', 'nv24'])
def test_yuv_images_may_have_odd_sizes(ros: Any, encoding: str, width: int, height: int, format_name: str) -> None:
    """Pixels without a partner have its colors: a picture of one color has that color up to the last column and row."""
    y, u, v = 81, 90, 240  # red
    if encoding.startswith('yuv'):
        pair = [u, y, v, y] if encoding == 'yuv422' else [y, u, y, v]
        data, step = bytes((pair * width)[: 2 * width]) * height, 2 * width
    else:
        columns, rows = (width, height) if encoding == 'nv24' else (-(-width // 2), -(-height // 2))
        data, step = bytes([y] * (width * height) + ([v, u] if encoding == 'nv21' else [u, v]) * (columns * rows)), width
    made = image(ros, encoding, data, width=width, height=height, step=step, format=format_name)
    assert made.rejected == {}
    found = np.asarray(Image.open(io.BytesIO(made.object.body)).convert('RGB')).astype(int)
    assert found.shape == (height, width, 3)
    wanted = [255, 0, 0] if width > 1 or not encoding.startswith('yuv') else found[0, 0].tolist()  # a lone half pair has no V
    assert np.abs(found - wanted).max() < 8


def test_limited_range_values_become_full_range(ros: Any) -> None:
    """Black and white of a camera, 16 and 235, are black and white; values beyond them are cut off."""
    data = bytes([0, 128, 16, 128, 235, 128, 255, 128])
    made = image(ros, 'yuv422_yuy2', data, width=4, height=1, step=8, format='png')
    assert np.asarray(Image.open(io.BytesIO(made.object.body))).tolist() == [[[0] * 3, [0] * 3, [255] * 3, [255] * 3]]


@pytest.mark.parametrize(('step', 'size'), [(96, 4608), (64, 4608), (0, 4608), (80, 80 * 72)])
def test_nv12_may_have_either_step(ros: Any, step: int, size: int) -> None:
    """The step may be that of Y, or their size divided by the height; the data must agree with it."""
    data = by_ffmpeg('nv12', padding=size // 72 - 64)
    made = image(ros, 'nv12', data, step=step)
    assert looks_like(simplejpeg.decode_jpeg(made.object.body), picture())


@pytest.mark.parametrize(('encoding', 'changes'), [
    ('nv12', {'data': bytes(4607)}), ('nv12', {'data': bytes(2 * 64 * 48), 'step': 128}), ('nv24', {'data': bytes(4608)}),
    ('yuv422_yuy2', {'step': 127}), ('yuv422_yuy2', {'data': bytes(100)}), ('yuv422', {'data': b''}),
])  # fmt: skip
def test_yuv_of_an_inconsistent_size_is_stored_as_serialized(ros: Any, encoding: str, changes: dict[str, Any]) -> None:
    """Planes whose place is not certain are not guessed: the message is stored as it was serialized."""
    values = {'data': bytes(2 * 64 * 48), 'step': 128} | changes
    cdr = ros.cdr(
        IMAGE, encoding=encoding, width=WIDTH, height=HEIGHT, step=values['step'], data=np.frombuffer(values['data'], np.uint8)
    )
    made = ros.encode(IMAGE, cdr)
    assert (made.rejected, made.object.body) == ({}, cdr)
    assert made.object.metadata['verbatim'] == 'unknown_layout'


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize('encoding', ['8UC1', *(f'bayer_{order}8' for order in ORDERS)])
def test_labels_and_mosaics_are_stored_without_loss(ros: Any, encoding: str, format_name: str, padding: int) -> None:
    """Values that are no brightness are never compressed with loss: they are a gray PNG, bit for bit."""
    values = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    rows = np.hstack((values, np.full((HEIGHT, padding), 7, np.uint8)))
    made = image(ros, encoding, rows.tobytes(), step=WIDTH + padding, format=format_name).object
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(made.body))), values)
    assert (made.content_type, made.metadata['encoding']) == ('image/png', encoding)


@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16', *(f'bayer_{order}16' for order in ORDERS)])
def test_sixteen_bit_images_become_sixteen_bit_pngs(ros: Any, encoding: str, bigendian: bool) -> None:
    """16-bit images are 16-bit PNGs, in either byte order."""
    values = np.random.default_rng(1).integers(0, 65536, (HEIGHT, WIDTH), np.uint16)
    data = values.astype('>u2' if bigendian else '<u2').tobytes()
    made = image(ros, encoding, data, step=2 * WIDTH, bigendian=bigendian).object
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(made.body))), values)


@pytest.mark.parametrize('padding', [0, 2])
@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize(('encoding', 'order'), [('rgb16', 'RGB'), ('bgr16', 'BGR'), ('16UC3', 'BGR'), ('rgba16', 'RGBA'),
                                                 ('bgra16', 'BGRA'), ('16UC4', 'BGRA')])  # fmt: skip
def test_sixteen_bit_colors_become_sixteen_bit_pngs(ros: Any, encoding: str, order: str, bigendian: bool, padding: int) -> None:
    """They are PNGs of 16 bits a color, which FFmpeg reads back bit for bit, and Pillow opens."""
    channels = len(order)
    values = np.random.default_rng(1).integers(0, 65536, (HEIGHT, WIDTH, channels), np.uint16)
    data = values.astype('>u2' if bigendian else '<u2').reshape(HEIGHT, -1).view(np.uint8)
    data = np.hstack((data, np.full((HEIGHT, padding), 7, np.uint8)))
    made = image(ros, encoding, data.tobytes(), step=data.shape[1], bigendian=bigendian).object
    with av.open(io.BytesIO(made.body), format='png_pipe') as file:
        frame = next(file.decode(video=0))
    kind = 'rgb48be' if channels == 3 else 'rgba64be'
    assert frame.format.name == kind
    found = np.frombuffer(frame.planes[0], '>u2').reshape(HEIGHT, -1)[:, : WIDTH * channels].reshape(HEIGHT, WIDTH, channels)
    np.testing.assert_array_equal(found, values[:, :, [order.index(channel) for channel in 'RGBA'[:channels]]])
    assert Image.open(io.BytesIO(made.body)).size == (WIDTH, HEIGHT)


@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize(('encoding', 'order'), [('8UC3', [2, 1, 0]), ('8UC4', [2, 1, 0, 0])])
def test_generic_color_encodings_have_the_order_of_opencv(ros: Any, encoding: str, order: list[int], format_name: str) -> None:
    """8UC3 and 8UC4 are in the order of OpenCV."""
    data = np.ascontiguousarray(picture()[:, :, order])
    made = image(ros, encoding, data.tobytes(), step=WIDTH * len(order), format=format_name).object
    assert made.content_type == f'image/{format_name}'
    assert looks_like(
        np.asarray(Image.open(io.BytesIO(made.body)).convert('RGB')), picture(), 2.0 if format_name == 'jpeg' else 0.1
    )


@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize('encoding', ['', '16SC1', '8SC1', '32SC1', '32FC3', '64FC1', 'rgb565', 'jpeg', 'yuv420', 'bayer_xxxx8',
                                      'RGB8', 'x\ny', 'ü' * 500])  # fmt: skip
def test_unknown_encodings_are_stored_as_serialized(ros: Any, encoding: str, format_name: str) -> None:
    """Images of encodings that are not known are stored bit for bit, and their metadata says so, in printable ASCII."""
    cdr = ros.cdr(IMAGE, encoding=encoding, width=3, height=2, step=9, data=np.arange(7, dtype=np.uint8))
    made = ros.encode(IMAGE, cdr, format=format_name)
    assert (made.rejected, made.object.body) == ({}, cdr)
    assert (made.object.key, made.object.content_type) == ('thor/camera/20251018/120000_front.cdr', 'application/octet-stream')
    assert made.object.metadata['verbatim'] == 'unsupported_encoding'
    assert made.object.metadata['encoding'].isascii()
    assert made.object.metadata['encoding'].isprintable()
    assert ros.types.deserialize(IMAGE, made.object.body).encoding == encoding


@pytest.mark.parametrize('format_name', ['webp', 'h264', '', 'rgb8; jpeg compressed bgr8', 'bgr8; tiff compressed '])
def test_unknown_compressions_are_stored_as_serialized(ros: Any, format_name: str) -> None:
    """Compressed data that are neither JPEG, PNG nor TIFF are stored bit for bit with their message."""
    cdr = ros.cdr(COMPRESSED, format=format_name, data=np.frombuffer(b'RIFF....WEBP' + bytes(50), np.uint8))
    made = ros.encode(COMPRESSED, cdr)
    assert (made.rejected, made.object.body) == ({}, cdr)
    assert made.object.metadata.items() >= {'verbatim': 'unsupported_encoding', 'encoding': format_name}.items()


def test_a_tiff_passes_through(ros: Any) -> None:
    """compressed_image_transport can publish TIFF: the object is that, byte for byte."""
    file = io.BytesIO()
    Image.fromarray(picture()).save(file, 'TIFF')
    made = compressed_as(ros, 'bgr8; tiff compressed bgr8', file.getvalue()).object
    assert (made.body, made.content_type, made.key[-5:]) == (file.getvalue(), 'image/tiff', '.tiff')


# -- compressed depth --------------------------------------------------------------------------------------------------


def depth(seed: int = 1, height: int = HEIGHT, width: int = WIDTH) -> Any:
    """Surfaces, edges and holes."""
    rng = np.random.default_rng(seed)
    found = (500 + np.add.outer(np.arange(height) * 7, np.arange(width) * 3) + rng.integers(0, 20, (height, width))).astype(
        np.uint16
    )
    found[rng.random((height, width)) < 0.1] = 0
    found[height // 3 : height // 2, width // 4 : width // 2] = 0
    found[0, 0], found[-1, -1] = 65535, 1
    return found


def rvl(pixels: Any) -> bytes:
    """As RvlCodec::CompressRVL writes it, with the size in front."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            value, low = value >> 3, value & 7
            nibbles.append(low | 8 if value else low)
            if not value:
                return

    flat = [int(pixel) for pixel in pixels.reshape(-1)]
    at = previous = 0
    while at < len(flat):
        end = next((place for place in range(at, len(flat)) if flat[place]), len(flat))
        put(end - at)
        at = end
        end = next((place for place in range(at, len(flat)) if not flat[place]), len(flat))
        put(end - at)
        for pixel in flat[at:end]:
            delta = pixel - previous
            put((delta << 1) ^ (delta >> 31) if delta >= 0 else -2 * delta - 1)
            previous = pixel
        at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int(''.join(f'{nibble:x}' for nibble in nibbles[place : place + 8]), 16) for place in range(0, len(nibbles), 8)]
    return struct.pack('<II', pixels.shape[1], pixels.shape[0]) + struct.pack(f'<{len(words)}I', *words)


def png_of(pixels: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, 'PNG')
    return file.getvalue()


HEADER = struct.pack('<iff', 0, 10100.0, -100.5)
QUANTIZED = {'depth_quant_a': '10100.0', 'depth_quant_b': '-100.5'}


@pytest.mark.parametrize('encoding', ['16UC1', '32FC1', 'mono16'])
@pytest.mark.parametrize('pixels', [depth(), depth(2, 7, 13), np.zeros((480, 640), np.uint16), np.full((3, 5), 9, np.uint16),
                                    np.array([[0, 65535, 0, 1, 65535]], np.uint16)],
                         ids=['room', 'odd', 'black', 'flat', 'jumps'])  # fmt: skip
def test_rvl_depth_becomes_a_sixteen_bit_png(ros: Any, pixels: Any, encoding: str) -> None:
    """A depth image in RVL is a 16-bit PNG with the same values, and the same metadata as one that was published as a PNG."""
    made = compressed_as(ros, f'{encoding}; compressedDepth rvl', HEADER + rvl(pixels))
    assert made.rejected == {}
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(made.object.body))), pixels)
    assert made.object.content_type == 'image/png'
    size = {'width': str(pixels.shape[1]), 'height': str(pixels.shape[0])}
    assert made.object.metadata.items() >= {'encoding': encoding, **QUANTIZED, **size}.items()


@pytest.mark.parametrize('format_name', ['16UC1; compressedDepth png', '16UC1; compressedDepth', '16UC1;compressedDepth', '16UC1',
                                         '16UC1; png compressedDepth'])  # fmt: skip
def test_every_header_of_compressed_depth_is_read(ros: Any, format_name: str) -> None:
    """The PNG is found whatever version of the plugin named it, also without the header in front of it."""
    data = png_of(depth())
    made = compressed_as(ros, format_name, HEADER + data).object
    assert (made.body, made.metadata.items() >= {'encoding': '16UC1', **QUANTIZED}.items()) == (data, True)
    bare = compressed_as(ros, format_name, data).object
    assert (bare.body, 'depth_quant_a' in bare.metadata) == (data, False)


@pytest.mark.parametrize('body', [
    b'', bytes(4), struct.pack('<II', 0, 9) + bytes(40), struct.pack('<II', 2**32 - 1, 2**32 - 1) + bytes(40),
    struct.pack('<II', 4000, 4000) + bytes(40), rvl(depth())[:-40], rvl(depth())[:20], struct.pack('<II', 8, 8) + b'\xff' * 40,
    struct.pack('<II', 64, 47) + rvl(depth())[8:],
], ids=range(9))  # fmt: skip
def test_unreadable_rvl_is_stored_as_serialized(ros: Any, body: bytes) -> None:
    """What claims to be RVL and is not is stored bit for bit."""
    with pytest.raises(ValueError, match='RVL'):
        decode_rvl(body)
    cdr = ros.cdr(COMPRESSED, format='16UC1; compressedDepth rvl', data=np.frombuffer(HEADER + body, np.uint8))
    made = ros.encode(COMPRESSED, cdr)
    assert made.rejected == ({} if body else {'malformed': 1})
    if body:
        assert (made.object.body, made.object.metadata['verbatim']) == (cdr, 'unsupported_encoding')


def test_any_bytes_as_rvl_are_an_image_or_an_error() -> None:
    """Noise is an image or a ValueError, never anything else."""
    rng = np.random.default_rng(3)
    outcomes = set()
    for seed in range(300):
        data = struct.pack('<II', 16, 16) + rng.integers(0, 256, int(rng.integers(0, 400)), np.uint8).tobytes()
        if seed % 3 == 0:
            changed = bytearray(rvl(depth(seed, 16, 16)))
            changed[8 + int(rng.integers(0, len(changed) - 8))] ^= 1 << int(rng.integers(0, 8))
            data = bytes(changed)
        try:
            assert decode_rvl(data).shape == (16, 16)
            outcomes.add('image')
        except ValueError:
            outcomes.add('error')
    assert outcomes == {'image', 'error'}


ROWS, COLUMNS = 5, 7
PIXELS = np.random.default_rng(11).integers(0, 256, (ROWS, COLUMNS, 4), np.uint8)
"""RGBA"""
DEPTH = np.random.default_rng(12).integers(0, 65536, (ROWS, COLUMNS), np.uint16)


def png(pixels: Any = PIXELS) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, 'PNG')
    return file.getvalue()


def compressed_png(ros: Any, data: bytes, format_name: str = 'png', **changes: Any) -> Any:
    return ros.encode(COMPRESSED, ros.cdr(COMPRESSED, format=format_name, data=np.frombuffer(data, np.uint8)), **changes)


def raw_pixels(ros: Any, pixels: Any, encoding: str, *, padding: int = 0, bigendian: bool = False, **changes: Any) -> Any:
    """The object of an Image of these pixels, with ``padding`` bytes at the end of each row."""
    rows = np.ascontiguousarray(pixels).reshape(ROWS, -1).view(np.uint8)
    rows = np.hstack((rows, np.full((ROWS, padding), 0xEE, np.uint8)))
    fields = {
        'height': ROWS,
        'width': COLUMNS,
        'step': rows.shape[1],
        'data': rows.reshape(-1),
        'is_bigendian': int(bigendian),
    }
    return ros.encode(IMAGE, ros.cdr(IMAGE, encoding=encoding, **fields), **changes).object


def pixels_of(made: Any) -> Any:
    return np.asarray(Image.open(io.BytesIO(made.body)))


@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
@pytest.mark.parametrize('pixels', [PIXELS, PIXELS[:, :, :3], PIXELS[:, :, 0], DEPTH], ids=['rgba', 'rgb', 'gray', '16 bit'])
def test_a_png_passes_through(ros: Any, format_name: str, pixels: Any) -> None:
    """The object is the published PNG byte for byte, under its own extension and content type, and knows its size."""
    data = png(np.ascontiguousarray(pixels))
    made = compressed_png(ros, data, format=format_name).object
    assert made.body == data
    assert (made.key, made.content_type) == ('thor/camera/20251018/120000_front.png', 'image/png')
    assert (made.metadata['width'], made.metadata['height']) == ('7', '5')


def test_a_jpeg_is_not_converted_to_png(ros: Any) -> None:
    """What was published with loss stays as it was published."""
    file = io.BytesIO()
    Image.fromarray(PIXELS[:, :, :3]).save(file, 'JPEG')
    made = compressed_png(ros, file.getvalue(), 'jpeg', format='png').object
    assert made.body == file.getvalue()
    assert made.key.endswith('_front.jpg')


def test_a_png_truncated_in_its_headers_is_malformed(ros: Any) -> None:
    """A PNG that ends before its first byte of image data is malformed at every length, and kept at every greater one."""
    data = png()
    start = data.index(b'IDAT') + 4
    reasons = {length: compressed_png(ros, data[:length]).rejected for length in range(8, len(data))}
    assert all(reasons[length] == {'malformed': 1} for length in range(8, start + 1))
    assert all(not reasons[length] for length in range(start + 1, len(data)))


@pytest.mark.parametrize('changes', [{16: 0x80}, {12: 0x4A}, {11: 12}, {16: 0, 17: 0, 18: 0, 19: 0}], ids=str)
def test_a_png_with_a_false_header_is_malformed(ros: Any, changes: dict[int, int]) -> None:
    """Impossible sizes and a first chunk that is not the header are malformed."""
    data = bytearray(png())
    for at, value in changes.items():
        data[at] = value
    assert compressed_png(ros, bytes(data)).rejected == {'malformed': 1}


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize(('encoding', 'order'), [('rgb8', [0, 1, 2]), ('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 3]),
                                                 ('bgra8', [2, 1, 0, 3]), ('mono8', [0])])  # fmt: skip
def test_format_png_keeps_every_bit(ros: Any, encoding: str, order: list[int], padding: int) -> None:
    """With format png, every 8-bit image reads back unchanged, alpha included, for any channel order and padding."""
    made = raw_pixels(ros, PIXELS[:, :, order], encoding, padding=padding, format='png')
    wanted = PIXELS[:, :, sorted(order)]
    np.testing.assert_array_equal(pixels_of(made), wanted[:, :, 0] if encoding == 'mono8' else wanted)
    assert (made.key, made.content_type) == ('thor/camera/20251018/120000_front.png', 'image/png')
    assert made.metadata['encoding'] == encoding


@pytest.mark.parametrize('padding', [0, 2])
@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16'])
@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
def test_format_png_keeps_sixteen_bits(ros: Any, format_name: str, encoding: str, bigendian: bool, padding: int) -> None:
    """16-bit images are 16-bit PNGs, with both formats, and every value is as it was published."""
    data = DEPTH.astype('>u2' if bigendian else '<u2')
    made = raw_pixels(ros, data, encoding, padding=padding, bigendian=bigendian, format=format_name)
    np.testing.assert_array_equal(pixels_of(made), DEPTH)
    assert (made.key[-4:], made.content_type, made.metadata['encoding']) == ('.png', 'image/png', encoding)


@pytest.mark.parametrize('padding', [0, 4])
@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('format_name', ['jpeg', 'png'])
def test_float_images_become_tiffs_without_loss(ros: Any, format_name: str, bigendian: bool, padding: int) -> None:
    """float32 images are TIFFs with both formats, and every bit is preserved, also in NaN and infinities."""
    meters = np.random.default_rng(13).normal(size=(ROWS, COLUMNS)).astype(np.float32)
    meters[0, :4] = np.nan, np.inf, -np.inf, -0.0
    meters[1, 0] = np.frombuffer(b'\1\2\xc0\x7f', np.float32)[0]  # a NaN with something in it
    data = meters.astype('>f4' if bigendian else '<f4')
    made = raw_pixels(ros, data, '32FC1', padding=padding, bigendian=bigendian, format=format_name)
    assert pixels_of(made).tobytes() == meters.tobytes()
    assert (made.key, made.content_type) == ('thor/camera/20251018/120000_front.tiff', 'image/tiff')


@pytest.mark.parametrize('format_name', ['16UC1; compressedDepth png', '16UC1; compressedDepth', '32FC1; compressedDepth png'])
def test_the_png_of_compressed_depth_is_stored(ros: Any, format_name: str) -> None:
    """The PNG behind the header of compressedDepth is the object; what the header says is in the metadata."""
    data = png(DEPTH)
    made = compressed_png(ros, struct.pack('<iff', 0, 10100.0, -100.5) + data, format_name).object
    assert made.body == data
    assert made.key.endswith('_front.png')
    assert made.metadata.items() >= {'encoding': format_name[:5], 'depth_quant_a': '10100.0', 'depth_quant_b': '-100.5'}.items()


@pytest.mark.parametrize(('format_name', 'data', 'reason'), [
    ('16UC1; compressedDepth png', b'', 'empty'), ('16UC1; compressedDepth png', bytes(12), 'malformed'),
    ('16UC1; compressedDepth', bytes(400), 'malformed'), ('16UC1; compressedDepth png', bytes(12) + png()[:30], 'malformed'),
])  # fmt: skip
def test_broken_compressed_depth_is_stored_as_serialized(ros: Any, format_name: str, data: bytes, reason: str) -> None:
    """What has no PNG although it says so is rejected."""
    encoding = compressed_png(ros, data, format_name)
    assert encoding.object is None
    assert encoding.rejected == {reason: 1}


def test_pillow_is_loaded_late() -> None:
    """A robot without depth images does not pay for the library that writes them."""
    program = 'import sys, shadowhound_data_logger.formats; print("PIL" in sys.modules)'
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.strip() == 'False'
