"""Moving from one Tower to another as in docs/tower.md: side by side, with rclone, verified by the catalog."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import boto3
import pytest
from click.testing import CliRunner
from lake.making import NOON_NS, add, add_part
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows import catalog as catalog_rows
from shadowhound_data_logger.stores import open_store

pytestmark = [
    pytest.mark.seaweedfs,
    pytest.mark.skipif(shutil.which('rclone') is None, reason='rclone is not installed'),
]
DOCS = Path(__file__).resolve().parents[2] / 'docs' / 'tower.md'
BUCKETS = ('sensor-data', 'trajectories')
LARGE = 'thor/rosbags/patrol/patrol_0.mcap'
BODIES = {
    **{('sensor-data', f'thor/camera/20261028/{number:06d}.jpg'): random.randbytes(1000 + number) for number in range(20)},
    ('sensor-data', LARGE): random.randbytes(20 << 20),
    ('sensor-data', 'thor/rosbags/patrol/manifest.json'): b'{}',
    ('sensor-data', 'thor/missions/run/summary.json'): b'{"success": true}',
    ('sensor-data', 'thor/_ledger/20261028/ledger.json'): b'{"balanced": true}',
    ('trajectories', 'thor/patrol_20261028_120000.csv'): b'x,y\n1,2\n',
}


def client(tower: Tower) -> Any:
    environ = tower.environment()
    return boto3.client('s3', endpoint_url=environ['AWS_ENDPOINT_URL'], aws_access_key_id=environ['AWS_ACCESS_KEY_ID'],
                        aws_secret_access_key=environ['AWS_SECRET_ACCESS_KEY'], region_name='us-east-1')  # fmt: skip


def remote(name: str, tower: Tower) -> dict[str, str]:
    environ, prefix = tower.environment(), f'RCLONE_CONFIG_{name}_'
    return {
        f'{prefix}TYPE': 's3', f'{prefix}PROVIDER': 'Other', f'{prefix}ENDPOINT': environ['AWS_ENDPOINT_URL'],
        f'{prefix}ACCESS_KEY_ID': environ['AWS_ACCESS_KEY_ID'], f'{prefix}SECRET_ACCESS_KEY': environ['AWS_SECRET_ACCESS_KEY'],
    }  # fmt: skip


@dataclass
class Towers:
    """An old one with a robot's data, and a new empty one."""

    old: Tower
    new: Tower
    tmp: Path

    def store(self, tower: Tower, bodies: dict[tuple[str, str], bytes], name: str) -> None:
        """As a robot does: objects, then a part with their rows."""
        rows = []
        with closing(open_store(tower.store_settings(), UploadSettings())) as store:
            for (bucket, key), body in bodies.items():
                fields = {'robot': 'thor', 't_start_ns': str(NOON_NS)}
                add(store, self.tmp / 'tmp', key, body, fields, bucket=bucket, content_type='image/jpeg')
                fields['sha256'] = hashlib.sha256(body).hexdigest()
                rows.append(catalog_rows.row_of(bucket, key, len(body), 'image/jpeg', fields))
            add_part(store, rows, name, self.tmp / 'tmp')

    def copy(self) -> str:
        """With the documented command; rclone's output."""
        text = re.search(r'^ +(rclone copy .*) old:sensor-data new:sensor-data$', DOCS.read_text(encoding='utf-8'), re.MULTILINE)
        assert text
        ours = {name: value for name, value in os.environ.items() if not name.startswith(('AWS_', 'RCLONE_'))}
        environ = {**ours, **remote('OLD', self.old), **remote('NEW', self.new), 'RCLONE_CONFIG': os.devnull}
        ran = [
            subprocess.run([*text[1].split(), '-v', f'old:{bucket}', f'new:{bucket}'], env=environ, check=True,
                           capture_output=True, text=True)
            for bucket in BUCKETS
        ]  # fmt: skip
        return ''.join(each.stderr for each in ran)

    def run(self, tower: Tower, *arguments: str) -> tuple[int, dict[str, Any]]:
        """A command of ours, with one of the two as the store."""
        environ = {**tower.environment(), 'AWS_CA_BUNDLE': None}
        found = CliRunner().invoke(cli, [*arguments, '--json'], env=environ, standalone_mode=False, catch_exceptions=False)
        return found.return_value, json.loads(found.stdout)

    def verify(self, *arguments: str) -> dict[str, list[str]]:
        """Verification of the new one: kind -> keys."""
        code, report = self.run(self.new, 'lake', 'verify', *arguments)
        assert code == (1 if report['findings'] else 0)
        return {kind: [one['key'] for one in piled['first']] for kind, piled in report['findings'].items()}

    def replace(self, key: str, body: bytes, sha256: str) -> None:
        client(self.new).put_object(Bucket='sensor-data', Key=key, Body=body, Metadata={'sha256': sha256})


