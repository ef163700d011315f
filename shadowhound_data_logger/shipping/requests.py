"""Serves requests for data that the robot keeps: polls the mailbox, makes requests rows, releases objects, answers.

A request is a row before anything is done about it, and each answer is spooled in the transaction that notes it. Objects are
released a few at a time, so that requests share the link by their priorities: no requester waits for another's
to finish. From slices that extend beyond the requested time, a bag of that time is cut, some milliseconds of work at each step.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND, Clock, iso
from shadowhound_data_logger.core.config import KeepSettings
from shadowhound_data_logger.core.dataclass_json import as_plain
from shadowhound_data_logger.core.errors import AccessDenied, ObjectRefused, StoreError
from shadowhound_data_logger.core.mailbox import (
    DEFAULT_EXPIRY_NS,
    DEFAULT_PRIORITY,
    MAILBOX_BUCKET,
    MAX_INBOX_BYTES,
    LostObject,
    ObjectCount,
    PullCancel,
    PullRequest,
    RequestAnswer,
    RequestRefused,
    answer_key,
    decode_inbox,
    inbox_key,
    read_entry,
    request_id,
)
from shadowhound_data_logger.core.model import DataObject, SpooledObject
from shadowhound_data_logger.core.status import RequestStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.shipping.slice_cuts import Cutter, SliceCuts
from shadowhound_data_logger.spool.request_table import (
    ACTIVE,
    CANCELLED,
    DONE,
    EXPIRED,
    REFUSED,
    KeptObject,
    RequestRow,
)
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.base import ObjectStore

log = logging.getLogger(__name__)

STEP_S: Final = 0.25
"""Between two releases while requests are open."""
WINDOW: Final = 64
"""Maximum of released objects that wait for delivery: later requests have their turn after these."""
WINDOW_S: Final = 5.0
"""The same in seconds of the link, but one object always may go."""
WINDOW_BYTES: Final = 4 << 20
"""The same where the pace of the link is not known."""
MIN_WINDOW, MAX_WINDOW = 1 << 20, 16 << 20
"""In bytes."""
TELL_S: Final = 30.0
"""Between two answers of how far a request is."""
MAX_REQUESTS: Final = 4096
"""That are remembered at a time; beyond it those are forgotten that were answered first."""
AT_A_TIME: Final = 64
"""New requests of one look: each is tried on all that is kept."""
REMEMBER_NS: Final = 30 * 24 * 3600 * SECOND
"""For so long after its last answer."""
TIDY_S: Final = 60.0
ANSWERS: Final = '_answers'
"""The sensor of answers."""


class RequestServer:
    """Serves the requests for what a robot keeps.

    Lifecycle: New; open once; ``wake`` from any thread; close once. Owns the thread ``requests``; its changes to the spool are
    durable when they return, so a crash at any moment leaves nothing half done.
    """

    def __init__(self, spool: Spool, store: ObjectStore, settings: KeepSettings, robot: str, clock: Clock, *,  # noqa: PLR0913 - each is a neighbor
                 put: Callable[[DataObject], None], released: Callable[[Sequence[SpooledObject]], None], cutter: Cutter,
                 mbps: Callable[[], float | None] = lambda: None, may_send: Callable[[], bool] = lambda: True,
                 finished: Callable[[], None] = lambda: None, thin: Callable[[], bool] = lambda: False,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``put`` matches answers to be spooled, ``released`` receives objects that may be shipped; ``mbps`` is the pace.

        While not ``may_send``, requests are accepted and nothing is released for them. ``finished`` is called when all objects of
        a request are in the store: a client may wait for that. ``thin`` makes room for what is kept, a little at a time.
        """
        self._spool = spool
        self._store = store
        self._settings = settings
        self._robot = robot
        self._clock = clock
        self._put = put
        self._released = released
        self._mbps = mbps
        self._may_send = may_send
        self._finished = finished
        self._thin = thin
        self._monotonic = monotonic
        self._version = ''
        self._poll_at_s = self._tidy_at_s = 0.0
        self._is_clear = False
        self._cuts = SliceCuts(spool, cutter, released, self._serve, monotonic)
        self._answering: dict[str, int] = {}
        """Request -> the number of its answer that is on its way into the spool."""
        self._served: dict[str, float] = {}
        """Requester -> bytes released, weighed by priority."""
        self._wakes = threading.Event()
        self._asked_here = deque[PullRequest | PullCancel]()
        self.status = RequestStatus()
        """Of up to ``keep.poll_s`` ago."""
        self.refused = Counter[str]()
        """Entries and mailboxes that were refused, by reason."""
        self.worker = Worker('requests', self._round, patience_s=120.0)

    def open(self) -> None:
        self.worker.start()

    def close(self, deadline_s: float) -> None:
        """End the thread; idempotent."""
        self.worker.stop()
        self._wakes.set()
        self.worker.join(deadline_s)

    def wake(self) -> None:
        """Something was delivered: there may be room for more."""
        self._wakes.set()

    def _round(self) -> None:
        busy = self.step()
        self._wakes.wait(STEP_S if busy else min(1.0, self._settings.poll_s))
        self._wakes.clear()

    def step(self) -> bool:
        """One look at everything; whether there is more to do. Raises OSError or sqlite3.Error where the spool is of no use."""
        now_s = self._monotonic()
        if not self._is_clear:
            self._spool.requests.clear_unfinished()
            self._is_clear = True
        with suppress(StoreError):  # which says how many answers there were; it is asked again
            while self._asked_here:
                self._handle_requests([self._asked_here[0]])
                self._asked_here.popleft()
        if now_s >= self._poll_at_s:
            self._poll_at_s = now_s + self._settings.poll_s
            self._poll()
            self._look()
        rows = self._spool.reading.requests.rows()
        now_ns = self._clock.wall_ns()
        for row in rows:
            if row.is_open and row.expires_ns <= now_ns:
                self._spool.requests.close(row.id, EXPIRED)
        rows = [row for row in rows if row.is_open and row.expires_ns > now_ns]
        is_busy = self._may_send() and self._release(rows) | self._cuts.work({row.id for row in rows})
        for row in self._spool.reading.requests.rows():
            if row.answered_state != row.state or row.is_open:
                self._answer(row)
        if now_s >= self._tidy_at_s:
            self._tidy_at_s = now_s + TIDY_S
            self._spool.requests.forget(now_ns - REMEMBER_NS)
            asking, known = {row.requester for row in rows}, {row.id for row in self._spool.reading.requests.rows()}
            self._served = {name: served for name, served in self._served.items() if name in asking}
            self._answering = {name: number for name, number in self._answering.items() if name in known}
            while self._spool.kept.evict_old():
                pass
        return self._thin() | is_busy

    # -- requests -------------------------------------------------------------------------------------------------

    def ask(self, want: Mapping[str, Any], by: str) -> str:
        """Ask for something at the robot itself, from any thread: its id. Raises RequestRefused."""
        now_ns = self._clock.wall_ns()
        asked = {'id': request_id(self._robot, want), 'robot': self._robot, 'by': by, 'made_ns': now_ns,
                 'expires_ns': now_ns + DEFAULT_EXPIRY_NS, 'priority': DEFAULT_PRIORITY, 'want': want}  # fmt: skip
        return self._hear(asked)

    def cancel(self, request: str, by: str) -> str:
        """Take a request back that was made, wherever that was, from any thread: its id. Raises RequestRefused."""
        return self._hear({'cancel': request, 'by': by, 'made_ns': self._clock.wall_ns()})

    def _hear(self, asked: Mapping[str, Any]) -> str:
        read = read_entry(self._robot, asked)
        if len(self._asked_here) >= AT_A_TIME:
            raise RequestRefused('too_many', 'too many ask at once')
        self._asked_here.append(read)
        self._wakes.set()
        return read.id

    def _look(self) -> None:
        """Count the open requests and their bytes."""
        index = self._spool.reading
        count, size = index.requests.open_count(), index.requested.unreleased_bytes()
        mbps = self._mbps()
        self.status = RequestStatus(count, size, mbps, round(8e-6 * size / mbps) if mbps else None)

    def _poll(self) -> None:
        """Look into the mailbox; a store that is away, or has none, is asked again."""
        try:
            found = self._store.changed(MAILBOX_BUCKET, inbox_key(self._robot), self._version, MAX_INBOX_BYTES)
            if found is not None and self._read(found[0]):
                self._version = found[1]
        except ObjectRefused as error:
            if error.data.get('reason') != 'missing':
                self._refuse('too_large' if error.data.get('reason') == 'size' else 'unreadable', str(error))
        except AccessDenied as error:
            self._refuse('denied', f'the mailbox may not be read: {error}')
        except StoreError as error:
            log.debug('the mailbox cannot be read now: %s', error)

    def _read(self, body: bytes) -> bool:
        """Whether all of it is done, for as long as it does not change. Raises StoreError."""
        try:
            entries = decode_inbox(body)
        except RequestRefused as error:
            self._refuse(error.reason, str(error))
            return True
        reads = []
        for entry in entries:
            try:
                reads.append(read_entry(self._robot, entry))
            except RequestRefused as error:
                self._refuse(error.reason, f'an entry of the mailbox is refused: {error}')
        return self._handle_requests(reads)

    def _handle_requests(self, reads: Sequence[PullRequest | PullCancel]) -> bool:
        """Whether all of it is done. Raises StoreError."""
        known = {row.id: row for row in self._spool.reading.requests.rows()}
        new, cancels = dict[str, PullRequest](), []
        for read in reads:
            row = known.get(read.id)
            if isinstance(read, PullCancel):
                cancels.append(read)
            elif row is None or (not row.is_open and row.answered_state == row.state and read.made_ns != row.made_ns):
                new.setdefault(read.id, read)
        if (beyond := len(known) + len(new) - MAX_REQUESTS) > 0:
            self._spool.requests.forget(self._clock.wall_ns(), beyond)
            known = {row.id: row for row in self._spool.reading.requests.rows()}
        room = max(0, MAX_REQUESTS - len(known))
        if len(new) > room:
            self._refuse('too_many', 'too many requests are open')
        known |= {row.id: row for row in self._accept(_in_turn(list(new.values()))[: min(AT_A_TIME, room)], known)}
        for cancel in cancels:
            row = known.get(cancel.id)
            if row is not None and row.is_open and cancel.made_ns > row.made_ns:
                self._spool.requests.close(cancel.id, CANCELLED)
        return len(new) <= min(AT_A_TIME, room)

    def _accept(self, new: Sequence[PullRequest], known: Mapping[str, RequestRow]) -> Iterator[RequestRow]:
        """Each is a row with what it chose; what is kept is looked through once. Raises StoreError."""
        if not new:
            return
        answers = {request.id: known[request.id].answers if request.id in known else self._answers_before(request.id)
                   for request in new}  # fmt: skip
        chosen: dict[str, list[tuple[int, int]]] = {request.id: [] for request in new}
        gone: dict[str, list[KeptObject]] = {request.id: [] for request in new}
        for item in self._spool.requests.selectable():
            for request in new:
                if request.want.matches(item.key, item.sensor, item.topic, item.t_start_ns, item.t_end_ns, item.metadata):
                    if item.is_here:
                        size = request.want.bytes_of(item.key, item.sensor, item.bytes, item.t_start_ns, item.t_end_ns,
                                                     item.metadata)  # fmt: skip
                        chosen[request.id].append((item.id, size))
                    else:
                        gone[request.id].append(item)
        now_ns = self._clock.wall_ns()
        for request in new:
            is_late = request.expires_ns <= now_ns
            row = self._spool.requests.accept(RequestRow(
                id=request.id, requester=request.by, priority=request.priority, made_ns=request.made_ns,
                expires_ns=request.expires_ns, received_ns=now_ns, selection=json.dumps(request.want.to_json()),
                state=REFUSED if is_late else ACTIVE, why='it has expired already' if is_late else '',
                answers=answers[request.id], unavailable=json.dumps(_gone(gone[request.id])),
            ), [] if is_late else chosen[request.id])  # fmt: skip
            log.info('%s asks for %d objects that are kept (request %s)', row.requester, row.objects, row.id)
            yield row

    def _answers_before(self, request: str) -> int:
        """Answers that the store has from before the index was lost. Raises StoreError."""
        number = 0
        while self._store.head(MAILBOX_BUCKET, answer_key(self._robot, request, number + 1)) is not None:
            number += 1
        return number

    def _refuse(self, reason: str, text: str) -> None:
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            log.warning('%s; further ones are only counted', text)

    # -- what is sent ----------------------------------------------------------------------------------------------

    def _release(self, rows: Sequence[RequestRow]) -> bool:
        """Let the next objects wait for delivery; whether there are any."""
        mbps = self._mbps()
        window = WINDOW_BYTES if mbps is None else min(max(round(WINDOW_S * mbps * 125_000), MIN_WINDOW), MAX_WINDOW)
        count, size = self._spool.reading.requested.released()
        if not rows or count > WINDOW // 2 or size > window // 2:
            return False
        room, room_bytes = WINDOW - count, window - size
        queues = {row.id: deque(self._spool.reading.requested.unreleased(row.id, room)) for row in rows}
        chosen: dict[int, int] = {}
        while len(chosen) < room and (row := self._next([row for row in rows if queues[row.id]])) is not None:
            number, size, is_cut = queues[row.id].popleft()
            if is_cut:
                self._cuts.begin(row)
                continue
            if (count or chosen) and size > room_bytes:
                break
            if number not in chosen:
                chosen[number] = row.priority
                room_bytes -= size
                self._serve(row, size)
        if chosen:
            self._released(self._spool.kept.release(list(chosen.items())))
        return bool(chosen)

    def _serve(self, row: RequestRow, size: int) -> None:
        self._served[row.requester] += size / (10 - row.priority)

    def _next(self, rows: Sequence[RequestRow]) -> RequestRow | None:
        """The most important, oldest request of the requester who was served the fewest bytes, weighted by priority."""
        if not rows:
            return None
        asking = {row.requester for row in rows}
        least = min((self._served[name] for name in asking if name in self._served), default=0.0)
        for name in asking:
            self._served.setdefault(name, least)
        first = min(asking, key=lambda name: (self._served[name], name))
        return min((row for row in rows if row.requester == first), key=lambda row: (row.priority, row.received_ns, row.id))

    # -- what is answered ------------------------------------------------------------------------------------------

    def _answer(self, row: RequestRow) -> None:
        """Spool the next answer of a request, if one is due."""
        if self._answering.get(row.id, 0) > row.answers:
            return
        if row.is_open and self._spool.reading.requested.is_settled(row.id):
            self._spool.requests.close(row.id, DONE)
            self._finished()
            row = replace(row, state=DONE)
        now_ns = self._clock.wall_ns()
        if row.answered_state == row.state and (not row.is_open or now_ns - row.answered_ns < TELL_S * SECOND):
            return
        if not row.is_open:
            self._spool.requests.let_go(row.id)
        progress = self._spool.reading.requested.progress(row.id)
        if not row.is_open and progress.outcomes.get('pending'):
            return  # the released objects are still delivered, and the last answer reports them
        number = row.answers + 1
        self._answering[row.id] = number
        answer = RequestAnswer(
            id=row.id, number=number, robot=self._robot, by=row.requester,
            state='accepted' if row.is_open and not row.answered_state else 'sending' if row.is_open else row.state,
            time=iso(now_ns), made_ns=row.made_ns, expires=iso(row.expires_ns), why=row.why, want=json.loads(row.selection),
            objects=row.objects, bytes=row.bytes, gone=json.loads(row.unavailable), mbps=self._mbps(),
            outcomes={state: ObjectCount(*counts) for state, counts in progress.outcomes.items()},
            lost=tuple(LostObject(key, state, reason, iso(settled_ns) if settled_ns else None)
                       for key, state, reason, settled_ns in progress.lost),
            bags=tuple(key.split('/')[2] for key in progress.manifests),
        )  # fmt: skip
        self._put(DataObject(
            bucket=MAILBOX_BUCKET, key=answer_key(self._robot, row.id, number),
            body=json.dumps(as_plain(answer), indent=1).encode(), content_type='application/json', sensor=ANSWERS, topic=None,
            type='', samples=0, t_start_ns=now_ns, t_end_ns=now_ns, priority=0, protected=True,
            metadata={meta.ROBOT: self._robot}, answers=(row.id, number, row.state),
        ))  # fmt: skip


def _in_turn(requests: Sequence[PullRequest]) -> list[PullRequest]:
    """The first of each requester, then the second of each, and so on: one who asks often does not come before all others."""
    turns = Counter[str]()
    order = []
    for index, request in enumerate(requests):
        turns[request.by] += 1
        order.append((turns[request.by], index, request))
    return [request for *_, request in sorted(order, key=itemgetter(0, 1))]


def _gone(items: Sequence[KeptObject]) -> dict[str, Any]:
    """Requested objects that were deleted before the request: how many, why, from what time, and when they were deleted."""
    if not items:
        return {}
    return {
        'objects': len(items), 'bytes': sum(item.bytes for item in items),
        'reasons': dict(Counter(f'{item.state}: {item.reason}' for item in items).most_common(8)),
        'from': iso(min(item.t_start_ns for item in items)), 'to': iso(max(item.t_end_ns for item in items)),
        'went': iso(max(item.settled_ns for item in items)),
    }  # fmt: skip
