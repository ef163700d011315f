"""Where the lake reads: one bucket of a store, as a value that another process may be given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.options import StoreSettings
from shadowhound_data_logger.retry import steadily
from shadowhound_data_logger.stores import open_reader
from shadowhound_data_logger.stores.base import ObjectStore

_Answer = TypeVar('_Answer')


@dataclass(frozen=True, slots=True)
class Bucket:
    """The questions of ``stores/base.py`` about one bucket, each with some tries. Thread-safe; its repr shows no secret.

    Nothing but a StoreError leaves, or SettingError for settings that no request can be sent with.
    """

    settings: StoreSettings = field(repr=False)
    name: str

    def describe(self) -> str:
        """Where it is, for a sentence; never a secret."""
        return f'the bucket {self.name} {"of" if self.settings.endpoint_url else "in"} {_reader(self.settings).describe()}'

    def folders(self, prefix: str) -> Sequence[str]:
        return self._ask(lambda store: store.folders(self.name, prefix))

    def list(self, prefix: str) -> Sequence[ObjectInfo]:
        return self._ask(lambda store: [*store.list(self.name, prefix)])

    def get(self, key: str, most: int) -> bytes:
        return self._ask(lambda store: store.get(self.name, key, most))

    def ranges(self, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        return self._ask(lambda store: store.ranges(self.name, key, spans))

    def head(self, key: str) -> ObjectInfo | None:
        return self._ask(lambda store: store.head(self.name, key))

    def delete(self, key: str) -> None:
        self._ask(lambda store: store.delete(self.name, key))

    def _ask(self, ask: Callable[[ObjectStore], _Answer]) -> _Answer:
        return steadily(lambda: ask(_reader(self.settings)))


@lru_cache(maxsize=16)
def _reader(settings: StoreSettings) -> ObjectStore:
    """One a process: it holds the connections."""
    return open_reader(settings)
