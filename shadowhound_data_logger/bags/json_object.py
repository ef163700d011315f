"""Reads an untrusted JSON object field by field, and checks the type of each."""

from __future__ import annotations

from typing import Any, Final

from shadowhound_data_logger.core.errors import BagDamaged

LIMIT: Final = 1 << 64
"""All numbers must be below this: times in MCAP are uint64."""


class JsonObject:
    """A JSON object from an untrusted file, with typed access to its fields.

    ``value`` is the result of ``json.loads``. Methods raise BagDamaged, with the path of the field, for invalid values.
    """

    def __init__(self, value: object, file: str, place: str) -> None:
        self._file, self._place = file, place
        if not isinstance(value, dict):
            raise BagDamaged(f'{file}: {place or "it"} is not a JSON object', path=file)
        self._fields: dict[str, Any] = value

    def text(self, name: str, *, is_any: bool = False) -> str:
        """A string; non-empty unless ``is_any``."""
        found = self._fields.get(name)
        if not isinstance(found, str) or not (found or is_any):
            raise self.wrong(name, 'a text')
        return found

    def text_or_none(self, name: str) -> str | None:
        """A string; None if it is missing or empty."""
        found = self._fields.get(name)
        return None if found is None or found == '' else self.text(name)

    def count(self, name: str) -> int:
        found = self._fields.get(name)
        if type(found) is not int or not 0 <= found < LIMIT:
            raise self.wrong(name, 'an integer from 0 to 2^64')
        return found

    def count_or_none(self, name: str) -> int | None:
        return None if self._fields.get(name) is None else self.count(name)

    def number(self, name: str) -> float:
        found = self._fields.get(name)
        if not isinstance(found, (int, float)) or isinstance(found, bool):
            raise self.wrong(name, 'a number')
        try:
            return float(found)
        except OverflowError:
            raise self.wrong(name, 'a 64-bit number') from None

    def flag(self, name: str) -> bool:
        found = self._fields.get(name)
        if not isinstance(found, bool):
            raise self.wrong(name, 'true or false')
        return found

    def counts(self, name: str) -> dict[str, int]:
        inner = JsonObject(self._fields.get(name), self._file, self._at(name))
        return {key: inner.count(key) for key in inner._fields}

    def has(self, name: str) -> bool:
        """Whether the field exists and is not null."""
        return self._fields.get(name) is not None

    def object(self, name: str) -> JsonObject:
        return JsonObject(self._fields.get(name), self._file, self._at(name))

    def object_or_none(self, name: str) -> JsonObject | None:
        return self.object(name) if self.has(name) else None

    def objects(self, name: str) -> list[JsonObject]:
        found = self._fields.get(name)
        if not isinstance(found, list):
            raise self.wrong(name, 'a list')
        return [JsonObject(one, self._file, f'{self._at(name)}[{place}]') for place, one in enumerate(found)]

    def wrong(self, name: str, allowed: str) -> BagDamaged:
        value = self._fields.get(name, 'nothing')
        found = f'a {type(value).__name__}' if isinstance(value, (dict, list)) else repr(value)[:80]
        return BagDamaged(
            f'{self._file}: {self._at(name)} is {found} and must be {allowed}', path=self._file, field=self._at(name)
        )

    def _at(self, name: str) -> str:
        return f'{self._place}.{name}' if self._place else name