@pytest.fixture
def towers(tmp_path: Path) -> Iterator[Towers]:
    for name in ('old', 'new'):
        (tmp_path / name).mkdir()
    with Tower(tmp_path / 'old') as old, Tower(tmp_path / 'new') as new:
        found = Towers(old, new, tmp_path)
        found.store(old, BODIES, 'first')
        for bucket in BUCKETS:
            client(new).create_bucket(Bucket=bucket)
        yield found


def test_a_tower_is_moved_as_documented(towers: Towers) -> None:
    """Every object arrives completely, once; objects that robots send to the new one stay; losses on the new one are named."""
    towers.copy()
    new = client(towers.new)
    for (bucket, key), body in BODIES.items():
        found = new.get_object(Bucket=bucket, Key=key)
        assert found['Body'].read() == body
        assert found['ContentType'] == 'image/jpeg'
        assert found['Metadata']['sha256'] == hashlib.sha256(body).hexdigest()
        assert found['Metadata']['robot'] == 'thor'
    assert towers.copy().count('There was nothing to transfer') == len(BUCKETS)
    towers.store(towers.old, {('sensor-data', 'thor/camera/20261028/late.jpg'): b'to the old one'}, 'late')
    towers.store(towers.new, {('sensor-data', 'thor/camera/20261028/new.jpg'): b'to the new one'}, 'new')
    towers.copy()

    catalog = towers.tmp / 'catalog'
    assert towers.run(towers.old, 'fetch', 'thor/_catalog/', '--to', str(catalog))[1]['moved'] == 2
    assert towers.run(towers.new, 'lake', 'verify', '--catalog', str(catalog))[1]['sound'] == len(BODIES) + 2
    assert towers.verify() == towers.verify('--deep') == {}

    keys = [key for bucket, key in BODIES if bucket == 'sensor-data']
    gone, cut, changed, sly = keys[:4]
    new.delete_object(Bucket='sensor-data', Key=gone)
    sums = {key: hashlib.sha256(body).hexdigest() for (_, key), body in BODIES.items()}
    towers.replace(cut, BODIES['sensor-data', cut][:-1], sums[cut])
    other = BODIES['sensor-data', changed][::-1]
    towers.replace(changed, other, hashlib.sha256(other).hexdigest())
    towers.replace(sly, BODIES['sensor-data', sly][::-1], sums[sly])
    assert towers.verify() == {'missing': [gone], 'size': [cut], 'checksum': [changed]}
    assert towers.verify('--deep') == {'missing': [gone], 'size': [cut], 'checksum': [changed, sly]}
    for entry in new.list_objects_v2(Bucket='sensor-data', Prefix='thor/_catalog/')['Contents']:
        if entry['Key'].endswith('_late.jsonl.zst'):
            new.delete_object(Bucket='sensor-data', Key=entry['Key'])
    assert towers.verify('--catalog', str(catalog))['unlisted'] == ['thor/camera/20261028/late.jpg']
