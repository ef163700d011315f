"""The service of the events: ``~/event/trigger`` (Trigger) begins one, or makes the one that goes on last longer.

It answers at once; ``message`` names the bag, or says why there is none.
"""

from __future__ import annotations

import logging
from typing import Any, Final

from rclpy.node import Node
from std_srvs.srv import Trigger

from shadowhound_data_logger.bags.events import Events

log = logging.getLogger(__name__)

NAME: Final = 'manual'
"""Of an event that somebody asked for."""
SERVICE: Final = 'service'


class EventControl:
    """New; open once; close once."""

    def __init__(self, node: Node, events: Events) -> None:
        self._node = node
        self._events = events
        self._service: Any = None

    def open(self) -> None:
        self._service = self._node.create_service(Trigger, '~/event/trigger', self._on_trigger)

    def close(self) -> None:
        if self._service is not None:
            self._node.destroy_service(self._service)
            self._service = None

    def _on_trigger(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._events.trigger(NAME, SERVICE)
        if not response.success:
            log.warning('~/event/trigger: %s', response.message)
        return response
