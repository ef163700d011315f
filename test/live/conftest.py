"""The Chromium with which the tests open the live page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    from live.browsing import CHROMIUM, FLAGS

    api = pytest.importorskip('playwright.sync_api')
    with (
        api.sync_playwright() as playwright,
        closing(playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)) as browser,
    ):
        yield browser
