"""Checks names and files that a robot wrote.

A client with a robot's keys can write anything below its prefix. A key becomes a path, a text is printed, and a file uses memory
only as far as this module allows. It raises NameRefused or a ValueError with the reason; the caller adds the name.
"""

from __future__ import annotations

import csv
import json
import math
import re
import unicodedata
import warnings
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.keys import MAX_KEY_BYTES, UNSEEN

MAX_FILE_NAME_BYTES: Final = 255
"""The limit of Linux file systems."""
MAX_DOCUMENT_BYTES: Final = 16 << 20
"""JSON that is read in one piece: the manifest of a day in slices of a minute has 2 MB. Python needs up to 24 times as much."""
MAX_JSON_DEPTH: Final = 64
"""JSON: readers may recurse into a document, and Python stops at a depth of 1,000 or less."""
MAX_SUMMARY_BYTES: Final = 1 << 20
"""A mission's ``summary.json``."""
MAX_YAML_BYTES: Final = 4 << 20
"""A ``metadata.yaml`` of some 15,000 slices."""
MAX_YAML_NODES: Final = 250_000
"""Each takes 50 us."""
MAX_YAML_DEPTH: Final = 32
MAX_OBJECT_BYTES: Final = 64 << 20
"""An object that is decoded in memory: an archive is closed after 16 MiB of messages."""
MAX_CHUNK_BYTES: Final = 128 << 20
"""A chunk of a bag, compressed or not: rosbag2 writes 768 KB, or the size of the largest message."""
PIECE_BYTES: Final = 4096
"""Damaged content: this much is lost where it cannot be decompressed."""
MAX_PIXELS: Final = 1 << 25
"""An image: 8K."""
MAX_MEMBERS: Final = 20_000
"""Files in an archive, two per message: it is closed after 10,000 of them."""
_TOO_DEEP: Final = f'its lists and objects are nested deeper than {MAX_JSON_DEPTH}'
_FORMULA: Final = frozenset('=+-@＝＋－＠')
_NUMBER: Final = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?', re.ASCII)


# -- names ---------------------------------------------------------------------------------------------------------------------


def path_below(folder: Path, key: str) -> Path:
    """The path of a key's file below a folder. Raises NameRefused for a key that is not a path below it."""
    if not is_path(key):
        raise NameRefused(f'the key {key[:200]!r} is not a path below a folder', name=key)
    return folder / key


def is_path(key: str) -> bool:
    """Whether a key can be a file below any folder: non-empty parts, no ``..``, no control characters, not too long."""
    parts = key.split('/')
    try:
        sizes = [len(part.encode()) for part in parts]
    except UnicodeEncodeError:  # an unpaired surrogate
        return False
    if '' in parts or '.' in parts or '..' in parts or sum(sizes) + len(parts) > MAX_KEY_BYTES + 1:
        return False
    return max(sizes) <= MAX_FILE_NAME_BYTES and (key.isprintable() or not any(unicodedata.category(one) == 'Cc' for one in key))


# -- what is printed -----------------------------------------------------------------------------------------------------------


def visible(text: str) -> str:
    """The text on one line, safe for a terminal: control characters are escaped as in ``repr``."""
    if text.isprintable():
        return text
    return ''.join(_escape(letter) if unicodedata.category(letter) in UNSEEN else letter for letter in text)


def csv_encoding(head: bytes) -> str:
    """The encoding of a CSV file that starts with these bytes: UTF-8, or what Excel writes, each with a byte order mark."""
    return 'utf-16' if head.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else 'utf-8-sig'


def csv_rows(body: bytes) -> csv.DictReader[str]:
    """The rows of a CSV file with a header; extra cells are under ``''``. Raises ValueError, csv.Error."""
    text = body.decode(csv_encoding(body))
    check_separator(text.partition('\n')[0])
    rows = csv.DictReader(StringIO(text, newline=''), strict=True, restkey='')
    rows.fieldnames = [name.strip() for name in rows.fieldnames or ()]
    return rows


