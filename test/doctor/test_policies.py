"""The doctor's findings about a robot's policies, without requests to the store or the registry."""

from __future__ import annotations

from pathlib import Path

import pytest
from doctor.scene import Scene

from shadowhound_data_logger.policies.folder import PolicyFolder

NAME = f'go2_patrol@1#{"a" * 16}'


def activate(scene: Scene, isolation: str) -> None:
    """Activate a version whose smoke run had this isolation; no root of trust is installed."""
    folder = PolicyFolder(scene.folder / 'home')
    folder.make()
    (folder.versions.path / NAME).mkdir()
    (folder.path / 'current').symlink_to(Path('versions') / NAME)
    with folder.state.changing() as state:
        state.verified[NAME] = isolation


@pytest.mark.parametrize(('isolation', 'checks'), [
    ('sandbox', ['policies.stale']), ('limits', ['policies.stale', 'policies.isolation']),
])  # fmt: skip
def test_a_policy_that_was_tried_without_a_sandbox_is_reported(scene: Scene, isolation: str, checks: list[str]) -> None:
    """So is a robot without a root of trust: it accepts no new version."""
    activate(scene, isolation)
    found = scene.findings('policies')
    assert [result.check for result in found] == checks
    assert 'root.json' in found[0].seen
    if len(found) > 1:
        assert NAME in found[1].seen
        assert 'apt install bubblewrap' in found[1].remedy


def test_a_robot_without_policies_has_no_finding(scene: Scene) -> None:
    assert scene.findings('policies') == []
