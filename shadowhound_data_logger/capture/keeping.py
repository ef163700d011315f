"""Which of the node's objects stay on the robot until somebody asks for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.config import BagSettings, KeepSettings, SensorSettings
from shadowhound_data_logger.missions.folder import safe_type
from shadowhound_data_logger.model import DataObject
from shadowhound_data_logger.options import ON_REQUEST


class Keeping:
    """Marks what is uploaded on request.

    New; ``mark`` from any thread, after the mission's marks.
    """

    def __init__(self, settings: KeepSettings, sensors: Mapping[str, SensorSettings]) -> None:
        """``sensors`` are the settings in force."""
        self._always = always_shipped(settings)
        self._sensors = sensors

    def mark(self, item: DataObject) -> DataObject:
        """The object, with the mark if it stays here."""
        sensor = self._sensors.get(item.sensor)
        if sensor is None or sensor.ship != ON_REQUEST or item.metadata.get(words.MISSION_TYPE) in self._always:
            return item
        return replace(item, metadata={**item.metadata, words.SHIP: words.ON_REQUEST})


def keeps_bag(settings: BagSettings, keep: KeepSettings, state: BagState) -> bool:
    """Whether the slices of a bag stay on the robot until somebody asks for them; those of events never do."""
    mission = state.mission
    return settings.ship == ON_REQUEST and (mission is None or safe_type(mission.type) not in always_shipped(keep))


def always_shipped(settings: KeepSettings) -> frozenset[str]:
    """Types of missions of which nothing stays on the robot, as they stand in metadata."""
    return frozenset(safe_type(name) for name in settings.missions if name)
