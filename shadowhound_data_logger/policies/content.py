"""Checks the files of a policy before any is loaded: they must not refer to other files or contain programs."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, check_size, from_json
from shadowhound_data_logger.policies.manifest import MANIFEST, PolicyManifest

MAX_HEADER_BYTES: Final = 1 << 20
"""Of a safetensors file: enough for about 8,000 tensors. Parsing the library's limit, 100 MB, would take gigabytes."""
MAX_ONNX_BYTES: Final = (1 << 31) - 1
"""Protobuf's limit for a message."""
ORT_FORMAT: Final = b'ORTM'
"""At offset 4; https://github.com/microsoft/onnxruntime/blob/main/onnxruntime/core/flatbuffers/schema/ort.fbs"""
MISSING_PACKAGE: Final = "install the extra: pip install 'shadowhound_data_logger[policies]'"
_OPERATORS: Final = frozenset({'EPContext'})
"""Operators with an attribute that names a file for the runtime to load: an engine that was compiled elsewhere."""


def check_files(folder: Path, manifest: PolicyManifest, *, hashes: bool = True) -> None:
    """Check that the folder has exactly the manifest's files, with the right sizes and, if ``hashes``, hashes and content.

    Raises PolicyRefused (``link``, ``files``, ``damaged``, ``external``, ``file_type``) and OSError.
    """
    listed = {file.path: file for file in manifest.files}
    found = set(files_of(folder))
    if unexpected := sorted(found ^ {*listed, MANIFEST}):
        problem = 'is not in the manifest' if unexpected[0] in found else 'is missing'
        raise PolicyRefused('files', f'the file {unexpected[0]!r} of {manifest.id} {problem}')
    for name, file in listed.items():
        path = folder / name
        if (size := path.stat().st_size) != file.size:
            raise PolicyRefused('damaged', f'{name} of {manifest.id} has {size:,} bytes, expected {file.size:,}')
        if hashes:
            if fingerprint(path)[1] != file.sha256:
                raise PolicyRefused('damaged', f'the SHA-256 of {name} of {manifest.id} does not match the manifest')
            check_content(path, name)


def files_of(folder: Path) -> Iterator[str]:
    """The paths of all files below a folder. Raises PolicyRefused (``link``) for anything that is neither file nor folder."""
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(parent, name)
            mode = path.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise PolicyRefused('link', f'{path} is a link or a device, not a regular file')
            if stat.S_ISREG(mode):
                yield path.relative_to(folder).as_posix()


def check_content(path: Path, name: str) -> None:
    """Raises PolicyRefused if the content does not match the suffix (``file_type``) or refers to another file (``external``)."""
    checks = {'.onnx': _check_onnx, '.safetensors': _check_safetensors, '.json': _check_json, '.npy': _check_npy}
    try:
        checks[PurePosixPath(name).suffix](path)
    except ValueError as error:
        raise PolicyRefused('file_type', f'the content of {name} does not match its suffix: {error}') from error


def _check_json(path: Path) -> None:
    check_size(path.stat().st_size, MAX_DOCUMENT_BYTES)
    from_json(path.read_bytes())


def _check_npy(path: Path) -> None:
    """Check only the magic number: the smoke run reads the array, and refuses arrays of objects."""
    with path.open('rb') as file:
        if file.read(6) != b'\x93NUMPY':
            raise ValueError('it is not a numpy array')


def _check_safetensors(path: Path) -> None:
    """Raises ValueError for a file that the library does not open."""
    try:
        from safetensors import SafetensorError, safe_open  # noqa: PLC0415 - in the extra
    except ImportError as error:
        raise PolicyError(f'{path.name} cannot be checked: {error}', remedy=MISSING_PACKAGE) from error
    with path.open('rb') as file:
        length = int.from_bytes(file.read(8), 'little')
    if length > MAX_HEADER_BYTES:
        raise ValueError(f'its header has {length:,} bytes, more than {MAX_HEADER_BYTES:,}')
    try:
        with safe_open(path, framework='numpy'):
            pass
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _check_onnx(path: Path) -> None:
    """Raises ValueError for a file that is not a model, PolicyRefused (``external``) if its data is in other files."""
    try:
        import onnx  # noqa: PLC0415 - in the extra
        from google.protobuf.message import DecodeError  # noqa: PLC0415 - installed with onnx
    except ImportError as error:
        raise PolicyError(f'{path.name} cannot be checked: {error}', remedy=MISSING_PACKAGE) from error
    size = path.stat().st_size
    if not 0 < size <= MAX_ONNX_BYTES:
        raise ValueError(f'it has {size:,} bytes, allowed are 1 to {MAX_ONNX_BYTES:,}')
    content = path.read_bytes()
    if content[4:8] == ORT_FORMAT:  # the runtime would load such a file in its own format, regardless of the rest
        raise ValueError('it is a model in the format of ONNX Runtime, not ONNX')
    try:
        model = onnx.load_model_from_string(content)
    except DecodeError as error:
        raise ValueError(f'it is not a model: {error}') from error
    if not model.HasField('graph'):
        raise ValueError('it is not a model: it has no graph')
    for tensor in _tensors(model, path.name):
        if tensor.external_data or tensor.data_location:
            raise PolicyRefused('external', f'{path.name} has tensors in other files', remedy='save the model as one file')


def _tensors(model: Any, name: str) -> Iterator[Any]:
    """All tensors of a model. Raises PolicyRefused (``external``) for an operator that loads another file."""

    def of_graph(graph: Any) -> Iterator[Any]:
        yield from graph.initializer
        yield from of_sparse(graph.sparse_initializer)
        yield from of_nodes(graph.node)

    def of_nodes(nodes: Iterable[Any]) -> Iterator[Any]:
        for node in nodes:
            if node.op_type in _OPERATORS:
                raise PolicyRefused('external', f'{name} has an operator that loads another file',
                                    remedy='export the model itself: the robot compiles engines')  # fmt: skip
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
