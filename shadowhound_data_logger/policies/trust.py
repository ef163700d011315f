"""Decides which policies may run here, by metadata of The Update Framework, which python-tuf fetches from the store and verifies.

A person installs one file on the robot, ``root.json``, which the robot trusts. After that, all keys can be replaced without
access to the robot. Verified metadata is kept in ``policies/metadata`` and protects against rollback to older metadata. It
expires; then the robot keeps its policies but accepts no new version until it receives fresh metadata (``why_stale``).
https://theupdateframework.github.io/specification/latest/
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.clock import FUTURE_SLACK_NS, SECOND, utc
from shadowhound_data_logger.core.errors import AccessDenied, ObjectRefused, PolicyError, PolicyRefused
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.policies.manifest import BUCKET, PREFIX
from shadowhound_data_logger.stores.base import ObjectStore

if TYPE_CHECKING:
    from tuf.api.metadata import TargetFile
    from tuf.ngclient import Updater

ROOT: Final = 'root.json'
METADATA: Final = f'{PREFIX}/_tuf'
"""Prefix of the metadata in the bucket of policies."""
MAX_METADATA_BYTES: Final = 5_000_000
"""Of one file: a list of about 20,000 versions. python-tuf's limits are the same or lower."""
SIGNED_AT: Final = 'signed_at'
"""A field of the timestamp in addition to those of the specification: a robot whose clock is earlier has a wrong clock."""
FRESH_DAYS: Final = 14.0
"""Default validity of a signed timestamp: how long a robot accepts new versions without receiving fresh metadata."""
MISSING_PACKAGE: Final = "install the extra: pip install 'shadowhound_data_logger[policies]'"
_ROLES: Final = ('root', 'timestamp', 'snapshot', 'targets')


def target_of(robot_type: str, name: str, version: int) -> str:
    """The path under which signers list the manifest of a version, as used in delegations: ``go2/go2_patrol/7``."""
    return f'{robot_type}/{name}/{version}'


class Trust:
    """The lists of all signers, as of one refresh. One thread."""

    def __init__(self, updater: Updater) -> None:
        self._updater = updater

    def listed(self, path: str) -> TargetFile | None:
        """Hash and length of the manifest at this path; None if no signer lists it who may.

        Raises PolicyRefused (``untrusted``, ``expired``) and StoreError if that cannot be determined.
        """
        found: TargetFile | None = _translated(lambda: self._updater.get_targetinfo(path))
        return found


def refresh(folder: Path, store: ObjectStore, received: Callable[[int], None], pause: Callable[[float], object]) -> Trust:
    """Fetch and verify the current metadata; ``folder`` is the robot's folder of policies.

    Raises PolicyRefused (``untrusted``, ``expired``), PolicyError if no root is installed, StoreError and OSError.
    """
    try:
        from tuf.api.exceptions import DownloadHTTPError  # noqa: PLC0415 - in the extra
        from tuf.ngclient import FetcherInterface, Updater  # noqa: PLC0415
    except ImportError as error:
        raise PolicyError(f'a package for signatures is missing: {error}', remedy=MISSING_PACKAGE) from error

    class StoreFetcher(FetcherInterface):
        """Reads the store instead of HTTP servers: a URL is a key."""

        def _fetch(self, url: str) -> Iterator[bytes]:
            try:
                body = with_retries(lambda: store.get(BUCKET, unquote(url), MAX_METADATA_BYTES), pause=pause)
            except ObjectRefused as error:
                if error.data.get('reason') != 'missing':
                    raise PolicyRefused('untrusted', error.what) from error
                raise DownloadHTTPError(error.what, 404) from error
            except AccessDenied as error:  # a server's response for a missing object, if the robot may not list the bucket
                raise DownloadHTTPError(error.what, 403) from error
            received(len(body))
            yield body

    metadata = folder / 'metadata'
    try:
        root = (folder / ROOT).read_bytes()
    except FileNotFoundError as error:
        raise PolicyError(f'{folder / ROOT} does not exist', remedy='install the root.json that policy keys created') from error

    def refreshed() -> Updater:
        updater = Updater(str(metadata), METADATA, fetcher=StoreFetcher(), bootstrap=root)
        updater.refresh()
        return updater

    for path in metadata.glob('tmp*'):  # left by python-tuf when it was killed
        path.unlink()
    before = _stamps(metadata)
    try:
        return Trust(_translated(refreshed))
    finally:
        if changed := _stamps(metadata) - before:  # after a power cut, older metadata would be accepted again
            for path, _ in changed:
                durable_files.sync(path)
            durable_files.sync(metadata)


def _stamps(folder: Path) -> set[tuple[Path, int]]:
    """The files in a folder with their modification times, without python-tuf's link to the root, which always changes."""
    return {(path, path.stat().st_mtime_ns) for path in folder.glob('*.json') if not path.is_symlink()}


def _translated(call: Callable[[], Any]) -> Any:
    """Call python-tuf and translate its exceptions."""
    from tuf.api.exceptions import DownloadError, ExpiredMetadataError, RepositoryError  # noqa: PLC0415 - in the extra

    try:
        return call()
    except ExpiredMetadataError as error:
        raise PolicyRefused(
            'expired', f'the signed metadata has expired: {error}', remedy='policy refresh signs it again'
        ) from error
    except (RepositoryError, DownloadError) as error:
        raise PolicyRefused('untrusted', f'the signed metadata in the store cannot be trusted: {error}') from error


def follows_signers(folder: Path) -> bool:
    """Whether this machine uses policies at all."""
    return (folder / ROOT).exists() or (folder / 'current').is_symlink()


def why_stale(folder: Path, now_ns: int) -> str:
    """Why this robot accepts no new versions now, judged by the metadata that it has verified; empty if it does.

    Needs no package of the extra. A wrong clock looks the same, which the text mentions.
    """
    if not (folder / ROOT).is_file():
        return f'{folder / ROOT} does not exist: install the root.json that policy keys created'
    found = {role: _signed(folder / 'metadata' / f'{role}.json') for role in _ROLES}
    if missing := [role for role, signed in found.items() if not signed]:
        return f'no signed {missing[0]} has been received yet'
    now = utc(now_ns)
    signed_at = _time(found['timestamp'].get(SIGNED_AT))
    if signed_at is not None and now_ns < int(signed_at.timestamp()) * SECOND - FUTURE_SLACK_NS:
        return f'the clock of this robot is wrong: it shows {now:%Y-%m-%d}, but its metadata was signed on {signed_at:%Y-%m-%d}'
    expired = [(expires, role) for role, signed in found.items() if (expires := _time(signed.get('expires'))) and expires <= now]
    if not expired:
        return ''
    expires, role = min(expired)
    return (f'no fresh metadata was received: the signed {role} expired on {expires:%Y-%m-%d %H:%M} UTC, and the clock shows '
            f'{now:%Y-%m-%d %H:%M}; policy refresh signs it again, unless this clock is wrong')  # fmt: skip


def _signed(path: Path) -> dict[str, Any]:
    """The signed part of a metadata file, which was verified when it was saved; empty if the file is missing."""
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        return dict(json.loads(path.read_bytes())['signed'])
    return {}


def _time(text: object) -> datetime | None:
    with suppress(ValueError, TypeError):
        return datetime.strptime(str(text), '%Y-%m-%dT%H:%M:%SZ').replace(tzinfo=timezone.utc)
    return None