def check_separator(names: str) -> None:
    """Raises ValueError if the header of a CSV file has another separator, as spreadsheets write in some languages."""
    for mark, name in ((';', 'semicolons'), ('\t', 'tabs')):
        if mark in names and ',' not in names:
            raise ValueError(f'its columns are separated by {name}: save it with commas')


def csv_cell(value: object) -> object:
    """A value for a CSV file: numbers unchanged, text on one line, and no text that a spreadsheet takes for a formula."""
    if value is None or isinstance(value, (bool, int, float)):
        return value
    text = visible(str(value))
    return f"'{text}" if text.lstrip()[:1] in _FORMULA and not _NUMBER.fullmatch(text) else text


def _escape(letter: str) -> str:
    return letter.encode('unicode_escape').decode('ascii')


# -- documents -----------------------------------------------------------------------------------------------------------------


def from_json(content: bytes, max_bytes: int = MAX_DOCUMENT_BYTES) -> Any:
    """Raises ValueError, also for a document that is too large or too deep."""
    check_size(len(content), max_bytes)
    try:
        return limit_depth(json.loads(content))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def from_strict_json(content: bytes, max_bytes: int) -> Any:
    """Like ``from_json``, but raises ValueError also for a duplicate name in an object and for a number that is not finite."""
    check_size(len(content), max_bytes)
    try:
        return limit_depth(
            json.loads(content, object_pairs_hook=_unique_names, parse_constant=_reject_constant, parse_float=_finite)
        )
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def limit_depth(document: Any) -> Any:
    """The JSON value unchanged. Raises ValueError if its lists and objects are nested more than 64 deep."""
    level, depth = [document], 0
    while level:
        if depth >= MAX_JSON_DEPTH:
            raise ValueError(_TOO_DEEP)
        depth += 1
        level = [
            each for one in level if isinstance(one, (dict, list)) for each in (one.values() if isinstance(one, dict) else one)
            if isinstance(each, (dict, list))
        ]  # fmt: skip
    return document


def _unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError('an object has a name twice')
    return found


def _reject_constant(word: str) -> Any:
    raise ValueError(f'{word} is not a JSON number')


def _finite(text: str) -> float:
    found = float(text)
    return found if math.isfinite(found) else _reject_constant(text)


def from_yaml(content: str) -> Any:
    """Mappings, sequences and scalars, without aliases: a few bytes of those can expand to any size. Raises ValueError."""
    from ruamel.yaml import YAML  # noqa: PLC0415 - 0.1 s that most need not
    from ruamel.yaml.composer import Composer  # noqa: PLC0415
    from ruamel.yaml.error import YAMLError  # noqa: PLC0415
    from ruamel.yaml.events import AliasEvent  # noqa: PLC0415

    class Plain(Composer):
        """Counts the nodes it composes."""

        nodes = depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            self.nodes += 1
            self.depth += 1
            if self.parser.check_event(AliasEvent):
                raise ValueError('it has aliases')
            if self.nodes > MAX_YAML_NODES or self.depth > MAX_YAML_DEPTH:
                raise ValueError(f'it is deeper than {MAX_YAML_DEPTH}, or has more than {MAX_YAML_NODES:,} values')
            made = super().compose_node(parent, index)
            self.depth -= 1
            return made

    check_size(len(content), MAX_YAML_BYTES)
    yaml = YAML(typ='safe', pure=True)  # the parser in C neither counts nor stops at a depth
    yaml.Composer = Plain
    try:
        return yaml.load(content)
    except (YAMLError, RecursionError, TypeError, AttributeError, LookupError) as error:
        raise ValueError(' '.join(str(error).split())) from error


def check_size(size: int, max_bytes: int) -> None:
    """Raises ValueError for a size above the limit."""
    if size > max_bytes:
        raise ValueError(f'it has {size:,} bytes; more than {max_bytes:,} are not read')


