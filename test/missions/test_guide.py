"""The code of the integration guide, as it stands there, against this package and a real MLflow server."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest
from missions.agent import jpeg
from missions.server import Server, complete, until

from shadowhound_data_logger import MissionDataLogger

pytestmark = pytest.mark.seaweedfs

EXECUTOR: Final = """
class MissionExecutor:
    def __init__(self, config, logger=None):
        # ...existing init...
        self.data_logger = MissionDataLogger()  # New

    def execute_mission(self, command: str):
        # Start logging
        mission_type = self._infer_mission_type(command)  # "patrol", "explore", etc.
        run_id = self.data_logger.start_mission(mission_type, command)

        try:
            # Execute mission (existing code)
            result = self.agent.prompt(command, ...)

            # Log mission data
            if self._latest_camera_frame is not None:
                self.data_logger.log_camera_frame(
                    self._encode_frame_as_jpeg(self._latest_camera_frame),
                    frame_id=0
                )

            # Log robot state (if available)
            robot_state = self.robot.get_state()  # From DIMOS
            self.data_logger.log_robot_state(
                battery_pct=robot_state.battery_percentage,
                temperature_c=robot_state.temperature,
                step=0
            )

            # Log trajectory (if mission involved navigation)
            if mission_type in ["patrol", "explore"]:
                trajectory_path = "/tmp/trajectory.csv"
                self._save_trajectory_csv(trajectory_path)
                self.data_logger.log_trajectory(trajectory_path)

            # Calculate metrics
            distance_m = self._calculate_distance_traveled()
            duration_s = self._calculate_mission_duration()

            # End logging
            self.data_logger.end_mission(
                success=True,
                distance_m=distance_m,
                duration_s=duration_s
            )

            return result, timing

        except Exception as e:
            self.data_logger.end_mission(success=False, distance_m=0, duration_s=0)
            raise
"""
QUERY: Final = """
import mlflow

mlflow.set_tracking_uri("http://TOWER_IP:5001")

# Get all patrol missions
client = mlflow.tracking.MlflowClient()
experiment = client.get_experiment_by_name("thor_missions")

runs = client.search_runs(
    experiment_ids=[experiment.experiment_id],
    filter_string="params.mission_type = 'patrol'"
)

for run in runs:
    print(f"Run ID: {run.info.run_id}")
    print(f"  Command: {run.data.params['mission_command']}")
    print(f"  Distance: {run.data.metrics['distance_traveled_m']} m")
    print(f"  Success: {run.data.metrics['success']}")
"""


def executor(command_fails: bool) -> Any:
    """The guide's class, with what it leaves to the existing code of the agent."""
    names: dict[str, Any] = {'MissionDataLogger': MissionDataLogger, 'timing': {}}
    exec(EXECUTOR, names)  # noqa: S102 - the guide's text is what is tested

    def prompt(command: str, _: object) -> str:
        if command_fails:
            raise RuntimeError('the robot fell over')
        return f'done: {command}'

    class Existing(names['MissionExecutor']):  # type: ignore[misc]
        agent = SimpleNamespace(prompt=prompt)
        robot = SimpleNamespace(get_state=lambda: SimpleNamespace(battery_percentage=87, temperature=41.5))
        _latest_camera_frame = jpeg(0)

        def _infer_mission_type(self, command: str) -> str:
            return command.split(maxsplit=1)[0]

        def _encode_frame_as_jpeg(self, frame: bytes) -> bytes:
            return frame

        def _save_trajectory_csv(self, path: str) -> None:
            Path(path).write_text('timestamp,x,y,yaw\n1.0,0.0,0.0,0.0\n2.0,1.0,0.0,0.0\n')

        def _calculate_distance_traveled(self) -> float:
            return 12.5

        def _calculate_mission_duration(self) -> float:
            return 60.0

    return Existing(config={})


@pytest.mark.long('a second of CPU or more')
def test_the_guide_s_executor_and_query(
    server: Server, warm_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its MissionExecutor logs a mission that succeeds and one that fails, and its query finds and prints both."""
    import mlflow  # takes a second, which those who only collect do not need

    monkeypatch.setenv('SHADOWHOUND_HOME', str(warm_home))
    good, bad = executor(command_fails=False), executor(command_fails=True)
    assert good.execute_mission('patrol by the guide') == ('done: patrol by the guide', {})
    with pytest.raises(RuntimeError, match='fell over'):
        bad.execute_mission('patrol into the pond')
    for each in (good, bad):
        each.data_logger.close()
    until(lambda: complete(warm_home, 2), 'both are sent')
    try:
        exec(QUERY.replace('http://TOWER_IP:5001', server.tower.tracking_uri), {})  # noqa: S102
    finally:
        mlflow.set_tracking_uri('')
    said = capsys.readouterr().out
    for command, distance, success in (('patrol by the guide', 12.5, 1.0), ('patrol into the pond', 0.0, 0.0)):
        run_id = server.run(command).info.run_id
        assert f'Run ID: {run_id}\n  Command: {command}\n  Distance: {distance} m\n  Success: {success}\n' in said
    run_id = server.run('patrol by the guide').info.run_id
    assert {'camera/frame_000000.jpg', 'trajectories/trajectory.csv', 'trajectory.png'} <= server.artifacts(run_id)


@pytest.mark.long('a program of many imports that walks for seconds')
def test_the_example(server: Server, warm_home: Path) -> None:
    """examples/mission_executor.py flies a mission of its simulated robot, whole and with all three pictures."""
    example = Path(__file__).parents[2] / 'examples' / 'mission_executor.py'
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(warm_home)}
    command = [sys.executable, str(example), 'patrol the example', '--seconds', '2']
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True, timeout=120)
    assert re.search(r'run [0-9a-f]{32}, \d+ records sent, 0 not yet', done.stdout), done.stdout + done.stderr
    run = server.run('patrol the example')
    assert run.info.status == 'FINISHED'
    assert 0.5 < run.data.metrics['distance_m'] < 2.0
    pictures = {'camera_summary.jpg', 'trajectory.png', 'battery.png'}
    assert pictures <= server.artifacts(run.info.run_id)
