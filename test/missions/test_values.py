"""Frames and numbers as agents have them: bytes, arrays of pixels, arrays of one element."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from missions.fakes import journal, journalling
from PIL import Image

from shadowhound_data_logger.missions.folder import missions

RED = np.zeros((48, 64, 3), np.uint8)
RED[..., 0] = 255
JPEG = simplejpeg.encode_jpeg(RED, colorspace='RGB')
MAGIC = np.full((48, 64), 200, np.uint8)
MAGIC[0, :3] = 0xFF, 0xD8, 0xFF


def frame_of(home: Path, value: Any) -> bytes:
    """The file of the one frame that is logged."""
    with journalling(home) as logger:
        logger.start_mission('patrol', '')
        logger.log_camera_frame(value, 3)
        (record,) = [record for record in journal(home) if record['k'] in {'frame', 'refused'}]
        assert record['k'] == 'frame'
        (folder,) = missions(home)
        return (folder.files / record['file']).read_bytes()


@pytest.mark.parametrize('value', [
    JPEG, bytearray(JPEG), memoryview(JPEG), np.frombuffer(JPEG, np.uint8), np.frombuffer(JPEG, np.uint8)[:, None],
], ids=['bytes', 'bytearray', 'memoryview', 'array', 'column'])  # fmt: skip
def test_a_jpeg_is_stored_unchanged(tmp_path: Path, value: Any) -> None:
    """From any type that holds its bytes; OpenCV's encoder returns an array."""
    assert frame_of(tmp_path, value) == JPEG


@pytest.mark.parametrize('value', [
    RED, np.dstack([RED, np.full((48, 64), 7, np.uint8)]), RED[:, ::-1], np.asfortranarray(RED), Image.fromarray(RED),
    np.zeros((96, 64, 3), np.uint8)[::2] + RED,
], ids=['rgb', 'rgba', 'mirrored', 'columns first', 'pillow', 'strided'])  # fmt: skip
def test_pixels_are_red_green_and_blue(tmp_path: Path, value: Any) -> None:
    """A red image is a red JPEG of the same size."""
    pixels = simplejpeg.decode_jpeg(frame_of(tmp_path, value), 'RGB')
    assert pixels.shape == RED.shape
    assert np.abs(pixels.astype(int) - RED).max() < 4


@pytest.mark.parametrize('value', [MAGIC, MAGIC[..., None]])
def test_gray_pixels_that_begin_as_a_jpeg_does_are_pixels(tmp_path: Path, value: Any) -> None:
    """An image that starts with the two bytes of a JPEG is still encoded."""
    pixels = simplejpeg.decode_jpeg(frame_of(tmp_path, value), 'GRAY')
    assert pixels.shape == (48, 64, 1)
    assert abs(float(pixels.mean()) - 200) < 2


@pytest.mark.parametrize(('value', 'remedy'), [
    (np.zeros((48, 64, 3)), 'scale it'), (np.zeros((48, 64), np.uint16), 'scale it'), (np.zeros((3, 48, 64), np.uint8), 'height'),
    (np.zeros((48, 64, 2), np.uint8), 'height'), (np.zeros((2, 48, 64, 3), np.uint8), 'height'), (np.uint8(3), 'height'),
    (np.zeros((0, 64, 3), np.uint8), 'height'), (np.zeros((70_000, 1, 3), np.uint8), '65500'), (RED.tobytes(), 'encode it'),
    (b'\x89PNG\r\n\x1a\n', 'encode it'), (b'', 'encode it'), (memoryview(b'\xff'), 'encode it'), ('a.jpg', 'encode it'),
    (None, 'encode it'), (3, 'encode it'), ([[1, 2]], 'encode it'), (np.frombuffer(b'\x89PNG', np.uint8), 'height'),
])  # fmt: skip
def test_data_that_is_not_an_image_is_refused_at_the_call(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, value: Any, remedy: str
) -> None:
    """It is counted by reason, and the warning has the remedy."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_camera_frame(value, 3)
        assert not list(next(missions(tmp_path)).files.glob('*.jpg')) or 'file' not in journal(tmp_path)[-1]
    assert [(record['k'], record.get('reason')) for record in journal(tmp_path)][1:-1] == [('refused', 'no_image')]
    assert remedy in caplog.text


@pytest.mark.parametrize('value', [
    np.array([2.5]), np.array([[2.5]]), np.array(2.5), np.float32(2.5), np.float64(2.5), np.array([2.5], np.float16), 2.5,
])  # fmt: skip
def test_one_element_is_a_number(tmp_path: Path, value: Any) -> None:
    """Of any shape and precision, as a value; an integer as a step."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_metric('a', value, np.array([3]))  # type: ignore[arg-type]
        logger.log_robot_state(value, value, np.int64(4))  # type: ignore[arg-type]
        logger.end_mission(np.array([True]), value, value)  # type: ignore[arg-type]
    _, metric, state, end = journal(tmp_path)
    assert (metric['m'], metric['s']) == ({'a': 2.5}, 3)
    assert (state['m'], state['s']) == ({'battery_pct': 2.5, 'temperature_c': 2.5}, 4)
    assert (end['success'], end['distance_m'], end['duration_s']) == (True, 2.5, 2.5)


@pytest.mark.parametrize('value', [
    np.array([1.0, 2.0]), np.array([]), np.array(['2.5']), np.array([1j]), np.datetime64('2025-10-18'), np.timedelta64(1, 's'),
    np.array([None]), np.array([np.nan]), np.array([b'2']),
])  # fmt: skip
def test_an_array_that_is_not_a_number_is_refused(tmp_path: Path, value: Any) -> None:
    """More or fewer elements, texts, times and complex numbers."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_metric('a', value)
    assert [record['k'] for record in journal(tmp_path)] == ['start', 'refused', 'end']
