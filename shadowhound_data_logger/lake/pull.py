"""Requests the objects that a robot keeps: lists them, writes requests to the mailbox that it polls, and reads its answers.

Requesters share a robot's mailbox (core/mailbox.py): each reads it, and replaces it only if it has not changed since.
"""

from __future__ import annotations

import getpass
import hashlib
import random
import re
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused
from shadowhound_data_logger.core.mailbox import (
    BAG_SENSOR,
    DEFAULT_EXPIRY_NS,
    DEFAULT_PRIORITY,
    MAILBOX_BUCKET,
    MAX_INBOX_BYTES,
    KeptFilter,
    PullCancel,
    PullRequest,
    RequestAnswer,
    RequestRefused,
    answers_prefix,
    decode_inbox,
    encode_inbox,
    inbox_key,
    read_entry,
    size_of,
)
from shadowhound_data_logger.core.model import ON_ROBOT, SpooledObject
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.core.untrusted import from_json, visible
from shadowhound_data_logger.formats.rows.catalog import KEPT, OBJECTS, place_of
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import robots
from shadowhound_data_logger.lake.select import Wanted, wanted
from shadowhound_data_logger.lake.tables import answer, literal, quoted
from shadowhound_data_logger.lake.views import views
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

FINAL: Final = frozenset({'done', 'expired', 'cancelled', 'refused'})
"""States after which a request gets no further answer."""
TRIES: Final = 60
"""Attempts to replace the mailbox: of a hundred concurrent requesters, one succeeds per round."""
PAUSE_S: Final = 0.2
"""The longest first pause between two attempts; it doubles up to four times."""
MAX_REQUESTS_PER_USER: Final = 128
"""Open requests per requester, so that the mailbox has space for others."""
ANSWERS_TRIED: Final = 8
"""The newest answers that are tried until one is valid."""
MAX_ANSWER_BYTES: Final = 1 << 20
POLL_S: Final = 2.0
MAX_POLLS: Final = 90
"""How often to poll for the rows of the objects that the robot uploaded."""
_OF_ROBOT: Final = ('robot', 'since', 'until', 'near', 'near_gps', 'mission', 'mission_type')
"""Flags that a request can have; the other flags select among the uploaded objects."""
_DAY_NS: Final = 24 * 3600 * 10**9


@dataclass(frozen=True, slots=True)
class PullState:
    """A request, from the mailbox and the answers."""

    id: str
    by: str
    state: str
    """``asked`` until the robot has answered; then the state of its newest answer."""
    priority: int | None
    want: dict[str, Any]
    answer: RequestAnswer | None
    """The newest answer."""


def kept(source: Bucket, robot: str, want: KeptFilter, findings: Findings) -> pa.Table:
    """The rows of objects that a robot keeps and that match the filter, with the columns of ``KEPT``. Raises StoreError."""
    rows = known(source, robot, want, findings)
    return rows.filter(pc.equal(rows['where'], ON_ROBOT))


def known(source: Bucket, robot: str, want: KeptFilter, findings: Findings) -> pa.Table:
    """The same, including rows of objects that the robot has lost. Raises StoreError."""
    early = Wanted(robot=robot, since_ns=None if want.since_ns is None else want.since_ns - _DAY_NS, until_ns=want.until_ns)
    has_date = early.has_date if early.since_ns is not None or early.until_ns is not None else None
    columns = ', '.join(map(quoted, KEPT.columns))
    stored = 'SELECT 1 FROM all_objects o WHERE o.robot = k.robot AND o.bucket = k.bucket AND o.key = k.key'
    newest = (
        'row_number() OVER (PARTITION BY bucket, key ORDER BY "where", bytes) AS _place'  # lost before robot, thinned before full
    )
    of_robot = f'SELECT k.*, {newest} FROM all_kept k WHERE robot = {literal(robot)} AND NOT EXISTS ({stored})'  # noqa: S608
    with views(source, [KEPT, OBJECTS], findings, robot=robot, has_date=has_date) as ready:
        rows = answer(ready, f'SELECT {columns} FROM ({of_robot}) WHERE _place = 1 ORDER BY bucket, key')  # noqa: S608
    return rows.filter(pa.array([matches(want, row) for row in rows.to_pylist()], pa.bool_()))


