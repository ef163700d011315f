"""What ``--fix`` may do by itself: narrow the modes of files with keys, and create buckets that are missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from shadowhound_data_logger.config import UploadSettings
from shadowhound_data_logger.doctor.model import Context, Result
from shadowhound_data_logger.doctor.services import ANSWER_S, CONNECT_S
from shadowhound_data_logger.errors import DataLoggerError


def fix(results: Sequence[Result], context: Context) -> Iterator[tuple[Result, str]]:
    """Each result that could be mended with what was done; where it failed, the words begin with ``not``."""
    done: set[tuple[str, ...]] = set()
    for result in results:
        if result.fix and result.fix not in done:
            done.add(result.fix)
            yield result, _fixed(result.fix, context)


def _fixed(what: tuple[str, ...], context: Context) -> str:
    kind, name, *rest = what
    try:
        if kind == 'mode':
            Path(name).chmod(int(rest[0], 8))
            return f'chmod {rest[0]} {name}'
        _create(name, context)
    except (OSError, DataLoggerError) as problem:
        return f'not done: {problem}'
    return f'created the bucket {name}'


def _create(bucket: str, context: Context) -> None:
    from shadowhound_data_logger.stores.s3_requests import S3Requests  # noqa: PLC0415 - botocore costs half a second

    upload = UploadSettings(threads=1, connect_timeout_s=CONNECT_S, read_timeout_s=ANSWER_S)
    with closing(S3Requests(context.settings.store, upload)) as requests:
        requests.open()
        requests.create_bucket(bucket)
