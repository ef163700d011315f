"""The network path to Tower: its name, its ports, its certificate, and on Tower itself which clients can reach its servers.

It sends nothing but the TLS handshake.
"""

from __future__ import annotations

import socket
import ssl
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from shadowhound_data_logger.doctor import services
from shadowhound_data_logger.doctor.machine import listening
from shadowhound_data_logger.doctor.model import Context, Result, error, info, ok, warning
from shadowhound_data_logger.doctor.services import CONNECT_S, TowerService

GLANCE_S: Final = 0.5
"""For a port that is only a guess."""
NOT_YET, EXPIRED, WRONG_HOST, WRONG_ADDRESS = 9, 10, 62, 64
"""X509_V_ERR_CERT_NOT_YET_VALID, _CERT_HAS_EXPIRED, _HOSTNAME_MISMATCH, _IP_ADDRESS_MISMATCH of OpenSSL's x509_vfy.h; others: not
trusted."""
CA_FILES: Final = {
    's3': ('AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE'),
    'mlflow': ('MLFLOW_TRACKING_SERVER_CERT_PATH', 'REQUESTS_CA_BUNDLE', 'CURL_CA_BUNDLE'),
}
"""Variables that name the file of trusted authorities, for botocore and for MLflow's client."""

SENT: Final = {
    's3': 'the data (the secret key is not sent)',
    'mlflow': 'the password, which each request carries, and the data',
}
"""What is readable on the network without encryption."""


def check_s3(context: Context) -> Iterator[Result]:
    """Check the network path to the S3 server."""
    yield from _check(services.s3(context), 'network.s3', context)


def check_mlflow(context: Context) -> Iterator[Result]:
    """Check the network path to MLflow."""
    yield from _check(services.mlflow(context), 'network.mlflow', context)


def _check(service: TowerService | None, check: str, context: Context) -> Iterator[Result]:
    if service is None:
        return
    try:
        addresses = _resolve(service)
    except (OSError, UnicodeError) as problem:
        yield error(
            f'{check}.dns',
            f'the name {service.host} cannot be resolved ({problem})',
            'no DNS server resolves it, or none can be reached: no WiFi, or not the network of the server',
            f'getent hosts {service.host}; or use the IP address of the server: '
            f'export {service.variable}=http{"s" * service.tls}://SERVER:{service.port}',
        )
        return
    yield ok(f'{check}.dns', f'{service.host} is {" and ".join(addresses)}')
    began_s = time.monotonic()
    address, refusal = _connect(addresses, service.port)
    if refusal is not None:
        yield _unreachable(service, address, f'{check}.tcp', refusal)
        return
    took_ms = 1000 * (time.monotonic() - began_s)
    yield ok(f'{check}.tcp', f'{service.title} at {service.host}:{service.port} accepts connections ({took_ms:.1f} ms)')
    if service.tls:
        yield _handshake(service, address, f'{check}.tls', context)
    elif not service.is_local:
        yield info(
            f'{check}.tls',
            f'{service.url} is not encrypted',
            f'{SENT[service.name]} can be read by every machine in this network',
            'use https on a network that you do not control',
        )


def _resolve(service: TowerService) -> list[str]:
    """Its addresses, the preferred one first."""
    found = socket.getaddrinfo(service.host, service.port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(each[4][0]) for each in found))


def _connect(addresses: Sequence[str], port: int) -> tuple[str, OSError | None]:
    """The first address that accepts a connection (a server may listen on only one), otherwise the first and its error."""
    problems: list[OSError] = []
    for address in addresses:
        try:
            socket.create_connection((address, port), timeout=CONNECT_S / len(addresses)).close()
        except OSError as problem:
            problems.append(problem)
        else:
            return address, None
    return addresses[0], problems[0]


def _unreachable(service: TowerService, address: str, check: str, problem: OSError) -> Result:
    where = f'{service.host}:{service.port}'
    if isinstance(problem, ConnectionRefusedError):
        others = [port for port in service.usual_ports if port != service.port and _answers(address, port)]
        remedy = f'on the server: sudo ss -ltnp | grep :{service.port} ; docker compose ps'
        cause = f'the machine is on, but {service.title} does not run there, or listens on another port or only on localhost'
        if others:
            cause += f'; something answers on port {others[0]}'
            remedy = f'export {service.variable}={service.at(others[0])}  # if that is {service.title}; otherwise {remedy}'
        return error(check, f'{where} refuses the connection', cause, remedy)
    if isinstance(problem, TimeoutError):
        return error(
            check,
            f'{where} does not answer within {CONNECT_S:g} s',
            'the server is off, a firewall drops packets to this port, or the WiFi is disconnected',
            f'ping -c 3 {service.host} ; on the server: '
            f'sudo ufw status | grep {service.port} || sudo ufw allow {service.port}/tcp',
        )
    return error(
        check,
        f'{where} cannot be reached: {problem.strerror or problem}',
        'this machine has no route to that network: WiFi off, or another network',
        f'ip route get {address} ; nmcli device status',
    )


