"""Requests for data that a robot keeps, on the page in Chromium."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from lake.test_pull import Field
from live.browsing import CHROMIUM, Served, fits, holds, opened, press

from shadowhound_data_logger.live.server import LiveSettings

if TYPE_CHECKING:
    from playwright.sync_api import Browser


pytestmark = [
    pytest.mark.ros,
    pytest.mark.long('a Chromium, a robot and a node'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]


def test_an_operator_requests_kept_data(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the page of a store: how much of a time is only on the robot, a request for it, and its result."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(Field(tmp_path)) as field:
        field.records(*range(20))
        settings = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
        with Served(settings, monkeypatch) as served:
            page = opened(browser, served.server.url)
            ask, report = page.locator('[data-act=pull]'), page.locator('.pull')
            holds(page, "document.querySelectorAll('rect.kept').length === 1 && document.querySelector('[data-offer]')")
            assert ask.count() == 0
            assert 'an operator can request them' in report.inner_text()
            press(page.get_by_role('button', name='Sign in', exact=True))
            page.locator('dialog input[name=token]').fill((tmp_path / 'live' / 'operator.token').read_text().strip())
            press(page.locator('dialog button.primary'))
            press(page.get_by_role('button', name='From here'))
            press(page.get_by_role('button', name='10 seconds back'))
            holds(page, "document.querySelector('[data-offer]')?.dataset.offer === '11'")
            press(ask)
            holds(page, "document.querySelector('[data-request]')?.dataset.state === 'asked'")
            assert field.kept() == [*range(20)]
            field.passes()
            field.passes()
            holds(page, "document.querySelector('[data-request]').dataset.state === 'done'")
            assert field.kept() == [*range(9)]
            holds(page, "!document.querySelector('[data-offer]')")
            assert page.locator('[data-field=sent]').inner_text() == '11'
            for width in (1440, 390):
                fits(page, width)
            assert page.wrong == []
            page.close()
