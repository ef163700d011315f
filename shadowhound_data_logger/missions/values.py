"""Checks names, numbers and texts against the tracking server's limits before they are journaled; texts are cut.

The limits are MLflow's (``mlflow/utils/validation.py`` of 2.14.0 and 3.17.2, the lower of both; colons in names, which 2.14
refuses, are not allowed). A request contains at most 1,000 points, params and tags together, and a million characters.
"""

from __future__ import annotations

import hashlib
import json
import math
import posixpath
import re
from typing import Any, Final

from shadowhound_data_logger.core.errors import Rejected

MAX_KEY: Final = 250
MAX_KEYS: Final = 50
"""Metrics in one record."""
MAX_TYPE: Final = 128
"""Characters of a mission type, which must fit into an object's metadata."""
MAX_PARAM: Final = 6000
MAX_TAG: Final = 5000
"""The limit of 2.14; that of 3.17 is 8,000."""
MAX_TEXT: Final = 1 << 20
"""Characters of any text in the journal."""
MAX_STEP: Final = (1 << 63) - 1
MAX_BITS: Final = 1024
"""Of an integer in an event: Python does not print far larger ones."""
JPEG: Final = b'\xff\xd8'
JPEG_QUALITY: Final = 90
MAX_SIDE: Final = 65_500
"""Pixels; libjpeg's limit."""
_ARRAYS: Final = ('__array__', '__array_interface__')
_SPACES: Final = {(): 'GRAY', (1,): 'GRAY', (3,): 'RGB', (4,): 'RGBA'}
"""Shape of a pixel -> simplejpeg's name of the color space."""
MAX_NAME_BYTES: Final = 240
"""File systems allow 255, and boto3 appends 9 while it downloads a file."""
MAX_EXTENSION: Final = 16
_ODD: Final = re.compile(r'[\x00-\x1f\x7f-\x9f#?\\\ud800-\udfff]|%(?=[0-9A-Fa-f]{2})|=(?=[0-9A-F]{2})|^ ')
"""Characters that do not arrive, tested with MLflow 3.17 through its proxy, with S3 and with folders. The server decodes ``%XX``
until none is left, and refuses ``#``; a ``?`` ends a URL; SeaweedFS treats a backslash as a slash; urllib drops control
characters and a leading space."""
_ODD_FOLDER: Final = re.compile(rf"{_ODD.pattern}|'|^\.(?=\.)")
"""MLflow puts a folder between quotes into a query, and treats ``..x`` as a path that leads out of the artifacts."""
_SCHEME: Final = re.compile(r'^([A-Za-z][A-Za-z0-9+.-]*):')
"""``C:`` and ``file:x`` look like URLs."""
_CUT: Final = re.compile(r'=[0-9A-F]?$')
_KEY: Final = re.compile(r'[/\w.\- ]+')


def metric_key(key: object) -> str:
    """Return the key unchanged; raises Rejected if MLflow would refuse it."""
    if not isinstance(key, str) or not _KEY.fullmatch(key) or len(key) > MAX_KEY or not _is_plain(key):
        allowed = f'use letters, digits and "_-./ ", at most {MAX_KEY} characters'
        raise Rejected('bad_name', f'{text(key, 80)!r} cannot be the name of a metric: {allowed}')
    return key


def number(value: Any, what: str) -> float:
    """A finite float; raises Rejected for anything else. Arrays of one element and numpy scalars are accepted, texts are not."""
    try:
        found = math.nan if isinstance(value, (str, bytes)) else float(_element(value))
    except (TypeError, ValueError, OverflowError, RuntimeError):
        found = math.nan
    if not math.isfinite(found):
        raise Rejected('not_a_number', f'{what} = {text(value, 80)!r}')
    return found


def integer(value: Any, what: str) -> int:
    """A step or id; raises Rejected for something other than an integer of at most 64 bits."""
    try:
        found = int(_element(value))
    except (TypeError, ValueError, OverflowError, RuntimeError):
        raise Rejected('not_a_number', f'{what} = {text(value, 80)!r}') from None
    if not -MAX_STEP <= found <= MAX_STEP:
        raise Rejected('not_a_number', f'{what} = {text(found, 80)} has more than 64 bits')
    return found


def _element(value: Any) -> Any:
    """The number in an array or tensor of one element, of any shape; other values unchanged."""
    if isinstance(value, (int, float)) or getattr(getattr(value, 'dtype', None), 'kind', 'f') not in 'biuf':
        return value
    item = getattr(value, 'item', None)
    return item() if callable(item) else value


def jpeg(value: Any, what: str) -> memoryview:
    """The bytes of a JPEG, unchanged, or an image encoded as JPEG. Raises Rejected for anything else.

    An image is an array of uint8 in the shape (height, width) or (height, width, 3 or 4), in the order red, green, blue (and
    alpha, which is dropped), as in ``mlflow.log_image``: a numpy array, a Pillow image or another object that numpy can read.
    """
    try:
        view = memoryview(value)
        is_line = view.itemsize == 1 and view.nbytes == max(
            view.shape or (), default=1
        )  # OpenCV's encoder gives a column of bytes
        data = view.cast('B') if is_line else memoryview(b'')
    except (TypeError, ValueError, BufferError):  # no buffer, or one with gaps
        data = memoryview(b'')
    if bytes(data[: len(JPEG)]) == JPEG:
        return data
    if not isinstance(value, (bytes, bytearray)) and any(hasattr(value, name) for name in _ARRAYS):
        return memoryview(_encoded(value, what))
    begins = f' that begins with {bytes(data[:4]).hex(" ")}' if data else ''
    error = f'{what} is {type(value).__name__}{begins}, not a JPEG: encode it, or pass its pixels as an array of uint8'
    raise Rejected('no_image', error)


