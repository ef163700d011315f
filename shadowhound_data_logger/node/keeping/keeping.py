"""Decides which objects stay on the robot until requested, and creates their previews, which are uploaded immediately."""

from __future__ import annotations

import logging
import tarfile
import threading
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from typing import Final

from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import BagSettings, KeepSettings, SensorSettings
from shadowhound_data_logger.core.model import PREVIEWS, DataObject
from shadowhound_data_logger.core.options import ON_REQUEST
from shadowhound_data_logger.core.untrusted import open_image

log = logging.getLogger(__name__)

PREVIEW_BYTES: Final = 5 << 10
"""Maximum size of a preview: one per second is 41 kbit/s per camera."""
PREVIEW_SIZE: Final = 192, 192
"""Maximum size of a preview in pixels."""
DECODED_SIZE: Final = 160, 120
"""A JPEG is decoded at 1/2, 1/4 or 1/8 of its size, not below this: 640 x 480 at 1/4."""
QUALITIES: Final = (60, 40, 20)
PRIORITY: Final = 2
"""Priority of previews: they are what users choose by."""
_UNREADABLE: Final = (OSError, ValueError, zipfile.BadZipFile, tarfile.TarError, LookupError, NotImplementedError)


class Keeping:
    """Marks objects to be uploaded on request, and creates their previews.

    New; ``mark`` and ``preview`` from any thread, after the mission's marks. ``_lock`` guards the times of previews.
    """

    def __init__(self, settings: KeepSettings, sensors: Mapping[str, SensorSettings], robot: str) -> None:
        """``sensors`` are the current settings."""
        self._always = always_shipped(settings)
        self._period_ns = round(settings.preview_s * SECOND)
        self._sensors = sensors
        self._robot = robot
        self._lock = threading.Lock()
        self._periods: dict[str, int] = {}
        self._logged: set[str] = set()

    def mark(self, item: DataObject) -> DataObject:
        """The object, marked if it is kept."""
        sensor = self._sensors.get(item.sensor)
        if sensor is None or sensor.ship != ON_REQUEST or item.metadata.get(meta.MISSION_TYPE) in self._always:
            return item
        return replace(item, metadata={**item.metadata, meta.SHIP: meta.ON_REQUEST})

    def preview(self, item: DataObject) -> DataObject | None:
        """A preview of a kept object, for the first of each period; otherwise None."""
        if not item.is_on_request or item.held or not isinstance(item.body, bytes) or not self._is_due(item):
            return None
        try:
            body = _preview_jpeg(_image_in(item.body, item.content_type))
        except _UNREADABLE as error:
            if item.sensor not in self._logged:
                self._logged.add(item.sensor)
                log.warning('there are no previews of %s: %s', item.sensor, error)
            return None
        if body is None:
            return None
        key = item.key.removeprefix(f'{self._robot}/').rpartition('.')[0]
        left_out = {meta.SHIP, meta.COUNT, meta.TOPIC, meta.TYPE, meta.SENSOR, 'width', 'height', 'encoding'}
        metadata = {name: value for name, value in item.metadata.items() if name not in left_out}
        return replace(
            item, bucket=item.bucket, key=f'{self._robot}/{PREVIEWS}/{key}.jpg', body=body, content_type='image/jpeg',
            sensor=f'{item.sensor}{PREVIEWS}', topic=None, type='', samples=0, priority=PRIORITY, dedup=False, key_pattern=None,
            metadata={**metadata, meta.PREVIEW_OF: item.key},
        )  # fmt: skip

    def _is_due(self, item: DataObject) -> bool:
        if not self._period_ns:
            return False
        period = item.t_start_ns // self._period_ns
        with self._lock:
            if self._periods.get(item.sensor) == period:
                return False
            self._periods[item.sensor] = period
            return True


def keeps_bag(settings: BagSettings, keep: KeepSettings, state: BagState) -> bool:
    """Whether the slices of a bag are kept until requested; those of events never are."""
    mission = state.mission
    return settings.ship == ON_REQUEST and (mission is None or mission.type not in always_shipped(keep))


def always_shipped(settings: KeepSettings) -> frozenset[str]:
    """Types of missions whose data is never kept back."""
    return frozenset(filter(None, settings.missions))


def _image_in(body: bytes, content_type: str) -> bytes | None:
    """The image in an object, or the first image of an archive; None if there is none."""
    if content_type in {'image/jpeg', 'image/png'}:
        return body
    if content_type == 'application/zip':
        with zipfile.ZipFile(BytesIO(body)) as archive:
            name = next((name for name in archive.namelist() if name.endswith(('.jpg', '.png'))), None)
            return archive.read(name) if name else None
    if content_type == 'application/x-tar':
        with tarfile.open(fileobj=BytesIO(body), mode='r:') as files:
            member = next((member for member in files if member.name.endswith(('.jpg', '.png'))), None)
            file = files.extractfile(member) if member else None
            return file.read() if file else None
    return None


def _preview_jpeg(image: bytes | None) -> bytes | None:
    """The image as a JPEG of at most ``PREVIEW_BYTES``; None if it has neither color nor gray, such as depth."""
    if image is None:
        return None
    with open_image(image) as opened:
        if opened.mode not in {'RGB', 'L', 'RGBA', 'P'}:
            return None
        opened.draft('RGB', DECODED_SIZE)
        small = opened.convert('RGB')
    small.thumbnail(PREVIEW_SIZE)
    for quality in QUALITIES:
        out = BytesIO()
        small.save(out, 'JPEG', quality=quality)
        if out.tell() <= PREVIEW_BYTES:
            return out.getvalue()
    return None