# -- content -------------------------------------------------------------------------------------------------------------------


def decompress(compression: str, content: bytes, size: int | None = None) -> bytes:
    """Decompress ``zstd`` or ``lz4`` content of this size (None: any allowed size), without using more memory than that.

    It stops at the size: a frame with more is invalid, and its rest is never decompressed. Raises ValueError.
    """
    max_bytes = MAX_CHUNK_BYTES if size is None else size
    check_size(max_bytes, MAX_CHUNK_BYTES)
    if compression not in {'zstd', 'lz4'}:
        raise ValueError(f'it is compressed with {compression!r}, which is not supported')
    try:
        found, is_whole = _zstd(content, max_bytes) if compression == 'zstd' else _lz4(content, max_bytes)
    except (RuntimeError, EOFError) as error:  # lz4 raises the former
        raise ValueError(str(error)) from error
    if not is_whole or len(found) > max_bytes or size not in {None, len(found)}:
        raise ValueError(f'it does not decompress to {"at most " * (size is None)}{max_bytes:,} bytes, as it should')
    return found


def decompress_damaged(compression: str, content: bytes, size: int) -> bytearray:
    """Decompress as much as possible of truncated or damaged content: its start, at most this size. Raises ValueError."""
    check_size(size, MAX_CHUNK_BYTES)
    if compression == 'zstd':
        from shadowhound_data_logger.core.zstd import ZstdDecompressor, ZstdError  # noqa: PLC0415 - for bags alone

        reader: Any = ZstdDecompressor()
        broken: tuple[type[Exception], ...] = (ZstdError, EOFError)
    elif compression == 'lz4':
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped] # noqa: PLC0415

        reader, broken = LZ4FrameDecompressor(), (RuntimeError, EOFError)
    else:
        raise ValueError(f'it is compressed with {compression!r}, which is not supported')
    found = bytearray()
    try:
        for at in range(0, len(content), PIECE_BYTES):
            piece = content[at : at + PIECE_BYTES]
            while len(found) < size and not reader.eof:
                more = reader.decompress(piece, min(size - len(found), MAX_SUMMARY_BYTES))
                found += more
                piece = b''
                if reader.needs_input or not more:
                    break
    except broken:
        pass
    return found


def _zstd(content: bytes, size: int) -> tuple[bytes, bool]:
    from shadowhound_data_logger.core.zstd import ZstdDecompressor, ZstdError  # noqa: PLC0415 - for bags alone

    found, left, is_whole = b'', content, False
    try:
        while left and len(found) <= size:  # frames may follow each other
            reader = ZstdDecompressor()
            found += reader.decompress(left, size + 1 - len(found))
            left, is_whole = reader.unused_data, reader.eof
    except ZstdError as error:
        raise ValueError(str(error)) from error
    return found, is_whole


def _lz4(content: bytes, size: int) -> tuple[bytes, bool]:
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415

    reader = LZ4FrameDecompressor()
    return bytes(reader.decompress(content, size + 1)), bool(reader.eof)


def open_image(content: bytes | Path) -> Any:
    """A Pillow image, not decoded yet: JPEG, PNG or TIFF, of at most ``MAX_PIXELS``. Raises OSError or ValueError."""
    from PIL import Image  # noqa: PLC0415 - 0.1 s, and most readers see none

    source = content if isinstance(content, Path) else BytesIO(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of images that are rejected below
            opened = Image.open(source, formats=('JPEG', 'PNG', 'TIFF'))
    except (Image.DecompressionBombError, SyntaxError) as error:  # which are not all ValueErrors
        raise ValueError(str(error)) from None
    try:
        check_pixels(opened.width, opened.height)
    except ValueError:
        opened.close()
        raise
    return opened


def check_pixels(width: int, height: int) -> None:
    """Raises ValueError for more than ``MAX_PIXELS``."""
    if width * height > MAX_PIXELS:
        raise ValueError(f'it claims {width:,} x {height:,} pixels')
