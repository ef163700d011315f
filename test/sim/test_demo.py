"""The demo: its audit of prepared spools, its output, its folder; and a short demo from end to end."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from urllib.request import ProxyHandler, build_opener

import pytest
from PIL import Image
from rich.console import Console
from shadowhound_sim import demo, demo_processes, demo_report
from shadowhound_sim.demo_audit import DemoAudit, audit
from shadowhound_sim.demo_run import Record, SpoolReading, StoreOutage
from shipping.fakes import until
from spool.making import FakeClock, make, new_spool, settle
from stores.memory import MemoryStore

from shadowhound_data_logger.core.config import CatalogSettings
from shadowhound_data_logger.core.model import DataObject, SpooledObject, State
from shadowhound_data_logger.formats.rows.catalog import row_of
from shadowhound_data_logger.formats.rows.parts import encode
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.spool.spool import Spool

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
CAMERA, IMU, RAW = '/camera/compressed', '/imu', '/camera/image_raw'
IMU_KEY = 'thor/imu/20251018/120000_imu.json'
READING = SpoolReading(30.0, 12_345, 412, 398, 14, 25_300_000, 'corridor', 'away')


class Scene:
    """A spool and a store after a run: two camera frames and a batch of three IMU samples."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.spool: Spool = new_spool(root)
        self.spool.open()
        self.store = MemoryStore()
        self.store.open()
        self.published = {CAMERA: 60, IMU: 3, RAW: 60}
        with self.spool.accounts.entry(CAMERA) as account:
            for number in range(11, 61):  # the first ten were published before the match
                account.receive('p', number)
            account.skipped += 48
        with self.spool.accounts.entry(IMU) as account:
            for number in (1, 2, 3):
                account.receive('q', number)
        self.items = self.spool.commit([
            an_object('thor/camera/20251018/120000_front.jpg', b'one', CAMERA),
            an_object('thor/camera/20251018/120001_front.jpg', b'two', CAMERA),
            an_object(IMU_KEY, json.dumps({'samples': [1, 2, 3]}).encode(), IMU, samples=3),
        ])  # fmt: skip

    def deliver(self, item: SpooledObject) -> None:
        self.store.put(item)
        settle(self.spool, item, State.DELIVERED)

    def catalog(self) -> None:
        for part in self.spool.commit(CatalogWriter(self.root, CatalogSettings(), 'thor', FakeClock()).parts()):
            self.deliver(part)

    def audit(self) -> DemoAudit:
        return audit(self.root, 'thor', self.published, self.store)


def an_object(key: str, body: bytes, topic: str, samples: int = 1) -> DataObject:
    metadata = {'sensor': key.split('/')[1], 'topic': topic}
    return make(key, body, topic=topic, samples=samples, sensor=metadata['sensor'], metadata=metadata)


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    """Nothing is delivered yet."""
    scene = Scene(tmp_path / 'spool')
    yield scene
    scene.spool.close()


@pytest.fixture
def good(scene: Scene) -> Scene:
    """Everything is delivered."""
    for item in scene.items:
        scene.deliver(item)
    scene.catalog()
    return scene


def test_an_audit_of_a_good_run_has_no_problems(good: Scene) -> None:
    """Objects and samples are counted, messages before the match separately; an unlogged topic is not a problem."""
    found = good.audit()
    assert found.problems == ()
    assert (found.read_back, found.samples, found.rows) == (4, 5, 3)
    assert found.messages[CAMERA].before_match == 10
    assert found.messages[IMU].before_match == 0
    assert found.messages[RAW].account is None
    assert (found.totals['camera'].objects, found.totals['camera'].delivered, found.totals['imu'].latest) == (2, 2, IMU_KEY)


def test_an_object_that_changed_is_found(good: Scene) -> None:
    """Content that differs from the spooled object is named by its key."""
    get = good.store.get
    good.store.get = lambda bucket, key: b'other' if 'front' in key else get(bucket, key)  # type: ignore[method-assign]
    assert [problem for problem in good.audit().problems if 'differs from the spooled object' in problem] == [
        'thor/camera/20251018/120000_front.jpg differs from the spooled object',
        'thor/camera/20251018/120001_front.jpg differs from the spooled object',
    ]


def test_a_missing_delivered_object_is_found(scene: Scene) -> None:
    """An object that the spool counts as delivered but the bucket lacks is named, and its samples are missing."""
    for item in scene.items[1:]:
        scene.deliver(item)
    settle(scene.spool, scene.items[0], State.DELIVERED)
    scene.catalog()
    assert scene.audit().problems == (
        'thor/camera/20251018/120000_front.jpg was delivered, but is not in the bucket',
        f'{CAMERA}: 2 messages are delivered, but 1 are in the bucket',
        'thor/camera/20251018/120000_front.jpg has a row in the catalog, but is not in the bucket',
    )


