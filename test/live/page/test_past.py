"""The past of a store or a spool on the page: playback, by either clock, in Chromium."""

from __future__ import annotations

import asyncio
import statistics
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from e2e.processes import until
from lake.making import NOON_NS, add, add_part, folder_store
from live.browsing import CHROMIUM, HOSTILE, NAMES, Served, fits, holds, opened, press
from live.test_history import LATE_S, ODOMETRY, jpeg, late_patrol, object_row, odometry, patrol

from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, UploadSettings
from shadowhound_data_logger.live.server import LiveSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from shadowhound_data_logger.stores.base import ObjectStore


pytestmark = [
    pytest.mark.ros,
    pytest.mark.long('a Chromium, a robot and a node'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]


COLORS = """() => {
    const canvas = document.querySelector('section[aria-label=Path] canvas');
    if (!canvas?.width) return 0;
    return new Set(new Uint32Array(canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
}"""
"""How many colors the floor plan has: one while it is empty."""


def minute(store: ObjectStore, folder: Path) -> None:
    """A minute of camera at 5 Hz and odometry, and the part with their rows."""
    rows = []
    for number in range(300):
        rows.append(object_row(number / 5, 'camera', '/camera', COMPRESSED_IMAGE, 'jpg'))
        rows[-1]['key'] = f'thor/camera/{number}.jpg'
        add(store, folder, rows[-1]['key'], jpeg(number % 256))
    for second in range(60):
        rows.append(object_row(second, 'odom', '/odom', ODOMETRY, 'json'))
        add(store, folder, rows[-1]['key'], odometry(second))
    add_part(store, rows, 'minute', folder)


@pytest.mark.slow
def test_playback_reads_ahead(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Playback in real time shows about six times per second of a recording, though each takes 0.08 s longer to read."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        minute(store, tmp_path / 'tmp')
    store_page = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
    served = Served(store_page, monkeypatch)
    ask = served.server.past.history.ask

    wanted_ms: list[int] = []
    took_s: list[float] = []

    async def ask_slowly(asked: dict[str, Any]) -> Any:
        if asked['do'] == 'moment':
            wanted_ms.append(asked['at'])
            began_s = time.monotonic()
            await asyncio.sleep(0.08)
            answer = await ask(asked)
            took_s.append(time.monotonic() - began_s)
            return answer
        return await ask(asked)

    monkeypatch.setattr(served.server.past.history, 'ask', ask_slowly)
    try:
        page = opened(browser, served.server.url)
        holds(page, '(shadowhound.past?.count ?? 0) > 0')
        for _ in range(5):
            press(page.get_by_role('button', name='10 seconds back'))
        at_ms = int(page.locator('[data-moment]').get_attribute('data-moment') or 0)
        holds(page, f'Math.abs(shadowhound.past.at - {at_ms}) < 1')
        press(page.locator('[data-play]'))
        hz, pace = played(page, 10)
        print(f'{hz:.1f} moments a second, at {pace:.2f} of the pace of a clock')  # noqa: T201 - a measurement
        # Six to seven on an idle machine. A busy one may delay the browser, and take long to read.
        assert hz >= min(4.5, 0.8 / statistics.median(took_s))
        assert 0.9 <= pace <= 1.1
        is_ahead = [page.evaluate('shadowhound.past.at') < wanted_ms[-1] for _ in range(100)]
        assert is_ahead.count(True) > 80
        assert page.wrong == []
        page.close()
    finally:
        served.close()


def played(page: Page, seconds: int) -> tuple[float, float]:
    """Displayed times per second during playback, and the time that passes on the page per second."""
    script = """async (seconds) => {
        const now = () => [shadowhound.past.count, shadowhound.past.at, performance.now()];
        const [count, at, began] = now();
        await new Promise((done) => setTimeout(done, seconds * 1000));
        const [last, reached, ended] = now();
        return [(last - count) / (ended - began) * 1000, (reached - at) / (ended - began)];
    }"""
    hz, pace = page.evaluate(script, seconds)
    return hz, pace


def test_the_past_is_shown_by_arrival(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For frames with old stamps: timeline, time and command follow the selected clock, and so do their ages."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        late_patrol(store, tmp_path)
    store_page = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
    served = Served(store_page, monkeypatch)
    noon = NOON_NS // 1_000_000
    bars = '[...document.querySelectorAll(\'rect.recorded[data-topic="/camera"]\')].map(bar => Number(bar.dataset.from))'
    try:
        page = opened(browser, served.server.url)
        holds(page, f'{bars}[0] === {noon}')
        page.get_by_label('By which time of the messages').select_option('received')
        holds(page, f'{bars}[0] === {noon + 1000 * LATE_S}')
        press(page.get_by_role('button', name='10 seconds back'))
        holds(page, "document.querySelector('[data-command=query]').textContent.includes('--by received')")
        assert page.locator('[data-act=label]').count() == 0
        page.get_by_label('By which time of the messages').select_option('stamp')
        holds(page, f'{bars}[0] === {noon}')
        assert page.wrong == []
        page.close()
    finally:
        served.close()


def test_the_page_of_a_store_shows_the_past_without_a_robot(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a robot: the last day, a time in it, and labels that an operator adds to it; names in it are text."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        patrol(store, tmp_path)
        rows = [
            object_row(6, 'camera', f'/{name}', COMPRESSED_IMAGE, 'jpg', mission_id=name, mission_type=name) for name in NAMES
        ]
        for place, row in enumerate(rows):
            row['key'] = f'thor/names/{place}.jpg'
            add(store, tmp_path / 'tmp', row['key'], jpeg(9))
        add_part(store, rows, 'names', tmp_path / 'tmp')
    store_page = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
    with Served(store_page, monkeypatch) as served:
        page = opened(browser, served.server.url)
        holds(page, "document.querySelectorAll('rect.recorded').length > 2 && shadowhound.past?.shown.length > 2")
        until(lambda: page.evaluate(COLORS) > 5, 'the path of the first moment is drawn')
        press(page.get_by_role('button', name='Sign in', exact=True))
        page.locator('dialog input[name=token]').fill((tmp_path / 'live' / 'operator.token').read_text().strip())
        press(page.locator('dialog button.primary'))
        at_ms = int(page.locator('[data-moment]').get_attribute('data-moment') or 0)
        press(page.get_by_role('button', name='From here'))
        press(page.get_by_role('button', name='1 second back'))
        holds(page, f"document.querySelector('[data-moment]').dataset.moment == {at_ms - 1000}")
        page.locator('input[name=label]').fill(HOSTILE)
        page.get_by_label('Note on the label').fill(HOSTILE)
        press(page.locator('[data-act=label]'))
        mark = page.locator('[data-mark=label]')
        mark.wait_for(state='attached')
        assert [mark.get_attribute(f'data-{name}') for name in ('name', 'from', 'to')] == [HOSTILE, str(at_ms - 1000), str(at_ms)]
        assert set(NAMES) <= set(
            page.locator('[data-mark=mission]').evaluate_all('marks => marks.map(mark => mark.dataset.name)')
        )
        for width in (1440, 390):
            fits(page, width)
        assert [url for url in page.asked if not url.startswith((served.server.url, 'blob:'))] == []
        assert page.evaluate('[window.attacked ?? null, document.querySelectorAll("img[src=x]").length]') == [None, 0]
        assert page.wrong == []
        page.close()
