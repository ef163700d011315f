"""What the files of a policy hold, judged without loading any: nothing in them refers to another file, or is a program."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.untrusted import MOST_DOCUMENT_BYTES, check_size, from_json
from shadowhound_data_logger.policies.manifest import MANIFEST, PolicyManifest

MOST_HEADER_BYTES: Final = 1 << 20
"""Of a safetensors file: enough for some 8,000 tensors. The library's own bound of 100 MB would take gigabytes to parse."""
MOST_ONNX_BYTES: Final = (1 << 31) - 1
"""Protobuf's own bound on a message."""
ORT_FORMAT: Final = b'ORTM'
"""At byte 4; https://github.com/microsoft/onnxruntime/blob/main/onnxruntime/core/flatbuffers/schema/ort.fbs"""
MISSING_PACKAGE: Final = "install the extra: pip install 'shadowhound_data_logger[policies]'"
_OPERATORS: Final = frozenset({'EPContext'})
"""Whose attributes name a file that the runtime loads: an engine that was compiled elsewhere."""


def check_files(folder: Path, manifest: PolicyManifest, *, hashes: bool = True) -> None:
    """Exactly the files of the manifest are in the folder, each a plain file of its size (and hash), with what it may hold.

    Raises PolicyRefused (``link``, ``files``, ``damaged``, ``external``, ``file_type``) and OSError.
    """
    named = {file.path: file for file in manifest.files}
    found = set(files_of(folder))
    if odd := sorted(found ^ {*named, MANIFEST}):
        what = 'is in its folder, and not in the manifest' if odd[0] in found else 'is not there'
        raise PolicyRefused('files', f'{odd[0]!r} of {manifest.id} {what}')
    for path, file in named.items():
        place = folder / path
        if place.stat().st_size != file.size:
            raise PolicyRefused('damaged', f'{path} of {manifest.id} has not its {file.size:,} bytes')
        if hashes:
            if fingerprint(place)[1] != file.sha256:
                raise PolicyRefused('damaged', f'{path} of {manifest.id} has another SHA-256 than the manifest says')
            check_content(place, path)


def files_of(folder: Path) -> Iterator[str]:
    """All that is no folder, as paths below it. Raises PolicyRefused for what is neither file nor folder."""
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(parent, name)
            mode = path.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise PolicyRefused('link', f'{path} is a link or a device, not a file')
            if stat.S_ISREG(mode):
                yield path.relative_to(folder).as_posix()


def check_content(path: Path, name: str) -> None:
    """Raises PolicyRefused for a file whose content is not what its suffix says, or that refers to another file."""
    checks = {'.onnx': _check_onnx, '.safetensors': _check_safetensors, '.json': _check_json, '.npy': _check_npy}
    try:
        checks[PurePosixPath(name).suffix](path)
    except ValueError as error:
        raise PolicyRefused('file_type', f'{name} is not what its name says: {error}') from error


def _check_json(path: Path) -> None:
    check_size(path.stat().st_size, MOST_DOCUMENT_BYTES)
    from_json(path.read_bytes())


def _check_npy(path: Path) -> None:
    """That it is an array; the smoke run reads it, and takes none of objects."""
    with path.open('rb') as file:
        if file.read(6) != b'\x93NUMPY':
            raise ValueError('it is no array of numpy')


def _check_safetensors(path: Path) -> None:
    """Raises ValueError for what the library does not open."""
    try:
        from safetensors import SafetensorError, safe_open  # noqa: PLC0415 - of the extra
    except ImportError as error:
        raise PolicyError(f'{path.name} cannot be checked: {error}', remedy=MISSING_PACKAGE) from error
    with path.open('rb') as file:
        length = int.from_bytes(file.read(8), 'little')
    if length > MOST_HEADER_BYTES:
        raise ValueError(f'its header has {length:,} bytes, more than {MOST_HEADER_BYTES:,}')
    try:
        with safe_open(path, framework='numpy'):
            pass
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _check_onnx(path: Path) -> None:
    """A model in one file. Raises ValueError for what is no model, PolicyRefused (``external``) for data elsewhere."""
    try:
        import onnx  # noqa: PLC0415 - of the extra
        from google.protobuf.message import DecodeError  # noqa: PLC0415 - comes with it
    except ImportError as error:
        raise PolicyError(f'{path.name} cannot be checked: {error}', remedy=MISSING_PACKAGE) from error
    size = path.stat().st_size
    if not 0 < size <= MOST_ONNX_BYTES:
        raise ValueError(f'it has {size:,} bytes')
    content = path.read_bytes()
    if content[4:8] == ORT_FORMAT:  # by which the runtime recognizes its own format, whatever follows
        raise ValueError('it is a model in the format of ONNX Runtime, not in that of ONNX')
    try:
        model = onnx.load_model_from_string(content)
    except DecodeError as error:
        raise ValueError(f'it is no model: {error}') from error
    if not model.HasField('graph'):
        raise ValueError('it is no model: it has no graph')
    for tensor in _tensors(model, path.name):
        if tensor.external_data or tensor.data_location:
            raise PolicyRefused('external', f'{path.name} keeps tensors in other files', remedy='save the model as one file')


def _tensors(model: Any, name: str) -> Iterator[Any]:
    """Every tensor of a model. Raises PolicyRefused (``external``) for an operator that loads another file."""

    def of_graph(graph: Any) -> Iterator[Any]:
        yield from graph.initializer
        yield from of_sparse(graph.sparse_initializer)
        yield from of_nodes(graph.node)

    def of_nodes(nodes: Iterable[Any]) -> Iterator[Any]:
        for node in nodes:
            if node.op_type in _OPERATORS:
                raise PolicyRefused('external', f'{name} has an operator that loads another file',
                                    remedy='export the model itself: engines are built on the robot')  # fmt: skip
            yield from of_attributes(node.attribute)

    def of_attributes(attributes: Iterable[Any]) -> Iterator[Any]:
        for attribute in attributes:
            yield from (attribute.t, *attribute.tensors)
            yield from of_sparse((attribute.sparse_tensor, *attribute.sparse_tensors))
            for graph in (attribute.g, *attribute.graphs):
                yield from of_graph(graph)

    def of_sparse(tensors: Iterable[Any]) -> Iterator[Any]:
        for tensor in tensors:
            yield from (tensor.values, tensor.indices)

    yield from of_graph(model.graph)
    for training in model.training_info:
        yield from of_graph(training.initialization)
        yield from of_graph(training.algorithm)
    for function in model.functions:
        yield from of_nodes(function.node)
        yield from of_attributes(function.attribute_proto)