def _answers(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), timeout=GLANCE_S).close()
    except OSError:
        return False
    return True


def bundle(service: TowerService, context: Context) -> tuple[str, str]:
    """Variable and path of the authorities that this service's client trusts; empty for those of the system."""
    return next(((name, path) for name in CA_FILES[service.name] if (path := context.environ.get(name))), ('', ''))


def _handshake(service: TowerService, address: str, check: str, context: Context) -> Result:
    """A TLS handshake, as this service's client will do it."""
    variable, trusted = bundle(service, context)
    try:
        trust = ssl.create_default_context(cafile=trusted or None)
    except OSError as problem:
        return error(
            check,
            f'{variable}={trusted} cannot be read: {problem}',
            'no certificate can be verified without it',
            f'ls -l {trusted}',
        )
    try:
        plain = socket.create_connection((address, service.port), timeout=CONNECT_S)
        with plain, trust.wrap_socket(plain, server_hostname=service.host) as secure:
            return ok(check, f'{service.url}: {secure.version()}, its certificate is trusted')
    except ssl.SSLCertVerificationError as problem:
        return _untrusted(service, check, problem, trusted)
    except (OSError, ValueError) as problem:
        return error(
            check,
            f'{service.url} does not speak TLS: {problem}',
            'the server expects plain http on this port',
            f'export {service.variable}={service.url.replace("https://", "http://")}',
        )


def _untrusted(service: TowerService, check: str, problem: ssl.SSLCertVerificationError, trusted: str) -> Result:
    shown = f'openssl s_client -connect {service.host}:{service.port} </dev/null 2>/dev/null | openssl x509 -noout'
    reasons: dict[int, Callable[[], Result]] = {
        EXPIRED: lambda: error(
            f'{check}.expired',
            f'the certificate of {service.url} has expired',
            'it was not renewed, or the clock of this machine is ahead',
            f'{shown} -dates ; date ; renew it on the server',
        ),
        NOT_YET: lambda: error(
            f'{check}.early',
            f'the certificate of {service.url} is not valid yet',
            'the clock of this machine is behind, or that of the server was ahead when it was made',
            f'{shown} -dates ; date ; set the clock: timedatectl',
        ),
        WRONG_HOST: lambda: error(
            f'{check}.host',
            f'the certificate of {service.url} is for another name',
            f'it does not name {service.host}',
            f'{shown} -ext subjectAltName ; use a name that is in it in {service.variable}',
        ),
    }
    reasons[WRONG_ADDRESS] = reasons[WRONG_HOST]
    if problem.verify_code in reasons:
        return reasons[problem.verify_code]()
    names = CA_FILES[service.name]
    return error(
        f'{check}.unknown',
        f'the certificate of {service.url} is not trusted ({problem.verify_message})',
        f'the authority that signed it is not in {trusted}' if trusted else 'a private authority has signed it',
        f'copy the certificate of that authority here and: export {names[0]}=/etc/shadowhound/ca.pem',
    )


def check_tower(context: Context) -> Iterator[Result]:
    """On Tower: whether other machines can reach the servers."""
    there = listening(context.root)
    for service in filter(None, (services.s3(context), services.mlflow(context))):
        only = {is_loopback for is_loopback, port in there if port == service.port}
        if not only and service.is_local:
            yield info('tower.listen', f'nothing listens on port {service.port} in this network namespace')
        elif only == {True}:
            yield warning(
                'tower.listen',
                f'{service.title} listens on 127.0.0.1:{service.port} only',
                'robots and workstations cannot reach it',
                'start it with 0.0.0.0 (docker: ports: "9000:9000"), and: '
                f'sudo ufw allow from 192.168.0.0/16 to any port {service.port} proto tcp',
            )
        elif only:
            yield ok(
                'tower.listen',
                f'{service.title} listens on port {service.port} for other machines as well',
                firewall=f'sudo ufw status | grep {service.port}',
            )
