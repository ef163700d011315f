"""``shadowhound-data bag`` as a user runs it: output, exit codes and JSON."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from bags.real_bags import NAME, stored, write_ours
from bags.reference import write
from click.testing import CliRunner, Result
from mcap.writer import Writer
from shadowhound_tower.embedded import Tower
from stores.spooled import QUICK

from shadowhound_data_logger.bags.naming import BUCKET
from shadowhound_data_logger.cli.bag import bag
from shadowhound_data_logger.core.errors import BagDamaged, BagError, SettingError
from shadowhound_data_logger.stores import open_store


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home with a bag in its folder store."""
    write_ours(tmp_path / 'home' / 'store' / BUCKET / 'thor' / 'rosbags' / NAME)
    return tmp_path / 'home'


def run(home: Path, *arguments: str | Path, **environ: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': '', 'SHADOWHOUND_ROBOT': 'thor', 'COLUMNS': '300', **environ}
    return CliRunner().invoke(bag, [str(each) for each in arguments], env=env, standalone_mode=False)


def parsed(result: Result) -> object:
    return json.loads(result.stdout)


def test_bags_are_listed(home: Path) -> None:
    """One line per bag; an empty list is not an error and names where it looked."""
    found = run(home, 'list')
    assert found.return_value == 0
    for text in (NAME, 'complete', '2025-10-18 12:00:00', '15 s', '1,650', 'store'):
        assert text in found.output
    (row,) = json.loads(run(home, 'list', '--json').output)
    assert (row['bag'], row['state'], row['slices'], row['topics']) == (NAME, 'complete', 3, 2)
    assert row['t_start'] == '2025-10-18T12:00:00.000000000Z'
    empty = run(home, 'list', '--robot', 'tachi')
    assert (empty.return_value, 'There is no bag of tachi, neither in the folder' in empty.output) == (0, True)
    assert parsed(run(home, 'list', '--since', '2026-01-01', '--json')) == []
    for since in ('yesterday', '2w', '20260101'):
        assert parsed(run(home, 'list', '--since', since, '--json')) == []
    assert len(parsed(run(home, 'list', '--since', '2025-10-18T14:00:00+02:00', '--json'))) == 1  # type: ignore[arg-type]


def test_info_shows_topics_and_slices(home: Path) -> None:
    """Topics with types and rates, and the slices; the same for a folder."""
    found = run(home, 'info', NAME)
    assert found.return_value == 0
    for text in ('/imu', 'std_msgs/msg/String', '100.0 Hz', '/camera/blob', '9.9 Hz', f'{NAME}_2.mcap', 'ROS humble'):
        assert text in found.output
    info = json.loads(run(home, 'info', NAME, '--json').output)
    assert {topic['name']: topic['messages'] for topic in info['topics']} == {'/imu': 1500, '/camera/blob': 150}
    folder = home / 'store' / BUCKET / 'thor' / 'rosbags' / NAME
    assert json.loads(run(home, 'info', folder, '--json').output)['messages'] == info['messages'] == 1650


def test_verify_has_an_exit_code_for_each_result(home: Path) -> None:
    """0 for an intact bag, 1 for one that is damaged or still growing."""
    assert run(home, 'verify', NAME).return_value == 0
    folder = home / 'store' / BUCKET / 'thor' / 'rosbags' / NAME
    assert run(home, 'verify', '--deep', folder).return_value == 0
    path = folder / f'{NAME}_1.mcap'
    content = bytearray(path.read_bytes())
    content[5000] ^= 1
    path.write_bytes(content)
    found = run(home, 'verify', '--deep', NAME)
    assert (found.return_value, f'{NAME}_1.mcap' in found.output, '2 of 3 files are intact' in found.output) == (1, True, True)
    path.unlink()
    found = run(home, 'verify', NAME)
    assert (found.return_value, 'still growing' in found.output) == (1, True)
    assert parsed(run(home, 'verify', NAME, '--json'))['is_complete'] is False  # type: ignore[index]


def test_a_second_fetch_downloads_nothing_and_a_cut_reads_little(home: Path, tmp_path: Path) -> None:
    """A second fetch reports 0 bytes; a cut reports how much it read."""
    assert 'downloaded 3' in run(home, 'fetch', NAME, '--to', tmp_path / 'here').output
    assert 'downloaded 0 B' in run(home, 'fetch', NAME, '--to', tmp_path / 'here').output
    found = run(
        home, 'cut', NAME, '--start', '-2', '--topic', 'imu', '--topic', '/camera/blob', '--to', tmp_path / 'piece', '--json'
    )
    report = json.loads(found.output)
    assert (found.return_value, report['topics'], report['messages']) == (0, 2, 221)
    assert report['read_bytes'] < report['bag_bytes'] / 3
    found = run(home, 'cut', tmp_path / 'here' / NAME, '--end', '1', '--regex', 'imu', '--to', tmp_path / 'other')
    assert '100 messages on 1 topic,' in found.output
    assert run(home, 'verify', tmp_path / 'other').return_value == 0


def test_uploaded_and_watched_bags_are_confirmed_by_the_store(home: Path, tmp_path: Path) -> None:
    """Afterwards they are listed."""
    write_ours(tmp_path / 'recordings' / 'by_hand', slices=1, each=20)
    found = run(home, 'upload', tmp_path / 'recordings' / 'by_hand', '--bag-name', 'named')
    assert (found.return_value, 'confirmed by the store' in found.output) == (0, True)
    assert run(home, 'upload', '--direct', '--tar-gz', tmp_path / 'recordings' / 'by_hand').return_value == 0
    found = run(home, 'watch', tmp_path / 'recordings', '--once', '--settle', '0.1', '--json')
    assert [json.loads(line)['what'] for line in found.output.splitlines()] == ['spooled', 'stored']
    assert found.return_value == 0
    names = [row['bag'] for row in json.loads(run(home, 'list', '--json').output)]
    assert sorted(names) == ['by_hand', 'by_hand.tar.gz', 'named', NAME]


def test_an_unreachable_tower_leaves_it_in_the_spool(home: Path, tmp_path: Path) -> None:
    """Exit code 1 with the reason; ``list`` reports the unreachable store and lists the local bags anyway."""
    write_ours(tmp_path / 'by_hand', slices=1, each=20)
    unreachable = {'AWS_ENDPOINT_URL': 'http://127.0.0.1:9', 'AWS_ACCESS_KEY_ID': 'k', 'AWS_SECRET_ACCESS_KEY': 's'}
    found = run(home, 'upload', tmp_path / 'by_hand', '--timeout', '0.5', **unreachable)
    assert (found.return_value, '3 of 3 files wait in the spool' in found.output) == (1, True)
    found = run(home, 'list', '--json', **unreachable)
    assert (found.return_value, '127.0.0.1:9' in found.stderr) == (1, True)
    assert [row['bag'] for row in json.loads(found.stdout)] == ['by_hand']
    (row,) = [row for row in json.loads(run(home, 'list', '--json').output) if row['bag'] == 'by_hand']
    assert (row['state'], row['where']) == ('complete', {'spool': 3})


@pytest.mark.parametrize(('arguments', 'error', 'text'), [
    (('info', 'patrol_2025'), BagError, f'the store has {NAME}'),
    (('cut', NAME, '--topic', '/imv', '--to', 'new'), BagError, 'did you mean /imu?'),
    (('cut', NAME, '--start', 'noon', '--to', 'new'), SettingError, 'seconds since the start'),
    (('list', '--since', 'tomorrow'), SettingError, 'yesterday'),
    (('upload', '/nowhere'), BagError, 'is not a folder'),
    (('verify', './nowhere'), Exception, 'there is no folder'),
    (('info', 'a b'), Exception, 'cannot be part of an object key'),
])  # fmt: skip
def test_errors_have_remedies(home: Path, arguments: tuple[str, ...], error: type[Exception], text: str) -> None:
    """Each names the value and what is allowed."""
    found = run(home, *arguments)
    assert isinstance(found.exception, error)
    assert text in getattr(found.exception, 'message', str(found.exception))


def test_every_verb_works_with_an_s3_server(seaweed: Tower, tmp_path: Path) -> None:
    """Upload, list, info, verify, fetch and cut over S3."""
    write_ours(tmp_path / 'far')
    environ = seaweed.environment()
    home = tmp_path / 'home'
    assert run(home, 'upload', '--robot', 'spot', tmp_path / 'far', **environ).return_value == 0
    assert json.loads(run(home, 'list', '--robot', 'spot', '--json', **environ).output)[0]['state'] == 'complete'
    assert json.loads(run(home, 'info', '--robot', 'spot', 'far', '--json', **environ).output)['messages'] == 1650
    assert run(home, 'verify', '--robot', 'spot', '--deep', 'far', **environ).return_value == 0
    assert run(home, 'fetch', '--robot', 'spot', 'far', '--to', tmp_path / 'here', **environ).return_value == 0
    span = ('--start', '3', '--end', '4')
    found = run(home, 'cut', '--robot', 'spot', 'far', *span, '--to', tmp_path / 'piece', '--json', **environ)
    assert json.loads(found.output)['messages'] == 110
    store = open_store(seaweed.store_settings(), QUICK)
    try:
        shutil.rmtree(tmp_path / 'far')
        write_ours(tmp_path / 'grows', is_ended=False)
        stored(store, tmp_path / 'grows', robot='spot')
    finally:
        store.close()
    assert json.loads(run(home, 'info', '--robot', 'spot', 'grows', '--json', **environ).output)['state'] == 'growing'


def test_reading_needs_neither_ros_nor_a_spool(home: Path) -> None:
    """A workstation has neither; and reading creates no files."""
    program = (
        'import sys\n'
        'from shadowhound_data_logger.cli.main import cli\n'
        f'for verb in (["list"], ["info", {NAME!r}], ["verify", {NAME!r}]):\n'
        '    cli(["bag", *verb], standalone_mode=False)\n'
        'print([name for name in ("rclpy", "botocore", "mlflow") if name in sys.modules])\n'
    )
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60,
                         env={'SHADOWHOUND_HOME': str(home), 'PATH': ''})  # fmt: skip
    assert ran.stdout.splitlines()[-1] == '[]'
    assert [path.name for path in home.iterdir()] == ['store']


