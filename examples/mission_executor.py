"""The integration guide's MissionExecutor, working: a mission agent that logs its actions, in plain Python without ROS.

    scripts/with-env python examples/mission_executor.py [--seconds 20] [COMMAND]

No robot is needed: the logged data (pose, battery, temperature, camera) is from the simulated Go2's world in this process. Next
to
``sim_go2_node`` and ``sensor_logger_node`` with the same SHADOWHOUND_HOME, the node joins the mission with its own measurements.
Data
is stored where the environment says (MLFLOW_TRACKING_URI, AWS_ENDPOINT_URL), otherwise below ``~/.shadowhound``. On a robot,
replace
SimulatedRobot by the real one, with the same methods.
"""

from __future__ import annotations

import argparse
import csv
import math
import tempfile
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray
from shadowhound_sim.camera import Camera
from shadowhound_sim.world import World

from shadowhound_data_logger import MissionDataLogger

PERIOD_S: Final = 0.2
FRAME_EVERY: Final = 5
"""Periods between camera frames."""


@dataclass(frozen=True, slots=True)
class RobotState:
    """The state reported by a robot; percent, degrees Celsius, meters, radians."""

    battery_percentage: float
    temperature: float
    x: float
    y: float
    yaw: float


class SimulatedRobot:
    """The simulated Go2 on its patrol, starting now."""

    def __init__(self, seed: int = 1) -> None:
        self._world = World.of(seed)
        self._camera = Camera(self._world)
        self._began_s = time.monotonic()

    def get_state(self) -> RobotState:
        t = time.monotonic() - self._began_s
        power, pose = self._world.power(t), self._world.pose(t)
        return RobotState(power.soc, power.motor_temperature, pose.x, pose.y, pose.yaw)

    def look(self) -> NDArray[np.uint8]:
        """A frame, 640 x 480, BGR."""
        t = time.monotonic() - self._began_s
        frame = np.empty((480, 640, 3), np.uint8)
        self._camera.draw(t, f'{t:.1f} s', frame)
        return frame


class Pose(NamedTuple):
    """A row of the trajectory: seconds since 1970, meters, radians."""

    timestamp: float
    x: float
    y: float
    yaw: float


class MissionExecutor:
    """As in the integration guide: each command is a mission."""

    def __init__(self, robot: SimulatedRobot, seconds: float) -> None:
        self.robot = robot
        self.data_logger = MissionDataLogger()
        self._seconds = seconds
        self._poses: list[Pose] = []

    def execute_mission(self, command: str) -> str:
        """Walk, log, and return the run; an exception ends the mission as FAILED."""
        mission_type = self._infer_mission_type(command)
        run_id = self.data_logger.start_mission(mission_type, command)
        began_s = time.monotonic()
        try:
            self._walk(began_s)
            with tempfile.TemporaryDirectory() as folder:
                trajectory_path = Path(folder) / 'trajectory.csv'
                self._save_trajectory_csv(trajectory_path)
                self.data_logger.log_trajectory(trajectory_path)  # it is copied: the file may be deleted
            self.data_logger.end_mission(
                success=True, distance_m=self._calculate_distance_traveled(), duration_s=time.monotonic() - began_s
            )
        except BaseException:
            self.data_logger.end_mission(success=False, distance_m=0, duration_s=0)
            raise
        return run_id

    def _walk(self, began_s: float) -> None:
        """A real agent would act here; this robot walks on its own, and its state is logged."""
        step = 0
        while time.monotonic() - began_s < self._seconds:
            state = self.robot.get_state()
            self._poses.append(Pose(time.time(), state.x, state.y, state.yaw))
            self.data_logger.log_robot_state(state.battery_percentage, state.temperature, step)
            if step % FRAME_EVERY == 0:
                self.data_logger.log_camera_frame(self._encode_frame_as_jpeg(self.robot.look()), frame_id=step // FRAME_EVERY)
            step += 1
            time.sleep(max(0.0, began_s + step * PERIOD_S - time.monotonic()))

    @staticmethod
    def _infer_mission_type(command: str) -> str:
        return next((word for word in ('patrol', 'explore') if word in command.lower()), 'test')

    @staticmethod
    def _encode_frame_as_jpeg(frame: NDArray[np.uint8]) -> bytes:
        return bytes(simplejpeg.encode_jpeg(frame, quality=85, colorspace='BGR'))

    def _save_trajectory_csv(self, path: Path) -> None:
        with path.open('w', newline='', encoding='utf-8') as file:
            rows: Any = csv.writer(file)
            rows.writerow(Pose._fields)
            rows.writerows(self._poses)

    def _calculate_distance_traveled(self) -> float:
        return sum(math.dist(one[1:3], other[1:3]) for one, other in pairwise(self._poses))


def main() -> None:
    """One mission, then wait until it is sent."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('command', nargs='?', default='patrol the house', metavar='COMMAND')
    parser.add_argument('--seconds', type=float, default=20.0, help='how long the mission takes (default 20)')
    options = parser.parse_args()
    executor = MissionExecutor(SimulatedRobot(), options.seconds)
    run_id = executor.execute_mission(options.command)
    report = executor.data_logger.close(deadline_s=60.0)
    print(f'mission {run_id}: run {report.run_id}, {report.sent} records sent, {report.unsent} not yet')  # noqa: T201
    if report.last_error:
        print(f'  {report.last_error}')  # noqa: T201


if __name__ == '__main__':
    main()
