"""The systemd unit: what it starts exists, and when it starts it again."""

from __future__ import annotations

import re
import shutil
import subprocess
from configparser import ConfigParser
from pathlib import Path

import pytest

from shadowhound_data_logger.options import ShutdownSettings

ROOT = Path(__file__).resolve().parents[1]
UNIT = ROOT / 'launch_configs' / 'shadowhound-data-logger.service'
CLOSE_S = 5.0
"""What capture/pipeline.py allows for making durable what is in memory."""


@pytest.fixture
def service() -> dict[str, str]:
    """The [Service] section, with continued lines joined as systemd joins them (systemd.syntax(7))."""
    parser = ConfigParser(interpolation=None, delimiters=('=',))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(UNIT.read_text(encoding='utf-8').replace('\\\n', ' '))
    return dict(parser['Service'])


def test_what_it_starts_is_there(service: dict[str, str]) -> None:
    """The shell's script parses; the executable and the files that it names are installed under these names."""
    script = re.fullmatch(r"/bin/bash -c '(.*)'", service['ExecStart'])
    assert script
    text = script[1].replace('$$', '$')
    assert subprocess.run(['bash', '-n', '-c', text], check=False).returncode == 0
    executable = re.search(r'exec "\$P/lib/shadowhound_data_logger/(\w+)"', text)
    assert executable
    assert f"'{executable[1]} = shadowhound_data_logger." in (ROOT / 'setup.py').read_text(encoding='utf-8')
    named = re.findall(r'\$C/([\w.]+)', text)
    assert sorted(named) == ['fastdds_shm.xml', 'go2.yaml']
    assert all((UNIT.parent / name).is_file() for name in named)


def test_the_smoke_run_of_policies_has_a_place_to_work() -> None:
    """``ProtectSystem=strict`` leaves nothing to write in but home and /data."""
    text = UNIT.with_name('shadowhound-policy.service').read_text(encoding='utf-8')
    assert 'ProtectSystem=strict' in text
    assert 'PrivateTmp=true' in text


def test_refused_settings_are_not_tried_again(service: dict[str, str]) -> None:
    """A crash starts it again, exit code 2 does not; it has time to close before it is killed."""
    assert service['Restart'] == 'on-failure'
    assert service['RestartPreventExitStatus'] == '2'
    assert float(service['TimeoutStopSec']) > CLOSE_S + ShutdownSettings().drain_s + 5


def test_the_secrets_are_in_the_file_that_the_guide_makes(service: dict[str, str]) -> None:
    """docs/thor.md creates the file of the unit, for its user alone, and no secret stands in the unit."""
    guide = (ROOT / 'docs' / 'thor.md').read_text(encoding='utf-8')
    assert f'install -m 0600 -o {service["User"]} /dev/null {service["EnvironmentFile"]}' in guide
    assert not [name for name in service if name == 'Environment']


def test_systemd_takes_it() -> None:
    """systemd-analyze finds nothing to complain about."""
    if shutil.which('systemd-analyze') is None:
        pytest.skip('no systemd here')
    said = subprocess.run(['systemd-analyze', 'verify', str(UNIT)], capture_output=True, text=True, check=False, timeout=60)
    assert (said.returncode, said.stderr) == (0, '')
