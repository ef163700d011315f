"""Settings from any parameters and any environment: either they are refused by name, or everything they promise works."""

from __future__ import annotations

from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import Settings, default_parameters
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.keys import KeyTemplate, check_key, check_name

KNOWN = sorted(default_parameters())
CHOSEN = (
    '', '~nobody/x', '{robot}/{date}/{time}', '{robot[0]}/{date}/{time}', 'a/../b', '\0', '{robot}/{date!r}/{time:>9999999}',
    'json', 'camera', '\ud800', 'x' * 5000,
)  # fmt: skip
TEXT = st.one_of(st.text(max_size=30), st.sampled_from(CHOSEN))
NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([10**400, -(10**400), True, 2**63, -0.0]))
PLAIN = st.one_of(TEXT, NUMBERS, st.none(), st.binary(max_size=5))
VALUES = st.one_of(PLAIN, st.lists(PLAIN, max_size=4), st.lists(TEXT, max_size=4), st.dictionaries(TEXT, PLAIN, max_size=2))
NAMES = st.one_of(
    st.sampled_from(KNOWN),
    st.sampled_from(KNOWN).flatmap(lambda name: st.text(max_size=4).map(lambda tail: name + tail)),
    st.builds('{}.{}'.format, TEXT, st.sampled_from(['topics', 'key', 'rate_hz', ''])),
    TEXT,
)
VARIABLES = ('AWS_ENDPOINT_URL', 'AWS_REGION', 'AWS_SECRET_ACCESS_KEY', 'SHADOWHOUND_HOME', 'SHADOWHOUND_ROBOT')


def loaded(parameters: dict[str, Any], environ: dict[str, str], namespace: str = '/') -> Settings | None:
    """The settings; None where they were refused with the name of what is wrong, in words that can be printed."""
    try:
        return Settings.load(parameters, environ, namespace)
    except SettingError as error:
        refusal = error
    assert 'name' in refusal.data
    assert refusal.data['allowed']
    assert str(refusal)
    return None


@settings(derandomize=True, deadline=None, max_examples=examples(400))
@given(st.dictionaries(NAMES, VALUES, max_size=4))
@example({'camera.rate_hz': 10**400})
@example({'spool.max_bytes': 10**400})
@example({'sensors': ['a'], 'a.topics': ['b'], 'a.key': '{robot}/{date}/{time}{sensor.name}'})
def test_any_parameters(parameters: dict[str, Any]) -> None:
    """Whatever is accepted names safe keys at any time, and periods that can be counted."""
    found = loaded(parameters, {})
    if found is None:
        return
    check_name(found.robot, 'the robot')
    for sensor in found.sensors:
        assert 0 <= sensor.period_ns <= 10**14
        for stamp_ns in (0, 1, 2**31 * SECOND, 2**32 * SECOND):
            key = KeyTemplate(sensor.key).render(robot=found.robot, sensor=sensor.name, stamp_ns=stamp_ns,
                                                 period_ns=sensor.period_ns, ext='json')  # fmt: skip
            assert check_key(key).startswith(f'{found.robot}/')


@settings(derandomize=True, deadline=None, max_examples=examples(200))
@given(st.dictionaries(st.sampled_from(VARIABLES), TEXT, max_size=5), TEXT)
@example({'SHADOWHOUND_HOME': '~nobody-of-this-name/x'}, '/')
def test_any_environment(environ: dict[str, str], namespace: str) -> None:
    """What is accepted has an absolute folder and a robot that is a word."""
    found = loaded({}, environ, namespace)
    if found is not None:
        assert found.spool_path.is_absolute()
        check_name(found.robot, 'the robot')


@settings(derandomize=True, deadline=None, max_examples=examples(600))
@given(name=st.sampled_from(KNOWN), value=VALUES)
def test_any_value_of_each_parameter(name: str, value: Any) -> None:
    """Each parameter that there is takes a value of its kind, or refuses it by its name."""
    loaded({name: value}, {})
