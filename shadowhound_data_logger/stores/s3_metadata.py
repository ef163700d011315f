"""User metadata in S3's headers. Values that would not survive a header unchanged are encoded as RFC 2047 words.

S3 itself uses that form for such values; https://docs.aws.amazon.com/AmazonS3/latest/userguide/UsingMetadata.html
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from email.errors import HeaderParseError
from email.header import decode_header, make_header
from typing import Final

from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.stores.content import object_metadata

_PLAIN: Final = re.compile(r'(?!=\?)([!-~]+( [!-~]+)*)?')
"""Printable ASCII. Spaces at the ends and repeated spaces would not survive a header and its signature."""


def to_headers(item: SpooledObject) -> dict[str, str]:
    """The metadata of an object, each value as printable ASCII."""
    return {name: value if _PLAIN.fullmatch(value) else _encoded(value) for name, value in object_metadata(item).items()}


def from_headers(metadata: Mapping[str, str]) -> dict[str, str]:
    """The inverse of ``to_headers``. Values that are not valid encoded words are returned unchanged."""
    return {name: _decoded(value) if value.startswith('=?') else value for name, value in metadata.items()}


def _encoded(value: str) -> str:
    return f'=?UTF-8?B?{base64.b64encode(value.encode()).decode("ascii")}?='


def _decoded(value: str) -> str:
    try:
        return str(make_header(decode_header(value)))
    except (HeaderParseError, LookupError, UnicodeError, ValueError):  # written by another program
        return value
