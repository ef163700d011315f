"""The node's response to each request, with stages that the test controls."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest
from spool.making import NOON_NS, FakeClock

from shadowhound_data_logger.core.config import KeepSettings
from shadowhound_data_logger.core.dataclass_json import as_plain
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.mailbox import request_id
from shadowhound_data_logger.core.status import MissionStatus, NodeStatus
from shadowhound_data_logger.node.intake.intake import _each
from shadowhound_data_logger.node.reporting.commands import Commands
from shadowhound_data_logger.node.reporting.interface import SWITCHES, TRIGGERS
from shadowhound_data_logger.shipping.requests import RequestServer

STAGES = ['intake', 'encode pool', 'spool writer']


class Stages:
    """All stages: ``asked`` lists the calls in order, ``stuck`` is the stage that does not finish."""

    def __init__(self, stuck: str = '', spooled: tuple[int, int] = (0, 0)) -> None:
        self.asked: list[Any] = []
        self.stuck = stuck
        self.spooled = [(10, 100), (10 + spooled[0], 100 + spooled[1])]
        self.paused = False
        self.intake = self.queue = self.recorder = self.events = self.mission = self.uploader = self
        self.event_buffer = SimpleNamespace(events=self)
        self.writer = Writer(self)
        self.latest: NodeStatus | None = None
        self.earlier: Mapping[str, Any] | None = None
        self.version = '1'
        self.requests: Any = None
        self.recorded: list[tuple[str, str, bool, str]] = []

    def commands(self) -> Commands:
        stages: Any = self
        return Commands(stages, Parameters(), stages, stages, 'thor', '/ns/sensor_logger_node')

    def add(self, who: str, do: str, *, ok: bool, answer: str) -> None:
        self.recorded.append((who, do, ok, answer))

    def does(self, stage: str) -> bool:
        self.asked.append(stage)
        return stage != self.stuck

    def flush(self, _: float) -> bool:
        return self.does('intake')

    def finished(self, _: float) -> bool:
        return self.does('encode pool')

    def pause(self, _: float = 0.0, *, paused: bool) -> Any:
        done = self.does('pause' if paused else 'resume')
        self.paused = paused if done else self.paused
        return done

    def start(self) -> tuple[bool, str]:
        return True, 'bag_1'

    def stop(self) -> tuple[bool, str]:
        return False, 'nothing is recorded'

    def split(self) -> tuple[bool, str]:
        raise OSError('the disk burns')

    def yield_to(self, *given: float) -> None:
        self.asked.append(given)

    def trigger(self, *given: str, who: str) -> tuple[bool, str]:
        self.asked.append((*given, who))
        return True, 'event_1 begins'

    def status(self) -> MissionStatus:
        return MissionStatus('patrol_1')


class Writer:
    """The spool writer."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages

    def written(self) -> tuple[int, int]:
        return self._stages.spooled.pop(0)

    def flush(self, _: float) -> bool:
        return self._stages.does('spool writer')


