"""The base class of every listener to the robot's messages, and what it is handed: all that the intake knows of its listeners."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple, Protocol

from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.options import BagSettings, EventSettings
from shadowhound_data_logger.spool.topic_account import Losses, TopicAccount

log = logging.getLogger(__name__)

_FULL_NAME: Final = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+', re.ASCII)
MAX_NAME: Final = 247
"""rmw/types.h, and https://design.ros2.org/articles/topic_and_service_names.html"""


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
    """What is estimated to have been lost before these messages, where they have no numbers; None where it is not known."""
    now_s: float
    """When they were drained, by the monotonic clock."""
    paused: bool
    """Whether messages are only counted now."""


def is_plain_name(topic: str) -> bool:
    """Whether a full name is valid in ROS and not hidden (no part of it begins with ``_``)."""
    return '/_' not in topic and len(topic) <= MAX_NAME and _FULL_NAME.fullmatch(topic) is not None


class TopicChoice:
    """Which topics a consumer wants, by its settings, the sensors and the graph. New for each set of settings."""

    def __init__(self, settings: BagSettings | EventSettings, named: Iterable[str]) -> None:
        """``named`` are the settings' topics as full names."""
        self._named = frozenset(named)
        self._regex = re.compile(settings.regex) if settings.regex else None
        self._exclude = re.compile(settings.exclude) if settings.exclude else None

    @property
    def asks_graph(self) -> bool:
        return self._regex is not None

    def names(self, topic: str) -> bool:
        """Whether the settings name this very topic."""
        return topic in self._named

    def wanted(self, sensors: Iterable[str], graph: Iterable[str]) -> frozenset[str]:
        """Full names; ``sensors`` are the topics that sensors take, ``graph`` all that there are (asked for a regex only)."""
        if self._regex is None:
            return self._named or frozenset(sensors)
        return self._named | {topic for topic in graph if self._matches(topic)}

    def _matches(self, topic: str) -> bool:
        """As rosbag2: any part of the name must match, and hidden topics (a part begins with ``_``) are left out.

        They are not left out if the expression itself has a ``/_``, as ``/_service_event$`` and ``/_action/`` have. Names that
        are not valid in ROS, which other DDS programs may use, always are: nothing in ROS can subscribe to them.
        """
        assert self._regex is not None
        is_hidden = '/_' in topic and '/_' not in self._regex.pattern
        if is_hidden or not _FULL_NAME.fullmatch(topic) or len(topic) > MAX_NAME or not self._regex.search(topic):
            return False
        return self._exclude is None or not self._exclude.search(topic)


class Consumer(Protocol):
    """Whoever listens to what the robot publishes: derive from it, and name it in ``Pipeline._make_stages``.

    The intake thread calls all of it, in the order in which messages came, and nothing in it may wait. One that raises in
    ``choose`` or ``take`` does not get these messages; the others do, and ``failures`` counts it.
    """

    wanted_topics: TopicChoice | None = None
    """Which topics it wants; None for those that the sensors have."""
    topics: frozenset[str] = frozenset()
    """Of these, those that it gets now, by their full names. The intake sets them."""
    from_start: bool = True
    """Whether it listens to these as soon as the intake is open, or once ``Intake.listen`` says so."""
    wants_latched: bool = False
    """Whether it begins with what latched publishers of these sent before, with subscriptions of its own for that."""
    failures: int = 0
    """How often it failed to take messages."""
    last_error: str = ''

    def enter(self, topic: str, type_name: str, sensor: str) -> None:  # noqa: ARG002
        """Of sensors: messages of a sensor's topic begin here, of this type."""
        return

    def choose(self, drained: Drained, account: TopicAccount) -> None:  # noqa: ARG002
        """Of sensors, before ``take``: count in the topic's account what is not stored.

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


def deliver(drained: Drained, consumers: Iterable[Consumer]) -> None:
    """Each of them takes the messages, whatever happens to one."""
    for consumer in consumers:
        try:
            consumer.take(drained)
        except Exception as error:  # noqa: BLE001 - a defect of one is none of the others'
            count_failure(consumer, drained.topic, error)


def count_failure(consumer: Consumer, topic: str, error: Exception) -> None:
    """Count it; the 1st, 10th, 100th, ... is said."""
    consumer.failures += 1
    consumer.last_error = f'{type(error).__name__}: {error}'
    if str(consumer.failures).strip('0') == '1':
        text = '%s failed to take messages of %s (%d times so far); all other consumers get them: %s'
        log.error(text, type(consumer).__name__, topic, consumer.failures, error, exc_info=error)
