"""The runner: checks that hang, crash or are not reached are in the result, which arrives before the deadline."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Iterator

import pytest
from doctor.scene import Scene

from shadowhound_data_logger.doctor import checks
from shadowhound_data_logger.doctor.model import Check, Context, Result, Role, Severity, error, ok
from shadowhound_data_logger.doctor.run import Examination, Running, in_child

LIMIT_S = 0.3


def fine(_: Context) -> Iterator[Result]:
    yield ok('fine.one', 'it is')


def crashing(_: Context) -> Iterator[Result]:
    yield ok('crashing.one', 'so far')
    raise ZeroDivisionError('no number')


def run(scene: Scene, *wanted: Check, timeout_s: float = 60.0) -> list[Result]:
    return Examination(wanted, scene.context(), timeout_s=timeout_s).run()


def test_a_crash_is_a_finding_and_stops_no_other_check(scene: Scene) -> None:
    """The earlier results of the check, and those of the others, are there as well."""
    found = run(scene, Check(name='crashing', run=crashing), Check(name='fine', run=fine))
    assert [result.check for result in found] == ['crashing.one', 'crashing.crash', 'fine.one']
    assert 'ZeroDivisionError: no number' in found[1].seen
    assert found[1].severity is Severity.ERROR


def test_a_hung_check_is_a_finding_at_its_deadline(scene: Scene) -> None:
    """Also if no time is left for later checks, which is reported."""
    over = threading.Event()

    def hangs(_: Context) -> Iterator[Result]:
        yield ok('hangs.one', 'so far')
        over.wait(120.0)
        yield ok('hangs.two', 'too late')

    began = time.monotonic()
    found = run(scene, Check(name='hangs', run=hangs), Check(name='fine', run=fine, after=('hangs',)), timeout_s=LIMIT_S)
    took = time.monotonic() - began
    over.set()
    assert [result.check for result in found] == ['hangs.one', 'hangs.deadline', 'fine']
    assert found[2].severity is Severity.SKIPPED
    assert took < 60.0
    assert '--only hangs' in found[1].remedy


def test_a_check_with_its_own_deadline_leaves_time_for_the_others(scene: Scene) -> None:
    """A check that hangs leaves the rest of the time to what comes after it."""
    over = threading.Event()
    hangs = Check(name='hangs', run=lambda _: iter([ok('hangs.one', str(over.wait(120.0)))]), deadline_s=LIMIT_S)
    found = run(scene, hangs, Check(name='fine', run=fine, after=('hangs',)), timeout_s=60.0)
    over.set()
    assert [result.check for result in found] == ['hangs.deadline', 'fine.one']


def test_a_check_sees_the_results_of_earlier_checks(scene: Scene) -> None:
    """Later checks wait for it."""
    seen: list[Result | None] = []

    def later(context: Context) -> Iterator[Result]:
        seen.append(context.failed('first'))
        yield ok('later', 'asked')

    broken = error('first.part', 'broken', 'so', 'mend it')
    first = Check(name='first', run=lambda _: iter([ok('first.begin', 'fine'), broken]))
    assert len(run(scene, Check(name='later', run=later, after=('first', 'not asked')), first)) == 3
    assert seen
    assert seen[0]
    assert seen[0].check == 'first.part'


def test_checks_run_side_by_side(scene: Scene) -> None:
    """Two that wait for each other both finish."""
    meeting = threading.Barrier(2, timeout=60.0)
    wait = [Check(name=name, run=lambda _: iter([ok('met', str(meeting.wait()))])) for name in ('a', 'b')]
    assert sorted(result.check for result in run(scene, *wait)) == ['met', 'met']


def test_a_crashed_process_is_a_finding(scene: Scene) -> None:
    """With its last output: here, that there is no such check."""
    (found,) = in_child(Running(Check(name='nothing', run=fine)), scene.context())
    assert found.check == 'nothing.crash'
    assert 'StopIteration' in found.seen


def test_a_process_that_hangs_is_killed(scene: Scene) -> None:
    """Whether it was running or about to start at the deadline."""
    running = Running(Check(name='hangs', run=fine))
    children = [subprocess.Popen(['sleep', '60']) for _ in range(2)]
    running.adopt(children[0])
    running.give_up()
    running.adopt(children[1])
    assert [child.wait(60.0) for child in children] == [-9, -9]


@pytest.mark.parametrize('role', Role)
def test_every_role_has_its_checks(role: Role) -> None:
    """Names are unique, and the prerequisites of a check exist for all its roles."""
    mine = {check.name: check for check in checks.CHECKS if role in check.roles}
    assert len(mine) >= 6
    assert len({check.name for check in checks.CHECKS}) == len(checks.CHECKS)
    assert all(name in mine for check in mine.values() for name in check.after)


def test_without_a_network_the_examination_ends_in_time(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing responds, not even the DNS server: it ends before the limit, each service is named, and other checks run."""
    over = threading.Event()

    def resolve(*_: object, **__: object) -> list[object]:
        over.wait(120.0)
        raise OSError('no answer')

    monkeypatch.setattr('socket.getaddrinfo', resolve)
    scene.environ |= {'AWS_ENDPOINT_URL': 'http://tower:9000', 'MLFLOW_TRACKING_URI': 'http://tower:5001',
                      'AWS_ACCESS_KEY_ID': 'a', 'AWS_SECRET_ACCESS_KEY': 'b'}  # fmt: skip
    wanted = [check for check in checks.CHECKS if not check.isolated]
    began = time.monotonic()
    found = Examination(wanted, scene.context()).run()
    took = time.monotonic() - began
    over.set()
    assert took < 60.0
    fields = {result.check: result.severity for result in found}
    assert fields['network.s3.deadline'] == fields['network.mlflow.deadline'] == Severity.ERROR
    assert fields['s3'] == fields['mlflow'] == Severity.SKIPPED
    assert fields['node.running'] == Severity.WARNING
