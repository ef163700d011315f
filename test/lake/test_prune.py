"""Pruning deletes only what rules select, records each deletion, and may be killed at any step.

``lake prune`` with a real server: killed repeatedly, with concurrent readers, a compaction and another prune.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from e2e.processes import until
from faults.front import Front
from faults.kinds import Fault
from faults.upstream import Request
from lake.making import DAY_NS, MINUTE_NS, NOON_NS, add, add_part, content, folder_store, merge, row

from shadowhound_data_logger import lake
from shadowhound_data_logger.bags.manifest import EventOf, Manifest, RecordedTopic
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, LakeError, SettingError
from shadowhound_data_logger.core.mailbox import KeptFilter
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.formats.rows.gaps import complete
from shadowhound_data_logger.formats.rows.parts import encode
from shadowhound_data_logger.lake import gaps, labels, prune, pull, verify
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.prune import dates_of_deletion, forgotten
from shadowhound_data_logger.lake.reindex import reindex
from shadowhound_data_logger.shipping.audit import AuditProgress, audit
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower


NOW_NS = NOON_NS + 10 * DAY_NS
RULES = 'camera 5d, bags 5d, events forever'
AGES = range(10)
"""The past days that have rows."""


class Dead(Exception):
    """The process was killed here."""


class MortalStore:
    """A store whose process is killed at its nth operation."""

    def __init__(self, inner: Any, life: int) -> None:
        self._inner, self._life, self._lock = inner, life, threading.Lock()

    def _live(self) -> None:
        with self._lock:
            if self._life == 0:
                raise Dead
            self._life -= 1

    def put(self, item: Any) -> Any:
        self._live()
        return self._inner.put(item)

    def delete(self, bucket: str, key: str) -> None:
        self._live()
        self._inner.delete(bucket, key)


def _source(settings: StoreSettings) -> Bucket:
    return Bucket(settings, catalog.BUCKET)


def _fill(settings: StoreSettings, folder: Path) -> None:
    """Three objects of two sensors per day, with their content, at noon."""
    with closing(open_store(settings, UploadSettings())) as store:
        for age in AGES:
            rows = [row(sensor, NOW_NS - age * DAY_NS + second * SECOND) for second in range(3) for sensor in ('camera', 'odom')]
            for each in rows:
                add(store, folder, each['key'], content(each['sensor'], each['t_start_ns']))
            add_part(store, rows, f'day{age}', folder)


def _add_bag(settings: StoreSettings, folder: Path, name: str, begin_ns: int, *, is_event: bool = False,
             has_manifest: bool = True) -> list[str]:  # fmt: skip
    """A bag of two slices, a day apart."""
    event = EventOf('fall', 1.0, 1.0, 1.0, ()) if is_event else None
    manifest = Manifest(name, 'thor', None, 'complete', (), (RecordedTopic('/imu', 'sensor_msgs/msg/Imu', 7),), (), event)
    prefix = f'thor/rosbags/{name}/'
    bodies = {f'{prefix}{name}_0.mcap': (b'zero', begin_ns), f'{prefix}{name}_1.mcap': (b'one', begin_ns + DAY_NS)}
    if has_manifest:
        bodies[f'{prefix}manifest.json'] = manifest.to_json(), begin_ns
    with closing(open_store(settings, UploadSettings())) as store:
        for number, (key, (body, at_ns)) in enumerate(bodies.items()):
            fields = {'robot': 'thor', 'sensor': 'bag', 't_start_ns': str(at_ns), 't_end_ns': str(at_ns + SECOND)}
            add(store, folder, key, body, fields)
            add_part(store, [catalog.row_of(catalog.BUCKET, key, len(body), '', fields)], f'{name}{number}', folder)
    return sorted(bodies)


def _plan(settings: StoreSettings, rules: str = RULES, **how: Any) -> prune.PrunePlan:
    found = {'exported': {}, 'findings': Findings(), **how}
    return prune.plan(_source(settings), prune.keep_rules(rules, NOW_NS), **found)


def _run(settings: StoreSettings, rules: str = RULES, store: Any = None, **how: Any) -> prune.Pruned:
    made = _plan(settings, rules, **how)
    with closing(open_store(settings, UploadSettings())) as own:
        return prune.apply(_source(settings), store or own, made, now_ns=NOW_NS, findings=Findings())


def _stored(settings: StoreSettings, *sensors: str) -> list[str]:
    """The keys in the store, without the catalog."""
    found = [entry.key for entry in _source(settings).list('thor/') if catalog.is_row(catalog.BUCKET, entry.key)]
    return sorted(key for key in found if not sensors or key.split('/')[1] in sensors)


def _answer(settings: StoreSettings) -> list[str]:
    return sorted(lake.objects(_source(settings))['key'].to_pylist())


def _check(settings: StoreSettings) -> None:
    """The catalog lists exactly the store's objects, and every deleted object has a row with the time of its deletion."""
    source, left_out = _source(settings), Findings()
    assert _answer(settings) == _stored(settings)
    rows = verify.rows(source, left_out)
    with closing(open_store(settings, UploadSettings())) as store, AuditProgress(settings.directory / 'v', '') as progress:
        found = audit(rows.pages(), progress, store)
    assert (found.counts, len(left_out)) == ({}, 0)


