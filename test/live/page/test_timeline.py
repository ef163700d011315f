"""The timeline of the live page in a real Chromium, for a store: zoom, pan, selection, gaps as text, jumps and cuts of bags."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from lake.gap_parts import lost, mark, tell
from lake.making import NOON_NS, add_part, folder_store
from live.browsing import CAUSES, CHROMIUM, HOSTILE, IMU, Served, fits, holds, opened, press, rgb
from live.test_history import bag, patrol
from spool.making import FakeClock, make, new_spool, put

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.formats.mcap.index import read_index
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.live.server import PAGE, LiveSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


NOON_MS = NOON_NS // 1_000_000
BAG = f'bump_{utc(NOON_NS + 20 * SECOND):%Y%m%d_%H%M%S}'


def test_each_cause_has_a_remedy() -> None:
    """The page has a remedy for every cause that the code knows."""
    source = (PAGE / 'gaps.js').read_text()
    known = set(re.findall(r'^  (\w+): ', source.partition('const REMEDIES')[2].partition('};')[0], re.MULTILINE))
    assert set(CAUSES) | {'unknown'} <= known | {'EntityTooLarge'}


def in_chromium(test: Any) -> Any:
    """A test with a browser."""
    skip = pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
    return pytest.mark.long('a Chromium')(skip(test))


@pytest.fixture
def page(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    """Ten seconds of a mission, with one second without the IMU, and a bag of an event ten seconds later."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    settings = folder_store(tmp_path)
    with closing(open_store(settings, UploadSettings())) as store:
        patrol(store, tmp_path)
        add_part(store, bag(store, tmp_path, BAG, 'bump', seconds=5), 'b', tmp_path / 'tmp')
    tell(settings, tmp_path, lost('1', 3, 4, cause='transport', topic='/imu'), mark(8, topic='/imu'),
         lost('2', 6, 7, cause=HOSTILE, topic='/odom', count=2))  # fmt: skip
    store_page = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
    with Served(store_page, monkeypatch) as served:
        page = opened(browser, served.server.url)
        holds(page, 'shadowhound.past?.count > 0 && document.querySelectorAll("rect.gap").length === 2')
        yield page
        assert page.wrong == []  # type: ignore[attr-defined]
        page.close()


def shown(page: Page) -> tuple[int, int, int]:
    """Start and end of the timeline and the selected time, in ms after noon."""
    slider = page.locator('svg[role=slider]')
    begin, end, now = (int(slider.get_attribute(f'aria-value{name}') or 0) - NOON_MS for name in ('min', 'max', 'now'))
    return begin, end, now


def at(page: Page, ms: float) -> tuple[float, float]:
    """The position of a time on the screen, on the last row of the timeline."""
    begin, end, _ = shown(page)
    page.locator('svg[role=slider]').scroll_into_view_if_needed()
    box = page.locator('svg[role=slider]').bounding_box()
    assert box is not None
    return box['x'] + 150 + (ms - begin) / (end - begin) * (box['width'] - 158), box['y'] + box['height'] - 40


def dragged(page: Page, first_ms: float, last_ms: float, key: str = '') -> None:
    ends = at(page, first_ms), at(page, last_ms)
    if key:
        page.keyboard.down(key)
    page.mouse.move(*ends[0])
    page.mouse.down()
    page.mouse.move(*ends[1], steps=4)
    page.mouse.up()
    if key:
        page.keyboard.up(key)


def moment_is(page: Page, ms: int) -> None:
    holds(page, f'Math.abs(Number(document.querySelector("[data-moment]").dataset.moment) - {NOON_MS + ms}) < 300')


@in_chromium
def test_the_timeline_opens_at_the_data_and_zooms_and_pans(page: Page) -> None:
    """30 s are more than a line in a day; wheel, drag, keys and buttons change the visible range, around the pointer."""
    begin, end, _ = shown(page)
    assert -2000 <= begin < 0
    assert 19_000 < end < 27_000
    page.mouse.move(*at(page, 5000))
    page.mouse.wheel(0, -240)
    slider = "document.querySelector('svg[role=slider]')"
    holds(page, f'{slider}.ariaValueMax - {slider}.ariaValueMin < {(end - begin) * 0.7}')
    first, last, _ = shown(page)
    assert (5000 - first) / (last - first) == pytest.approx((5000 - begin) / (end - begin), abs=0.02)
    dragged(page, 5000, 3000)
    holds(page, f'{slider}.ariaValueMin - {NOON_MS + first} > 1500')
    moved, moved_end, _ = shown(page)
    assert moved - first == pytest.approx(2000, abs=100)
    assert moved_end - moved == pytest.approx(last - first, abs=2)
    page.locator('svg[role=slider]').focus()
    page.keyboard.press('-')
    holds(page, f'{slider}.ariaValueMax - {slider}.ariaValueMin > {(last - first) * 1.9}')
    page.set_viewport_size({'width': 390, 'height': 800})
    page.keyboard.press('-')
    holds(page, f'{slider}.ariaValueMax - {slider}.ariaValueMin > {(last - first) * 3.8}')
    apart = 'boxes.length > 1 && boxes.every((box, place) => !place || boxes[place - 1].right < box.left)'
    holds(page, f'(boxes => {apart})([...document.querySelectorAll(".tick-label")].map(label => label.getBoundingClientRect()))')
    press(page.get_by_role('button', name='Fit', exact=True))
    holds(
        page,
        f'Math.abs({slider}.ariaValueMin - {NOON_MS + begin}) < 50 && Math.abs({slider}.ariaValueMax - {NOON_MS + end}) < 50',
    )


