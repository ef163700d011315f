"""A researcher requests kept data from a robot, and gets it: a spool, a directory store, and the command line between them.

A robot's responses to a request, and labels below a robot's prefix: they may contain anything.
"""

from __future__ import annotations

import json
import math
import random
import time
import unicodedata
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from lake import bad_parts
from lake.making import NOON_NS as LAKE_NOON_NS
from lake.making import add, fill, folder_store, merge
from spool.making import NOON_NS, FakeClock, assert_whole, make, receive

from shadowhound_data_logger.bags.kept import KeptCut
from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.cli.pull import _sentence
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import CatalogSettings, KeepSettings, SpoolSettings, StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.keys import UNSEEN
from shadowhound_data_logger.core.mailbox import KeptFilter, ObjectCount, PullRequest, encode_inbox
from shadowhound_data_logger.core.model import Outcome, State
from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.labels import LABELS
from shadowhound_data_logger.lake import labels, link
from shadowhound_data_logger.lake import pull as lake
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.dataset import MissionDataset
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.labels import Label
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.shipping.requests import RequestServer
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore

NOON = '2025-10-18T12:00:00Z'


class Field:
    """A robot in the field, and the store that it reaches."""

    def __init__(self, home: Path) -> None:
        self.clock = FakeClock()
        self.clock.now_ns = NOON_NS + 3600 * SECOND
        self.now_s = 0.0
        self.settings = StoreSettings(directory=home / 'store')
        self.store = DirectoryStore(self.settings.directory)
        self.source = Bucket(self.settings, 'sensor-data')
        self.spool = Spool(home / 'spool', SpoolSettings(min_free_bytes=0), self.clock, 'thor', KeepSettings(max_bytes=1 << 20))
        self.spool.open()
        self.catalogue = CatalogWriter(home / 'spool', CatalogSettings(), 'thor', self.clock, lambda: self.now_s, keeps=True)
        self.server = RequestServer(self.spool, self.store, KeepSettings(), 'thor', self.clock, put=self.commit,
                                    released=lambda _: None, cutter=partial(KeptCut, home),
                                    monotonic=lambda: self.now_s)  # fmt: skip

    def close(self) -> None:
        self.spool.close()

    def commit(self, *items: Any) -> None:
        self.spool.commit(items)

    def records(self, *numbers: int, size: int = 1000) -> None:
        items = [
            make(f'thor/camera/20251018/{number:06d}_front.jpg', bytes([number]) * size, t_start_ns=NOON_NS + number * SECOND,
                 t_end_ns=NOON_NS + number * SECOND,
                 metadata={meta.ROBOT: 'thor', meta.POSE: f'{number} 0 0 odom', meta.SHIP: meta.ON_REQUEST})
            for number in numbers
        ]  # fmt: skip
        receive(self.spool, len(items))
        self.spool.commit(items)
        self.passes()

    def passes(self) -> None:
        """Ten seconds: the robot polls its mailbox, reports its data, and delivers."""
        self.now_s += 10
        self.clock.now_ns += 10 * SECOND
        self.server.step()
        for _ in range(3):
            self.commit(*self.catalogue.due())
            while items := self.spool.pending(100):
                for item in items:
                    self.store.put(item)
                self.spool.commit(outcomes=[Outcome(item, State.DELIVERED) for item in items])
            self.now_s += 10
            self.server.step()

    def kept(self, **want: Any) -> list[int]:
        """The numbers of the objects that the robot keeps, according to the store."""
        found = lake.kept(self.source, 'thor', KeptFilter(**want), Findings())
        return sorted(int(key[-16:-10]) for key in found['key'].to_pylist())


@pytest.fixture
def field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Field]:
    made = Field(tmp_path)
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    yield made
    made.close()


def run(*arguments: str, code: int = 0) -> Any:
    """The JSON output of a command."""
    done = CliRunner().invoke(cli, [*arguments, '--json'], standalone_mode=False)
    assert done.exception is None, done.exception
    assert done.return_value == code, done.output
    return json.loads(done.stdout)


