"""A Tower behind TLS: three wrong certificates are three findings, before a request is sent."""

from __future__ import annotations

import datetime
import ipaddress
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from doctor.scene import Scene, expect
from stores.fake_s3 import FakeS3, served, with_tls

from shadowhound_data_logger.doctor.model import Severity

DAY = datetime.timedelta(days=1)


def certificate(folder: Path, host: str = '127.0.0.1', *, ended: bool = False) -> tuple[str, str]:
    """Of a server that signed itself, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, 'tower')])
    now = datetime.datetime.now(datetime.timezone.utc)
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - 3 * DAY)
        .not_valid_after(now - DAY if ended else now + DAY)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(host))]), critical=False)
        .sign(key, hashes.SHA256())
    )
    (folder / 'crt').write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    (folder / 'key').write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )  # fmt: skip
    return str(folder / 'crt'), str(folder / 'key')


@pytest.fixture(params=['s3', 'mlflow'])
def service(request: pytest.FixtureRequest) -> tuple[str, str, str]:
    """Name, variable of the address and variable of the trusted certificates, as each client has its own."""
    return {
        's3': ('s3', 'AWS_ENDPOINT_URL', 'AWS_CA_BUNDLE'),
        'mlflow': ('mlflow', 'MLFLOW_TRACKING_URI', 'MLFLOW_TRACKING_SERVER_CERT_PATH'),
    }[request.param]


KINDS = {
    'unknown': ({}, ('/etc/shadowhound/ca.pem',)),
    'expired': ({'ended': True}, ('-dates', 'renew it')),
    'host': ({'host': '10.0.0.1'}, ('subjectAltName',)),
}


@pytest.mark.parametrize('kind', KINDS)
def test_a_wrong_certificate_is_named(scene: Scene, tmp_path: Path, service: tuple[str, str, str], kind: str) -> None:
    """And nothing is sent to its server."""
    name, address, bundle = service
    how, words = KINDS[kind]
    made = certificate(tmp_path, **how)
    if kind != 'unknown':
        scene.environ[bundle] = made[0]
    with with_tls(*made) as url:
        scene.environ[address] = url
        results = scene.ask(f'network.{name}', name)
    expect([result for result in results if result.is_finding], f'network.{name}.tls.{kind}', *words)
    assert results[-1].severity is Severity.SKIPPED


def test_a_certificate_that_is_trusted(scene: Scene, tmp_path: Path, service: tuple[str, str, str]) -> None:
    """By the variable of that client."""
    name, address, bundle = service
    made = certificate(tmp_path)
    scene.environ[bundle] = made[0]
    with with_tls(*made) as url:
        scene.environ[address] = url
        assert scene.findings(f'network.{name}') == []


def test_https_to_a_plain_port(scene: Scene) -> None:
    """With the address that works."""
    with served(FakeS3()) as server:
        scene.environ['AWS_ENDPOINT_URL'] = server.url.replace('http:', 'https:')
        expect(scene.findings('network.s3'), 'network.s3.tls', f'export AWS_ENDPOINT_URL={server.url}')


def test_a_bundle_that_is_not_there(scene: Scene, tmp_path: Path) -> None:
    """Is no reason to doubt the server."""
    with with_tls(*certificate(tmp_path)) as url:
        scene.environ |= {'AWS_ENDPOINT_URL': url, 'AWS_CA_BUNDLE': '/nowhere/ca.pem'}
        expect(scene.findings('network.s3'), 'network.s3.tls', 'ls -l /nowhere/ca.pem')


def test_a_server_behind_tls_is_known(scene: Scene, tmp_path: Path) -> None:
    """As one without is: by its name and its time."""
    made = certificate(tmp_path)
    scene.environ |= {'AWS_CA_BUNDLE': made[0], 'AWS_ACCESS_KEY_ID': 'a', 'AWS_SECRET_ACCESS_KEY': 'b'}
    with with_tls(*made) as url:
        scene.environ['AWS_ENDPOINT_URL'] = url
        told = {result.check: result.severity for result in scene.ask('s3')}
    assert told['s3.server'] == told['s3.clock'] == Severity.OK
