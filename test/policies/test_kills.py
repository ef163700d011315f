"""A robot that is killed while it changes its policy, in little: ``python -m torture.policies`` does it 200 times."""

from __future__ import annotations

from pathlib import Path

import pytest

from torture import policies


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('a Tower of its own, and a smoke run for each kill')
def test_the_active_version_is_always_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is killed, and where a disk is full, in front of a real registry and a real store."""
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    assert policies.main(['--kills', '10', '--seed', '11', '--folder', str(tmp_path / 'shop')]) == 0
