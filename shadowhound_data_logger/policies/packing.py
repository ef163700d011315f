"""Packs a trained policy with a manifest, and publishes it."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import ForeignObject, PolicyError, PolicyRefused
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.policies.content import check_content, check_files
from shadowhound_data_logger.policies.manifest import (
    BUCKET,
    FORMAT,
    MANIFEST,
    MAX_MANIFEST_BYTES,
    ONNX,
    PolicyManifest,
    check_file_name,
    parse_manifest,
)
from shadowhound_data_logger.policies.registry import ID_TAG, ROBOTS_TAG, MlflowRegistry, source_of
from shadowhound_data_logger.policies.smoke import open_model, worst_difference
from shadowhound_data_logger.policies.trust import MISSING_PACKAGE, target_of
from shadowhound_data_logger.stores.base import ObjectStore

if TYPE_CHECKING:
    from shadowhound_data_logger.policies.repository import Repository

MODEL: Final = 'model.onnx'
CONFIG: Final = 'config.json'
ROBOT_TYPES: Final = ('go2',)


@dataclass(frozen=True, slots=True, kw_only=True)
class Packing:
    """The fields of a manifest that are not derived from the policy's files."""

    name: str
    version: int
    robot_types: Sequence[str] = ROBOT_TYPES
    fps: float = 10.0
    dataset: str = ''
    run: str = ''
    tolerance: float = 1e-4
    p99_ms: float = 100.0
    failures: int = 3


def pack(folder: Path, smoke: Path, packed: Path, packing: Packing) -> PolicyManifest:
    """Copy the files of a policy to ``packed`` and write its manifest, with the model's output for the sample.

    ``folder`` contains model.onnx and optionally .json, .safetensors and .npy files; config.json may name the elements of inputs
    and outputs (``input_features`` and ``output_features``: name -> names, units). ``smoke`` is an .npz file with an array for
    each input. Raises PolicyError, PolicyRefused, OSError.
    """
    if packed.exists():
        raise PolicyError(f'{packed} already exists', remedy='choose a new folder: packed policies are not overwritten')
    files = _files(folder)
    part = packed.with_name(f'{packed.name}.part')
    shutil.rmtree(part, ignore_errors=True)
    for name in files:
        (part / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / name, part / name, follow_symlinks=False)
    described = _run_model(part, smoke)
    files += [*described['smoke']['inputs'].values(), *described['smoke']['outputs'].values()]
    listed = []
    for name in sorted(files):
        check_content(part / name, name)
        size, sha256 = fingerprint(part / name)
        listed.append({'path': name, 'bytes': size, 'sha256': sha256})
    manifest = {
        'format': FORMAT, 'name': packing.name, 'version': packing.version,
        'kind': ONNX, 'model': MODEL, 'robot_types': list(packing.robot_types), 'fps': packing.fps,
        'inputs': described['inputs'], 'outputs': described['outputs'], 'dataset': packing.dataset, 'run': packing.run,
        'smoke': {**described['smoke'], 'tolerance': packing.tolerance},
        'limits': {'p99_ms': packing.p99_ms, 'failures': packing.failures}, 'files': listed,
    }  # fmt: skip
    content = json.dumps(manifest, indent=1).encode() + b'\n'
    parsed = parse_manifest(content)
    (part / MANIFEST).write_bytes(content)
    part.rename(packed)
    return parsed


def _files(folder: Path) -> list[str]:
    """All files below a folder. Raises PolicyRefused for files that a policy may not have."""
    found = []
    for path in sorted(folder.rglob('*')):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            raise PolicyRefused('link', f'{path} is a link', remedy='pack the files themselves')
        if path.is_file():
            found.append(check_file_name(name))
    if MODEL not in found:
        raise PolicyError(f'{folder} has no {MODEL}', remedy='export the policy to ONNX, as docs/policies.md shows')
    if any(name == MANIFEST or name.startswith('smoke/') for name in found):
        raise PolicyError(f'{folder} is already packed', remedy='pack the folder that the training wrote')
    return found