class Parameters:
    """A parameter interface."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {'camera.rate_hz': 1.0}

    def get(self, names: list[str]) -> dict[str, Any]:
        if 'nope' in names:
            raise DataLoggerError('there is no parameter nope', remedy='there are others')
        return {name: self.values[name] for name in names}

    def set(self, values: Mapping[str, Any]) -> tuple[bool, str]:
        self.values |= values
        return True, 'set'

    def described(self) -> list[dict[str, Any]]:
        return [{'name': name, 'value': value} for name, value in self.values.items()]


def ask(commands: Commands, do: str, **arguments: Any) -> tuple[bool, str]:
    """Whether it succeeded, and the message."""
    answer = commands.answer({'do': do, **arguments})
    assert answer['robot'] == 'thor'
    return answer['ok'], answer['message' if answer['ok'] else 'error']


@pytest.mark.parametrize(
    ('spooled', 'words'),
    [((12, 345), '12 objects with 345 messages spooled'), ((1, 1), '1 object with 1 message spooled'),
     ((0, 0), '0 objects with 0 messages spooled')],
)  # fmt: skip
def test_a_flush_follows_the_data_flow(spooled: tuple[int, int], words: str) -> None:
    """First the open batches, then the queue, then the disk; the response has what became durable in between."""
    stages = Stages(spooled=spooled)
    assert ask(stages.commands(), 'flush') == (True, words)
    assert stages.asked == STAGES


@pytest.mark.parametrize('stuck', STAGES)
def test_an_incomplete_flush_names_its_stage(stuck: str) -> None:
    """It is not a success, the stage is named, and later ones are not waited for."""
    stages = Stages(stuck)
    success, words = ask(stages.commands(), 'flush')
    assert (success, stages.asked[-1]) == (False, stuck)
    assert f'the {stuck} did not finish within 5 s' in words


def test_a_pause_spools_what_is_open() -> None:
    """Messages before the pause are made durable, and the response reports it; pausing twice is the same as once."""
    stages = Stages(spooled=(2, 30))
    commands = stages.commands()
    success, words = ask(commands, 'pause')
    assert success
    assert 'delivery continues' in words
    assert '2 objects with 30 messages spooled' in words
    assert stages.asked == ['pause', *STAGES]
    assert ask(commands, 'pause') == (True, 'paused already')


def test_a_pause_on_a_slow_disk_is_a_pause() -> None:
    """It is active once the intake has applied it, and the response has what is not durable yet."""
    stages = Stages('spool writer')
    success, words = ask(stages.commands(), 'pause')
    assert (success, stages.paused) == (True, True)
    assert 'the spool writer did not finish' in words


@pytest.mark.parametrize('paused', [True, False])
def test_a_hung_intake_neither_pauses_nor_resumes(*, paused: bool) -> None:
    """It is not a success, and the state is unchanged."""
    stages = Stages('pause' if paused else 'resume')
    stages.paused = not paused
    success, words = ask(stages.commands(), 'pause' if paused else 'resume')
    assert (success, stages.paused) == (False, not paused)
    assert 'the intake did not do it' in words


def test_a_pause_ends() -> None:
    """Messages are stored again, without another flush; resuming without a pause is not a failure."""
    stages = Stages()
    stages.paused = True
    commands = stages.commands()
    assert ask(commands, 'resume') == (True, 'messages are stored again')
    assert stages.asked == ['resume']
    assert ask(commands, 'resume') == (True, 'not paused')


def test_a_failing_source_does_not_stop_the_others() -> None:
    """All steps of a round run in order, and the failure is raised at the end."""
    done: list[int] = []

    def step(number: int) -> None:
        done.append(number)
        if number == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _each([lambda number=number: step(number) for number in range(3)])  # type: ignore[misc]
    assert done == [0, 1, 2]


def test_each_service_has_a_command() -> None:
    """No service responds with an error about its own request."""
    commands = Stages().commands()
    known = commands.answer({'do': 'describe'})['commands']
    requests = [*TRIGGERS.values(), *(request for pair in SWITCHES.values() for request in pair)]
    assert {request['do'] for request in requests} <= set(known)
    for request in requests:
        assert 'takes' not in commands.answer(request).get('error', '')


@pytest.mark.parametrize(
    ('request_', 'words'),
    [
        ({}, '"do" is one of flush, pause'),
        ({'do': 'dance'}, "it is 'dance'"),
        ({'do': ['flush']}, '"do" is one of'),
        ({'do': 'x' * 10_000}, '"do" is one of'),
        ({'do': 'flush', 'hard': True}, "flush takes nothing else, and no 'hard'"),
        ({'do': 'event', 'name': 5}, "name of event is a string, not '5'"),
        ({'do': 'event', 'name': ''}, '1 to 100 letters'),
        ({'do': 'event', 'name': 'x' * 101}, '1 to 100 letters'),
        ({'do': 'event', 'note': 'x' * 1001}, 'up to 1000'),
        ({'do': 'event', 'by': 'condition'}, 'command or service'),
        ({'do': 'set'}, 'set takes values'),
        ({'do': 'set', 'values': [1]}, 'values of set is an object'),
        ({'do': 'get', 'names': [1]}, 'names of get are strings'),
        ({'do': 'get', 'names': ['nope']}, 'there is no parameter nope (there are others)'),
        ({'do': 'bag stop'}, 'nothing is recorded'),
        ({'do': 'status'}, 'there is no status yet'),
        ({'do': 'diagnostics'}, 'there is no status yet'),
    ],
)
def test_an_impossible_request_is_answered(request_: Mapping[str, Any], words: str) -> None:
    """It gives a brief reason, and nothing is done."""
    stages = Stages()
    answer = stages.commands().answer(request_)
    assert (answer['ok'], answer['robot'], stages.asked) == (False, 'thor', [])
    assert words in answer['error']
    assert len(answer['error']) < 500


def test_a_defect_in_a_command_is_answered(caplog: pytest.LogCaptureFixture) -> None:
    """The node continues; the log has the traceback."""
    done, words = ask(Stages().commands(), 'bag split')
    assert (done, words) == (False, 'it failed because of a bug in this program: OSError: the disk burns')
    assert caplog.records[-1].exc_info


def test_an_event_has_a_name_and_a_note() -> None:
    """Both are in its manifest, with the requester; an event from a service has neither."""
    stages = Stages()
    commands = stages.commands()
    assert ask(commands, 'event', name='fall', note='on the stairs') == (True, 'event_1 begins')
    commands.answer(TRIGGERS['~/event/trigger'])
    assert stages.asked == [('fall', 'command', 'on the stairs', ''), ('manual', 'service', '', '')]


def test_read_only_commands() -> None:
    """Parameters, the active mission, the last status, and itself."""
    stages = Stages()
    commands = stages.commands()
    stages.latest = NodeStatus(robot='thor')
    assert commands.answer({'do': 'status'})['status'] == as_plain(stages.latest)
    assert commands.answer({'do': 'mission'})['mission']['mission_id'] == 'patrol_1'
    assert ask(commands, 'set', values={'camera.rate_hz': 5}) == (True, 'set')
    assert commands.answer({'do': 'get', 'names': ['camera.rate_hz']})['values'] == {'camera.rate_hz': 5}
    assert commands.answer({'do': 'parameters'})['parameters'] == [{'name': 'camera.rate_hz', 'value': 5}]
    assert commands.answer({'do': 'describe'})['node'] == '/ns/sensor_logger_node'


def test_commands_that_change_something_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    """A failure is a warning; read-only commands are not logged."""
    caplog.set_level(logging.INFO)
    commands = Stages().commands()
    for do in ('flush', 'bag stop', 'parameters', 'describe', 'mission'):
        commands.answer({'do': do})
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ('INFO', 'flush: 0 objects with 0 messages spooled'),
        ('WARNING', 'bag stop: nothing is recorded'),
    ]


def test_named_requests_are_recorded() -> None:
    """With the node's response, whatever it was; requests without a name are not."""
    stages = Stages()
    commands = stages.commands()
    for do in ('bag start', 'bag stop', 'bag split', 'event', 'nothing'):
        commands.answer({'do': do, 'who': 'operator at 10.0.0.7'})
    ask(commands, 'resume')
    ask(commands, 'yield', max_mbps=1.0)
    assert {who for who, *_ in stages.recorded} == {'operator at 10.0.0.7'}
    assert [(do, ok) for _, do, ok, _ in stages.recorded] == [
        ('bag start', True), ('bag stop', False), ('bag split', False), ('event', True), ('nothing', False),
    ]  # fmt: skip
    assert stages.recorded[1][3] == 'nothing is recorded'


