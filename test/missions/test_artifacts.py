"""Each artifact arrives in the run separately, whatever its name; one that the server refuses delays no other."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from missions.downloads import held
from missions.fakes import FakeSpooler, FakeTracking, journal, journalling
from missions.server import Server
from profiles import examples

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import TrackingError, TrackingRefused, TrackingUnavailable
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionFolder, Run, missions
from shadowhound_data_logger.missions.overview import report
from shadowhound_data_logger.missions.tracking import MlflowTracking
from shadowhound_data_logger.missions.values import MAX_NAME_BYTES, artifact_folder, artifact_name

KEPT = (
    'plain.txt', '.hidden', 'two..dots', 'trail.', 'trail ', '100%.txt', '%', 'x' * 236 + '.txt', 'é.txt', 'e\u0301.txt',
    '巡逻.txt', '\N{DOG FACE}.png', 'a*b', 'q"q', '<x>|y', "it's", 'Case', 'case', 'ext.', 'a;b', 'a&b=c', 'a+b', 'a b', '~home',
    '$x', '{a}', '[a]', 'a,b', '@x', '!x', '^x', '-', 'con', '12:30.png', 'a=b', '\u202ertl', '\u2028x',
)  # fmt: skip
CHANGED = {
    'map#1.png': 'map=231.png', 'map#2.png': 'map=232.png', 'what?.txt': 'what=3F.txt', 'a%41b.txt': 'a=2541b.txt',
    'a%2541b.txt': 'a=252541b.txt', 'a%%32.txt': 'a%=2532.txt', 'a%2Fb': 'a=252Fb', 'a%00b': 'a=2500b', 'a%2E%2E': 'a=252E=252E',
    'back\\slash': 'back=5Cslash', 'new\nline': 'new=0Aline', 'tab\t': 'tab=09', 'esc\x1b': 'esc=1B', '\x7f': '=7F',
    '\x85': '=C2=85', ' lead': '=20lead', 'C:': 'C=3A', 'file:x': 'file=3Ax', 'http:x': 'http=3Ax', 'A:b': 'A=3Ab',
    'map=231.png': 'map=3D231.png', 'a=3D': 'a=3D3D', '\udcff.txt': '=FF.txt',
}  # fmt: skip
FOLDERS = {"it's": 'it=27s', '..dots': '=2E.dots', '...': '=2E..', 'a/..b/c#': 'a/=2E.b/c=23', 'maps': 'maps'}
LONG = ('x' * 251 + '.txt', 'x' * 250 + 'y.txt', '巡' * 85, '探' * 85, '#' * 254 + 'a', '#' * 254 + 'b')
"""255 bytes, and more if unusual characters are replaced."""


def original(name: str) -> str:
    """The original of a changed name."""
    found = re.sub(rb'=([0-9A-F]{2})', lambda match: bytes.fromhex(match[1].decode()), name.encode())
    return found.decode('utf-8', 'surrogateescape')


def test_names_that_mlflow_allows_are_kept_and_others_changed() -> None:
    """As docs/missions.md documents."""
    assert [artifact_name(name) for name in KEPT] == list(KEPT)
    assert {name: artifact_name(name) for name in CHANGED} == CHANGED
    assert {name: artifact_folder(name) for name in FOLDERS} == FOLDERS
    assert [original(artifact_name(name)) for name in CHANGED] == list(CHANGED)


LETTERS = st.one_of(st.sampled_from("#%?=\\:' .23AaFf\n"), st.characters(exclude_characters='/\0', exclude_categories=['Cs']))
NAMES = st.text(LETTERS, min_size=1)


@settings(max_examples=examples(200))
@given(NAMES, NAMES)
def test_two_names_never_become_one(one: str, other: str) -> None:
    """Each can be read back, and MLflow's server, which decodes a path until it does not change, leaves it unchanged."""
    names = [artifact_name(name) for name in (one, other)]
    assert (names[0] == names[1]) is (one == other)
    for name, given_ in zip(names, (one, other), strict=True):
        assert len(name.encode()) <= MAX_NAME_BYTES
        assert unquote(name) == name
        if len(given_) < 60:
            assert original(name) == given_


def test_long_names_stay_apart() -> None:
    """A name that becomes too long for a file when it is changed gets a hash, and keeps its extension."""
    names = [f'{"#" * length}{end}.png' for length in (84, 85, 200, 250) for end in ('a', 'b')]
    found = [artifact_name(name) for name in names]
    assert len(set(found)) == len(names)
    assert all(name.endswith('.png') and len(name.encode()) <= MAX_NAME_BYTES for name in found)
    assert not any(re.search(r'=([0-9A-F]?~|[^0-9A-F])', name) for name in found)


def files(folder: Path, names: list[str]) -> Iterator[Path]:
    for number, name in enumerate(names):
        place = folder / str(number)
        place.mkdir()
        path = place / name
        path.write_bytes(os.fsencode(name))
        yield path