def _run_model(part: Path, smoke: Path) -> dict[str, Any]:
    """Run the model and write the sample; returns the fields ``inputs``, ``outputs`` and ``smoke`` of the manifest."""
    import numpy as np  # noqa: PLC0415

    check_content(part / MODEL, MODEL)
    try:
        session = open_model(part / MODEL)
    except ImportError as error:
        raise PolicyError(f'the model cannot be run: {error}', remedy=MISSING_PACKAGE) from error
    with np.load(smoke, allow_pickle=False) as arrays:
        given = {spec.name: arrays[spec.name] for spec in session.get_inputs() if spec.name in arrays}
    if missing := [spec.name for spec in session.get_inputs() if spec.name not in given]:
        raise PolicyError(f'{smoke} has no array {missing[0]!r}', remedy='np.savez(FILE, **{input name: array})')
    names = [spec.name for spec in session.get_outputs()]
    outputs = dict(zip(names, session.run(names, given), strict=True))
    again = dict(zip(names, session.run(names, given), strict=True))
    for name, array in outputs.items():
        if not np.isfinite(array).all() or worst_difference(array, again[name]):
            raise PolicyError(f'{name} is not finite, or differs between two runs with the same input')
    (part / 'smoke').mkdir()
    paths: dict[str, dict[str, str]] = {}
    for kind, tensors in (('inputs', given), ('outputs', outputs)):
        paths[kind] = {name: f'smoke/{kind}_{number}.npy' for number, name in enumerate(tensors)}
        for name, path in paths[kind].items():
            np.save(part / path, tensors[name], allow_pickle=False)
    config = from_json((part / CONFIG).read_bytes()) if (part / CONFIG).is_file() else {}
    return {'smoke': paths, 'inputs': [_tensor(name, array, config, 'input_features') for name, array in given.items()],
            'outputs': [_tensor(name, array, config, 'output_features') for name, array in outputs.items()]}  # fmt: skip


def _tensor(name: str, array: Any, config: Mapping[str, Any], key: str) -> dict[str, Any]:
    feature = config.get(key, {}).get(name, {})
    return {'name': name, 'shape': list(array.shape), 'dtype': str(array.dtype), 'names': feature.get('names', []),
            'units': feature.get('units', [])}  # fmt: skip


def publish(packed: Path, store: ObjectStore, registry: MlflowRegistry, repository: Repository, *, key: Path | None = None,
            aliases: Sequence[str] = (), robots: Sequence[str] = ()) -> tuple[PolicyManifest, bool]:  # fmt: skip
    """Upload a policy, register it, list it in the signed metadata, and then set its aliases; can be repeated.

    ``robots`` are those that try it as a canary. A published version is never overwritten. Also returns whether robots see it
    now; otherwise ``policy refresh`` must run on the machine that has online.key. Raises PolicyError, StoreError.
    """
    content = _content(packed)
    manifest = parse_manifest(content)
    check_files(packed, manifest)
    source = source_of(manifest.robot_types[0], manifest.name, manifest.version)
    known = registry.versions(manifest.name)
    following = 1 + max((each.version for each in known), default=0)
    remedy = f'pack it with --version {following}'
    if all(each.source != source for each in known):
        _check_number(manifest, following)
        remedy = f'publish the folder whose publication was interrupted, or delete {source}/, which is not in the registry'
    folder = source.removeprefix(f's3://{BUCKET}/')
    for name in (*(file.path for file in manifest.files), MANIFEST):  # the manifest last: then the upload is complete
        size, sha256 = fingerprint(packed / name)
        item = _item(f'{folder}/{name}', packed / name, size, sha256)
        try:
            with_retries(lambda item=item: store.put(item))  # type: ignore[misc]
        except ForeignObject as error:
            text = f'the store already has a different {manifest.name}@{manifest.version}: {error.what}'
            raise PolicyError(text, remedy=remedy) from error
    tags = {ID_TAG: manifest.id, 'shadowhound.dataset': manifest.dataset}
    number = registry.register(manifest.name, source, {key: value for key, value in tags.items() if value}, manifest.run)
    _check_number(manifest, number)
    is_visible = repository.publish(
        {target_of(kind, manifest.name, manifest.version): content for kind in manifest.robot_types}, key
    )
    if robots:
        registry.tag(manifest.name, number, ROBOTS_TAG, ','.join(robots))
    for alias in aliases:
        registry.set_alias(manifest.name, alias, number)
    return manifest, is_visible


def _check_number(manifest: PolicyManifest, number: int) -> None:
    """Raises PolicyError if the registry's version number differs from that of the manifest."""
    if number != manifest.version:
        raise PolicyError(f'in the registry this is version {number} of {manifest.name}, but it is packed as {manifest.version}',
                          remedy=f'pack it with --version {number}')  # fmt: skip


def _content(packed: Path) -> bytes:
    with (packed / MANIFEST).open('rb') as file:
        return file.read(MAX_MANIFEST_BYTES + 1)


def _item(key: str, path: Path, size: int, sha256: str) -> SpooledObject:
    kind = 'application/json' if path.suffix == '.json' else 'application/octet-stream'
    return SpooledObject(id=0, bucket=BUCKET, key=key, path=path, size=size, sha256=sha256, content_type=kind,
                         metadata={meta.SENSOR: 'policy'}, priority=5, created_ns=time.time_ns())  # fmt: skip