def test_a_pull_delivers_the_requested_objects(field: Field) -> None:
    """The rows arrive before the bytes; requested objects arrive verified, and are then no longer on the robot."""
    field.records(*range(6))
    assert field.kept() == [0, 1, 2, 3, 4, 5]
    assert run('query', '--sensor', 'camera') == []
    report = run('pull', '--sensor', 'camera', '--near', '3,0,1', '--user', 'ada')
    assert (report['robot'], report['objects'], report['bytes'], report['answer']) == ('thor', 3, 3000, None)
    assert [one['state'] for one in run('pull', '--list')] == ['asked']
    field.passes()
    assert [(one['state'], one['by']) for one in run('pull', '--list')] == [('done', 'ada')]
    assert run('pull', '--sensor', 'camera', '--near', '3,0,1', '--dry-run')['objects'] == 0
    assert field.kept() == [0, 1, 5]
    field.now_s += 60
    field.passes()
    assert [row['key'][-16:-10] for row in run('query', '--sensor', 'camera')] == ['000002', '000003', '000004']
    assert_whole(field.spool.root)


@pytest.mark.parametrize('seed', range(4))
def test_thinned_objects_have_their_current_size(tmp_path: Path, seed: int) -> None:
    """The robot reports it again, with fewer bytes, and that row counts in any order; for lost messages the row of the loss."""
    found = [('a', 'robot', 100), ('a', 'robot', 50), ('b', 'robot', 10), ('a', 'robot', 80), ('b', 'lost', 10)]
    random.Random(seed).shuffle(found)
    settings = folder_store(tmp_path)
    with closing(open_store(settings, UploadSettings())) as store:
        for number, (name, where, size) in enumerate(found):
            row = {**catalog.row_of(catalog.BUCKET, f'thor/{name}', size, '', {}), 'where': where}
            key = catalog.KEPT.part_key('thor', catalog.UNDATED, str(number))
            add(store, tmp_path / 'tmp', key, parts.encode([row], catalog.KEPT))
    rows = lake.known(Bucket(settings, catalog.BUCKET), 'thor', KeptFilter(), Findings()).to_pylist()
    assert [(row['key'], row['where'], row['bytes']) for row in rows] == [('thor/a', 'robot', 50), ('thor/b', 'lost', 10)]


