"""``shadowhound-data doctor``: output, JSON, exit codes, and what --fix changes."""

from __future__ import annotations

import json
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from doctor.scene import FOREIGN
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.cli import doctor as verb
from shadowhound_data_logger.doctor import model
from shadowhound_data_logger.doctor.model import Check, Context

BAD = model.error('some.thing', 'seen [bold]so\x1b[31m', 'the cause', 'echo a very long command ' + 'x' * 200)
ODD = model.warning('some.other', 'an oddity', 'it is odd', 'mend it')
FINE = model.ok('some.fine', 'as it should be')
SAID = model.info('some.info', 'good to know')


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[model.Result]:
    """The results of the only check."""
    results: list[model.Result] = []

    def run(_: Context) -> Iterator[model.Result]:
        yield from results

    monkeypatch.setattr(verb, 'CHECKS', (Check(name='some', run=run), Check(name='some.part', run=lambda _: iter([FINE]))))
    return results


def run(folder: Path, *arguments: str, **environ: str | None) -> Result:
    from os import environ as outside

    clean: dict[str, str | None] = {name: None for name in outside if name.startswith(FOREIGN)}
    given = {**clean, 'SHADOWHOUND_HOME': str(folder / 'home'), 'HOME': str(folder), **environ}
    return CliRunner(env=given).invoke(verb.doctor, list(arguments), standalone_mode=False)


def test_findings_come_after_the_verdict(found: list[model.Result], tmp_path: Path) -> None:
    """Errors before warnings, each with the observation, the reason, and a command on one line."""
    found += [FINE, ODD, SAID, BAD]
    answer = run(tmp_path, '--role', 'robot', SHADOWHOUND_ROBOT='thor')
    assert answer.return_value == 1
    lines = [line.rstrip() for line in answer.stdout.splitlines()]
    assert lines[0].startswith('2 findings: 1 error, 1 warning  role robot, robot thor, ')
    assert lines[2:5] == ['some.thing  seen [bold]so?[31m', '    the cause', f'    -> {BAD.remedy}']
    assert lines[6] == 'some.other  an oddity'
    assert 'some.info: good to know' in lines
    assert 'Fine: some 2 (-v shows them)' in lines
    assert 'as it should be' not in answer.stdout


def test_without_findings_the_exit_code_is_0(found: list[model.Result], tmp_path: Path) -> None:
    """Information does not change it; -v shows passed checks."""
    found += [FINE, SAID]
    answer = run(tmp_path, '-v')
    assert answer.return_value == 0
    assert answer.stdout.startswith('Nothing is wrong')
    assert 'ok some.fine: as it should be' in answer.stdout


def test_a_robot_that_is_not_named_is_reported(found: list[model.Result], tmp_path: Path) -> None:
    """Where no node has run: the name is the one that a node here would have."""
    found += [FINE]
    assert 'no robot found, checked as ' in run(tmp_path, '--role', 'robot').stdout
    assert 'robot tachi' in run(tmp_path, '--role', 'robot', '--namespace', '/tachi').stdout


def test_json_is_one_document(found: list[model.Result], tmp_path: Path) -> None:
    """With the verdict and all results."""
    found += [FINE, BAD]
    answer = run(tmp_path, '--json', '--role', 'workstation', SHADOWHOUND_ROBOT='tachi')
    document: dict[str, Any] = json.loads(answer.stdout)
    assert answer.return_value == 1
    assert {**document, 'took_s': 0, 'results': []} == {
        'role': 'workstation', 'robot': 'tachi', 'ok': False, 'took_s': 0, 'findings': 1, 'results': [], 'fixed': [],
    }  # fmt: skip
    assert document['results'][1] == {
        'check': 'some.thing', 'severity': 'error', 'seen': BAD.seen, 'cause': 'the cause', 'remedy': BAD.remedy,
        'took_s': document['results'][1]['took_s'], 'fix': [], 'data': {},
    }  # fmt: skip


def test_checks_are_selected_by_name_or_prefix(found: list[model.Result], tmp_path: Path) -> None:
    """``--only`` takes the name of a check or its prefix."""
    found.append(BAD)
    assert run(tmp_path, '--only', 'some.part').return_value == 0
    assert run(tmp_path, '--only', 'some').return_value == 1


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('--only', 'everything'), 'there are some, some.part'),
        (('--rate', '/imu'), '--rate /imu=50'),
        (('--role', 'laptop'), 'laptop'),
        (('--timeout', '0'), '0'),
    ],
    ids=lambda given: given[0] if isinstance(given, tuple) else given,
)  # fmt: skip
def test_an_unknown_check_is_wrong_usage(
    found: list[model.Result], tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    """The error lists the checks; none has run."""
    error = run(tmp_path, *arguments).exception
    assert isinstance(error, click.UsageError)
    assert words in f'{error.format_message()} {getattr(error, "remedy", "")}'


def test_an_invalid_parameter_file_is_wrong_usage(found: list[model.Result], tmp_path: Path) -> None:
    """The error names the file."""
    (tmp_path / 'a.yaml').write_text('- no mapping')
    error = run(tmp_path, '--params-file', str(tmp_path / 'a.yaml')).exception
    assert isinstance(error, click.UsageError)
    assert 'a.yaml is not a parameter file' in error.format_message()


def test_a_setting_that_the_node_would_refuse_is_a_finding(tmp_path: Path) -> None:
    """In the parameter file that was passed."""
    (tmp_path / 'a.yaml').write_text('/**:\n  ros__parameters:\n    camera:\n      rate: 3.0\n    imu: {batch_s: 2.0}\n')
    answer = run(tmp_path, '--params-file', str(tmp_path / 'a.yaml'), '--only', 'environment', '--json')
    found = {result['check']: result for result in json.loads(answer.stdout)['results']}
    assert 'camera.rate = 3.0 is refused' in found['environment.settings']['seen']


def test_fix_narrows_a_mode_and_nothing_else(tmp_path: Path) -> None:
    """The key file becomes readable by its owner only; findings that need a command remain."""
    path = tmp_path / '.aws/credentials'
    path.parent.mkdir()
    path.write_text('[default]\naws_access_key_id = a\naws_secret_access_key = b\n')
    path.chmod(0o644)
    asked = ('--role', 'robot', '--only', 'secrets')
    assert run(tmp_path, *asked).return_value == 1
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    answer = run(tmp_path, *asked, '--fix')
    assert answer.return_value == 0
    assert f'--fix: chmod 600 {path}' in answer.stdout
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert run(tmp_path, *asked).return_value == 0
    assert run(tmp_path, *asked, '--fix', AWS_SECRET_ACCESS_KEY='minioadmin').return_value == 1


@pytest.mark.seaweedfs
def test_fix_creates_buckets_where_the_keys_allow_it(tmp_path: Path, seaweed: Tower) -> None:
    """Otherwise it prints the reason."""
    name = f'b{tmp_path.name.replace("_", "-")[:40]}'
    (tmp_path / 'a.yaml').write_text(f'/**:\n  ros__parameters:\n    sensors: [imu]\n    imu: {{bucket: {name}}}\n')
    asked = ('--role', 'robot', '--only', 's3', '--params-file', str(tmp_path / 'a.yaml'), '--fix')
    few = run(tmp_path, *asked, **seaweed.environment('limited'))
    assert few.return_value == 1
    many = run(tmp_path, *asked, **seaweed.environment())
    assert f'--fix: created the bucket {name}' in many.stdout
    assert many.return_value == 0
    assert run(tmp_path, *asked, **seaweed.environment()).return_value == 0
