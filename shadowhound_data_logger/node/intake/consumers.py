"""The interface of consumers of the robot's messages. The intake knows its consumers only through it."""

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
    """The messages of a topic from one drain."""

    topic: str
    type: str
    sensor: str
    """The sensor of the topic; empty if it has none."""
    messages: Sequence[Taken]
    """The oldest first, each with its publisher if known; no repeats. If ``sensor`` is empty, numbered messages may be repeats: a
    consumer that counts them must skip those.
    """
    lost: Losses
    """Estimated losses before these messages, if they have no sequence numbers; None if unknown."""
    now_s: float
    """Time of the drain, by the monotonic clock."""
    paused: bool
    """Whether messages are only counted at present."""


def is_plain_name(topic: str) -> bool:
    """Whether a full name is valid in ROS and not hidden (no part starts with ``_``)."""
    return '/_' not in topic and len(topic) <= MAX_NAME and _FULL_NAME.fullmatch(topic) is not None


class TopicChoice:
    """Selects the topics of a consumer from its settings, the sensors and the graph. New for each set of settings."""

    def __init__(self, settings: BagSettings | EventSettings, named: Iterable[str]) -> None:
        """``named`` are the settings' topics as full names."""
        self._named = frozenset(named)
        self._regex = re.compile(settings.regex) if settings.regex else None
        self._exclude = re.compile(settings.exclude) if settings.exclude else None

    @property
    def needs_graph(self) -> bool:
        return self._regex is not None

    def names(self, topic: str) -> bool:
        """Whether the settings name this topic."""
        return topic in self._named

    def wanted(self, sensors: Iterable[str], graph: Iterable[str]) -> frozenset[str]:
        """Full names; ``sensors`` are the topics of the sensors, ``graph`` all topics (needed only for a regex)."""
        if self._regex is None:
            return self._named or frozenset(sensors)
        return self._named | {topic for topic in graph if self._matches(topic)}

    def _matches(self, topic: str) -> bool:
        """As rosbag2: a match anywhere in the name counts, and hidden topics (a part starts with ``_``) are skipped.

        They are not skipped if the expression itself contains ``/_``, as in ``/_service_event$`` and ``/_action/``. Names that
        are invalid in ROS, which other DDS programs may use, are always skipped: ROS cannot subscribe to them.
        """
        assert self._regex is not None
        is_hidden = '/_' in topic and '/_' not in self._regex.pattern
        if is_hidden or not _FULL_NAME.fullmatch(topic) or len(topic) > MAX_NAME or not self._regex.search(topic):
            return False
        return self._exclude is None or not self._exclude.search(topic)


class Consumer(Protocol):
    """A consumer of messages: derive from it, and add it in ``Pipeline._make_stages``.

    The intake thread makes all calls, in the order of the messages, and no call may block. If ``choose`` or ``take`` raises, only
    this consumer misses these messages, and ``failures`` counts it.
    """

    wanted_topics: TopicChoice | None = None
    """The topics it wants; None for those of the sensors."""
    topics: frozenset[str] = frozenset()
    """The wanted topics that it receives at present, as full names. Set by the intake."""
    from_start: bool = True
    """Whether it receives them as soon as the intake is open, or only after ``Intake.listen``."""
    wants_latched: bool = False
    """Whether it starts with what latched publishers sent before, through separate subscriptions."""
    left_out: int = 0
    """Number of topics that match its expression but are skipped, because there are too many. Set by the intake."""
    failures: int = 0
    """Number of failures to take messages."""
    last_error: str = ''

    def enter(self, topic: str, type_name: str, sensor: str) -> None:  # noqa: ARG002
        """For sensors: messages of a sensor's topic start here, with this type."""
        return

    def choose(self, drained: Drained, account: TopicAccount) -> None:  # noqa: ARG002
        """For sensors, before ``take``: count in the topic's account what is not stored.

        The lock of the accounts has been held since the messages were received, so that a commit sees both or neither. Do nothing
        else here.
        """
        return

    def take(self, drained: Drained) -> None:
        """Receive messages of one topic, and the gap before them."""

    def begin(self) -> None:
        """The consumer receives messages from now on. Called again without an ``end`` if something new starts."""
        return

    def leave(self, topic: str) -> None:  # noqa: ARG002 - for those who have something to do then
        """No more messages of the topic; later ones have another type or belong to another start."""
        return

    def tick(self, now_s: float) -> None:  # noqa: ARG002
        """Called each round, after the messages: do what is due without one."""
        return

    def flush(self) -> None:
        """Pass on gathered messages, as if no more would arrive."""
        return


def deliver(drained: Drained, consumers: Iterable[Consumer]) -> None:
    """Pass the messages to each consumer, even if one fails."""
    for consumer in consumers:
        try:
            consumer.take(drained)
        except Exception as error:  # noqa: BLE001 - a bug in one must not affect the others
            count_failure(consumer, drained.topic, error)


def count_failure(consumer: Consumer, topic: str, error: Exception) -> None:
    """Count a failure; log the 1st, 10th, 100th, ..."""
    consumer.failures += 1
    consumer.last_error = f'{type(error).__name__}: {error}'
    if str(consumer.failures).strip('0') == '1':
        text = '%s failed to take messages of %s (%d times so far); all other consumers receive them: %s'
        log.error(text, type(consumer).__name__, topic, consumer.failures, error, exc_info=error)
