"""The page of a store with an unreachable S3 server, in a real Chromium with a real SeaweedFS."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from e2e.machines import ROBOT, Machines
from e2e.processes import until
from live.browsing import CHROMIUM, FLAGS, IMU, Served, counted, holds, most_of, opened, press
from live.test_history import patrol
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.live import server as server_module
from shadowhound_data_logger.live.access import make_tokens
from shadowhound_data_logger.live.kinds import KINDS, LiveItem, table_item
from shadowhound_data_logger.live.server import LiveSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.mark.seaweedfs
@pytest.mark.long('a Chromium and an S3 server')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_the_page_survives_an_outage_of_the_store(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reports what cannot be reached, keeps its contents, and continues without a reload once the server responds again."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    with Tower(tmp_path / 'tower') as tower:
        for name, value in tower.environment().items():
            monkeypatch.setenv(name, value)
        with closing(open_store(tower.store_settings(), UploadSettings())) as store:
            patrol(store, tmp_path)
        with Served(
            LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True), monkeypatch
        ) as served:
            page = opened(browser, served.server.url)
            holds(page, 'document.querySelectorAll("rect.recorded").length > 1 && shadowhound.past?.shown.length > 1')
            page.evaluate('window.same = true')
            frames = page.evaluate('shadowhound.past.count')
            tower.stop_s3()
            served.run(served.server.past.history._end())  # data already read would be enough for a while
            press(page.get_by_role('button', name='10 seconds back'))
            page.locator('.timeline [role=alert]').first.wait_for()
            text = page.locator('.timeline [role=alert]').first.inner_text()
            assert tower.endpoint_url in text
            assert page.evaluate('document.querySelectorAll("rect.recorded").length') > 1
            tower.start_s3()
            press(page.get_by_role('button', name='1 second on'))
            holds(page, f'shadowhound.past.count > {frames}')
            holds(page, 'document.querySelectorAll(".timeline [role=alert]").length === 0')
            assert page.evaluate('window.same')
            page.close()


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_the_page_reconnects_after_an_outage(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a silent outage of the link: the page continues within 2 s, without a reload.

    The ages that it shows in between are within 200 ms of the truth: when the publisher sent the message shown.
    """
    sent_s: list[float] = []

    def numbered() -> list[LiveItem]:
        """A message with its number as roll, in degrees."""
        sent_s.append(time.monotonic())
        return [table_item('/imu', KINDS[IMU], [(sent_s[-1] * 1e3, {'rpy.x': math.radians(len(sent_s) - 1)})])]

    with ExitStack() as stack:
        machines = Machines(stack)
        listener = machines.listener()
        listener.setblocking(False)
        monkeypatch.setattr(server_module, '_listener', lambda *_: listener)
        served = Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', bind=ROBOT), monkeypatch)
        stack.callback(served.close)
        served.loop.call_soon_threadsafe(served.server.viewers.on_graph, {'/imu': (IMU, 1)})
        stack.callback(served.every(0.03, numbered))
        program = machines.program(str(CHROMIUM), tmp_path)
        elsewhere = stack.enter_context(closing(browser.browser_type.launch(executable_path=program, args=FLAGS)))
        page = opened(elsewhere, served.server.url)
        tried: list[str] = []
        page.on('websocket', lambda socket: tried.append(socket.url))
        page.locator('input[name=token]').fill((tmp_path / 'live' / 'viewer.token').read_text().strip())
        press(page.locator('button.primary'))
        holds(page, 'shadowhound.count.imu > 20')
        page.evaluate('window.same = true')
        machines.cut()
        cut_s = time.monotonic()
        shown: list[tuple[float, float, float]] = []
        while time.monotonic() < cut_s + 10:
            before_s = time.monotonic()
            age_ms = page.evaluate("Number(document.querySelector('[data-age=imu]').dataset.ms)")
            shown.append((before_s, time.monotonic(), age_ms / 1e3))
        number = int(float(page.locator('section[aria-label=Attitude] .legend b').first.inner_text()))
        assert cut_s - 1.5 < sent_s[number] <= cut_s  # the last one that arrived
        at_s = sent_s[number]
        wrong_s = [max(before_s - at_s - age_s, age_s - (after_s - at_s)) for before_s, after_s, age_s in shown]
        print(f'ages differ by at most {most_of(wrong_s) * 1e3:.0f} ms from the truth, in {len(wrong_s)} looks')  # noqa: T201 - a measurement
        assert most_of(wrong_s) <= 0.2
        assert len(tried) > 3  # it does not wait for a connection that TCP still retries
        count = counted(page, 'imu')
        machines.mend()
        mended_s = time.monotonic()
        holds(page, f'shadowhound.count.imu > {count}')
        print(f'it continued after {time.monotonic() - mended_s:.2f} s')  # noqa: T201 - a measurement
        assert time.monotonic() - mended_s <= 2.0
        assert page.evaluate('window.same')


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_a_sign_in_that_has_ended_asks_for_the_token(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An open page reports it and stops connecting; with the new token it continues, without a reload."""
    settings = LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', bind='0.0.0.0', port=0)
    with Served(settings, monkeypatch) as served:
        page = opened(browser, f'http://127.0.0.1:{served.server.port}/')
        tried: list[str] = []
        page.on('websocket', lambda socket: tried.append(socket.url))

        def sign_in() -> None:
            page.locator('input[name=token]').fill((tmp_path / 'live' / 'viewer.token').read_text().strip())
            press(page.locator('button.primary'))

        sign_in()
        holds(page, 'shadowhound.count.figures > 0')
        page.evaluate('window.same = true')
        make_tokens(tmp_path / 'live', replace=True)
        page.get_by_text('Your sign-in has ended.').wait_for()
        before = len(tried)
        page.wait_for_timeout(4000)  # it would have tried three times by then
        assert len(tried) == before
        count = counted(page, 'figures')
        sign_in()
        holds(page, f'shadowhound.count.figures > {count}')
        assert page.evaluate('window.same')
        assert len(tried) > before
        page.close()


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_a_viewer_becomes_an_operator(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The previous sign-in ends along with its connection; the page continues with the new one, without a reload."""
    monkeypatch.setattr(server_module, 'CHECK_S', 0.2)
    settings = LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', bind='0.0.0.0', port=0)
    with Served(settings, monkeypatch) as served:
        page = opened(browser, f'http://127.0.0.1:{served.server.port}/')
        page.locator('input[name=token]').fill((tmp_path / 'live' / 'viewer.token').read_text().strip())
        press(page.locator('button.primary'))
        holds(page, 'shadowhound.count.figures > 0')
        page.evaluate('window.same = true')
        (viewer,) = served.server.viewers.connected
        press(page.get_by_role('button', name='Sign in as operator'))
        page.locator('dialog input[name=token]').fill((tmp_path / 'live' / 'operator.token').read_text().strip())
        press(page.locator('dialog button.primary'))
        page.locator('[data-act=flush]').wait_for()
        until(lambda: [one.who.role for one in served.server.viewers.connected] == ['operator'], 'the connection of the operator')
        assert viewer not in served.server.viewers.connected
        count = counted(page, 'figures')
        holds(page, f'shadowhound.count.figures > {count}')
        assert page.evaluate('window.same')
        page.close()


@pytest.mark.ros
@pytest.mark.long('a Chromium, a robot and a node')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_where_everybody_may_watch_an_operator_becomes_a_viewer(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once the sign-in has ended, the page has no operator buttons any more, and continues."""
    with Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0), monkeypatch) as served:
        page = opened(browser, served.server.url)
        press(page.get_by_role('button', name='Sign in', exact=True))
        page.locator('dialog input[name=token]').fill((tmp_path / 'live' / 'operator.token').read_text().strip())
        press(page.locator('dialog button.primary'))
        page.locator('[data-act=flush]').wait_for()
        page.reload()  # with the cookie that identifies the connection
        page.locator('[data-act=flush]').wait_for()
        make_tokens(tmp_path / 'live', replace=True)
        page.locator('[data-act=flush]').wait_for(state='detached')
        count = counted(page, 'figures')
        holds(page, f'shadowhound.count.figures > {count}')
        page.close()
