"""Publishers that the robot's RMW finds and the node's does not: compares the front's graph with the node's.

This covers discovery only: whether messages of a discovered publisher arrive is another question (``ros`` of the doctor, and the
ledger). It covers the topics of the enabled sensors.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.status import UndiscoveredTopic

log = logging.getLogger(__name__)

SETTLED_S: Final = 30.0
"""How long the front must report a publisher before it counts. A killed publisher stays known for its lease (10 s by default with
Cyclone DDS, 20 s with Fast DDS in ROS), and the two sides drop it at different moments.
"""
SILENT_S: Final = 30.0
"""After a longer silence of the front nothing is known, and counting restarts; it reports every other second, or every 20 s with
very many publishers.
"""
MAX_PUBLISHERS: Final = 8
"""Of one topic, in a report: more of them take no more memory."""
MAX_NODES: Final = 3
MAX_LETTERS: Final = 200
"""Maximum letters of a name in a message."""
REMEDY: Final = (
    "listen through the robot's own RMW (capture.rmw: robot), or have both look in the same networks: interfaces and peers of "
    'CYCLONEDDS_URI, ROS_STATIC_PEERS (docs/thor.md, Middleware)'
)
_Report = Mapping[str, Any]
"""{topic: [[gid, type, node], ...]}, as sent by the front; node is empty if unknown."""


class UndiscoveredPublishers:
    """Publishers that the robot's RMW finds and the node does not.

    New; ``compare`` for each report of the front; ``rows`` at any time. Used by the main thread only.
    """

    def __init__(self, rmw: str, robot: str, topics: Callable[[], Mapping[str, str]], known: Callable[[str], set[str]], *,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``rmw`` and ``robot`` are the RMWs of the node and of the robot.

        ``topics`` are those of the sensors, with the type that the settings name or '', and ``known`` returns the gids of a
        topic's publishers that the node has found.
        """
        self._rmw, self._robot = rmw, robot
        self._topics, self._known = topics, known
        self._monotonic = monotonic
        self._reported_s: float | None = None
        self._since_s: dict[tuple[str, str], float] = {}
        self._rows: dict[str, UndiscoveredTopic] = {}

    def compare(self, report: _Report) -> dict[str, Any]:
        """Process a report of publishers that the node has not found; returns the input for the next one."""
        now_s = self._monotonic()
        if self._reported_s is None or now_s - self._reported_s > SILENT_S:
            self._since_s = {}
        self._reported_s = now_s
        topics = self._topics()
        known = {topic: self._known(topic) for topic in topics}
        found = {topic: _publishers(report.get(topic), type_name, known[topic]) for topic, type_name in topics.items()}
        self._since_s = {(topic, gid): self._since_s.get((topic, gid), now_s) for topic, each in found.items() for gid in each}
        for topic, publishers in found.items():
            settled = {gid: each for gid, each in publishers.items() if now_s - self._since_s[topic, gid] >= SETTLED_S}
            self._settle(topic, settled, now_s)
        for topic in self._rows.keys() - found.keys():
            del self._rows[topic]
        return {'topics': sorted(topics), 'gids': sorted(set().union(*known.values()))}

    def rows(self) -> Mapping[str, UndiscoveredTopic] | None:
        """The topics with such publishers, and a message about each; None without recent reports."""
        if self._reported_s is None or self._monotonic() - self._reported_s > SILENT_S:
            return None
        return self._rows

    def _settle(self, topic: str, publishers: Mapping[str, tuple[str, str]], now_s: float) -> None:
        before = self._rows.pop(topic, None)
        if not publishers:
            if before is not None:
                log.info('%s: %s no longer has a publisher that %s has not found', topic, self._robot, self._rmw)
            return
        nodes = sorted({node for _, node in publishers.values()} - {''})
        seconds = round(now_s - min(self._since_s[topic, gid] for gid in publishers))
        whose = f' (of {", ".join(nodes[:MAX_NODES])}{" and others" if len(nodes) > MAX_NODES else ""})' if nodes else ''
        more = ' or more' if len(publishers) >= MAX_PUBLISHERS else ''
        count, what = (f'{len(publishers)}{more} publishers', 'they send') if len(publishers) > 1 else ('a publisher', 'it sends')
        text = (f'{topic} is not fully received: {self._robot} finds {count}{whose} that {self._rmw}, by which the node listens, '
                f'has not found; what {what} is not logged')  # fmt: skip
        self._rows[topic] = UndiscoveredTopic(len(publishers), tuple(nodes), seconds, text)
        if before is None or len(publishers) > before.publishers:
            log.error('%s, for %d s now: %s', text, seconds, REMEDY)


def _publishers(given: Any, type_name: str, known: set[str]) -> dict[str, tuple[str, str]]:
    """The reported publishers of the logged type that the node has not found since: gid -> type and node."""
    rows = given if isinstance(given, list) else []
    found = {}
    for row in rows:
        if isinstance(row, list) and len(row) == 3 and all(isinstance(word, str) for word in row):
            gid, type_found, node = (printable(word[:MAX_LETTERS]) for word in row)
            if gid not in known and type_name in {'', type_found}:
                found[gid] = type_found, node
    return found
