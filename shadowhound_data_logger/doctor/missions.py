"""Missions of this machine: whether the agent logs any, and whether they reached MLflow."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.doctor.model import Context, Result, info, ok, warning
from shadowhound_data_logger.missions.overview import overviews

NAME: Final = 'missions'


def check(context: Context) -> Iterator[Result]:
    """Check that missions are readable, logged and delivered."""
    try:
        found = overviews(context.settings.home)
    except OSError as problem:
        yield warning(
            NAME, f'the missions cannot be read: {problem}', 'they belong to another user', f'ls -l {context.settings.home}'
        )
        return
    if not found:
        yield info(
            NAME,
            'no mission has been logged here',
            'the mission agent does not use MissionDataLogger yet, or another SHADOWHOUND_HOME',
            'docs/missions.md',
        )
        return
    stuck = [each for each in found if not each.complete and each.last_error]
    refused = [each for each in found if each.refused_by_server]
    for each in stuck[-1:]:
        yield warning(
            'missions.sent',
            f'{len(stuck)} of {len(found)} missions are not sent; the last one: {each.last_error}',
            'MLflow or the store does not accept them',
            each.remedy or 'shadowhound-data doctor --only mlflow',
        )
    for each in refused[-1:]:
        yield warning(
            'missions.refused',
            f'MLflow refused a part of {len(refused)} missions',
            f'the last one is {each.mission_id}',
            f'shadowhound-data missions show {each.mission_id}',
        )
    if not stuck and not refused:
        waiting = sum(not each.complete for each in found)
        yield ok(NAME, f'{len(found)} missions, {waiting} of them not delivered yet')
