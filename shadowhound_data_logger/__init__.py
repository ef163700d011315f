"""ShadowHound data logger: a robot's data off the robot, complete and verified."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shadowhound_data_logger.missions.mission_data_logger import MissionDataLogger

__all__ = ['MissionDataLogger']


def __getattr__(name: str) -> Any:
    if name == 'MissionDataLogger':  # imported when used: a command needs none of it
        from shadowhound_data_logger.missions.mission_data_logger import MissionDataLogger  # noqa: PLC0415

        return MissionDataLogger
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
