"""MLflow's registry: aliases of a registered model select the version that a robot runs; publishing adds versions.

Uses MLflow's REST API directly (``mlflow_rest.py``), because a response has about 500 bytes and importing MLflow's client takes
seconds. https://mlflow.org/docs/latest/api_reference/rest-api.html
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
"""Tag of a version: the robots that try it as a canary, separated by commas."""
ID_TAG: Final = 'shadowhound.policy'
PAGE: Final = 200
"""Versions per request: the response has about 200 KB."""
MAX_PAGES: Final = 500
_MISSING: Final = frozenset({'RESOURCE_DOES_NOT_EXIST', 'INVALID_PARAMETER_VALUE'})
"""Error codes for an alias that does not exist; MLflow returns the latter if the model exists."""


@dataclass(frozen=True, slots=True)
class RegisteredVersion:
    """A version in the registry. Its fields are not trusted."""

    name: str
    version: int
    source: str
    robots: frozenset[str]
    """The robots that try it as a canary."""


class PolicyRegistry(Protocol):
    """The requests of a robot."""

    def alias(self, name: str, alias: str) -> RegisteredVersion | None:
        """The version with this alias; None if there is none. Raises TrackingError."""


class MlflowRegistry:
    """The registry of an MLflow server."""

    def __init__(self, rest: MlflowRest) -> None:
        self._rest = rest

    def alias(self, name: str, alias: str) -> RegisteredVersion | None:
        try:
            found = self._rest.json('GET', 'registered-models/alias?' + urlencode({'name': name, 'alias': alias}))
        except TrackingRefused as error:
            if error.data['code'] in _MISSING:
                return None
            raise
        return _version(found.get('model_version'))

    def versions(self, name: str) -> list[RegisteredVersion]:
        """All versions of a model, the newest first. Raises PolicyError if there are implausibly many."""
        query = {'filter': f"name='{name}'", 'max_results': str(PAGE), 'order_by': 'version_number DESC'}
        found: list[RegisteredVersion] = []
        for _ in range(MAX_PAGES):
            page = self._rest.json('GET', f'model-versions/search?{urlencode(query)}')
            found += map(_version, page.get('model_versions', []))
            if not (token := page.get('next_page_token')):
                return found
            query['page_token'] = str(token)
        raise PolicyError(f'the registry lists more than {PAGE * MAX_PAGES:,} versions of {name}')

    def register(self, name: str, source: str, tags: dict[str, str], run: str) -> int:
        """Register a version and return its number; if a version already has this source, return its number."""
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
        """Set a tag of a version."""
        self._rest.json('POST', 'model-versions/set-tag', {'name': name, 'version': str(version), 'key': key, 'value': value})

    def set_alias(self, name: str, alias: str, version: int) -> None:
        """Move an alias to a version."""
        self._rest.json('POST', 'registered-models/alias', {'name': name, 'alias': alias, 'version': str(version)})


def choose(registry: PolicyRegistry, name: str, robot: str) -> RegisteredVersion | None:
    """The version that a robot should run: its own alias, or the canary if that names the robot, or the champion."""
    if (own := registry.alias(name, f'robot-{robot}')) is not None:
        return own
    canary = registry.alias(name, CANARY)
    if canary is not None and robot in canary.robots:
        return canary
    return registry.alias(name, CHAMPION)


def source_of(robot_type: str, name: str, version: int) -> str:
    """The location of a version: ``s3://lerobot/policies/go2/go2_patrol_v7``."""
    return f's3://{BUCKET}/{PREFIX}/{robot_type}/{name}_v{version}'


def folder_of(chosen: RegisteredVersion, name: str) -> str:
    """The prefix of a version's keys. Raises PolicyRefused (``source``) if the registry's source is not where it must be."""
    source = chosen.source.rstrip('/')
    robot_type = source.removeprefix(f's3://{BUCKET}/{PREFIX}/').partition('/')[0]
    if chosen.name != name or not is_name(robot_type) or source != source_of(robot_type, name, chosen.version):
        text = f'the source of {name}@{chosen.version} in the registry, {chosen.source[:200]!r}, is not a location of policies'
        raise PolicyRefused('source', text)
    return source.removeprefix(f's3://{BUCKET}/')


def _version(given: Any) -> RegisteredVersion:
    try:
        number = int(str(given['version'])[:9])
        tags = {str(tag['key']): str(tag.get('value', '')) for tag in given.get('tags', [])}
        robots = frozenset(robot.strip() for robot in tags.get(ROBOTS_TAG, '').split(',') if robot.strip())
        return RegisteredVersion(str(given['name']), number, str(given.get('source', '')), robots)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PolicyError(f'the registry returned something other than a version of a model: {str(given)[:100]!r}') from error