def _encoded(value: Any, what: str) -> bytes:
    import numpy as np  # noqa: PLC0415 - not needed by agents that pass JPEGs
    import simplejpeg  # noqa: PLC0415

    try:
        pixels = np.asarray(value)
    except Exception as error:  # such as a tensor on another device
        raise Rejected('no_image', f'{what} is {type(value).__name__}, which numpy cannot read: {error}') from error
    if pixels.dtype != np.uint8:
        raise Rejected('no_image', f'{what} is an array of {pixels.dtype}, not of uint8: scale it, (image * 255).astype("uint8") '
                                   'if its values are between 0 and 1')  # fmt: skip
    space = _SPACES.get(pixels.shape[2:] if pixels.ndim == 3 else () if pixels.ndim == 2 else (0,))
    if space is None or not 0 < min(pixels.shape[:2]) <= max(pixels.shape[:2]) <= MAX_SIDE:
        raise Rejected('no_image', f'{what} is an array of the shape {pixels.shape}, not (height, width) or (height, width, 3 or '
                                   f'4), with sides of at most {MAX_SIDE}')  # fmt: skip
    encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(pixels.reshape(*pixels.shape[:2], -1)), JPEG_QUALITY, space)
    return encoded


def text(value: object, limit: int = MAX_TEXT) -> str:
    """Any value as a text that every database accepts: no NUL (PostgreSQL), no lone surrogates, at most ``limit`` characters."""
    try:
        found = str(value)
    except Exception:  # noqa: BLE001 - an agent's class may raise anything, and Python does for a number with 5,000 digits
        found = f'<{type(value).__name__}>'
    return found.replace('\0', '\N{REPLACEMENT CHARACTER}').encode('utf-8', 'replace').decode('utf-8')[:limit]


def artifact_folder(path: object) -> str:
    """A folder below the run's artifacts, '' for their root; raises Rejected for a path that leads out of them."""
    if path is None or path == '':
        return ''
    if not isinstance(path, str) or posixpath.normpath(path) != path or len(path) > MAX_KEY or '\0' in path:
        raise Rejected('bad_name', f'{text(path, 80)!r} is not a folder below the artifacts of a run')
    if path.partition('/')[0] in {'', '.', '..'}:
        raise Rejected('bad_name', f'{text(path, 80)!r} leads out of the artifacts of a run')
    return '/'.join(artifact_name(part, _ODD_FOLDER) for part in path.split('/'))


def artifact_name(name: str, odd: re.Pattern[str] = _ODD) -> str:
    """The name of a file in a run: unchanged if MLflow's server and clients list and download it under this name.

    Otherwise ``=XX`` replaces each byte that they do not accept (``map#1.png`` becomes ``map=231.png``), and ``=`` before two hex
    digits, so that two names never become the same. A name of more than 240 bytes is cut and gets a hash.
    """
    found = _SCHEME.sub(r'\1=3A', odd.sub(lambda match: _escaped(match[0]), name))
    if len(found.encode()) <= MAX_NAME_BYTES:
        return found
    stem, dot, extension = found.rpartition('.')
    tail = f'~{hashlib.sha256(_bytes(name)).hexdigest()[:16]}'
    tail += f'.{extension}' if stem and dot and len(extension.encode()) <= MAX_EXTENSION else ''
    kept = found.encode()[: MAX_NAME_BYTES - len(tail.encode())].decode(errors='ignore')
    return _CUT.sub('', kept) + tail


def _escaped(letters: str) -> str:
    return ''.join(f'={byte:02X}' for byte in _bytes(letters))


def _bytes(name: str) -> bytes:
    """The name's bytes in the file system; lone surrogates become question marks."""
    try:
        return name.encode('utf-8', 'surrogateescape')
    except UnicodeEncodeError:
        return name.encode('utf-8', 'replace')


def plain(value: Any, depth: int = 4) -> Any:
    """The value as JSON; values that JSON cannot represent become text."""
    if value is None or (isinstance(value, int) and value.bit_length() <= MAX_BITS):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, dict) and depth:
        copy = dict(value)  # in one step: another thread of the agent may change it at the same time
        return {text(key, MAX_KEY): plain(inner, depth - 1) for key, inner in copy.items()}
    if isinstance(value, (list, tuple)) and depth:
        return [plain(inner, depth - 1) for inner in value]
    return text(value, MAX_PARAM)


def bounded(value: Any) -> Any:
    """Return the value unchanged; raises Rejected if it is too large for a record."""
    size = len(json.dumps(value))
    if size > MAX_TEXT:
        raise Rejected('too_large', f'an event has {size} characters, more than {MAX_TEXT}: use log_artifact')
    return value


def boolean(value: object) -> bool:
    """The truth value; False for objects without one, such as arrays."""
    try:
        return bool(value)
    except (TypeError, ValueError):
        return False


def _is_plain(path: str) -> bool:
    """Whether it is a normalized path that stays below its folder."""
    return posixpath.normpath(path) == path and path != '.' and not path.startswith(('..', '/'))