@in_chromium
def test_a_gap_is_drawn_and_described(page: Page) -> None:
    """A click selects the last message before it: what was lost, why, the remedy; jumps do too; hostile causes are text."""
    gap = page.locator('rect.gap[data-topic="/imu"]').bounding_box()
    assert gap is not None
    page.mouse.click(gap['x'] + gap['width'] / 2, gap['y'] + 4)
    moment_is(page, 3000)
    words = page.locator('[data-gap=transport]').inner_text()
    assert '/imu: 5 messages did not reach the node, 12:00:03 to 12:00:04 UTC (1.0 s).' in words.replace('\n', ' ')
    assert 'Why: Lost on the way to the node' in words
    assert 'net.core.rmem_max' in words
    press(page.get_by_role('button', name='Next gap'))
    moment_is(page, 6000)
    assert HOSTILE in page.locator('.chosen').first.inner_text()
    press(page.get_by_role('button', name='Next event'))
    moment_is(page, 20_000)
    press(page.get_by_role('button', name='Next event'))
    page.get_by_text('There is no later event within 24 hours.').wait_for()
    press(page.get_by_role('button', name='Previous gap'))
    moment_is(page, 6000)
    page.locator('svg[role=slider]').focus()
    page.keyboard.press('p')
    moment_is(page, 3000)
    assert page.evaluate('window.attacked ?? null') is None


@in_chromium
@pytest.mark.parametrize(
    ('steps_s', 'breaks'),
    [
        ([0.2] * 5 + [3.0] + [0.2] * 5, [6]), ([1.0] * 5 + [0.2] * 9, []), ([1.0] * 5 + [0.2] * 5 + [1.0] + [0.2] * 4, [11]),
        ([0.2] * 4 + [3.0, 3.0] + [0.2] * 4, [5, 6]), ([3.0] + [0.1] * 5, [1]), ([0.1] * 5 + [3.0], [6]), ([3.0], []),
    ],
)  # fmt: skip
def test_a_line_breaks_where_data_is_missing(page: Page, steps_s: list[float], breaks: list[int]) -> None:
    """Not where messages of objects, one per second, are followed by those of a bag."""
    found = page.evaluate(
        """async (steps) => {
            const { Ring } = await import('/plots.js');
            const ring = new Ring(60);
            ring.names = ['x'];
            ring.columns = [steps.reduce((times, step) => [...times, times.at(-1) + step], [0])];
            return ring.breaks();
        }""",
        steps_s,
    )
    assert found == breaks


