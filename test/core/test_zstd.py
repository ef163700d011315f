"""Bags are read and written on a Python that has zstd itself, where `backports.zstd` is not installed."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import importlib, pkgutil, sys, types
from backports import zstd
rosbags = importlib.import_module('rosbags.rosbag2')  # looks for it by itself
compression = types.ModuleType('compression')
compression.zstd = zstd
sys.modules.update({'compression': compression, 'compression.zstd': zstd})
for name in [name for name in sys.modules if name.startswith('backports')]:
    sys.modules[name] = None
sys.version_info = (3, 14, 0, 'final', 0)
for folder in ('formats.mcap', 'bags'):
    package = importlib.import_module(f'shadowhound_data_logger.{folder}')
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f'{package.__name__}.{module.name}')
from shadowhound_data_logger.core.untrusted import decompress
print(decompress('zstd', zstd.compress(b'a chunk')))
"""


@pytest.mark.long('a process of its own')
def test_from_python_3_14_on_only_the_standard_library_is_needed() -> None:
    """Every module of mcap and bags is imported by an interpreter that reports 3.14, without `backports.zstd`."""
    ran = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, text=True, check=False, timeout=120)
    assert (ran.returncode, ran.stdout) == (0, "b'a chunk'\n"), ran.stderr
