"""Kept data of a robot is requested from its live page in a real Chromium, and arrives in the store."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from e2e.processes import GENTLE, Processes, until
from live.browsing import CHROMIUM, fits, holds, opened, press

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [
    pytest.mark.long('a robot, a node, its page and a Chromium'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]
KEPT = {
    'camera.rate_hz': 0.0, 'camera.batch_s': 1.0, 'camera.format': 'tar', 'camera.ship': 'on_request',
    'keep.max_bytes': 10**9, 'keep.poll_s': 1.0,
}  # fmt: skip


def test_an_operator_requests_what_is_kept(processes: Processes, browser: Browser) -> None:
    """The page shows how much is kept of the selected time; a request sends it, and the page follows it to its end."""
    node = processes.node(None, KEPT)
    processes.sim('image_raw:=false', GENTLE)
    until(lambda: len([*(node.home / 'spool/kept').rglob('*.tar')]) >= 10, 'archives of images are kept')
    assert not [*(node.home / 'store').rglob('camera*/*.tar')]
    _, url = processes.page(node)
    page = opened(browser, url)
    press(page.get_by_role('button', name='Sign in as operator'))
    page.locator('dialog input[name=token]').fill((node.home / 'live/operator.token').read_text().strip())
    press(page.locator('dialog button.primary'))
    press(page.get_by_role('button', name='Back in time'))
    page.locator('[data-offer]').wait_for()
    slider = page.locator('svg[role=slider]')
    slider.focus()
    for key in (
        'ArrowLeft',
        'ArrowLeft',
        'ArrowLeft',
        'ArrowLeft',
        'ArrowLeft',
        '[',
        'ArrowRight',
        'ArrowRight',
        'ArrowRight',
        ']',
    ):
        page.keyboard.press(key)
    holds(page, 'document.querySelector("[data-command=pull]") !== null')
    holds(page, '["2", "3", "4", "5"].includes(document.querySelector("[data-offer]")?.dataset.offer)')
    offered = int(page.locator('[data-offer]').get_attribute('data-offer') or 0)
    press(page.locator('[data-act=pull]'))
    holds(page, 'document.querySelector("[data-request]")?.dataset.state === "done"')
    assert int(page.locator('[data-request] [data-field=sent]').inner_text()) == offered
    assert len([*(node.home / 'store').rglob('*.tar')]) == offered
    holds(page, 'document.querySelector("[data-offer]") === null || document.querySelector("[data-offer]").dataset.offer === "0"')
    for width in (1280, 390):
        fits(page, width)
    assert page.wrong == []
    page.close()
