"""Full-text search: the index is built from the store alone, returns the best results first, and executes nothing in a query."""

from __future__ import annotations

import json
import sqlite3
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lake.making import NOON_NS, add, folder_store

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError, SettingError, UnknownName
from shadowhound_data_logger.lake import labels, search
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.select import wanted
from shadowhound_data_logger.stores import open_store

HOUR = 3600 * SECOND
MISSIONS = (
    ('patrol', 'open the door handle in the kitchen', True, [{'name': 'door_opened', 'force_n': 12.5, 'hand': 'left'}], []),
    ('patrol', 'the handle of the cellar, then the door', False, [], ['the gripper slipped off the Türgriff']),
    ('explore', 'go up the stairs', True, [{'name': 'stairs_seen', 'steps': 14}], []),
)


@pytest.fixture(scope='module')
def lake(tmp_path_factory: pytest.TempPathFactory) -> Bucket:
    root = tmp_path_factory.mktemp('search')
    settings = folder_store(root)
    with closing(open_store(settings, UploadSettings())) as store:
        for number, (kind, command, success, events, errors) in enumerate(MISSIONS):
            begin_ns = NOON_NS + number * HOUR
            fields = {'mission_id': f'm{number}', 'mission_type': kind, 'mission_command': command, 'success': success,
                    'start_ns': begin_ns, 'end_ns': begin_ns + 60 * SECOND, 'result': 'FINISHED' if success else 'FAILED',
                    'events': [{'time': '2026-10-28T12:00:05Z', **event} for event in events],
                    'errors': [{'error': text} for text in errors]}  # fmt: skip
            add(store, root, f'thor/missions/run{number}/summary.json', json.dumps(fields).encode())
        add(store, root, 'thor/missions/run3/camera/frame_000001.jpg', b'one that goes on')
        add(store, root, 'thor/missions/run4/summary.json', b'{"not": json')
        label = labels.Label(robot='thor', label='stairs', since_ns=NOON_NS + 2 * HOUR, until_ns=NOON_NS + 2 * HOUR + SECOND)
        labels.write(store, 'thor', [label], by='ann')
    return Bucket(settings, 'sensor-data')


