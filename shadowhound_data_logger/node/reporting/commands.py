"""What a running node can be asked to do, each defined once: services, parameters and the control socket all use it.

A request and its answer are plain values, as JSON has them: ``{"do": "flush"}`` is answered by ``{"ok": true, "robot": "thor",
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
from shadowhound_data_logger.spool.act_record import ActRecord

log = logging.getLogger(__name__)

FLUSH_S: Final = 5.0
"""A caller is told what has not been done by then; it takes a fraction of that unless the disk is slow."""
MANUAL: Final = 'manual'
"""Name of an event that somebody asked for and did not name."""
ASKERS: Final = ('command', 'service', 'page')
"""By whom it is said to have been triggered."""
MAX_NAME: Final = 100
"""Letters of an event's name."""
YIELD_S: Final = 5.0
"""For so long uploads yield to whoever watches, unless it is asked for again: a live page that was killed slows nothing down."""
WHO: Final = 'who'
"""With any request: whom somebody asks for, to be said in the log, in the ledger and in the manifest of an event."""
MAX_NOTE: Final = 1000
"""Letters of what is said of it."""


class Settable(Protocol):
    """The parameters of the node."""

    def get(self, names: list[str]) -> dict[str, Any]: ...
    def set(self, values: Mapping[str, Any]) -> Answer: ...
    def described(self) -> list[dict[str, Any]]: ...


@dataclass(frozen=True, slots=True)
class _Command:
    do: Callable[..., Answer | dict[str, Any]]
    arguments: Mapping[str, type] = field(default_factory=dict)
    quiet: bool = False
    """Whether a success is worth no line in the log: it only tells something, or whoever does it says so."""
    takes_who: bool = False


class Commands:
    """Everything that the node can be asked to do.

    Used by the main thread alone: one command is done after the other, and a flush may take ``FLUSH_S``.
    """

    def __init__(self, stages: Stages, parameters: Settable, status: Status, acts: ActRecord, robot: str, node: str) -> None:
        """``acts`` keeps what somebody with a name asked for; ``node`` is the full name under which ROS knows the node."""
        self._stages = stages
        self._parameters = parameters
        self._status = status
        self._acts = acts
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
            'status': _Command(self._tell_status, quiet=True),
            'mission': _Command(self._tell_mission, quiet=True),
            'diagnostics': _Command(self._diagnose, quiet=True),
            'describe': _Command(self._describe, quiet=True),
            'compare': _Command(self._compare, {'found': dict}, quiet=True),
        }

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Do what is asked, and say what became of it; whatever goes wrong with it, the node goes on."""
        try:
            done = self._do(request)
        except DataLoggerError as error:
            done = False, str(error)
        except Exception as error:  # whoever asks must not be able to end the node
            log.exception('%r failed', request.get('do'))
            done = False, f'it failed, which is a defect of this program: {type(error).__name__}: {error}'
        if isinstance(done, dict):
            return {'ok': True, 'robot': self._robot, **done}
        if who := _who(request):
            self._acts.add(who, printable(str(request.get('do')))[:MAX_NAME], ok=done[0], said=done[1])
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

    # -- what they do ----------------------------------------------------------------------------------------------

    def _flush(self, deadline_s: float = FLUSH_S) -> Answer:
        """Spool all that was taken or waits to be; whether that worked, and what became durable, in words."""
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
        """Begin or end a pause; whether it is in force, and what became of the open batches, in words."""
        intake = self._stages.intake
        if paused is intake.paused:
            return True, 'paused already' if paused else 'not paused'
        end_s = time.monotonic() + FLUSH_S
        if not intake.pause(FLUSH_S, paused=paused):
            return False, f'the intake did not do it within {FLUSH_S:g} s; it does as soon as it can'
        if not paused:
            return True, 'messages are stored again'
        _, spooled = self._flush(end_s - time.monotonic())
        return True, f'paused: messages are counted and not stored, delivery continues; {spooled}'

    def _trigger(self, name: str = MANUAL, note: str = '', by: str = ASKERS[0], who: str = '') -> Answer:
        """Begin an event, or make the one that goes on last longer; names the bag."""
        if not 0 < len(name) <= MAX_NAME or len(note) > MAX_NOTE:
            return False, f'an event has a name of 1 to {MAX_NAME} letters, and a note of up to {MAX_NOTE}'
        if by not in ASKERS:
            return False, f'an event is triggered by {" or ".join(ASKERS)}, not {by[:MAX_NAME]!r}'
        return self._stages.event_buffer.events.trigger(name, by, note, who=who)

    def _pull(self, want: Mapping[str, Any] | None = None, cancel: str = '', by: str = MANUAL) -> Answer | dict[str, Any]:
        """Ask for what is kept here, or take a request back."""
        requests = self._stages.requests
        if requests is None:
            return False, 'nothing is kept here: ship of all sensors and of bag is always'
        try:
            return {'id': requests.cancel(cancel, by) if cancel else requests.ask(want or {}, by)}
        except RequestRefused as error:
            return False, str(error)

    def _yield(self, max_mbps: float = 0.0) -> Answer:
        """Leave the link to whoever watches the robot, for some seconds."""
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

    def _tell_status(self) -> Answer | dict[str, Any]:
        """Of up to a second ago."""
        status = self._status.latest
        return {'status': as_plain(status)} if status else (False, 'there is no status yet')

    def _tell_mission(self) -> dict[str, Any]:
        return {'mission': fields_of(self._stages.mission.status())}

    def _diagnose(self) -> Answer | dict[str, Any]:
        """What /diagnostics says of up to a second ago."""
        status = self._status.latest
        return {'diagnostics': plain_entries(status, self._status.earlier)} if status else (False, 'there is no status yet')

    def _describe(self) -> dict[str, Any]:
        return {'node': self._node, 'pid': os.getpid(), 'version': self._status.version, 'commands': list(self._known)}

    def _compare(self, found: Mapping[str, Any] | None = None) -> Answer | dict[str, Any]:
        """Of the front: the publishers that the robot's RMW finds beyond ours."""
        unheard = self._stages.unheard
        return unheard.compare(found or {}) if unheard is not None else (False, 'the node listens through the RMW of the robot')


_KINDS: Final[Mapping[type, str]] = {str: 'a string', float: 'a number with a point', list: 'a list', dict: 'an object'}


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def _who(request: Mapping[str, Any]) -> str:
    """For whom it is asked; empty where nobody says so."""
    return printable(str(request.get(WHO, '')))[:MAX_NAME]
