"""Which topics a bag holds, or the ring of the events, decided from the settings, the sensors and the graph. Plain Python."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from shadowhound_data_logger.options import BagSettings, EventSettings

_FULL_NAME: Final = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+', re.ASCII)
MAX_NAME: Final = 247
"""rmw/types.h, and https://design.ros2.org/articles/topic_and_service_names.html"""


class Choice:
    """New for each set of settings; ``wanted`` again and again, because sensors and graph change."""

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
        """As rosbag2: any part of the name has to match; hidden topics (a part begins with ``_``) are left out.

        So are names that are none of ROS, which another DDS program may well have: nobody can subscribe to them in ROS.
        """
        assert self._regex is not None
        if '/_' in topic or not _FULL_NAME.fullmatch(topic) or len(topic) > MAX_NAME or not self._regex.search(topic):
            return False
        return self._exclude is None or not self._exclude.search(topic)