@pytest.fixture(scope='module')
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('filled')
    _fill(folder_store(folder), folder / 'tmp')
    return folder


@pytest.fixture
def settings(filled: Path, tmp_path: Path) -> StoreSettings:
    shutil.copytree(filled / 'store', tmp_path / 'store')
    return folder_store(tmp_path)


def test_prune_deletes_exactly_what_a_rule_names(settings: StoreSettings) -> None:
    """By sensor and age. The catalog lists the rest, rows of deleted objects have the time, and a second run finds nothing."""
    before = _stored(settings)
    done = _run(settings)
    old = [key for key in before if '/camera/' in key and key.split('/')[2] < '20261102']
    assert len(old) == 12
    assert (done.objects, _stored(settings)) == (12, sorted({*before} - {*old}))
    _check(settings)
    rows = forgotten(_source(settings), None, Findings())
    assert sorted(rows['key'].to_pylist()) == old
    assert {*rows['rule'].to_pylist()} == {'camera 5d'}
    assert {*dates_of_deletion(rows).values()} == {f'{utc(NOW_NS):%Y-%m-%d}'}
    assert _run(settings) == prune.Pruned()
    asked = "SELECT count(*) AS n, sum(count) AS messages FROM forgotten WHERE sensor = 'camera'"
    assert lake.sql(asked, _source(settings)).to_pydict() == {'n': [12], 'messages': [12]}
    with closing(open_store(settings, UploadSettings())) as store:
        assert reindex(_source(settings), store, 'thor').gone == 0


def test_the_gap_journal_lists_deletions(settings: StoreSettings, tmp_path: Path) -> None:
    """For each hour one gap with its messages, which a later prune of more of that hour replaces."""
    began_ns = NOW_NS - 9 * DAY_NS
    with closing(open_store(settings, UploadSettings())) as store:
        report = complete('thor', 'j', 1, sink='objects', topic='/camera/compressed', session=1, from_ns=began_ns,
                        to_ns=NOW_NS, grade='exact', received=60, skipped=0)  # fmt: skip
        body = encode([report], gaps.GAPS)
        add(store, tmp_path / 'tmp', gaps.GAPS.part_key('thor', f'{utc(NOW_NS):%Y-%m-%d}', 'mark'), body, {'robot': 'thor'})
    first = row('camera', began_ns)
    _run(settings, exported={(first['bucket'], first['key']): 'a set'})
    known = gaps.known('thor', '/camera/compressed', began_ns, NOW_NS, source=_source(settings))
    assert [(gap.kind, gap.cause, gap.count) for gap in known.gaps] == [('forgotten', 'retention', 2)] + [
        ('forgotten', 'retention', 3)] * 3  # fmt: skip
    assert not known.between(began_ns + DAY_NS, began_ns + DAY_NS + 2 * SECOND).is_whole
    assert known.between(NOW_NS - DAY_NS, NOW_NS).is_whole
    _run(settings)
    known = gaps.known('thor', '/camera/compressed', began_ns, NOW_NS, source=_source(settings))
    assert [gap.count for gap in known.gaps] == [3] * 4


