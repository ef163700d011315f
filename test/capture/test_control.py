"""What ``~/flush`` and ``~/pause`` do and answer, with stages that do as they are told."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip('rclpy')

from shadowhound_data_logger.capture.control import Control
from shadowhound_data_logger.capture.intake import _each

STAGES = ['intake', 'encode pool', 'spool writer']


class Stages:
    """All three stages: ``asked`` is what was asked of them in order, ``stuck`` the one that does not finish."""

    def __init__(self, stuck: str = '', spooled: tuple[int, int] = (0, 0)) -> None:
        self.asked: list[str] = []
        self.stuck = stuck
        self.spooled = [(10, 100), (10 + spooled[0], 100 + spooled[1])]
        self.paused = False

    def control(self) -> Control:
        stage: Any = self
        writer: Any = Writer(self)
        return Control(stage, stage, stage, writer)

    def does(self, stage: str) -> bool:
        self.asked.append(stage)
        return stage != self.stuck

    def flush(self, _: float) -> bool:
        return self.does('intake')

    def finished(self, _: float) -> bool:
        return self.does('encode pool')

    def pause(self, _: float, *, paused: bool) -> bool:
        done = self.does('pause' if paused else 'resume')
        self.paused = paused if done else self.paused
        return done


class Writer:
    """The spool writer among them."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages

    def written(self) -> tuple[int, int]:
        return self._stages.spooled.pop(0)

    def flush(self, _: float) -> bool:
        return self._stages.does('spool writer')


@pytest.mark.parametrize(
    ('spooled', 'words'),
    [((12, 345), '12 objects with 345 messages spooled'), ((1, 1), '1 object with 1 message spooled'),
     ((0, 0), '0 objects with 0 messages spooled')],
)  # fmt: skip
def test_a_flush_goes_along_the_way_of_the_data(spooled: tuple[int, int], words: str) -> None:
    """First the open batches, then the queue, then the disk; the answer says what became durable meanwhile."""
    stages = Stages(spooled=spooled)
    assert stages.control().flush() == (True, words)
    assert stages.asked == STAGES


@pytest.mark.parametrize('stuck', STAGES)
def test_a_flush_that_does_not_finish_says_where(stuck: str) -> None:
    """It is no success, the stage is named, and those after it are not waited for."""
    stages = Stages(stuck)
    success, words = stages.control().flush()
    assert (success, stages.asked[-1]) == (False, stuck)
    assert f'the {stuck} did not finish within 5 s' in words


def test_a_pause_spools_what_is_open() -> None:
    """What came before the pause is made durable, and the answer tells it; twice is once."""
    stages = Stages(spooled=(2, 30))
    control = stages.control()
    success, words = control.pause(paused=True)
    assert success
    assert 'delivery goes on' in words
    assert '2 objects with 30 messages spooled' in words
    assert stages.asked == ['pause', *STAGES]
    assert control.pause(paused=True) == (True, 'paused already')


def test_a_pause_on_a_slow_disk_is_a_pause() -> None:
    """It is in force once the intake has it, and the answer says what is not durable yet."""
    stages = Stages('spool writer')
    success, words = stages.control().pause(paused=True)
    assert (success, stages.paused) == (True, True)
    assert 'the spool writer did not finish' in words


@pytest.mark.parametrize('paused', [True, False])
def test_an_intake_that_hangs_neither_pauses_nor_resumes(*, paused: bool) -> None:
    """It is no success, and the state stays what it was."""
    stages = Stages('pause' if paused else 'resume')
    stages.paused = not paused
    success, words = stages.control().pause(paused=paused)
    assert (success, stages.paused) == (False, not paused)
    assert 'the intake did not do it' in words


def test_a_pause_ends() -> None:
    """Messages are stored again, without another flush; ending none is no failure."""
    stages = Stages()
    stages.paused = True
    control = stages.control()
    assert control.pause(paused=False) == (True, 'messages are stored again')
    assert stages.asked == ['resume']
    assert control.pause(paused=False) == (True, 'not paused')


def test_one_source_that_fails_does_not_stop_the_others() -> None:
    """All steps of a round are done in their order, and the failure is raised in the end."""
    done: list[int] = []

    def step(number: int) -> None:
        done.append(number)
        if number == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _each([lambda number=number: step(number) for number in range(3)])  # type: ignore[misc]
    assert done == [0, 1, 2]
