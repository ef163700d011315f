"""SeaweedFS's own servers next to S3, which serve every client unless they have keys: whether one answers us without keys.

Each gets one call that changes nothing. It needs ``grpcio`` (the extra ``tower``); without it the check is skipped.
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
"""A server of SeaweedFS has its gRPC port this far above that of HTTP."""
S3_PORT: Final = 9000
"""Of a Tower; ``make tower --offset`` moves all ports by the same."""
ANSWER_S: Final = 1.5
"""For a connection, and for all of the answer: a firewall gives neither."""
LOOPBACK: Final = '127.0.0.1'


class Question(NamedTuple):
    """A gRPC call to one of SeaweedFS's servers, without keys."""

    server: str
    port: int
    method: str


S3: Final = Question('S3', S3_PORT + GRPC, '/messaging_pb.SeaweedS3IamCache/ListPolicies')
OTHERS: Final = (
    Question('filer', 18888, '/filer_pb.SeaweedFiler/GetFilerConfiguration'),
    Question('master', 19333, '/master_pb.Seaweed/GetMasterConfiguration'),
    Question('volume server', 18080, '/volume_server_pb.VolumeServer/VolumeServerStatus'),
)


def check(context: Context) -> Iterator[Result]:
    """See the module."""
    service = services.s3(context)
    if service is None:
        return
    if failed := context.failed('network.s3'):
        yield skipped(NAME, failed)
        return
    if find_spec('grpc') is None:
        yield info(NAME, "not checked: it needs grpcio (pip install 'shadowhound_data_logger[tower]')")
        return
    hosts = [service.host, *([LOOPBACK] if context.role is Role.TOWER and not service.is_local else [])]
    asked = [(host, question) for host in hosts for question in questions(service.port)]
    with ThreadPoolExecutor(len(asked)) as pool:
        answered = pool.map(lambda one: answers_anybody(one[0], one[1].port, one[1].method), asked)
        found = [one for one, is_open in zip(asked, answered, strict=True) if is_open]
    if found:
        where = ', '.join(f'{host}:{question.port} ({question.server})' for host, question in found)
        yield warning(
            'seaweedfs.open',
            f'SeaweedFS serves everybody at {where}',
            'it was started without the keys and the certificate of its own servers: anyone who can reach one of these can '
            'become an administrator, and read or delete what is stored',
            'on Tower: make tower-secrets, and start the servers again (docs/tower.md)',
            ports=[question.port for _, question in found],
        )
    else:
        yield ok(NAME, 'except S3, no port of SeaweedFS answers without a key')


def questions(s3_port: int) -> list[Question]:
    """For the servers behind an S3 port: at SeaweedFS's own ports, and where ``make tower --offset`` puts them."""
    offsets = {0, max(0, s3_port - S3_PORT)}
    return [S3._replace(port=s3_port + GRPC)] + [
        question._replace(port=question.port + offset) for offset in sorted(offsets) for question in OTHERS
    ]


def answers_anybody(host: str, port: int, method: str) -> bool:
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