def test_referenced_objects_are_kept(settings: StoreSettings) -> None:
    """By a dataset, a label of a time or of an object, or an open request, each counted and named; force overrides."""
    source = _source(settings)
    exported, labeled, asked = (row('camera', NOW_NS - age * DAY_NS) for age in (9, 8, 7))
    at_ns = NOW_NS - 6 * DAY_NS
    with closing(open_store(settings, UploadSettings())) as store:
        of_object = labels.Label(robot='thor', label='door', since_ns=0, until_ns=0, bucket=catalog.BUCKET, key=labeled['key'])
        of_time = labels.Label(robot='thor', label='stairs', since_ns=at_ns - SECOND, until_ns=at_ns + SECOND)
        labels.write(store, 'thor', [of_object, of_time], by='me')
        request = pull.put_request(store, source, 'thor', KeptFilter(keys=frozenset({asked['key']})), by='me')
    how: dict[str, Any] = {'exported': {(exported['bucket'], exported['key']): 'patrols'}}
    made = _plan(settings, **how)
    camera = made.sensors['camera']
    assert (camera.objects, camera.going, dict(camera.protected)) == (30, 7, {'data set': 1, 'label': 3, 'request': 1})
    assert camera.referrers == {'data set patrols', 'label door', 'label stairs', f'request {request.id}'}
    assert _run(settings, **how).objects == 7
    left = _stored(settings, 'camera')
    assert {exported['key'], labeled['key'], asked['key']} <= {*left}
    assert len(left) == 23
    _check(settings)
    assert _run(settings, **how, is_forced=True).objects == 5
    assert len(_stored(settings, 'camera')) == 18
    _check(settings)


def test_a_label_that_cannot_be_read_stops_it(settings: StoreSettings, tmp_path: Path) -> None:
    """Otherwise labeled objects might be deleted."""
    with closing(open_store(settings, UploadSettings())) as store:
        add(store, tmp_path / 'tmp', 'thor/_labels/date=2026-11-01/thor_x.jsonl.zst', b'no parquet')
    with pytest.raises(LakeError, match='labels'):
        _plan(settings)


@pytest.mark.long('a second of CPU or more')
def test_a_bag_is_deleted_completely_or_not_at_all(settings: StoreSettings, tmp_path: Path) -> None:
    """When its last slice is old. An event's bag has a separate rule; without a manifest it is unknown which one applies."""
    tmp = tmp_path / 'tmp'
    old = _add_bag(settings, tmp, 'old', NOW_NS - 8 * DAY_NS)
    young = _add_bag(settings, tmp, 'young', NOW_NS - 5 * DAY_NS - MINUTE_NS)
    event = _add_bag(settings, tmp, 'event', NOW_NS - 8 * DAY_NS, is_event=True)
    torn = _add_bag(settings, tmp, 'torn', NOW_NS - 8 * DAY_NS, has_manifest=False)
    made = _plan(settings, 'bags 5d')
    bags = made.sensors['bags']
    assert (bags.going, dict(bags.protected), made.sensors['events'].objects) == (3, {'no manifest': 2}, 3)
    _run(settings, 'bags 5d', is_forced=True)
    assert _stored(settings, 'rosbags') == sorted([*young, *event, *torn])
    _check(settings)
    known = gaps.known('thor', '/imu', NOW_NS - 9 * DAY_NS, NOW_NS, sink='bags', source=_source(settings))
    assert [(gap.kind, gap.count) for gap in known.gaps] == [('forgotten', 7)]
    _run(settings, 'bags forever, events 5d')
    assert _stored(settings, 'rosbags') == sorted([*young, *torn])
    assert old
    _check(settings)


def _repeat(settings: StoreSettings, folder: Path, of: catalog.Row, at_ns: int) -> catalog.Row:
    again = {**row('camera', at_ns), 'key': of['key']}
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [again], f'again{at_ns}', folder)
    return again


