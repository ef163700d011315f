"""Which version a robot should run, as MLflow's registry says: aliases of a registered model; and the way of a version into it.

By hand (``mlflow_rest.py``): an answer has some 500 bytes, and MLflow's own client takes seconds to import.
https://mlflow.org/docs/latest/api_reference/rest-api.html
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Protocol
from urllib.parse import urlencode

from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused, TrackingRefused
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.mlflow_rest import MlflowRest
from shadowhound_data_logger.policies.manifest import BUCKET, PREFIX

CHAMPION, CANARY = 'champion', 'canary'
ROBOTS_TAG: Final = 'shadowhound.robots'
"""Of a version: the robots that take it as a canary, with commas between them."""
ID_TAG: Final = 'shadowhound.policy'
PAGE: Final = 200
"""Versions that are asked for at once: an answer with them has some 200 KB."""
MOST_PAGES: Final = 500
_NOT_THERE: Final = frozenset({'RESOURCE_DOES_NOT_EXIST', 'INVALID_PARAMETER_VALUE'})
"""MLflow says the latter of an alias that a model does not have."""


@dataclass(frozen=True, slots=True)
class RegisteredVersion:
    """A version in the registry, none of which is believed."""

    name: str
    version: int
    source: str
    robots: frozenset[str]
    """Those that are to try it."""


class PolicyRegistry(Protocol):
    """What a robot asks."""

    def alias(self, name: str, alias: str) -> RegisteredVersion | None:
        """The version that has an alias; None where there is none. Raises TrackingError."""


class MlflowRegistry:
    """The registry of an MLflow server. One request a call."""

    def __init__(self, rest: MlflowRest) -> None:
        self._rest = rest

    def alias(self, name: str, alias: str) -> RegisteredVersion | None:
        try:
            told = self._rest.json('GET', 'registered-models/alias?' + urlencode({'name': name, 'alias': alias}))
        except TrackingRefused as error:
            if error.data['code'] in _NOT_THERE:
                return None
            raise
        return _version(told.get('model_version'))

    def versions(self, name: str) -> list[RegisteredVersion]:
        """All of a model, the newest first. Raises PolicyError for more than anybody can have made."""
        asked = {'filter': f"name='{name}'", 'max_results': str(PAGE), 'order_by': 'version_number DESC'}
        found: list[RegisteredVersion] = []
        for _ in range(MOST_PAGES):
            told = self._rest.json('GET', f'model-versions/search?{urlencode(asked)}')
            found += map(_version, told.get('model_versions', []))
            if not (token := told.get('next_page_token')):
                return found
            asked['page_token'] = str(token)
        raise PolicyError(f'the registry names more than {PAGE * MOST_PAGES:,} versions of {name}')

    def register(self, name: str, source: str, tags: dict[str, str], run: str) -> int:
        """The number of a new version, or of the one that has this source already."""
        try:
            self._rest.json('POST', 'registered-models/create', {'name': name})
        except TrackingRefused as error:
            if error.data['code'] != 'RESOURCE_ALREADY_EXISTS':
                raise
        number = next((each.version for each in self.versions(name) if each.source == source), 0)
        if not number:
            body = {'name': name, 'source': source, **({'run_id': run} if run else {}),
                    'tags': [{'key': key, 'value': value} for key, value in tags.items()]}  # fmt: skip
            number = _version(self._rest.json('POST', 'model-versions/create', body).get('model_version')).version
        return number

    def tag(self, name: str, version: int, key: str, value: str) -> None:
        self._rest.json('POST', 'model-versions/set-tag', {'name': name, 'version': str(version), 'key': key, 'value': value})

    def set_alias(self, name: str, alias: str, version: int) -> None:
        """Give a version an alias, which another one loses."""
        self._rest.json('POST', 'registered-models/alias', {'name': name, 'alias': alias, 'version': str(version)})


def choose(registry: PolicyRegistry, name: str, robot: str) -> RegisteredVersion | None:
    """What a robot should run: its own alias, else the canary if that lists it, else the champion."""
    if (own := registry.alias(name, f'robot-{robot}')) is not None:
        return own
    canary = registry.alias(name, CANARY)
    if canary is not None and robot in canary.robots:
        return canary
    return registry.alias(name, CHAMPION)


def source_of(robot_type: str, name: str, version: int) -> str:
    """Where a version is: ``s3://lerobot/policies/go2/go2_patrol_v7``."""
    return f's3://{BUCKET}/{PREFIX}/{robot_type}/{name}_v{version}'


def folder_of(chosen: RegisteredVersion, name: str) -> str:
    """The prefix of the keys of a version. Raises PolicyRefused (``source``) where the registry names anything else."""
    source = chosen.source.rstrip('/')
    robot_type = source.removeprefix(f's3://{BUCKET}/{PREFIX}/').partition('/')[0]
    if chosen.name != name or not is_name(robot_type) or source != source_of(robot_type, name, chosen.version):
        text = f'the registry says that {name}@{chosen.version} is at {chosen.source[:200]!r}, where it cannot be'
        raise PolicyRefused('source', text)
    return source.removeprefix(f's3://{BUCKET}/')


def _version(told: Any) -> RegisteredVersion:
    try:
        number = int(str(told['version'])[:9])
        tags = {str(tag['key']): str(tag.get('value', '')) for tag in told.get('tags', [])}
        robots = frozenset(robot.strip() for robot in tags.get(ROBOTS_TAG, '').split(',') if robot.strip())
        return RegisteredVersion(str(told['name']), number, str(told.get('source', '')), robots)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PolicyError(f'the registry answers with something that is no version of a model: {str(told)[:100]!r}') from error
