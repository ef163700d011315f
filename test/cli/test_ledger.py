"""``shadowhound-data ledger`` on spools and ledgers made here: output, width and exit codes, also with ``--verify``."""

from __future__ import annotations

import io
import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from rich.console import Console
from spool.making import NOON_NS, abandon, make, new_spool, put, settle

from shadowhound_data_logger.cli.ledger import ledger, page
from shadowhound_data_logger.cli.main import main
from shadowhound_data_logger.cli.output import print_page
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.stamps import Times, by_arrival
from shadowhound_data_logger.stores.directory import DirectoryStore

STATES = ('delivered', 'pending', 'held', 'evicted', 'quarantined', 'deduplicated')


def a_topic(**figures: Any) -> dict[str, Any]:
    row = {
        'type': 'x/msg/Y', 'accounting': 'exact', 'published': 100, 'received': 100, 'missed': 0, 'missed_by': {}, 'skipped': 40,
        'rejected': {}, 'dropped': {}, 'stored': 60, 'open': 0, 'stored_in': dict.fromkeys(STATES, 0) | {'delivered': 60},
        'gaps': {}, 'by_arrival': {}, 'corrected': {}, 'stamps': None, 'other_types': {},
    }  # fmt: skip
    row = {'published_estimated': None, 'missed_estimated': None, **row, **figures}
    if 'by_grade' not in row:
        about = ('published', 'published_estimated', 'received', 'missed', 'missed_estimated', 'missed_by')
        row['by_grade'] = {row['accounting']: {name: row[name] for name in about}}
    return row


def a_ledger(balanced: bool = True, **topics: dict[str, Any]) -> dict[str, Any]:
    counts = {
        'spooled': 60,
        'pending': 0,
        'held': 0,
        'delivered': 60,
        'evicted': 0,
        'quarantined': 0,
        'deduplicated': 0,
        'kept': 0,
    }
    named = {f'/{name}'.replace('__', '/'): row for name, row in topics.items()}
    return {
        'robot': 'thor', 'balanced': balanced, 'topics': named, 'bags': {}, 'events': {}, 'objects': counts, 'bytes': counts,
        'clock': {'is_set': True, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'held': 0}, 'operator_requests': [],
        'not_logged': {}, 'robots': ['thor'],
    }  # fmt: skip


def shown(found: dict[str, Any], width: int = 80, *, terminal: bool = False) -> str:
    output = io.StringIO()
    print_page(
        *page(found), console=Console(file=output, width=width, highlight=False, force_terminal=terminal, color_system=None)
    )
    return output.getvalue()


def test_the_default_topics_fit_into_80_columns() -> None:
    """Without a terminal no line is longer than 80 characters, and nothing is cut or abbreviated."""
    text = shown(a_ledger(camera__camera_info=a_topic(published=1_234_567, received=1_234_567), point_cloud2=a_topic()))
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert '/camera/camera_info  1,234,567  1,234,567' in text
    assert '…' not in text


def test_the_robot_is_the_one_whose_node_ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The spool contains the name of a node in a namespace; the environment can name another robot."""
    monkeypatch.delenv('SHADOWHOUND_ROBOT', raising=False)
    spool = new_spool(tmp_path)
    spool.open()
    (tmp_path / 'status-tachi.json').write_text('{}')
    for robot in ('tachi', 'other'):
        answer = CliRunner().invoke(ledger, ['--spool', str(tmp_path), '--json'], standalone_mode=False)
        found = json.loads(answer.stdout)
        assert (found['robot'], found['robots']) == (robot, [robot])
        monkeypatch.setenv('SHADOWHOUND_ROBOT', 'other')
    abandon(spool)


def test_robots_that_share_a_spool_are_all_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ledger covers the whole spool, so it names all of them."""
    monkeypatch.delenv('SHADOWHOUND_ROBOT', raising=False)
    spool = new_spool(tmp_path)
    spool.open()
    for robot in ('tachi', 'thor'):
        (tmp_path / f'status-{robot}.json').write_text('{}')
    answer = CliRunner().invoke(ledger, ['--spool', str(tmp_path)], standalone_mode=False)
    assert 'No message of tachi and thor has been received yet.' in answer.stdout
    abandon(spool)