def matches(want: KeptFilter, row: Mapping[str, Any]) -> bool:
    """Whether an object matches a filter, by its row."""
    metadata = {name: row[name] for name in ('mission_id', 'run_id', 'mission_type') if row[name] is not None}
    metadata |= place_of(row)
    begin_ns = row['t_start_ns'] or 0
    return want.matches(row['key'], row['sensor'] or '', row['topic'], begin_ns, row['t_end_ns'] or begin_ns, metadata)


def put_request(store: ObjectStore, source: Bucket, robot: str, want: KeptFilter, *, by: str, priority: int = DEFAULT_PRIORITY,
        expiry_ns: int = DEFAULT_EXPIRY_NS) -> PullRequest:  # fmt: skip
    """Put a request into a robot's mailbox, unless it is already there. Raises StoreError, LakeError."""
    now_ns = time.time_ns()
    request = PullRequest(robot=robot, by=by, made_ns=now_ns, expires_ns=now_ns + expiry_ns, want=want, priority=priority)
    _checked(robot, request.to_json())

    def add(entries: list[Any]) -> list[Any] | None:
        nonlocal request
        left = _unanswered(source, robot, entries)
        for asked in _requests(robot, left):
            if asked.id == request.id and not any(entry.get('cancel') == asked.id for entry in left):
                request = asked
                return None
        if sum(asked.by == by for asked in _requests(robot, left)) >= MAX_REQUESTS_PER_USER:
            raise LakeError(
                f'{by} has {MAX_REQUESTS_PER_USER} requests open', remedy='wait until some are answered, or cancel one'
            )
        return [*(entry for entry in left if _request_id(entry) != request.id), request.to_json()]

    _change(store, robot, add)
    return request


def cancel(store: ObjectStore, source: Bucket, robot: str, request: str, *, by: str) -> None:
    """Cancel a request. Raises StoreError, LakeError."""

    def add(entries: list[Any]) -> list[Any]:
        left = _unanswered(source, robot, entries)
        made_ns = max((asked.made_ns + 1 for asked in _requests(robot, left) if asked.id == request), default=0)
        cancellation = PullCancel(id=request, by=by, made_ns=max(time.time_ns(), made_ns)).to_json()
        _checked(robot, cancellation)
        return [*left, cancellation]

    _change(store, robot, add)


def listed(source: Bucket, robot: str) -> list[PullState]:
    """The requests in a robot's mailbox, and their states. Raises StoreError, LakeError."""
    requests = _requests(robot, _entries(source, robot))
    with ThreadPoolExecutor(THREADS) as pool:
        answers = pool.map(lambda request: newest_answer(source, robot, request.id), requests)
    found = []
    for request, newest in zip(requests, answers, strict=True):
        is_current = newest is not None and (newest.state not in FINAL or _is_final_answer(newest, request.made_ns))
        answer = newest if is_current else None
        state = 'asked' if answer is None else answer.state
        found.append(PullState(request.id, request.by, state, request.priority, request.want.to_json(), answer))
    return found


def unanswered(source: Bucket, robot: str) -> list[PullRequest]:
    """The requests in a robot's mailbox without a final answer. Raises StoreError, LakeError."""
    return _requests(robot, _unanswered(source, robot, _entries(source, robot)))


def _entries(source: Bucket, robot: str) -> list[Any]:
    """The entries of a robot's mailbox; empty if it does not exist."""
    try:
        return decode_inbox(source.get(inbox_key(robot), MAX_INBOX_BYTES))
    except ObjectRefused as error:
        if error.data.get('reason') == 'missing':
            return []
        raise
    except RequestRefused as error:
        raise LakeError(f'the mailbox of {robot} is damaged: {error}', remedy='replace it with an empty one') from error


def newest_answer(source: Bucket, robot: str, request: str) -> RequestAnswer | None:
    """The newest valid answer to a request; None before the first. Raises StoreError."""
    numbers = []
    for entry in source.list(answers_prefix(robot, request)):
        name = entry.key.rpartition('/')[2].removesuffix('.json')
        if name.isascii() and name.isdigit() and len(name) < 10:
            numbers.append(int(name))
    for number in sorted(numbers, reverse=True)[:ANSWERS_TRIED]:
        try:
            body = source.get(f'{answers_prefix(robot, request)}{number}.json', MAX_ANSWER_BYTES)
            answer = parse(RequestAnswer, from_json(body, MAX_ANSWER_BYTES))
        except (ObjectRefused, ValueError):
            continue
        if answer.id == request:
            return answer
    return None


