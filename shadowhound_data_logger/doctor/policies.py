"""Policies of this robot: whether the signed metadata is fresh, so that new versions are accepted and stolen keys replaced."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.doctor.model import Context, Result, ok, warning
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.smoke import SANDBOX
from shadowhound_data_logger.policies.trust import follows_signers, why_stale

NAME: Final = 'policies'


def check(context: Context) -> Iterator[Result]:
    """Uses the last verified metadata on the disk, not the store or the registry."""
    folder = PolicyFolder(context.settings.home)
    if not follows_signers(folder.path):
        yield ok(NAME, 'no policies are followed here')
    elif why := why_stale(folder.path, time.time_ns()):
        yield warning(
            'policies.stale',
            f'no new version is accepted: {why}',
            'signing has stopped, new metadata does not reach this robot, policy run is not running, or a clock is wrong',
            'shadowhound-data policy sync ; shadowhound-data doctor --only clock',
        )
    else:
        yield ok(NAME, f'the signed metadata is fresh; active is {folder.current() or "no policy"}')
    if (active := folder.current()) and (tried := folder.state.read().verified.get(active)) != SANDBOX:
        yield warning(
            'policies.isolation',
            f'{active} was tested in {tried or "an unknown isolation"}, not in a sandbox',
            'bubblewrap is missing or may not create namespaces here, and policy run was started with --isolation limits',
            'sudo apt install bubblewrap ; shadowhound-data policy sync --isolation sandbox',
        )
