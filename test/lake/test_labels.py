"""Labels: layers in the store that are added and never changed, as filters and columns of every query."""

from __future__ import annotations

import json
import pickle
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import duckdb
import pytest
from lake.making import NOON_NS, fill, folder_store

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError, NameRefused, SettingError
from shadowhound_data_logger.lake import labels, query
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.dataset import MissionDataset
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.labels import Label
from shadowhound_data_logger.stores import open_store

MINUTE = 60 * SECOND
STAIRS = Label(robot='thor', label='stairs', since_ns=NOON_NS, until_ns=NOON_NS + 16 * SECOND, note='the cellar')
PICTURE = 'thor/camera/20261028/115500_x.jpg'
BOX = Label(robot='thor', label='person', since_ns=0, until_ns=0, bucket='sensor-data', key=PICTURE, x=1, y=2, width=3, height=4)


@pytest.fixture(scope='module')
def lake(tmp_path_factory: pytest.TempPathFactory) -> Bucket:
    root = tmp_path_factory.mktemp('labels')
    settings = folder_store(root)
    fill(settings, root, days=(0,))
    return Bucket(settings, 'sensor-data')


def write_labels(lake: Bucket, *found: Label, is_removal: bool = False) -> str:
    with closing(open_store(lake.settings, UploadSettings())) as store:
        return labels.write(store, found[0].robot, found, by='ann', is_removal=is_removal)


def names(lake: Bucket) -> list[str]:
    return [each.label for each in labels.read(lake, 'thor')]


def test_a_removal_is_a_layer_and_a_label_may_come_back(lake: Bucket, tmp_path: Path) -> None:
    """The newest row about a label counts; layers stay, with author and time."""
    first = write_labels(lake, STAIRS)
    write_labels(lake, STAIRS)
    (one,) = labels.read(lake, 'thor')
    assert (one.label, one.note, one.by, one.id) == ('stairs', 'the cellar', 'ann', STAIRS.checked().id)
    write_labels(lake, one, is_removal=True)
    assert names(lake) == []
    write_labels(lake, STAIRS)
    assert names(lake) == ['stairs']
    assert lake.head(first) is not None
    files = f'{lake.settings.directory}/sensor-data/thor/_labels/*/*.jsonl.zst'
    counts = duckdb.read_json(files, format='newline_delimited', compression='zstd').query(
        'rows', 'SELECT what, count(*) FROM rows GROUP BY what ORDER BY what'
    )
    assert counts.fetchall() == [
        ('label', 3),
        ('removed', 1),
    ]


