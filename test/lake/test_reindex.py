"""A lost catalog is rebuilt from the objects, and missing rows are added, each row once."""

from __future__ import annotations

from contextlib import closing
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from lake.making import DAY_NS, NOON_NS, SENSORS, Watched, add, add_part, content, folder_store, keys, merge, row

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import StoreUnavailable
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import reindex as library
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.stores import open_store

TIMES = [NOON_NS + second * SECOND for second in range(0, 60, 20)] + [NOON_NS + DAY_NS]
LATER = datetime.now(timezone.utc) + timedelta(hours=2)


@pytest.fixture
def settings(tmp_path: Path) -> StoreSettings:
    """Objects with metadata, without a catalog."""
    settings = folder_store(tmp_path)
    with closing(open_store(settings, UploadSettings())) as store:
        for sensor in SENSORS:
            for stamp_ns in TIMES:
                made = row(sensor, stamp_ns)
                names = ('robot', 'sensor', 'topic', 'type', 'count', 't_start_ns', 't_end_ns')
                metadata = {name: str(made[name]) for name in names}
                metadata |= {'pose': f'{made["x"]} {made["y"]} {made["yaw"]} odom', 'battery_pct': str(made['battery_pct'])}
                add(store, tmp_path / 'tmp', made['key'], content(sensor, stamp_ns), metadata, content_type=made['content_type'])
        add(store, tmp_path / 'tmp', 'thor/patrol_20261028_120000.csv', b'x,y', bucket='trajectories')
    return settings


ROWS = [row(sensor, stamp_ns) for sensor in SENSORS for stamp_ns in TIMES]
ALL = sorted([*keys(ROWS), 'thor/patrol_20261028_120000.csv'])


def run(settings: StoreSettings, robot: str = 'thor') -> library.Reindexed:
    with closing(open_store(settings, UploadSettings())) as store:
        return library.reindex(Bucket(settings, catalog.BUCKET), store, robot)


def answer(settings: StoreSettings, **flags: Any) -> list[str]:
    return sorted(lake.objects(Bucket(settings, catalog.BUCKET), **flags)['key'].to_pylist())


def test_a_lost_catalog_is_rebuilt(settings: StoreSettings) -> None:
    """All rows, as the robot would have written them; a second run adds nothing."""
    found = run(settings)
    assert (found.listed, found.added, found.gone) == (9, 9, 0)
    assert answer(settings) == ALL
    made = {one['key']: one for one in lake.objects(Bucket(settings, catalog.BUCKET), robot='thor').to_pylist()}
    for expected in ROWS:
        kept = {name for name in catalog.COLUMNS if name not in {'t_start', 't_end', 'mission_id', 'run_id', 'mission_type'}}
        assert {name: made[expected['key']][name] for name in kept} == {name: expected[name] for name in kept}
    assert run(settings).added == 0
    assert answer(settings) == ALL


def test_only_missing_rows_are_requested(settings: StoreSettings, tmp_path: Path) -> None:
    """Objects in the robot's parts are only listed; missing objects named there are counted, and their rows stay."""
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [row('odom', stamp_ns) for stamp_ns in (*TIMES[:3], NOON_NS + 5 * SECOND)], 'part', tmp_path / 'tmp')
    found = run(settings)
    assert (found.listed, found.added, found.gone) == (9, 6, 1)
    assert answer(settings) == sorted([*ALL, row('odom', NOON_NS + 5 * SECOND)['key']])


def test_a_part_that_comes_after_it_adds_no_row_twice(settings: StoreSettings, tmp_path: Path) -> None:
    """Robots deliver parts after the objects: before and after a merge a row in two files is one row."""
    run(settings)
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [row(sensor, stamp_ns) for sensor in SENSORS for stamp_ns in TIMES[:3]], 'late', tmp_path / 'tmp')
        assert answer(settings) == ALL
        assert len(lake.objects(Bucket(settings, catalog.BUCKET), sensor='camera')) == len(TIMES)
        merge(settings)
        assert answer(settings) == ALL
        add_part(store, [row('camera', TIMES[0])], 'later', tmp_path / 'tmp')
    assert answer(settings) == ALL


def test_a_killed_reindex_resumes(settings: StoreSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of the objects requested so far are there; the next run requests the rest."""
    monkeypatch.setattr(library, 'PAGE', 4)
    asked: list[str] = []
    plain = library.Bucket

    class Flaky(Watched):
        def head(self, key: str) -> Any:
            asked.append(key)
            if len(asked) > 6:
                raise StoreUnavailable('away')
            return super().head(key)

    with monkeypatch.context() as patch:
        patch.setattr(library, 'Bucket', lambda *place: Flaky(plain(*place)))
        with pytest.raises(StoreUnavailable):
            run(settings)
    assert run(settings).added == 5
    assert answer(settings) == ALL