def test_a_pipe_gets_complete_columns() -> None:
    """Without a terminal, rows wider than 80 columns are not wrapped: one line per topic."""
    losses = {'rejected': {'truncated': 1_000_000}, 'dropped': {'queue_full': 2_000_000}}
    name = 'tachi__front_camera__image_raw__compressed'
    text = shown(a_ledger(**{name: a_topic(published=10**9, received=10**9, open=1234, **losses)}))
    row = next(line for line in text.splitlines() if line.startswith('/tachi'))
    figures = '1,000,000,000 1,000,000,000 0 40 1,000,000 2,000,000 60 1,234'
    assert row.split() == ['/tachi/front_camera/image_raw/compressed', *figures.split()]


@pytest.mark.parametrize('width', [60, 80])
def test_a_narrow_terminal_breaks_no_topic(width: int) -> None:
    """A table that is too wide is a list of names and values."""
    name = 'tachi__front_camera__image_raw__compressed'
    text = shown(a_ledger(**{name: a_topic()}), width, terminal=True)
    assert max(map(len, text.splitlines())) <= width
    assert '/tachi/front_camera/image_raw/compressed' in text.split()


def test_empty_columns_are_hidden() -> None:
    """The columns rejected, dropped and open appear only if they contain something."""
    assert not {'rejected', 'dropped', 'open'} & set(shown(a_ledger(imu=a_topic())).split())
    assert 'dropped' in shown(a_ledger(imu=a_topic(dropped={'queue_full': 1}))).split()


def test_bags_have_a_separate_table() -> None:
    """It shows what was recorded into bags, and why messages were not; without bags there is no such table."""
    found = a_ledger(imu=a_topic())
    assert 'bags' not in shown(found)
    text = shown(found | {'bags': {'/imu': a_topic(skipped=0, dropped={'queue_full': 40}, stored=60)}})
    assert 'Messages recorded into bags of thor' in text
    assert '/imu in bags: dropped by queue_full 40' in text


def test_causes_are_listed_by_topic() -> None:
    """Missed, rejected and dropped messages are listed with their causes, the most frequent first."""
    text = shown(a_ledger(imu=a_topic(missed=15, missed_by={'transport': 3, 'restart': 12}), odom=a_topic()))
    assert '/imu: missed by restart 12, transport 3' in text
    assert '/odom:' not in text


def test_other_types_of_a_topic_are_reported() -> None:
    """With the publishers and the number of rejected messages, or that it is unknown."""
    others = {'a/msg/A': {'publishers': ['/x'], 'messages': 1234}, 'b/msg/B': {'publishers': [], 'messages': None}}
    text = shown(a_ledger(odom=a_topic(other_types=others)), 200)
    assert '/odom: published as a/msg/A too, by /x; of that 1,234 messages were rejected (wrong_type)' in text
    assert 'published as b/msg/B too, by a program that is not a ROS node; it was not listened to' in text


def test_messages_dated_by_arrival_are_reported() -> None:
    """How many of each topic, with the reason why their own time was not trusted."""
    text = shown(a_ledger(odom=a_topic(by_arrival={'sent_ahead': 3, 'stamp_too_old': 1200})), 200)
    assert '/odom: dated by arrival, not by the message: stamp_too_old 1,200, sent_ahead 3' in text


def test_a_clock_that_is_off_is_named() -> None:
    """The topic's line contains the offset and the likely cause."""
    stamps = {'publisher': 'p', 'state': 'offset', 'offset_s': -3600.0, 'spread_s': 0.1, 'since_ns': 0, 'cause': 'clock'}
    text = shown(a_ledger(odom=a_topic(stamps=stamps)), 300)
    assert '/odom: stamps are 3,600.0 s newer than their arrival since 1970-01-01' in text
    assert 'the clock of the computer that publishes it is not synchronized' in text


def test_undelivered_messages_are_reported() -> None:
    """Stored messages whose objects are not in the store yet are listed with their state."""
    text = shown(a_ledger(imu=a_topic(stored_in=dict.fromkeys(STATES, 0) | {'delivered': 50, 'pending': 10})))
    assert '/imu: of 60 stored, pending 10' in text