def wait(source: Bucket, robot: str, request: str, *, tell: Callable[[RequestAnswer | None], None] = lambda _: None,
         made_ns: int = 0) -> RequestAnswer:  # fmt: skip
    """Wait for the final answer to a request made at ``made_ns``; the callback gets the newest answer. Raises StoreError."""
    while True:
        answer = newest_answer(source, robot, request)
        tell(answer)
        if answer is not None and _is_final_answer(answer, made_ns):
            return answer
        time.sleep(POLL_S)


def requester() -> str:
    """The user of this process, as a valid name."""
    return re.sub(r'[^A-Za-z0-9_.-]', '_', getpass.getuser())


def request_and_wait(source: Bucket, flags: Mapping[str, Any], *, sensors: Collection[str] | None = None,
                     say: Callable[[str], None] = lambda _: None, findings: Findings | None = None) -> int:  # fmt: skip
    """Request what every robot keeps of these sensors (None: all except bags), and wait until the store has it.

    ``flags`` are those of a query; ``near`` and ``near_gps`` apply only to the first sensor, because few others have a position.
    Returns the number of requested objects. Raises LakeError if a robot refuses or a request expires, SettingError, StoreError.
    """
    asked = wanted(time.time_ns(), **{name: flags[name] for name in _OF_ROBOT if flags.get(name) is not None})
    findings = Findings() if findings is None else findings
    total, requests = 0, list[tuple[PullRequest, list[dict[str, Any]]]]()
    with closing(open_store(source.settings, UploadSettings())) as store:
        for robot in robots(source) if asked.robot is None else [asked.robot]:
            want = KeptFilter(
                since_ns=asked.since_ns, until_ns=asked.until_ns, mission=asked.mission, mission_type=asked.mission_type
            )
            rows = kept(source, robot, want, findings).to_pylist()
            there = {row['sensor'] for row in rows}
            for sensor in sorted(there) if sensors is None else sensors:
                if sensor in there and sensor != BAG_SENSOR:
                    is_first = sensors is not None and sensor == next(iter(sensors))
                    near, near_gps = (asked.near, asked.near_gps) if is_first else (None, None)
                    of_it = replace(want, sensor=sensor, near=near, near_gps=near_gps)
                    found = [row for row in rows if matches(of_it, row)]
                    requests.append((put_request(store, source, robot, of_it, by=requester()), found))
                    total += len(found)
    for request, found in requests:
        _await(source, request, found, say, findings)
    return total


def await_rows(source: Bucket, robot: str, want: KeptFilter, rows: Iterable[Mapping[str, Any]], findings: Findings,
               say: Callable[[str], None] = lambda _: None) -> None:  # fmt: skip
    """Wait up to three minutes until the store has the rows of these objects, which a robot has uploaded.

    Does not wait for slices that were uploaded only in part. Raises StoreError.
    """
    names = {row['key'] for row in rows if row['where'] == ON_ROBOT and size_of(want, row) == (row['bytes'] or 0)}
    for _ in range(MAX_POLLS):
        if names.isdisjoint(kept(source, robot, want, findings)['key'].to_pylist()):
            return
        say(f'waiting for the rows of {robot}: {want.sensor or "all sensors"}')
        time.sleep(POLL_S)


def _await(source: Bucket, request: PullRequest, rows: Sequence[Mapping[str, Any]], say: Callable[[str], None],
           findings: Findings) -> None:  # fmt: skip
    """Wait until a request is done and the store has the rows of its objects."""

    def tell(answer: RequestAnswer | None) -> None:
        say(f'waiting for {request.robot}: {request.want.sensor}, {visible(_progress_text(answer))}')

    answer = wait(source, request.robot, request.id, tell=tell, made_ns=request.made_ns)
    if answer.state != 'done':
        raise LakeError(f'{request.robot} did not send all of {request.want.sensor}: {visible(_progress_text(answer))}',
                        remedy='see `shadowhound-data pull --list`, or request it again')  # fmt: skip
    await_rows(source, request.robot, request.want, rows, findings, say)


