"""Publishers that the robot's own RMW finds and the node's does not: the front's graph, compared with that of the node.

What is known is who was discovered, no more: whether messages of a publisher that both have found arrive is another question
(``ros`` of the doctor, and the ledger). It is about the topics of the sensors that are enabled.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.status import UnheardTopic

log = logging.getLogger(__name__)

SETTLED_S: Final = 30.0
"""For how long the front must report a publisher before it is called unheard. One that was killed stays known for its lease (10 s
by default with Cyclone DDS, 20 s with Fast DDS as ROS has it), and the two sides forget it at different moments."""
SILENT_S: Final = 30.0
"""After a longer silence of the front nothing is known, and what is reported then starts again; it reports every other second, or
every 20 s in a crowd of publishers."""
MAX_PUBLISHERS: Final = 8
"""Of a topic, in a report: a crowd of them costs no more."""
MAX_NODES: Final = 3
MAX_LETTERS: Final = 200
"""Of a name, in what is said."""
REMEDY: Final = (
    "listen through the robot's own RMW (capture.rmw: robot), or have both look in the same networks: interfaces and peers of "
    'CYCLONEDDS_URI, ROS_STATIC_PEERS (docs/thor.md, Middleware)'
)
_Report = Mapping[str, Any]
"""{topic: [[gid, type, node], ...]}, as far as it is what the front sends; node is empty where it is not known."""


class Unheard:
    """Publishers that the robot's RMW finds and the node does not.

    New; ``compare`` whenever the front reports; ``rows`` at any time. Used by the main thread alone.
    """

    def __init__(self, rmw: str, robot: str, topics: Callable[[], Mapping[str, str]], known: Callable[[str], set[str]], *,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``rmw`` and ``robot`` are the RMWs of the node and of the robot.

        ``topics`` are those to be heard, with the type that the settings name or nothing, and ``known`` tells the gids of
        the publishers of one that the node itself has found.
        """
        self._rmw, self._robot = rmw, robot
        self._topics, self._known = topics, known
        self._monotonic = monotonic
        self._reported_s: float | None = None
        self._since_s: dict[tuple[str, str], float] = {}
        self._rows: dict[str, UnheardTopic] = {}

    def compare(self, report: _Report) -> dict[str, Any]:
        """Take a report of the publishers that the front finds beyond those told to it; what it needs to make the next one."""
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

    def rows(self) -> Mapping[str, UnheardTopic] | None:
        """The topics with such publishers, and what is to be said of each; None while nobody compares."""
        if self._reported_s is None or self._monotonic() - self._reported_s > SILENT_S:
            return None
        return self._rows

    def _settle(self, topic: str, publishers: Mapping[str, tuple[str, str]], now_s: float) -> None:
        before = self._rows.pop(topic, None)
        if not publishers:
            if before is not None:
                log.info('%s: %s no longer knows a publisher that %s has not found', topic, self._robot, self._rmw)
            return
        nodes = sorted({node for _, node in publishers.values()} - {''})
        seconds = round(now_s - min(self._since_s[topic, gid] for gid in publishers))
        whose = f' (of {", ".join(nodes[:MAX_NODES])}{" and others" if len(nodes) > MAX_NODES else ""})' if nodes else ''
        more = ' or more' if len(publishers) >= MAX_PUBLISHERS else ''
        count, what = (f'{len(publishers)}{more} publishers', 'they send') if len(publishers) > 1 else ('a publisher', 'it sends')
        text = (f'{topic} is not all heard: {self._robot} finds {count}{whose} that {self._rmw}, by which the node listens, '
                f'has not found; what {what} is not logged')  # fmt: skip
        self._rows[topic] = UnheardTopic(len(publishers), tuple(nodes), seconds, text)
        if before is None or len(publishers) > before.publishers:
            log.error('%s, for %d s now: %s', text, seconds, REMEDY)


def _publishers(given: Any, type_name: str, known: set[str]) -> dict[str, tuple[str, str]]:
    """By gid, type and node of those that are reported, of the type that is logged, and that we have not found meanwhile."""
    rows = given if isinstance(given, list) else []
    found = {}
    for row in rows:
        if isinstance(row, list) and len(row) == 3 and all(isinstance(word, str) for word in row):
            gid, type_found, node = (printable(word[:MAX_LETTERS]) for word in row)
            if gid not in known and type_name in {'', type_found}:
                found[gid] = type_found, node
    return found