def test_labels_choose_objects(lake: Bucket) -> None:
    """A label of a time selects everything that overlaps it, one of an object only that; with other flags, and in SQL."""
    write_labels(lake, STAIRS)
    boxes = [BOX, replace(BOX, key='thor/camera/none.jpg')]
    kept, absent = labels.with_times(lake, boxes, Findings())
    assert absent == ['thor/camera/none.jpg']
    write_labels(lake, *kept)
    found = query.objects(lake, label='stairs', sensor='camera').to_pydict()
    assert [(each - NOON_NS) // SECOND for each in sorted(found['t_start_ns'])] == [0, 15]
    assert query.objects(lake, label='person').to_pydict()['key'] == [PICTURE]
    assert query.objects(lake, label='nothing').to_pydict()['key'] == []
    both = [{'since_ns': NOON_NS + 10 * SECOND, 'until_ns': NOON_NS + MINUTE}]
    assert len(query.objects(lake, label='stairs', sensor='odom', ranges=both)) == 1
    report = query.sql("SELECT label, width FROM labels WHERE label = 'person'", lake).to_pydict()
    assert report == {'label': ['person'], 'width': [3.0]}
    rows = query.objects(lake, sensor='camera', since='2026-10-28T11:55', until='2026-10-28T12:01').sort_by('t_start_ns')
    column = labels.column(rows, labels.read(lake))
    assert [each for each in column if each] == [['person'], ['stairs'], ['stairs']]
    assert labels.with_column(rows.slice(0, 0), [STAIRS])['labels'].to_pylist() == []


def test_samples_have_labels(lake: Bucket) -> None:
    """The labels at the time of the call, also in a dataset that was pickled."""
    write_labels(lake, STAIRS)
    dataset = MissionDataset(lake, since='2026-10-28T11:59:50', until='2026-10-28T12:01')
    found = [(stamp - NOON_NS) // SECOND for stamp, names in zip(dataset.stamps_ns, dataset.labels(), strict=True) if names]
    assert found == [0, 15]
    assert [(stamp - NOON_NS) // SECOND for stamp in MissionDataset(lake, label='stairs').stamps_ns] == [0, 15]
    write_labels(lake, STAIRS, is_removal=True)
    assert not any(pickle.loads(pickle.dumps(dataset)).labels())  # noqa: S301 - our own


def test_labels_are_read_from_csv_and_coco() -> None:
    """A CSV and a COCO file; another file gets an error with the reason."""
    head, first = b'label,since,until,key,x,y,width,height,note', b'stairs,2026-10-28T12:00,2026-10-28T12:01,,,,,,up'
    body = b'\n'.join((head, first, b'mug,,,thor/a.jpg,1,2,3,4,'))
    stairs, mug = labels.from_csv(body, 'thor', NOON_NS)
    assert (stairs.since_ns, stairs.until_ns, stairs.note) == (NOON_NS, NOON_NS + MINUTE, 'up')
    assert (mug.key, mug.box) == ('thor/a.jpg', (1, 2, 3, 4))
    coco = {'images': [{'id': 1, 'file_name': 'thor/a.jpg'}], 'categories': [{'id': 7, 'name': 'mug'}],
            'annotations': [{'image_id': 1, 'category_id': 7, 'bbox': [1, 2, 3, 4]}]}  # fmt: skip
    (one,) = labels.from_coco(json.dumps(coco).encode(), '')
    assert (one.robot, one.label, one.box) == ('thor', 'mug', (1, 2, 3, 4))
    for wrong in (
        b'since,until\n1,2\n',
        b'label,since,until\nx,,\n',
        b'label,colour\nx,red\n',
        b'\xff',
        b'label,key,x\nm,thor/a,b\n',
        b'label,label,key\nm,n,thor/a\n',
        b'label,key\nm,thor/a,b\n',
    ):
        with pytest.raises(LakeError, match='CSV'):
            labels.from_csv(wrong, 'thor', NOON_NS)
    for wrong in (b'{}', b'{"images": 1}', b'[]', json.dumps({**coco, 'annotations': [{'image_id': 2}]}).encode(),
                  json.dumps(coco).replace('[1, 2,', f'[{10**400}, 2,').encode()):  # fmt: skip
        with pytest.raises(LakeError, match='COCO'):
            labels.from_coco(wrong, 'thor')


@pytest.mark.parametrize('wrong', [
    {'label': ''}, {'label': 'a\nb'}, {'label': 'x' * 201}, {'until_ns': 0}, {'x': 1.0}, {'key': 'tachi/a.jpg', 'bucket': 'b'},
    {'key': 'thor/../a', 'bucket': 'sensor-data'}, {'robot': '../x'},
    {'key': 'thor/a.jpg', 'bucket': 'sensor-data', 'x': 0.0, 'y': 0.0, 'width': float('nan'), 'height': 1.0},
])  # fmt: skip
def test_an_invalid_label_is_refused(wrong: dict[str, object]) -> None:
    """Before anything is written."""
    with pytest.raises((SettingError, NameRefused)):
        Label(**{'robot': 'thor', 'label': 'stairs', 'since_ns': 1, 'until_ns': 2, **wrong}).checked()  # type: ignore[arg-type]