def log_all(logger: MissionDataLogger, folder: Path) -> dict[str, bytes]:
    """All names, at the root and in a folder with an unusual name, and all folders; returns what the run must have."""
    names, expected = [*KEPT, *CHANGED, *LONG], {}
    for path in files(folder, names):
        for where in (None, 'odd #1'):
            logger.log_artifact(path, where)
            key = artifact_name(path.name)
            expected[f'odd =231/{key}' if where else key] = os.fsencode(path.name)
    for where, key in FOLDERS.items():
        logger.log_artifact(folder / '0' / names[0], where)
        expected[f'{key}/{names[0]}'] = os.fsencode(names[0])
    return expected


SINGLY = ('map=231.png', 'a=2541b.txt', 'odd =231/back=5Cslash', '巡逻.txt', 'it=27s/plain.txt')


def without_ours(found: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in found.items() if name not in {'summary.json', 'events.jsonl'}}


@pytest.mark.seaweedfs
@pytest.mark.long('two hundred uploads')
def test_every_name_reaches_the_run_through_the_server(server: Server, warm_home: Path, tmp_path: Path) -> None:
    """Listed and downloaded by MLflow's client and by the requests of its page; the summary has the names that were changed."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=60.0)
    run_id = logger.start_mission('patrol', 'odd names')
    expected = log_all(logger, tmp_path)
    logger.end_mission(True, 1.0, 1.0)
    done = logger.close(200.0)
    assert (done.complete, done.unattached, done.last_error) == (True, 0, '')
    found = held(server.tower.tracking_uri, run_id, SINGLY)
    assert without_ours(found) == expected
    renamed = json.loads(found['summary.json'])['renamed_artifacts']
    assert renamed['map=231.png'] == 'map#1.png'
    assert renamed['it=27s/plain.txt'] == "it's/plain.txt"
    assert 'plain.txt' not in renamed
    spark = server.tower.tracking('spark')
    login = spark['MLFLOW_TRACKING_USERNAME'], spark['MLFLOW_TRACKING_PASSWORD']
    for name in ('map=231.png', 'a=2541b.txt', '巡逻.txt', 'odd =231/back=5Cslash', 'a&b=c', 'a+b'):
        import requests  # of MLflow

        where = f'{server.tower.tracking_uri}/get-artifact'
        page = requests.get(where, {'run_uuid': run_id, 'path': name}, auth=login, timeout=30)
        assert page.content == expected[name], name


@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize('store', ['folder', pytest.param('s3', marks=pytest.mark.seaweedfs)])
@pytest.mark.long('two hundred uploads')
def test_every_name_reaches_a_store_without_a_server(
    store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Artifacts in a folder, or directly in S3."""
    monkeypatch.setenv('MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR', 'false')
    uri = f'sqlite:///{tmp_path}/mlflow.db'
    tracking = MlflowTracking(uri, 'names', None if store == 's3' else tmp_path / 'artifacts')
    tracking.open()
    if store == 's3':
        server: Server = request.getfixturevalue('server')
        monkeypatch.setenv('MLFLOW_S3_ENDPOINT_URL', server.tower.endpoint_url)
        tracking._client.create_experiment('names', artifact_location=f's3://sensor-data/names-{tmp_path.name}')
    with journalling(tmp_path / 'home') as logger:
        logger.start_mission('patrol', '')
        expected = log_all(logger, tmp_path)
    (folder,) = missions(tmp_path / 'home')
    delivery = deliver(folder, tracking)
    assert delivery.sent.complete
    assert delivery.run is not None
    assert without_ours(held(uri, delivery.run.run_id, SINGLY)) == expected


# -- what the server does not take ---------------------------------------------------------------------------------


def deliver(folder: MissionFolder, tracking: Any, rounds: int = 1000) -> Delivery:
    delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
    for _ in range(rounds):
        for work in (delivery.track, delivery.attach, delivery.spool):
            try:
                work()
            except TrackingError:
                continue
        if delivery.complete():
            break
    return delivery


class Picky(FakeTracking):
    """A server that refuses some artifacts."""

    def __init__(self, takes: Callable[[str], bool], error: Callable[[], Exception]) -> None:
        super().__init__()
        self.takes, self.error, self.asked = takes, error, 0

    def artifact(self, run: Run, path: Path, folder: str) -> None:
        if not self.takes(path.name):
            self.asked += 1
            raise self.error()
        super().artifact(run, path, folder)


