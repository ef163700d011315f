"""The file of ``export lerobot --config``: which topics and fields become which features, and how missions become episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.stamps import BY_STAMP
from shadowhound_data_logger.core.untrusted import from_yaml
from shadowhound_data_logger.datasets.clocks import read_pairs
from shadowhound_data_logger.datasets.features import AUTO, AV1, MAPPED, OWN_FILES, ExportOptions, StatePart

REMEDY: Final = 'docs/datasets.md describes the file; see also examples/export_base.yaml and export_arm.yaml'
_QUATERNION: Final = tuple('xyzw')


@dataclass(frozen=True, slots=True)
class TopicFields:
    """Fields of a topic's messages."""

    topic: str
    fields: tuple[str, ...]
    """Paths in the message, such as ``twist.twist.linear.x``; a list contributes all its numbers."""
    names: tuple[str, ...] = ()
    """One per number; by default the joints' names in the message, otherwise the fields."""
    units: tuple[str, ...] = ()
    """One per number, or one for all."""

    def part(self, name: str) -> StatePart:
        """Raises ValueError."""
        if not self.topic.startswith('/') or not self.fields:
            raise ValueError(
                f'{self.topic!r} with fields {list(self.fields)}: a topic starts with a slash, and fields are not empty'
            )
        return StatePart(name, self.topic, self.fields, self.names, self.units or ('',), tuple(_turns(self.fields)))


@dataclass(frozen=True, slots=True)
class ExportFile:
    """The content of the file, one field per key; docs/datasets.md has the table."""

    images: Mapping[str, str] = field(default_factory=lambda: {'front': 'camera'})
    state: tuple[Any, ...] = ('pose',)
    action: Any = AUTO
    fps: Any = AUTO
    by: str = BY_STAMP
    resample: Mapping[str, str] = field(default_factory=dict)
    max_age_s: Mapping[str, float] = field(default_factory=dict)
    max_gap_s: float = 5.0
    max_stale: float = 0.05
    codec: str = AV1
    lossless: bool = False
    layout: str = OWN_FILES
    labels: bool = False
    validation: float = 0.0
    validation_label: str = ''
    robot_type: str = ''
    arm: str = ''
    arm_clock: str = ''
    task: bool = False

    def options(self, folder: Path, *, allow_gaps: bool = False) -> ExportOptions:
        """Paths are relative to ``folder``. Raises LakeError, SettingError, ValueError."""
        if self.robot_type:
            check_name(self.robot_type, 'robot_type')
        if self.arm:
            check_name(self.arm, 'arm')
        if self.fps != AUTO and (not isinstance(self.fps, int) or isinstance(self.fps, bool)):
            raise ValueError(f'fps is not auto or a whole number, but {self.fps!r}')
        pairs = read_pairs(folder / self.arm_clock) if self.arm_clock else ()
        return ExportOptions(
            fps=None if self.fps == AUTO else self.fps, images=self.images,
            state=tuple(each if isinstance(each, str) else _part(each, 'state') for each in self.state),
            action=self.action if isinstance(self.action, str) else _part(self.action, 'action', MAPPED),
            by=self.by, resample=self.resample, max_age_s=self.max_age_s, max_gap_s=self.max_gap_s, max_stale=self.max_stale,
            codec=self.codec, is_lossless=self.lossless, layout=self.layout, labels=self.labels, validation=self.validation,
            validation_label=self.validation_label, robot_type=self.robot_type, arm=self.arm, allow_gaps=allow_gaps,
            clock_pairs=tuple((int(robot), int(arm)) for robot, arm in pairs),
        )  # fmt: skip


def read(path: Path) -> ExportFile:
    """Read the file. Raises LakeError with its name."""
    try:
        given = from_yaml(path.read_text(encoding='utf-8'))
        given = {} if given is None else given
        _check_keys(given, ExportFile, '')
        return parse(ExportFile, given)
    except (ValueError, OSError) as error:
        raise LakeError(f'{path}: {error}', remedy=REMEDY) from error


def _part(given: Any, key: str, name: str = '') -> StatePart:
    _check_keys(given, TopicFields, f' of {key}')
    found = parse(TopicFields, given)
    return found.part(name or found.topic.strip('/').replace('/', '_'))


def _check_keys(given: Any, kind: type[ExportFile | TopicFields], where: str) -> None:
    if not isinstance(given, dict):
        raise ValueError(f'{given!r}{where} is not a mapping of keys to values')  # noqa: TRY004 - one error for bad input
    known = [each.name for each in fields(kind)]
    for name in given:
        if name not in known:
            near = get_close_matches(str(name), known, 1)
            raise ValueError(
                f'there is no key {name!r}{where}: ' + (f'is it {near[0]}?' if near else f'known keys are {", ".join(known)}')
            )


def _turns(paths: tuple[str, ...]) -> Iterable[slice]:
    """Find consecutive ``....x`` to ``....w`` of one orientation."""
    for first in range(len(paths) - 3):
        prefixes, axes = zip(*(path.rpartition('.')[::2] for path in paths[first : first + 4]), strict=True)
        if axes == _QUATERNION and len(set(prefixes)) == 1:
            yield slice(first, first + 4)