@in_chromium
def test_a_selection_offers_its_commands_and_a_piece_of_the_bag(page: Page, tmp_path: Path) -> None:
    """By shift and drag, and by keys; the cut is an MCAP file with the messages of that time, which other viewers can open."""
    dragged(page, 2000, 21_500, 'Shift')
    holds(page, 'document.querySelector("[data-selected]") !== null')
    begin, end = (int(each) - NOON_MS for each in (page.locator('[data-selected]').get_attribute('data-selected') or '').split())
    assert abs(begin - 2000) < 200
    assert abs(end - 21_500) < 200
    holds(page, '["query", "fetch", "bag cut", "export"].every(name => document.querySelector(`[data-command="${name}"]`))')
    since = f'{utc(NOON_NS + begin * 1_000_000):%Y-%m-%dT%H:%M:%S}'
    assert f'--since {since}' in page.locator('[data-command=query]').inner_text()
    press(page.locator(f'[data-cut="{BAG}"]'))
    page.locator('[data-piece]').wait_for()
    assert 'of the 20 s: the rest is not in the closed files of the bag' in page.locator('.download').inner_text()
    with page.expect_download() as download:
        page.locator('[data-piece]').evaluate('link => link.click()')
    download.value.save_as(tmp_path / 'piece.mcap')
    index = read_index(LocalFile(tmp_path / 'piece.mcap'))
    assert {channel.topic for channel in index.channels.values()} == {'/bagged', '/imu'}
    assert NOON_NS + 20 * SECOND <= index.t_start_ns <= index.t_end_ns < NOON_NS + (end + 1) * 1_000_000
    address = page.evaluate('document.querySelector("[data-piece]").href')
    elsewhere = page.context.browser.new_context().request if page.context.browser is not None else page.request
    part = elsewhere.get(address, headers={'Range': 'bytes=0-7', 'Origin': 'https://app.foxglove.dev'})
    assert (part.status, part.body()[:5], part.headers['access-control-allow-origin']) == (206, b'\x89MCAP', '*')
    assert elsewhere.get(address.replace('.mcap', 'x.mcap')).status == 404
    assert address in page.evaluate('decodeURIComponent(document.querySelector("[data-viewer=Foxglove]").href)')
    for width in (1280, 390):
        fits(page, width)
    page.set_viewport_size({'width': 1280, 'height': 800})
    page.locator('svg[role=slider]').focus()
    page.keyboard.press('Escape')
    holds(page, 'document.querySelector("[data-selected]") === null')
    for key in ('[', 'ArrowRight', 'ArrowRight', 'ArrowRight', ']'):
        page.keyboard.press(key)
    length = '(([from, to]) => to - from)((document.querySelector("[data-selected]")?.dataset.selected ?? "0 0").split(" "))'
    holds(page, f'{length} === 3000')


