"""What the tracking server accepts: names, numbers and texts, checked or cut before they are journalled.

The limits are MLflow's own (``mlflow/utils/validation.py`` of 2.14.0 and 3.17.2, the smaller of both; the colon in names, which
2.14 refuses, is left out). A request holds at most 1,000 points, params and tags together, and a million characters.
"""

from __future__ import annotations

import json
import math
import posixpath
import re
from typing import Any, Final

from shadowhound_data_logger.errors import Rejected

MAX_KEY: Final = 250
MAX_KEYS: Final = 50
"""Metrics in one record."""
MAX_TYPE: Final = 128
"""Letters of a mission's type: a word, which must fit into an object's metadata."""
MAX_PARAM: Final = 6000
MAX_TAG: Final = 5000
"""What 2.14 takes; 3.17 takes 8,000."""
MAX_TEXT: Final = 1 << 20
"""Of anything that is journalled: a mission's command is not a film."""
MAX_STEP: Final = (1 << 63) - 1
MAX_BITS: Final = 1024
"""Of a number in an event: far larger ones Python does not even write."""
_KEY: Final = re.compile(r'[/\w.\- ]+')


def metric_key(key: object) -> str:
    """The key unchanged; raises Rejected for one that MLflow would refuse."""
    if not isinstance(key, str) or not _KEY.fullmatch(key) or len(key) > MAX_KEY or not _is_plain(key):
        raise Rejected('bad_name', f'{text(key, 80)!r} cannot name a metric: letters, digits, "_-./ ", at most {MAX_KEY}')
    return key


def number(value: Any, what: str) -> float:
    """A finite float; raises Rejected for anything else. Arrays of one element and numpy's scalars are numbers, texts are not."""
    try:
        found = math.nan if isinstance(value, (str, bytes)) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        found = math.nan
    if not math.isfinite(found):
        raise Rejected('not_a_number', f'{what} = {text(value, 80)!r}')
    return found


def whole(value: Any, what: str) -> int:
    """A step or id; raises Rejected for what is none or too large for 64 bits."""
    try:
        found = int(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        raise Rejected('not_a_number', f'{what} = {text(value, 80)!r}') from None
    if not -MAX_STEP <= found <= MAX_STEP:
        raise Rejected('not_a_number', f'{what} = {text(found, 80)} has more than 64 bits')
    return found


def content(value: Any, what: str) -> memoryview:
    """The bytes of a file; raises Rejected for what are none, or no single one."""
    try:
        found = memoryview(value).cast('B')
    except TypeError:
        found = memoryview(b'')
    if not found:
        raise Rejected('no_image', f'{what} is {type(value).__name__}, not the bytes of a JPEG')
    return found


def text(value: object, limit: int = MAX_TEXT) -> str:
    """Any value as text that every database takes: no NUL (PostgreSQL), no lone surrogates, at most ``limit`` characters."""
    try:
        found = str(value)
    except Exception:  # noqa: BLE001 - an agent's own class raises what it likes, and Python for a number of 5,000 digits
        found = f'<{type(value).__name__}>'
    return found.replace('\0', '\N{REPLACEMENT CHARACTER}').encode('utf-8', 'replace').decode('utf-8')[:limit]


def artifact_folder(path: object) -> str:
    """A folder below the run's artifacts, '' for its root; raises Rejected for one that leads elsewhere."""
    if path is None or path == '':
        return ''
    if not isinstance(path, str) or not _is_plain(path) or '\0' in path or len(path) > MAX_KEY:
        raise Rejected('bad_name', f'{text(path, 80)!r} is not a folder below the artifacts of a run')
    return path


def plain(value: Any, depth: int = 4) -> Any:
    """The value as JSON can hold it: what it cannot becomes text."""
    if value is None or (isinstance(value, int) and value.bit_length() <= MAX_BITS):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, dict) and depth:
        copy = dict(value)  # in one step: another thread of the agent may change it meanwhile
        return {text(key, MAX_KEY): plain(inner, depth - 1) for key, inner in copy.items()}
    if isinstance(value, (list, tuple)) and depth:
        return [plain(inner, depth - 1) for inner in value]
    return text(value, MAX_PARAM)


def bounded(value: Any) -> Any:
    """The value unchanged; raises Rejected for what is not a record any more but a file."""
    size = len(json.dumps(value))
    if size > MAX_TEXT:
        raise Rejected('too_large', f'an event of {size} characters: log_artifact takes a file')
    return value


def truth(value: object) -> bool:
    """False for what has none, such as an array."""
    try:
        return bool(value)
    except (TypeError, ValueError):
        return False


def _is_plain(path: str) -> bool:
    """Whether it stays what it is, and where it is, when it is taken for a file's path."""
    return posixpath.normpath(path) == path and path != '.' and not path.startswith(('..', '/'))
