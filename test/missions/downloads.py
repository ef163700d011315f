"""The artifacts of a run as MLflow's client lists and downloads them: ``python -m missions.downloads URI RUN NAME ...``.

A separate process, because MLflow's client leaves threads behind. Those with a NAME are downloaded
singly as well.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any


def held(uri: str, run_id: str, names: Sequence[str]) -> dict[str, bytes]:
    """By their paths in the run."""
    tests = str(Path(__file__).parents[1])
    environ = {**os.environ, 'PYTHONPATH': os.pathsep.join((tests, str(Path(tests).parent), os.environ.get('PYTHONPATH', '')))}
    command = [sys.executable, '-m', 'missions.downloads', uri, run_id, *names]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=240, check=False)
    assert not done.returncode, done.stderr[-3000:]
    return {name: bytes.fromhex(content) for name, content in json.loads(done.stdout.splitlines()[-1]).items()}


def listed(client: Any, run_id: str, folder: str | None = None) -> Iterator[str]:
    for item in client.list_artifacts(run_id, folder):
        if item.is_dir:
            yield from listed(client, run_id, item.path)
        else:
            yield item.path


def main(uri: str, run_id: str, *names: str) -> None:
    """The list, the download of everything and single downloads must agree."""
    from mlflow import MlflowClient

    client = MlflowClient(uri)
    with tempfile.TemporaryDirectory() as target:
        whole = Path(client.download_artifacts(run_id, '', target))
        found = {str(path.relative_to(whole)): path.read_bytes() for path in whole.rglob('*') if path.is_file()}
    assert sorted(found) == sorted(listed(client, run_id))
    for name in names:
        with tempfile.TemporaryDirectory() as target:
            assert Path(client.download_artifacts(run_id, name, target)).read_bytes() == found[name], name
    sys.stdout.write(json.dumps({name: content.hex() for name, content in found.items()}) + '\n')


if __name__ == '__main__':
    main(*sys.argv[1:])
