"""Who ran what: a mission says which policy was active when it began."""

from __future__ import annotations

from pathlib import Path

from missions.fakes import journals

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.missions.folder import MissionSent, Run
from shadowhound_data_logger.missions.story import Story, summary_of
from shadowhound_data_logger.policies.folder import PolicyFolder

ID = 'go2_patrol@7#0123456789abcdef'


def test_a_mission_says_which_policy_was_active(tmp_path: Path) -> None:
    """In the params of its run and in its summary; one that began without a policy says none."""
    logger = MissionDataLogger(home=tmp_path, robot='thor', replay=False, start_timeout_s=0.0)
    for has_policy in (False, True):
        if has_policy:
            folder = PolicyFolder(tmp_path)
            folder.make()
            (folder.path / 'current').symlink_to(f'versions/{ID}')
        logger.start_mission(f'patrol_{has_policy}', 'go round')
        logger.end_mission(True, 1.0, 2.0)
    logger.close()
    told = {}
    for records in journals(tmp_path):
        story = Story()
        for record in records:
            story.add(record)
        summary = summary_of(story, 'mission', Run('run', '1', ''), MissionSent(), {})
        told[summary['mission_type']] = (story.params().get('policy'), summary['policy'])
    assert told == {'patrol_False': (None, None), 'patrol_True': (ID, ID)}
