"""Objects that a robot keeps until requested, and the requests: from its spool, or from the catalog and its mailbox.

On the robot the index of its spool has both, and requests are sent to the node. On another machine they are in the store, where
this machine must be allowed to replace the mailbox.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import LakeError, SpoolError
from shadowhound_data_logger.core.mailbox import KeptFilter, Offer, RequestAnswer, offer
from shadowhound_data_logger.core.model import ON_ROBOT, State
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.spool.control import connect
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.status import read as read_status
from shadowhound_data_logger.stores import open_store

MAX_REQUESTS: Final = 20
"""The number of newest requests that are shown."""
FRESH_S: Final = 10.0
"""How long data from the store is cached."""
PACE_S: Final = 60.0
"""The same for a robot's throughput."""
MAX_SLICE_NS: Final = 3600 * SECOND
"""A slice that starts this long before a time may have messages of it."""


@dataclass(frozen=True, slots=True)
class KeptRequest:
    """A request, as shown on the page."""

    id: str
    by: str
    state: str
    why: str
    want: Mapping[str, Any]
    """The ``KeptFilter``."""
    objects: int
    bytes: int
    sent: int
    """Objects that the store has."""
    sent_bytes: int


class KeptSource(Protocol):
    """The page's source of kept objects and requests."""

    is_recorded: bool
    """Whether kept objects are included in the recorded runs (``live/past.py``)."""

    def rows(self, robot: str, begin_ns: int, end_ns: int) -> list[Mapping[str, Any]]:
        """Objects that are kept or lost, with the part in this time: columns of ``formats.rows.catalog.KEPT``."""

    def mbps(self, robot: str) -> float | None:
        """The robot's upload throughput; None if unknown."""

    def requests(self, robot: str) -> list[KeptRequest]:
        """The newest requests, oldest first."""

    def ask(self, robot: str, want: KeptFilter, by: str) -> str:
        """Send a request; returns its id."""

    def cancel(self, robot: str, request: str, by: str) -> None: ...


def offers(source: KeptSource, robot: str, begin_ns: int, end_ns: int) -> dict[str, Offer]:
    """Sensor -> what a request for this time would get."""
    want, mbps = KeptFilter(since_ns=begin_ns, until_ns=end_ns), source.mbps(robot)
    of: dict[str, list[Mapping[str, Any]]] = {}
    for row in source.rows(robot, begin_ns, end_ns):
        of.setdefault(row['sensor'] or '', []).append(row)
    return {sensor: offer(replace(want, sensor=sensor), rows, mbps) for sensor, rows in sorted(of.items()) if sensor}


class SpoolKept:
    """One robot, from the index of its spool; requests are sent to its node."""

    is_recorded = True

    def __init__(self, spool: Path, robot: str) -> None:
        self._spool, self._robot = spool, robot

    def rows(self, robot: str, begin_ns: int, end_ns: int) -> list[Mapping[str, Any]]:
        """Kept objects. Raises SpoolError."""
        want = KeptFilter(since_ns=begin_ns, until_ns=end_ns)
        found = self._read(lambda index: list(index.overview.recorded(robot, begin_ns - MAX_SLICE_NS, end_ns, state=State.KEPT)))
        return [
            {'key': key, 'sensor': sensor, 'topic': topic, 'bytes': size, 't_start_ns': start_ns, 't_end_ns': last_ns,
             'received_start_ns': received_ns, 'received_end_ns': received_end_ns, 'where': ON_ROBOT}
            for _, key, _, _, sensor, topic, _, size, start_ns, last_ns, received_ns, received_end_ns, *_ in found
            if want.matches(key, sensor, topic, start_ns, last_ns, {})
        ]  # fmt: skip

    def mbps(self, robot: str) -> float | None:
        return read_status(self._spool, robot, SystemClock.of_this_machine()).node.requests.mbps

    def requests(self, robot: str) -> list[KeptRequest]:
        """Raises SpoolError."""
        return self._read(_read_requests) if robot == self._robot else []

    def ask(self, robot: str, want: KeptFilter, by: str) -> str:
        """Raises NodeUnavailable, LakeError."""
        return str(self._request(robot, want=want.to_json(), by=by)['id'])

    def cancel(self, robot: str, request: str, by: str) -> None:
        """Raises NodeUnavailable, LakeError."""
        self._request(robot, cancel=request, by=by)

    def _request(self, robot: str, **arguments: Any) -> dict[str, Any]:
        with closing(connect(self._spool, robot)) as connection:
            answer = connection.ask('pull', **arguments)
        if not answer['ok']:
            raise LakeError(str(answer.get('error')))
        return answer

    def _read(self, read: Callable[[Index], _Answer]) -> _Answer:
        index = Index(self._spool / 'index.db', read_only=True)
        try:
            index.open()
            with closing(index):
                return read(index)
        except sqlite3.Error as error:
            raise SpoolError(f'the index of {self._spool} cannot be read: {error}') from error


