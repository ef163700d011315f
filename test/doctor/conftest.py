"""A healthy robot for each test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from doctor.scene import Scene, scenes


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    yield from scenes(tmp_path)
