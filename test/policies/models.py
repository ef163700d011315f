"""Policies to be packed: small ONNX models that do what a test needs, and the folders that a training would write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from shadowhound_data_logger.policies import packing, signing
from shadowhound_data_logger.policies.manifest import PolicyManifest
from shadowhound_data_logger.policies.registry import RegisteredVersion, source_of

STATE, ACTION = 'observation.state', 'action'


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
    """What a training wrote, and a sample beside it."""
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
    """Who packs and signs: a folder with a key."""

    folder: Path
    name: str = 'go2_patrol'

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.key = self.folder / 'spark.key'
        self.key_id = signing.keygen(self.key)

    @property
    def public(self) -> Path:
        return self.folder / 'spark.key.pub'

    def packed(self, version: int, model: onnx.ModelProto | None = None, **given: Any) -> tuple[Path, PolicyManifest]:
        """A version, signed."""
        folder = trained(self.folder / f'trained_{version}', model or linear(0.1 * version))
        packed = self.folder / f'packed_{version}'
        packing.pack(folder, folder.with_suffix('.npz'), packed, packing.Packing(
            **{'name': self.name, 'version': version, 'p99_ms': 5000.0, 'dataset': 'd' * 64, **given}))  # fmt: skip
        packing.sign(packed, self.key)
        return packed, packing.parse_manifest((packed / 'manifest.json').read_bytes())


class Aliases:
    """A registry that says what a test says."""

    def __init__(self) -> None:
        self.told: dict[str, RegisteredVersion] = {}

    def alias(self, name: str, alias: str) -> RegisteredVersion | None:
        return self.told.get(alias)

    def say(self, alias: str, version: int, *, source: str = '', robots: frozenset[str] = frozenset(), name: str = 'go2_patrol'
            ) -> None:  # fmt: skip
        self.told[alias] = RegisteredVersion(name, version, source or source_of('go2', name, version), robots)
