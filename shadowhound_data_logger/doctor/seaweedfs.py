"""SeaweedFS's internal servers next to S3, which serve every client unless they have keys: whether one answers without keys.

Each receives one call that changes nothing. It needs ``grpcio`` (the extra ``tower``); without it the check is skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from typing import Final, NamedTuple

from shadowhound_data_logger.doctor import services
from shadowhound_data_logger.doctor.model import Context, Result, Role, info, ok, skipped, warning

NAME: Final = 'seaweedfs'
GRPC: Final = 10_000
"""The gRPC port of a SeaweedFS server is this far above its HTTP port."""
S3_PORT: Final = 9000
"""Tower's port; ``make tower --offset`` shifts all ports by the same amount."""
ANSWER_S: Final = 1.5
"""For a connection, and for the complete answer: a firewall sends neither."""
LOOPBACK: Final = '127.0.0.1'


class Probe(NamedTuple):
    """A gRPC call to one of SeaweedFS's servers, without keys."""

    server: str
    port: int
    method: str


S3: Final = Probe('S3', S3_PORT + GRPC, '/messaging_pb.SeaweedS3IamCache/ListPolicies')
OTHERS: Final = (
    Probe('filer', 18888, '/filer_pb.SeaweedFiler/GetFilerConfiguration'),
    Probe('master', 19333, '/master_pb.Seaweed/GetMasterConfiguration'),
    Probe('volume server', 18080, '/volume_server_pb.VolumeServer/VolumeServerStatus'),
)


def check(context: Context) -> Iterator[Result]:
    """Check that no internal server answers without keys."""
    service = services.s3(context)
    if service is None:
        return
    if failed := context.failed('network.s3'):
        yield skipped(NAME, failed)
        return
    if find_spec('grpc') is None:
        yield info(NAME, "not checked: it needs grpcio (pip install 'shadowhound_data_logger[tower]')")
        return
    hosts = [service.host, *([LOOPBACK] if context.role is Role.SERVER and not service.is_local else [])]
    asked = [(host, probe) for host in hosts for probe in probes(service.port)]
    with ThreadPoolExecutor(len(asked)) as pool:
        answered = pool.map(lambda one: answers_without_keys(one[0], one[1].port, one[1].method), asked)
        found = [one for one, is_open in zip(asked, answered, strict=True) if is_open]
    if found:
        where = ', '.join(f'{host}:{probe.port} ({probe.server})' for host, probe in found)
        yield warning(
            'seaweedfs.open',
            f'SeaweedFS serves every client at {where}',
            'it was started without keys and a certificate for its internal servers: every client that can reach one '
            'can become an administrator, and read or delete objects',
            'on the server: make tower-secrets, and start the servers again (docs/tower.md)',
            ports=[probe.port for _, probe in found],
        )
    else:
        yield ok(NAME, 'no port of SeaweedFS except S3 answers without a key')


def probes(s3_port: int) -> list[Probe]:
    """The calls for the servers behind an S3 port: at SeaweedFS's own ports, and shifted as by ``make tower --offset``."""
    offsets = {0, max(0, s3_port - S3_PORT)}
    return [S3._replace(port=s3_port + GRPC)] + [
        probe._replace(port=probe.port + offset) for offset in sorted(offsets) for probe in OTHERS
    ]


def answers_without_keys(host: str, port: int, method: str) -> bool:
    """Whether a gRPC server answers a call without encryption, certificate and token. False if nothing listens."""
    import grpc  # noqa: PLC0415 - of the extra; a fifth of a second

    if port > 0xFFFF:
        return False
    with grpc.insecure_channel(f'{host}:{port}') as channel:
        try:
            channel.unary_unary(method)(b'', timeout=ANSWER_S)
        except grpc.RpcError:
            return False
    return True
