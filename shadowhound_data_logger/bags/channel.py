"""What a slice says of a recorded topic: all that a reader needs to decode its messages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic with one type.

    ``type`` is the ROS name (``sensor_msgs/msg/Imu``). ``encoding`` says how ``definition`` is written: ``ros2msg`` or
    ``ros2idl``; both are empty where nobody knows the type. ``type_hash`` is ``RIHS01_...``, empty where the distribution
    knows none (Humble). ``qos`` is the YAML that rosbag2 calls offered_qos_profiles, its policies in
    numbers as Humble reads them, empty when it is not known.
    """

    topic: str
    type: str
    encoding: str
    definition: str
    type_hash: str
    qos: str
