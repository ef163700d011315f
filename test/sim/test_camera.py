"""Frames are drawn from the same building and the same pose as everything else."""

from __future__ import annotations

import math

import numpy as np
import pytest
import simplejpeg
from shadowhound_sim import camera, glyphs
from shadowhound_sim.camera import Camera
from shadowhound_sim.world import World


@pytest.fixture(scope='module')
def front() -> Camera:
    return Camera(World.of(1))


def _frame(front: Camera, t: float, caption: str = '') -> np.ndarray:
    image = np.zeros((camera.HEIGHT, camera.WIDTH, 3), np.uint8)
    front.draw(t, caption, image)
    return image


@pytest.mark.long('every pixel')
def test_every_pixel_is_redrawn(front: Camera) -> None:
    """A frame depends only on the time: nothing of the frame before is visible."""
    first = {t: _frame(front, t) for t in np.arange(0, 60, 5.9)}
    for t in reversed(list(first)):
        assert np.array_equal(_frame(front, t), first[t])


@pytest.mark.long('every pixel')
def test_no_two_frames_are_alike(front: Camera) -> None:
    """The number in the caption distinguishes frames even if the view is the same."""
    assert not np.array_equal(_frame(front, 3.0, '#000001'), _frame(front, 3.0, '#000002'))
    assert not np.array_equal(_frame(front, 3.0), _frame(front, 3.0333))


def test_walls_are_where_the_pinhole_model_puts_them(front: Camera) -> None:
    """The foot of the wall ahead is seen at horizon + focal length * camera height / depth, to the row."""
    checked = 0
    for t in np.arange(0.5, 59, 1.3):
        view = front._view(front.world.pose(float(t)))
        middle = camera.WIDTH // 2
        depth = float(view.wall[middle])
        nearer = view.hits.near[:, middle - 2 : middle + 2].min()
        if nearer < depth or not 1.0 < depth < 3.0:
            continue  # something stands before the wall
        foot = view.horizon + camera.FOCAL * view.z / depth
        column = _frame(front, float(t))[:, middle].astype(int).sum(axis=1)
        skirting, floor = column[math.floor(foot) - 3], column[math.ceil(foot) + 3]
        assert abs(skirting - floor) > 15, (t, foot)
        checked += 1
    assert checked >= 5


@pytest.mark.long('every pixel')
def test_rooms_look_different(front: Camera) -> None:
    """Mean colors of frames from different rooms differ clearly, so that a frame shows where it was taken."""
    means: dict[str, list[np.ndarray]] = {}
    for t in np.arange(0, 59, 1.5):
        means.setdefault(front.world.room(float(t)), []).append(_frame(front, float(t)).reshape(-1, 3).mean(axis=0))
    centers = [np.mean(values, axis=0) for values in means.values()]
    apart = [np.linalg.norm(a - b) for i, a in enumerate(centers) for b in centers[:i]]
    assert min(apart) > 8


def test_a_frame_compresses_to_the_size_of_a_real_one(front: Camera) -> None:
    """Quality 80 gives 15 to 70 KB, and decoding returns the frame."""
    for t in np.arange(0, 60, 7.1):
        image = _frame(front, float(t), 'CAPTION')
        data = simplejpeg.encode_jpeg(image, 80, 'BGR', '420')
        assert 15_000 < len(data) < 70_000
        decoded = simplejpeg.decode_jpeg(data, 'BGR').astype(int)
        assert np.abs(decoded - image).mean() < 6


def test_the_pixels_are_packed_blue_green_red() -> None:
    """Four packed pixels become twelve bytes in the order of bgr8."""
    out = np.zeros((1, 4, 3), np.uint8)
    camera._unpack(np.array([[0x00112233, 0x00445566, 0x00778899, 0x00AABBCC]], np.uint32), out)
    assert out.tobytes().hex() == '332211665544998877ccbbaa'


def test_text_is_cut_at_the_edge_and_unknown_characters_are_blank() -> None:
    """A caption that is too long is cut, and no character raises."""
    image = np.zeros((20, 50, 3), np.uint8)
    glyphs.write(image, 'A\u00e9' * 100, 4, 2, (1, 2, 3))
    assert image[2 : 2 + glyphs.HEIGHT, 4 : 4 + glyphs.ADVANCE].any()
    assert not image[2 : 2 + glyphs.HEIGHT, 4 + glyphs.ADVANCE : 4 + 2 * glyphs.ADVANCE].any()
    glyphs.write(image, 'A', 60, 2, (1, 2, 3))
