"""The commands of a running node, each defined once for services, parameters and the control socket.

A request and its answer are plain JSON values: ``{"do": "flush"}`` is answered by ``{"ok": true, "robot": "thor",
"message": "..."}`` or ``{"ok": false, "robot": "thor", "error": "..."}``.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from shadowhound_data_logger.bags.recorder import Answer
from shadowhound_data_logger.core.dataclass_json import as_plain, fields_of
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.mailbox import RequestRefused
from shadowhound_data_logger.node.reporting.diagnostics import plain_entries
from shadowhound_data_logger.node.reporting.status import Stages, Status
from shadowhound_data_logger.spool.operator_requests import OperatorRequests

log = logging.getLogger(__name__)

FLUSH_S: Final = 5.0
"""Timeout of a flush, reported to the caller; it takes a fraction of that unless the disk is slow."""
DEFAULT_NAME: Final = 'manual'
"""Name of a requested event without a name."""
TRIGGERED_BY: Final = ('command', 'service', 'page')
"""Possible triggers, as recorded in the event."""
MAX_NAME: Final = 100
"""Maximum letters of an event's name."""
YIELD_S: Final = 5.0
"""How long uploads yield to viewers after a request: a live page that was killed slows nothing down."""
WHO: Final = 'who'
"""In any request: the requester, for the log, the ledger and the manifest of an event."""
MAX_NOTE: Final = 1000
"""Maximum letters of a note."""


class ParameterAccess(Protocol):
    """The parameters of the node."""

    def get(self, names: list[str]) -> dict[str, Any]: ...
    def set(self, values: Mapping[str, Any]) -> Answer: ...
    def described(self) -> list[dict[str, Any]]: ...


@dataclass(frozen=True, slots=True)
class _Command:
    do: Callable[..., Answer | dict[str, Any]]
    arguments: Mapping[str, type] = field(default_factory=dict)
    quiet: bool = False
    """Whether a success is not logged: it only reads something, or its implementation logs it."""
    takes_who: bool = False


