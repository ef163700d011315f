"""Queries by values, words and labels on the command line: their output, and what an answer reports about its limits."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from lake.gap_parts import mark, tell
from lake.making import NOON_NS, add, folder_store
from lake.test_values import BATCHES, filled

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.stores import open_store

LAST = 'thor/s/20261028/000009_s.json'


@pytest.fixture(scope='module')
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten batches of a sensor ``s``, two of them without statistics, a watermark, and a mission with a command."""
    home = tmp_path_factory.mktemp('home')
    filled(home, BATCHES, [True] * 8 + [False] * 2)
    tell(folder_store(home), home, mark(7 * 60, topic='/s'))
    summary = {'mission_id': 'm', 'mission_type': 'patrol', 'mission_command': 'open the door', 'success': True,
               'start_ns': NOON_NS, 'end_ns': NOON_NS + 90 * SECOND}  # fmt: skip
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        add(store, home, 'thor/missions/run/summary.json', json.dumps(summary).encode())
        add(store, home, 'thor/missions/later/camera/frame_000001.jpg', b'one that goes on')
    return home


def run(home: Path, *arguments: str) -> Result:
    env = {'SHADOWHOUND_HOME': str(home), 'COLUMNS': '150', 'AWS_ENDPOINT_URL': '', 'SHADOWHOUND_ROBOT': ''}
    found = CliRunner().invoke(cli, arguments, env=env, standalone_mode=False)
    if found.exception is not None:
        raise found.exception
    return found


def answer(home: Path, *arguments: str) -> Any:
    found = run(home, *arguments, '--json')
    return json.loads(found.output)


def test_an_answer_by_value_states_its_coverage(home: Path) -> None:
    """The text shows the watermark if it is before the newest object; the JSON always has it."""
    found = run(home, 'query', '--when', 's.a > 10')
    assert found.output.splitlines()[1:] == [
        'thor   2026-10-28 12:07:00.400  2026-10-28 12:07:00.400  0.0 s         1', '',
        '1 time. 1 of 10 objects opened (10 %).', '2 objects without statistics may hold more: --scan opens them.',
        'thor /s: fresh up to 2026-10-28 12:07:00.000.',
    ]  # fmt: skip
    found = answer(home, 'query', '--when', 's.a > 10', '--scan')
    assert (len(found['ranges']), found['opened'], found['unknown']) == (3, 3, 0)
    assert found['fresh'][0]['fresh'] == '2026-10-28T12:07:00.000000000Z'


def test_labels_are_added_listed_removed_and_queried(home: Path, tmp_path: Path) -> None:
    """From the ranges of an answer, for an object, with a box, from CSV and from COCO; as a filter and a column of ``query``."""
    ranges = tmp_path / 'high.json'
    ranges.write_text(run(home, 'query', '--when', 's.a > 10', '--json').output, encoding='utf-8')
    assert answer(home, 'label', 'add', 'high', '--ranges', str(ranges))['added'] == 1
    assert answer(home, 'label', 'add', 'person', '--object', LAST, '--box', '1,2,3,4')['added'] == 1
    table = tmp_path / 'labels.csv'
    table.write_text('label,since,until\nfirst,2026-10-28T12:00,2026-10-28T12:00:30\n', encoding='utf-8')
    coco = tmp_path / 'coco.json'
    coco.write_text(json.dumps({
        'images': [{'id': 1, 'file_name': LAST}, {'id': 2, 'file_name': 'thor/s/none.json'}],
        'categories': [{'id': 7, 'name': 'mug'}],
        'annotations': [{'image_id': 1, 'category_id': 7, 'bbox': [1, 2, 3, 4]},
                        {'image_id': 2, 'category_id': 7, 'bbox': [1, 2, 3, 4]}],
    }), encoding='utf-8')  # fmt: skip
    assert answer(home, 'label', 'import', str(table))['added'] == 1
    imported = answer(home, 'label', 'import', str(coco), '--user', 'ann')
    assert (imported['added'], imported['absent']) == (1, ['thor/s/none.json'])
    standing = answer(home, 'label', 'list')
    assert [(each['label'], each['by'] == 'ann', each['width']) for each in standing] == [
        ('first', False, None), ('high', False, None), ('mug', True, 3.0), ('person', False, 3.0),
    ]  # fmt: skip
    assert [row['key'] for row in answer(home, 'query', '--label', 'high')] == ['thor/s/20261028/000007_s.json']
    labelled = [(row['key'], row['labels']) for row in answer(home, 'query', '--labels') if row['labels']]
    assert labelled == [('thor/s/20261028/000000_s.json', ['first']), ('thor/s/20261028/000007_s.json', ['high']),
                        (LAST, ['mug', 'person'])]  # fmt: skip
    assert answer(home, 'query', '--when', 's.a >= 0', '--label', 'first')['objects'] == 1
    assert answer(home, 'label', 'remove', '--label', 'mug')['removed'] == 1
    (first,) = (each['id'] for each in answer(home, 'label', 'list', '--label', 'first'))
    assert run(home, 'label', 'remove', first, 'none').return_value == 1
    assert answer(home, 'label', 'import', str(table))['added'] == 1
    assert [each['label'] for each in answer(home, 'label', 'list')] == ['first', 'high', 'person']


