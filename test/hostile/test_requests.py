"""What a robot answers to a request, and labels below a robot's own prefix: anything may be in them."""

from __future__ import annotations

import json
import math
import unicodedata
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hostile import bad_parts
from hypothesis import given, settings
from hypothesis import strategies as st
from lake.making import NOON_NS, fill, folder_store

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.keys import UNSEEN
from shadowhound_data_logger.core.mailbox import KeptFilter, PullRequest, encode_inbox
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.labels import LABELS
from shadowhound_data_logger.lake import labels
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(exclude_categories=['Cs']), max_size=8)
    | st.sampled_from(['done', 'sending', '\x1b[2J', '\x07', 10**400]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4) | st.just('objects'), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip
ANSWERS = st.fixed_dictionaries({}, optional=dict.fromkeys((
    'id', 'state', 'objects', 'bytes', 'outcomes', 'lost', 'bags', 'why', 'time', 'made_ns', 'number', 'mbps', '\x1b[31m',
), ANYTHING))  # fmt: skip
REQUEST = PullRequest(robot='thor', by='x', made_ns=NOON_NS, expires_ns=NOON_NS + SECOND, want=KeptFilter(sensor='camera'))


@pytest.fixture(scope='module')
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with the data of a day, and a request in the mailbox of its robot."""
    root = tmp_path_factory.mktemp('hostile-answers')
    fill(folder_store(root), root, days=(0,))
    inbox = root / 'store/sensor-data/_requests/thor/inbox.json'
    inbox.parent.mkdir(parents=True)
    inbox.write_bytes(encode_inbox([REQUEST.to_json()]))
    return root


def is_harmless(text: str) -> bool:
    """No character has power over a terminal; one without a meaning in Unicode has none."""
    return all(unicodedata.category(each) not in UNSEEN or each == '\n' for each in text)


@settings(max_examples=40, deadline=None)
@given(answer=ANSWERS, is_addressed=st.booleans())
def test_any_answer_is_listed(home: Path, answer: dict[str, Any], is_addressed: bool) -> None:
    """As text and as JSON; the request is there either way, and no control character reaches the terminal."""
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
    """Of a label that is fine."""
    one = labels.Label(robot='thor', label='stairs', since_ns=NOON_NS, until_ns=NOON_NS + SECOND).checked()
    return {**{name: getattr(one, name) for name in labels.FIELDS}, 'what': 'label', 'by': 'ann', 'made_ns': NOON_NS,
            'made': NOON_NS // 1000, 'format_version': 1, **fields}  # fmt: skip


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
    'a time that ends before it begins': {'since_ns': NOON_NS, 'until_ns': 0},
    'the last time there is': {'since_ns': -(1 << 63), 'until_ns': (1 << 63) - 1},
    'a text without end': {'label': 'x' * 60_000, 'note': 'y' * 4000},
    'a future that replaces everything': {'what': 'removed', 'made_ns': (1 << 63) - 1, 'id': row()['id'], 'robot': 'tachi'},
}


@pytest.mark.parametrize('kind', HOSTILE)
def test_hostile_labels_affect_no_other_robot(tmp_path: Path, kind: str) -> None:
    """The label beside it is shown, and every verb that reads labels answers without a control character."""
    fill(folder_store(tmp_path), tmp_path, days=(0,), hours=(12,))
    source = Bucket(folder_store(tmp_path), 'sensor-data')
    bad_parts.put(folder_store(tmp_path), parts.encode([row()], LABELS), 'thor_good', of=LABELS)
    bad_parts.put(folder_store(tmp_path), parts.encode([row(**{'id': 'f' * 16, **HOSTILE[kind]})], LABELS), 'thor_bad', of=LABELS)
    assert 'stairs' in {each.label for each in labels.read(source, 'thor', findings=Findings(lambda _: None))}
    environ = {'SHADOWHOUND_HOME': str(tmp_path), 'AWS_ENDPOINT_URL': None}
    for arguments in (
        ['label', 'list'], ['label', 'list', '--json'], ['query', '--label', 'stairs', '--format', 'csv'],
        ['query', '--label', HOSTILE[kind].get('label', 'stairs'), '--json'], ['pull', '--robot', 'thor', '--label', 'stairs'],
    ):  # fmt: skip
        done = CliRunner().invoke(cli, arguments, env=environ, standalone_mode=False)
        assert done.exception is None or hasattr(done.exception, 'remedy'), (arguments, done.exc_info)
        assert is_harmless(done.output), arguments
    assert {each.robot for each in labels.read(source, 'tachi', findings=Findings(lambda _: None))} <= set()