def test_waiting_ends_with_the_last_answer(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also for a request of another client; a new one removes it."""
    field.records(1, 2)
    monkeypatch.setattr(lake.time, 'sleep', lambda _: field.passes())
    first = run('pull', '--sensor', 'camera', '--until', '2025-10-18T12:00:02Z', '--wait')
    assert first['answer']['outcomes'] == {'delivered': {'objects': 1, 'bytes': 1000}}
    second = run('pull', '--sensor', 'camera', '--where', 'x > 1.5', '--wait')
    assert second['answer']['want'] == {'sensor': 'camera', 'keys': ['thor/camera/20251018/000002_front.jpg']}
    assert [one['id'] for one in run('pull', '--list')] == [second['id']]


def test_objects_lost_on_the_robot_are_reported(field: Field) -> None:
    """The row of a loss supersedes that of the kept object, before and after a merge, and so does that of an arrival."""
    field.records(*range(8), size=200 << 10)
    assert field.kept() == [3, 4, 5, 6, 7]
    report = run('pull', '--sensor', 'camera', '--until', '2025-10-18T12:00:04Z')
    assert (report['objects'], report['lost']) == (1, {'no_room': 3})
    field.passes()
    answer = lake.newest_answer(field.source, 'thor', report['id'])
    assert answer
    assert (answer.gone['objects'], answer.gone['reasons']) == (3, {'evicted: no_room': 3})
    assert field.kept() == [4, 5, 6, 7]
    for _ in range(2):
        merge(field.settings)
        assert field.kept() == [4, 5, 6, 7]
    field.records(8, 9, size=200 << 10)
    assert field.kept() == [5, 6, 7, 8, 9]


def test_a_request_is_cancelled(field: Field) -> None:
    """The robot confirms it, and what it has not sent stays."""
    field.records(1)
    request = run('pull', '--sensor', 'camera')['id']
    done = CliRunner().invoke(cli, ['pull', '--cancel', request], standalone_mode=False)
    assert done.exception is None
    field.server._poll_at_s = 1e9  # the robot is offline during the request and its cancellation
    field.passes()
    field.server._poll_at_s = 0.0
    field.passes()
    assert field.kept() == [1]
    answer = lake.newest_answer(field.source, 'thor', request)
    assert answer
    assert (answer.state, answer.outcomes) == ('cancelled', {'unsent': ObjectCount(1, 1000)})


def test_times_labels_and_sql_select_the_request(field: Field, tmp_path: Path) -> None:
    """And nothing else: the robot gets a request for these names, and none if nothing is selected."""
    field.records(*range(8))
    ranges = tmp_path / 'ranges.json'
    spans = [{'robot': 'thor', 'since_ns': NOON_NS + at * SECOND, 'until_ns': NOON_NS + at * SECOND + 1} for at in (1, 5)]
    ranges.write_text(json.dumps(spans))
    seen = Label(robot='thor', label='door', since_ns=NOON_NS + 6 * SECOND, until_ns=NOON_NS + 7 * SECOND).checked()
    early = Label(robot='thor', label='early', since_ns=NOON_NS - 7 * SECOND, until_ns=NOON_NS - 6 * SECOND).checked()
    labels.write(field.store, 'thor', [seen, early], by='x')
    none = run('pull', '--sensor', 'camera', '--where', 'x > 100')
    assert (none['objects'], none['id']) == (0, None)
    assert run('pull', '--sensor', 'camera', '--label', 'early', '--dry-run')['objects'] == 0
    assert run('pull', '--sensor', 'camera', '--label', 'door', '--where', 'x < 7', '--dry-run')['objects'] == 1
    assert run('pull', '--sensor', 'camera', '--ranges', str(ranges))['objects'] == 2
    field.passes()
    field.passes()
    assert field.kept() == [0, 2, 3, 4, 6, 7]
    assert run('pull', '--sensor', 'camera', '--label', 'door')['objects'] == 2
    field.passes()
    field.passes()
    assert field.kept() == [0, 2, 3, 4]


@pytest.mark.parametrize('arguments', [
    (), ('--where', 'nonsense('), ('--bag', '../x'), ('--sensor', 'camera', '--expires', '100d'), ('--cancel', 'x'),
    ('--failed',), ('--policy', 'p'), ('--sensor', 'camera', '--user', '../x'),
])  # fmt: skip
def test_unavailable_data_is_reported(field: Field, arguments: tuple[str, ...]) -> None:
    """Before anything is written."""
    field.records(1)
    done = CliRunner().invoke(cli, ['pull', *arguments], standalone_mode=False)
    assert done.exception is not None
    assert run('pull', '--list') == []


@pytest.mark.parametrize(('arguments', 'what', 'remedy'), [
    (['--robot', 'thro', '--sensor', 'camera'], "no robot 'thro'", "is it 'thor'?"),
    (['--sensor', 'camra'], "no sensor 'camra'", "is it 'camera'?"),
    (['--sensor', 'camera', '--mission-type', 'patrl'], "no mission type 'patrl'", "is it 'patrol'?"),
    (['--bag', 'patrl_20251018'], "no bag 'patrl_20251018'", "is it 'patrol_20251018'?"),
    (['--sensor', 'thermal', '--until', '2025-10-18'], '', ''), (['--bag', 'patrl_*'], '', ''),
])  # fmt: skip
def test_a_name_that_nothing_has_is_wrong_usage(field: Field, arguments: list[str], what: str, remedy: str) -> None:
    """The nearest names are suggested; data that the robot keeps and the catalog does not list exists as well."""
    field.records(1)
    item = make('thor/thermal/20251018/000000_x.jpg', t_start_ns=NOON_NS, t_end_ns=NOON_NS, sensor='thermal', topic='/thermal',
                metadata={meta.ROBOT: 'thor', meta.SHIP: meta.ON_REQUEST, meta.MISSION_TYPE: 'patrol'})  # fmt: skip
    slice_ = make('thor/rosbags/patrol_20251018/0.mcap', t_start_ns=NOON_NS, t_end_ns=NOON_NS, sensor='bag', topic=None,
                  metadata={meta.ROBOT: 'thor', meta.SHIP: meta.ON_REQUEST})  # fmt: skip
    receive(field.spool, 2)
    field.spool.commit([item, slice_])
    field.passes()
    done = CliRunner().invoke(cli, ['pull', *arguments], standalone_mode=False)
    if not what:
        assert (done.exception, done.return_value) == (None, 0)
        return
    assert isinstance(done.exception, BadUsage), done.exception
    assert (what in done.exception.message, remedy) == (True, done.exception.remedy)
    assert run('pull', '--list') == []


@pytest.mark.long('a picture by matplotlib')
def test_throughput_predicts_the_duration_of_a_pull(field: Field, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The median of the robot's recent measurements; the same by position is an image."""
    field.records(1, 2)
    samples = [
        {'stamp_ns': NOON_NS, 'x': float(number), 'y': 0.0, 'mbps': mbps} for number, mbps in enumerate((0.0, 1.0, 2.0, 9.0))
    ]
    body = json.dumps({'samples': [*samples, {'mbps': 'fast'}, 7]}).encode()
    field.commit(make('thor/_wifi/20251018/120000_wifi.json', body, sensor='_wifi', topic=None, samples=0))
    field.passes()
    field.now_s += 60
    field.passes()
    monkeypatch.setattr(link.time, 'time_ns', lambda: NOON_NS + 3600 * SECOND)
    report = run('pull', '--sensor', 'camera', '--dry-run')
    assert (report['mbps'], report['seconds']) == (2.0, pytest.approx(0.008))
    target = tmp_path / 'wifi.png'
    text = run('lake', 'coverage', '--since', '2025-10-18', '--until', '2025-10-19', '--wifi', str(target))
    assert [one['mbps'] for one in text] == [0.0, 1.0, 2.0, 9.0]
    assert target.read_bytes().startswith(b'\x89PNG')


def test_a_dataset_pulls_kept_data(field: Field, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waits until the objects and their rows have arrived; others are kept. A folder has no robot to send requests to."""
    field.records(*range(6))
    monkeypatch.setattr(lake.time, 'sleep', lambda _: field.passes())
    assert len(MissionDataset(field.source, since=NOON)) == 0
    made = MissionDataset(field.source, since=NOON, near=(3.0, 0.0, 1.0), pull=True)
    assert made.stamps_ns.tolist() == [NOON_NS + number * SECOND for number in (2, 3, 4)]
    assert field.kept() == [0, 1, 5]
    assert lake.request_and_wait(field.source, {'since': NOON}) == 3
    assert field.kept() == []
    assert lake.request_and_wait(field.source, {'since': NOON}) == 0
    (tmp_path / 'folder' / 'thor' / '_catalog').mkdir(parents=True)
    with pytest.raises(SettingError, match='pull'):
        MissionDataset(tmp_path / 'folder', pull=True)


def test_an_unfinished_pull_is_reported(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its progress."""
    field.records(1)
    field.server._release = lambda _: False  # type: ignore[method-assign] # it has no link

    def sleep(_: float) -> None:
        field.passes()
        field.clock.now_ns += 8 * 24 * 3600 * SECOND

    monkeypatch.setattr(lake.time, 'sleep', sleep)
    monkeypatch.setattr(lake.time, 'time_ns', lambda: field.clock.now_ns)
    with pytest.raises(LakeError, match='expired, 0 of 1 objects'):
        lake.request_and_wait(field.source, {'since': NOON})


def test_a_hostile_mailbox_and_hostile_answers_are_read(field: Field) -> None:
    """On the client: foreign entries of the mailbox are skipped, and no number or text in a response crashes a command."""
    field.records(1, 2)
    prefix = '_requests/thor/inbox.json'
    lake.make(field.store, 'thor')
    found = field.store.changed('sensor-data', prefix, '', 1 << 20)
    assert found
    far = time.time_ns() + 300 * 24 * 3600 * SECOND
    ours = PullRequest(robot='thor', by='x', made_ns=far, expires_ns=far + SECOND, want=KeptFilter(sensor='camera')).to_json()
    junk = [7, None, {'id': ['x']}, {'id': {}, 'cancel': []}, {'cancel': 1e308}, ours]
    body = json.dumps({'format': 1, 'entries': junk}).encode()
    assert field.store.replace('sensor-data', prefix, body, found[1])
    assert [one['by'] for one in run('pull', '--list')] == ['x']
    report = run('pull', '--sensor', 'camera')
    assert [one['id'] for one in run('pull', '--list')] == [report['id']] == [ours['id']]
    for number, answer in enumerate((
        {'state': 'sending', 'objects': '\x1b[2J', 'outcomes': {'delivered': [1]}, 'number': {}},
        {'state': 'done\x07', 'objects': 10**30, 'outcomes': {'x': 1}, 'bags': {}, 'made_ns': 'x'},
        {'state': 'sending', 'outcomes': [], 'bags': [['x']], 'why': {'a': 1}, 'time': []},
        {'state': 'done\x07', 'objects': 10**30, 'outcomes': {'\x1b': {}}, 'bags': ['\x1b[2J'], 'why': '\x07', 'time': '\x1b'},
    ), 50):  # fmt: skip
        place = field.settings.directory / 'sensor-data' / 'thor' / '_answers' / report['id'] / f'{number}.json'
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(json.dumps({'id': report['id'], **answer}))
        done = CliRunner().invoke(cli, ['pull', '--list'], standalone_mode=False)
        assert done.exception is None
        assert '\x1b' not in done.output
        assert '\x07' not in done.output
    newest = lake.newest_answer(field.source, 'thor', report['id'])
    assert newest
    assert newest.state == 'done\x07'
    assert '\x1b' not in visible(_sentence(newest))


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(exclude_categories=['Cs']), max_size=8)
    | st.sampled_from(['done', 'sending', '\x1b[2J', '\x07', 10**400]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4) | st.just('objects'), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip
ANSWERS = st.fixed_dictionaries({}, optional=dict.fromkeys((
    'id', 'state', 'objects', 'bytes', 'outcomes', 'lost', 'bags', 'why', 'time', 'made_ns', 'number', 'mbps', '\x1b[31m',
), ANYTHING))  # fmt: skip
REQUEST = PullRequest(
    robot='thor', by='x', made_ns=LAKE_NOON_NS, expires_ns=LAKE_NOON_NS + SECOND, want=KeptFilter(sensor='camera')
)


@pytest.fixture(scope='module')
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a day of data, and a request in the mailbox of its robot."""
    root = tmp_path_factory.mktemp('hostile-answers')
    fill(folder_store(root), root, days=(0,))
    inbox = root / 'store/sensor-data/_requests/thor/inbox.json'
    inbox.parent.mkdir(parents=True)
    inbox.write_bytes(encode_inbox([REQUEST.to_json()]))
    return root


def is_harmless(text: str) -> bool:
    """No character controls a terminal, and none is unassigned in Unicode."""
    return all(unicodedata.category(each) not in UNSEEN or each == '\n' for each in text)


@settings(max_examples=40, deadline=None)
@given(answer=ANSWERS, is_addressed=st.booleans())
def test_any_answer_is_listed(home: Path, answer: dict[str, Any], is_addressed: bool) -> None:
    """As text and as JSON; the request is there in any case, and no control character reaches the terminal."""
    place = home / 'store/sensor-data/thor/_answers' / REQUEST.id / '1.json'
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps({**answer, 'id': REQUEST.id, 'state': str(answer.get('state'))} if is_addressed else answer))
    environ = {'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': None}
    done = CliRunner().invoke(cli, ['pull', '--list', '--robot', 'thor'], env=environ, standalone_mode=False)
    assert done.exception is None
    assert REQUEST.id in done.output
    assert is_harmless(done.output)
    done = CliRunner().invoke(cli, ['pull', '--list', '--robot', 'thor', '--json'], env=environ, standalone_mode=False)
    assert done.exception is None
    assert [one['id'] for one in json.loads(done.stdout)] == [REQUEST.id]


def row(**fields: Any) -> dict[str, Any]:
    """The row of a valid label."""
    one = labels.Label(robot='thor', label='stairs', since_ns=LAKE_NOON_NS, until_ns=LAKE_NOON_NS + SECOND).checked()
    return {**{name: getattr(one, name) for name in labels.FIELDS}, 'what': 'label', 'by': 'ann', 'made_ns': LAKE_NOON_NS,
            'made': LAKE_NOON_NS // 1000, 'format_version': 1, **fields}  # fmt: skip


HOSTILE: dict[str, dict[str, Any]] = {
    'a terminal escape': {'label': '\x1b[2J', 'note': '\x1b]0;x\x07', 'by': '\x9b31m'},
    'a formula': {'label': '=HYPERLINK("http://x")', 'note': '@SUM(1)'},
    'SQL': {'label': "x' OR '1'='1", 'id': "'; DROP TABLE objects; --"},
    'another robot': {'robot': 'tachi'},
    "another robot's object": {'bucket': 'sensor-data', 'key': 'tachi/camera/20261028/000000_x.jpg'},
    'a path': {'bucket': '..', 'key': '../../../etc/passwd'},
    'a box without end': {
        'bucket': 'sensor-data',
        'key': 'thor/x.jpg',
        'x': math.nan,
        'y': math.inf,
        'width': -1.0,
        'height': 0.0,
    },
    'a time that ends before it begins': {'since_ns': LAKE_NOON_NS, 'until_ns': 0},
    'the last time there is': {'since_ns': -(1 << 63), 'until_ns': (1 << 63) - 1},
    'a text without end': {'label': 'x' * 60_000, 'note': 'y' * 4000},
    'a future that replaces everything': {'what': 'removed', 'made_ns': (1 << 63) - 1, 'id': row()['id'], 'robot': 'tachi'},
}


def test_hostile_labels_affect_no_other_robot(tmp_path: Path) -> None:
    """The label next to it is shown, and every command that reads labels responds without a control character."""
    fill(folder_store(tmp_path), tmp_path, days=(0,), hours=(12,))
    source = Bucket(folder_store(tmp_path), 'sensor-data')
    bad_parts.put(folder_store(tmp_path), parts.encode([row()], LABELS), 'thor_good', of=LABELS)
    for number, fields in enumerate(HOSTILE.values()):
        bad = parts.encode([row(**{'id': f'{number:016x}', **fields})], LABELS)
        bad_parts.put(folder_store(tmp_path), bad, f'thor_bad{number}', of=LABELS)
    assert 'stairs' in {each.label for each in labels.read(source, 'thor', findings=Findings(lambda _: None))}
    environ = {'SHADOWHOUND_HOME': str(tmp_path), 'AWS_ENDPOINT_URL': None}
    for arguments in (
        ['label', 'list'], ['label', 'list', '--json'], ['query', '--label', 'stairs', '--format', 'csv'],
        ['pull', '--robot', 'thor', '--label', 'stairs'],
        *(['query', '--label', fields['label'], '--json'] for fields in HOSTILE.values() if 'label' in fields),
    ):  # fmt: skip
        done = CliRunner().invoke(cli, arguments, env=environ, standalone_mode=False)
        assert done.exception is None or hasattr(done.exception, 'remedy'), (arguments, done.exc_info)
        assert is_harmless(done.output), arguments
    assert {each.robot for each in labels.read(source, 'tachi', findings=Findings(lambda _: None))} <= set()