def test_an_object_without_a_row_is_found(good: Scene) -> None:
    """An object that the catalog lacks, or has twice, is named by its key."""
    late, twice = 'thor/imu/20251018/120009_imu.json', 'thor/camera/20251018/120000_front.jpg'
    good.deliver(good.spool.commit([an_object(late, b'{"samples": []}', IMU, samples=0)])[0])
    body = encode([row_of('sensor-data', twice, 3, 'image/jpeg', {'robot': 'thor'})])
    again = make('thor/_catalog/date=2025-10-18/again.jsonl.zst', body, sensor='_catalog', topic=None, samples=0)
    good.deliver(good.spool.commit([again])[0])
    assert good.audit().problems == (f'{twice} has 2 rows in the catalog', f'{late} has 0 rows in the catalog')


def test_a_message_after_the_last_received_one_is_found(good: Scene) -> None:
    """The ledger has no information about messages lost at the very end; the robot's own count does."""
    good.published[IMU] = 5
    assert good.audit().problems == (f'{IMU}: 2 of 5 messages are not in the ledger',)


def test_undelivered_objects_are_a_problem(scene: Scene) -> None:
    """Pending objects are counted, and so are missed messages."""
    with scene.spool.accounts.entry(IMU) as account:
        account.receive('q', 6)
        account.skipped += 1
    scene.spool.commit([an_object('thor/imu/20251018/120001_imu.json', b'{}', IMU, samples=0)])
    scene.published[IMU] = 6
    problems = scene.audit().problems
    assert f'{IMU}: 2 messages are missed' in problems
    assert '4 objects are pending' in problems


def printed(found: DemoAudit, record: Record) -> str:
    output = io.StringIO()
    demo_report.show_result(found, record, Console(file=output, width=80, highlight=False))
    return output.getvalue()


def test_the_result_fits_into_80_columns(good: Scene) -> None:
    """Topics and keys are not cut, and each part of the result is printed."""
    record = Record(good.published, (replace(READING, t=40.0, pending=0),), (25.0, 35.0))
    text = printed(good.audit(), record)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert '10 messages were published before the node found their publishers' in text
    assert f'{RAW} is not logged' in text
    assert 'The S3 server was down for 10 s' in text
    assert '4 objects with 5 messages read back from the S3 server: all as spooled' in text
    assert IMU_KEY in text


def test_the_result_names_the_problems(good: Scene) -> None:
    """With a problem the objects are not reported as spooled."""
    good.published[IMU] = 5
    text = printed(good.audit(), Record(good.published, (READING,), None))
    assert 'all as spooled' not in text
    assert f'{IMU}: 2 of 5 messages are not in the ledger' in text


def test_catching_up_is_measured_from_the_return() -> None:
    """The backlog counts as sent when a tenth of it remains; None if that never happened."""
    waiting = [(0.0, 2), (10.0, 0), (20.0, 50), (30.0, 80), (31.0, 60), (33.0, 8), (34.0, 0)]
    readings = tuple(replace(READING, t=t, pending=pending) for t, pending in waiting)
    assert Record({}, readings, (12.0, 30.0)).backlog == 80
    assert Record({}, readings, (12.0, 30.0)).caught_up_s == pytest.approx(3.0)
    assert Record({}, readings[:5], (12.0, 30.0)).caught_up_s is None


def test_progress_without_a_terminal_is_a_line_every_five_seconds() -> None:
    """Also when the Tower changes its state, and at the end."""
    output = io.StringIO()
    with demo_report.progress(Console(file=output, width=80), 20.0) as show:
        for tenth in range(123):
            show(replace(READING, t=tenth / 10, tower='up' if tenth < 72 else 'away'))
    lines = [line.split()[0] for line in output.getvalue().splitlines()]
    assert lines == ['time', '0', '5', '7', '10', '12']


