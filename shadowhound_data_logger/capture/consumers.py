"""What every listener to the robot's messages derives from, and what it is handed: all that the intake knows of its listeners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from shadowhound_data_logger.model import Taken
from shadowhound_data_logger.spool.accounts import Losses, TopicAccount

if TYPE_CHECKING:
    from shadowhound_data_logger.capture.extra_topics import TopicChoice


class Drained(NamedTuple):
    """What one drain took of a topic."""

    topic: str
    type: str
    sensor: str
    """The name of the sensor that has the topic; empty where none has."""
    messages: Sequence[Taken]
    """The oldest first, each with its sender where that is known; none came before. Where ``sensor`` is empty, numbered messages
    may be repeats: whoever counts them leaves those out."""
    lost: Losses
    """What is estimated to have been lost before these messages, where they have no numbers; None where nobody knows."""
    now_s: float
    """When they were drained, by the monotonic clock."""
    paused: bool
    """Whether messages are only counted now."""


class Consumer(Protocol):
    """Whoever listens to what the robot publishes: derive from it, and name it in ``Pipeline._make_stages``.

    The intake thread calls all of it, in the order in which messages came, and nothing in it may wait.
    """

    choice: TopicChoice | None = None
    """Which topics it wants; None for those that the sensors have."""
    topics: frozenset[str] = frozenset()
    """With a choice: those that it gets now, by their full names. The intake sets them."""
    from_start: bool = True
    """With a choice: whether it listens as soon as the intake is open, or once ``Intake.listen`` says so."""
    wants_latched: bool = False
    """With a choice: whether it begins with what latched publishers sent before, with subscriptions of its own for that."""

    def enter(self, topic: str, type_name: str, sensor: str) -> None:  # noqa: ARG002
        """Without a choice: messages of a sensor's topic begin here, of this type."""
        return

    def choose(self, drained: Drained, account: TopicAccount) -> None:  # noqa: ARG002
        """Without a choice, before ``take``: count in the topic's account what is not stored.

        The lock of the accounts has been held since the messages were received, so that no commit sees the one without the
        other: nothing but that is done here.
        """
        return

    def take(self, drained: Drained) -> None:
        """Messages of one topic, and the gap before them."""

    def begin(self) -> None:
        """It listens from now on; again without an ``end`` where something new begins for it here."""
        return

    def leave(self, topic: str) -> None:  # noqa: ARG002 - for those who have something to do then
        """The messages of the topic end here; should more come, they are of another type, or another beginning."""
        return

    def tick(self, now_s: float) -> None:  # noqa: ARG002
        """Each round, after the messages: do what is due without one."""
        return

    def flush(self) -> None:
        """Hand on what was gathered, as if no further message came."""
        return
