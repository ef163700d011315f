"""``shadowhound-data policy``: keys, packs and publishes policies; on the robot fetches, verifies, activates and rolls back."""

from __future__ import annotations

import os
from pathlib import Path

import click

from shadowhound_data_logger.cli.common import (
    BadUsage,
    LazyCommands,
    Verb,
    examples,
)
from shadowhound_data_logger.core.mlflow_rest import MlflowRest
from shadowhound_data_logger.policies.registry import MlflowRegistry


@click.group(
    commands=LazyCommands(
        (
            Verb('keys', module='policy_sign'),
            Verb('sign-root', module='policy_sign', attribute='sign_root'),
            Verb('rotate', module='policy_sign'),
            Verb('delegate', module='policy_sign'),
            Verb('refresh', module='policy_sign'),
            Verb('pack', module='policy_sign'),
            Verb('publish', module='policy_sign'),
            Verb('withdraw', module='policy_sign'),
            Verb('sync', module='policy_run'),
            Verb('run', module='policy_run'),
            Verb('list', module='policy_run', attribute='list_'),
            Verb('show', module='policy_run'),
            Verb('use', module='policy_run'),
            Verb('rollback', module='policy_run'),
            Verb('pin', module='policy_run'),
            Verb('unpin', module='policy_run'),
            Verb('report', module='policy_run'),
        )
    ),
    epilog=examples('policy publish packed --alias champion', 'policy sync --name go2_patrol'),
)
def policy() -> None:
    """Sign trained policies and deliver them to robots.

    MLflow's registry selects the version (alias champion), the store has its bytes, and The Update Framework decides whether
    it may run: a robot trusts the root.json that was installed on it, and the keys that it names.
    """


def registry() -> MlflowRegistry:
    """The one that MLFLOW_TRACKING_URI names. Raises BadUsage without one."""
    url = os.environ.get('MLFLOW_TRACKING_URI', '')
    if not url.startswith(('http://', 'https://')) or '@' in url:
        raise BadUsage('the registry is an MLflow server, and MLFLOW_TRACKING_URI names none', 'set it: http://SERVER:5001')
    return MlflowRegistry(MlflowRest(url.rstrip('/'), os.environ, Path.home()))
