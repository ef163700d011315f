"""Video of a camera that stops and returns with another size, in a real Chromium."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from live.browsing import CHROMIUM
from live.test_webrtc import CAMERA, open_page, robot, until

from shadowhound_data_logger.core.options import COMPRESSED_IMAGE

SIZES = ((160, 120), (800, 608))


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_a_camera_returns_with_another_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the same connection, without a reload: while it is away, its last frame is marked as old."""
    api = pytest.importorskip('playwright.async_api')
    pytest.importorskip('aiortc')
    size = '(({width, height}) => `${width}x${height}`)(document.querySelector(".camera canvas"))'
    is_old = 'document.querySelector("[data-age=camera]")?.classList.contains("old") === true'

    async def run() -> None:
        async with robot(tmp_path, monkeypatch, '0.0.0.0') as found, api.async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox', '--disable-gpu'])
            tab = await browser.new_page()
            await open_page(tab, found)
            await tab.select_option('[data-video]', 'video')
            await until(lambda: tab.evaluate('shadowhound.video.frames > 5'), 'frames of video')
            await tab.evaluate('window.first = shadowhound.video.pc')
            show = found.server.viewers.on_items
            for width, height in SIZES:
                monkeypatch.setattr(found.server.viewers, 'on_items', lambda _: None)
                found.server.viewers.on_graph({CAMERA: (COMPRESSED_IMAGE, 0)})
                await until(lambda: tab.evaluate(is_old), 'its last frame is old')
                frame = bytes(simplejpeg.encode_jpeg(np.full((height, width, 3), 90, np.uint8), 90, colorsubsampling='420'))
                monkeypatch.setattr('live.test_webrtc.picture', lambda _, frame=frame: frame)
                found.server.viewers.on_graph({CAMERA: (COMPRESSED_IMAGE, 1)})
                monkeypatch.setattr(found.server.viewers, 'on_items', show)
                expected = f'{width}x{height}'
                await until(lambda expected=expected: tab.evaluate(f'{size} === "{expected}" && !({is_old})'), expected)  # type: ignore[misc]
            assert await tab.evaluate('shadowhound.video.state.value') == 'on'
            assert await tab.evaluate('shadowhound.video.pc === window.first')
            await browser.close()

    asyncio.run(run())
