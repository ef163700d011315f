"""The page can be understood without the documentation: each value has its definition, also on a phone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from e2e.processes import until
from lake.test_pull import Field
from live.browsing import CHROMIUM, HOSTILE, IMU, LONG, NAMES, Served, fits, holds, opened, press, told_of_names
from live.test_fleet import store_of
from spool.test_status import written

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.live.kinds import KINDS, LiveItem, table_item
from shadowhound_data_logger.live.server import LiveSettings

if TYPE_CHECKING:
    from playwright.sync_api import Browser, CDPSession, Page

FIGURES = (
    'main :is([data-field], dd, td.n, td.figure, .big, .legend b, [data-value], [data-offer], [role=meter],'
    ' h2, h3, h4, th, .row-name)'
)
UNDEFINED = f"""[...document.querySelectorAll('{FIGURES}')].filter((each) => !each.closest('.list .rows, .gaps-table td, .tree')
    && !(each.closest('[title]')?.title.length > 8)).map((each) => each.outerHTML.slice(0, 120))"""
FIX, BATTERY = 'sensor_msgs/msg/NavSatFix', 'go2_interfaces/msg/LowState'


def values() -> list[LiveItem]:
    """A row of each kind of plot."""
    now_ms = time.monotonic() * 1e3
    rows = {
        '/imu': (IMU, {'rpy.x': 0.1, 'accel.x': 1.0}), '/lowstate': (BATTERY, {'battery': 70.0, 'volts': 29.0, 'body': 40.0}),
        '/fix': (FIX, {'lat': 47.0, 'lat_rest': 0.0, 'lon': 8.0, 'lon_rest': 0.0, 'altitude': 1.0, 'status': 0.0, 'error': 1.0}),
    }  # fmt: skip
    return [table_item(topic, KINDS[kind], [(now_ms, row)]) for topic, (kind, row) in rows.items()]


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    """The page of a robot with every value."""
    with ExitStack() as stack:
        settings = LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0)
        served = Served(settings, monkeypatch)
        stack.callback(served.close)
        figures, gaps = told_of_names(time.time() * 1e3)
        figures['store'] |= {'waits_for': {'upload.when': 'wifi.ssid == "lab"'}}
        monkeypatch.setattr(served.server._figures, 'now', lambda **_: figures)
        monkeypatch.setattr(served.server._figures, 'gaps', lambda *_: gaps)
        graph = {'/imu': (IMU, 1), '/fix': (FIX, 1), '/lowstate': (BATTERY, 1)}
        served.loop.call_soon_threadsafe(served.server.viewers.on_graph, graph)
        stack.callback(served.every(0.1, values))
        yield served


def undefined(page: Page) -> list[str]:
    return list(page.evaluate(UNDEFINED))


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_every_figure_of_the_live_page_has_a_definition(browser: Browser, robot: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the tooltip of the value, or of its container; so has each title of a panel, head of a column and card."""

    async def doctor(*_: Any) -> dict[str, Any]:
        return {'doctor': {'results': []}}

    monkeypatch.setattr('shadowhound_data_logger.live.acts._doctor', doctor)
    page = opened(browser, robot.server.url)
    holds(page, 'shadowhound.count.fix > 3 && document.querySelectorAll("[data-field=policy]").length === 1')
    page.locator('.menu input').evaluate_all('all => { for (const one of all) if (!one.checked) one.click(); }')
    holds(page, 'document.querySelectorAll(".views h3").length === document.querySelectorAll(".menu input").length + 1')
    press(page.get_by_role('button', name='Run the doctor'))
    page.locator('.doctor h4').wait_for()
    assert page.locator('.gaps-table th').count() == 6
    assert page.evaluate(f"document.querySelectorAll('{FIGURES}').length") > 60
    assert undefined(page) == []
    page.close()


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_every_figure_of_the_past_has_a_definition(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a store: the table of robots, and the data kept by a robot."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(Field(tmp_path)) as field:
        field.records(*range(20))
        store_of(tmp_path, time.time_ns() - 10 * SECOND)
        settings = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
        with Served(settings, monkeypatch) as served:
            page = opened(browser, served.server.url)
            holds(page, 'document.querySelectorAll("tr[data-robot]:not([data-state=unknown])").length === 4')
            page.get_by_label('Of which time').select_option('range')
            holds(page, '["query", "fetch"].every(name => document.querySelector(`[data-command=${name}]`))')
            assert page.locator('.fleet th, .commands .row-name, .pull h3').count() > 7
            assert undefined(page) == []
            page.close()


def touch(session: CDPSession, kind: str, *points: tuple[float, float]) -> None:
    """Real touch events: the page's script is not called directly."""
    given: list[Any] = [{'x': x, 'y': y, 'id': number} for number, (x, y) in enumerate(points)]
    session.send('Input.dispatchTouchEvent', {'type': kind, 'touchPoints': given})


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_on_a_phone_the_important_parts_come_first(browser: Browser, robot: Served) -> None:
    """The save button, the state and the camera are in view first; a tap on a value shows its definition.

    One finger on the 3D view scrolls the page; two turn the view and do not scroll. The page can be installed.
    """
    context = browser.new_context(viewport={'width': 390, 'height': 844}, has_touch=True, is_mobile=True, reduced_motion='reduce')
    page = context.new_page()
    page.goto(robot.server.url)
    holds(page, 'shadowhound.count.fix > 3')
    bottoms = [page.locator(each).first.bounding_box() for each in ('[data-glance=save]', '.glance a', 'section.camera')]
    assert all(box is not None and box['y'] + box['height'] <= 844 for box in bottoms), bottoms
    assert bottoms[0]['y'] < bottoms[1]['y'] < bottoms[2]['y']  # type: ignore[index]
    page.locator('[data-field=free]').scroll_into_view_if_needed()
    page.locator('[data-field=free]').tap()
    assert page.locator('.hint').inner_text() == 'Free space on the disk that the spool is on'
    page.locator('[data-field=free]').tap()
    assert page.locator('.hint').count() == 0
    page.evaluate('document.querySelector(".cloud").scrollIntoView({block: "center", behavior: "instant"})')
    holds(page, 'document.querySelector(".cloud canvas").style.touchAction === "pan-y"')
    box = page.locator('.cloud canvas').bounding_box()
    assert box is not None
    x, y = box['x'] + box['width'] / 2, box['y'] + box['height'] / 2
    session = context.new_cdp_session(page)
    where, view = 'scrollY', 'JSON.stringify(shadowhound.view())'
    before = page.evaluate(f'[{where}, {view}]')
    touch(session, 'touchStart', (x, y))
    for step in range(1, 8):
        touch(session, 'touchMove', (x, y - 15 * step))
    touch(session, 'touchEnd')
    holds(page, f'{where} > {before[0] + 50}')
    assert page.evaluate(view) == before[1]
    page.evaluate('document.querySelector(".cloud").scrollIntoView({block: "center", behavior: "instant"})')
    scrolled = page.evaluate(where)
    touch(session, 'touchStart', (x - 30, y), (x + 30, y))
    for step in range(1, 8):
        touch(session, 'touchMove', (x - 30 + 12 * step, y), (x + 30 + 12 * step, y))
    touch(session, 'touchEnd')
    holds(page, f'{view} !== {before[1]!r}')
    assert page.evaluate(where) == scrolled
    errors = session.send('Page.getInstallabilityErrors')['installabilityErrors']
    assert [each['errorId'] for each in errors if each['errorId'] != 'in-incognito'] == []
    context.close()


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_an_unfinished_check_is_not_an_error(browser: Browser, robot: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the doctor found neither problems nor their absence; its errors are marked as such."""
    found = [
        {'check': 's3.deadline', 'severity': 'error', 'seen': 'the check did not end within 20 s', 'cause': '', 'remedy': ''},
        {'check': 'disk.space', 'severity': 'error', 'seen': 'the disk is full', 'cause': '', 'remedy': 'free some'},
    ]

    async def doctor(*_: Any) -> dict[str, Any]:
        return {'doctor': {'results': found}}

    monkeypatch.setattr('shadowhound_data_logger.live.acts._doctor', doctor)
    page = opened(browser, robot.server.url)
    press(page.get_by_role('button', name='Run the doctor'))
    page.locator('.doctor li').first.wait_for()
    marks = page.locator('.doctor .mark').evaluate_all('all => all.map((one) => one.className)')
    assert marks == ['mark watch', 'mark bad']
    assert page.locator('.doctor li').first.inner_text().endswith('Not known (s3): the check did not end within 20 s')
    page.close()


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_names_are_text_and_fit(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names, reasons and responses with code or without spaces: none of it runs, and it fits on a phone."""
    settings = LiveSettings(spool=tmp_path / 'spool', robot=LONG[:60], tokens=tmp_path / 'live', port=0)
    with Served(settings, monkeypatch) as served:
        figures, gaps = told_of_names(time.time() * 1e3)
        monkeypatch.setattr(served.server._figures, 'now', lambda **_: figures)
        monkeypatch.setattr(served.server._figures, 'gaps', lambda *_: gaps)
        monkeypatch.setattr(served.server.acts, '_ask', lambda *_: {'ok': True, 'message': HOSTILE + LONG})
        graph = {f'/{name}/{place}': ('sensor_msgs/msg/Imu', 1) for name in NAMES for place in (1, 2)}
        served.loop.call_soon_threadsafe(served.server.viewers.on_graph, graph)
        page = opened(browser, served.server.url)
        press(page.get_by_role('button', name='Sign in', exact=True))
        page.locator('dialog input[name=token]').fill((tmp_path / 'live' / 'operator.token').read_text().strip())
        press(page.locator('dialog button.primary'))
        press(page.locator('[data-act=flush]'))
        holds(page, 'document.querySelectorAll(".answers li, rect.gap, .findings li").length >= 5')
        page.evaluate('document.querySelector("rect.gap").dispatchEvent(new PointerEvent("pointerenter"))')
        page.evaluate('document.querySelectorAll("details").forEach(each => { each.open = true; })')
        page.locator('.chosen').wait_for()
        for width in (1440, 1000, 390, 320):
            fits(page, width)
        assert HOSTILE in page.locator('body').inner_text()
        assert page.evaluate('[window.attacked ?? null, document.querySelectorAll("img[src=x]").length]') == [None, 0]
        assert page.wrong == []
        page.close()


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_waiting_uploads_name_their_rule_and_duration(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the node's status: the rule and why it does not hold, or when everything will have arrived."""
    spool, clock = tmp_path / 'spool', SystemClock.of_this_machine()
    served = Served(LiveSettings(spool=spool, robot='thor', tokens=tmp_path / 'live', port=0), monkeypatch)
    fields: dict[str, Any] = {'state': 'waiting', 'waits_for': {'upload.when': 'wifi.ssid == "lab": it is "cafe"'}}

    def shows() -> list[str]:
        """The text of the page, for a running node."""
        written(spool, boot_id=clock.boot_id, boot_ns=clock.boot_ns(), spool={'pending': 7}, store=fields)
        texts: list[str] = page.locator('[data-field=waits-for], [data-field=left]').all_inner_texts()
        return texts

    try:
        page = opened(browser, served.server.url)
        reports = ['waits for wifi.ssid == "lab": it is "cafe"', 'once a rule holds']
        until(lambda: shows() == reports, lambda: f'the rule is shown: {shows()}')
        fields |= {'state': 'shipping', 'mbps': 2.0, 'left_s': 754, 'waits_for': {}}
        until(lambda: shows() == ['13 min'], lambda: f'the time is shown: {shows()}')
        page.close()
    finally:
        served.close()