def test_a_repeat_keeps_what_holds_its_content(settings: StoreSettings, tmp_path: Path) -> None:
    """An object referenced as content by a younger row counts as young as that row."""
    held = row('camera', NOW_NS - 9 * DAY_NS)
    _repeat(settings, tmp_path / 'tmp', held, NOW_NS - DAY_NS + 30 * SECOND)
    _run(settings)
    assert held['key'] in _stored(settings)
    assert len(_stored(settings, 'camera')) == 19
    assert len(forgotten(_source(settings), None, Findings())) == 11


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('later_s', [600, 2 * 86_400 + 600])
def test_a_label_of_a_repeat_protects_its_content(settings: StoreSettings, tmp_path: Path, later_s: int) -> None:
    """On the same day and on another one; without it content and repeat are deleted together, and the repeat's messages count."""
    held = row('camera', NOW_NS - 9 * DAY_NS)
    again = _repeat(settings, tmp_path / 'tmp', held, held['t_start_ns'] + later_s * SECOND)
    at_ns = again['t_start_ns']
    of_time = labels.Label(robot='thor', label='cat', since_ns=at_ns - SECOND, until_ns=at_ns + SECOND)
    with closing(open_store(settings, UploadSettings())) as store:
        labels.write(store, 'thor', [of_time], by='me')
        assert _run(settings).objects == 11
        assert held['key'] in _stored(settings)
        labels.write(store, 'thor', [of_time], by='me', is_removal=True)
    assert _run(settings).objects == 1
    assert len(_stored(settings, 'camera')) == 18
    _check(settings)
    assert sum(gaps.newest(_source(settings))['count'].to_pylist()) == 13


def test_a_robot_cannot_have_a_young_object_deleted(settings: StoreSettings, tmp_path: Path) -> None:
    """With a row with an older time, or a fake deletion: a robot may only write below its prefix."""
    young = row('camera', NOW_NS)
    old_ns = NOW_NS - 9 * DAY_NS
    forged = {**row('camera', old_ns + MINUTE_NS), 'key': young['key']}
    known = {name: young[name] for name in ('bucket', 'key', 'bytes', 't_start_ns')}
    fields = {**dict.fromkeys(catalog.FORGOTTEN.columns), **known, 'forgotten_ns': NOW_NS, 'format_version': 1}  # fmt: skip
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [forged], 'forged', tmp_path / 'tmp')
        body = encode([fields], catalog.FORGOTTEN)
        add(store, tmp_path / 'tmp', f'thor/_forgotten/date={utc(NOW_NS):%Y-%m-%d}/thor_x.jsonl.zst', body, {'robot': 'thor'})
    assert _run(settings).objects == 12
    assert young['key'] in _stored(settings)
    assert young['key'] in _answer(settings)


def test_by_size_the_oldest_days_go(settings: StoreSettings) -> None:
    """Only for rules with an age; an unreachable size is reported."""
    per_day = sum(len(content(sensor, NOW_NS)) for sensor in ('camera', 'odom')) * 3
    camera = len(content('camera', NOW_NS)) * 3
    total = per_day * len(AGES)
    made = _plan(settings, 'camera 30d, odom forever', max_bytes=total - 2 * camera + 1)
    assert (made.going, made.over_bytes) == (6, 0)
    made = _plan(settings, 'camera 30d, odom forever', max_bytes=0)
    assert (made.going, made.sensors['camera'].is_all, made.over_bytes) == (30, True, total - 10 * camera)
    _run(settings, 'camera 30d, odom forever', max_bytes=total - 2 * camera)
    assert len(_stored(settings, 'camera')) == 24
    assert len(_stored(settings, 'odom')) == 30
    _check(settings)


@pytest.mark.long('a death after each request')
def test_prune_may_be_killed_anywhere(tmp_path: Path) -> None:
    """After each step, every object in the catalog exists; the next run finishes it, once for each object."""
    for life in range(100):
        settings = folder_store(tmp_path / str(life))
        with closing(open_store(settings, UploadSettings())) as store:
            rows = [row('camera', NOW_NS - age * DAY_NS) for age in (9, 8, 1)]
            for each in rows:
                add(store, tmp_path / 'tmp', each['key'], content('camera', each['t_start_ns']))
                add_part(store, [each], f'{each["t_start_ns"]}', tmp_path / 'tmp')
            is_dead = False
            try:
                _run(settings, store=MortalStore(store, life))
            except Dead:
                is_dead = True
            names = _source(settings)
            gone = {*forgotten(names, None, Findings())['key'].to_pylist()}
            assert {each['key'] for each in rows} - gone <= {*_stored(settings)}
            _run(settings)
        assert _stored(settings) == [rows[2]['key']]
        assert len(forgotten(names, None, Findings())) == 2
        found = gaps.newest(names)
        assert sum(found['count'].to_pylist()) == 2
        if not is_dead:
            break
    else:
        pytest.fail('prune never finished')
    assert life > 6
    _check(settings)


