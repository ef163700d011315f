from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import NameRefused, SettingError
from shadowhound_data_logger.core.keys import (
    MAX_NAME_BYTES,
    MAX_SEGMENT_BYTES,
    KeyTemplate,
    check_key,
    check_name,
    dated,
    unique,
    unsynced,
)

NOON_NS = 1_760_788_800 * SECOND + 250_000_000
HOSTILE = ['', '.', '..', '../x', 'a/../b', '/a', 'a//b', 'a/', 'a b', 'a\n',
           '\x00', 'a\x7f', 'ü', '\ud800', 'a\\b', '$(rm)', '~', 'a?b']  # fmt: skip


@pytest.mark.parametrize('name', [*HOSTILE, 'a/b', '.hidden', '-option', '_a', 'a..b', 'x' * (MAX_NAME_BYTES + 1)])
def test_hostile_names_are_refused(name: str) -> None:
    """A name that could escape its folder, hide, or confuse a shell or a server is refused, and the error names its setting."""
    with pytest.raises(NameRefused, match=r'the robot name .* cannot be part of an object key .*use letters'):
        check_name(name, 'the robot name')


@pytest.mark.parametrize('name', ['thor', 'robot0', 'T-1000', 'a.b_c', 'x' * MAX_NAME_BYTES])
def test_names_that_are_words_pass(name: str) -> None:
    """A valid name is returned unchanged."""
    assert check_name(name, 'the robot name') == name


@pytest.mark.parametrize('key', [*HOSTILE, '~/x', 'a/./b', 'x' * (MAX_SEGMENT_BYTES + 1), 'x/' * 600 + 'x'])
def test_hostile_keys_are_refused(key: str) -> None:
    """A key that a server, a file system or a shell could misread is refused, whatever it contains."""
    with pytest.raises(NameRefused):
        check_key(key)


@given(st.text())
def test_a_key_is_refused_or_safe(key: str) -> None:
    """Any text is refused with NameRefused, or is a relative path of printable ASCII without ``..``."""
    try:
        assert check_key(key) == key
    except NameRefused:
        return
    assert key.isascii()
    assert key.isprintable()
    assert not {'', '.', '..'} & set(key.split('/'))


KEYS = st.from_regex(r'([a-z]{1,9}/){0,3}[a-z.]?[a-z][a-z.]{0,198}', fullmatch=True)


@given(KEYS, st.integers(0, 2000))
def test_a_numbered_key_is_allowed(key: str, attempt: int) -> None:
    """Every numbered name of an allowed key is allowed, in the same folder, and unique."""
    check_key(key)
    names = {unique(key, number) for number in (0, attempt + 1, attempt + 2)}
    assert len(names) == 3
    assert {check_key(name).rpartition('/')[0] for name in names} == {key.rpartition('/')[0]}


@pytest.mark.parametrize(('key', 'second'), [
    ('a/120000_front.jpg', 'a/120000_front_2.jpg'), ('a.b/run', 'a.b/run_2'), ('bag.tar.gz', 'bag_2.tar.gz'),
    ('x/' + 'y' * 196 + '.jpg', 'x/' + 'y' * 194 + '_2.jpg'), ('.' + 'x' * 199, '.' + 'x' * 197 + '_2'),
    ('/'.join([*['y' * 170] * 5, 'y' * 169]), '/'.join([*['y' * 170] * 5, 'y' * 167 + '_2'])),
])  # fmt: skip
def test_the_number_is_before_the_extension(key: str, second: str) -> None:
    """The number follows the stem; a name at the maximum length loses the end of its stem."""
    assert check_key(unique(check_key(key), 2)) == second


@pytest.mark.parametrize('template', [
    '{robot}/camera/front.jpg', '{robot}/{date}/front.jpg', '{robot}/{time}_front.jpg', '{robot}/{date:.4}/{time}.jpg',
    '{robot}/{date}/{time:.2}.jpg', '{robot}/{date}/{time!r}.jpg', '{robot}/{date}/{time:{sensor}}', '{robot}/{date}/{time[0]}',
])  # fmt: skip
def test_templates_that_could_collide_are_refused(template: str) -> None:
    """Without the complete date and time two objects would share a name: the error has setting, value and what is allowed."""
    with pytest.raises(SettingError) as caught:
        KeyTemplate.parse(template, 'camera.key')
    assert caught.value.data['name'] == 'camera.key'
    assert caught.value.data['value'] == template
    assert '{date} and {time}' in str(caught.value)


@pytest.mark.parametrize('template', [
    '{robot', '{}/{date}/{time}', '{robot}/{date}/{time}/{secret}', '{robot.__class__}/{date}/{time}', '{robot}/../{date}{time}',
    '{date}/{time}', 'thor/{date}/{time}', '/{robot}/{date}/{time}', '{robot}/{date} {time}', '{robot}//{date}{time}', '', '{0}',
])  # fmt: skip
def test_templates_that_make_no_safe_key_are_refused(template: str) -> None:
    """Unknown fields, ``..`` and keys that do not start with the robot are refused."""
    with pytest.raises(SettingError, match=r'camera\.key'):
        KeyTemplate.parse(template, 'camera.key')


@pytest.mark.parametrize(('period_ns', 'time'), [
    (SECOND, '120000'), (10 * SECOND, '120000'), (SECOND // 2, '120000_250'), (0, '120000_250'), (3 * SECOND // 2, '120000_250'),
])  # fmt: skip
def test_the_time_is_as_fine_as_objects_come(period_ns: int, time: str) -> None:
    """At full seconds a key has HHMMSS, in UTC; if objects can be closer to each other, milliseconds as well."""
    key = KeyTemplate.parse('{robot}/{sensor}/{date}/{time}_front.{ext}', 'camera.key')
    rendered = key.render(robot='thor', sensor='camera', stamp_ns=NOON_NS, period_ns=period_ns, ext='jpg')
    assert rendered == f'thor/camera/20251018/{time}_front.jpg'


@pytest.mark.parametrize('period_ns', [SECOND, 0])
def test_a_pattern_gets_its_time_later(period_ns: int) -> None:
    """A key with a deferred time becomes the same as one made immediately."""
    key = KeyTemplate.parse('{robot}/{sensor}/{date}/{time}_front.{ext}', 'camera.key')
    pattern = key.pattern(robot='thor', sensor='camera', period_ns=period_ns, ext='jpg')
    at_once = key.render(robot='thor', sensor='camera', stamp_ns=NOON_NS + SECOND // 4, period_ns=period_ns, ext='jpg')
    assert dated(pattern, NOON_NS + SECOND // 4) == at_once


def test_a_key_by_the_boot_clock_sorts_by_time() -> None:
    """It has no date, sorts by time, and has the same end as the final one."""
    key = unsynced('thor', 'a-boot', 'imu', 123 * SECOND + 45_000_000, 'thor/imu/{date}/{time}_imu.tar.gz')
    assert key == 'thor/_unsynced/a-boot/imu/00000123_045_imu.tar.gz'