def test_accounting_is_mentioned_only_where_it_is_not_exact() -> None:
    """Unknown values are dashes, never 0, and a line explains why; the total of such a column is unknown too."""
    text = shown(a_ledger(imu=a_topic(accounting='received-only', published=None, missed=None), odom=a_topic()))
    assert '/imu: its messages carry no numbers' in text
    assert next(line for line in text.splitlines() if line.startswith('/imu')).split()[1:5] == ['received-only', '-', '100', '-']
    assert next(line for line in text.splitlines() if line.startswith('all')).split()[1:4] == ['-', '200', '-']
    assert 'exact' not in shown(a_ledger(odom=a_topic()))


ABOUT: dict[str, Any] = {
    'accounting': 'estimated', 'published': None, 'published_estimated': 123, 'missed': None, 'missed_estimated': 23,
    'missed_by': {'transport': 20, 'restart': 3},
}  # fmt: skip


def test_estimates_are_marked_everywhere() -> None:
    """In the topic's row, in the total, and in the causes."""
    text = shown(a_ledger(imu=a_topic(**ABOUT), odom=a_topic()))
    assert next(line for line in text.splitlines() if line.startswith('/imu')).split()[1:5] == ['estimated', '~123', '100', '~23']
    assert next(line for line in text.splitlines() if line.startswith('all')).split()[1:4] == ['~223', '200', '~23']
    assert '/imu: missed by transport ~20, restart ~3' in text


def test_several_grades_have_a_line_each() -> None:
    """The topic's row has its current grade; below it, each grade has its own counts."""
    parts = a_topic(received=40, published=45, missed=5)['by_grade'] | a_topic(**ABOUT)['by_grade']
    text = shown(a_ledger(imu=a_topic(received=140, published=None, missed=None, by_grade=parts)))
    lines = [line.split() for line in text.splitlines()]
    assert ['/imu', 'exact', '-', '140', '-'] in [line[:5] for line in lines]
    assert ['exact', '45', '40', '5'] in lines
    assert ['estimated', '~123', '100', '~23'] in lines
    assert '/imu: missed by transport ~20, restart ~3 (estimated)' in text


@pytest.mark.parametrize(
    ('rows', 'words'),
    [
        ([{}], 'every message is stored, skipped, or listed as lost.'),
        ([{}, ABOUT], 'or listed as lost; what was missed is estimated for 1 topic.'),
        ([{'accounting': 'received-only', 'missed': None, 'published': None}] * 2, 'what was missed is not known for 2 topics.'),
    ],
)
def test_no_sentence_claims_more_than_the_grades(rows: list[dict[str, Any]], words: str) -> None:
    """Only exact accounting claims that every message is accounted for."""
    text = shown(a_ledger(**{f't{number}': a_topic(**row) for number, row in enumerate(rows)}), 200)
    assert words in text
    assert ('balances: every message is stored' in text) == (rows == [{}])


@pytest.mark.parametrize('unknown', [
    {'not_logged': {'/led': 'there is no rule for its type'}},
    {'topics': {'odom': {'other_types': {'x/msg/Y': {'messages': None, 'publishers': ['/a']}}}}},
])  # fmt: skip
def test_the_verdict_is_about_what_was_received_where_something_is_not_logged(unknown: dict[str, Any]) -> None:
    """Unlogged messages are listed above it."""
    found = a_ledger(odom=a_topic(**unknown.get('topics', {}).get('odom', {})))
    text = shown({**found, 'not_logged': unknown.get('not_logged', {})}, 200)
    assert 'balances: every message that was received is stored, skipped, or listed as lost; what is not logged is listed' in text
    assert '/led: not logged: there is no rule for its type' in text or 'so the number of messages is not known' in text


def test_topics_without_messages_are_listed_below_the_table() -> None:
    """They have no row in the table."""
    never = a_topic(accounting=None, received=0, published=None, missed=None, stored=0, skipped=0, by_grade={})
    text = shown(a_ledger(imu=never, odom=a_topic()))
    assert not any(line.startswith('/imu') for line in text.splitlines())
    assert 'no message was received of /imu' in text


