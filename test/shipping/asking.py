"""A robot that keeps data, a mailbox, and a client that requests data."""

from __future__ import annotations

import hashlib
import json
from functools import partial
from pathlib import Path
from typing import Any

from spool.making import NOON_NS, FakeClock, make, receive, rows
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.kept import KeptCut
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import KeepSettings, SpoolSettings
from shadowhound_data_logger.core.mailbox import MAILBOX_BUCKET, KeptFilter, PullRequest, answers_prefix, encode_inbox, inbox_key
from shadowhound_data_logger.core.model import DataObject, Outcome, SpooledObject, State
from shadowhound_data_logger.shipping.requests import RequestServer
from shadowhound_data_logger.spool.spool import Spool

KEEP = KeepSettings(poll_s=10.0)


def frame(number: int, *, body: bytes = b'', **fields: Any) -> DataObject:
    """An image that is kept on the robot, one per second."""
    stamp_ns = NOON_NS + number * SECOND
    values = {meta.ROBOT: 'thor', meta.POSE: f'{number} 0 0 odom', meta.SHIP: meta.ON_REQUEST, **fields.pop('metadata', {})}
    return make(f'thor/camera/20251018/{number:06d}_front.jpg', body or b'%06d' % number, t_start_ns=stamp_ns, t_end_ns=stamp_ns,
                metadata=values, **fields)  # fmt: skip


class Desk:
    """A robot with its spool and a store, and a client that requests data."""

    def __init__(self, root: Path, keep: KeepSettings = KEEP) -> None:
        self.root = root
        self.clock = FakeClock()
        self.clock.now_ns = NOON_NS + 3600 * SECOND
        self.now_s = 0.0
        self.store = MemoryStore()
        self.keep = keep
        self.version = ''
        self.entries: list[Any] = []
        self.released: list[SpooledObject] = []
        self._put_inbox(b'{"format":1,"entries":[]}')
        self.open()

    def open(self) -> None:
        """Start the node."""
        self.spool = Spool(self.root, SpoolSettings(min_free_bytes=0), self.clock, 'thor', self.keep)
        self.spool.open()
        self.server = RequestServer(self.spool, self.store, self.keep, 'thor', self.clock, put=self._commit,
                                    released=self.released.extend, cutter=partial(KeptCut, self.root.parent),
                                    monotonic=lambda: self.now_s)  # fmt: skip

    def _commit(self, item: DataObject) -> None:
        self.spool.commit([item])

    def _put_inbox(self, body: bytes) -> None:
        path = self.root.parent / 'inbox'
        path.write_bytes(body)
        sha256 = hashlib.sha256(body).hexdigest()
        self.store.put(SpooledObject(0, MAILBOX_BUCKET, inbox_key('thor'), path, len(body), sha256, 'application/json', {}, 0, 0))

    def keeps(self, *items: DataObject) -> None:
        receive(self.spool, sum(item.samples for item in items))
        assert self.spool.commit(items) == []

    def write(self, body: bytes) -> None:
        """Replace the mailbox as a client does."""
        found = self.store.changed(MAILBOX_BUCKET, inbox_key('thor'), '', 1 << 30)
        assert found
        assert self.store.replace(MAILBOX_BUCKET, inbox_key('thor'), body, found[1])

    def ask(self, *, by: str = 'spark', priority: int = 5, expires_s: int = 3600, **want: Any) -> str:
        now_ns = self.clock.now_ns
        request = PullRequest(robot='thor', by=by, made_ns=now_ns, expires_ns=now_ns + expires_s * SECOND, priority=priority,
                              want=KeptFilter(**want))  # fmt: skip
        self.entries.append(request.to_json())
        self.write(encode_inbox(self.entries))
        return request.id

    def step(self, seconds: float = 10.0) -> None:
        self.now_s += seconds
        self.clock.now_ns += round(seconds * SECOND)
        self.server.step()

    def deliver(self, most: int = 1000) -> int:
        """Deliver pending objects to the store."""
        items = self.spool.pending(most)
        for item in items:
            self.store.put(item)
        self.spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])
        return len(items)

    def answers(self, request: str) -> list[dict[str, Any]]:
        """The responses in the store, in order."""
        while self.deliver():
            pass
        found = [
            json.loads(self.store.get(MAILBOX_BUCKET, info.key))
            for info in self.store.list(MAILBOX_BUCKET, answers_prefix('thor', request))
        ]
        return sorted(found, key=lambda answer: answer['number'])

    def finish(self) -> None:
        """Continue until nothing changes."""
        for _ in range(60):
            self.step()
            self.deliver()
            if not self.spool.reading.requested.released()[0] and not any(
                row.is_open for row in self.spool.reading.requests.rows()
            ):
                break
        self.step()

    def state(self, number: int) -> str:
        return next(row['state'] for row in rows(self.root) if row['key'].endswith(f'{number:06d}_front.jpg'))
