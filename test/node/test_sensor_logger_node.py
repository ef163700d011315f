"""The node's command line: arguments that do not belong to ROS are refused before anything starts."""

from __future__ import annotations

import os

import pytest

from shadowhound_data_logger.node.sensor_logger_node import main


@pytest.fixture(autouse=True)
def variables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the RMW chosen by the node from affecting later tests."""
    monkeypatch.setattr(os, 'environ', os.environ.copy())


@pytest.mark.parametrize('arguments', [['--params-file', 'my.yaml'], ['camera.rate_hz:=2.0', '--ros-args', '-r', '__ns:=/a']])
def test_arguments_that_ros_would_ignore_are_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2, the argument by name, and where it belongs: rcl would silently run with the defaults."""
    assert main(arguments) == 2
    captured = capsys.readouterr().err
    assert f'{arguments[0]!r} is not a valid argument' in captured
    assert '--ros-args' in captured


@pytest.mark.parametrize('option', ['-h', '--help'])
def test_help_starts_nothing(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Help is printed with exit code 0, and no node runs."""
    assert main([option]) == 0
    assert capsys.readouterr().out.startswith('usage: sensor_logger_node')
