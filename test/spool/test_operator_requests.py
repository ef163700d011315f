"""Requests of operators persist after the node exits and are part of the ledger."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import pytest

from shadowhound_data_logger.spool import operator_requests
from shadowhound_data_logger.spool.operator_requests import MAX_BYTES, MAX_REQUESTS, MAX_TEXT, OperatorRequests


def test_the_newest_requests_survive_the_process(tmp_path: Path) -> None:
    """Up to a limit, in order, each with who, what, when and the response; those of other robots are not included."""
    now_ns = count(1).__next__
    record = OperatorRequests(tmp_path, 'thor', now_ns)
    for number in range(MAX_REQUESTS):
        record.add('operator at 10.0.0.7', 'flush', ok=True, answer=f'{number} objects')
    OperatorRequests(tmp_path, 'thor', now_ns).add('operator at 10.0.0.8', 'pause', ok=False, answer='x' * 1000)
    found = operator_requests.read(tmp_path, 'thor')
    assert len(found) == MAX_REQUESTS
    assert found[0] == {'at_ns': 2, 'who': 'operator at 10.0.0.7', 'do': 'flush', 'ok': True, 'answer': '1 objects'}
    assert found[-1] == {
        'at_ns': MAX_REQUESTS + 1, 'who': 'operator at 10.0.0.8', 'do': 'pause', 'ok': False, 'answer': 'x' * MAX_TEXT
    }  # fmt: skip
    assert operator_requests.file(tmp_path, 'thor').stat().st_mode & 0o077 == 0
    assert operator_requests.read(tmp_path, 'loki') == []


@pytest.mark.parametrize(
    'damage',
    [
        b'',
        b'{',
        b'{"a": 1}',
        b'[1]',
        b'[{"at_ns": "x"}]',
        b'\xff',
        b'null',
        b'[{"at_ns": 1e999}]',
        b'[' * 100_000,
        b' ' * (MAX_BYTES + 1),
    ],
)
def test_a_damaged_file_is_empty(tmp_path: Path, damage: bytes) -> None:
    """The next request is saved."""
    operator_requests.file(tmp_path, 'thor').write_bytes(damage)
    assert operator_requests.read(tmp_path, 'thor') == []
    OperatorRequests(tmp_path, 'thor', lambda: 1).add('operator', 'flush', ok=True, answer='done')
    assert [act['do'] for act in operator_requests.read(tmp_path, 'thor')] == ['flush']


def test_a_write_error_stops_no_request(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    OperatorRequests(tmp_path / 'gone', 'thor', lambda: 1).add('operator', 'flush', ok=True, answer='done')
    assert 'cannot record' in caplog.text
