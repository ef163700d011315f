"""``manifest.json``: describes a policy: its files with hashes, its inputs and outputs, and its limits.

The format belongs to this package (docs/policies.md). A manifest is trusted only if signed metadata contains its hash
(``trust.py``), and its fields are checked even then, because a signed manifest may be invalid. Only the manifest contains the
hashes of the other files.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import PurePosixPath
from typing import Any, Final

from shadowhound_data_logger.core.errors import PolicyRefused
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.untrusted import from_strict_json, is_path

BUCKET: Final = 'lerobot'
PREFIX: Final = 'policies'
"""Bucket and prefix of policies in the store."""
FORMAT: Final = 1
MANIFEST: Final = 'manifest.json'
MAX_MANIFEST_BYTES: Final = 1 << 20
MAX_FILES: Final = 100
MAX_POLICY_BYTES: Final = 16 << 30
MAX_VALUES: Final = 1 << 24
"""Elements of one tensor."""
SUFFIXES: Final = frozenset({'.json', '.safetensors', '.onnx', '.npy'})
"""Allowed for the files of a policy: data formats that no reader executes."""
ONNX: Final = 'onnx'
DTYPES: Final = ('float32', 'float64', 'int64', 'int32', 'uint8')
ID_DIGITS: Final = 16
_ID: Final = re.compile(rf'([A-Za-z0-9][A-Za-z0-9_.-]{{0,63}})@([1-9][0-9]{{0,8}})#([0-9a-f]{{{ID_DIGITS}}})')
_SHA256: Final = re.compile(r'[0-9a-f]{64}')


@dataclass(frozen=True, slots=True)
class PolicyFile:
    """One file of a policy."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class TensorSpec:
    """An input or an output of the model."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    names: tuple[str, ...]
    """Names of the elements along the last axis, in order; empty if unknown."""
    units: tuple[str, ...]
    """Units of the same elements; empty if unknown."""


@dataclass(frozen=True, slots=True)
class SmokeSample:
    """A sample input with the expected output: tensor name -> file (``.npy``)."""

    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    tolerance: float
    """Largest allowed absolute difference of an element of the output."""


@dataclass(frozen=True, slots=True)
class PolicyManifest:
    """A valid manifest."""

    name: str
    version: int
    kind: str
    model: str
    robot_types: tuple[str, ...]
    fps: float
    """Steps per second."""
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    dataset: str
    """Digest of the training set; empty if unknown."""
    run: str
    """The MLflow run that trained the policy; empty if unknown."""
    smoke: SmokeSample
    p99_ms: float
    """Largest allowed 99th percentile of the duration of a step."""
    failures: int
    """Failed steps allowed in a window of ``running.WINDOW`` steps."""
    files: tuple[PolicyFile, ...]
    sha256: str
    """SHA-256 of the manifest, which identifies the policy with all its files."""

    @property
    def id(self) -> str:
        """Such as ``go2_patrol@7#0123456789abcdef``: the name of the version's folder, and in missions."""
        return f'{self.name}@{self.version}#{self.sha256[:ID_DIGITS]}'

    @property
    def size(self) -> int:
        """Total bytes of all files."""
        return sum(file.size for file in self.files)


def split_id(text: str) -> tuple[str, int, str] | None:
    """Name, version and the first digits of the manifest's SHA-256; None for a text that is not the id of a policy."""
    found = _ID.fullmatch(text)
    return (found[1], int(found[2]), found[3]) if found and '..' not in found[1] else None


def parse_manifest(content: bytes) -> PolicyManifest:
    """Parse a manifest. Raises PolicyRefused: ``manifest``, ``size``, or for a file ``path``, ``twice`` or ``file_type``."""
    try:
        return _manifest(from_strict_json(content, MAX_MANIFEST_BYTES), hashlib.sha256(content).hexdigest())
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        text = f'the field {error} is missing' if isinstance(error, KeyError) else str(error)
        raise PolicyRefused('manifest', f'{MANIFEST} is not the manifest of a policy: {text[:200]}') from error


def _manifest(given: Any, sha256: str) -> PolicyManifest:
    if not isinstance(given, dict) or given.get('format') != FORMAT:
        raise ValueError(f'its format is not {FORMAT}')
    smoke, limits = given['smoke'], given['limits']
    manifest = PolicyManifest(
        name=_name(given['name']), version=_count(given['version'], 999_999_999),
        kind=_one_of(given['kind'], (ONNX,)), model=_text(given['model']), robot_types=_tuple(given['robot_types'], _name, 100),
        fps=_number(given['fps'], 1e4), inputs=_tuple(given['inputs'], _tensor, 100),
        outputs=_tuple(given['outputs'], _tensor, 100), dataset=_text(given['dataset']), run=_text(given['run']),
        smoke=SmokeSample(_texts(smoke['inputs']), _texts(smoke['outputs']), _number(smoke['tolerance'], 1e6)),
        p99_ms=_number(limits['p99_ms'], 1e6), failures=_count(limits['failures'], 1 << 20, low=0),
        files=_tuple(given['files'], _file, MAX_FILES), sha256=sha256,
    )  # fmt: skip
    _check_files(manifest)
    return manifest


