"""What a Foxglove or Lichtblick is sent, in their WebSocket protocol: serialized messages as they came, with their definitions.

The protocol (github.com/foxglove/ws-protocol, docs/spec.md; ``foxglove.sdk.v1`` is the same here): the server tells in
JSON who it is and which channels there are, the client subscribes to some, and each message goes as a binary one. Nothing is
decoded. A topic is read while a client is subscribed to it, and what a link cannot carry in time is left out: of pictures, clouds
and other large messages only the newest waits.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections import deque
from collections.abc import Mapping
from typing import Any, Final, TypeGuard

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.live.kinds import KINDS, LiveItem

PROTOCOLS: Final = ('foxglove.sdk.v1', 'foxglove.websocket.v1')
MOST_SUBSCRIPTIONS: Final = 200
MOST_WAITING: Final = 64
"""Messages of a topic of small ones; older ones are left out."""
LARGE: Final = 32 << 10
"""Bytes of a message of which the newest alone waits."""
_MESSAGE_DATA: Final = 1
_WARNING, _ERROR = 1, 2
"""Levels of a status."""
_UINT32: Final = 1 << 32


class FoxgloveClient:
    """Decides what one client is sent. Used by the event loop alone.

    ``publish`` which topics there are and ``offer`` what comes; ``next`` until it is None, then wait for ``ready``.
    """

    def __init__(self, robot: str, session: str) -> None:
        self.ready = asyncio.Event()
        self._graph: dict[str, str] = {}
        self._ids: dict[str, int] = {}
        self._last_id = 0
        self._subscribed: dict[str, int] = {}  # topic -> the client's number of its subscription
        self._texts: deque[str] = deque()
        self._waiting: dict[str, deque[LiveItem]] = {}
        self._say(
            op='serverInfo', name=f'shadowhound {robot}', capabilities=[], supportedEncodings=[], metadata={}, sessionId=session
        )

    @property
    def watched(self) -> frozenset[str]:
        """Topics to which it is subscribed."""
        return frozenset(self._subscribed)

    def publish(self, graph: Mapping[str, str]) -> None:
        """These topics and types exist, and no others."""
        gone = [topic for topic, name in self._graph.items() if graph.get(topic) != name]
        if numbers := [self._ids.pop(topic) for topic in gone if topic in self._ids]:
            self._say(op='unadvertise', channelIds=numbers)
        for topic in gone:
            self._subscribed.pop(topic, None)
            self._waiting.pop(topic, None)
        channels = []
        for topic in graph.keys() - self._ids.keys():
            encoding, definition, _ = describe(graph[topic])
            if not definition:
                continue  # its messages could not be read at the other end
            self._last_id += 1
            self._ids[topic] = self._last_id
            channels.append({'id': self._last_id, 'topic': topic, 'encoding': 'cdr', 'schemaName': graph[topic],
                             'schemaEncoding': encoding, 'schema': definition})  # fmt: skip
        self._graph = dict(graph)
        if channels:
            self._say(op='advertise', channels=sorted(channels, key=lambda channel: str(channel['topic'])))

    def take(self, said: Mapping[str, Any]) -> None:
        """What the client said, as parsed JSON; what is wrong is told to it."""
        topics = {number: topic for topic, number in self._ids.items()}
        if said.get('op') == 'subscribe':
            for one in _list(said, 'subscriptions'):
                number, channel = (one.get('id'), one.get('channelId')) if isinstance(one, dict) else (None, None)
                if not _is_number(number) or not _is_number(channel) or channel not in topics:
                    self._complain(f'there is no channel {str(channel)[:40]}')
                elif topics[channel] in self._subscribed or len(self._subscribed) >= MOST_SUBSCRIPTIONS:
                    self._complain(f'channel {channel} is subscribed, or {MOST_SUBSCRIPTIONS} are')
                else:
                    self._subscribed[topics[channel]] = number
        elif said.get('op') == 'unsubscribe':
            numbers = _list(said, 'subscriptionIds')
            for topic in [topic for topic, number in self._subscribed.items() if number in numbers]:
                del self._subscribed[topic]
                self._waiting.pop(topic, None)
        else:
            self._complain('this server takes subscribe and unsubscribe')

    def offer(self, item: LiveItem) -> None:
        """Send this message of a topic when there is room."""
        if item.topic not in self.watched:
            return
        waiting = self._waiting.setdefault(item.topic, deque(maxlen=MOST_WAITING))
        kind = KINDS.get(self._graph.get(item.topic, ''))
        if len(item.body) > LARGE or (kind is not None and kind.is_bulk):
            waiting.clear()
        waiting.append(item)
        self.ready.set()

    def next(self) -> str | bytes | None:
        """What is sent now, small messages first; None while nothing waits."""
        if self._texts:
            return self._texts.popleft()
        waiting = [topic for topic, items in self._waiting.items() if items]
        if not waiting:
            return None
        topic = min(waiting, key=lambda name: len(self._waiting[name][0].body) > LARGE)
        item = self._waiting[topic].popleft()
        self._waiting[topic] = self._waiting.pop(topic)  # the others have their turn first
        return struct.pack('<BIQ', _MESSAGE_DATA, self._subscribed[topic], int((item.head or {})['at_ns'])) + item.body

    def _complain(self, message: str) -> None:
        if len(self._texts) < MOST_WAITING:
            self._say(op='status', level=_WARNING, message=message)

    def _say(self, **what: Any) -> None:
        self._texts.append(json.dumps(what))
        self.ready.set()


def refusal(message: str) -> str:
    """What a client is told that may not stay: its alerts show it."""
    return json.dumps({'op': 'status', 'level': _ERROR, 'message': message})


def _list(said: Mapping[str, Any], name: str) -> list[Any]:
    found = said.get(name)
    return found[:MOST_SUBSCRIPTIONS] if isinstance(found, list) else []


def _is_number(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _UINT32
