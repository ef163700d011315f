"""Message packages that cannot be used here cost their own topics alone."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from shadowhound_data_logger.ros.reader import TypeUnavailable, message_class, unavailable

BROKEN = """
class Meta(type):
    _TYPE_SUPPORT = None

    @classmethod
    def __import_type_support__(cls):
        from rosidl_generator_py import import_type_support
        import_type_support('broken_interfaces')

class IMU(metaclass=Meta):
    pass
"""
"""As rosidl generates it, beside a library that is not found: PYTHONPATH is set, LD_LIBRARY_PATH is not."""


def test_a_package_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is unavailable, as one that is not installed is; what rosidl raises is not an ImportError and would end the intake."""
    (tmp_path / 'broken_interfaces').mkdir()
    (tmp_path / 'broken_interfaces/msg.py').write_text(BROKEN)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(TypeUnavailable, match='a library of broken_interfaces does not load: is its workspace sourced'):
        message_class('broken_interfaces/msg/IMU')
    sys.modules.pop('broken_interfaces.msg')


@pytest.mark.parametrize('layout', ['careless.py', 'careless/__init__.py'])
def test_a_package_without_messages_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str) -> None:
    """A neighbor that publishes a type of that name would have whatever is installed here run."""
    path = tmp_path / layout
    path.parent.mkdir(exist_ok=True)
    path.write_text('raise SystemExit("it was run")')
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(TypeUnavailable, match='no package careless with messages'):
        message_class('careless/msg/Thing')
    assert 'careless' not in sys.modules


@pytest.mark.parametrize(
    'name',
    [
        'no_such_package/msg/X',
        'std_msgs/msg/NoSuchName',
        'std_msgs',
        'os/msg/X',
        'os.path/msg/X',
        '/msg/X',
        'std_msgs/msg/__doc__',
        'std_srvs/srv/Trigger',
        'std_srvs/msg/Trigger_Event',
        'std_msgs/srv/Trigger_Event',
        'std_srvs/srv/NoSuchName_Event',
        'no_such_package/action/X_FeedbackMessage',
        'os/action/X_FeedbackMessage',
        'std_srvs/idl/Trigger_Event',
    ],
)
def test_an_invalid_type(name: str) -> None:
    """Each is told as the package that is missing, whatever the import raised."""
    with pytest.raises(TypeUnavailable, match=name):
        message_class(name)


@pytest.mark.parametrize(('name', 'why'), [
    ('nav2_none/action/Go_FeedbackMessage', 'its message package is not installed here .*no package nav2_none with actions'),
    ('std_msgs/srv/Trigger_Event', 'no package std_msgs with services'),
    ('std_srvs/srv/NoSuchName_Event', 'the package std_srvs that is installed here has no std_srvs/srv/NoSuchName_Event'),
    ('std_msgs/msg/NoSuchName', 'the package std_msgs that is installed here has no std_msgs/msg/NoSuchName'),
    ('std_srvs/srv/Trigger', 'is not the name of a message type'),
])  # fmt: skip
def test_the_reason_is_true(name: str, why: str) -> None:
    """A type that is missing in an installed package is not reported as a missing package."""
    assert re.search(why, unavailable(name))


@pytest.mark.parametrize('name', [
    'std_srvs/srv/Trigger_Event', 'std_srvs/srv/Trigger_Request', 'action_msgs/msg/GoalStatusArray',
    'action_msgs/srv/CancelGoal_Event', 'test_msgs/action/Fibonacci_FeedbackMessage', 'test_msgs/action/Fibonacci_SendGoal_Event',
    'test_msgs/action/NestedMessage_GetResult_Event',
])  # fmt: skip
def test_parts_of_services_and_actions(name: str) -> None:
    """Messages of services and actions can be received where their package is installed."""
    pytest.importorskip(name.partition('/')[0])
    if name.endswith('_Event'):
        pytest.importorskip('service_msgs', reason='Humble has no service events')
    assert message_class(name).__name__ == name.rpartition('/')[2]
    assert not unavailable(name)
