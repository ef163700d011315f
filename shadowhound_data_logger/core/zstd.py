"""zstd: the module of CPython 3.14, and for those before it the same one from PyPI."""

from __future__ import annotations

import sys

if sys.version_info >= (3, 14):
    from compression.zstd import DecompressionParameter, ZstdDecompressor, ZstdError, ZstdFile, compress
else:
    from backports.zstd import DecompressionParameter, ZstdDecompressor, ZstdError, ZstdFile, compress

__all__ = ['DecompressionParameter', 'ZstdDecompressor', 'ZstdError', 'ZstdFile', 'compress']
