"""A machine to examine: its variables, its folders, and a separate /proc if needed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from stores.fake_s3 import hung, refused

from shadowhound_data_logger.core import mlflow_rest
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.doctor import s3
from shadowhound_data_logger.doctor.checks import CHECKS
from shadowhound_data_logger.doctor.context import make
from shadowhound_data_logger.doctor.model import Context, Result, Role
from shadowhound_data_logger.doctor.run import Examination
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.status import file

FOREIGN = (
    'AWS_',
    'MLFLOW_',
    'SHADOWHOUND_',
    'ROS_DOMAIN',
    'ROS_AUTO',
    'ROS_LOCAL',
    'RMW_',
    'HTTP',
    'http',
    'NO_PROXY',
    'no_proxy',
)
PATIENCE_S = 120.0
"""Deadline of an examination: other tests load the machine, and these are about the findings."""
BIG_BUFFER = 16 << 20


@dataclass
class Scene:
    """A healthy robot until a test changes it. Changes on ``stack`` are undone at the end."""

    folder: Path
    stack: ExitStack
    environ: dict[str, str] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=lambda: {'spool.min_free_bytes': 0, 'spool.max_bytes': 1 << 20})
    role: Role = Role.ROBOT
    namespace: str = '/'
    root: Path = Path('/')

    @classmethod
    def healthy(cls, folder: Path, stack: ExitStack) -> Scene:
        """Without a Tower; its kernel has large buffers, and no other process runs."""
        scene = cls(folder, stack, root=folder / 'root')
        kept = {name: value for name, value in os.environ.items() if not name.startswith(FOREIGN)}
        scene.environ = {**kept, 'HOME': str(folder / 'user'), 'SHADOWHOUND_HOME': str(folder / 'home')}
        for name in ('proc/net', 'dev/shm', 'etc/shadowhound', 'proc/sys/net/core'):
            (scene.root / name).mkdir(parents=True)
        (scene.root / 'proc/sys/net/core/rmem_max').write_text(f'{BIG_BUFFER}\n')
        (scene.root / 'proc/locks').write_text('')
        (folder / 'user').mkdir()
        return scene

    @property
    def home(self) -> Path:
        return self.folder / 'home'

    @property
    def spool(self) -> Path:
        return self.home / 'spool'

    def context(self) -> Context:
        return make(self.environ, role=self.role, parameters=self.parameters, namespace=self.namespace, root=self.root)

    def ask(self, *names: str) -> list[Result]:
        """All results of these checks."""
        context = self.context()
        wanted = [check for check in CHECKS if check.name in names and self.role in check.roles]
        return Examination(wanted, context, timeout_s=PATIENCE_S).run()

    def findings(self, *names: str) -> list[Result]:
        return [result for result in self.ask(*names) if result.is_finding]

    # -- the state of the machine ------------------------------------------------------------------------------------

    def open_spool(self) -> Spool:
        """The node's spool; closed at the end."""
        spool = Spool(self.spool, SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
        spool.open()
        self.stack.callback(spool.close)
        return spool

    def run_node(self, **changes: Any) -> None:
        """A status as a node writes it, from now and this process."""
        clock = SystemClock.of_this_machine()
        status = {
            'robot': 'thor', 'version': '', 'pid': os.getpid(), 'boot_id': clock.boot_id, 'boot_ns': clock.boot_ns(),
            'store': {'target': 'a server', 'state': 'idle'}, **changes,
        }  # fmt: skip
        self.spool.mkdir(parents=True, exist_ok=True)
        file(self.spool, 'thor').write_text(json.dumps(status))

    def process(self, pid: int, *words: str, **environ: str) -> None:
        """Add a process to /proc."""
        folder = self.root / f'proc/{pid}'
        folder.mkdir()
        (folder / 'cmdline').write_bytes(b'\0'.join(word.encode() for word in (*words, '')))
        (folder / 'environ').write_bytes(b'\0'.join(f'{name}={value}'.encode() for name, value in environ.items()))

    def listen(self, *sockets: str) -> None:
        """TCP sockets that accept connections, as ``0100007F:2328``."""
        lines = ['  sl  local_address rem_address   st', *(f'   0: {each} 00000000:0000 0A' for each in sockets)]
        (self.root / 'proc/net/tcp').write_text('\n'.join(lines) + '\n')


def assert_finding(found: list[Result], name: str, *words: str) -> None:
    """The only finding, by its name, with a remedy that contains this text."""
    reports = [f'{result.check}: {result.seen} | {result.cause} -> {result.remedy}' for result in found]
    assert [result.check for result in found] == [name], reports or 'nothing was found'
    assert found[0].seen, reports
    assert found[0].cause, reports
    missing = [word for word in words if word not in found[0].remedy]
    assert not missing, reports


def scenes(tmp_path: Path) -> Iterator[Scene]:
    with ExitStack() as stack:
        yield Scene.healthy(tmp_path, stack)


Inject = Callable[[Scene], None]


@contextmanager
def patient(seconds: float) -> Iterator[None]:
    """The timeout of a response."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(s3, 'ANSWER_S', seconds)
        patch.setattr(mlflow_rest, 'TIMEOUT_S', seconds)
        yield


def keys(**changes: str) -> Inject:
    return lambda scene: scene.environ.update(changes)


def nobody_there(variable: str) -> Inject:
    return lambda scene: scene.environ.update({variable: scene.stack.enter_context(refused())})


def hanging(variable: str) -> Inject:
    def inject(scene: Scene) -> None:
        scene.stack.enter_context(patient(0.5))
        scene.environ[variable] = scene.stack.enter_context(hung())

    return inject
