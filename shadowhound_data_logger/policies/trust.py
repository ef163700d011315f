"""Whether a policy may run here: metadata of The Update Framework, which python-tuf fetches from the store and verifies.

A person installs one file, ``root.json``, which the robot trusts. Every key may change after that without a visit to the robot.
What was verified is kept in ``policies/metadata`` and protects against older metadata; it expires, and a robot that has received
nothing fresh keeps what it has (``why_stale``). https://theupdateframework.github.io/specification/latest/
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
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.policies.manifest import BUCKET, PREFIX
from shadowhound_data_logger.stores.base import ObjectStore

if TYPE_CHECKING:
    from tuf.api.metadata import TargetFile
    from tuf.ngclient import Updater

ROOT: Final = 'root.json'
METADATA: Final = f'{PREFIX}/_tuf'
"""Where the metadata are, in the bucket of the policies."""
MAX_METADATA_BYTES: Final = 5_000_000
"""Of one file: a list of some 20,000 versions. python-tuf's own bounds are as large or lower."""
SIGNED_AT: Final = 'signed_at'
"""A field of the timestamp, next to those of the specification: a robot whose clock is behind it has a wrong clock."""
FRESH_DAYS: Final = 14.0
"""What is signed is valid for, by default: so long a robot takes new versions without having received anything fresh."""
MISSING_PACKAGE: Final = "install the extra: pip install 'shadowhound_data_logger[policies]'"
_ROLES: Final = ('root', 'timestamp', 'snapshot', 'targets')


def target_of(robot_type: str, name: str, version: int) -> str:
    """The path under which signers list the manifest of a version, and that delegations refer to: ``go2/go2_patrol/7``."""
    return f'{robot_type}/{name}/{version}'


class Trust:
    """What signers say, as of one look at the store. One thread."""

    def __init__(self, updater: Updater) -> None:
        self._updater = updater

    def listed(self, path: str) -> TargetFile | None:
        """Hash and length of the manifest at this path; None where no signer who may lists it.

        Raises PolicyRefused (``untrusted``, ``expired``) and StoreError where that cannot be said.
        """
        found: TargetFile | None = _checked(lambda: self._updater.get_targetinfo(path))
        return found


def refresh(folder: Path, store: ObjectStore, received: Callable[[int], None], pause: Callable[[float], object]) -> Trust:
    """Fetch and verify what signers say now; ``folder`` is that of the robot's policies.

    Raises PolicyRefused (``untrusted``, ``expired``), PolicyError where no root is installed, StoreError and OSError.
    """
    try:
        from tuf.api.exceptions import DownloadHTTPError  # noqa: PLC0415 - of the extra
        from tuf.ngclient import FetcherInterface, Updater  # noqa: PLC0415
    except ImportError as error:
        raise PolicyError(f'signatures need a package that is missing: {error}', remedy=MISSING_PACKAGE) from error

    class StoreFetcher(FetcherInterface):
        """Reads the store instead of HTTP servers: a URL is a key."""

        def _fetch(self, url: str) -> Iterator[bytes]:
            try:
                body = steadily(lambda: store.get(BUCKET, unquote(url), MAX_METADATA_BYTES), pause=pause)
            except ObjectRefused as error:
                if error.data.get('reason') != 'missing':
                    raise PolicyRefused('untrusted', error.what) from error
                raise DownloadHTTPError(error.what, 404) from error
            except AccessDenied as error:  # what a server answers for a missing object where the robot may not list
                raise DownloadHTTPError(error.what, 403) from error
            received(len(body))
            yield body

    metadata = folder / 'metadata'
    try:
        root = (folder / ROOT).read_bytes()
    except FileNotFoundError as error:
        raise PolicyError(f'there is no {folder / ROOT}', remedy='install the root.json that policy keys made') from error

    def refreshed() -> Updater:
        updater = Updater(str(metadata), METADATA, fetcher=StoreFetcher(), bootstrap=root)
        updater.refresh()
        return updater

    for path in metadata.glob('tmp*'):  # of python-tuf, when it was killed
        path.unlink()
    before = _stamps(metadata)
    try:
        return Trust(_checked(refreshed))
    finally:
        if changed := _stamps(metadata) - before:  # a power cut would let older metadata in again
            for path, _ in changed:
                durable_files.sync(path)
            durable_files.sync(metadata)


def _stamps(folder: Path) -> set[tuple[Path, int]]:
    """The files in a folder with the times of their changes, without python-tuf's link to the root, which it renews each time."""
    return {(path, path.stat().st_mtime_ns) for path in folder.glob('*.json') if not path.is_symlink()}


def _checked(ask: Callable[[], Any]) -> Any:
    """The answer of python-tuf, with its errors as ours."""
    from tuf.api.exceptions import DownloadError, ExpiredMetadataError, RepositoryError  # noqa: PLC0415 - of the extra

    try:
        return ask()
    except ExpiredMetadataError as error:
        raise PolicyRefused(
            'expired', f'what was signed is out of date: {error}', remedy='policy refresh signs it again'
        ) from error
    except (RepositoryError, DownloadError) as error:
        raise PolicyRefused('untrusted', f'the signed metadata in the store cannot be trusted: {error}') from error


def follows_signers(folder: Path) -> bool:
    """Whether this machine takes policies at all."""
    return (folder / ROOT).exists() or (folder / 'current').is_symlink()


def why_stale(folder: Path, now_ns: int) -> str:
    """Why this robot takes no new version now, by what it has verified so far; empty where it does.

    Needs no package of the extra. A clock that is wrong looks like this as well, and the text says so.
    """
    if not (folder / ROOT).is_file():
        return f'there is no {folder / ROOT}: install the root.json that policy keys made'
    found = {role: _signed(folder / 'metadata' / f'{role}.json') for role in _ROLES}
    if missing := [role for role, signed in found.items() if not signed]:
        return f'no signed {missing[0]} has been received yet'
    now = utc(now_ns)
    signed_at = _time(found['timestamp'].get(SIGNED_AT))
    if signed_at is not None and now_ns < int(signed_at.timestamp()) * SECOND - FUTURE_SLACK_NS:
        return (
            f'the clock of this robot is wrong: it says {now:%Y-%m-%d}, and what it has verified was signed {signed_at:%Y-%m-%d}'
        )
    expired = [(expires, role) for role, signed in found.items() if (expires := _time(signed.get('expires'))) and expires <= now]
    if not expired:
        return ''
    expires, role = min(expired)
    return (f'nothing fresh has been received: the signed {role} expired on {expires:%Y-%m-%d %H:%M} UTC, and the clock says '
            f'{now:%Y-%m-%d %H:%M}; policy refresh signs it again, unless this clock is wrong')  # fmt: skip


def _signed(path: Path) -> dict[str, Any]:
    """What a file of metadata says, which was verified before it was kept; empty where there is none."""
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        return dict(json.loads(path.read_bytes())['signed'])
    return {}


def _time(text: object) -> datetime | None:
    with suppress(ValueError, TypeError):
        return datetime.strptime(str(text), '%Y-%m-%dT%H:%M:%SZ').replace(tzinfo=timezone.utc)
    return None