def _check_files(manifest: PolicyManifest) -> None:
    """Names must be unique and not a folder of another file; every file and tensor that is referred to must exist."""
    paths = [file.path for file in manifest.files]
    lower = [path.lower() for path in (*paths, MANIFEST)]
    if len(set(lower)) < len(lower):
        raise PolicyRefused('twice', f'{MANIFEST} of {manifest.id} lists a file twice')
    folders = {str(parent) for path in paths for parent in PurePosixPath(path).parents}
    if folders.intersection(paths):
        raise PolicyRefused('path', f'{MANIFEST} of {manifest.id} lists a file that is also the folder of another file')
    referred = [manifest.model, *manifest.smoke.inputs.values(), *manifest.smoke.outputs.values()]
    if missing := sorted(set(referred) - set(paths)):
        raise ValueError(f'{missing[0]!r} is not among its files')
    if {spec.name for spec in manifest.inputs} != set(manifest.smoke.inputs):
        raise ValueError('the smoke sample does not have the inputs of the model')
    if {spec.name for spec in manifest.outputs} != set(manifest.smoke.outputs):
        raise ValueError('the smoke sample does not have the outputs of the model')
    if not manifest.model.endswith('.onnx'):
        raise ValueError(f'the model {manifest.model!r} is not an .onnx file')
    if manifest.size > MAX_POLICY_BYTES:
        raise PolicyRefused('size', f'{manifest.id} has {manifest.size:,} bytes, more than the allowed {MAX_POLICY_BYTES:,}')


def check_file_name(path: str) -> str:
    """Return the path unchanged if a policy may have such a file. Raises PolicyRefused: ``path`` or ``file_type``."""
    parts = path.split('/')
    if not is_path(path) or len(parts) > 3 or not all(is_name(part, 200) for part in parts):
        raise PolicyRefused('path', f'a policy cannot have a file {path[:100]!r}: it is not a plain path below the folder')
    if PurePosixPath(path).suffix not in SUFFIXES:
        allowed = ' '.join(sorted(SUFFIXES))
        raise PolicyRefused('file_type', f'a policy cannot have a file {path[:100]!r}: allowed are {allowed}')
    return path


def _file(given: Any) -> PolicyFile:
    size, sha256 = _count(given['bytes'], MAX_POLICY_BYTES, low=0), _text(given['sha256'])
    if not _SHA256.fullmatch(sha256):
        raise ValueError(f'{sha256[:80]!r} is not a SHA-256')
    return PolicyFile(check_file_name(_text(given['path'])), size, sha256)


def _tensor(given: Any) -> TensorSpec:
    spec = TensorSpec(
        _text(given['name']), _tuple(given['shape'], lambda size: _count(size, MAX_VALUES), 8),
        _one_of(given['dtype'], DTYPES), _tuple(given['names'], _text, MAX_VALUES), _tuple(given['units'], _text, MAX_VALUES),
    )  # fmt: skip
    values = 1
    for size in spec.shape:
        values *= size
    if values > MAX_VALUES:
        raise ValueError(f'{spec.name[:80]!r} has more than {MAX_VALUES:,} elements')
    last = spec.shape[-1] if spec.shape else 1
    if any(words and len(words) != last for words in (spec.names, spec.units)):
        raise ValueError(f'{spec.name[:80]!r} must have one name and unit for each of the {last} elements, or none')
    return spec


def _text(given: Any) -> str:
    if not isinstance(given, str) or len(given) > 1000 or not given.isprintable():
        raise ValueError(f'{str(given)[:80]!r} is not a printable text of at most 1000 characters')
    return given


def _texts(given: Any) -> Mapping[str, str]:
    return {_text(name): _text(value) for name, value in given.items()} if isinstance(given, dict) else _text(None)  # type: ignore[return-value]


def _name(given: Any) -> str:
    if not is_name(_text(given)):
        raise ValueError(f'{given[:80]!r} is not a name: use letters, digits, "_", "-" and ".", at most 64')
    return str(given)


def _one_of(given: Any, allowed: tuple[str, ...]) -> str:
    if given not in allowed:
        raise ValueError(f'{str(given)[:80]!r} is not one of {", ".join(allowed)}')
    return str(given)


def _count(given: Any, high: int, low: int = 1) -> int:
    if type(given) is not int or not low <= given <= high:
        raise ValueError(f'{str(given)[:80]} is not an integer from {low} to {high}')
    return given


def _number(given: Any, high: float) -> float:
    if type(given) not in {int, float} or not isfinite(given) or not 0.0 < given <= high:
        raise ValueError(f'{str(given)[:80]} is not a number above 0 and at most {high:g}')
    return float(given)


def _tuple(given: Any, parse: Callable[[Any], Any], limit: int) -> tuple[Any, ...]:
    if not isinstance(given, list) or len(given) > limit:
        raise ValueError(f'{str(given)[:80]} is not a list of at most {limit} items')
    return tuple(parse(each) for each in given)
