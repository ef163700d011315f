"""Processes of the tests: the node, the simulated robot, a witness and publishers, each separate and always reaped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from forking import Forked, can_fork, fork
from shadowhound_sim.demo_processes import THIS_MACHINE

from shadowhound_data_logger.spool import ledger

HERE = Path(__file__).parent
NODE = 'shadowhound_data_logger.node.sensor_logger_node'
SIM = 'shadowhound_sim.sim_go2_node'
COMMANDS = 'shadowhound_data_logger.cli.main'
LONG = bool(os.environ.get('SHADOWHOUND_TEST_LONG'))
"""``SHADOWHOUND_TEST_LONG=1 make test PYTEST_ARGS=test/e2e`` runs for the documented minutes instead of seconds."""
WAIT_S = 120.0
"""Longer than any working operation takes on a busy machine; a node starts in two seconds on an idle one."""
GENTLE = 'rate_scale:=0.3'
"""Of a simulated Go2, for tests that do not depend on its rates: it and the node use a third of the CPU."""
UNHEARD = 3
"""The number of messages that a publisher may have sent before a node on a busy machine discovers it, RELIABLE or not: an account
starts with the first message received (docs/reliability.md).
"""
T = TypeVar('T')


def until(condition: Callable[[], T], what: str | Callable[[], str], seconds: float = WAIT_S) -> T:
    """The first true result of ``condition``; after a timeout the test fails with ``what`` it waited for."""
    end = time.monotonic() + seconds
    while not (answer := condition()):
        assert time.monotonic() < end, f'within {seconds:g} s: {what if isinstance(what, str) else what()}'
        time.sleep(0.02)
    return answer


class Process:
    """A Python program with standard error (and output, unless piped) going to a log file."""

    def __init__(
        self, name: str, command: Sequence[str], log: Path, environ: Mapping[str, str], *,
        piped: bool = False, forked: bool = False,
    ) -> None:  # fmt: skip
        self.name, self.log_path = name, log
        pipe = subprocess.PIPE if piped else None
        self.popen: subprocess.Popen[str] | Forked
        with log.open('ab') as file:
            if forked and can_fork(environ):
                self.popen = fork(command, environ, file, piped=piped)
            else:
                self.popen = subprocess.Popen(
                    [sys.executable, *command], stdin=pipe or subprocess.DEVNULL, stdout=pipe or file, stderr=file,
                    env=dict(environ), text=True,
                )  # fmt: skip

    @property
    def log(self) -> str:
        return self.log_path.read_text(encoding='utf-8', errors='replace')

    def await_log(self, words: str, seconds: float = WAIT_S) -> None:
        """Wait until the log contains the text."""

        def looked() -> bool:
            assert words in self.log or self.popen.poll() is None, f'{self.name} ended with {self.popen.returncode}: {self.log}'
            return words in self.log

        until(looked, f'{self.name} says {words!r}', seconds)

    def signal(self, number: int) -> None:
        self.popen.send_signal(number)

    def wait(self, seconds: float = WAIT_S) -> int:
        return self.popen.wait(seconds)

    def kill(self) -> None:
        """Kill it; idempotent."""
        self.popen.kill()
        self.popen.wait()
        for stream in (self.popen.stdin, self.popen.stdout):
            if stream is not None:
                stream.close()


class Node(Process):
    """A running ``sensor_logger_node``."""

    home: Path
    robot: str

    @property
    def hears_numbers(self) -> bool:
        """Whether its middleware numbers messages: only then is missed known exactly."""
        return 'listening by rmw_fastrtps' in self.log

    @property
    def is_beside(self) -> bool:
        """Whether the robot uses another RMW: messages then arrive over UDP, which may lose large ones."""
        return "(the robot's is " in self.log

    def known(self, count: int) -> int | None:
        """The ledger's value of a number that needs sequence numbers: None without them."""
        return count if self.hears_numbers else None

    def ledger(self) -> Mapping[str, Any]:
        """The output of ``shadowhound-data ledger --json``; it balances at any time."""
        found = ledger.read(self.home / 'spool', self.robot)
        assert ledger.imbalances(found) == []
        return found

    def topic(self, name: str) -> dict[str, Any]:
        """The topic's row of the ledger; empty until it exists."""
        row: dict[str, Any] = self.ledger()['topics'].get(name, {})
        return row

    def received(self, name: str, count: int, seconds: float = WAIT_S) -> None:
        """Wait until that many messages of the topic are durably accounted for."""
        until(
            lambda: self.topic(name).get('received', 0) >= count,
            lambda: f'{count} of {name} received: {self.topic(name)}',
            seconds,
        )

    def settled(self, name: str, count: int, seconds: float = WAIT_S) -> dict[str, Any]:
        """Wait until this many of the topic are received and none is open or pending; its row."""

        def done() -> bool:
            row = self.topic(name)
            return bool(row and row['received'] >= count and not row['open'] and not row['stored_in']['pending'])

        until(done, lambda: f'{count} of {name} delivered: {self.topic(name)}', seconds)
        return self.topic(name)

    def delivered(self, at_least: int = 1, seconds: float = WAIT_S) -> None:
        """Wait until this many objects are delivered and none is pending."""

        def done() -> bool:
            objects = self.ledger()['objects']
            return bool(objects['delivered'] >= at_least and not objects['pending'])

        until(done, lambda: f'{at_least} objects delivered: {self.ledger()["objects"]}', seconds)

    def stop(self, number: int = signal.SIGINT, seconds: float = WAIT_S) -> dict[str, Any]:
        """Stop it, and check that it exits with code 0; its last ledger."""
        self.signal(number)
        assert self.wait(seconds) == 0, self.log
        return self.ledger()