class FakeTower:
    """Records its calls."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def stop_s3(self) -> None:
        self.calls.append('stop')

    def start_s3(self) -> None:
        self.calls.append('start')


def look_until(outage: StoreOutage, t: float, state: str, *, is_last: bool = False) -> None:
    """Poll until the outage's thread has reached the state; pytest's timeout is the deadline."""
    while outage.state != state:
        outage.poll(t, is_last=is_last)


@pytest.mark.timeout(60)
def test_the_s3_server_stops_once_and_restarts() -> None:
    """It stops at its time for its duration, and the span is recorded."""
    tower = FakeTower()
    with StoreOutage(tower, 25.0, 10.0) as outage:  # type: ignore[arg-type]
        outage.poll(24.9)
        assert outage.state == 'up'
        look_until(outage, 25.0, 'away')
        outage.poll(34.9)
        assert tower.calls == ['stop']
        look_until(outage, 35.5, 'back')
        outage.poll(60.0)
    assert tower.calls == ['stop', 'start']
    assert outage.span == (25.0, 35.5)


@pytest.mark.timeout(60)
def test_the_s3_server_restarts_before_the_end_of_any_demo() -> None:
    """When the robot has stopped, the outage ends, so that everything can be delivered."""
    tower = FakeTower()
    with StoreOutage(tower, 1.0, 1000.0) as outage:  # type: ignore[arg-type]
        look_until(outage, 2.0, 'away')
        look_until(outage, 3.0, 'back', is_last=True)
    assert tower.calls == ['stop', 'start']


def test_the_demo_does_not_reach_a_real_robot_or_tower(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Variables of the shell that name a Tower, a robot or peers are not passed to the node; the domain is another one."""
    foreign = {'AWS_ENDPOINT_URL': 'http://real', 'AWS_SESSION_TOKEN': 't', 'SHADOWHOUND_ROBOT': 'tachi', 'ROS_DOMAIN_ID': '7',
               'ROS_STATIC_PEERS': '10.0.0.1', 'MLFLOW_TRACKING_URI': 'http://real', 'SHADOWHOUND_HOME': '/real'}  # fmt: skip
    for name, value in foreign.items():
        monkeypatch.setenv(name, value)
    found = demo_processes.environment(tmp_path, {'AWS_ENDPOINT_URL': 'http://127.0.0.1:1'}, 42)
    assert not {'AWS_SESSION_TOKEN', 'ROS_STATIC_PEERS', 'MLFLOW_TRACKING_URI'} & found.keys()
    assert (found['AWS_ENDPOINT_URL'], found['ROS_DOMAIN_ID'], found['SHADOWHOUND_ROBOT']) == ('http://127.0.0.1:1', '42', 'thor')
    assert found['SHADOWHOUND_HOME'] == str(tmp_path)


def test_a_domain_that_is_in_use_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain is in use if its first port is bound on this machine."""
    taken = demo_processes.free_domain()
    monkeypatch.setattr('random.sample', lambda domains, _: [taken, *(domain for domain in domains if domain != taken)])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as user:
        user.bind(('', 7400 + 250 * taken + 10))
        assert demo_processes.free_domain() in set(demo_processes.DOMAINS) - {taken}


def test_a_folder_of_an_earlier_demo_is_replaced(tmp_path: Path) -> None:
    """Its content is deleted, the folder is kept."""
    folder = tmp_path / 'demo'
    with demo.fresh_folder(folder):
        (folder / 'home').mkdir()
        (folder / 'home' / 'old').touch()
        (folder / 'old.png').touch()
    with demo.fresh_folder(folder):
        assert [path.name for path in folder.iterdir()] == [demo.MARKER]


def test_a_foreign_folder_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2 and an error; nothing in it is changed."""
    (tmp_path / 'thesis.tex').touch()
    assert demo.main(['--folder', str(tmp_path)]) == 2
    assert 'was not created by a demo' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['thesis.tex']


def test_two_demos_do_not_share_a_folder(tmp_path: Path) -> None:
    """The second one fails without changing the first one's data."""
    with demo.fresh_folder(tmp_path / 'demo') as folder:
        (folder / 'data').touch()
        with pytest.raises(demo.FolderRefused, match='another demo is running'), demo.fresh_folder(folder):
            pass
        assert (folder / 'data').exists()


@pytest.mark.parametrize(
    'arguments', [['--duration', '1'], ['--outage', '-1'], ['--duration', '10', '--outage', '6'], ['--duration', 'nan']]
)
def test_times_that_make_no_sense_are_refused(arguments: list[str], tmp_path: Path) -> None:
    """Exit code 2, and no folder is created."""
    assert demo.main([*arguments, '--folder', str(tmp_path / 'demo')]) == 2
    assert not (tmp_path / 'demo').exists()


def test_errors_of_the_node_are_reported(good: Scene) -> None:
    """With their number and the first of them, verbatim."""
    record = Record(good.published, (READING,), None, ('[ERROR] [1.0] [sensor_logger]: intake failed', 'another'))
    text = printed(good.audit(), record)
    assert 'Errors that the node logged: 2' in text
    assert '[ERROR] [1.0] [sensor_logger]: intake failed' in text
    assert 'another' not in text


