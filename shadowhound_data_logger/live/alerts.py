"""Alerts: a message to a URL when a condition of a robot begins, and another one when it ends.

The page of a store checks all robots, by the catalog and the gap journal. The page of a robot checks that robot, by its spool and
its policies. Messages are sent as JSON, with the headers that make ntfy render JSON (https://docs.ntfy.sh/publish, "Message
templating"; ntfy 2.10 or newer). Other webhooks ignore these headers.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import aiohttp

from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.policies.state import StateFile
from shadowhound_data_logger.spool.status import RUNNING

log = logging.getLogger(__name__)

CHECK_S: Final = 300.0
"""Between two checks. What could not be sent is sent after the next one."""
AGAIN_S: Final = 3600.0
"""At most one message about the beginning of a condition in this time, per robot and condition."""
TIMEOUT_S: Final = 10.0
MAX_SENT: Final = 20
"""Messages per check."""
MAX_POLICIES: Final = 3
"""Versions that were rolled back, the newest ones."""
FULL_SHARE: Final = 0.9
MAX_TEXT: Final = 300
SILENT, LOST, DISK, QUARANTINE, POLICY = 'silent', 'losses', 'disk', 'quarantine', 'policy'
HEADERS: Final = {'Template': 'yes', 'Title': '{{.title}}', 'Message': '{{.text}}'}
"""For ntfy: it fills the templates from the JSON."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlertSettings:
    """Where alerts are sent, and from which bounds on."""

    url: str = field(repr=False)
    """May contain a token, so it is in no log."""
    silent_s: float = 3600.0
    """A robot is silent if nothing arrived for longer than this."""
    lost: int = 1000
    """Messages that may be missing per day (UTC)."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Whether a condition of a robot is true; None: that is unknown."""

    robot: str
    name: str
    is_on: bool | None
    text: str
    """Describes the condition, whether or not it is true."""


@dataclass(slots=True)
class _Sent:
    """The last message about a condition that was delivered."""

    begin_s: float
    """When its last beginning was reported, in seconds since 1970."""
    is_on: bool


def conditions_of_fleet(rows: Iterable[Mapping[str, Any]], settings: AlertSettings, now_s: float) -> Iterator[Condition]:
    """The conditions of all robots of a store, from the rows of ``live/fleet.py``.

    A robot without a message for a week is retired, so whether it is silent is unknown.
    """
    for row in rows:
        robot = str(row['robot'])
        contact_ms = [row[name] for name in ('last', 'known') if row[name] is not None]
        is_silent = now_s - max(contact_ms) / 1e3 > settings.silent_s if contact_ms else None
        yield Condition(robot, SILENT, is_silent, f'nothing from it arrived in the store for {_hours(settings.silent_s)}')
        yield _losses(robot, int(row['lost']), settings)
        yield Condition(robot, DISK, row['no_room'] > 0, 'it deleted objects today because its disk or spool was full')
        yield _quarantine(robot, int(row['quarantined']), 'messages of today (UTC)')


def conditions_of_robot(
    figures: Mapping[str, Any], lost: int | None, policies: Path, settings: AlertSettings
) -> Iterator[Condition]:
    """The conditions of the robot of this machine: ``SpoolFigures.now``, messages missing today, the folder of its policies."""
    robot, spool = str(figures['robot']), figures.get('spool') or {}
    yield Condition(robot, SILENT, figures.get('state') != RUNNING, 'its node is not running, or does not answer')
    yield _losses(robot, lost, settings)
    yield _disk(robot, spool)
    yield _quarantine(robot, int(spool.get('quarantined') or 0), 'objects')
    try:
        bad = list(StateFile(policies).read().bad.items())[-MAX_POLICIES:]
    except DataLoggerError:
        return
    for policy, why in bad:
        yield Condition(robot, f'{POLICY} {policy}', True, f'policy {policy} was rolled back: {why}')


def _losses(robot: str, lost: int | None, settings: AlertSettings) -> Condition:
    text = f'more than {settings.lost:,} messages are missing today (UTC)'
    if lost is None:
        return Condition(robot, LOST, None, text)
    return Condition(robot, LOST, lost > settings.lost, f'{text}: {lost:,}' if lost > settings.lost else text)


def _quarantine(robot: str, count: int, what: str) -> Condition:
    text = f'{what} are in quarantine because the store refused them; "shadowhound-data spool list" on the robot shows the reason'
    return Condition(robot, QUARANTINE, count > 0, f'{count:,} {text}' if count else text)