def _progress_text(answer: RequestAnswer | None) -> str:
    return 'asked' if answer is None else f'{answer.state}, {answer.delivered.objects} of {answer.objects} objects'


def _is_final_answer(answer: RequestAnswer, made_ns: int) -> bool:
    """Whether it is the final answer to a request made at that time: an earlier answer belongs to an earlier request."""
    return answer.state in FINAL and answer.made_ns >= made_ns


def _requests(robot: str, entries: Iterable[Any]) -> list[PullRequest]:
    found = []
    for entry in entries:
        try:
            read = read_entry(robot, entry)
        except RequestRefused:
            continue
        if isinstance(read, PullRequest):
            found.append(read)
    return found


def _checked(robot: str, entry: dict[str, Any]) -> None:
    try:
        read_entry(robot, entry)
    except RequestRefused as error:
        raise LakeError(f'the robot would refuse the request: {error}', remedy='request less, or change the filter') from error


def _unanswered(source: Bucket, robot: str, entries: Sequence[Any]) -> list[Any]:
    """The entries without requests that have a final answer or expired more than a day ago, and without their cancellations."""
    requests = _requests(robot, entries)
    with ThreadPoolExecutor(THREADS) as pool:
        answers = list(pool.map(lambda request: newest_answer(source, robot, request.id), requests))
    now_ns = time.time_ns()
    waiting = {
        request.id for request, answer in zip(requests, answers, strict=True)
        if not (answer is not None and _is_final_answer(answer, request.made_ns))
        and request.expires_ns + _DAY_NS > now_ns
    }  # fmt: skip
    return [entry for entry in entries if isinstance(entry, dict) and _request_id(entry) in waiting]


def _request_id(entry: Mapping[str, Any]) -> str:
    """The id of the request that an entry makes or cancels; the entry can be any JSON object."""
    found = entry.get('id', entry.get('cancel'))
    return found if isinstance(found, str) else ''


def _read(store: ObjectStore, robot: str) -> tuple[list[Any], str]:
    """The entries of the mailbox, which is created if it does not exist, and its ETag."""
    try:
        found = with_retries(lambda: store.changed(MAILBOX_BUCKET, inbox_key(robot), '', MAX_INBOX_BYTES))
    except ObjectRefused as error:
        if error.data.get('reason') != 'missing':
            raise
        make(store, robot)
        found = with_retries(lambda: store.changed(MAILBOX_BUCKET, inbox_key(robot), '', MAX_INBOX_BYTES))
    assert found is not None
    try:
        return decode_inbox(found[0]), found[1]
    except RequestRefused as error:
        where = f'{MAILBOX_BUCKET}/{inbox_key(robot)}'
        raise LakeError(f'{where} is damaged: {error}', remedy='replace it with an empty one') from error


def make(store: ObjectStore, robot: str) -> None:
    """Create an empty mailbox for a robot, if it does not exist. Raises StoreError."""
    body = encode_inbox([])
    with tempfile.TemporaryDirectory(prefix='shadowhound-inbox-') as folder:
        path = Path(folder, 'inbox.json')
        path.write_bytes(body)
        store.put(SpooledObject(
            id=0, bucket=MAILBOX_BUCKET, key=inbox_key(robot), path=path, size=len(body),
            sha256=hashlib.sha256(body).hexdigest(), content_type='application/json', metadata={}, priority=5, created_ns=0,
        ))  # fmt: skip


def _change(store: ObjectStore, robot: str, change: Callable[[list[Any]], list[Any] | None]) -> None:
    """Replace the entries by those that ``change`` returns, even if other processes do the same; None: change nothing."""
    for attempt in range(TRIES):
        entries, version = _read(store, robot)
        changed = change(entries)
        if changed is None:
            return
        try:
            body = encode_inbox(changed)
        except RequestRefused as error:
            raise LakeError(str(error), remedy='wait until some requests are answered, or cancel one') from error
        if with_retries(lambda: store.replace(MAILBOX_BUCKET, inbox_key(robot), body, version)):  # noqa: B023 - called at once
            return
        time.sleep(random.uniform(0.0, PAUSE_S * 2.0 ** min(attempt, 4)))
    raise LakeError('other processes kept changing the mailbox', remedy='run the command again')