def test_an_imbalance_is_named() -> None:
    """The verdict names each sum that does not add up."""
    text = shown(a_ledger(balanced=False, imu=a_topic(stored=59)))
    assert 'The ledger balances' not in text
    assert 'Does not balance: /imu: received 100' in text


def test_a_spool_without_messages_is_no_error() -> None:
    """A node that has not received anything yet has a ledger that balances."""
    text = shown(a_ledger())
    assert 'No message of thor has been received yet.' in text
    assert 'The ledger balances' in text


def test_the_command_reads_a_spool_in_use(tmp_path: Path) -> None:
    """While another process has the spool open: exit code 0, and --json has the same counts as the text."""
    spool = new_spool(tmp_path / 'spool')
    spool.open()
    try:
        first, _ = put(spool, make('thor/camera/20251018/120000_front.jpg'), make('thor/camera/20251018/120001_front.jpg'))
        settle(spool, first, State.DELIVERED)
        text = CliRunner().invoke(ledger, ['--spool', str(tmp_path / 'spool')], standalone_mode=False)
        as_json = CliRunner().invoke(ledger, ['--json', '--spool', str(tmp_path / 'spool')], standalone_mode=False)
    finally:
        spool.close()
    assert (text.return_value, as_json.return_value) == (0, 0)
    assert '/camera: of 2 stored, pending 1' in text.stdout
    found = json.loads(as_json.stdout)
    assert found['balanced'] is True
    assert found['topics']['/camera']['stored_in']['delivered'] == 1
    assert found['objects']['pending'] == 1


