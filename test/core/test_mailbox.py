"""An entry of a mailbox with any contents is refused, or is a request that round-trips."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shipping.asking import Desk, frame

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.mailbox import KeptFilter, PullRequest, RequestRefused, read_entry, request_id

NOW_NS = 1_760_788_800 * SECOND
GOOD = PullRequest(
    robot='thor', by='spark', made_ns=NOW_NS, expires_ns=NOW_NS + SECOND, want=KeptFilter(sensor='camera')
).to_json()
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters()) | st.sampled_from(['thor', 'camera', '*']),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*GOOD, *KeptFilter.__slots__, 'x']), inner),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from([*GOOD, 'cancel']), ANYTHING, max_size=2), st.none() | st.dictionaries(
    st.sampled_from(['sensor', 'topic', 'mission', 'mission_type', 'since_ns', 'until_ns', 'near', 'keys']), ANYTHING, max_size=3,
))  # fmt: skip
def test_an_entry_is_rejected_or_round_trips(changed: dict[str, Any], want: dict[str, Any] | None) -> None:
    """With surrogates, NaN, huge numbers and deep nesting anywhere, and with valid and invalid ids."""
    entry = {**GOOD, **changed}
    if want is not None:
        entry |= {'want': want, 'id': request_id('thor', want)}
    try:
        read = read_entry('thor', entry)
    except RequestRefused:
        return
    assert read_entry('thor', json.loads(json.dumps(read.to_json()))) == read


@pytest.mark.parametrize(
    'keys',
    [['tachi/camera/20251018/000001_front.jpg'], ['../../../../etc/passwd', '/etc/passwd'], ['tachi/*'], ['*/../index.db']],
)
def test_keys_that_the_robot_does_not_keep_match_nothing(tmp_path: Path, keys: list[str]) -> None:
    """A key is compared with those of kept objects, and never opened: the request completes without a result."""
    desk = Desk(tmp_path / 'spool')
    desk.keeps(frame(1))
    wild = tuple(key for key in keys if '*' in key)
    request = desk.ask(keys=frozenset(keys) - set(wild), patterns=wild)
    desk.finish()
    assert [(answer['state'], answer['objects']) for answer in desk.answers(request)] == [('done', 0)]
    assert desk.released == []
    desk.spool.close()