@pytest.mark.parametrize(
    'line',
    ['[ERROR] [1.1] [sensor_logger]: intake failed', '[FATAL] [1.1] [sensor_logger]: no', 'Traceback (most recent call last):'],
)
def test_a_node_that_logged_an_error_is_reported(tmp_path: Path, line: str) -> None:
    """Each error in its log counts; a line that only mentions one does not."""
    log = tmp_path / 'node.log'
    with demo_processes.Child('platform', [], os.environ, log) as child:
        until(lambda: not child.is_running)
        assert child.errors() == []
        log.write_text(f'[WARN] [1760788800.0] [sensor_logger]: an ERROR was avoided\n{line}\n', encoding='utf-8')
        assert child.errors() == [line]


def test_a_child_is_asked_to_stop_once(tmp_path: Path) -> None:
    """A second SIGINT would kill a Python that is exiting and has no handlers any more: the child would count as failed."""
    module = tmp_path / 'slow_to_end.py'
    module.write_text("""
import signal, threading
stop = threading.Event()
signal.signal(signal.SIGINT, lambda *_: stop.set())
class Ends:
    def __del__(self, sleep=__import__('time').sleep):
        print('ends', flush=True)
        sleep(0.3)
left = Ends()
print('here', flush=True)
stop.wait()
""")
    environ = {**os.environ, 'PYTHONPATH': str(tmp_path)}
    with demo_processes.Child('slow_to_end', [], environ, tmp_path / 'child.log') as child:
        until(lambda: 'here' in child.output)
        child.ask_to_stop()
        until(lambda: 'ends' in child.output)
        child.stop(20.0)
        child.check()


def get(address: str, path: str) -> bytes:
    """A response of the live page."""
    with build_opener(ProxyHandler({})).open(address + path, timeout=90) as answer:
        assert answer.status == 200
        return bytes(answer.read())


@pytest.mark.long('a whole demo')
@pytest.mark.ros
@pytest.mark.seaweedfs
def test_a_short_demo_succeeds(tmp_path: Path) -> None:
    """With a real Tower, the real node, a mission and the simulated robot: exit code 0, a ledger that balances, four images.

    The live page is served while the robot walks, and with --keep until Ctrl-C; Chromium takes a fifth image, of the page.
    """
    pytest.importorskip('rclpy')
    folder = tmp_path / 'demo'
    command = [sys.executable, '-m', 'shadowhound_sim.demo', '--keep']
    options = ['--duration', '6', '--outage', '2', '--folder', str(folder)]
    environ = os.environ | {'COLUMNS': '80', 'PYTHONUNBUFFERED': '1'}
    with (tmp_path / 'errors').open('w+') as errors, ExitStack() as stack:
        run = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=errors, text=True, env=environ)
        stack.callback(run.communicate)
        stack.callback(run.kill)
        assert run.stdout is not None
        output = ''

        def read_until(words: str) -> str:
            """The output up to the line with these words."""
            nonlocal output
            assert run.stdout is not None
            while words not in output and (line := run.stdout.readline()):
                output += line
            assert words in output, output + (tmp_path / 'errors').read_text()
            return output

        address = read_until('Watch it live').split()[-1]
        walking = folder / 'sim.out'
        until(walking.exists, 60.0)
        assert json.loads(get(address, 'api/session'))['robot'] == 'thor'
        assert '"published"' not in walking.read_text(), 'the robot walks no more'

        assert address in read_until('Ctrl-C stops it').split()[-20:]
        assert 'doctor' in json.loads(get(address, 'api/doctor'))  # takes seconds
        assert b'<html' in get(address, '')
        run.send_signal(signal.SIGINT)
        output += run.stdout.read()
        assert run.wait(200) == 0, output + (tmp_path / 'errors').read_text()
    assert 'The ledger balances' in output
    assert 'all as spooled' in output
    assert 'DOWN' in output
    assert 'The mission patrol_' in output
    assert (tmp_path / 'errors').read_text() == ''
    assert json.loads((folder / 'ledger.json').read_text())['balanced'] is True
    images = ['frames.png', 'patrol.png', 'delivery.png', 'mission.png']
    if CHROMIUM is not None and find_spec('playwright') is not None:
        images.append('live.jpg')
    for name in images:
        with Image.open(folder / name) as plot:
            assert min(plot.size) > 200
        assert str(folder / name) in output