def test_no_spool_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 1, one line that names the folder, and one with a remedy."""
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'ledger', '--spool', str(tmp_path / 'none')])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 1
    error = capsys.readouterr().err
    what, remedy = error.splitlines()
    assert str(tmp_path / 'none') in what
    assert 'SHADOWHOUND_HOME' in remedy


@pytest.mark.parametrize(
    ('clock', 'words'),
    [
        (
            {'is_set': False, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'held': 7},
            ['7 objects wait for their date'],
        ),
        (
            {'is_set': True, 'steps': 2, 'last_step_s': -5.0, 'last_step_time': '2025-10-18T11:59:55.000000Z', 'held': 0},
            ['stepped 2 times, last by -5.000 s at 2025-10-18T11:59:55'],
        ),
        ({'is_set': True, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'held': 0}, []),
    ],
)
def test_clock_steps_are_reported(clock: dict[str, Any], words: list[str]) -> None:
    """Only if they affect dates."""
    text = ' '.join(shown({**a_ledger(), 'clock': clock}).split())
    for part in words:
        assert part in text
    assert ('clock of the robot' in text) is bool(words)


def lossy(root: Path) -> None:
    """A home with a transport loss at noon, and two samples dropped a minute later, in a mission."""
    spool = new_spool(root)
    spool.open()
    with spool.accounts.entry('/camera') as account:
        for number in (1, 5, 6, 7):
            account.receive('p', number, Times(NOON_NS + number * 100_000_000, NOON_NS + 146 * SECOND + number * 100_000_000))
        account.skipped += 2
    spool.accounts.set_mission('patrol-7')
    spool.accounts.drop('/camera', 'queue_full', 2, by_arrival(NOON_NS + 60 * SECOND), by_arrival(NOON_NS + 61 * SECOND))
    spool.commit()
    spool.close()


def gaps(root: Path, *options: str) -> tuple[Any, list[dict[str, Any]]]:
    """The page of ``--gaps``, and the rows of its JSON."""
    given = ['--gaps', '--spool', str(root), *options]
    text = CliRunner().invoke(ledger, given, standalone_mode=False)
    as_json = CliRunner().invoke(ledger, [*given, '--json'], standalone_mode=False)
    return text, json.loads(as_json.stdout)['gaps'] if as_json.exit_code == 0 else []


def test_gaps_have_time_duration_count_and_cause(tmp_path: Path) -> None:
    """As a table, and as the JSON of the contract."""
    lossy(tmp_path / 'spool')
    text, rows = gaps(tmp_path / 'spool')
    assert text.return_value == 0
    lines = [line.split() for line in text.stdout.splitlines()]
    arrived = ['2025-10-18', '12:02:26.100']
    assert ['/camera', 'objects', '2025-10-18', '12:00:00.100', '0.4', 's', *arrived, '3', '1', 'missed', 'transport'] in lines
    assert [
        '/camera',
        'objects',
        '2025-10-18',
        '12:01:00.000',
        '1.0',
        's',
        '2025-10-18',
        '12:01:00.000',
        '2',
        '1',
        'dropped',
        'queue_full',
        'patrol-7',
    ] in lines
    assert rows[0] == {
        'sink': 'objects', 'topic': '/camera', 'publisher': 'p', 'session': 1, 'kind': 'missed', 'cause': 'transport',
        'from_ns': NOON_NS + 100_000_000, 'to_ns': NOON_NS + 500_000_000, 'received_from_ns': NOON_NS + 146_100_000_000,
        'received_to_ns': NOON_NS + 146_500_000_000, 'count': 3, 'merged': 1, 'grade': 'exact', 'mission_id': None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ('options', 'causes'),
    [
        (['--topic', '/camera'], ['transport', 'queue_full']),
        (['--topic', '/imu'], []),
        (['--since', '2025-10-18T12:00:30'], ['queue_full']),
        (['--until', '2025-10-18T12:00:00.2'], ['transport']),
        (['--cause', 'queue_full'], ['queue_full']),
        (['--cause', 'missed'], ['transport']),
    ],
)
def test_gaps_can_be_filtered_by_topic_time_and_cause(tmp_path: Path, options: list[str], causes: list[str]) -> None:
    """With --since or --until, gaps without a time are skipped."""
    lossy(tmp_path / 'spool')
    _, rows = gaps(tmp_path / 'spool', *options)
    assert sorted(row['cause'] for row in rows) == sorted(causes)


def test_questions_about_gaps_need_gaps(tmp_path: Path) -> None:
    """An option that would have no effect is rejected."""
    found = CliRunner().invoke(ledger, ['--topic', '/camera', '--spool', str(tmp_path)])
    assert found.exit_code == 2
    assert 'choose among gaps' in found.output


SECRET = 'a-Secret-that-nobody-may-see'


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home whose spool has delivered three objects to its folder, and holds one more."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    spool = new_spool(tmp_path / 'spool')
    spool.open()
    store = DirectoryStore(tmp_path / 'store')
    items = put(spool, *(make(f'thor/{name}', name.encode()) for name in ('a', 'b', 'c', 'pending')))
    for item in items[:3]:
        store.put(item)
        settle(spool, item, State.DELIVERED)
    abandon(spool)  # without closing it, as while the node runs
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(ledger, arguments, standalone_mode=False)


def as_json(*arguments: str) -> dict[str, Any]:
    answer = run(*arguments, '--json')
    report: dict[str, Any] = json.loads(answer.stdout)
    assert answer.return_value == (0 if report['ok'] else 1)
    return report


@pytest.mark.parametrize('option', ['--verify', '--deep'])
def test_verify_finds_a_complete_store(home: Path, option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 0; the text has the number of objects, the store, and since when objects are remembered."""
    monkeypatch.setenv('COLUMNS', '300')
    answer = run(option)
    assert answer.return_value == 0
    text = ' '.join(answer.stdout.split())
    assert f'the folder {home}/store was checked for 3 of 3 delivered objects, those since 2025-10-18 12:00:00 UTC.' in text
    assert 'All of them are there' in text
    assert not answer.stderr


def test_verify_lists_missing_objects(home: Path) -> None:
    """Exit code 1; each kind of finding is listed with its keys, in the text and as JSON."""
    (home / 'store/sensor-data/thor/a').unlink()
    (home / 'store/sensor-data/thor/b').write_bytes(b'longer')
    text = run('--verify')
    assert text.return_value == 1
    assert 'sensor-data/thor/a: 1 bytes were delivered' in text.stdout
    assert '2 are not what was delivered' in text.stdout
    report = as_json('--verify')
    assert {kind: [one['key'] for one in group['first']] for kind, group in report['findings'].items()} == {
        'missing': ['thor/a'], 'size': ['thor/b'],
    }  # fmt: skip
    assert (report['asked'], report['sound'], report['known'], report['forgotten']) == (3, 1, 3, 0)