@pytest.mark.parametrize(('arguments', 'what', 'remedy'), [
    (['add', 'x', '--robot', 'thro', '--since', '2026-10-28T12:00', '--until', '2026-10-28T12:01'], 'robot', "is it 'thor'?"),
    (['list', '--label', 'stiars'], 'label', "is it 'stairs'?"), (['list', '--robot', 'thro'], 'robot', "is it 'thor'?"),
    (['remove', '--label', 'stiars'], 'label', "is it 'stairs'?"), (['remove', '0000000000000000'], 'label id', 'there are '),
])  # fmt: skip
def test_a_label_that_nothing_has_is_wrong_usage(home: Path, arguments: list[str], what: str, remedy: str) -> None:
    """The nearest names are suggested, and nothing is written."""
    ends = ('--robot', 'thor', '--since', '2026-10-28T12:00', '--until', '2026-10-28T12:01')
    (given,) = answer(home, 'label', 'add', 'stairs', *ends)['ids']
    with pytest.raises(BadUsage, match=f'there is no {what} ') as raised:
        run(home, 'label', *arguments)
    assert raised.value.remedy.startswith(remedy)
    assert [each['id'] for each in answer(home, 'label', 'list', '--label', 'stairs')] == [given]
    assert answer(home, 'label', 'remove', given)['removed'] == 1


@pytest.mark.parametrize(('when', 'remedy'), [
    ('s.aa > 1', "is it 'a'?"), ('z.a > 1', 'there are s'), ('s.a > 1 and s.aa > 1', "is it 'a'?"),
    ('max(s.aa) > 1 or s.aa < 0', "is it 'a'?"),
])  # fmt: skip
def test_a_field_that_nothing_has_is_wrong_usage(tmp_path: Path, when: str, remedy: str) -> None:
    """Anywhere in the condition."""
    filled(tmp_path, BATCHES, [True] * 10)
    with pytest.raises(BadUsage) as raised:
        run(tmp_path, 'query', '--when', when)
    assert raised.value.remedy.startswith(remedy)


def test_words_are_found_with_the_labels_of_their_time(home: Path) -> None:
    """The answer includes when the index was updated, and that a mission had not ended."""
    times = ('--since', '2026-10-28T12:00:30', '--until', '2026-10-28T12:01')
    assert answer(home, 'label', 'add', 'hall', '--robot', 'thor', *times)['added'] == 1
    indexed = answer(home, 'lake', 'index')
    assert (indexed['missions'], indexed['waiting']) == (1, 1)
    found = answer(home, 'search', 'door')
    assert [(each['kind'], each['mission_id'], 'hall' in each['labels']) for each in found['found']] == [('mission', 'm', True)]
    assert (found['waiting'], found['fresh_ns'] > NOON_NS) == (1, True)
    assert answer(home, 'search', 'door', '--label', 'hall')['found'] == found['found']
    assert answer(home, 'search', 'door', '--label', 'high')['found'] == []
    with pytest.raises(BadUsage, match="no label 'halll'"):
        run(home, 'search', 'door', '--label', 'halll')
    text = run(home, 'search', 'door').output
    assert text.splitlines()[0].split()[-1] == 'labels'
    assert text.splitlines()[-1].startswith('Fresh up to 20')
    assert text.splitlines()[-1].endswith('(`lake index`); 1 mission had no summary yet.')
    assert 'Nothing has these words' in run(home, 'search', 'zebra').output
