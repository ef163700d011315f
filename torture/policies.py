"""Kills a robot that follows a registry, with ``kill -9``, at any moment of a download, a smoke run or an activation.

After each kill ``current`` must be a whole, verified version: the one that was active before, or the one that was to be. Now and
then it is left alone, and then it must arrive.
"""

from __future__ import annotations

import os
import random
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

from policies.models import Aliases, Spark, linear

from shadowhound_data_logger.errors import DataLoggerError
from shadowhound_data_logger.options import StoreSettings, UploadSettings
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync
from shadowhound_data_logger.stores import open_store
from torture._command import Bar, asked_kills, parser, progress, verdict, workshop

KILLS: Final = 200
SHORT_KILLS: Final = 20
VERSIONS: Final = 5
LEFT_ALONE: Final = 20
"""One round of so many is not killed."""
STEPS: Final = 60
"""Of which one is the last of a process that kills itself: more than a round has."""
BALLAST: Final = 500_000
"""Floats in each model: the download takes some of the time."""


class Follower:
    """A robot of two versions at most, so that nearly every round downloads, and its Spark."""

    def __init__(self, folder: Path) -> None:
        self.spark = Spark(folder / 'spark')
        self.registry = Aliases()
        self.folder = PolicyFolder(folder / 'robot')
        self.folder.make()
        shutil.copy(self.spark.public, self.folder.path / 'keys' / 'spark.pub')
        self.store = open_store(StoreSettings(directory=folder / 'store'), UploadSettings())
        self.ids: list[str] = []
        for version in range(1, VERSIONS + 1):  # of one serial: each may follow each
            packed, manifest = self.spark.packed(version, linear(0.1 * version, extra=BALLAST), serial=1)
            shutil.copytree(packed, folder / 'store' / 'lerobot' / 'policies' / 'go2' / f'go2_patrol_v{version}')
            self.ids.append(manifest.id)

    def follow(self, version: int, *, is_left: bool, step: int | None) -> None:
        """In a process of its own: what ``policy run`` does, over and over unless it is left alone.

        With a step, it kills itself before that call that makes something durable.
        """
        if step is not None:
            _die_at(step)
        self.registry.say('champion', version)
        settings = PolicySettings(name='go2_patrol', robot='thor', min_free_bytes=0, keep=2)
        one = PolicySync(self.folder, self.store, self.registry, settings)
        one.run()
        while not is_left:
            one.run()

    def wrong(self, allowed: set[str | None]) -> str:
        """What is wrong with the active version; empty for nothing."""
        now = self.folder.current()
        if now not in allowed:
            return f'{now} is active, and neither of {allowed}'
        try:
            if now is not None:
                self.folder.check(now, self.folder.state())
        except (DataLoggerError, OSError) as error:
            return f'{now}: {error}'
        return ''


def _die_at(step: int) -> None:
    left = step

    def dying(act: Callable[..., Any]) -> Callable[..., Any]:
        def acts(*given: Any, **named: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                os.kill(os.getpid(), 9)
            return act(*given, **named)

        return acts

    for name in ('fsync', 'fdatasync', 'replace', 'symlink', 'chmod', 'rename'):
        setattr(os, name, dying(getattr(os, name)))


def forked(act: Callable[[], None]) -> int:
    """The process id of a child that does it, in a group of its own."""
    pid = os.fork()
    if pid == 0:
        code = 1
        with suppress(BaseException):
            os.setsid()
            act()
            code = 0
        os._exit(code)
    return pid


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign."""
    given = asked_kills(parser('policies', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    chance = random.Random(given.seed)
    outcomes: Counter[str] = Counter()
    found: list[str] = []
    with workshop(given) as shop:
        robot = Follower(shop.folder)
        longest_s = 0.0
        rounds = 0
        while outcomes['killed'] < given.kills:
            before = robot.folder.current()
            wanted = chance.choice([name for name in robot.ids if name != before])
            version = robot.ids.index(wanted) + 1
            is_left = rounds % LEFT_ALONE == 0
            rounds += 1
            begin = time.monotonic()
            step = None if is_left or chance.random() < 0.5 else chance.randrange(STEPS)
            pid = forked(partial(robot.follow, version, is_left=is_left, step=step))
            if not is_left:
                time.sleep(longest_s * (chance.uniform(0.0, 1.3) if step is None else 1.3))
                os.kill(pid, 9)
            status = os.waitpid(pid, 0)[1]
            is_killed = os.WIFSIGNALED(status)
            if is_left:
                longest_s = time.monotonic() - begin
            outcomes['killed' if is_killed else 'done'] += 1
            now = robot.folder.current()
            if is_killed:
                outcomes['before' if now == before else 'after'] += 1
                outcomes['while downloading or trying'] += any(robot.folder.incoming.iterdir())
            if wrong := robot.wrong({before, wanted} if is_killed else {wanted}):
                found.append(f'round {rounds}: {wrong}')
                progress(found[-1])
            if rounds % 20 == 0:
                progress(f'{outcomes["killed"]} kills, {len(found)} findings')
        robot.store.close()
        shop.passed = not found
    bars = [Bar('the active version is whole, verified, and the one before or the one after', not found, '; '.join(found[:5])),
            Bar('kills came before and after the activation', bool(outcomes['before'] and outcomes['after']),
                f'{outcomes["before"]} before, {outcomes["after"]} after')]  # fmt: skip
    return verdict({'seed': given.seed, **outcomes}, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
