"""Kills a robot that follows a registry, with ``kill -9``, at each step of a sync, an activation, a rollback and a report.

MLflow's registry and SeaweedFS are real, with the permissions of a robot; so are signatures, hashes and smoke runs. A step is a
call that makes something durable, or a downloaded piece; many kills happen at random times instead. Some rounds fill the disk
at a step. After each, ``current`` must be a complete, verified version: the one that was active before, or the new one. The
interrupted action is then repeated, and must succeed.
"""

from __future__ import annotations

import os
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import boto3
from policies.models import Spark, linear
from shadowhound_tower.embedded import Tower
from shared_tower import USERS

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.mlflow_rest import MlflowRest
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.policies import packing, running, sync
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.manifest import PolicyManifest
from shadowhound_data_logger.policies.registry import CHAMPION, MlflowRegistry
from shadowhound_data_logger.stores.s3 import S3Store
from torture._command import Check, parse_kills, parser, progress, verdict, workshop
from torture._disks import MEBI, Disk, NotAllowed, small_disk

KILLS: Final = 200
SHORT_KILLS: Final = 20
FULL: Final = 5
"""The disk is filled once per this many kills."""
VERSIONS: Final = 6
ROBOT: Final = 'thor'
NAME: Final = 'go2_patrol'
BALLAST: Final = 1_000_000
"""Floats in each model: the download takes some of the time."""
DISK_MB: Final = 48
STEPS: Final = ('fsync', 'fdatasync', 'replace', 'symlink', 'chmod', 'rename', 'rmdir', 'unlink')
"""Calls of ``os`` before which a process may be killed."""
SPARE_STEPS: Final = 5
"""A sync may have this many fewer steps than the first one: the number of downloaded pieces varies."""
WAIT_S: Final = 300.0


@dataclass(frozen=True, slots=True)
class Round:
    """One action of the robot, from one active version to another."""

    act: str
    """``sync``, ``use``, ``rollback`` or ``report``."""
    before: str
    after: str


class Robot:
    """At most two versions, so that each sync of a new one downloads; its Spark, and its Tower."""

    def __init__(self, tower: Tower, folder: Path, home: Path) -> None:
        self._tower = tower
        self._spark = Spark(folder / 'spark')
        self._steps = folder / 'steps'
        self.folder = PolicyFolder(home)
        self._spark.trusted_by(self.folder)
        keys = tower.environment()
        boto3.client('s3', endpoint_url=tower.endpoint_url, region_name='us-east-1', aws_access_key_id=keys['AWS_ACCESS_KEY_ID'],
                     aws_secret_access_key=keys['AWS_SECRET_ACCESS_KEY']).create_bucket(Bucket='lerobot')  # fmt: skip
        self._registry = self._registry_of('spark')
        self.manifests: dict[str, PolicyManifest] = {}
        with closing(self._store_of('spark')) as store:
            signing = self._spark.signing(store)
            for version in range(1, VERSIONS + 1):
                packed, manifest = self._spark.packed(version, linear(0.1 * version, extra=BALLAST))
                packing.publish(packed, store, self._registry, signing, aliases=[CHAMPION])
                self.manifests[manifest.id] = manifest

    def _store_of(self, user: str) -> S3Store:
        store = S3Store(self._tower.store_settings(user), UploadSettings())
        store.open()
        return store

    def _registry_of(self, user: str) -> MlflowRegistry:
        return MlflowRegistry(MlflowRest(self._tower.tracking_uri, self._tower.tracking(user), Path('/nonexistent')))

    def prepare(self, act: str, chance: random.Random) -> Round:
        """A possible next action: nothing is pinned, no version is bad, and the target of a rollback was active before."""
        before, installed = str(self.folder.current()), self.folder.versions.ids()
        is_new = act == 'sync'
        others = set(self.manifests).difference(installed) if is_new else {*installed} - {before}
        after = chance.choice(sorted(others))
        if is_new:
            self._registry.set_alias(NAME, CHAMPION, self.manifests[after].version)
        with self.folder.state.changing() as state:
            state.pin, state.history = None, [] if is_new else [after]
            state.bad.clear()
        return Round(act, before, after)

    def do(self, one: Round) -> None:
        """What a command line or a program of the robot does."""
        if one.act == 'sync':
            with closing(self._store_of(ROBOT)) as store:
                settings = sync.PolicySettings(name=NAME, robot=ROBOT, min_free_bytes=0, keep=2)
                sync.PolicySync(self.folder, store, self._registry_of(ROBOT), settings).run()
        elif one.act == 'use':
            self.folder.use(one.after)
        elif self.folder.current() == one.before:  # not where it was done before the kill
            if one.act == 'rollback':
                self.folder.roll_back()
            else:
                running.judge(self.folder, one.before, self.manifests[one.before], 1000, 0.0)

    def wrong(self, allowed: Sequence[str]) -> str:
        """What is wrong with the active version; empty if nothing."""
        now = self.folder.current()
        if now is None or now not in allowed:
            return f'{now} is active, and none of {allowed}'
        try:
            self.folder.check(now, self.folder.state.read())
        except (DataLoggerError, OSError) as error:
            return f'{now}: {error}'
        return '' if now in self.folder.state.read().verified else f'{now} was never verified'

    def start(self, one: Round, at: int | None = None, then: Callable[[], object] = lambda: None) -> int:
        """Run it in a separate process, in which ``then`` is called at this step."""
        self._steps.unlink(missing_ok=True)
        return forked(partial(self._counted, one, at, then))

    def _counted(self, one: Round, at: int | None, then: Callable[[], object]) -> None:
        steps = 0

        def step() -> None:
            nonlocal steps
            if steps == at:
                then()
            steps += 1

        for name in STEPS:
            setattr(os, name, _after(step, getattr(os, name)))
        count = sync._Traffic.count
        sync._Traffic.count = _after(step, count)  # type: ignore[method-assign]
        self.do(one)
        self._steps.write_text(str(steps))

    def steps(self) -> int:
        """Steps of the last process that completed."""
        return int(self._steps.read_text()) if self._steps.exists() else 0