def test_verify_names_a_store_that_is_not_the_nodes(home: Path) -> None:
    """If objects are missing and the node delivered to another store, the report names that store."""
    status = home / 'spool' / 'status-thor.json'
    for path in (home / 'store').rglob('*'):
        if path.is_file():
            path.unlink()
    for target, is_other in (('the S3 server at http://10.0.0.5:9000', True), (f'the folder {home}/store', False)):
        status.write_text(json.dumps({'robot': 'thor', 'store': {'target': target}}))
        text = ' '.join(run('--verify').stdout.split())
        assert '3 not in the store' in text
        assert (f'But the node delivered to {target}: is AWS_ENDPOINT_URL set here' in text) is is_other
        assert as_json('--verify')['delivered_to'] == [target]


def test_forgotten_objects_are_reported(home: Path) -> None:
    """The report counts the delivered objects that the index no longer contains."""
    with closing(sqlite3.connect(home / 'spool/index.db')) as index:
        index.execute("DELETE FROM objects WHERE key = 'thor/a'")
        index.commit()
    assert '1 older ones are not remembered' in ' '.join(run('--verify').stdout.split())


def test_the_catalog_is_not_called_forgotten(home: Path) -> None:
    """Parts of the catalog are not checked, as later ones replace them, but they do not count as forgotten."""
    with closing(sqlite3.connect(home / 'spool/index.db')) as index:
        index.execute("UPDATE objects SET sensor = '_catalog' WHERE key = 'thor/a'")
        index.commit()
    report = as_json('--verify')
    assert (report['known'], report['forgotten']) == (2, 0)


def test_an_unreachable_store_is_an_error_and_not_a_loss(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 1 and the number of unchecked objects; none is called missing, and no secret is printed."""
    monkeypatch.setenv('AWS_ENDPOINT_URL', 'http://127.0.0.1:9')
    monkeypatch.setenv('AWS_ACCESS_KEY_ID', 'KEYID')
    monkeypatch.setenv('AWS_SECRET_ACCESS_KEY', SECRET)
    monkeypatch.setattr('shadowhound_data_logger.core.retry.TRIES', 1)
    answer = run('--verify')
    assert answer.return_value == 1
    text = ' '.join(answer.output.split())
    assert 'The store cannot be reached' in text
    assert '3 objects are not checked yet' in text
    assert SECRET not in text
    report = as_json('--deep')
    assert (report['findings'], report['asked'], bool(report['unreachable'])) == ({}, 0, True)
    monkeypatch.delenv('AWS_ENDPOINT_URL')
    assert as_json('--verify')['asked'] == 3


def test_an_interrupted_run_resumes(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Objects that an earlier run found intact are not checked again, except with --again."""
    heads = DirectoryStore.head

    def interrupted(self: DirectoryStore, bucket: str, key: str) -> Any:
        if key == 'thor/c':
            raise KeyboardInterrupt
        return heads(self, bucket, key)

    for option, asked in (('--verify', 1), ('--again', 3)):
        with monkeypatch.context() as patched:
            patched.setattr(DirectoryStore, 'head', interrupted)
            with pytest.raises(click.Abort):
                CliRunner().invoke(ledger, ['--verify'], standalone_mode=False, catch_exceptions=False)
        report = as_json('--verify', option)
        assert (report['asked'], report['asked_earlier'], report['sound']) == (asked, 3 - asked, 3)


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['--again'], 2, '--again is for --verify'),
    (['--verify', '--spool', '/nonexistent'], 1, 'there is no spool'),
])  # fmt: skip
def test_wrong_usage_is_refused(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    """Exit code 2 for options that exclude each other, 1 for a spool that does not exist."""
    monkeypatch.setattr(sys, 'argv', ['shadowhound-data', 'ledger', *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == code
    assert words in capsys.readouterr().err


def test_a_copied_spool_is_verified_like_the_original(home: Path) -> None:
    """The copy refers to the same store."""
    shutil.copytree(home / 'spool', home / 'rescued')
    assert as_json('--verify', '--spool', str(home / 'rescued'))['asked'] == 3
