"""What the files of a policy hold, judged without loading any: nothing in them refers to another file, or is a program."""

from __future__ import annotations

import mmap
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final

from shadowhound_data_logger.durable_files import fingerprint
from shadowhound_data_logger.errors import PolicyRefused
from shadowhound_data_logger.policies.manifest import MANIFEST, PolicyManifest
from shadowhound_data_logger.untrusted import MOST_DOCUMENT_BYTES, check_size, from_json, from_strict_json

MOST_HEADER_BYTES: Final = 1 << 20
"""Of a safetensors file: enough for some 8,000 tensors. The library's own bound of 100 MB would take gigabytes to parse."""
DTYPE_BITS: Final[dict[str, int]] = {
    'BOOL': 8, 'U8': 8, 'I8': 8, 'F8_E4M3': 8, 'F8_E5M2': 8, 'F8_E8M0': 8, 'U16': 16, 'I16': 16, 'F16': 16, 'BF16': 16, 'U32': 32,
    'I32': 32, 'F32': 32, 'U64': 64, 'I64': 64, 'F64': 64,
}  # fmt: skip
"""Of safetensors, by element."""
MOST_RANK: Final = 32
MOST_ONNX_BYTES: Final = (1 << 31) - 1
"""Protobuf's own bound on a message."""
ORT_FORMAT: Final = b'ORTM'
"""At byte 4; https://github.com/microsoft/onnxruntime/blob/main/onnxruntime/core/flatbuffers/schema/ort.fbs"""
MOST_NODES: Final = 5_000_000
MOST_DEPTH: Final = 16
_TENSOR: Final = 'tensor'
_WITHIN: Final[dict[str, dict[int, str]]] = {
    'model': {7: 'graph', 20: 'training', 25: 'function'},
    'training': {1: 'graph', 2: 'graph'},
    'function': {7: 'node', 11: 'attribute'},
    'graph': {1: 'node', 5: _TENSOR, 15: 'sparse'},
    'node': {5: 'attribute'},
    'attribute': {5: _TENSOR, 6: 'graph', 10: _TENSOR, 11: 'graph', 22: 'sparse', 23: 'sparse'},
    'sparse': {1: _TENSOR, 2: _TENSOR},
}
"""Which fields of a message hold which others, down to the tensors; https://github.com/onnx/onnx/blob/main/onnx/onnx.proto"""
_EXTERNAL_DATA, _DATA_LOCATION, _OP_TYPE = 13, 14, 4
_OPERATORS: Final = frozenset({b'EPContext'})
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
    """Eight bytes of length, a header in JSON, and tensors, one behind the other; https://github.com/huggingface/safetensors#format.

    As strict as the library: each byte behind the header is of exactly one tensor.
    """
    size = path.stat().st_size
    with path.open('rb') as file:
        length = int.from_bytes(file.read(8), 'little')
        if not 2 <= length <= min(MOST_HEADER_BYTES, size - 8):
            raise ValueError(f'it has no header of safetensors of at most {MOST_HEADER_BYTES:,} bytes')
        header = from_strict_json(file.read(length), MOST_HEADER_BYTES)
    try:
        texts = header.pop('__metadata__', {})
        if not all(isinstance(text, str) for text in texts.values()):
            raise ValueError('its metadata are no texts')
        end = 0
        for begin, after in sorted(_place(told) for told in header.values()):
            if begin != end:
                raise ValueError('its tensors overlap, or leave a gap')
            end = after
    except (AttributeError, TypeError, KeyError) as error:
        raise ValueError('its header is not one of safetensors') from error
    if end != size - 8 - length:
        raise ValueError('its tensors are not what is behind the header')


def _place(told: Any) -> tuple[int, int]:
    """Where a tensor begins and ends. Raises ValueError, TypeError, KeyError."""
    shape, (begin, after) = told['shape'], told['data_offsets']
    bits = DTYPE_BITS[told['dtype']]
    if len(told) != 3 or not isinstance(shape, list) or len(shape) > MOST_RANK:
        raise ValueError('a tensor has not a type, a shape and a place alone')
    for number in (*shape, begin, after):
        if type(number) is not int or not 0 <= number < 1 << 48:
            raise ValueError('the shape or the place of a tensor is no number of bytes')
    for size in shape:
        bits *= size
    if bits != (after - begin) * 8:
        raise ValueError('a tensor has not the bytes of its shape')
    return begin, after


def _check_onnx(path: Path) -> None:
    """A model in one file. Raises ValueError for what is no protobuf, PolicyRefused (``external``) for data elsewhere."""
    size = path.stat().st_size
    if not 0 < size <= MOST_ONNX_BYTES:
        raise ValueError(f'it has {size:,} bytes')
    with path.open('rb') as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[4:8] == ORT_FORMAT:  # by which the runtime tells them, whatever else they are
            raise ValueError('it is a model in the format of ONNX Runtime, not in that of ONNX')
        _Onnx(content, path.name).walk('model', 0, size, 0)


class _Onnx:
    """Walks over the messages of a model as far as tensors and operators are in them, and reads no number of any tensor."""

    def __init__(self, content: Any, name: str) -> None:
        self._content = content
        self._name = name
        self._left = MOST_NODES

    def walk(self, message: str, at: int, end: int, depth: int) -> None:
        if depth > MOST_DEPTH:
            raise ValueError('it is too deep')
        within = _WITHIN.get(message, {})
        while at < end:
            self._left -= 1
            if self._left < 0:
                raise ValueError(f'it has more than {MOST_NODES:,} fields')
            tag, at = self._varint(at, end)
            if tag >> 32:  # of which readers of protobuf take the lower half
                raise ValueError('it is no model')
            number, kind = tag >> 3, tag & 7
            begin, at, value = self._field(kind, at, end)
            if message == _TENSOR and (number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value)):
                raise PolicyRefused('external', f'{self._name} keeps tensors in other files', remedy='save the model as one file')
            if message == 'node' and number == _OP_TYPE and self._content[begin:at] in _OPERATORS:
                raise PolicyRefused('external', f'{self._name} has an operator that loads another file',
                                    remedy='export the model itself: engines are built on the robot')  # fmt: skip
            if kind == 2 and number in within:
                self.walk(within[number], begin, at, depth + 1)

    def _field(self, kind: int, at: int, end: int) -> tuple[int, int, int]:
        """Where its content begins and ends, and its number where it is one."""
        value, begin = 0, at
        if kind == 0:
            value, after = self._varint(at, end)
        elif kind == 2:
            length, begin = self._varint(at, end)
            after = begin + length
        elif kind in {1, 5}:
            after = at + (8 if kind == 1 else 4)
        else:
            raise ValueError('it is no model')
        if after > end:
            raise ValueError('it is cut off')
        return begin, after, value

    def _varint(self, at: int, end: int) -> tuple[int, int]:
        value = shift = 0
        while at < end and shift < 70:
            byte = self._content[at]
            at += 1
            value |= (byte & 127) << shift
            if byte < 128:
                return value, at
            shift += 7
        raise ValueError('it is cut off')
