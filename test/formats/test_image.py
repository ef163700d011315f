"""JPEGs pass through untouched, raw colors become JPEGs that look the same, and contradictory images are rejected by reason."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import simplejpeg

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
def test_passes_through(ros: Any, subsampling: str) -> None:
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


def test_big_endian_cdr(ros: Any) -> None:
    """A JPEG inside big-endian CDR comes out untouched too."""
    cdr = ros.cdr(COMPRESSED, data=np.frombuffer(jpeg(), np.uint8), little_endian=False)
    assert ros.encode(COMPRESSED, cdr).object.body == jpeg()


def test_a_missing_end_and_fill_bytes_are_passed(ros: Any) -> None:
    """Some cameras omit the EOI marker, append bytes or insert fill bytes before a marker: such frames are kept."""
    whole = jpeg()
    for data in (whole[:-2], whole + bytes(7), whole[:2] + b'\xff\xff' + whole[2:], whole[: len(whole) - 100]):
        assert compressed(ros, data).object.body == data


@pytest.mark.parametrize(
    ('data', 'reason'),
    [(b'', 'empty'), (b'\xff\xd8\xff', 'malformed'), (b'\xff\xd8\xff\xe0' + bytes(400), 'malformed')],
    ids=['nothing', 'magic only', 'zeros'],
)  # fmt: skip
def test_what_is_no_image(ros: Any, data: bytes, reason: str) -> None:
    """No data, and a JPEG without its headers, are rejected by reason."""
    encoding = compressed(ros, data)
    assert encoding.object is None
    assert encoding.rejected == {reason: 1}


def test_a_jpeg_cut_in_its_headers(ros: Any) -> None:
    """A JPEG that ends before its first scan byte is malformed at every length, and kept at every greater one."""
    data = jpeg()
    scan = data.index(b'\xff\xda')
    scan += 2 + int.from_bytes(data[scan + 2 : scan + 4], 'big')
    reasons = {length: compressed(ros, data[:length]).rejected for length in range(3, scan + 40)}
    assert all(reasons[length] == {'malformed': 1} for length in range(3, scan + 1))
    assert all(not reasons[length] for length in range(scan + 1, scan + 40))


@pytest.mark.parametrize('padding', [0, 16])
@pytest.mark.parametrize('encoding', ['rgb8', 'bgr8', 'rgba8', 'bgra8'])
def test_colors_and_padding(ros: Any, encoding: str, padding: int) -> None:
    """A raw color image, with or without padding at the end of its rows, decodes to the same picture."""
    picture = gradient()
    order = ['rgba'.index(channel) % 3 for channel in encoding.removesuffix('8')]
    rows = np.hstack((picture[:, :, order].reshape(48, -1), np.full((48, padding), 99, np.uint8)))
    body = raw(ros, rows, encoding=encoding, width=64).object.body
    decoded = simplejpeg.decode_jpeg(body).astype(int)
    assert decoded.shape == (48, 64, 3)
    assert np.abs(decoded - picture).max() <= 12
    assert np.abs(decoded - picture).mean() < 2


def test_gray(ros: Any) -> None:
    """A mono8 image becomes a gray JPEG."""
    gray = gradient()[:, :, 1]
    body = raw(ros, gray, encoding='mono8').object.body
    assert simplejpeg.decode_jpeg_header(body)[2:] == ('Gray', 'Gray')
    assert np.abs(simplejpeg.decode_jpeg(body, 'GRAY')[:, :, 0].astype(int) - gray).max() <= 6


def test_quality(ros: Any) -> None:
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
def test_raw_images_with_false_sizes(ros: Any, lies: dict[str, Any], reason: str) -> None:
    """Inconsistent sizes and images without pixels have different reasons, for every format."""
    for format_name in ('jpeg', 'png'):
        result = raw(ros, gradient().reshape(48, -1), sensor={'format': format_name}, **({'encoding': 'bgr8'} | lies))
        assert result.object is None
        assert result.rejected == {reason: 1}


def test_too_large_for_a_jpeg(ros: Any) -> None:
    """An image with a side that JPEG cannot express is rejected before the encoder sees it."""
    assert raw(ros, np.zeros((1, 65_501), np.uint8), encoding='mono8').rejected == {'too_large': 1}
    assert raw(ros, np.zeros((1, 65_500), np.uint8), encoding='mono8').object is not None


def test_a_jpeg_has_brightness_and_sharpness(ros: Any) -> None:
    """Computed from its gray: an even image has its brightness and no edges; a reader of the object computes the same."""
    board = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((16, 16))) * 255
    told = {}
    for name, gray in (('dark', np.full((96, 128), 20)), ('board', board)):
        picture = np.repeat(gray[:, :, None].astype(np.uint8), 3, axis=2)
        made = compressed(ros, bytes(simplejpeg.encode_jpeg(picture, quality=95))).object
        told[name] = unpack_statistics(made.statistics)
        assert told[name] == statistics_of(made.key, made.body)
        assert (set(told[name]), told[name][ALL].count) == ({ALL, 'brightness', 'sharpness'}, 1)
    assert told['dark']['brightness'].mean == pytest.approx(20, abs=2)
    assert told['board']['brightness'].max == pytest.approx(127, abs=3)
    assert told['dark']['sharpness'].max < 1
    assert told['board']['sharpness'].max > 100
    assert compressed(ros, jpeg(), statistics=('none',)).object.statistics == b''
