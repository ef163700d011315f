"""The scripts of tower/ as modules: they are run where the package is not installed, and are no part of it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

TOWER = Path(__file__).resolve().parents[1] / 'tower'


def load(name: str) -> ModuleType:
    """A script that is no part of the package."""
    spec = importlib.util.spec_from_file_location(name, TOWER / f'{name}.py')
    assert spec
    assert spec.loader
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make_secrets = load('make_secrets')
prepare = load('prepare')
