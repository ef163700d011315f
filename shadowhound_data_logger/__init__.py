"""ShadowHound data logger: a robot's data off the robot, whole and trusted."""

from shadowhound_data_logger.missions.mission_data_logger import MissionDataLogger

__all__ = ['MissionDataLogger']
