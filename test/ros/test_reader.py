"""Message packages that cannot be used here cost their own topics alone."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from shadowhound_data_logger.ros.reader import TypeUnavailable, message_class

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
    """A neighbour that publishes a type of that name would have whatever is installed here run."""
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
    ],
)
def test_a_type_that_is_none(name: str) -> None:
    """Each is told as the package that is missing, whatever the import raised."""
    with pytest.raises(TypeUnavailable, match=name):
        message_class(name)
