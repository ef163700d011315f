"""The way from one Tower to another in docs/tower.md: side by side, by rclone, with everything that makes an object ours."""

from __future__ import annotations

import hashlib
import os
import random
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import boto3
import pytest

from shadowhound_data_logger.sim.tower import Tower

pytestmark = [
    pytest.mark.seaweedfs,
    pytest.mark.skipif(shutil.which('rclone') is None, reason='rclone is not installed'),
]
DOCS = Path(__file__).resolve().parents[2] / 'docs' / 'tower.md'


def _client(tower: Tower) -> Any:
    environ = tower.environment()
    return boto3.client('s3', endpoint_url=environ['AWS_ENDPOINT_URL'], aws_access_key_id=environ['AWS_ACCESS_KEY_ID'],
                        aws_secret_access_key=environ['AWS_SECRET_ACCESS_KEY'], region_name='us-east-1')  # fmt: skip


def _remote(name: str, tower: Tower) -> dict[str, str]:
    environ, prefix = tower.environment(), f'RCLONE_CONFIG_{name}_'
    return {
        f'{prefix}TYPE': 's3', f'{prefix}PROVIDER': 'Other', f'{prefix}ENDPOINT': environ['AWS_ENDPOINT_URL'],
        f'{prefix}ACCESS_KEY_ID': environ['AWS_ACCESS_KEY_ID'], f'{prefix}SECRET_ACCESS_KEY': environ['AWS_SECRET_ACCESS_KEY'],
    }  # fmt: skip


def test_the_documented_command_moves_all_of_an_object(seaweed: Tower, tmp_path: Path) -> None:
    """Content, content type and metadata arrive, large objects too; a second run moves nothing."""
    said = re.search(r'^    (rclone sync .*) old:sensor-data new:sensor-data$', DOCS.read_text(encoding='utf-8'), re.MULTILINE)
    assert said
    old = _client(seaweed)
    old.create_bucket(Bucket='to-move')
    bodies = {f'thor/camera/{number}.jpg': random.randbytes(1000 + number) for number in range(20)}
    bodies['thor/rosbags/large.mcap'] = random.randbytes(20 << 20)
    for key, body in bodies.items():
        metadata = {'sha256': hashlib.sha256(body).hexdigest(), 'robot': 'thor'}
        old.put_object(Bucket='to-move', Key=key, Body=body, ContentType='image/jpeg', Metadata=metadata)
    with Tower(tmp_path) as tower:
        new = _client(tower)
        new.create_bucket(Bucket='to-move')
        ours = {name: value for name, value in os.environ.items() if not name.startswith(('AWS_', 'RCLONE_'))}
        environ = {**ours, **_remote('OLD', seaweed), **_remote('NEW', tower), 'RCLONE_CONFIG': os.devnull}
        command = [*said[1].split(), '-v', 'old:to-move', 'new:to-move']
        subprocess.run(command, env=environ, check=True, capture_output=True)
        for key, body in bodies.items():
            found = new.get_object(Bucket='to-move', Key=key)
            assert found['Body'].read() == body
            assert found['ContentType'] == 'image/jpeg'
            assert found['Metadata']['sha256'] == hashlib.sha256(body).hexdigest()
            assert found['Metadata']['robot'] == 'thor'
        again = subprocess.run(command, env=environ, check=True, capture_output=True, text=True)
        assert 'There was nothing to transfer' in again.stderr