def _disk(robot: str, spool: Mapping[str, Any]) -> Condition:
    free, reserve, used, most = (spool.get(name) for name in ('free_bytes', 'min_free_bytes', 'bytes', 'max_bytes'))
    is_short = None if free is None or reserve is None else free < reserve
    if most and used is not None and used > FULL_SHARE * most:
        is_short = True
    text = 'the disk or the spool is nearly full; when it is full, the least important objects are deleted'
    return Condition(robot, DISK, is_short, text)


def _hours(seconds: float) -> str:
    return f'{seconds / 3600:g} h'


class Alerts:
    """Sends alerts while the page is served. Used by one event loop.

    Lifecycle: New; open once; close once.
    """

    def __init__(self, settings: AlertSettings, state: Path, check: Callable[[], Awaitable[Sequence[Condition]]],
                 now: Callable[[], float] = time.time) -> None:  # fmt: skip
        """``state`` is a file that remembers what was sent; ``check`` returns the current conditions."""
        self._settings, self._path, self._check, self._now = settings, state, check, now
        self._host = urlsplit(settings.url).hostname or ''
        self._sent = _read(state)
        self._problem = ''
        self._task: asyncio.Task[None] | None = None

    def open(self) -> None:
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def look(self) -> None:
        """Check once, and send what has begun or ended. Raises DataLoggerError if the conditions cannot be checked."""
        found, now_s = await self._check(), self._now()
        due = [each for each in found if self._is_due(each, now_s)][:MAX_SENT]
        if not due:
            return
        timeout = aiohttp.ClientTimeout(total=TIMEOUT_S)
        async with aiohttp.ClientSession(timeout=timeout) as session:
            for each in due:
                if not await self._post(session, each):
                    break  # the others are sent after the next check
                key, is_on = (each.robot, each.name), bool(each.is_on)
                self._sent[key] = _Sent(now_s if is_on else self._sent[key].begin_s, is_on)
        self._remember(now_s)

    async def _run(self) -> None:
        while True:
            try:
                await self.look()
            except DataLoggerError as error:
                self._report(f'the conditions for alerts cannot be checked: {error}')
            except Exception:  # the one supervised catch-all: the page is served without alerts until the next check
                log.exception('the conditions for alerts cannot be checked')
            await asyncio.sleep(CHECK_S)

    def _is_due(self, each: Condition, now_s: float) -> bool:
        sent = self._sent.get((each.robot, each.name))
        if each.is_on is None:
            return False
        if not each.is_on:
            return sent is not None and sent.is_on
        return sent is None or (not sent.is_on and now_s - sent.begin_s >= AGAIN_S)

    async def _post(self, session: aiohttp.ClientSession, each: Condition) -> bool:
        content = {
            'title': f'{each.robot}: {each.name}' if each.is_on else f'{each.robot}: {each.name} has ended',
            'text': visible(each.text if each.is_on else f'No longer: {each.text}.')[:MAX_TEXT],
            'robot': each.robot, 'condition': each.name, 'state': 'begins' if each.is_on else 'ended',
            'at': iso(int(self._now() * SECOND)),
        }  # fmt: skip
        headers = {**HEADERS, 'Priority': 'high' if each.is_on else 'default'}
        try:
            async with session.post(self._settings.url, json=content, headers=headers, allow_redirects=False) as answer:
                problem = '' if answer.status < 300 else f'it answers with status {answer.status}'
        except (aiohttp.ClientError, asyncio.TimeoutError, OSError, ValueError) as error:
            problem = type(error).__name__  # its text may contain the URL
        self._report(problem and f'alerts cannot be sent to {self._host}: {problem}; the next attempt is in {CHECK_S:g} s')
        return not problem

    def _report(self, problem: str) -> None:
        """Log a problem once, not with each check."""
        if problem and problem != self._problem:
            log.warning('%s', problem)
        self._problem = problem

    def _remember(self, now_s: float) -> None:
        self._sent = {key: each for key, each in self._sent.items() if each.is_on or now_s - each.begin_s < AGAIN_S}
        rows = [[robot, name, each.begin_s, each.is_on] for (robot, name), each in self._sent.items()]
        try:
            with replacing(self._path, mode=0o600) as file:
                file.write(json.dumps(rows).encode())
        except OSError as error:
            log.warning('%s cannot be written, so alerts may be sent again after a restart: %s', self._path, error.strerror)


def _read(path: Path) -> dict[tuple[str, str], _Sent]:
    """What was sent; nothing if the file is missing or damaged: then alerts are sent again."""
    try:
        rows = json.loads(path.read_bytes())
        return {(str(robot), str(name)): _Sent(float(begin_s), is_on is True) for robot, name, begin_s, is_on in rows}
    except (OSError, ValueError, TypeError):
        return {}
