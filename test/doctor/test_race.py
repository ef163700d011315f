"""What the doctor says of a server where several create one object at once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from unittest import mock

import pytest
from stores.fake_s3 import FakeS3, served

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.doctor import s3
from shadowhound_data_logger.doctor.model import Result, Severity
from shadowhound_data_logger.doctor.s3_put import single_requests

NAMES = [f'{number:032x}' for number in range(s3.RACES)]


def raced(server: FakeS3) -> Iterator[Result]:
    settings = StoreSettings(endpoint_url=server.url, access_key_id='key', secret_access_key='secret')
    ids = [mock.Mock(hex=name) for name in NAMES]
    with (
        served(server),
        single_requests(settings) as requests,
        mock.patch.object(s3, 'uuid', mock.Mock(uuid4=mock.Mock(side_effect=ids))),
    ):
        yield from s3.race_creates(requests, 'sensor-data', 'thor')


@pytest.mark.parametrize(('winners', 'severity'), [(1, Severity.OK), (2, Severity.WARNING)])
def test_a_server_with_two_winners_is_reported(winners: int, severity: Severity) -> None:
    """How many won is in it, and nothing is left in the store."""
    server = FakeS3()
    if winners > 1:
        server.races = {f'/sensor-data/thor/_doctor/{name}': threading.Barrier(s3.RACERS) for name in NAMES}
    (found,) = raced(server)
    assert (found.check, found.severity) == ('s3.race', severity)
    assert winners == 1 or f'[{", ".join(["4"] * s3.RACES)}] succeeded' in found.seen
    assert not server.objects
