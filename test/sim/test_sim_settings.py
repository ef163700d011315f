"""The simulated Go2's parameters, and the loop that publishes what is due."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy')

from shadowhound_sim.sim_go2_node import SimSettings, run

from shadowhound_data_logger.core.errors import SettingError

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(
    ('name', 'value'),
    [('seed', -1), ('seed', 1.5), ('duration_s', 'long'), ('rate_scale', 0.0), ('rate_scale', float('nan')), ('image_raw', 1)],
)
def test_a_wrong_value_is_named(name: str, value: object) -> None:
    """The error has the name, the value and what is allowed."""
    with pytest.raises(SettingError) as caught:
        SimSettings.load({name: value})
    assert caught.value.data['name'] == name
    assert str(caught.value).startswith(f'{name} = {value!r} is refused; allowed is')


def test_whole_numbers_and_the_parameters_of_rclpy_are_taken() -> None:
    """``duration_s:=5`` is five seconds, and what rclpy declares by itself is nobody's mistake."""
    settings = SimSettings.load({'duration_s': 5, 'use_sim_time': False, 'start_type_description_service': True})
    assert settings == SimSettings(duration_s=5.0)


class SlowRobot:
    """Takes a tenth of a second for its first message, longer than all others should take together."""

    rates_hz = {'a': 1000.0}  # noqa: RUF012

    def __init__(self) -> None:
        self.samples: list[tuple[float, int]] = []

    def publish(self, name: str, t: float, stamp_ns: int) -> None:
        if not self.samples:
            time.sleep(0.1)
        self.samples.append((t, stamp_ns))


def test_a_late_robot_catches_up_completely() -> None:
    """After a stall everything that was due is published, each with the time at which it was due."""
    robot = SlowRobot()
    run(robot, SimSettings(duration_s=0.05), lambda: False)  # type: ignore[arg-type]
    assert [t for t, _ in robot.samples] == [k / 1000 for k in range(50)]
    assert [stamp - robot.samples[0][1] for _, stamp in robot.samples] == [k * 1_000_000 for k in range(50)]


def test_a_stop_is_heeded_before_the_next_message() -> None:
    """Nothing more is published once it is to stop."""
    robot = SlowRobot()
    run(robot, SimSettings(), lambda: len(robot.samples) == 3)  # type: ignore[arg-type]
    assert len(robot.samples) == 3