class Commands:
    """All commands of the node.

    Used by the main thread only: commands are handled one at a time, and a flush may take ``FLUSH_S``.
    """

    def __init__(
        self, stages: Stages, parameters: ParameterAccess, status: Status, requests: OperatorRequests, robot: str, node: str
    ) -> None:
        """``requests`` records requests with a named requester; ``node`` is the logger's full public name in ROS."""
        self._stages = stages
        self._parameters = parameters
        self._status = status
        self._requests = requests
        self._robot = robot
        self._node = node
        recorder = stages.recorder
        self._known: Mapping[str, _Command] = {
            'flush': _Command(self._flush),
            'pause': _Command(lambda: self._pause(paused=True)),
            'resume': _Command(lambda: self._pause(paused=False)),
            'bag start': _Command(recorder.start, quiet=True),
            'bag stop': _Command(recorder.stop, quiet=True),
            'bag split': _Command(recorder.split),
            'bag pause': _Command(lambda: recorder.pause(paused=True)),
            'bag resume': _Command(lambda: recorder.pause(paused=False)),
            'event': _Command(self._trigger, {'name': str, 'note': str, 'by': str}, quiet=True, takes_who=True),
            'pull': _Command(self._pull, {'want': dict, 'cancel': str, 'by': str}),
            'yield': _Command(self._yield, {'max_mbps': float}, quiet=True),
            'set': _Command(self._set, {'values': dict}, quiet=True),
            'get': _Command(self._get, {'names': list}, quiet=True),
            'parameters': _Command(self._list, quiet=True),
            'status': _Command(self._get_status, quiet=True),
            'mission': _Command(self._get_mission, quiet=True),
            'diagnostics': _Command(self._diagnose, quiet=True),
            'describe': _Command(self._describe, quiet=True),
            'compare': _Command(self._compare, {'found': dict}, quiet=True),
        }

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Handle a request and return the answer; the node continues whatever fails."""
        try:
            done = self._do(request)
        except DataLoggerError as error:
            done = False, str(error)
        except Exception as error:  # a request must not be able to stop the node
            log.exception('%r failed', request.get('do'))
            done = False, f'it failed because of a bug in this program: {type(error).__name__}: {error}'
        if isinstance(done, dict):
            return {'ok': True, 'robot': self._robot, **done}
        if who := _who(request):
            self._requests.add(who, printable(str(request.get('do')))[:MAX_NAME], ok=done[0], answer=done[1])
        return {'ok': done[0], 'robot': self._robot, 'message' if done[0] else 'error': done[1]}

    def _do(self, request: Mapping[str, Any]) -> Answer | dict[str, Any]:
        name = request.get('do')
        command = self._known.get(name) if isinstance(name, str) else None
        if command is None:
            return False, f'"do" is one of {", ".join(self._known)}; it is {str(name)[:MAX_NAME]!r}'
        who = _who(request)
        arguments = {key: value for key, value in request.items() if key not in ('do', WHO)}
        for key, value in arguments.items():
            kind = command.arguments.get(key)
            if kind is None:
                takes = ', '.join(command.arguments) or 'nothing else'
                return False, f'{name} takes {takes}, and no {key[:MAX_NAME]!r}'
            if not isinstance(value, kind):
                return False, f'{key} of {name} is {_KINDS[kind]}, not {str(value)[:MAX_NAME]!r}'
        done = command.do(**arguments, **({WHO: who} if command.takes_who else {}))
        if not isinstance(done, dict) and (who or not (done[0] and command.quiet)):
            log.log(logging.INFO if done[0] else logging.WARNING, '%s%s: %s', who and f'{who}: ', name, done[1])
        return done

    # -- implementations -------------------------------------------------------------------------------------------

    def _flush(self, deadline_s: float = FLUSH_S) -> Answer:
        """Spool everything taken so far; returns whether that succeeded, and a text with what became durable."""
        end_s = time.monotonic() + deadline_s
        writer = self._stages.writer
        before = writer.written()
        stages = {
            'intake': self._stages.intake.flush,
            'encode pool': self._stages.queue.finished,
            'spool writer': writer.flush,
        }
        for name, flush in stages.items():
            if not flush(max(0.0, end_s - time.monotonic())):
                return False, f'not everything is spooled: the {name} did not finish within {deadline_s:g} s'
        objects, messages = (now - then for now, then in zip(writer.written(), before, strict=True))
        return True, f'{_count(objects, "object")} with {_count(messages, "message")} spooled'

    def _pause(self, *, paused: bool) -> Answer:
        """Start or end a pause; returns whether it is in effect, and a text about the open batches."""
        intake = self._stages.intake
        if paused is intake.paused:
            return True, 'paused already' if paused else 'not paused'
        end_s = time.monotonic() + FLUSH_S
        if not intake.pause(FLUSH_S, paused=paused):
            return False, f'the intake did not do it within {FLUSH_S:g} s; it will as soon as it can'
        if not paused:
            return True, 'messages are stored again'
        _, spooled = self._flush(end_s - time.monotonic())
        return True, f'paused: messages are counted and not stored, delivery continues; {spooled}'

    def _trigger(self, name: str = DEFAULT_NAME, note: str = '', by: str = TRIGGERED_BY[0], who: str = '') -> Answer:
        """Start an event, or extend the current one; the answer names the bag."""
        if not 0 < len(name) <= MAX_NAME or len(note) > MAX_NOTE:
            return False, f'an event needs a name of 1 to {MAX_NAME} letters, and a note of up to {MAX_NOTE}'
        if by not in TRIGGERED_BY:
            return False, f'an event is triggered by {" or ".join(TRIGGERED_BY)}, not {by[:MAX_NAME]!r}'
        return self._stages.event_buffer.events.trigger(name, by, note, who=who)

    def _pull(self, want: Mapping[str, Any] | None = None, cancel: str = '', by: str = DEFAULT_NAME) -> Answer | dict[str, Any]:
        """Request kept data, or cancel a request."""
        requests = self._stages.requests
        if requests is None:
            return False, 'no data is kept here: ship of all sensors and of bag is always'
        try:
            return {'id': requests.cancel(cancel, by) if cancel else requests.ask(want or {}, by)}
        except RequestRefused as error:
            return False, str(error)

    def _yield(self, max_mbps: float = 0.0) -> Answer:
        """Leave the link to viewers for some seconds."""
        if not 0.0 < max_mbps < float('inf'):
            return False, 'yield takes max_mbps, which is above 0'
        self._stages.uploader.yield_to(max_mbps, YIELD_S)
        return True, f'uploads send at most {max_mbps:g} Mbit/s for {YIELD_S:g} s'

    def _get(self, names: list[Any] | None = None) -> Answer | dict[str, Any]:
        if not all(isinstance(name, str) for name in names or ()):
            return False, 'names of get are strings'
        return {'values': self._parameters.get(names or [])}

    def _set(self, values: Mapping[str, Any] | None = None) -> Answer:
        if not values:
            return False, 'set takes values: {"camera.rate_hz": 5.0}'
        return self._parameters.set(values)

    def _list(self) -> dict[str, Any]:
        return {'parameters': self._parameters.described()}

    def _get_status(self) -> Answer | dict[str, Any]:
        """The status, at most a second old."""
        status = self._status.latest
        return {'status': as_plain(status)} if status else (False, 'there is no status yet')

    def _get_mission(self) -> dict[str, Any]:
        return {'mission': fields_of(self._stages.mission.status())}

    def _diagnose(self) -> Answer | dict[str, Any]:
        """The entries of /diagnostics, at most a second old."""
        status = self._status.latest
        return {'diagnostics': plain_entries(status, self._status.earlier)} if status else (False, 'there is no status yet')

    def _describe(self) -> dict[str, Any]:
        return {'node': self._node, 'pid': os.getpid(), 'version': self._status.version, 'commands': list(self._known)}

    def _compare(self, found: Mapping[str, Any] | None = None) -> Answer | dict[str, Any]:
        """For the front: publishers that the robot's RMW finds and ours does not."""
        publishers = self._stages.undiscovered
        return (
            publishers.compare(found or {})
            if publishers is not None
            else (False, 'the node listens through the RMW of the robot')
        )


_KINDS: Final[Mapping[type, str]] = {str: 'a string', float: 'a number with a point', list: 'a list', dict: 'an object'}


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def _who(request: Mapping[str, Any]) -> str:
    """The requester; empty if not given."""
    return printable(str(request.get(WHO, '')))[:MAX_NAME]
