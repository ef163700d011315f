"""Bills of materials and the audit of the pins: requirements/supply_chain.py."""

from __future__ import annotations

import importlib
import json
import re
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def supply_chain(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / 'requirements')
    return importlib.import_module('supply_chain')


def test_every_bundled_component_has_a_version_a_license_and_a_hash(supply_chain: Any) -> None:
    """Each package of package-lock.json that runs in the page, as npm hands it out."""
    found = {each['name']: each for each in supply_chain.vendored()}
    wanted = json.loads((ROOT / 'requirements/page/package.json').read_text())['dependencies']
    assert set(wanted) <= set(found)
    for each in found.values():
        assert re.fullmatch(r'pkg:npm/(%40[a-z]+/)?[a-z-]+@[0-9.]+', each['purl'])
        assert each['licenses'] == [{'license': {'id': each['licenses'][0]['license']['id']}}]
        assert [(one['alg'], len(one['content'])) for one in each['hashes']] == [('SHA-512', 128)]


def test_a_bill_of_materials_names_its_subject(supply_chain: Any, tmp_path: Path) -> None:
    """This package with its version, in addition to what the tool adds."""
    target = tmp_path / 'a.cdx.json'
    supply_chain.write(target, {'bomFormat': 'CycloneDX', 'metadata': {'tools': {'components': []}}, 'components': []})
    data = json.loads(target.read_text())['metadata']
    version = re.search(r'<version>(.+)</version>', (ROOT / 'package.xml').read_text())
    assert version is not None
    assert (data['component']['name'], data['component']['version']) == ('shadowhound_data_logger', version[1])
    assert data['component']['licenses'] == [{'license': {'id': 'Apache-2.0'}}]
    assert 'tools' in data


def test_a_machine_without_the_database_skips_the_audit(
    supply_chain: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """With exit code 0 and a line that says so, and without making an environment for it."""
    monkeypatch.setattr(supply_chain, 'database', lambda: 'http://127.0.0.1:9')
    monkeypatch.setattr(supply_chain, 'tools', lambda: pytest.fail('it is not needed'))
    monkeypatch.setattr(supply_chain, 'REACHED', tmp_path / 'cache' / 'reached')
    assert supply_chain.audit() == 0
    out = capsys.readouterr().out
    assert 'audit: skipped, http://127.0.0.1:9/aio' in out
    assert out.endswith('; it has never been reached from here\n')


def test_a_skipped_audit_names_the_last_one(
    supply_chain: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The time of the last answer and its age in days; a damaged note is unknown, and not an error."""
    reached = tmp_path / 'cache' / 'reached'
    monkeypatch.setattr(supply_chain, 'REACHED', reached)
    for name, answer in (('reachable', True), ('tools', None), ('audited', [])):
        monkeypatch.setattr(supply_chain, name, lambda *_, answer=answer: answer)
    assert supply_chain.audit() == 0
    then = datetime.fromisoformat(reached.read_text().strip())
    assert timedelta(0) <= datetime.now(timezone.utc) - then < timedelta(hours=1)
    monkeypatch.setattr(supply_chain, 'reachable', lambda _: False)
    reached.write_text((then - timedelta(days=40)).isoformat())
    assert supply_chain.audit() == 0
    assert capsys.readouterr().out.endswith('+00:00, 40 days ago\n')
    for damaged in ('', 'never', '2026-11-01'):
        reached.write_text(damaged)
        assert supply_chain.audit() == 0
        assert 'when it was last reached is unknown' in capsys.readouterr().out


def test_known_vulnerabilities_are_reported_once(
    supply_chain: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A package of several lock files is one finding; what the database does not know counts as not asked."""
    monkeypatch.setattr(supply_chain, 'REACHED', tmp_path / 'reached')
    rows = [
        {'name': 'a', 'version': '1', 'vulns': [{'id': 'CVE-1', 'fix_versions': ['2']}]},
        {'name': 'b', 'version': '1', 'vulns': []}, {'name': 'c', 'skip_reason': 'not found'},
    ]  # fmt: skip
    for name, answer in (('reachable', True), ('tools', None), ('audited', rows)):
        monkeypatch.setattr(supply_chain, name, lambda *_, answer=answer: answer)
    assert supply_chain.audit() == 1
    assert capsys.readouterr().out == 'a 1: CVE-1, fixed in 2\n'
    assert supply_chain.judged(rows[1:]) == ([], 1)


@pytest.mark.parametrize(
    ('package', 'oldest'),
    [('aiohttp', (3, 14, 4)), ('orjson', (3, 11, 6)), ('pillow', (12, 3)), ('grpcio', (1, 66, 2)), ('torch', (2, 6))],
)
def test_no_version_with_a_known_vulnerability_is_accepted(package: str, oldest: tuple[int, ...]) -> None:
    """The lowest version that setup.py allows has the security fixes that docs/dependencies.md names."""
    found = re.findall(rf"'{package}>=([0-9.]+)", (ROOT / 'setup.py').read_text())
    assert found
    assert all(tuple(map(int, one.split('.'))) >= oldest for one in found)
    assert f'| {package} | {".".join(map(str, oldest))} |' in (ROOT / 'docs/dependencies.md').read_text()
