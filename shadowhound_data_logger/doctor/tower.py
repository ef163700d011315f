"""On Tower: whether others can reach what listens here."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.doctor import services
from shadowhound_data_logger.doctor.machine import listening
from shadowhound_data_logger.doctor.model import Context, Result, info, ok, warning

NAME: Final = 'tower'


def check(context: Context) -> Iterator[Result]:
    """See the module."""
    there = listening(context.root)
    for service in filter(None, (services.s3(context), services.mlflow(context))):
        only = {is_loopback for is_loopback, port in there if port == service.port}
        if not only and service.is_local:
            yield info('tower.listen', f'nothing listens on port {service.port} in this network namespace')
        elif only == {True}:
            yield warning(
                'tower.listen',
                f'{service.title} listens on 127.0.0.1:{service.port} only',
                'Thor and Spark cannot reach it',
                'start it with 0.0.0.0 (docker: ports: "9000:9000"), and: '
                f'sudo ufw allow from 192.168.0.0/16 to any port {service.port} proto tcp',
            )
        elif only:
            yield ok(
                'tower.listen',
                f'{service.title} listens on port {service.port} for others as well',
                firewall=f'sudo ufw status | grep {service.port}',
            )