def _after(step: Callable[[], None], act: Callable[..., Any]) -> Callable[..., Any]:
    def acts(*given: Any, **named: Any) -> Any:
        step()
        return act(*given, **named)

    return acts


def forked(act: Callable[[], None]) -> int:
    """The process id of a child that does it, in a separate group; its exit code is 1 on failure."""
    pid = os.fork()
    if pid == 0:
        code = 1
        with suppress(BaseException):
            os.setsid()
            act()
            code = 0
        os._exit(code)
    return pid


def ended(pid: int) -> int:
    """Its status. Raises TimeoutError if it hangs, and kills it then."""
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return status
        time.sleep(0.002)
    os.kill(pid, 9)
    os.waitpid(pid, 0)
    raise TimeoutError(f'a step of the robot took more than {WAIT_S:g} s')


def fill(path: Path) -> None:
    """The file takes all free space of its disk."""
    with path.open('wb', buffering=0) as file:
        for size in (MEBI, 4096, 1):
            with suppress(OSError):
                while True:
                    file.write(bytes(size))


class Campaign:
    """Rounds, and the problems found."""

    def __init__(self, robot: Robot, disk: Disk | None, chance: random.Random) -> None:
        self._robot = robot
        self._disk = disk
        self._chance = chance
        self._longest_s: dict[str, float] = {}
        self.steps: dict[str, int] = {}
        self.killed_at: dict[str, set[int]] = {}
        self.outcomes: Counter[str] = Counter()
        self.found: list[str] = []

    def begin(self) -> None:
        """Each action once without a kill: its number of steps, and its duration."""
        robot = self._robot
        for name in robot.manifests:  # all of them, in order: a verified version may follow a later one
            robot._registry.set_alias(NAME, CHAMPION, robot.manifests[name].version)
            robot.do(Round('sync', '', name))
        for act in ('sync', 'use', 'rollback', 'report'):
            one, began = robot.prepare(act, self._chance), time.monotonic()
            status = ended(robot.start(one))
            self._longest_s[act] = time.monotonic() - began
            self._audit(one, [one.after], f'an uncut {act} ended with {status}')
            self.steps[act] = robot.steps()
            self.killed_at[act] = set()

    def kills(self, count: int) -> None:
        """Each step once, as far as they exist, and then random times."""
        deck = [(act, step) for act, steps in self.steps.items() for step in range(steps)]
        self._chance.shuffle(deck)
        at_steps = max(count // 2, min(len(deck), count * 3 // 4))
        while self.outcomes['killed'] < count:
            act, step = deck.pop() if deck and self.outcomes['killed'] < at_steps else (self._chance.choice([*self.steps]), None)
            one = self._robot.prepare(act, self._chance)
            pid = self._robot.start(one, step, lambda: os.kill(os.getpid(), 9))
            if step is None:
                time.sleep(self._longest_s[act] * self._chance.uniform(0.0, 1.1))
                os.kill(pid, 9)
            is_killed = os.WIFSIGNALED(ended(pid))
            if step is None:  # most of them should hit
                self._longest_s[act] *= 1.05 if is_killed else 0.85
            self.outcomes['killed' if is_killed else 'done'] += 1
            if is_killed:
                self.outcomes['before' if self._robot.folder.current() == one.before else 'after'] += 1
                self.killed_at[act] |= {step} if step is not None else set()
            self._audit(one, [one.before, one.after] if is_killed else [one.after], f'{act}, killed at {step}')
            self._again(one)
            if self.outcomes['killed'] % 20 == 0 and is_killed:
                progress(f'{self.outcomes["killed"]} kills, {len(self.found)} findings')

    def fills(self, count: int) -> None:
        """The disk is full from a random step on, and then has space again."""
        disk = self._disk
        if disk is None:
            return
        deck = [(act, step) for act, steps in self.steps.items() for step in range(steps)]
        for act, step in self._chance.sample(deck, min(count, len(deck))):
            one = self._robot.prepare(act, self._chance)
            status = ended(self._robot.start(one, step, partial(fill, disk.path / 'ballast')))
            self.outcomes['full disk, failed' if status else 'full disk, done'] += 1
            self._audit(one, [one.before, one.after] if status else [one.after], f'{act}, disk full at {step}')
            (disk.path / 'ballast').unlink(missing_ok=True)
            self._again(one)

    def _again(self, one: Round) -> None:
        """The interrupted action must succeed when repeated."""
        self._robot.do(one)
        self._audit(one, [one.after], f'{one.act}, once more')

    def _audit(self, one: Round, allowed: Sequence[str], what: str) -> None:
        if wrong := self._robot.wrong(allowed):
            self.found.append(f'{what}, from {one.before} to {one.after}: {wrong}')
            progress(self.found[-1])
            with suppress(DataLoggerError):
                self._robot.folder.use(one.after)

    def figures(self) -> Mapping[str, Any]:
        return {**self.outcomes, 'steps': self.steps, 'killed at steps': {act: len(at) for act, at in self.killed_at.items()}}


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign."""
    given = parse_kills(parser('policies', __doc__ or ''), argv, usual=KILLS, short=SHORT_KILLS)
    with workshop(given) as shop, ExitStack() as stack:
        (shop.folder / 'tmp').mkdir(exist_ok=True)
        os.environ['TMPDIR'] = str(shop.folder / 'tmp')  # of smoke runs that are killed
        disk: Disk | None = None
        try:
            disk = stack.enter_context(small_disk(shop.folder, DISK_MB))
        except NotAllowed:
            progress('this machine lets nobody mount anything: no disk is filled up')
        tower = stack.enter_context(Tower(shop.folder / 'tower', mlflow=True, users=USERS))
        robot = Robot(tower, shop.folder, disk.path if disk else shop.folder / 'robot')
        campaign = Campaign(robot, disk, random.Random(given.seed))
        campaign.begin()
        campaign.kills(given.kills)
        campaign.fills(-(-given.kills // FULL))
        found, outcomes = campaign.found, campaign.outcomes
        shop.passed = not found
    bars = [Check('the active version is whole, verified, and the one before or the one after', not found, '; '.join(found[:5]))]
    if given.kills >= KILLS // 2:
        is_everywhere = all(len(campaign.killed_at[act]) >= steps - SPARE_STEPS for act, steps in campaign.steps.items())
        bars += [Check('it was killed at each step', is_everywhere, str(campaign.figures()['killed at steps'])),
                 Check('kills came before and after the activation', bool(outcomes['before'] and outcomes['after']),
                     f'{outcomes["before"]} before, {outcomes["after"]} after')]  # fmt: skip
    return verdict({'seed': given.seed, **campaign.figures()}, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
