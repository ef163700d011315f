"""A query returns exactly the matching rows, and reads only what can contain them."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from faults.front import Front
from lake.making import DAY_NS, FAILED, FINISHED, NOON_NS, Watched, add, add_part, fill, folder_store, keys, minutes, row, watched
from policies.models import Spark

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import CredentialsRejected, LakeError, SettingError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.tables import Tables
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from faults.upstream import Request
    from shadowhound_tower.embedded import Tower

DAY = {'since': '2026-10-28', 'until': '2026-10-29'}


@pytest.fixture(scope='module')
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[StoreSettings, list[catalog.Row]]:
    """Two days of a small robot in a folder."""
    root = tmp_path_factory.mktemp('lake')
    return folder_store(root), fill(folder_store(root), root / 'tmp')


def found(source: Any, **flags: Any) -> list[str]:
    return sorted(lake.objects(source, columns=['key'], **flags)['key'].to_pylist())


@pytest.mark.parametrize(
    ('flags', 'holds'),
    [
        ({}, lambda _: True),
        ({'sensor': 'camera'}, lambda row: row['sensor'] == 'camera'),
        ({'topic': '/odom', 'robot': 'thor'}, lambda row: row['topic'] == '/odom'),
        ({'robot': 'tachi'}, lambda _: False),
        (DAY, lambda row: NOON_NS - DAY_NS // 2 <= row['t_start_ns'] < NOON_NS + DAY_NS // 2),
        ({'since': '2026-10-29T11:30:15'}, lambda row: row['t_start_ns'] >= NOON_NS + DAY_NS - 1785 * 10**9),
        ({'until': '2026-10-28T11:30:15'}, lambda row: row['t_start_ns'] < NOON_NS - 1785 * 10**9),
        ({'near': (3.0, 1.5, 2.0)}, lambda row: (row['x'] - 3) ** 2 + (row['y'] - 1.5) ** 2 <= 4),
        ({'near': '-6,0,0.5', **DAY}, lambda row: (row['x'] + 6) ** 2 + row['y'] ** 2 <= 0.25
                                                  and row['t_start_ns'] < NOON_NS + DAY_NS // 2),
        ({'mission_type': 'patrol'}, lambda row: row['mission_type'] == 'patrol'),
        ({'mission': 'mfail'}, lambda row: row['mission_id'] == FAILED),
        ({'mission': 'run-mfinished'}, lambda row: row['mission_id'] == FINISHED),
        ({'success': False}, lambda row: row['mission_id'] == FAILED),
        ({'success': True, 'sensor': 'odom'}, lambda row: row['mission_id'] == FINISHED and row['sensor'] == 'odom'),
        ({'where': "battery_pct < 62 AND key LIKE '%.jpg'"}, lambda row: row['battery_pct'] < 62 and row['sensor'] == 'camera'),
    ],
    ids=lambda value: str(value)[:40] if isinstance(value, dict) else '',
)  # fmt: skip
def test_flags_select_rows(
    world: tuple[StoreSettings, list[catalog.Row]], flags: dict[str, Any], holds: Callable[[catalog.Row], bool]
) -> None:
    """The result equals that of a loop over all rows."""
    settings, rows = world
    expected = keys([row for row in rows if holds(row)])
    assert found(Bucket(settings, catalog.BUCKET), **flags) == expected
    assert bool(expected) != (flags == {'robot': 'tachi'}), 'a question that nothing answers proves nothing'


@pytest.mark.parametrize(
    ('near', 'numbers'),
    [
        ('48.1351,11.582,30', [0, 1]), ((48.1351, 11.582, 120.0), [0, 1, 2]), ((0.0, 180.0, 100.0), [3, 4]),
        ((0.0, -180.0, 100.0), [3, 4]), ((0.0, -179.9995, 60.0), [4]), ((90.0, 77.0, 100.0), [5, 6]),
        ((89.9995, 0.0, 120.0), [5, 6]),        ((-90.0, 0.0, 2.1e7), [0, 1, 2, 3, 4, 5, 6]),
    ],
)  # fmt: skip
def test_objects_near_a_place_on_earth_are_found(tmp_path: Path, near: Any, numbers: list[int]) -> None:
    """Around a town, across the antimeridian and around the pole; objects without a position are never found."""
    places = ['48.1351 11.582 500', '48.1352 11.582 500', '48.1361 11.582 500', '0 179.9995 0', '0 -179.9995 nan', '89.9995 0 0',
              '89.9995 180 0', None]  # fmt: skip
    settings = folder_store(tmp_path)
    rows = [row('camera', NOON_NS + number * SECOND, **({'gps': gps} if gps else {})) for number, gps in enumerate(places)]
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, rows, '20261028T120000_boot', tmp_path / 'tmp')
    assert found(Bucket(settings, catalog.BUCKET), near_gps=near) == keys([rows[number] for number in numbers])


@pytest.mark.parametrize('near', ['1,2', '91,0,5', '0,181,5', '0,0,0', '0,0,nan', 'a,b,c', (0.0, 0.0)])
def test_an_invalid_place_is_refused(world: tuple[StoreSettings, list[catalog.Row]], near: Any) -> None:
    """With a valid example."""
    with pytest.raises(SettingError, match='near_gps'):
        found(Bucket(world[0], catalog.BUCKET), near_gps=near)


def test_by_received_selects_by_arrival_time(tmp_path: Path) -> None:
    """A frame that arrived on the next day is of that day by arrival, and of the day of its stamp otherwise."""
    settings, late_ns = folder_store(tmp_path), 13 * 3600 * 10**9
    fields = {'received_start_ns': str(NOON_NS + late_ns), 'received_end_ns': str(NOON_NS + late_ns)}
    rows = [row('camera', NOON_NS, **fields), row('odom', NOON_NS)]
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, rows, '20261028T120000_boot', tmp_path / 'tmp')
    source, next_day = Bucket(settings, catalog.BUCKET), {'since': '2026-10-29', 'until': '2026-10-30'}
    (camera,), (odom,) = (keys([each]) for each in rows)
    assert (found(source, **DAY), found(source, **next_day)) == (sorted([camera, odom]), [])
    assert found(source, **DAY, by='received') == [odom], 'it has no time of arrival: its robot dated it by its own clock'
    assert found(source, **next_day, by='received') == [camera]
    (one,) = lake.objects(source, by='received', sensor='camera').to_pylist()
    assert (one['t_start_ns'], one['t_start'].day, one['clock_offset_ns']) == (NOON_NS + late_ns, 29, late_ns)
    (told_topic,) = lake.sql("SELECT first FROM topics WHERE topic = '/camera/compressed'", source, by='received').to_pylist()
    assert told_topic['first'].hour == 1
    with pytest.raises(SettingError, match='stamp or received'):
        found(source, by='arrival')


def test_every_column_round_trips(world: tuple[StoreSettings, list[catalog.Row]]) -> None:
    """Names, order and values; times in UTC."""
    settings, rows = world
    answer = lake.objects(Bucket(settings, catalog.BUCKET), sensor='camera', order='t_start_ns', limit=1).to_pylist()
    first = min((row for row in rows if row['sensor'] == 'camera'), key=lambda row: row['t_start_ns'])
    assert list(answer[0]) == list(catalog.COLUMNS)
    times = {'t_start', 't_end'}
    assert {name: value for name, value in answer[0].items() if name not in times} == {
        name: value for name, value in first.items() if name not in times
    }
    assert answer[0]['t_start'].timestamp() * 1e6 == first['t_start']


def test_only_requested_days_are_read(tmp_path: Path) -> None:
    """Not even the names of other days; what is in the tables is not read again."""
    fill(folder_store(tmp_path), tmp_path / 'tmp')
    source = watched(folder_store(tmp_path))
    assert len(lake.objects(source, robot='thor', **DAY)) == 192
    assert {key for verb, key in source.asked if verb == 'list'} == {'thor/_catalog/date=2026-10-28/'}
    read = [key for verb, key in source.asked if verb == 'get' and '/missions/' not in key]
    assert all(key.startswith('thor/_catalog/date=2026-10-28/') for key in read)
    assert len({*read}) == 24
    source.asked.clear()
    assert len(lake.objects(source, robot='thor', **DAY)) == 192
    assert 'get' not in {verb for verb, _ in source.asked}


def test_rows_of_a_store_that_was_replaced_are_forgotten(tmp_path: Path) -> None:
    """A folder, or the address of a server, with different contents now."""
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp', days=(0,))
    assert len(found(Bucket(settings, catalog.BUCKET))) == 192
    shutil.rmtree(settings.directory)
    rows = fill(settings, tmp_path / 'tmp', days=(1,), hours=(11,))
    assert found(Bucket(settings, catalog.BUCKET)) == keys(rows)


def test_sql_over_the_views_is_consistent(world: tuple[StoreSettings, list[catalog.Row]]) -> None:
    """``objects``, ``topics`` and ``missions`` agree with one another, with the same flags."""
    source = Bucket(world[0], catalog.BUCKET)
    day = [row for row in world[1] if catalog.date_of(row) == '2026-10-28']
    counted = lake.sql('SELECT sensor, count(*) AS n FROM objects GROUP BY sensor ORDER BY sensor', source, **DAY).to_pydict()
    assert counted == {'sensor': ['camera', 'odom'], 'n': [len(day) // 2, len(day) // 2]}
    topics = lake.sql('SELECT topic, objects, messages FROM topics ORDER BY topic', source, **DAY).to_pydict()
    assert topics == {'topic': ['/camera/compressed', '/odom'], 'objects': counted['n'], 'messages': counted['n']}
    failed = lake.sql(
        'SELECT m.result, count(*) AS n FROM objects o JOIN missions m ON o.mission_id = m.mission_id '
        'WHERE NOT m.success GROUP BY m.result', source, **DAY,
    ).to_pydict()  # fmt: skip
    assert failed == {'result': ['FAILED'], 'n': [sum(row['mission_id'] == FAILED for row in day)]}


@pytest.mark.parametrize(
    'told', ['{"distance_m": 1%s}' % (400 * '0'), '{"result": "\\ud800"}', 10_000 * '[', '{"mission_type": 5}'], ids=range(4)
)
def test_an_invalid_summary_affects_only_its_mission(tmp_path: Path, told: str) -> None:
    """A summary may be hostile: then the mission has no end, and the others are still listed."""
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp', days=(0,), hours=(12,))
    untyped = {**row('camera', NOON_NS + 10**9), 'mission_id': 'odd', 'run_id': 'run-odd', 'mission_type': None}
    with closing(open_store(settings, UploadSettings())) as store:
        add(store, tmp_path / 'tmp', 'thor/missions/run-odd/summary.json', told.encode())
        add_part(store, [untyped], 'odd', tmp_path / 'tmp')
    every = {one['mission_id']: one for one in lake.missions(Bucket(settings, catalog.BUCKET)).to_pylist()}
    assert (every[FAILED]['success'], every[FINISHED]['success']) == (False, True)
    assert (every['odd']['distance_m'], every['odd']['success'], every['odd']['mission_type']) == (None, None, None)


def test_a_file_deleted_during_a_listing_is_not_an_error(tmp_path: Path) -> None:
    """A compacted file replaces them."""
    settings = folder_store(tmp_path)
    rows = fill(settings, tmp_path / 'tmp', days=(0,), hours=(12,))
    gone = settings.directory / catalog.BUCKET / 'thor/_catalog/date=2026-10-28/gone.parquet'
    gone.symlink_to(tmp_path / 'nowhere')
    assert len(lake.objects(Bucket(settings, catalog.BUCKET))) == len(rows)


def test_a_mission_without_a_summary_has_no_end(tmp_path: Path) -> None:
    """It is still running, or its robot is unreachable: neither failed nor succeeded."""
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp', days=(0,), hours=(11,))
    source = Bucket(settings, catalog.BUCKET)
    source.delete(f'thor/missions/run-{FAILED}/summary.json')
    store = open_store(settings, UploadSettings())
    add(store, tmp_path / 'tmp', 'thor/missions/run-x/summary.json', b'{broken')
    report = lake.missions(source).sort_by('mission_id').to_pydict()
    assert report['mission_id'] == [FAILED, FINISHED]
    assert report['success'] == [None, True]
    assert report['duration_s'] == [None, 600.0]
    assert found(source, success=False) == []


def test_which_policy_was_active_and_what_it_was_trained_on(tmp_path: Path) -> None:
    """The mission names it, and the manifest with that hash names the dataset; one with another hash is ignored."""
    settings = folder_store(tmp_path)
    fill(settings, tmp_path / 'tmp', days=(0,), hours=(11,))
    packed, manifest = Spark(tmp_path / 'spark').packed(7)
    source = Bucket(settings, catalog.BUCKET)
    for mission, policy in ((FAILED, manifest.id), (FINISHED, f'{manifest.name}@7#{16 * "0"}')):
        key = f'thor/missions/run-{mission}/summary.json'
        fields = json.loads(source.get(key, 1 << 20)) | {'policy': policy}
        source.delete(key)
        with closing(open_store(settings, UploadSettings())) as store:
            add(store, tmp_path / 'tmp', key, json.dumps(fields).encode())
    shutil.copytree(packed, settings.directory / 'lerobot' / 'policies' / 'go2' / 'go2_patrol_v7')
    failed = lake.sql('SELECT policy, policy_dataset FROM missions WHERE NOT success', source).to_pylist()
    assert failed == [{'policy': manifest.id, 'policy_dataset': 64 * 'd'}]
    assert lake.missions(source, mission=FINISHED)['policy_dataset'].to_pylist() == [None]
    own, every = found(source, mission=FAILED), found(source, where='mission_id IS NOT NULL')
    for wanted, expected in (('go2_patrol', every), ('go2_patrol@7', every), (manifest.id, own), (manifest.id[:-3], own),
                             ('go2_patrol@', []), ('go2', []), ('go2_patrol@70', []), ('other', [])):  # fmt: skip
        assert found(source, policy=wanted) == expected, wanted
    assert found(source, policy='go2_patrol', success=False) == own
    others = 'go2_patrol@7#0000000000000000, none, go2_stairs@3#1111111111111111'
    fields = {'policy': 'go2_patrol@7#0000000000000000', 'policies': others}  # it changed during the mission
    with closing(open_store(settings, UploadSettings())) as store:
        add(store, tmp_path / 'tmp', 'thor/missions/run-both/summary.json', json.dumps(fields).encode())
        both = {**row('camera', NOON_NS + 10**9), 'mission_id': 'mlast', 'run_id': 'run-both'}
        add_part(store, [both], 'both', tmp_path / 'tmp')
    assert lake.missions(source).sort_by('mission_id').to_pydict()['policies'] == [None, None, others]
    assert found(source, policy='go2_stairs@3') == [both['key']]
    assert found(source, policy='none') == []
    with pytest.raises(LakeError, match='cannot be selected by policy'):
        lake.sql('SELECT * FROM gaps', source, policy='go2_patrol')


def test_objects_delivered_before_their_run_existed_belong_to_the_mission(tmp_path: Path) -> None:
    """The mission's outcome and its run are known from its other objects, which the query need not select."""
    settings = folder_store(tmp_path)
    rows = [each for _, few in minutes(days=(0,), hours=(11,)) for each in few]
    early = [{**each, 'run_id': None} if each['sensor'] == 'camera' else each for each in rows]
    fill(settings, tmp_path / 'tmp', days=(), hours=())
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, early, 'early', tmp_path / 'tmp')
    source = Bucket(settings, catalog.BUCKET)
    frames = sorted(each['key'] for each in rows if each['sensor'] == 'camera' and each['mission_id'] == FAILED)
    assert found(source, sensor='camera', success=False) == frames
    assert found(source, sensor='camera', mission='run-mfail', **DAY) == found(source, sensor='camera', mission=FAILED) == frames
    report = lake.missions(source, sensor='camera', **DAY).sort_by('mission_id').to_pydict()
    assert (report['run_id'], report['success']) == ([f'run-{FAILED}', f'run-{FINISHED}'], [False, True])