class Publisher(Process):
    """A process with publishers (publisher.py, or cyclone_driver.py), controlled line by line."""

    def create(self, topic: str, type_name: str, *, reliable: bool = True, latched: bool = False, depth: int = 1000) -> None:
        """A publisher named after its topic."""
        self._tell(do='create', topic=topic, type=type_name, reliable=reliable, latched=latched, depth=depth)

    def matched(self, topic: str, count: int = 1) -> None:
        """Wait until it has this many subscriptions."""
        self._tell(do='matched', topic=topic, count=count)

    def listen(self, topic: str, type_name: str, *, reliable: bool = True, depth: int = 1000) -> None:
        """A reader in the same process, of a Cyclone DDS driver."""
        self._tell(do='listen', topic=topic, type=type_name, reliable=reliable, latched=False, depth=depth)

    def count(self, topic: str) -> int:
        """The messages received by its reader."""
        return int(self._tell(do='count', topic=topic))

    def publish(self, topic: str, messages: Iterable[bytes], period_s: float = 0.002) -> None:
        """Publish serialized messages; returns when the last one is sent."""
        self._tell(do='publish', topic=topic, messages=[message.hex() for message in messages], period_s=period_s)

    def again(self, topic: str, message: bytes, count: int, period_s: float) -> None:
        """Publish the same message this many times; returns when the last one is sent."""
        self._tell(do='again', topic=topic, message=message.hex(), count=count, period_s=period_s)

    def begin(self, topic: str, type_name: str, period_s: float, size: int = 0) -> None:
        """Publish numbers from 0 on, as text of that size, evenly until ``halt``."""
        self._tell(do='begin', topic=topic, type=type_name, period_s=period_s, size=size)

    def halt(self, topic: str) -> None:
        self._tell(do='halt', topic=topic)

    def begin_numbered(self, topic: str, name: str, size: int, period_s: float) -> None:
        """Publish Strings with that name and sequence numbers (numbered.py) from now on, in the background."""
        self._tell(do='begin_numbered', topic=topic, name=name, size=size, period_s=period_s)

    def halt_numbered(self, topic: str) -> int:
        """Stop them; returns how many were sent."""
        return int(self._tell(do='halt_numbered', topic=topic))

    def pauses_numbered(self, topic: str, longer_ns: int) -> list[tuple[int, int]]:
        """Pauses longer than that between two of them, wall clock in ns."""
        return [(begin, end) for begin, end in json.loads(self._tell(do='pauses_numbered', topic=topic, longer_ns=longer_ns))]

    def heard(self, topic: str, node: Node, message: bytes) -> None:
        """Publish the message until the node received it, so that whatever follows is published after the match."""
        self.matched(topic)
        before = node.topic(topic).get('received', 0)

        def received() -> bool:
            self.publish(topic, [message], 0.0)
            return bool(node.topic(topic).get('received', 0) > before)

        until(received, f'{topic} is received')

    def destroy(self, topic: str) -> None:
        """Destroy it immediately: wait for messages that must arrive first."""
        self._tell(do='destroy', topic=topic)

    def end(self) -> None:
        """Leave the graph properly, so that others notice immediately; wait for messages that must arrive first."""
        self._tell(do='end')
        assert self.wait() == 0, self.log

    def _tell(self, **order: object) -> str:
        """Send a command; returns its response without ``done``."""
        assert self.popen.stdin is not None
        assert self.popen.stdout is not None
        self.popen.stdin.write(json.dumps(order) + '\n')
        self.popen.stdin.flush()
        answer = self.popen.stdout.readline()
        assert answer.startswith('done'), f'{order["do"]}: {answer}{self.log}'
        return answer.removeprefix('done').strip()


