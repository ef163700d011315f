"""One Tower for all workers of a test run, in a separate process that ends with the run.

``python shared_tower.py FOLDER PID USERS [--mlflow]`` starts it, writes FOLDER/tower.json and stops when the process PID exits.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from shadowhound_tower.embedded import OWNER, Tower

from shadowhound_data_logger.core.config import StoreSettings

ROBOTS: Final = ('thor', 'tachi')
"""A test changes the password of the second."""
BUCKETS: Final = ('sensor-data', 'trajectories', 'lerobot', 'mlflow')
USERS: Final = {
    'thor': [*(f'{action}:{name}/thor/*' for name in ('sensor-data', 'trajectories', 'imu-data') for action in ('Read', 'Write')),
             'Read:lerobot/policies/*'],
    'spark': [*(f'{action}:{name}' for name in BUCKETS for action in ('Read', 'List')), 'Write:lerobot'],
    'stranger': ['Read:other'],
}  # fmt: skip
"""Of S3: Thor's keys may put and get the robot's objects and get policies, but neither list nor delete; Spark's may read and
publish; the stranger's have no access here."""
WAIT_S: Final = 180.0
"""For both servers, on a machine where all workers start at the same time."""


class SharedTower:
    """A Tower in another process, with the attributes of ``Tower`` that tests use."""

    def __init__(self, description: Mapping[str, Any]) -> None:
        self._environments: dict[str, dict[str, str]] = description['environments']
        self._trackings: dict[str, dict[str, str]] = description['trackings']
        self._folder = Path(description['folder'])
        self.endpoint_url: str = description['endpoint_url']
        self.tracking_uri: str = description['tracking_uri']

    def environment(self, user: str = OWNER) -> dict[str, str]:
        return dict(self._environments[user])

    def tracking(self, user: str) -> dict[str, str]:
        return dict(self._trackings[user])

    def store_settings(self, user: str = OWNER) -> StoreSettings:
        environ = self._environments[user]
        return StoreSettings(endpoint_url=self.endpoint_url, access_key_id=environ['AWS_ACCESS_KEY_ID'],
                             secret_access_key=environ['AWS_SECRET_ACCESS_KEY'])  # fmt: skip


def shared_tower(folder: Path, users: Mapping[str, Sequence[str]], owner: int, *, mlflow: bool) -> SharedTower:
    """The Tower of this run in ``folder``, started by the first worker that needs it; it runs as long as process ``owner``."""
    folder.mkdir(exist_ok=True)
    with (folder / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        file = folder / 'tower.json'
        if not file.exists():
            _start(folder, [str(owner), json.dumps(users), *(['--mlflow'] if mlflow else [])])
        return SharedTower(json.loads(file.read_text()))


def _start(folder: Path, arguments: Sequence[str]) -> None:
    """Start it and wait until it is ready. Without Popen, as the process keeps running after the worker that starts it."""
    command, log = [sys.executable, __file__, str(folder), *arguments], folder / 'log'
    pid = os.posix_spawn(sys.executable, command, os.environ, setsid=True, file_actions=[
        (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
        (os.POSIX_SPAWN_OPEN, 1, str(log), os.O_WRONLY | os.O_CREAT, 0o600), (os.POSIX_SPAWN_DUP2, 1, 2),
    ])  # fmt: skip
    end = time.monotonic() + WAIT_S
    while not (folder / 'tower.json').exists():
        assert os.waitpid(pid, os.WNOHANG) == (0, 0), log.read_text()
        assert time.monotonic() < end, f'no Tower within {WAIT_S:g} s: {log.read_text()}'
        time.sleep(0.02)


def main(folder: str, owner: str, users: str, *options: str) -> None:
    watched = os.pidfd_open(int(owner))
    data, has_mlflow = Path(folder) / 'data', '--mlflow' in options
    with Tower(data, mlflow=has_mlflow, users=json.loads(users), robots=ROBOTS) as tower:
        description = {
            'folder': str(data), 'endpoint_url': tower.endpoint_url, 'tracking_uri': tower.tracking_uri,
            'environments': {user: tower.environment(user) for user in (OWNER, *json.loads(users))},
            'trackings': {user: tower.tracking(user) for user in (OWNER, 'spark', *ROBOTS)} if has_mlflow else {},
        }  # fmt: skip
        part = Path(folder) / 'tower.json.part'
        part.touch(mode=0o600)
        part.write_text(json.dumps(description))
        part.rename(Path(folder) / 'tower.json')
        select.select([watched], [], [])


if __name__ == '__main__':
    main(*sys.argv[1:])