def test_the_requester_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """Also if a success is not logged otherwise, and it is passed on to the event; with any content it stays one line."""
    caplog.set_level(logging.INFO)
    stages = Stages()
    assert ask(stages.commands(), 'event', name='fall', by='page', who='operator at 10.0.0.7') == (True, 'event_1 begins')
    assert ask(stages.commands(), 'bag stop', who='a\nb' * 1000)[0] is False
    assert stages.asked == [('fall', 'page', '', 'operator at 10.0.0.7')]
    first, second = (record.getMessage() for record in caplog.records)
    assert first == 'operator at 10.0.0.7: event: event_1 begins'
    assert '\n' not in second
    assert len(second) < 200


def test_uploads_yield_for_some_seconds(caplog: pytest.LogCaptureFixture) -> None:
    """The client repeats its request; not every repeat is logged."""
    caplog.set_level(logging.INFO)
    stages = Stages()
    assert ask(stages.commands(), 'yield', max_mbps=2.0) == (True, 'uploads send at most 2 Mbit/s for 5 s')
    assert stages.asked == [(2.0, 5.0)]
    assert not caplog.records
    for wrong in (0.0, -1.0, float('inf'), float('nan')):
        assert ask(stages.commands(), 'yield', max_mbps=wrong)[0] is False
    assert ask(stages.commands(), 'yield', max_mbps=2)[0] is False
    assert ask(stages.commands(), 'yield')[0] is False


def test_a_pull_requests_kept_data() -> None:
    """The response has the id of the request; invalid requests are refused, and all are if nothing is kept."""
    stages = Stages()
    assert ask(stages.commands(), 'pull', want={'sensor': 'camera'}) == (
        False, 'no data is kept here: ship of all sensors and of bag is always'
    )  # fmt: skip
    spool: Any = None
    stages.requests = RequestServer(spool, spool, KeepSettings(), 'thor', FakeClock(), put=spool, released=spool, cutter=spool)
    want = {'sensor': 'camera', 'since_ns': NOON_NS}
    commands = stages.commands()
    name = request_id('thor', want)
    assert commands.answer({'do': 'pull', 'want': want, 'by': 'x'}) == {'ok': True, 'robot': 'thor', 'id': name}
    for wrong in ({}, {'want': {}}, {'want': {'sensor': 5}}, {'want': want, 'by': '../x'}, {'cancel': '../x'}):
        assert ask(commands, 'pull', **wrong)[0] is False