class Processes:
    """All processes that a test starts. ``end`` reaps those still running. Most are ``forked``, which is faster (forking.py)."""

    def __init__(self, folder: Path, domain: int, robot: str, *, forked: bool = False) -> None:
        self.folder, self.robot, self._forked = folder, robot, forked
        self.started: list[Process] = []
        foreign = ('AWS_', 'MLFLOW_', 'SHADOWHOUND_HOME', 'SHADOWHOUND_ROBOT', 'ROS_LOCALHOST_ONLY')
        self.environ = {name: value for name, value in os.environ.items() if not name.startswith(foreign)} | {
            'ROS_DOMAIN_ID': str(domain), **THIS_MACHINE, 'ROS_LOG_DIR': str(folder / 'ros'),
            'RCUTILS_COLORIZED_OUTPUT': '0', 'PYTHONUNBUFFERED': '1',
        }  # fmt: skip

    def node(
        self, store: Mapping[str, str] | None = None, parameters: Mapping[str, Any] | None = None, *arguments: str,
        ready: bool = True, robot: str | None = None, home: str = 'home', environ: Mapping[str, str] | None = None,
        program: Sequence[str] = ('-m', NODE),
    ) -> Node:  # fmt: skip
        """The logger: ``store`` has the environment variables of the store, ``parameters`` are flat ROS names."""
        name = self._name('node')
        file = self.folder / f'{name}.yaml'
        given = {'spool.min_free_bytes': 0, **(parameters or {})}
        file.write_text(json.dumps({'/**': {'ros__parameters': given}}))
        robot = self.robot if robot is None else robot
        own = {'SHADOWHOUND_HOME': str(self.folder / home), 'SHADOWHOUND_ROBOT': robot}
        command = [*program, '--ros-args', '--params-file', str(file), *arguments]
        environ = {**self.environ, **own, **(store or {}), **(environ or {})}
        node = Node(name, command, self.folder / f'{name}.log', environ, forked=self._forked)
        self.started.append(node)
        node.home, node.robot = self.folder / home, robot
        if ready:
            node.await_log('logging ')
        return node

    def sim(self, *parameters: str, namespace: str = '/') -> Process:
        """The simulated Go2; ``published`` has its final counts."""
        given = [word for parameter in parameters for word in ('-p', parameter)]
        name = self._name('sim')
        command = ['-m', SIM, '--ros-args', '-r', f'__ns:={namespace}', *given]
        return self._keep(Process(name, command, self.folder / f'{name}.log', self.environ, forked=self._forked))

    def page(
        self, node: Node, *arguments: str, port: int = 0, program: Sequence[str] = ('-m', COMMANDS),
        environ: Mapping[str, str] | None = None,
    ) -> tuple[Process, str]:  # fmt: skip
        """The live page of this node's data, and its address."""
        name = self._name('live')
        own = {'SHADOWHOUND_HOME': str(node.home), 'SHADOWHOUND_ROBOT': node.robot}
        environ = {**self.environ, **own, **(environ or {})}
        command = [*program, 'live', '--json', '--port', str(port), *arguments]
        page = self._keep(Process(name, command, self.folder / f'{name}.log', environ))
        page.await_log('"problem"')
        text = page.log
        return page, json.loads(text[text.index('{') : text.rindex('}') + 1])['url']

    def witness(self, topics: Mapping[str, str], output: Path, *, best_effort: Iterable[str] = ()) -> Process:
        """A second subscriber that writes everything it receives, unchanged, to a file (witness.py); SIGTERM stops it."""
        order = json.dumps({topic: [type_name, topic not in best_effort] for topic, type_name in topics.items()})
        name = self._name('witness')
        command = [str(HERE / 'witness.py'), str(output), order]
        witness = self._keep(Process(name, command, self.folder / f'{name}.log', self.environ, forked=self._forked))
        witness.await_log('ready')
        return witness

    def publisher(self, *, cyclone: bool = False, environ: Mapping[str, str] | None = None) -> Publisher:
        """A process with publishers, of rclpy or as a robot with Cyclone DDS has them."""
        name = self._name('publisher')
        command = [str(HERE / ('cyclone_driver.py' if cyclone else 'publisher.py'))]
        humble = {'AS_HUMBLE': 'yes'} if os.environ.get('ROS_DISTRO') == 'humble' else {}
        own = {**self.environ, **humble, **(environ or {})}
        if not self._forked or not can_fork(own):
            own['PYTHONPATH'] = os.pathsep.join([str(HERE.parent), *filter(None, [own.get('PYTHONPATH')])])
        process = Publisher(name, command, self.folder / f'{name}.log', own, piped=True, forked=self._forked)
        self.started.append(process)
        return process

    def logs(self) -> list[tuple[str, str]]:
        """Title and end of each log."""
        return [(f'log of {process.name} ({process.popen.poll()})', process.log[-6000:]) for process in self.started]

    def end(self) -> None:
        for process in reversed(self.started):
            process.kill()

    def _keep(self, process: Process) -> Process:
        self.started.append(process)
        return process

    def _name(self, kind: str) -> str:
        return f'{kind}-{len(self.started)}'


def is_accounted(told: int | None, counted: int) -> bool:
    """Whether a ledger includes everything that a robot published, except what it sent before the node discovered it."""
    return told is None or 0 <= counted - told <= UNHEARD


def published(sim: Process, seconds: float = WAIT_S) -> dict[str, int]:
    """Wait for the end of a simulated Go2; topic -> messages, counted by the robot."""
    assert sim.wait(seconds) == 0, sim.log
    line = next(line for line in reversed(sim.log.splitlines()) if line.startswith('{"published"'))
    counts: dict[str, int] = json.loads(line)['published']
    return counts
