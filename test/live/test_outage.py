"""The page of a store while its S3 server is away, in a real Chromium with a real SeaweedFS."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from live.test_history import patrol
from live.test_page import CHROMIUM, Served, holds, opened, press
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.live.server import LiveSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [
    pytest.mark.seaweedfs,
    pytest.mark.long('a Chromium and an S3 server'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]


def test_the_page_survives_an_outage_of_the_store(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says what cannot be reached, keeps what it shows, and goes on without a reload once the server is back."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    with Tower(tmp_path / 'tower') as tower:
        for name, value in tower.environment().items():
            monkeypatch.setenv(name, value)
        with closing(open_store(tower.store_settings(), UploadSettings())) as store:
            patrol(store, tmp_path)
        served = Served(
            LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True), monkeypatch
        )
        try:
            page = opened(browser, served.server.url)
            holds(page, 'document.querySelectorAll("rect.recorded").length > 1 && shadowhound.past?.shown.length > 1')
            page.evaluate('window.same = true')
            frames = page.evaluate('shadowhound.past.count')
            tower.stop_s3()
            served.run(served.server.past.history._end())  # what it has read already would do for a while
            press(page.get_by_role('button', name='10 seconds back'))
            page.locator('.timeline [role=alert]').first.wait_for()
            said = page.locator('.timeline [role=alert]').first.inner_text()
            assert tower.endpoint_url in said
            assert page.evaluate('document.querySelectorAll("rect.recorded").length') > 1
            tower.start_s3()
            press(page.get_by_role('button', name='1 second on'))
            holds(page, f'shadowhound.past.count > {frames}')
            holds(page, 'document.querySelectorAll(".timeline [role=alert]").length === 0')
            assert page.evaluate('window.same')
            page.close()
        finally:
            served.close()
