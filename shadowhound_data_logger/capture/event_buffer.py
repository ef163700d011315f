"""The event buffer of the node, put together: the ring, what triggers events, and who writes them; nothing without topics."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node

from shadowhound_data_logger.bags.events import NOTICE_S, Events
from shadowhound_data_logger.bags.place import Place
from shadowhound_data_logger.bags.recording import Outlet
from shadowhound_data_logger.bags.ring import Ring
from shadowhound_data_logger.capture.event_tap import EventTap
from shadowhound_data_logger.capture.event_watch import EventWatch
from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.options import EventSettings
from shadowhound_data_logger.worker import Worker


class EventBuffer:
    """Life: New; open once; ``close`` after the intake. ``tap`` is what the intake fills; None where nothing is kept."""

    def __init__(self, node: Node, settings: Settings, place: Place, outlet: Outlet, types: MessageTypes) -> None:
        options, home = settings.events, settings.home
        ring = Ring(options.max_bytes, options.pre_s + NOTICE_S)
        self.events = Events(options, settings.bag, place, ring, outlet, settings.intake.poll_s)
        self.tap = EventTap(node, options, ring, self.events.claims) if options.enabled else None
        self._watch = self._make_watch(options, home, place, types)

    @property
    def workers(self) -> Sequence[Worker]:
        """Those that have something to do."""
        return *self.events.workers, *([self._watch.worker] if self._watch is not None else [])

    def open(self) -> None:
        self.events.open()
        if self._watch is not None:
            self._watch.open()

    def close(self, deadline_s: float) -> bool:
        """End the event that goes on; False when that took too long."""
        end_s = time.monotonic() + deadline_s
        watched = self._watch is None or self._watch.close(deadline_s)
        return self.events.close(max(0.0, end_s - time.monotonic())) and watched

    def update(self, settings: EventSettings) -> None:
        """Go on by other settings, as far as they are live."""
        self.events.update(settings)
        if self._watch is not None:
            self._watch.update(settings.log_event)

    def on_mission(self, told: Mapping[str, Any]) -> None:
        """Which mission is active now; empty for none."""
        self.events.on_mission(told)
        if self._watch is not None:
            self._watch.on_mission(told)

    def _make_watch(self, options: EventSettings, home: Path, place: Place, types: MessageTypes) -> EventWatch | None:
        if self.tap is None:
            return None
        return EventWatch(self.tap.inbox, types, home, place.clock, options.log_event, self.events.trigger)
