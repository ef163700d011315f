"""Which of the node's objects stay on the robot until somebody asks for them, and the previews of them that are sent at once."""

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
"""Of a preview, at most: with one a second 41 kbit/s a camera."""
PREVIEW_SIZE: Final = 192, 192
"""Pixels that a preview fits into."""
DECODED_SIZE: Final = 160, 120
"""A JPEG is decoded at a half, a quarter or an eighth of its size, of which this still is a part: 640 x 480 at a quarter."""
QUALITIES: Final = (60, 40, 20)
PRIORITY: Final = 2
"""Of previews: they are what somebody chooses by."""
_UNREADABLE: Final = (OSError, ValueError, zipfile.BadZipFile, tarfile.TarError, LookupError, NotImplementedError)


class Keeping:
    """Marks what is uploaded on request, and makes previews of it.

    New; ``mark`` and ``preview`` from any thread, after the mission's marks. ``_lock`` guards when previews were made.
    """

    def __init__(self, settings: KeepSettings, sensors: Mapping[str, SensorSettings], robot: str) -> None:
        """``sensors`` are the settings in force."""
        self._always = always_shipped(settings)
        self._period_ns = round(settings.preview_s * SECOND)
        self._sensors = sensors
        self._robot = robot
        self._lock = threading.Lock()
        self._periods: dict[str, int] = {}
        self._told: set[str] = set()

    def mark(self, item: DataObject) -> DataObject:
        """The object, with the mark if it stays here."""
        sensor = self._sensors.get(item.sensor)
        if sensor is None or sensor.ship != ON_REQUEST or item.metadata.get(meta.MISSION_TYPE) in self._always:
            return item
        return replace(item, metadata={**item.metadata, meta.SHIP: meta.ON_REQUEST})

    def preview(self, item: DataObject) -> DataObject | None:
        """A small picture of an object that stays here, the first of each period; None of anything else."""
        if not item.is_on_request or item.held or not isinstance(item.body, bytes) or not self._is_due(item):
            return None
        try:
            body = _small(_picture(item.body, item.content_type))
        except _UNREADABLE as error:
            if item.sensor not in self._told:
                self._told.add(item.sensor)
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
    """Whether the slices of a bag stay on the robot until somebody asks for them; those of events never do."""
    mission = state.mission
    return settings.ship == ON_REQUEST and (mission is None or mission.type not in always_shipped(keep))


def always_shipped(settings: KeepSettings) -> frozenset[str]:
    """Types of missions of which nothing stays on the robot."""
    return frozenset(filter(None, settings.missions))


def _picture(body: bytes, content_type: str) -> bytes | None:
    """The picture that an object is, or the first of an archive; None where it has none."""
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


def _small(picture: bytes | None) -> bytes | None:
    """The picture as a JPEG of at most ``PREVIEW_BYTES``; None for one that has no colors or greys, such as depth."""
    if picture is None:
        return None
    with open_image(picture) as opened:
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
