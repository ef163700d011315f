"""Object keys: templates, uniqueness and safety. A name from outside is checked before it becomes part of a key."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from string import Formatter
from typing import Final

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.errors import NameRefused, SettingError

MAX_KEY_BYTES: Final = 1024
"""S3's limit on a key; https://docs.aws.amazon.com/AmazonS3/latest/userguide/object-keys.html"""
MAX_SEGMENT_BYTES: Final = 200
"""Below the 255 bytes of a file name, with room for ``_NNN`` and ``.part``: the spool's tree mirrors the bucket."""
MAX_NAME_BYTES: Final = 64
"""A robot, sensor or mission type is a word, not a sentence."""
MAX_BAG_BYTES: Final = 160
"""The name of a bag: such a word followed by a boot id or a time. Its files append a number to it."""

_NAME = re.compile(r'[A-Za-z0-9][A-Za-z0-9_.-]*')
_SEGMENT = re.compile(r"[A-Za-z0-9!_.*'()=+@-]+")
_FIELDS: Final = ('robot', 'sensor', 'date', 'time', 'ext')


UNSEEN: Final = frozenset({'Cc', 'Cf', 'Cs', 'Zl', 'Zp'})
"""Unicode categories that move the cursor, change the direction or break lines; https://www.unicode.org/reports/tr44/"""


def printable(text: str) -> str:
    """Text from outside for a log, a terminal or a status; invisible characters become question marks."""
    return ''.join('?' if unicodedata.category(letter) in UNSEEN else letter for letter in text)


def check_name(name: str, what: str, max_bytes: int = MAX_NAME_BYTES) -> str:
    """The name unchanged, if it can be part of a key: letters, digits, ``_ - .``, at most ``max_bytes``, no ``..``.

    Raises NameRefused otherwise; ``what`` describes the name in the error.
    """
    if not is_name(name, max_bytes):
        raise NameRefused(
            f'{what} {name[:80]!r} cannot be part of an object key',
            remedy=f'use letters, digits, "_", "-" and ".", at most {max_bytes}, starting with a letter or digit',
            name=name,
        )
    return name


def is_name(name: str, max_bytes: int = MAX_NAME_BYTES) -> bool:
    """Whether ``check_name`` allows it."""
    return bool(_NAME.fullmatch(name)) and '..' not in name and len(name.encode(errors='replace')) <= max_bytes


def check_key(key: str) -> str:
    """The key unchanged, if every S3 server, a Linux file system and a shell can handle it; raises NameRefused."""
    segments = key.split('/')
    if len(key.encode(errors='surrogatepass')) > MAX_KEY_BYTES:
        raise NameRefused(f'the key {key[:80]!r}... has more than {MAX_KEY_BYTES} bytes', name=key)
    for segment in segments:
        if not is_segment(segment):
            raise NameRefused(f'the key {key[:200]!r} has an unsafe part {segment[:80]!r}', name=key)
    return key


def is_segment(name: str) -> bool:
    """Whether ``check_key`` allows it between two slashes."""
    return bool(_SEGMENT.fullmatch(name)) and name not in {'.', '..'} and len(name) <= MAX_SEGMENT_BYTES


def unique(key: str, attempt: int) -> str:
    """The ``attempt``-th name of a key: ``a/120000_front.jpg``, then ``a/120000_front_1.jpg``, ``_2``, ...

    A name at the length limit loses the end of its stem, so that ``check_key`` still allows the key.
    """
    if attempt == 0:
        return key
    folder, slash, name = key.rpartition('/')
    stem, dot, extension = name.partition('.')
    tail = f'_{attempt}{dot}{extension}'
    room = min(MAX_SEGMENT_BYTES, MAX_KEY_BYTES - len(folder) - len(slash)) - len(tail)
    if room < 0:  # no stem to number, such as ``.x...x``
        return f'{folder}{slash}{name[: room + len(dot) + len(extension)]}_{attempt}'
    return f'{folder}{slash}{stem[:room]}{tail}'


@dataclass(frozen=True, slots=True)
class KeyTemplate:
    """A key with ``{robot} {sensor} {date} {time} {ext}`` in it.

    ``{date}`` is YYYYMMDD. ``{time}`` is HHMMSS, or HHMMSS_mmm if objects can be less than a second apart or start within a
    second. Both are UTC. A template without them would give two objects the same name, and is rejected.
    """

    template: str

    @classmethod
    def parse(cls, template: str, setting: str) -> KeyTemplate:
        """Raises SettingError naming ``setting``."""
        allowed = 'a key such as "{robot}/camera/{date}/{time}_front.jpg", with {date} and {time} in it'
        try:
            parts = [part for part in Formatter().parse(template) if part[1] is not None]
        except ValueError:
            raise SettingError(setting, template, allowed) from None
        fields = [field for _, field, _, _ in parts if field is not None]
        if any(spec or conversion for _, _, spec, conversion in parts):  # {time:.2s} is the hour: names would collide
            raise SettingError(setting, template, allowed)
        if not {'date', 'time'} <= set(fields) or not set(fields) <= set(_FIELDS):
            raise SettingError(setting, template, allowed)
        if not template.startswith('{robot}/'):
            raise SettingError(setting, template, 'a key that begins with "{robot}/"')
        try:
            cls(template).render(robot='r', sensor='s', stamp_ns=0, period_ns=SECOND, ext='x')
        except (NameRefused, ValueError, AttributeError, LookupError):
            raise SettingError(setting, template, allowed) from None
        return cls(template)

    def render(self, *, robot: str, sensor: str, stamp_ns: int, period_ns: int, ext: str) -> str:
        """The key of an object that starts at ``stamp_ns``; ``period_ns`` is the minimum time between two objects."""
        return dated(self.pattern(robot=robot, sensor=sensor, period_ns=period_ns, ext=ext), stamp_ns)

    def pattern(self, *, robot: str, sensor: str, period_ns: int, ext: str) -> str:
        """The key of an object whose time is not known yet, for ``dated``."""
        time = '{time}_{ms}' if period_ns % SECOND or not period_ns else '{time}'
        return self.template.format(robot=robot, sensor=sensor, date='{date}', time=time, ext=ext)


def dated(pattern: str, stamp_ns: int) -> str:
    """The key of a pattern at this time. Raises NameRefused if that is not a valid key."""
    when = utc(stamp_ns)
    values = {
        '{date}': when.strftime('%Y%m%d'),
        '{time}': when.strftime('%H%M%S'),
        '{ms}': f'{stamp_ns % SECOND // 1_000_000:03d}',
    }
    for name, value in values.items():
        pattern = pattern.replace(name, value)
    return check_key(pattern)


def unsynced(robot: str, boot_id: str, sensor: str, boot_ns: int, key: str) -> str:
    """The key of an object whose time is known only by the boot clock; its ending is that of ``key``.

    ``thor/_unsynced/<boot_id>/camera/00000123_456_camera.jpg``: seconds since boot, milliseconds.
    """
    _, dot, extension = key.rpartition('/')[2].partition('.')
    seconds, rest_ns = divmod(boot_ns, SECOND)
    return check_key(f'{robot}/_unsynced/{boot_id}/{sensor}/{seconds:08d}_{rest_ns // 1_000_000:03d}_{sensor}{dot}{extension}')