class StoreKept:
    """All robots in the store that the environment names. It needs the extra ``lake``."""

    is_recorded = False

    def __init__(self) -> None:
        """Raises SettingError for invalid settings of a store."""
        from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415 - the extra lake
        from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415

        self._settings = store_settings(os.environ, home(os.environ))
        self._source = Bucket(self._settings, BUCKET)
        self._findings = Findings(lambda _: None)
        self._rows: tuple[str, int, int, float, list[Mapping[str, Any]]] | None = None
        self._paces: dict[str, tuple[float, float | None]] = {}

    def rows(self, robot: str, begin_ns: int, end_ns: int) -> list[Mapping[str, Any]]:
        """Raises StoreError."""
        from shadowhound_data_logger.lake import pull  # noqa: PLC0415 - the extra lake

        known, now_s = self._rows, time.monotonic()
        is_known = known is not None and known[0] == robot and known[1] <= begin_ns and known[2] >= end_ns
        if known is None or not is_known or now_s - known[3] > FRESH_S:
            wide = KeptFilter(since_ns=begin_ns, until_ns=end_ns)
            known = self._rows = robot, begin_ns, end_ns, now_s, pull.known(self._source, robot, wide, self._findings).to_pylist()
        want = KeptFilter(since_ns=begin_ns, until_ns=end_ns)
        return [row for row in known[4] if row['t_start_ns'] is not None and pull.matches(want, row)]

    def mbps(self, robot: str) -> float | None:
        """Raises StoreError."""
        from shadowhound_data_logger.lake import link  # noqa: PLC0415 - the extra lake

        known, now_s = self._paces.get(robot), time.monotonic()
        if known is None or now_s - known[0] > PACE_S:
            known = self._paces[robot] = now_s, link.pace_mbps(self._source, robot, self._findings)
        return known[1]

    def requests(self, robot: str) -> list[KeptRequest]:
        """Raises StoreError, LakeError."""
        from shadowhound_data_logger.lake import pull  # noqa: PLC0415 - the extra lake

        found = []
        for one in pull.listed(self._source, robot)[-MAX_REQUESTS:]:
            answer = one.answer or RequestAnswer(id=one.id, state=one.state)
            found.append(KeptRequest(one.id, one.by, one.state, answer.why, one.want, answer.objects, answer.bytes,
                                     answer.delivered.objects, answer.delivered.bytes))  # fmt: skip
        return found

    def ask(self, robot: str, want: KeptFilter, by: str) -> str:
        """Raises StoreError, LakeError."""
        from shadowhound_data_logger.lake import pull  # noqa: PLC0415 - the extra lake

        with closing(open_store(self._settings, UploadSettings())) as store:
            return pull.put_request(store, self._source, robot, want, by=by).id

    def cancel(self, robot: str, request: str, by: str) -> None:
        """Raises StoreError, LakeError."""
        from shadowhound_data_logger.lake import pull  # noqa: PLC0415 - the extra lake

        with closing(open_store(self._settings, UploadSettings())) as store:
            pull.cancel(store, self._source, robot, request, by=by)


_Answer = TypeVar('_Answer')


def _read_requests(index: Index) -> list[KeptRequest]:
    found = []
    for row in index.requests.rows()[-MAX_REQUESTS:]:
        sent, size = index.requested.progress(row.id).outcomes.get('delivered', (0, 0))
        want = json.loads(row.selection)
        found.append(KeptRequest(row.id, row.requester, row.state, row.why, want, row.objects, row.bytes, sent, size))
    return found
