"""What checks, their runner and the report exchange: a check, what it may know, and what it found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import DataLoggerError, SettingError


class Role(str, Enum):
    """What this machine is."""

    THOR = 'thor'
    """The robot: it logs, keeps a spool, and may neither list nor delete on Tower."""
    TOWER = 'tower'
    """The servers."""
    SPARK = 'spark'
    """It reads what is in the store, and trains."""


EVERYWHERE: Final = frozenset(Role)
THOR: Final = frozenset({Role.THOR})
TOWER: Final = frozenset({Role.TOWER})


class Severity(str, Enum):
    """How much a result matters; warnings and errors are findings."""

    OK = 'ok'
    INFO = 'info'
    """Good to know; nothing has to be done."""
    WARNING = 'warning'
    """It works, but not as well or as safely as it should."""
    ERROR = 'error'
    """Something does not work."""
    SKIPPED = 'skipped'
    """Not asked, because of what another check found."""


FINDINGS: Final = frozenset({Severity.WARNING, Severity.ERROR})


@dataclass(frozen=True, slots=True)
class Result:
    """One answer; ``check`` is dotted and begins with the name of the check that gave it, such as ``s3.signature``."""

    check: str
    severity: Severity
    seen: str
    cause: str = ''
    remedy: str = ''
    """Words or, better, a command to paste."""
    took_s: float = 0.0
    fix: tuple[str, ...] = ()
    """What ``--fix`` may do about it: ('mode', path, octal) or ('bucket', name)."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """Figures for programs, and for the checks that come after."""

    @property
    def is_finding(self) -> bool:
        return self.severity in FINDINGS

    def as_dict(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        return {**asdict(self), 'severity': self.severity.value, 'fix': list(self.fix), 'data': dict(self.data)}

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> Result:
        return cls(**{**given, 'severity': Severity(given['severity']), 'fix': tuple(given['fix'])})


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """What a check may know. Made by ``context.make``."""

    role: Role
    environ: Mapping[str, str]
    settings: Settings
    """Those of the node; where some are refused, what is left of them."""
    refused: tuple[SettingError, ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Flat ROS parameters as they were given."""
    parameter_file: Path | None = None
    namespace: str = '/'
    """Of the node."""
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    """Rates at which topics are expected where it is not those of ``expected``."""
    root: Path = Path('/')
    """Where ``proc``, ``etc``, ``run`` and ``dev`` of this machine are."""
    earlier: Mapping[str, tuple[Result, ...]] = field(default_factory=dict)
    """What the checks that this one comes after have found."""

    def failed(self, check: str) -> Result | None:
        """The error of an earlier check that makes asking further useless."""
        return next((result for result in self.earlier.get(check, ()) if result.severity is Severity.ERROR), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Something that is asked of a machine."""

    name: str
    run: Callable[[Context], Iterable[Result]]
    """May take long, hang or raise: the runner sees to that."""
    roles: frozenset[Role] = EVERYWHERE
    deadline_s: float = 5.0
    after: tuple[str, ...] = ()
    """Checks that have ended before this one begins."""
    apart: bool = False
    """In a process of its own, because it may crash or hang beyond what a thread can be left alone with."""


def ok(check: str, seen: str, **data: Any) -> Result:
    """As it should be."""
    return Result(check, Severity.OK, seen, data=data)


def info(check: str, seen: str, cause: str = '', remedy: str = '', **data: Any) -> Result:
    """No finding."""
    return Result(check, Severity.INFO, seen, cause, remedy, data=data)


def warning(check: str, seen: str, cause: str, remedy: str, *, fix: tuple[str, ...] = (), **data: Any) -> Result:
    """A finding; it works all the same."""
    return Result(check, Severity.WARNING, seen, cause, remedy, fix=fix, data=data)


def measured(check: str, seen: str, cause: str, remedy: str, *, is_fine: bool, **data: Any) -> Result:
    """A figure: as it should be, or a finding though it works all the same."""
    return ok(check, seen, **data) if is_fine else warning(check, seen, cause, remedy, **data)


def error(check: str, seen: str, cause: str, remedy: str, *, fix: tuple[str, ...] = (), **data: Any) -> Result:
    """A finding; something does not work."""
    return Result(check, Severity.ERROR, seen, cause, remedy, fix=fix, data=data)


def skipped(check: str, why: Result) -> Result:
    """Not asked because of another result."""
    return Result(check, Severity.SKIPPED, f'not run, because of {why.check}')


def of_error(check: str, problem: DataLoggerError, cause: str = '', *, fix: tuple[str, ...] = ()) -> Result:
    """An error of ours says itself what happened and what to do."""
    text = problem.args[0] if problem.args else type(problem).__name__
    return error(check, str(text), cause, problem.remedy, fix=fix)
