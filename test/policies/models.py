"""Small ONNX models, packed policies, and a robot that syncs them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import boto3
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.errors import PolicyRefused
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.policies import packing, roots
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.manifest import MANIFEST, PolicyManifest
from shadowhound_data_logger.policies.registry import RegisteredVersion, source_of
from shadowhound_data_logger.policies.repository import Repository
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync
from shadowhound_data_logger.policies.trust import ROOT, target_of
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

STATE, ACTION = 'observation.state', 'action'


def bucket_of(tower: Tower) -> Any:
    """The administrator's client of a Tower with an empty bucket for policies."""
    keys = tower.environment()
    client = boto3.client('s3', endpoint_url=tower.endpoint_url, region_name='us-east-1',
                          aws_access_key_id=keys['AWS_ACCESS_KEY_ID'],
                          aws_secret_access_key=keys['AWS_SECRET_ACCESS_KEY'])  # fmt: skip
    with suppress(client.exceptions.BucketAlreadyOwnedByYou, client.exceptions.BucketAlreadyExists):
        client.create_bucket(Bucket='lerobot')
    for entry in client.list_objects_v2(Bucket='lerobot', Prefix='policies/_tuf/').get('Contents', ()):
        client.delete_object(Bucket='lerobot', Key=entry['Key'])
    return client


def linear(gain: float = 0.5, operator: str = 'MatMul', extra: int = 0) -> onnx.ModelProto:
    """Three states to two actions; ``extra`` floats of ballast make it larger."""
    weights = numpy_helper.from_array(np.full((3, 2), gain, 'f4'), 'weights')
    ballast = [numpy_helper.from_array(np.random.default_rng(1).random(extra, 'f4'), 'ballast')] if extra else []
    nodes = [helper.make_node(operator, [STATE, 'weights'], [ACTION])]
    graph = helper.make_graph(
        nodes, 'policy', [helper.make_tensor_value_info(STATE, TensorProto.FLOAT, [1, 3])],
        [helper.make_tensor_value_info(ACTION, TensorProto.FLOAT, [1, 2])], [weights, *ballast],
    )  # fmt: skip
    return helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)], ir_version=9)


def trained(folder: Path, model: onnx.ModelProto | None = None) -> Path:
    """A folder with the output of a training, and a sample next to it."""
    folder.mkdir(parents=True)
    (folder / 'model.onnx').write_bytes((model or linear()).SerializeToString())
    features: dict[str, Any] = {
        'input_features': {STATE: {'names': ['x', 'y', 'yaw'], 'units': ['m', 'm', 'rad']}},
        'output_features': {ACTION: {'names': ['linear.x', 'angular.z'], 'units': ['m/s', 'rad/s']}},
    }
    (folder / 'config.json').write_text(json.dumps(features))
    (folder / 'train_config.json').write_text('{"steps": 1}')
    np.savez(folder.with_suffix('.npz'), **{STATE: np.array([[0.1, 0.2, 0.3]], 'f4')})  # type: ignore[arg-type]
    return folder


@dataclass
class Spark:
    """A team with one key per role, which packs and signs."""

    folder: Path
    name: str = 'go2_patrol'

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.keys = self.folder / 'keys'
        roots.create(self.keys)

    @property
    def root(self) -> Path:
        """The root that robots trust."""
        return self.keys / ROOT

    def signing(self, store: ObjectStore, **given: Any) -> Repository:
        """A repository to sign in."""
        return Repository(self.keys, store, lambda _: '', **given)

    def trusted_by(self, folder: PolicyFolder) -> None:
        """Install the root on a robot."""
        folder.make()
        shutil.copy(self.root, folder.path / ROOT)

    def packed(self, version: int, model: onnx.ModelProto | None = None, **given: Any) -> tuple[Path, PolicyManifest]:
        """Pack a version."""
        folder = trained(self.folder / f'trained_{version}', model or linear(0.1 * version))
        packed = self.folder / f'packed_{version}'
        packing.pack(folder, folder.with_suffix('.npz'), packed, packing.Packing(
            **{'name': self.name, 'version': version, 'p99_ms': 5000.0, 'dataset': 'd' * 64, **given}))  # fmt: skip
        return packed, packing.parse_manifest((packed / 'manifest.json').read_bytes())


class Aliases:
    """A registry whose aliases are set by the test."""

    def __init__(self) -> None:
        self._aliases: dict[str, RegisteredVersion] = {}

    def alias(self, name: str, alias: str) -> RegisteredVersion | None:
        return self._aliases.get(alias)

    def set_alias(
        self, alias: str, version: int, *, source: str = '', robots: frozenset[str] = frozenset(), name: str = 'go2_patrol'
    ) -> None:
        self._aliases[alias] = RegisteredVersion(name, version, source or source_of('go2', name, version), robots)


def refused(robot: PolicySync) -> str:
    """The reason why a sync is refused; the active version stays."""
    before = robot.folder.current()
    with pytest.raises(PolicyRefused) as raised:
        robot.run()
    assert robot.folder.current() == before
    return raised.value.reason


@dataclass
class Scene:
    """A team, a store in a folder, a registry, and a robot that trusts the team."""

    path: Path
    registry: Aliases = field(default_factory=Aliases)

    def __post_init__(self) -> None:
        self.spark = Spark(self.path / 'spark')
        self.store = open_store(StoreSettings(directory=self.path / 'store'), UploadSettings())
        self.robot = self.new_robot('thor')
        self.folder = self.robot.folder

    def new_robot(self, name: str, **given: Any) -> PolicySync:
        folder = PolicyFolder(self.path / name)
        self.spark.trusted_by(folder)
        settings = PolicySettings(**{'name': 'go2_patrol', 'robot': name, 'min_free_bytes': 0, **given})
        return PolicySync(folder, self.store, self.registry, settings, pause=lambda _: None)

    def place(self, version: int) -> Path:
        return self.path / 'store' / 'lerobot' / 'policies' / 'go2' / f'go2_patrol_v{version}'

    def publish(self, version: int, model: onnx.ModelProto | None = None, alias: str = 'champion', **given: Any) -> str:
        packed, manifest = self.spark.packed(version, model, **given)
        shutil.copytree(packed, self.place(version))
        self.sign(version)
        self.registry.set_alias(alias, version)
        return manifest.id

    def forge(self, version: int, change: Callable[[dict[str, Any]], object]) -> None:
        """Change a manifest and sign it again."""
        manifest = json.loads((self.place(version) / MANIFEST).read_bytes())
        change(manifest)
        self.sign(version, json.dumps(manifest).encode())

    def sign(self, version: int, content: bytes | None = None) -> None:
        """Sign the manifest in the store, or ``content`` instead."""
        path = self.place(version) / MANIFEST
        if content is not None:
            path.write_bytes(content)
        self.spark.signing(self.store).publish({target_of('go2', 'go2_patrol', version): path.read_bytes()})

    def refused(self) -> str:
        return refused(self.robot)