@pytest.mark.long('a second of CPU or more')
def test_two_concurrent_prunes_delete_once(settings: StoreSettings) -> None:
    """Both find the same objects; each object has one row that counts, and its messages are counted once."""
    with closing(open_store(settings, UploadSettings())) as store:
        plans = [_plan(settings), _plan(settings, 'camera 7d')]
        failed: list[BaseException] = []

        def run(made: prune.PrunePlan) -> None:
            try:
                prune.apply(_source(settings), store, made, now_ns=NOW_NS, findings=Findings())
            except BaseException as error:  # noqa: BLE001 - reported by the test
                failed.append(error)

        threads = [threading.Thread(target=run, args=(made,)) for made in plans]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert failed == []
    _run(settings)
    assert len(_stored(settings, 'camera')) == 18
    assert len(forgotten(_source(settings), None, Findings())) == 12
    assert sum(gaps.newest(_source(settings))['count'].to_pylist()) == 12
    _check(settings)


@pytest.mark.long('a second of CPU or more')
def test_merging_parts_does_not_change_the_result(settings: StoreSettings) -> None:
    """Whether files of tables are merged before, between or after."""
    with closing(open_store(settings, UploadSettings())) as store:
        made = _plan(settings)
        merge(settings)
        prune.apply(_source(settings), store, made, now_ns=NOW_NS, findings=Findings())
        _check(settings)
        merge(settings)
    _check(settings)
    assert len(_answer(settings)) == 48


def test_missing_permission_names_the_required_user(settings: StoreSettings) -> None:
    """And with that permission the next run deletes what is recorded."""

    class Denying(MortalStore):
        def delete(self, bucket: str, key: str) -> None:
            raise AccessDenied('no', bucket=bucket)

    with (
        closing(open_store(settings, UploadSettings())) as store,
        pytest.raises(LakeError, match='do not permit pruning') as denied,
    ):
        _run(settings, store=Denying(store, 1000))
    assert 'prune' in denied.value.remedy
    assert _run(settings).resumed == 12
    _check(settings)


@pytest.mark.parametrize('text', ['', 'camera', 'camera 90', 'camera 90d lidar 14d', 'camera 1d, camera 2d', '_ledger 1d',
                                  'bag 1d, bags 2d', 'camera 2999-01-01', 'camera/ 1d', 'camera 90d,'])  # fmt: skip
def test_invalid_rules_are_rejected(text: str) -> None:
    """With the setting and what is allowed."""
    with pytest.raises(SettingError, match='--keep'):
        prune.keep_rules(text, NOW_NS)


def test_any_label_protects_what_it_reaches_into() -> None:
    """The same as checking each period."""
    rng = random.Random(7)
    for _ in range(300):
        spans = [(begin, begin + rng.randrange(30)) for begin in (rng.randrange(100) for _ in range(rng.randrange(8)))]
        shield = prune.Protection(labeled=[_span(*span) for span in spans])
        begin = rng.randrange(130)
        end = begin + rng.randrange(20)
        each = {**row('camera', begin), 't_end_ns': end}
        assert (shield.why(each) is not None) == any(since <= end and until >= begin for since, until in spans)


def _span(since_ns: int, until_ns: int) -> labels.Label:
    return labels.Label(robot='thor', label='x', since_ns=since_ns, until_ns=until_ns)


ROBOT = 'pruned'
KEPT_DAYS = 4
A_DAY = 60
"""Objects of a sensor."""
KILLS = 5
MAIN = (sys.executable, '-m', 'shadowhound_data_logger.cli.main')


