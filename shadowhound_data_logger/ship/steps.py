"""What passes between the Schedule and the threads that act for it: all frozen, without behaviour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.ship.outage import Notice
from shadowhound_data_logger.ship.retry import Verdict


@dataclass(frozen=True, slots=True)
class Ship:
    """Put this object, then call ``delivered``, ``failed`` or ``crashed``."""

    item: SpooledObject


@dataclass(frozen=True, slots=True)
class Look:
    """Ask the spool for what is pending, then call ``found`` or ``look_failed``."""

    exclude: frozenset[int]
    without: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Rest:
    """There is nothing to do for so long, or until something changes: call ``rest`` with it."""

    seconds: float
    version: int


Step = Ship | Look | Rest


@dataclass(frozen=True, slots=True)
class Ruling:
    """What follows from a failure: the reason to quarantine the object, if so, and what is to be logged."""

    quarantine: str | None = None
    notices: Sequence[Notice] = ()


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The schedule at one instant."""

    active: bool | None
    """Whether this process drains; None while it is not known yet."""
    outage: Verdict | None
    blocked: Mapping[str, str]
    """Bucket -> why its objects wait."""
    in_flight: int
    ready: int
    deferred: int
    delivered: int
    retries: int
    last_error: str