@pytest.mark.parametrize(
    'ask',
    [
        lambda source: lake.objects(source, where='no_such_column < 3'),
        lambda source: lake.objects(source, where='<<'),
        lambda source: lake.sql('SELEC 1', source),
        lambda source: lake.sql('SELECT key FROM nothing', source),
        lambda source: lake.sql('SELECT nope(key) FROM objects', source),
    ],
)
def test_every_invalid_query_is_the_same_kind_of_error(
    world: tuple[StoreSettings, list[catalog.Row]], ask: Callable[[Any], object]
) -> None:
    """A LakeError with the part that the engine rejected."""
    with pytest.raises(LakeError, match='cannot be answered'):
        ask(Bucket(world[0], catalog.BUCKET))


def test_a_missing_lake_is_empty(tmp_path: Path) -> None:
    """No store yet, no catalog yet: no rows, no error."""
    source = Bucket(folder_store(tmp_path), catalog.BUCKET)
    assert found(source) == []
    assert lake.missions(source).to_pydict()['mission_id'] == []
    assert lake.topics(source, **DAY).to_pydict()['topic'] == []


class Recorder(Front):
    """A proxy that records the target of each request."""

    targets: list[str]

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        self.targets.append(f'{request.method} {request.target}')
        return super().forward(request, slowly=slowly)


