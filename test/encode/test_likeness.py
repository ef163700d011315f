"""Pictures of the same scene look alike, those of others do not, and only who asks for it pays for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import simplejpeg

from shadowhound_data_logger.encode import registry
from shadowhound_data_logger.encode.image import difference_hash
from shadowhound_data_logger.model import Likeness
from shadowhound_data_logger.options import COMPRESSED_IMAGE as COMPRESSED


def scene(number: int, noise: float = 0.0) -> Any:
    """640 x 480 grey fields, a few pixels of which the sensor got wrong."""
    source = np.random.default_rng(number)
    fields = np.kron(source.uniform(20, 230, (6, 8)), np.ones((80, 80)))
    return fields + np.random.default_rng(99).normal(0, noise, fields.shape)


def jpeg(pixels: Any, quality: int = 85) -> bytes:
    colours = np.repeat(np.clip(pixels, 0, 255).astype(np.uint8)[:, :, None], 3, 2)
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(colours), quality=quality))


def distance(one: bytes, other: bytes) -> int:
    first, second = difference_hash(one), difference_hash(other)
    assert first is not None
    assert second is not None
    return (first ^ second).bit_count()


@pytest.mark.parametrize('quality', [30, 60, 95])
def test_noise_and_compression_change_little(quality: int) -> None:
    """At most the two bits that are worth setting as a limit."""
    assert distance(jpeg(scene(1)), jpeg(scene(1, noise=8.0), quality)) <= 2


def test_other_scenes_are_far_away() -> None:
    """Further than the largest limit that is any good."""
    assert min(distance(jpeg(scene(1)), jpeg(scene(number))) for number in range(2, 12)) > 10


def test_the_bits_are_where_the_brightness_grows() -> None:
    """Of a picture that grows brighter to the right all 64 are set, of its mirror image none."""
    ramp = np.tile(np.linspace(0, 255, 640), (480, 1))
    assert difference_hash(jpeg(ramp)) == (1 << 64) - 1
    assert difference_hash(jpeg(ramp[:, ::-1])) == 0


@pytest.mark.parametrize('body', [
    b'', b'no picture', jpeg(np.zeros((7, 640))), jpeg(np.zeros((480, 8))), jpeg(np.zeros((480, 640))),
    jpeg(np.full((480, 640), 255.0)),
])  # fmt: skip
def test_what_cannot_be_told_is_none(body: bytes) -> None:
    """No picture, too few pixels, or nothing in it: a lens that is covered must not look like one that is dazzled."""
    assert difference_hash(body) is None


@pytest.mark.parametrize(('given', 'is_asked'), [
    ({'dedup': True, 'dedup_distance': 3}, True), ({'dedup': True}, False), ({'dedup_distance': 3}, False),
])  # fmt: skip
def test_only_who_asks_for_it_pays(ros: Any, monkeypatch: pytest.MonkeyPatch, given: dict[str, Any], is_asked: bool) -> None:
    """An object has its likeness with both settings; without them nothing is decoded."""
    if not is_asked:
        monkeypatch.setattr(registry, 'difference_hash', None)
    body = jpeg(scene(1))
    cdr = ros.cdr(COMPRESSED, format='jpeg', data=np.frombuffer(body, np.uint8))
    made = ros.encode(COMPRESSED, cdr, **given).object
    assert made.likeness == (Likeness(difference_hash(body) or 0, 3) if is_asked else None)
