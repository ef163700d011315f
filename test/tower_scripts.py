"""The scripts of tower/ as modules: they are run where the package is not installed, and are not part of it."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import sys
from pathlib import Path
from types import ModuleType

TOWER = Path(__file__).resolve().parents[1] / 'tower'


def load(name: str) -> ModuleType:
    """A script that is not part of the package."""
    spec = importlib.util.spec_from_file_location(name, TOWER / f'{name}.py')
    assert spec
    assert spec.loader
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make_secrets = load('make_secrets')
prepare = load('prepare')
run = load('run')


def processes_of(folder: Path) -> list[int]:
    """Those whose command line names the folder."""
    found: list[int] = []
    for entry in Path('/proc').iterdir():
        try:
            if entry.name.isdigit() and str(folder) in (entry / 'cmdline').read_text():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def reload_s3(folder: Path) -> None:
    """Have the S3 server of a Tower of plain processes read its users again."""
    for number in processes_of(folder):
        if Path(f'/proc/{number}/cmdline').read_text().partition('\0')[0].endswith('weed'):
            os.kill(number, signal.SIGHUP)


def remove_database(folder: Path, offset: int) -> None:
    """Where run.py puts the files of PostgreSQL and MLflow for root, whose own folders their user cannot enter."""
    for path in run.unprivileged_folders(folder, offset).values():
        shutil.rmtree(path, ignore_errors=True)
