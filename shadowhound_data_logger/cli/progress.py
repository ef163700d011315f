"""A progress bar on a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from shadowhound_data_logger.core.progress import ProgressListener


class ProgressBar(ProgressListener):
    """How far something is; any thread may move it. See ``progress``."""

    def __init__(self, bar: Progress, what: str, total: int | None) -> None:
        self._bar = bar
        self._task = bar.add_task(what, total=total)

    def begin(self, total: int) -> None:
        """So much there is to do in all."""
        self._bar.update(self._task, total=total)

    def have(self, count: int = 1) -> None:
        """So much more is done; negative where some of it turned out wrong."""
        self._bar.advance(self._task, count)

    def say(self, what: str, done: int | None = None) -> None:
        """What is under way now, and how much is done of it."""
        self._bar.update(self._task, description=what, completed=done)


@contextmanager
def progress(what: str = '', total: int | None = None, *, of: Literal['bytes', 'objects', 'words', 'seconds'] = 'words'
             ) -> Iterator[ProgressBar]:  # fmt: skip
    """A line on standard error where that is a terminal, gone at the end: a bar of bytes or objects, or the text it is given."""
    console = Console(stderr=True)
    with Progress(*_columns(of), console=console, transient=True, disable=not console.is_terminal) as bar:
        yield ProgressBar(bar, what, total)


def _columns(of: str) -> Sequence[ProgressColumn]:
    words = TextColumn('{task.description}')
    if of == 'bytes':
        return words, BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()
    if of == 'objects':
        return words, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return (SpinnerColumn(), words, TimeElapsedColumn()) if of == 'seconds' else (SpinnerColumn(), words)