@pytest.fixture(scope='module')
def index(lake: Bucket, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('index') / 'search.db'
    left_out = Findings(lambda _: None)
    found = search.update(path, lake, left_out)
    assert (found.missions, found.waiting, found.documents) == (3, 2, 7)
    assert [one.key for one in left_out] == ['thor/missions/run4/summary.json']
    return path


def missions(index: Path, text: str, **flags: object) -> list[str | None]:
    return [each['mission_id'] for each in search.search(index, text, wanted(0, **flags))]  # type: ignore[arg-type]


def test_words_phrases_and_prefixes_are_found(index: Path) -> None:
    """All words in any order, those of a phrase in order; letters in any form; the best first."""
    assert sorted(map(str, missions(index, 'door handle'))) == ['m0', 'm1']
    assert missions(index, '"door handle"') == ['m0']
    without = search.search(index, 'DOOR -kitchen', wanted(0), kind='mission')
    assert [each['mission_id'] for each in without] == ['m1']
    assert missions(index, 'turgriff') == ['m1']
    assert sorted(map(str, missions(index, 'stair*'))) == ['None', 'm2', 'm2']
    assert missions(index, 'kitchen OR cellar') in (['m0', 'm1'], ['m1', 'm0'])
    (event,) = search.search(index, 'left', wanted(0))
    assert (event['kind'], event['title'], event['since_ns']) == ('event', 'door_opened', NOON_NS + 5 * SECOND)
    assert missions(index, 'zebra') == []


def test_flags_restrict_the_search(index: Path) -> None:
    """Robot, time, mission, outcome, label and ranges."""
    assert missions(index, 'door handle', success=False) == ['m1']
    assert missions(index, 'door handle', until='2026-10-28T12:30') == ['m0']
    assert missions(index, 'door handle', mission='run1') == ['m1']
    for wrong, named in (({'robot': 'thro'}, 'thor'), ({'mission_type': 'patrl'}, 'patrol'), ({'mission': 'run9'}, 'run'),
                         ({'label': 'stair'}, 'stairs')):  # fmt: skip
        with pytest.raises(UnknownName, match=named):
            missions(index, 'door', **wrong)
    assert missions(index, 'up', label='stairs') == ['m2']
    assert missions(index, 'door', label='stairs') == []
    assert [each['labels'] for each in search.search(index, 'explore', wanted(0))] == [['stairs']]
    assert [each['labels'] for each in search.search(index, '"door handle" OR ann', wanted(0))] == [[], []]
    times = [
        {'since_ns': NOON_NS + HOUR, 'until_ns': NOON_NS + HOUR},
        *({'since_ns': at, 'until_ns': at} for at in range(0, 9999, 2)),
    ]
    assert missions(index, 'handle', ranges=times) == ['m1']
    assert missions(index, 'handle', ranges=[{**times[0], 'robot': 'tachi'}]) == []
    assert [each['title'] for each in search.search(index, 'stairs', wanted(0), kind='label')] == ['stairs']


def test_an_update_reads_what_is_new(lake: Bucket, index: Path, tmp_path: Path) -> None:
    """A second update adds nothing, and a rebuild gives the same result; the index records its last update."""
    before = search.updated(index)
    again = search.update(index, lake, Findings(lambda _: None))
    after = search.updated(index)
    assert before is not None
    assert after is not None
    assert before < after < (time.time_ns(), 3)
    assert after[1] == 2
    assert (again.missions, again.documents) == (0, 7)
    fresh = tmp_path / 'search.db'
    search.update(fresh, lake, Findings(lambda _: None))
    assert search.search(fresh, 'door', wanted(0)) == search.search(index, 'door', wanted(0))


def test_the_index_is_shared_through_the_store(lake: Bucket, index: Path) -> None:
    """It replaces the previous one."""
    with closing(open_store(lake.settings, UploadSettings())) as store:
        search.put(store, 'sensor-data', '_search/search.db', index)
        with closing(sqlite3.connect(index)) as db:
            db.execute('VACUUM')
        search.put(store, 'sensor-data', '_search/search.db', index)
    with search.downloaded(lake, '_search/search.db') as path:
        assert path.read_bytes() == index.read_bytes()
        assert missions(path, '"door handle"') == ['m0']


@given(st.text(max_size=40) | st.text('"*-()ORNEAD:^+ {}a\'', max_size=20))
def test_a_query_is_not_a_command(index: Path, text: str) -> None:
    """Any input is searched for, or refused with what is allowed: it is never a syntax error of SQLite."""
    with suppress(SettingError):
        search.search(index, text, wanted(0))


@pytest.mark.parametrize('text', ['', '   ', '"door', '-door', 'door OR', 'OR', '***', '\x00', ' '.join('x' * 40)])
def test_an_invalid_query_is_reported(index: Path, text: str) -> None:
    """With what is allowed."""
    with pytest.raises(SettingError, match='phrase'):
        search.search(index, text, wanted(0))


def test_a_file_that_is_not_an_index_is_refused(tmp_path: Path, lake: Bucket) -> None:
    """Neither a damaged file nor one with foreign tables or triggers is accepted."""
    path = tmp_path / 'search.db'
    with pytest.raises(LakeError, match='does not exist'):
        search.search(path, 'door', wanted(0))
    path.write_bytes(b'no database' * 99)
    with pytest.raises(LakeError, match='cannot be used'):
        search.search(path, 'door', wanted(0))
    path.unlink()
    search.update(path, lake, Findings(lambda _: None))
    with closing(sqlite3.connect(path)) as db:
        db.executescript("CREATE VIEW more AS SELECT load_extension('x');")
    with pytest.raises(LakeError, match='not a search index'):
        search.search(path, 'door', wanted(0))


COMMANDS = {
    'zh0': '去厨房看看门有没有关', 'zh1': '晚上巡逻时给Go2机器狗拍照',
    'ja0': 'キッチンのドアを確認して', 'ja1': '廊下を巡回して写真を撮る',
    'th0': 'ไปดูประตูห้องครัว', 'th1': 'ลาดตระเวนรอบห้องนั่งเล่น',
    'de0': 'Prüfe die Küchentür im Erdgeschoss', 'ko0': '부엌에서 문을 확인해',
}  # fmt: skip


@pytest.fixture(scope='module')
def commands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('commands') / 'search.db'
    with search._opened(path, is_new=True) as db, db:
        for name, command in COMMANDS.items():
            search.add(db, search.of_mission('thor', name, {'mission_command': command, 'mission_id': name}))
    return path


@pytest.mark.parametrize(
    ('query', 'expected'),
    [('厨房', 'zh0'), ('门', 'zh0'), ('看看', 'zh0'), ('厨房 门', 'zh0'), ('厨房*', 'zh0'), ('"去厨房看看"', 'zh0'),
     ('去厨房看看门有没有关', 'zh0'),
     ('巡逻', 'zh1'), ('机器狗', 'zh1'), ('go2', 'zh1'), ('Go2机器狗', 'zh1'), ('房厨', ''), ('厨房 -门', ''),
     ('ドア', 'ja0'), ('キッチン', 'ja0'), ('ｷｯﾁﾝ', 'ja0'), ('確認', 'ja0'), ('写真', 'ja1'), ('廊下', 'ja1'), ('ドン', ''),
     ('ประตู', 'th0'), ('ห้องครัว', 'th0'), ('ห้อง', 'th0 th1'), ('ลาดตระเวน', 'th1'),
     ('küche*', 'de0'), ('kuchentur', 'de0'), ('Küchentür', 'de0'), ('tür', ''), ('부엌*', 'ko0'), ('부엌', '')],
)  # fmt: skip
def test_words_of_scripts_without_spaces_are_found(commands: Path, query: str, expected: str) -> None:
    """Anywhere, even a single letter; for compounds with letters only at the start (decision 0023)."""
    assert sorted(map(str, missions(commands, query))) == expected.split()


def test_excerpts_are_verbatim(commands: Path) -> None:
    """They show nothing of the tokenization."""
    for query in ('厨房', 'ドア', 'ประตู', 'küche*'):
        (found,) = search.search(commands, query, wanted(0))
        assert found['title'] == COMMANDS[str(found['mission_id'])]
        assert '\x1f' not in json.dumps(found)


def test_labels_of_scripts_without_spaces_are_compared_whole(tmp_path: Path) -> None:
    """The flag compares complete names, and names are returned unchanged."""
    settings = folder_store(tmp_path)
    with closing(open_store(settings, UploadSettings())) as store:
        fields = {'mission_id': 'm', 'mission_command': '厨房', 'start_ns': NOON_NS, 'end_ns': NOON_NS + SECOND}
        add(store, tmp_path / 'x', 'thor/missions/run/summary.json', json.dumps(fields).encode())
        labels.write(store, 'thor', [labels.Label(robot='thor', label='楼梯', since_ns=NOON_NS, until_ns=NOON_NS + 1)], by='ann')
    path = tmp_path / 'search.db'
    search.update(path, Bucket(settings, 'sensor-data'))
    assert [each['labels'] for each in search.search(path, '厨房', wanted(0, label='楼梯'))] == [['楼梯']]
    with pytest.raises(UnknownName, match='楼梯'):
        missions(path, '厨房', label='楼')


def test_the_index_takes_little_more_than_the_words(tmp_path: Path) -> None:
    """Of Chinese less than three times the text, with the text itself in it."""
    path, text = tmp_path / 'search.db', 0
    with search._opened(path, is_new=True) as db, db:
        for number in range(3000):
            command = f'{COMMANDS["zh0"]} {COMMANDS["zh1"]} {number}' * 3
            text += len(command.encode())
            search.add(db, [search.Document(kind='mission', robot='thor', title=command, text='')])
    assert path.stat().st_size < 3 * text


def test_an_index_of_another_version_is_built_again(lake: Bucket, tmp_path: Path) -> None:
    """By the next update, from the store; until then a search ignores it, since its tokens differ."""
    path = tmp_path / 'search.db'
    search.update(path, lake)
    with closing(sqlite3.connect(path)) as db, db:
        db.execute('DELETE FROM words')
        db.execute('PRAGMA user_version = 1')
    with pytest.raises(LakeError, match='of this version') as raised:
        search.search(path, 'door', wanted(0))
    assert raised.value.remedy == search.REMEDY
    assert search.update(path, lake).missions == len(MISSIONS)
    assert 'm0' in missions(path, 'door')


def test_a_file_of_another_program_is_left_alone(lake: Bucket, tmp_path: Path) -> None:
    """It may be any database."""
    path = tmp_path / 'search.db'
    with closing(sqlite3.connect(path)) as db, db:
        db.execute('CREATE TABLE precious (x)')
    before = path.read_bytes()
    with pytest.raises(LakeError, match='not a search index') as raised:
        search.update(path, lake)
    assert 'remove it' in raised.value.remedy
    assert path.read_bytes() == before