@pytest.mark.parametrize('verb', ['list', 'info', 'verify', 'fetch', 'cut', 'upload', 'watch', 'record'])
def test_the_help_has_every_verb(verb: str) -> None:
    """For the verb and each of its options."""
    command = bag.commands[verb]
    assert command.help
    assert all(option.help for option in command.params if isinstance(option, click.Option))


def test_a_bag_whose_times_are_counters_has_no_rates(tmp_path: Path) -> None:
    """A bag of 400 ns has no rates, percentages stay below 100, and counts of one are singular."""
    home, folder = tmp_path / 'home', tmp_path / 'b'

    def fill(writer: Writer) -> None:
        channel = writer.register_channel('/x', 'cdr', writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data'))
        for number in range(400):
            writer.add_message(channel, number, b'1234', number)

    write(folder / 'b_0.mcap', fill)
    found = run(home, 'info', f'{folder}/').output
    assert 'Hz' not in found
    assert '400 on 1 topic ' in found
    assert 'in 1 file ' in found
    assert '1 of 1 file is intact' in run(home, 'verify', f'{folder}/').output
    there = home / 'store' / 'sensor-data' / 'thor' / 'rosbags' / 'b'
    there.mkdir(parents=True)
    (there / 'b_0.mcap').write_bytes((folder / 'b_0.mcap').read_bytes())
    found = run(home, 'cut', 'b', '--to', tmp_path / 'piece').output
    assert 'Read all 8.0 KB in 3 requests.' in found
    assert '%' not in found
    (folder / 'b_0.mcap').write_bytes((folder / 'b_0.mcap').read_bytes()[:-1])
    for verb in ('info', 'cut'):
        ran = run(home, verb, f'{folder}/', *(('--to', tmp_path / 'other') if verb == 'cut' else ()))
        assert isinstance(ran.exception, BagDamaged)
        assert 'fetch' not in str(ran.exception)


@pytest.mark.parametrize('verb', ['info', 'verify', 'cut'])
def test_a_folder_without_a_slash_is_hinted_at(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    """A plain name refers to a bag in the store; if only a folder has that name, the error suggests ./NAME."""
    monkeypatch.chdir(tmp_path)
    write_ours(tmp_path / 'mine')
    error = run(home, verb, 'mine', *(('--to', tmp_path / 'other') if verb == 'cut' else ())).exception
    assert isinstance(error, BagError)
    assert './mine' in error.remedy


def test_repair_reports_damage_and_losses(tmp_path: Path) -> None:
    """As text and JSON: damaged, lost and rebuilt parts; exit code 1 if there are any, otherwise 0."""
    folder = tmp_path / NAME
    write_ours(folder)
    whole = run(tmp_path, 'repair', folder)
    assert (whole.return_value, 'nothing is damaged in 3 files' in whole.output) == (0, True)
    torn = folder / f'{NAME}_1.mcap'
    torn.write_bytes(torn.read_bytes()[:-100_000])
    found = run(tmp_path, 'repair', folder)
    assert found.return_value == 1
    for text in (f'{NAME}_repaired: ', '1 of them damaged', 'a truncated chunk', 'rebuilt: the summary and the footer'):
        assert text in found.output
    assert run(tmp_path, 'verify', f'{folder}_repaired', '--deep').return_value == 0
    report = parsed(run(tmp_path, 'repair', folder, '--to', tmp_path / 'other', '--json'))
    assert isinstance(report, dict)
    assert (report['out'], report['is_damaged']) == (str(tmp_path / 'other'), True)
    (file,) = [each for each in report['files'] if each['losses']]
    assert (file['name'], file['messages'] + file['lost_messages'], file['losses'][0]['messages']) == (torn.name, 550, None)
    assert 'already exists' in str(run(tmp_path, 'repair', folder).exception)
    assert 'exclude each other' in str(run(tmp_path, 'repair', folder, '--in-place', '--to', 'x').exception)
    assert run(tmp_path, 'repair', folder, '--in-place').return_value == 1
    assert run(tmp_path, 'repair', folder, '--in-place').return_value == 0


def test_a_torn_bag_has_a_remedy(tmp_path: Path) -> None:
    """With every verb that reads it."""
    folder = tmp_path / NAME
    write_ours(folder)
    torn = folder / f'{NAME}_1.mcap'
    torn.write_bytes(torn.read_bytes()[:-100_000])
    (folder / 'manifest.json').unlink()
    for arguments in (('cut', folder, '--to', tmp_path / 'piece'), ('verify', folder), ('info', folder)):
        found = run(tmp_path, *arguments)
        assert found.return_value == 1
        assert torn.name in found.output
        assert 'bag repair' in found.output, arguments