@in_chromium
def test_losses_are_shown_until_acknowledged(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the last day, or since the acknowledgment, which this browser stores; the row of the topic is no longer an alarm."""
    now_ms = time.time() * 1e3
    columns = ['sink', 'topic', 'kind', 'cause', 'from', 'to', 'count', 'grade']
    gaps = [['objects', '/imu', 'missed', 'restart', now_ms - 600_000, now_ms - 590_000, 12, 'exact'],
            ['bags', '/imu', 'missed', 'restart', now_ms - 600_000, now_ms - 590_000, 12, 'exact']]  # fmt: skip
    fields = {'from': now_ms - 3.6e6, 'to': now_ms, 'now': now_ms, 'columns': columns, 'gaps': gaps, 'known': []}
    row = {'topic': '/imu', 'type': IMU, 'sensor': 'imu', 'missed': 12, 'missed_estimated': None, 'unavailable': '', 'lost': 0,
           'rate_hz': 50.0, 'age_s': 0.01, 'publishers': 1, 'may_be_silent': False, 'received': 99, 'stored': 99}  # fmt: skip
    figures = {'robot': 'thor', 'state': 'running', 'age_s': 0.1, 'paused': False, 'queue': {}, 'findings': [], 'balanced': True,
               'spool': {}, 'store': {}, 'objects': {}, 'bytes': {}, 'topics': [row]}  # fmt: skip
    with Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0), monkeypatch) as served:
        monkeypatch.setattr(served.server._figures, 'now', lambda **_: figures)
        monkeypatch.setattr(served.server._figures, 'gaps', lambda *_: fields)
        page = opened(browser, served.server.url)
        holds(page, 'document.querySelector("[data-losses]")?.dataset.losses === "12"')
        assert 'The node was not running' in page.locator('[data-losses]').inner_text()
        lossy = 'document.querySelectorAll(\'td[data-topic="/imu"].lossy\').length'
        holds(page, f'{lossy} === 1')
        press(page.get_by_role('button', name='I have seen them'))
        holds(page, 'document.querySelector("[data-losses]").dataset.losses === "0"')
        holds(page, f'{lossy} === 0')
        page.reload()
        holds(page, 'document.querySelector("[data-losses]")?.dataset.losses === "0"')
        assert page.wrong == []  # type: ignore[attr-defined]
        page.close()


@in_chromium
def test_the_live_view_begins_with_what_was_recorded(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots and path of the time before the page was opened, from the spool, though no messages arrive now."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    spool = new_spool(tmp_path / 'spool', FakeClock())
    spool.open()
    now_ns = time.time_ns()
    try:
        for second in range(20):
            at_ns = now_ns - (20 - second) * SECOND
            vector, turn = {'x': 1.0, 'y': 2.0, 'z': 9.5}, {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
            unknown = {f'{each}_covariance': [0.0] * 9 for each in ('orientation', 'angular_velocity', 'linear_acceleration')}
            sample = {
                'stamp_ns': at_ns,
                'orientation': turn,
                'angular_velocity': vector,
                'linear_acceleration': vector,
                **unknown,
            }
            metadata = {'received_start_ns': str(at_ns), 'received_end_ns': str(at_ns), 'pose': f'{second}.0 1.0 0.5 odom'}
            body = json.dumps({'type': IMU, 'samples': [sample]}).encode()
            put(spool, make(f'thor/imu/{utc(at_ns):%Y%m%d/%H%M%S}_imu.json', body, sensor='imu', topic='/imu', type=IMU,
                            t_start_ns=at_ns, t_end_ns=at_ns, metadata=metadata))  # fmt: skip
    finally:
        spool.close()
    with Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0), monkeypatch) as served:
        served.loop.call_soon_threadsafe(served.server.viewers.on_graph, {'/imu': (IMU, 1)})
        page = opened(browser, served.server.url)
        holds(page, 'window.shadowhound?.prefilled >= 2')
        shown = '[...document.querySelectorAll("section[aria-label=Acceleration] .legend b")].map(one => one.textContent)[2]'
        holds(page, f'{shown} === "9.5"')
        assert page.wrong == []  # type: ignore[attr-defined]
        page.close()


BLINDNESS = {
    'protan': ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    'deutan': ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    'tritan': ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
}
"""Linear RGB as seen with this deficiency: Machado, Oliveira and Fernandes (2009), severity 1."""


def seen(color: str, kind: str) -> Any:
    """A computed color in CIE Lab."""
    linear = np.array([(part / 255 + 0.055) ** 2.4 / 1.055**2.4 if part > 10 else part / 255 / 12.92 for part in rgb(color)])
    linear = np.clip(np.array(BLINDNESS[kind]) @ linear if kind else linear, 0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear / (0.9505, 1, 1.089)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_each_cause_of_a_gap_has_its_own_color(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hue and pattern, on the timeline as in the legend, also for a server's causes; most hues differ for the color-blind too."""
    causes = sorted({*CAUSES, 'unknown', 'EntityTooLarge', 'InvalidObjectState'})
    now_ms = time.time() * 1e3
    columns = ['sink', 'topic', 'kind', 'cause', 'from', 'to', 'count', 'grade']
    rows = [['objects', '/imu', 'missed', cause, now_ms - 3e6 + 7e4 * place, now_ms - 3e6 + 7e4 * place + 3e4, 5, 'exact']
            for place, cause in enumerate(causes)]  # fmt: skip
    gaps = {'from': now_ms - 3.6e6, 'to': now_ms, 'now': now_ms, 'columns': columns, 'gaps': rows, 'known': []}
    looks = """all => all.map((rect) => {
        const fill = getComputedStyle(rect).fill, pattern = fill.match(/#([^")]+)/)?.[1];
        if (!pattern) return [fill, '', ''];
        const [hue, mark] = document.getElementById(pattern).children;
        return [getComputedStyle(hue).fill, mark.getAttribute('d'), getComputedStyle(mark).fill];
    })"""
    with Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0), monkeypatch) as served:
        monkeypatch.setattr(served.server._figures, 'gaps', lambda *_: gaps)
        page = opened(browser, served.server.url)
        holds(page, f'document.querySelectorAll("rect.gap").length === {len(causes)}')
        assert page.locator('rect.gap').evaluate_all('all => all.map(rect => rect.dataset.cause)') == causes
        for scheme in ('light', 'dark'):
            page.emulate_media(color_scheme=scheme)
            drawn = [tuple(poll) for poll in page.locator('rect.gap').evaluate_all(looks)]
            assert len(set(drawn)) == len(causes)
            assert all(hue.startswith('rgb(') and mark in {'', page_rgb(page, '--panel')} for hue, _, mark in drawn)
            swatches = page.locator('.legend svg[data-swatch] rect')
            assert [tuple(poll) for poll in swatches.evaluate_all(looks)] == drawn
            hues = sorted({hue for hue, _, _ in drawn})
            for kind in ('', *BLINDNESS):
                apart = {(one, other): float(np.linalg.norm(seen(one, kind) - seen(other, kind)))
                         for one in hues for other in hues if one < other}  # fmt: skip
                assert min(apart.values()) > APART, (scheme, kind, min(apart, key=lambda pair: apart[pair]), min(apart.values()))
        assert page.wrong == []
        page.close()


APART = 20.0
"""The distance between two hues, in CIE Lab: the smallest noticeable one is 2.3."""


def page_rgb(page: Page, name: str) -> str:
    """The computed value of a color of the style sheet."""
    script = """name => {
        const probe = document.body.appendChild(document.createElement('i'));
        probe.style.color = `var(${name})`;
        const found = getComputedStyle(probe).color;
        probe.remove();
        return found;
    }"""
    return str(page.evaluate(script, name))
