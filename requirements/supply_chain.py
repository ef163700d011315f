#!/usr/bin/env python3
"""What the package consists of, and its known vulnerabilities: ``make sbom`` and ``make audit``.

    sbom    build/sbom/LOCK.cdx.json of each lock file that users install, and vendored.cdx.json of what is bundled here:
            CycloneDX 1.6, with versions, package URLs and SHA-256 or SHA-512 of every file that may be installed
    audit   known vulnerabilities of the pins, also of those in the image of MLflow; exit code 1 if there are any, 0 if the
            database cannot be reached, with the time at which it was last reached

The tools have a separate environment, .cache/audit, from requirements/audit.txt.
"""

from __future__ import annotations

import argparse
import base64
import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

ROOT: Final = Path(__file__).resolve().parents[1]
LOCKS: Final = ('robot', 'runtime')
"""What robots and other machines install (docs/dependencies.md)."""
AUDITED: Final = (*(ROOT / 'requirements' / f'{lock}.txt' for lock in LOCKS), ROOT / 'tower' / 'mlflow.txt')
TOOLS: Final = ROOT / '.cache' / 'audit'
REACHED: Final = ROOT / '.cache' / 'audit-reached'
"""When the database answered last, as RFC 3339 in UTC."""
PAGE: Final = ROOT / 'requirements' / 'page' / 'package-lock.json'
LICENSES: Final = ROOT / 'shadowhound_data_logger' / 'live' / 'page' / 'vendor' / 'LICENSES.txt'
ANSWER_S: Final = 3.0
AUDIT_S: Final = 60.0
_BUNDLED: Final = re.compile(r'^(\S+) (\d\S*) \(([^)]+)\)$', re.MULTILINE)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('what', choices=('sbom', 'audit'))
    what = parser.parse_args(arguments).what
    return sbom(ROOT / 'build' / 'sbom') if what == 'sbom' else audit()


def sbom(folder: Path) -> int:
    """Write the bills of materials; the exit code."""
    tools()
    folder.mkdir(parents=True, exist_ok=True)
    for lock in LOCKS:
        target = folder / f'{lock}.cdx.json'
        command = [str(TOOLS / 'bin' / 'cyclonedx-py'), 'requirements', str(ROOT / 'requirements' / f'{lock}.txt'),
                   '--output-reproducible', '--output-format', 'JSON', '--output-file', str(target)]  # fmt: skip
        subprocess.run(command, check=True)
        write(target, json.loads(target.read_text(encoding='utf-8')))
    content = {'bomFormat': 'CycloneDX', 'specVersion': '1.6', 'version': 1, 'components': list(vendored())}
    write(folder / 'vendored.cdx.json', content)
    return 0


def write(target: Path, content: dict[str, Any]) -> None:
    """Write a bill of materials of this package, with name, version and licenses as in package.xml."""
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()  # noqa: S314 - our own
    name, version = manifest.findtext('name'), manifest.findtext('version')
    license_ = [{'license': {'id': each.text}} for each in manifest.findall('license')]
    subject = {'type': 'application', 'bom-ref': f'{name}@{version}', 'name': name, 'version': version, 'licenses': license_}
    content['metadata'] = {**content.get('metadata', {}), 'component': subject}
    target.write_text(json.dumps(content, indent=2) + '\n', encoding='utf-8')
    print(target)


def vendored() -> Iterator[dict[str, Any]]:
    """The libraries in the bundles of the live page."""
    locked: Mapping[str, Any] = json.loads(PAGE.read_text(encoding='utf-8'))['packages']
    for name, version, license_ in _BUNDLED.findall(LICENSES.read_text(encoding='utf-8')):
        at = locked[f'node_modules/{name}']
        if (at['version'], at['license']) != (version, license_):
            raise SystemExit(f'{LICENSES} has {name} {version} ({license_}), {PAGE} has another: run `make vendor`')
        algorithm, _, digest = at['integrity'].partition('-')
        yield {
            'type': 'library', 'bom-ref': f'{name}@{version}', 'name': name, 'version': version,
            'purl': f'pkg:npm/{name.replace("@", "%40")}@{version}', 'licenses': [{'license': {'id': license_}}],
            'hashes': [{'alg': algorithm.upper().replace('SHA', 'SHA-'), 'content': base64.b64decode(digest).hex()}],
        }  # fmt: skip