def through(front: Front, tower: Tower) -> StoreSettings:
    plain = tower.store_settings()
    return StoreSettings(endpoint_url=front.url, access_key_id=plain.access_key_id, secret_access_key=plain.secret_access_key)


@pytest.mark.seaweedfs
def test_only_that_day_is_read_from_a_real_server(seaweed: Tower, tmp_path: Path) -> None:
    """The requests name no other day; the result is the same as for the folder; no secret is shown."""
    fill(seaweed.store_settings(), tmp_path)
    rows = [row for _, each in minutes() for row in each]
    with Recorder(seaweed.endpoint_url) as front:
        front.targets = []
        settings = through(front, seaweed)
        source = Watched(Bucket(settings, catalog.BUCKET))
        answer = lake.objects(source, **DAY, robot='thor', near=(3.0, 1.5, 2.0), where='battery_pct < 62')['key'].to_pylist()
        dated = [target for target in front.targets if 'date' in target]
        assert len(dated) == 25
        assert all('date%3D2026-10-28' in target or 'date=2026-10-28' in target for target in dated)
    expected = [
        row for row in rows
        if catalog.date_of(row) == '2026-10-28' and row['battery_pct'] < 62 and (row['x'] - 3) ** 2 + (row['y'] - 1.5) ** 2 <= 4
    ]  # fmt: skip
    assert sorted(answer) == keys(expected)
    assert expected
    shown = f'{source.inner!r} {source.describe()} {Tables.shared(settings)!r}'
    assert settings.secret_access_key not in shown
    assert settings.access_key_id not in shown