@pytest.fixture
def folder(tmp_path: Path) -> MissionFolder:
    """A mission with five artifacts."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        for path in files(tmp_path, ['bad', 'b', 'c', 'd', 'e']):
            logger.log_artifact(path)
            logger.log_event('seen', name=path.name)
    return next(missions(tmp_path))


OTHERS = {'b', 'c', 'd', 'e', 'events.jsonl', 'summary.json'}


def test_refused_artifacts_are_counted_with_their_reason(folder: MissionFolder) -> None:
    """It is skipped once the server accepts others; the mission is complete, and its report contains what is missing and why."""
    tracking = Picky(lambda name: name != 'bad', lambda: TrackingUnavailable('404 for bad', remedy='', of_object=True))
    assert deliver(folder, tracking).sent.complete
    assert set(tracking.artifacts) == OTHERS
    found = report(folder)
    assert (found.complete, found.unattached, found.last_error) == (True, 1, '404 for bad')


@pytest.mark.parametrize('error', [TrackingUnavailable('500 for bad', remedy=''), OSError(5, 'Input/output error')])
def test_an_artifact_that_fails_delays_no_other(folder: MissionFolder, error: Exception) -> None:
    """A server's error, a broken connection or disk: all others arrive, and it is retried until it does too."""
    broken = True
    tracking = Picky(lambda name: name != 'bad' or not broken, lambda: error)
    delivery = Delivery(folder, tracking, FakeSpooler())  # type: ignore[arg-type]
    for _ in range(50):
        for work in (delivery.track, delivery.attach, delivery.spool):
            try:
                work()
            except (TrackingError, OSError):
                continue
        assert not delivery.complete()
    assert set(tracking.artifacts) == OTHERS
    assert tracking.asked > 10
    assert report(folder).unattached == 0
    broken = False
    assert deliver(folder, tracking).sent.complete
    assert set(tracking.artifacts) == OTHERS | {'bad'}


def test_a_server_that_refuses_everything_is_not_believed(folder: MissionFolder) -> None:
    """A proxy that answers 404 to everything does not refuse an artifact: all of them wait for the server."""
    away = True
    tracking = Picky(lambda _: not away, lambda: TrackingUnavailable('404', remedy='', of_object=True))
    assert not deliver(folder, tracking, 50).sent.complete
    assert report(folder).unattached == 0
    away = False
    assert deliver(folder, tracking).sent.complete
    assert set(tracking.artifacts) == OTHERS | {'bad'}


def test_a_restart_in_between_loses_nothing(folder: MissionFolder) -> None:
    """Artifacts that wait behind others do not count as sent."""
    tracking = Picky(lambda name: name != 'bad', lambda: TrackingUnavailable('500', remedy=''))
    deliver(folder, tracking, 20)
    assert folder.sent().artifacts < folder.sent().metrics
    again = FakeTracking(runs=tracking.runs)
    assert deliver(folder, again).sent.complete
    assert set(again.artifacts) == OTHERS | {'bad'}


@pytest.mark.seaweedfs
@pytest.mark.long('waits for what does not come')
def test_an_artifact_with_the_name_of_a_folder_is_renamed(server: Server, warm_home: Path, tmp_path: Path) -> None:
    """If the server cannot hold both, the rest of the mission is there, and the report names the missing one."""
    logger = MissionDataLogger(home=warm_home, start_timeout_s=60.0)
    run_id = logger.start_mission('patrol', 'a clash')
    for name, where in (('clash', None), ('in.txt', 'clash'), ('plain.txt', None)):
        (tmp_path / name).write_text(name)
        logger.log_artifact(tmp_path / name, where)
    logger.end_mission(True, 1.0, 1.0)
    done = logger.close(20.0)
    assert server.artifacts(run_id) >= {'plain.txt', 'summary.json'}
    if not {'clash', 'clash/in.txt'} <= server.artifacts(run_id):
        assert 'clash' in done.last_error + done.waiting_for
        assert done.unattached or not done.complete


def test_an_s3_server_s_answer_is_recognized(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """boto3 hides it in the cause of its error."""
    from boto3.exceptions import S3UploadFailedError
    from botocore.exceptions import ClientError

    def answer(code: str, status: int) -> Callable[..., None]:
        def put() -> None:
            raise ClientError({'Error': {'Code': code}, 'ResponseMetadata': {'HTTPStatusCode': status}}, 'PutObject')

        def fail(*_: object) -> None:
            try:
                put()
            except ClientError as error:
                raise S3UploadFailedError(f'Failed: {error}')  # noqa: B904 - as boto3 does

        return fail

    tracking = MlflowTracking(f'file://{tmp_path}/mlruns', 'x')
    tracking._client = type('Client', (), {})()
    run = Run('r', '1', 's3://bucket/x')
    monkeypatch.setenv('MLFLOW_S3_ENDPOINT_URL', 'http://127.0.0.1:9')
    for code, status, of_object in (('KeyTooLongError', 400, True), ('SlowDown', 503, False), ('AccessDenied', 403, False)):
        tracking._client.log_artifact = answer(code, status)
        with pytest.raises(TrackingUnavailable) as caught:
            tracking.artifact(run, tmp_path / 'map.png', 'maps')
        assert caught.value.data['of_object'] is of_object
        assert 'maps/map.png' in str(caught.value)
    tracking._client.log_artifact = answer('EntityTooLarge', 413)
    with pytest.raises(TrackingRefused):
        tracking.artifact(run, tmp_path / 'map.png', 'maps')


@pytest.mark.parametrize('where', ['..', '../x', '/x', '.', 'a//b', 'a/', './a', 'a/../b', 'x' * 251, 'a\0b', 3])
def test_a_folder_that_leads_elsewhere_is_refused_at_the_call(tmp_path: Path, where: Any) -> None:
    """It is refused and counted, because MLflow would refuse it."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_artifact(__file__, where)
    assert [record.get('reason') for record in journal(tmp_path)] == [None, 'bad_name', None]