def audit() -> int:
    """Print the known vulnerabilities of the pins; the exit code. An unreachable database is reported in one line."""
    first = re.findall(r'^(\S+)==(\S+)', AUDITED[0].read_text(encoding='utf-8'), re.MULTILINE)[0]
    if not reachable(url := f'{database()}/{first[0]}/{first[1]}/json'):
        print(f'audit: skipped, {url} does not answer within {ANSWER_S:g} s; {last_reached()}')
        return 0
    try:
        tools()
        lines, asked = judged([row for lock in AUDITED for row in audited(lock)])
    except (subprocess.SubprocessError, OSError, ValueError, LookupError) as error:
        print(f'audit: skipped, pip-audit failed: {str(error)[:200]}; {last_reached()}')
        return 0
    REACHED.parent.mkdir(exist_ok=True)
    REACHED.write_text(f'{datetime.now(timezone.utc).isoformat(timespec="seconds")}\n', encoding='utf-8')
    print('\n'.join(lines) or f'audit: no known vulnerability in {asked} packages')
    return 1 if lines else 0


def last_reached() -> str:
    """When the database answered last on this machine."""
    try:
        then = datetime.fromisoformat(REACHED.read_text(encoding='utf-8').strip())
        days = (datetime.now(timezone.utc) - then).days
    except FileNotFoundError:
        return 'it has never been reached from here'
    except (OSError, ValueError, TypeError) as error:
        return f'when it was last reached is unknown ({error})'
    return f'it was last reached at {then.isoformat()}, {days} days ago'


def audited(lock: Path) -> list[dict[str, Any]]:
    """pip-audit's row of each package."""
    command = [str(TOOLS / 'bin' / 'pip-audit'), '--requirement', str(lock), '--require-hashes', '--disable-pip',
               '--format', 'json', '--progress-spinner', 'off', '--timeout', f'{ANSWER_S:g}']  # fmt: skip
    answer = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=AUDIT_S, check=False)
    rows: list[dict[str, Any]] = json.loads(answer.stdout)['dependencies']
    return rows


def judged(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], int]:
    """A line for each vulnerability, and how many packages the database has."""
    known = {row['name']: row for row in rows if 'skip_reason' not in row}
    lines = {
        f'{row["name"]} {row["version"]}: {one["id"]}, fixed in {", ".join(one["fix_versions"]) or "no version"}'
        for row in rows
        for one in row.get('vulns', ())
    }
    return sorted(lines), len(known)


def database() -> str:
    """The URL of PyPI below which each version of a package has its vulnerabilities; empty without pip."""
    try:
        from pip._internal.models.index import PyPI  # noqa: PLC0415
    except ImportError:
        return ''
    return str(PyPI.pypi_url)


def reachable(url: str) -> bool:
    """Whether it answers before the deadline with JSON, not with the page of a proxy."""
    try:
        with urllib.request.urlopen(url, timeout=ANSWER_S) as answer:  # noqa: S310 - https, ours
            return 'vulnerabilities' in json.load(answer)
    except (OSError, ValueError):
        return False


def tools() -> None:
    """Install or update the environment of the tools. Raises subprocess.CalledProcessError without a registry."""
    wanted = (ROOT / 'requirements' / 'audit.txt').read_text(encoding='utf-8')
    done = TOOLS / 'done'
    if done.is_file() and done.read_text(encoding='utf-8') == wanted:
        return
    uv = str(ROOT / '.venv' / 'bin' / 'uv')
    subprocess.run([uv, 'venv', '--quiet', '--clear', str(TOOLS)], check=True, timeout=AUDIT_S)
    command = [uv, 'pip', 'install', '--quiet', '--python', str(TOOLS / 'bin' / 'python'), '--require-hashes',
               '--requirement', str(ROOT / 'requirements' / 'audit.txt')]  # fmt: skip
    subprocess.run(command, check=True, timeout=AUDIT_S)
    done.write_text(wanted, encoding='utf-8')


if __name__ == '__main__':
    sys.exit(main())
