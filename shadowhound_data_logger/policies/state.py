"""``state.json``: which versions of policies were active, misbehaved, or were verified on this robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import orjson

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.untrusted import from_strict_json
from shadowhound_data_logger.policies.manifest import split_id
from shadowhound_data_logger.policies.versions import read_file

MAX_STATE_BYTES: Final = 4 << 20
MAX_REMEMBERED: Final = 1000
"""Versions for which a robot remembers that they were verified here, or misbehaved."""


@dataclass(slots=True)
class PolicyState:
    """The content of ``state.json``."""

    pin: str | None = None
    """The id that stays active, regardless of the registry."""
    history: list[str] = field(default_factory=list)
    """Previously active ids, the newest last."""
    verified: dict[str, str] = field(default_factory=dict)
    """Id -> the isolation of its smoke run, for all versions that passed every check here, including deleted ones."""
    bad: dict[str, str] = field(default_factory=dict)
    """Id -> why it was rolled back; only ``use`` activates such a version again."""
    withdrawn: list[str] = field(default_factory=list)
    """Ids of versions that were verified here and that no signer lists any longer: they must not run."""


class StateFile:
    """Reads and writes the state of a robot's policies. Any number of processes may use it."""

    def __init__(self, policies: Path) -> None:
        self._path = policies / 'state.json'
        self._lock_path = policies / 'lock'

    def lock(self) -> AbstractContextManager[bool]:
        """Lock the state and the link to the active version, which change together."""
        return durable_files.flock(self._lock_path)

    def read(self) -> PolicyState:
        """Raises PolicyError for a damaged file: then nothing changes, and the active policy keeps running."""
        try:
            return _parse_state(from_strict_json(read_file(self._path, MAX_STATE_BYTES), MAX_STATE_BYTES))
        except FileNotFoundError:
            return PolicyState()
        except (ValueError, TypeError, KeyError, PolicyRefused) as error:
            remedy = (f'remove {self._path}: this robot then forgets which policies misbehaved and which older versions it must '
                      'refuse')  # fmt: skip
            raise PolicyError(f'{self._path} is damaged: {error}', remedy=remedy) from error

    def write(self, state: PolicyState) -> None:
        """Write the state, with the lock held. Forgets the oldest entries beyond ``MAX_REMEMBERED``."""
        state.history = state.history[-MAX_REMEMBERED:]
        state.bad = dict([*state.bad.items()][-MAX_REMEMBERED:])
        state.verified = dict([*state.verified.items()][-MAX_REMEMBERED:])
        content = {'format': 1, **{name: getattr(state, name) for name in PolicyState.__slots__}}
        with durable_files.replacing(self._path, is_synced=True, mode=0o600) as file:
            file.write(orjson.dumps(content, option=orjson.OPT_INDENT_2) + b'\n')
        durable_files.sync(self._path.parent)

    @contextmanager
    def changing(self) -> Iterator[PolicyState]:
        """Lock the state, yield it to be changed, and write it."""
        with self.lock():
            state = self.read()
            yield state
            self.write(state)


def newest_of(state: PolicyState, name: str) -> int:
    """The highest version of a policy that was verified here and is still listed; 0 if there is none."""
    known = (split_id(each) for each in state.verified if each not in state.withdrawn)
    return max((each[1] for each in known if each and each[0] == name), default=0)


def _parse_state(given: Mapping[str, Any]) -> PolicyState:
    if given['format'] != 1:
        raise ValueError('it was written by another version of this package')
    state = PolicyState(**{name: given[name] for name in PolicyState.__slots__})
    types: dict[str, Any] = {'history': list, 'verified': dict, 'bad': dict, 'withdrawn': list}
    if any(not isinstance(getattr(state, name), type_) for name, type_ in types.items()):
        raise ValueError('its fields have the wrong types')
    return state
