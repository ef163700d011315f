"""Other engines read the tables of the lake: the unchanged lines of docs/api/lake.md, with a real S3 server."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from textwrap import dedent

import boto3
import pytest
from lake.making import NOON_NS, add_part, row
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest
from shadowhound_data_logger.lake.row_files import Scope, row_files
from shadowhound_data_logger.lake.tables import Tables
from shadowhound_data_logger.stores import open_store

PAGE = Path(__file__).parents[2] / 'docs' / 'api' / 'lake.md'
COUNTS = {'camera': 3, 'odom': 2}
RUN = """
import ast, json, sys
url, options, code = json.load(sys.stdin)
import deltalake
table = deltalake.DeltaTable(url, storage_options=options)
*lines, last = ast.parse(code).body
names = {'table': table, 'url': url, 'options': options}
exec(compile(ast.Module(lines, []), 'page', 'exec'), names)
found = eval(compile(ast.Expression(last.value), 'page', 'eval'), names)
if hasattr(found, 'rows'):
    found = found.rows()
if hasattr(found, 'to_dict'):
    found = list(found.to_dict().items())
if isinstance(found, dict):
    found = list(zip(*found.values()))
rows = [list(row.values()) if isinstance(row, dict) else row for row in found]
print(json.dumps({sensor: int(count) for sensor, count in rows}))
"""


@pytest.fixture(scope='module')
def lake(tower: Tower, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, dict[str, str]]:
    """The URL and the options of a table with ``COUNTS``."""
    settings, folder, robot = tower.store_settings(), tmp_path_factory.mktemp('engines'), 'engines'
    keys = {'aws_access_key_id': settings.access_key_id, 'aws_secret_access_key': settings.secret_access_key}
    with closing(boto3.client('s3', endpoint_url=settings.endpoint_url, region_name=settings.region, **keys)) as client:
        for name in {'lake', BUCKET} - {each['Name'] for each in client.list_buckets()['Buckets']}:
            client.create_bucket(Bucket=name)
    rows = [row(sensor, NOON_NS + place * SECOND, robot) for sensor, count in COUNTS.items() for place in range(count)]
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, rows, 'a', folder)
    source, tables, findings = Bucket(settings, BUCKET), Tables(f's3://lake/{robot}', settings), Findings()
    tables.create()
    assert ingest(source, tables, findings, row_files(source, findings, Scope(robot=robot))).rows == len(rows)
    options = {name.upper(): value for name, value in keys.items()}
    return f'{tables.root}/objects', options | {
        'AWS_ENDPOINT_URL': settings.endpoint_url,
        'AWS_REGION': settings.region,
        'AWS_ALLOW_HTTP': 'true',
    }


def examples() -> dict[str, str]:
    """By the name of the imported module."""
    blocks = re.split(r'^    # (.*)$', PAGE.read_text(encoding='utf-8'), flags=re.MULTILINE)[1:]
    found = {}
    for title, block in zip(blocks[::2], blocks[1::2], strict=True):
        name = re.split(r'[ ,(]', title)[0].lower()
        lines = [line for line in block.splitlines() if not line or line.startswith('    ')]
        found[name] = dedent('\n'.join(lines))
    return found


def test_the_page_has_all_engines() -> None:
    """And no others, which would not be tested."""
    assert set(examples()) == {'duckdb', 'polars', 'pandas', 'daft', 'ray', 'spark'}


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('processes of engines')
@pytest.mark.parametrize('name', ['duckdb', 'polars', 'pandas', 'daft', 'ray'])
def test_an_engine_reads_the_tables(name: str, lake: tuple[str, dict[str, str]]) -> None:
    """It counts the objects of each sensor."""
    if importlib.util.find_spec(name) is None:
        pytest.skip(f'{name} is not installed here: pip install {name}')
    code = examples()[name].replace('2026-11-20', f'{utc(NOON_NS):%Y-%m-%d}')
    given = json.dumps([*lake, code])
    done = subprocess.run([sys.executable, '-c', RUN], input=given, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == COUNTS
