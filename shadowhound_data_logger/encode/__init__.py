"""From samples to finished objects: one registry of formats, one file a format. Needs no ROS: definitions come as text."""

from shadowhound_data_logger.encode.registry import Encoding, encode
from shadowhound_data_logger.encode.types import MessageTypes, header_stamp_ns

__all__ = ['Encoding', 'MessageTypes', 'encode', 'header_stamp_ns']