class Counting(Front):
    """Passes on this many deletions and then stops responding."""

    def __init__(self, url: str) -> None:
        super().__init__(url, lambda: Fault.HUNG if self.deleted >= self.limit else Fault.NONE)
        self.limit, self.deleted = sys.maxsize, 0

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        self.deleted += request.method == 'DELETE'
        return super().forward(request, slowly=slowly)


def command(tower: Tower, *arguments: str, url: str = '') -> subprocess.Popen[str]:
    environ = {**os.environ, **tower.environment(), **({'AWS_ENDPOINT_URL': url} if url else {})}
    return subprocess.Popen([*MAIN, *arguments], env=environ, text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE)  # fmt: skip


def ended(processes: Sequence[subprocess.Popen[str]]) -> list[str]:
    """The output of each, after all have succeeded."""
    reports = [process.communicate(timeout=240) for process in processes]
    for process, (out, err) in zip(processes, reports, strict=True):
        assert process.returncode == 0, f'{process.args}: {out}{err}'
    return [out for out, _ in reports]


@pytest.mark.seaweedfs
@pytest.mark.slow
@pytest.mark.long('kills')
def test_prune_may_be_killed_next_to_readers_and_a_compaction(seaweed: Tower, tmp_path: Path) -> None:
    """In the end exactly what the rule selects is deleted, with one row each; concurrent readers can read the rest."""
    now_ns, chance = time.time_ns(), random.Random(7)
    ages = range(10)
    rows: dict[str, catalog.Row] = {}
    with closing(open_store(seaweed.store_settings(), UploadSettings())) as store:
        for age in ages:
            begin_ns = now_ns - age * DAY_NS - 6 * 3600 * SECOND
            of_day = [row(sensor, begin_ns + number * SECOND, ROBOT) for number in range(A_DAY) for sensor in ('camera', 'odom')]
            for each in of_day:
                add(store, tmp_path / 'bodies', each['key'], content(each['sensor'], each['t_start_ns']))
            add_part(store, of_day, f'day{age}', tmp_path / 'bodies')
            rows |= {each['key']: each for each in of_day}
    source = Bucket(seaweed.store_settings(), catalog.BUCKET)
    since_ns = now_ns - KEPT_DAYS * DAY_NS
    going = {key for key, each in rows.items() if each['sensor'] == 'camera' and each['t_start_ns'] < since_ns}
    assert len(going) == 6 * A_DAY

    def there() -> set[str]:
        return {info.key for info in source.list(f'{ROBOT}/') if info.key in rows}

    prune = ('lake', 'prune', '--keep', f'camera {KEPT_DAYS}d', '--yes', '--robot', ROBOT)
    with Counting(seaweed.endpoint_url) as front:
        for kill in range(KILLS):
            front.limit = front.deleted + 1 + chance.randrange(A_DAY)
            with command(seaweed, *prune, url=front.url) as process:
                until(lambda: front.deleted >= front.limit and front.is_quiet, f'the prune {kill} deletes')
                process.send_signal(signal.SIGKILL)
    assert 0 < len(rows) - len(there()) < len(going), 'it was killed in the middle of its work'
    reader = command(seaweed, 'fetch', '--robot', ROBOT, '--since', f'{KEPT_DAYS - 1}d', '--to', str(tmp_path / 'fetched'))
    ended([reader, command(seaweed, *prune), command(seaweed, *prune), command(seaweed, 'lake', 'ingest')])
    ended([command(seaweed, *prune)])
    assert rows.keys() - there() == going
    young = {key for key, each in rows.items() if each['t_start_ns'] >= now_ns - (KEPT_DAYS - 1) * DAY_NS}
    fetched = {str(path.relative_to(tmp_path / 'fetched')): path for path in (tmp_path / 'fetched').rglob('*_x.*')}
    assert fetched.keys() >= young
    for key in young:
        assert fetched[key].read_bytes() == content(rows[key]['sensor'], rows[key]['t_start_ns'])
    report = Counter(each['key'] for each in forgotten(source, ROBOT, Findings()).to_pylist())
    assert report == Counter(dict.fromkeys(going, 1))
    (asked,) = ended([command(seaweed, 'query', '--robot', ROBOT, '--since', '20d', '--json')])
    answer: list[dict[str, Any]] = json.loads(asked)
    assert {each['key'] for each in answer} == there()
