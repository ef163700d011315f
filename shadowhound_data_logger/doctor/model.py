"""The types that checks, their runner and the report share: a check, its context, and its results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import DataLoggerError, SettingError


class Role(str, Enum):
    """The role of this machine."""

    ROBOT = 'robot'
    """Logs, has a spool, and can neither list nor delete on the server."""
    SERVER = 'server'
    """Runs the S3 store and MLflow."""
    WORKSTATION = 'workstation'
    """Reads the store, and trains."""


EVERYWHERE: Final = frozenset(Role)
ROBOT: Final = frozenset({Role.ROBOT})
SERVER: Final = frozenset({Role.SERVER})


class Severity(str, Enum):
    """How serious a result is; warnings and errors are findings."""

    OK = 'ok'
    INFO = 'info'
    """For information; nothing needs to be done."""
    WARNING = 'warning'
    """It works, but not as well or as safely as it should."""
    ERROR = 'error'
    """Something does not work."""
    SKIPPED = 'skipped'
    """Not checked, because of the result of another check."""


FINDINGS: Final = frozenset({Severity.WARNING, Severity.ERROR})


@dataclass(frozen=True, slots=True)
class Result:
    """One result; ``check`` is dotted and starts with the name of its check, such as ``s3.signature``."""

    check: str
    severity: Severity
    seen: str
    cause: str = ''
    remedy: str = ''
    """Text or, better, a command to paste."""
    took_s: float = 0.0
    fix: tuple[str, ...] = ()
    """The repair that ``--fix`` can do: ('mode', path, octal) or ('bucket', name)."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """Values for programs, and for later checks."""

    @property
    def is_finding(self) -> bool:
        return self.severity in FINDINGS

    def as_dict(self) -> dict[str, Any]:
        """As printed by ``--json``."""
        return {**asdict(self), 'severity': self.severity.value, 'fix': list(self.fix), 'data': dict(self.data)}

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> Result:
        return cls(**{**given, 'severity': Severity(given['severity']), 'fix': tuple(given['fix'])})


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """The input of a check. Created by ``context.make``."""

    role: Role
    environ: Mapping[str, str]
    settings: Settings
    """The node's settings; if some are invalid, those that are left."""
    refused: tuple[SettingError, ...] = ()
    is_named: bool = True
    """False if the robot's name is the default of a node: neither given, nor that of a node that has run here."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Flat ROS parameters as given."""
    parameter_file: Path | None = None
    namespace: str = '/'
    """The node's namespace."""
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    """Expected rates by topic, where they differ from the defaults."""
    root: Path = Path('/')
    """The root of ``proc``, ``etc``, ``run`` and ``dev`` of this machine."""
    earlier: Mapping[str, tuple[Result, ...]] = field(default_factory=dict)
    """Results of the checks that this one runs after."""

    def failed(self, check: str) -> Result | None:
        """The error of an earlier check that makes further checks useless."""
        return next((result for result in self.earlier.get(check, ()) if result.severity is Severity.ERROR), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A check of a machine."""

    name: str
    run: Callable[[Context], Iterable[Result]]
    """May take long, hang or raise: the runner handles that."""
    roles: frozenset[Role] = EVERYWHERE
    deadline_s: float = 5.0
    after: tuple[str, ...] = ()
    """Checks that must end before this one starts."""
    isolated: bool = False
    """Run it in a separate process, because it may crash, or hang in a way that a thread cannot be abandoned."""


def ok(check: str, seen: str, **data: Any) -> Result:
    """As it should be."""
    return Result(check, Severity.OK, seen, data=data)


def info(check: str, seen: str, cause: str = '', remedy: str = '', **data: Any) -> Result:
    """Not a finding."""
    return Result(check, Severity.INFO, seen, cause, remedy, data=data)


def warning(check: str, seen: str, cause: str, remedy: str, *, fix: tuple[str, ...] = (), **data: Any) -> Result:
    """A finding that does not stop anything from working."""
    return Result(check, Severity.WARNING, seen, cause, remedy, fix=fix, data=data)


def measured(check: str, seen: str, cause: str, remedy: str, *, is_fine: bool, **data: Any) -> Result:
    """A measured value: fine, or a warning."""
    return ok(check, seen, **data) if is_fine else warning(check, seen, cause, remedy, **data)


def error(check: str, seen: str, cause: str, remedy: str, *, fix: tuple[str, ...] = (), **data: Any) -> Result:
    """A finding: something does not work."""
    return Result(check, Severity.ERROR, seen, cause, remedy, fix=fix, data=data)


def skipped(check: str, why: Result) -> Result:
    """Not checked because of another result."""
    return Result(check, Severity.SKIPPED, f'not run, because of {why.check}')


def from_error(check: str, problem: DataLoggerError, cause: str = '', *, fix: tuple[str, ...] = ()) -> Result:
    """A result from an error of this package, which has its own message and remedy."""
    text = problem.args[0] if problem.args else type(problem).__name__
    return error(check, str(text), cause, problem.remedy, fix=fix)
