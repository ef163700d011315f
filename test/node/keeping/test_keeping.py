"""Objects kept on the robot, and their previews, which are sent immediately."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image
from spool.making import NOON_NS, make

from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar, pack_zip
from shadowhound_data_logger.node.keeping.keeping import DECODED_SIZE, PREVIEW_BYTES, PREVIEW_SIZE, Keeping, keeps_bag

PARAMETERS = {'camera.ship': 'on_request', 'keep.missions': ['inspection'], 'bag.ship': 'on_request'}


def keeping(**parameters: Any) -> Keeping:
    settings = Settings.load({**PARAMETERS, **parameters}, {})
    return Keeping(settings.keep, {sensor.name: sensor for sensor in settings.sensors}, 'thor')


def picture(kind: str = 'JPEG', mode: str = 'RGB') -> bytes:
    """Noise, which no file format can compress."""
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    out = BytesIO()
    Image.fromarray(noise).convert(mode).save(out, kind)
    return out.getvalue()


def frame(body: bytes, content_type: str = 'image/jpeg', after_s: float = 0.0, **fields: Any) -> DataObject:
    stamp_ns = NOON_NS + round(after_s * SECOND)
    return make(body=body, content_type=content_type, t_start_ns=stamp_ns, t_end_ns=stamp_ns,
                metadata={meta.ROBOT: 'thor', meta.POSE: '1 2 0 odom'}, **fields)  # fmt: skip


@pytest.mark.parametrize(('body', 'content_type'), [
    (picture(), 'image/jpeg'), (picture('PNG'), 'image/png'), (picture('JPEG', 'L'), 'image/jpeg'),
    (pack_zip([ArchiveFile('1.json', NOON_NS, b'{}'), ArchiveFile('1.jpg', NOON_NS, picture())]), 'application/zip'),
    (pack_tar([ArchiveFile('1.jpg', NOON_NS, picture()), ArchiveFile('1.json', NOON_NS, b'{}')]), 'application/x-tar'),
])  # fmt: skip
def test_a_preview_is_small_and_names_its_original(body: bytes, content_type: str) -> None:
    """A JPEG of at most 5 KB, with the position of the image; it is housekeeping, and is not kept on the robot."""
    keeper = keeping()
    kept = keeper.mark(frame(body, content_type))
    found = keeper.preview(kept)
    assert found
    assert isinstance(found.body, bytes)
    assert len(found.body) <= PREVIEW_BYTES
    assert max(DECODED_SIZE) <= max(Image.open(BytesIO(found.body)).size) <= max(PREVIEW_SIZE)
    assert (found.key, found.sensor) == ('thor/_previews/camera/20251018/120000_front.jpg', 'camera_previews')
    assert (found.topic, found.samples, found.is_on_request) == (None, 0, False)
    assert found.metadata == {meta.ROBOT: 'thor', meta.POSE: '1 2 0 odom', meta.PREVIEW_OF: kept.key}


def test_one_preview_is_kept_per_second() -> None:
    """The first of each second; none if previews are disabled, or for objects that are sent anyway."""
    keeper, body = keeping(), picture()
    made = [keeper.preview(keeper.mark(frame(body, after_s=number / 5))) for number in range(10)]
    assert [one is not None for one in made] == [True, *[False] * 4, True, *[False] * 4]
    off = keeping(**{'keep.preview_s': 0.0})
    assert off.preview(off.mark(frame(body))) is None
    always = keeping(**{'camera.ship': 'always'})
    item = frame(body)
    assert always.mark(item) is item
    assert always.preview(item) is None


@pytest.mark.parametrize('make_body', [
    lambda: b'not a picture', lambda: picture()[:100], lambda: pack_zip([ArchiveFile('1.jpg', NOON_NS, picture())])[:-40],
    lambda: picture('TIFF', 'F'),
], ids=['no picture', 'cut off', 'cut archive', 'depth'])  # fmt: skip
@pytest.mark.parametrize('content_type', ['image/jpeg', 'application/zip', 'application/x-tar'])
def test_an_object_without_an_image_has_no_preview(make_body: Callable[[], bytes], content_type: str) -> None:
    """And is kept anyway."""
    keeper = keeping()
    kept = keeper.mark(frame(make_body(), content_type))
    assert kept.is_on_request
    assert keeper.preview(kept) is None


def test_missions_of_named_types_and_events_are_sent(tmp_path: Any) -> None:
    """Regardless of their sensors' and bags' settings."""
    keeper = keeping()
    inspection, patrol = (make(metadata={meta.MISSION_TYPE: name}) for name in ('inspection', 'patrol'))
    assert not keeper.mark(inspection).is_on_request
    assert keeper.mark(patrol).is_on_request
    settings = Settings.load(PARAMETERS, {})
    bags = {name: BagState.begin(tmp_path / name, 'thor', MissionOf(name, 'id', None)) for name in ('inspection', 'patrol')}
    assert {name: keeps_bag(settings.bag, settings.keep, state) for name, state in bags.items()} == {
        'inspection': False, 'patrol': True,
    }  # fmt: skip
