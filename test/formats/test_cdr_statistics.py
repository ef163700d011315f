"""The statistics of a batch, taken from its CDR bytes at once, are those of the numbers in its JSON."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.statistics import ALL, MEAN_ERROR, FieldStatistics, unpack_statistics
from shadowhound_data_logger.formats.types import MessageTypes

STAMP_NS = 1_760_788_800_250_000_000
POINT = 'float32 x\nfloat64 y\nbool[2] z\n'
EVERY = """
std_msgs/Header header
uint8 first
float64 wide
float32 small
string text
float32[3] three
int64 far
uint64 farther
own_msgs/Point[2] fixed
own_msgs/Point[] points
string[] names
float32[] ranges
uint8[] picture
int8[] cells
uint8[4] four
byte octet
bool yes
int16 stamp_ns
float64 last
"""
FLOATS = st.floats(width=32) | st.sampled_from([7.038531e-26, 0.1, 3.4028234663852886e38, 1e-45, math.nan, math.inf])
DOUBLES = st.floats() | st.sampled_from([1e308, -1e308, 0.1])


@pytest.fixture(scope='module')
def types(tmp_path_factory: pytest.TempPathFactory) -> MessageTypes:
    prefix = tmp_path_factory.mktemp('types')
    folder = prefix / 'share' / 'own_msgs' / 'msg'
    folder.mkdir(parents=True)
    for name, text in (('Point', POINT), ('Every', EVERY)):
        (folder / f'{name}.msg').write_text(text)
    return MessageTypes([prefix])


def store() -> Any:
    made = get_typestore(Stores.LATEST)
    made.register(get_types_from_msg(POINT, 'own_msgs/msg/Point') | get_types_from_msg(EVERY, 'own_msgs/msg/Every'))
    return made


STORE = store()


def cdr(draw: Any, points: int, names: int, ranges: int) -> bytes:
    of = STORE.types

    def point() -> Any:
        return of['own_msgs/msg/Point'](draw(FLOATS), draw(DOUBLES), np.array([True, draw(st.booleans())]))

    def floats(count: int) -> Any:
        return np.array([draw(FLOATS) for _ in range(min(count, 4))] + [0.5] * (count - 4), np.float32)[:count]

    header = of['std_msgs/msg/Header'](of['builtin_interfaces/msg/Time'](1, 2), 'odom')
    big = st.integers(-(2**63), 2**63 - 1)
    message = of['own_msgs/msg/Every'](
        header, 7, draw(DOUBLES), draw(FLOATS), 'null', floats(3), draw(big), draw(big) + 2**63, [point(), point()],
        [point() for _ in range(points)], ['a' * place for place in range(names)], floats(ranges), np.zeros(5, np.uint8),
        np.arange(ranges, dtype=np.int8), np.arange(4, dtype=np.uint8), -1, draw(st.booleans()), 9, draw(DOUBLES),
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, 'own_msgs/msg/Every'))


def sensor(**changed: Any) -> SensorSettings:
    return SensorSettings(name='s', **changed)


def of_document(body: bytes, chosen: tuple[str, ...]) -> dict[str, Any]:
    found = FieldStatistics(chosen)
    document = json.loads(body)
    found.add(document.get('samples', [document]))
    return found.result()


@given(st.data())
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
def test_they_are_those_of_the_json(types: MessageTypes, data: st.DataObject) -> None:
    """Field by field, of batches and single messages, of one layout or of several, whatever the numbers are."""
    points, names, ranges = data.draw(st.tuples(*(st.sampled_from(some) for some in ((0, 1, 3, 21), (0, 2), (0, 2, 20, 25)))))
    count = data.draw(st.integers(1, 4))
    chosen = data.draw(st.sampled_from([(), ('three', 'points'), ('ranges', 'last', '')]))
    is_alike = data.draw(st.booleans())
    samples = tuple(
        Sample(STAMP_NS + place, cdr(data.draw, points, names, ranges if is_alike else ranges + place)) for place in range(count)
    )
    batch = Batch('s', '/s', 'own_msgs/msg/Every', samples, 1)
    made = encode(batch, sensor(batch_s=data.draw(st.sampled_from([0.0, 1.0])), statistics=chosen), 'thor', types).object
    assert made is not None
    found, expected = unpack_statistics(made.statistics), of_document(made.body, chosen)
    assert found.keys() == expected.keys()
    for name, one in expected.items():
        told = found[name]
        for what in ('first', 'last', 'min', 'max', 'count', 'nan_count'):
            assert getattr(told, what) == getattr(one, what), (name, what)
        if name != ALL and one.mean is not None and told.mean is not None:
            assert abs(told.mean - one.mean) <= MEAN_ERROR * max(abs(one.min), abs(one.max)) + 2**-140, name
        else:
            assert one.mean is None or told.mean is None