@pytest.mark.seaweedfs
def test_wrong_credentials_are_reported_without_showing_them(seaweed: Tower) -> None:
    """It is a LakeError without key and secret."""
    plain = seaweed.store_settings()
    wrong = StoreSettings(endpoint_url=plain.endpoint_url, access_key_id=plain.access_key_id, secret_access_key='not the secret')
    with pytest.raises(CredentialsRejected) as caught:
        lake.objects(Bucket(wrong, catalog.BUCKET))
    assert plain.access_key_id not in str(caught.value)
    assert 'not the secret' not in str(caught.value)
    assert 'AWS_SECRET_ACCESS_KEY' in str(caught.value)


@pytest.mark.parametrize(
    ('keys', 'error', 'says'),
    [({}, CredentialsRejected, 'there are no credentials for the S3 server'),
     ({'access_key_id': 'k'}, SettingError, 'AWS_SECRET_ACCESS_KEY'),
     ({'secret_access_key': 's'}, SettingError, 'AWS_ACCESS_KEY_ID')],
)  # fmt: skip
def test_missing_credentials_are_reported(
    keys: dict[str, str], error: type[Exception], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """No model, or half a pair: the missing one is reported before any request."""
    for name in [name for name in os.environ if name.startswith('AWS_')]:
        monkeypatch.delenv(name)
    monkeypatch.setenv('HOME', str(tmp_path))
    with pytest.raises(error, match=says):
        Bucket(StoreSettings(endpoint_url='http://127.0.0.1:9', **keys), catalog.BUCKET).folders('')


def test_a_source_can_be_sent_to_another_process(world: tuple[StoreSettings, list[catalog.Row]]) -> None:
    """As with Ray."""
    source = pickle.loads(pickle.dumps(Bucket(world[0], catalog.BUCKET)))  # noqa: S301 - our own
    assert len(found(source, **DAY)) == len(world[1]) // 2
