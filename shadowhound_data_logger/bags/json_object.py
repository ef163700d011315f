"""Reads a JSON object that anybody may have written, field by field, each with its type checked."""

from __future__ import annotations

from typing import Any, Final

from shadowhound_data_logger.core.errors import BagDamaged

MOST: Final = 1 << 64
"""Times in MCAP have 64 bits without a sign."""


class JsonObject:
    """A JSON object from an untrusted file, with typed access to its fields.

    New with what ``json.loads`` gave; what is not as it must be raises BagDamaged with its place.
    """

    def __init__(self, value: object, file: str, place: str) -> None:
        self._file, self._place = file, place
        if not isinstance(value, dict):
            raise BagDamaged(f'{file}: {place or "it"} is not JSON object', path=file)
        self._fields: dict[str, Any] = value

    def text(self, name: str, *, is_any: bool = False) -> str:
        """Not empty, unless any will do."""
        found = self._fields.get(name)
        if not isinstance(found, str) or not (found or is_any):
            raise self.wrong(name, 'a text')
        return found

    def text_or_none(self, name: str) -> str | None:
        """None for an empty one as well."""
        found = self._fields.get(name)
        return None if found is None or found == '' else self.text(name)

    def count(self, name: str) -> int:
        found = self._fields.get(name)
        if type(found) is not int or not 0 <= found < MOST:
            raise self.wrong(name, 'a whole number of 0 ... 2^64')
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
            raise self.wrong(name, 'a number of 64 bits') from None

    def flag(self, name: str) -> bool:
        found = self._fields.get(name)
        if not isinstance(found, bool):
            raise self.wrong(name, 'true or false')
        return found

    def counts(self, name: str) -> dict[str, int]:
        inner = JsonObject(self._fields.get(name), self._file, self._at(name))
        return {key: inner.count(key) for key in inner._fields}

    def has(self, name: str) -> bool:
        """Whether something other than null is there."""
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
