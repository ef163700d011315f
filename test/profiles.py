"""How much hypothesis tries: all of it in ``make test-long``, where its tests run again, and a quarter in ``make test``."""

from __future__ import annotations

import os
from typing import Final

from hypothesis import settings

LONG: Final = bool(os.environ.get('SHADOWHOUND_TEST_LONG'))
FULL: Final = 100
"""As hypothesis has it."""


def examples(full: int) -> int:
    """How many of so many."""
    return full if LONG else max(10, full // 4)


def load() -> None:
    """For tests that say nothing else. Each run tests the same, and a busy machine is not a finding."""
    settings.register_profile('tests', max_examples=examples(FULL), deadline=None, derandomize=True)
    settings.load_profile('tests')
