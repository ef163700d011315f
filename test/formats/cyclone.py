"""A message as an application of Cyclone DDS without ROS has it (types of the package ``cyclonedds``)."""

from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float64, int32, sequence, uint32


@dataclass
@final
class Time(IdlStruct, typename='builtin_interfaces::msg::dds_::Time_'):
    """A builtin_interfaces/msg/Time."""

    sec: int32
    nanosec: uint32


@dataclass
@final
class Header(IdlStruct, typename='std_msgs::msg::dds_::Header_'):
    """A std_msgs/msg/Header."""

    stamp: Time
    frame_id: str


@dataclass
@final
class JointState(IdlStruct, typename='sensor_msgs::msg::dds_::JointState_'):
    """A sensor_msgs/msg/JointState."""

    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]
