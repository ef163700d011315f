"""Records what a model was trained on: computes the digest of a dataset, and sets it as a tag of an MLflow run.

A digest identifies everything in a dataset of ``shadowhound-data export``: ``info.json`` has the options, the table of sources
the SHA-256 of every source object, the table of gaps what was known to be missing, and the table of labels, if any, the labels at
the time of the export.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.config import home
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.missions.replay import open_tracking
from shadowhound_data_logger.missions.tracking import MlflowTracking

INFO: Final = 'meta/info.json'
DIGEST_FILES: Final = (INFO, 'meta/shadowhound_sources.parquet', 'meta/shadowhound_gaps.parquet')
LABEL_TABLE: Final = 'meta/shadowhound_labels.parquet'
"""Exists only in datasets with labels, as part of their digest."""
DIGEST_TAG: Final = 'shadowhound_dataset_digest'
NAME_TAG: Final = 'shadowhound_dataset'


def digest_of(folder: Path, info: bytes | None = None) -> str:
    """SHA-256 (hex) over ``DIGEST_FILES`` and the table of labels. Raises LakeError.

    ``info`` is the content of ``info.json`` before it is written.
    """
    whole = hashlib.sha256()
    for name in (*DIGEST_FILES, *((LABEL_TABLE,) if (folder / LABEL_TABLE).is_file() else ())):
        try:
            body = info if info is not None and name == INFO else (folder / name).read_bytes()
        except OSError as error:
            raise LakeError(f'{folder} is not a dataset of this program: {name}: {error.strerror}',
                            remedy='pass a folder that export lerobot wrote') from error  # fmt: skip
        whole.update(f'{name} {hashlib.sha256(body).hexdigest()}\n'.encode())
    return whole.hexdigest()


def log_dataset(run: Any, folder: Path | str) -> str:
    """Record in an MLflow run which dataset it is trained on, as tags with the dataset's digest and name.

    Args:
        run: a run (``mlflow.active_run()``) or its id. The server is that of the process's MLflow, otherwise MLFLOW_TRACKING_URI.
        folder: a dataset that ``shadowhound-data export lerobot`` wrote.

    Returns:
        The digest: a SHA-256 that stands for how the dataset was made, all its sources, and the known gaps.

    Raises:
        LakeError: the folder is not such a dataset.
        TrackingUnavailable: the server does not answer.
        TrackingRefused: the server refuses the tags.
    """
    folder = Path(folder)
    digest = digest_of(folder)
    run_id = run if isinstance(run, str) else run.info.run_id
    _tracking().log(run_id, (), {}, {DIGEST_TAG: digest, NAME_TAG: folder.absolute().name})
    return digest


def runs_trained_on(digests: Iterable[str]) -> dict[str, list[str]]:
    """Digest -> ids of the runs that ``log_dataset`` tagged with it. Raises TrackingUnavailable, TrackingRefused."""
    wanted = sorted(set(digests))
    tracking = _tracking() if wanted else None
    return {digest: tracking.tagged(DIGEST_TAG, digest) for digest in wanted} if tracking else {}


def _tracking() -> MlflowTracking:
    loaded = sys.modules.get('mlflow')
    if loaded is not None and hasattr(loaded, 'get_tracking_uri'):
        return MlflowTracking(loaded.get_tracking_uri(), '')
    return open_tracking(home(os.environ), '')
