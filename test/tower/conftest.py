"""A server with the users created by make_secrets.py."""

from __future__ import annotations

import random
import socket
from collections.abc import Callable, Iterator
from typing import Any, Final

import boto3
import pytest
from shadowhound_tower.embedded import Tower
from tower_scripts import make_secrets, prepare

PORTS: Final = (9000, 5001, 5432, 9333, 8080, 8888)


@pytest.fixture(scope='module')
def offset() -> int:
    """An offset for all ports so that none of them is taken."""
    for number in random.sample(range(500, 3000), 50):
        sockets = [socket.socket() for _ in PORTS]
        try:
            for one, port in zip(sockets, PORTS, strict=True):
                one.bind(('127.0.0.1', port + number))
            return number
        except OSError:
            continue
        finally:
            for one in sockets:
                one.close()
    raise AssertionError('no free ports')


@pytest.fixture(scope='session')
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tower]:
    """SeaweedFS with the users of make_secrets.py, prepared by prepare.py."""
    users = {name: make_secrets.actions(name) for name in ('mlflow', 'spark', 'prune', 'thor', 'tachi')}
    with Tower(tmp_path_factory.mktemp('tower'), users=users) as tower:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in tower.environment().items():
                patch.setenv(name, value)
            assert prepare.main(['--robot', 'thor', '--robot', 'tachi']) == 0
        yield tower


@pytest.fixture(scope='session')
def as_user(server: Tower) -> Callable[[str], Any]:
    """An S3 client with the keys of a user."""

    def connect(user: str) -> Any:
        environ = server.environment(user)
        return boto3.client(
            's3', endpoint_url=environ['AWS_ENDPOINT_URL'], aws_access_key_id=environ['AWS_ACCESS_KEY_ID'],
            aws_secret_access_key=environ['AWS_SECRET_ACCESS_KEY'], region_name='us-east-1',
        )  # fmt: skip

    return connect
