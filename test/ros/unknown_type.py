"""A type that this process does not know, and a program that publishes it and knows it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from shadowhound_data_logger.formats import definitions
from shadowhound_data_logger.ros import reader, type_support

NAME = 'test_msgs/msg/Arrays'
PROGRAM = """
import sys, rclpy
from rclpy.qos import QoSProfile
from test_msgs.msg import Arrays
rclpy.init()
node = rclpy.create_node('knowing', namespace='/robot')
publisher = node.create_publisher(Arrays, '/arrays', QoSProfile(depth=10))
node.create_timer(0.1, lambda: publisher.publish(Arrays(alignment_check=7)))
rclpy.spin(node)
"""


@contextmanager
def publisher(domain: int) -> Iterator[None]:
    """A node that publishes ``/arrays`` ten times per second."""
    running = subprocess.Popen([sys.executable, '-c', PROGRAM], env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})
    try:
        yield
    finally:
        running.kill()
        running.wait()


@contextmanager
def hidden(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This process has neither the package test_msgs nor its definitions; skips the test where types have no descriptions."""
    pytest.importorskip('test_msgs')
    if type_support.rclpy_version()[0] < type_support.FIRST_WITH_HASH:
        pytest.skip('types have no descriptions')
    find, is_installed = definitions._find_file, reader._is_installed

    def find_others(prefixes: Any, type_name: str, extension: str) -> Any:
        if type_name.startswith('test_msgs/'):
            raise FileNotFoundError(type_name)
        return find(prefixes, type_name, extension)

    def forget() -> None:
        definitions._describe.cache_clear()
        definitions.LEARNED.clear()
        for known in (reader.message_class, reader.is_installed, reader.unavailable, type_support._maker):
            known.cache_clear()
        type_support._CLASSES.clear()

    monkeypatch.setattr(definitions, '_find_file', find_others)
    monkeypatch.setattr(reader, '_is_installed', lambda package, kind: package != 'test_msgs' and is_installed(package, kind))
    forget()
    yield
    forget()
