"""Runs checks concurrently, and does the repairs of ``--fix``: modes of files with keys, missing buckets, stale shared memory.

It always ends in time; checks that hang, crash or do not start are in the results as well.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.doctor.context import to_child
from shadowhound_data_logger.doctor.model import Check, Context, Result, Severity, error
from shadowhound_data_logger.doctor.s3_put import single_requests
from shadowhound_data_logger.ros.port_guard import settle
from shadowhound_data_logger.ros.shared_memory import orphans

TIMEOUT_S: Final = 12.0
"""Including Python's startup, a run on a dead network ends within 15 s."""
CHILD: Final = 'shadowhound_data_logger.doctor.checks'
_Message = tuple[str, 'Result | None']
"""A check's name and one of its results; None marks its end."""


@dataclass(slots=True)
class Running:
    """A check that is running.

    Its thread registers the children that it starts; the runner kills them when it abandons the check.
    """

    check: Check
    until_s: float = 0.0
    given_up: bool = False
    children: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def adopt(self, child: subprocess.Popen[bytes]) -> None:
        self.children.append(child)
        if self.given_up:  # otherwise ``give_up`` will see it
            child.kill()

    def give_up(self) -> None:
        self.given_up = True
        for child in self.children:
            child.kill()


class Examination:
    """Runs the checks side by side, each with a deadline.

    New; ``run`` once, from one thread. A check that misses its deadline is abandoned; its later results are ignored.
    """

    def __init__(
        self,
        checks: Sequence[Check],
        context: Context,
        *,
        timeout_s: float = TIMEOUT_S,
        on_end: Callable[[Check], None] = lambda _: None,
    ) -> None:
        """``on_end`` is called for each check that ended. With a longer ``timeout_s``, each check has more time as well."""
        self._waiting = list(checks)
        self._context = context
        self._timeout_s = timeout_s
        self._patience = max(1.0, timeout_s / TIMEOUT_S)
        self._on_end = on_end
        self._order = [check.name for check in checks]
        self._running: dict[str, Running] = {}
        self._found: dict[str, list[Result]] = {check.name: [] for check in checks}
        self._ended: set[str] = set()
        self._results: queue.Queue[_Message] = queue.Queue()

    def run(self) -> list[Result]:
        """All results, in the order of the checks."""
        end_s = time.monotonic() + self._timeout_s
        while self._running or self._waiting:
            self._start_ready(end_s)
            if self._running:
                self._collect(min(running.until_s for running in self._running.values()))
                self._give_up(time.monotonic())
        return [result for name in self._order for result in self._found[name]]

    def _start_ready(self, end_s: float) -> None:
        for check in list(self._waiting):
            if any(name in self._found and name not in self._ended for name in check.after):
                continue
            self._waiting.remove(check)
            if time.monotonic() >= end_s:
                self._found[check.name].append(Result(check.name, Severity.SKIPPED, 'not run: no time was left'))
                self._ended.add(check.name)
                self._on_end(check)
                continue
            until_s = min(time.monotonic() + self._patience * check.deadline_s, end_s)
            running = self._running[check.name] = Running(check, until_s)
            earlier = {name: tuple(self._found.get(name, ())) for name in check.after}
            context = replace(self._context, earlier=earlier)
            threading.Thread(target=_work, args=(running, context, self._results.put), name=check.name, daemon=True).start()

    def _collect(self, until_s: float) -> None:
        try:
            name, result = self._results.get(timeout=max(0.0, until_s - time.monotonic()))
        except queue.Empty:
            return
        if name not in self._running:
            return
        if result is None:
            self._end(name)
        else:
            self._found[name].append(result)

    def _give_up(self, now_s: float) -> None:
        for name, running in list(self._running.items()):
            if now_s < running.until_s or not self._results.empty():
                continue
            running.give_up()
            self._found[name].append(_timed_out(running.check, min(self._patience * running.check.deadline_s, self._timeout_s)))
            self._end(name)

    def _end(self, name: str) -> None:
        self._ended.add(name)
        self._on_end(self._running.pop(name).check)


def _timed_out(check: Check, limit_s: float) -> Result:
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    cause = (
        'the service it checks hangs'
        if load < cores
        else f'the service it checks hangs, or this machine is too busy (load {load:.0f} on {cores} cores)'
    )
    return error(
        f'{check.name}.deadline',
        f'the check did not end within {limit_s:g} s',
        cause,
        f'shadowhound-data doctor --only {check.name} --timeout {4 * TIMEOUT_S:g}',
    )


def _work(running: Running, context: Context, send: Callable[[_Message], None]) -> None:
    """The thread of one check, with the doctor's only catch-all: a crash is a finding and does not end the other checks."""
    check, began_s = running.check, time.monotonic()
    try:
        for result in in_child(running, context) if check.isolated else check.run(context):
            now_s = time.monotonic()
            send((check.name, replace(result, took_s=result.took_s or round(now_s - began_s, 3))))
            began_s = now_s
    except Exception as problem:  # noqa: BLE001
        send((check.name, crashed(check, f'{type(problem).__name__}: {problem}')))
    finally:
        send((check.name, None))


def crashed(check: Check, how: str) -> Result:
    """The finding that the check itself failed."""
    remedy = f'shadowhound-data doctor --only {check.name} --json, and send us its output'
    return error(f'{check.name}.crash', f'the check failed: {how}', 'a case that the doctor does not handle', remedy)


def in_child(running: Running, context: Context) -> Iterator[Result]:
    """Run the check in a separate process."""
    check = running.check
    with tempfile.TemporaryFile() as log:
        command = [sys.executable, '-m', CHILD, check.name]
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=dict(context.environ))
        running.adopt(child)
        with child:
            assert child.stdin is not None
            assert child.stdout is not None
            child.stdin.write(to_child(context))
            child.stdin.close()
            for line in child.stdout:
                yield Result.from_dict(json.loads(line))
        if child.returncode:
            log.seek(0)
            last = (log.read().decode(errors='replace').strip().splitlines() or ['no output'])[-1]
            yield crashed(check, f'its process ended with {child.returncode}: {last}')


def fix(results: Sequence[Result], context: Context) -> Iterator[tuple[Result, str]]:
    """Yield each result that can be fixed and what was done; on failure the text starts with ``not``."""
    done: set[tuple[str, ...]] = set()
    for result in results:
        if result.fix and result.fix not in done:
            done.add(result.fix)
            yield result, _fixed(result.fix, context)


def _fixed(what: tuple[str, ...], context: Context) -> str:
    kind, name, *rest = what
    try:
        if kind == 'mode':
            Path(name).chmod(int(rest[0], 8))
            return f'chmod {rest[0]} {name}'
        if kind == 'segments':
            freed = orphans(Path(name), free=True)
            return f'freed {sum(each.bytes for each in freed) / 1e6:.0f} MB in {name}'
        if kind == 'ports':
            return f'repaired {", ".join(settle(Path(name))) or "nothing"} in {name}'
        _create(name, context)
    except (OSError, DataLoggerError) as problem:
        return f'not done: {problem}'
    return f'created the bucket {name}'


def _create(bucket: str, context: Context) -> None:
    with single_requests(context.settings.store) as requests:
        requests.create_bucket(bucket)
