"""Bags: full-rate recordings in rosbag2's format, in slices that are complete files."""

from shadowhound_data_logger.bags.record import Recorded, record_and_upload_rosbag

__all__ = ['Recorded', 'record_and_upload_rosbag']
