"""The page of a robot other than a Go2, in a real Chromium: everything it publishes is shown, without any settings."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from e2e.processes import Process, Processes, until
from lake.making import folder_store
from live.browsing import CHROMIUM, Served, fits, holds, in_own_domain, opened, press
from live.page.any_robot import DESCRIPTION, HOSTILE, LATITUDE, LONGITUDE
from live.test_history import patrol
from live.test_kinds import cdr
from live.test_panels import TYPES, transforms

from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.live.kinds import KINDS, LiveItem, table_item
from shadowhound_data_logger.live.panels import panel_of
from shadowhound_data_logger.live.server import LiveSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long('a Chromium and a robot'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]
PROGRAM = Path(__file__).with_name('any_robot.py')
MORE = 510
"""Additional topics, first in alphabetical order."""
TF, FIX = 'tf2_msgs/msg/TFMessage', 'sensor_msgs/msg/NavSatFix'


class Watching:
    """A robot, a node and their page."""

    def __init__(self, processes: Processes) -> None:
        self.processes = processes
        robot = Process('robot', [str(PROGRAM), str(MORE)], processes.folder / 'robot.log', processes.environ)
        processes.started.append(robot)
        robot.await_log('ready')
        self.node = processes.node(parameters={'capture.topics': 'sensors'})
        self.live, self.url = processes.page(self.node)


@pytest.fixture(scope='module')
def watching(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watching]:
    pytest.importorskip('rclpy')
    with in_own_domain(tmp_path_factory.mktemp('any')) as started:
        yield Watching(started)


@pytest.fixture(scope='module')
def page(watching: Watching, browser: Browser) -> Page:
    return opened(browser, watching.url)


def text(page: Page, selector: str) -> str:
    return str(page.locator(selector).first.inner_text())


def inspect(page: Page, topic: str) -> None:
    """Show its newest message, or stop; it is found by its name."""
    page.get_by_label('Search topics and types').fill(topic)
    press(page.locator(f'[data-inspect="{topic}"]'))


@contextmanager
def observer(watching: Watching) -> Iterator[Callable[[], set[str]]]:
    """Yields a function that returns the topics to which the page subscribes, once it has subscribed to any."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=int(watching.processes.environ['ROS_DOMAIN_ID']))
    node = rclpy.create_node('observer', context=context, start_parameter_services=False, enable_rosout=False)

    def read() -> set[str]:
        with suppress(RuntimeError):  # the page is not visible yet
            return {topic for topic, _ in node.get_subscriber_names_and_types_by_node('shadowhound_live', '/')}
        return set()

    try:
        until(lambda: '/scan' in read(), 'the page is seen')
        yield read
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_each_standard_type_has_its_panel(page: Page) -> None:
    """Scan, map, model, GPS, diagnostics and log appear, in addition to camera and plots; there are no errors in the browser."""
    for kind in ('camera', 'scan', 'map', 'model', 'odom', 'imu', 'joints', 'battery', 'fix', 'diagnostics', 'rosout'):
        holds(page, f'(shadowhound.count[{json.dumps(kind)}] ?? 0) > 0')
    panels = page.locator('section.view').evaluate_all('all => all.map(one => one.ariaLabel)')
    assert panels == ['Camera', '3D view', 'Path', 'GPS', 'Attitude', 'Acceleration', 'Joints', 'Battery', 'Temperature',
                      'Diagnostics', 'Log']  # fmt: skip
    assert page.evaluate('shadowhound.wrong') == 0
    assert page.wrong == []  # type: ignore[attr-defined]


def test_gps_is_exact(page: Page) -> None:
    """Within the circle that the robot drives, to 0.1 m."""
    holds(page, 'document.querySelector("[data-field=lat]")?.textContent.length > 9')
    latitude, longitude = (float(text(page, f'[data-field={name}]')) for name in ('lat', 'lon'))
    assert abs(((latitude - LATITUDE) / 9e-6 / 2) ** 2 + ((longitude - LONGITUDE) / 1.3e-5 / 3) ** 2 - 1) < 0.1


def test_missing_parts_of_the_model_are_named(page: Page) -> None:
    """Its meshes are files on the robot."""
    until(lambda: 'meshes are files on the robot' in ' '.join(page.locator('[data-note]').all_inner_texts()), 'the note')


def test_texts_of_the_robot_are_text(page: Page) -> None:
    """In diagnostics, in the log and in a message."""
    until(lambda: HOSTILE in text(page, '[data-list=diagnostics]'), 'the diagnostics')
    until(lambda: HOSTILE in text(page, '[data-list=rosout]'), 'the log')
    names = page.locator('[data-list=diagnostics] summary b').all_inner_texts()
    assert names.index('motor') < names.index('wifi') < names.index('lidar')  # errors first
    inspect(page, '/wheel/name')
    until(lambda: HOSTILE in text(page, '[data-message="/wheel/name"]'), 'the message')
    inspect(page, '/wheel/name')
    assert page.evaluate('[window.attacked ?? null, document.querySelectorAll("img[src=x]").length]') == [None, 0]


def test_an_unpublished_topic_is_listed_last(page: Page) -> None:
    """The node subscribes to those of a Go2. Of more than 500 topics none with a publisher is cut, and any can be found."""
    page.get_by_label('Search topics and types').fill('')
    holds(page, 'document.querySelectorAll("[data-inspect]").length > 50')
    names = page.locator('[data-inspect]').evaluate_all('all => all.map(one => one.dataset.inspect)')
    assert {'/scan', '/map', '/fix'} <= {*names}
    assert names.index('/scan') < names.index('/a/n0')
    press(page.locator('.topics-panel > button'))
    holds(page, f'document.querySelectorAll("[data-inspect]").length > {MORE + 12}')
    last = page.locator('table.topics tbody tr').last
    assert 'no publisher' in last.inner_text()
    silent = page.locator('tr', has=page.locator('[data-inspect="/camera/compressed"]'))
    assert 'no publisher' in silent.inner_text()
    page.get_by_label('Search topics and types').fill('a/n509')
    holds(page, 'document.querySelectorAll("[data-inspect]").length === 1')
    page.get_by_label('Search topics and types').fill('laserscan')
    holds(page, 'document.querySelector("[data-inspect]").dataset.inspect === "/scan"')
    page.get_by_label('Search topics and types').fill('')


def test_a_number_of_a_message_is_plotted(page: Page, watching: Watching) -> None:
    """By a click on it, also for an element of an array that is not shown; before that nothing subscribes to the topic."""
    inspect(page, '/scan')
    holds(page, 'document.querySelectorAll("[data-path]").length > 30')
    press(page.locator('[data-path="ranges[3]"]'))
    page.locator('.element input').fill('200')
    press(page.locator('.element button'))
    for path in ('ranges[3]', 'ranges[200]'):
        plot = f'[data-plot="/scan#{path}"] [data-value]'
        until(lambda plot=plot: 0.1 < float(text(page, plot).replace('–', 'nan')) < 20, 'a value')
    inspect(page, '/scan')
    inspect(page, '/wheel/speed')
    press(page.locator('[data-path="data"]'))
    value = '[data-plot="/wheel/speed#data"] [data-value]'
    holds(page, f"""Number(document.querySelector('{value}')?.textContent) > 0""")
    first = float(text(page, value))
    until(lambda: float(text(page, value)) > first + 20, 'it counts on')
    inspect(page, '/wheel/speed')


def test_cameras_are_side_by_side_and_depth_has_a_scale(page: Page) -> None:
    """Up to the number available; the scale has its unit."""
    for count in (1, 2):
        press(page.get_by_label('Another camera beside this one'))
        holds(page, f'document.querySelectorAll(".camera.other").length === {count}')
    holds(page, 'document.querySelector("[data-scale]")?.textContent === "04 m"')
    assert page.get_by_label('Another camera beside this one').count() == 0
    colors = """topic => {
        const canvas = document.querySelector(`section[aria-label="Camera ${topic}"] canvas`);
        return [...canvas.getContext('2d').getImageData(80, 60, 1, 1).data];
    }"""
    until(lambda: abs(page.evaluate(colors, '/rear/compressed')[0] - 200) < 5, 'the frame of the rear camera')


def test_the_layout_is_remembered_for_the_robot(page: Page) -> None:
    """After a reload: cameras, plots, panels."""
    press(page.locator('.menu summary'))
    press(page.get_by_role('checkbox', name='Temperature'))
    holds(page, 'document.querySelector("section[aria-label=Temperature]") === null')
    page.reload()
    holds(
        page, 'document.querySelectorAll(".camera.other").length === 2 && document.querySelectorAll("[data-plot]").length === 3'
    )
    holds(page, 'document.querySelector("section[aria-label=Battery]") !== null')
    assert page.locator('section[aria-label=Temperature]').count() == 0
    holds(page, 'shadowhound.count.field > 10')


def test_the_page_fits_on_a_phone(page: Page) -> None:
    """With everything open."""
    for width in (1440, 390):
        fits(page, width)
    page.set_viewport_size({'width': 1280, 'height': 800})
    assert page.evaluate('shadowhound.wrong') == 0
    assert page.wrong == []  # type: ignore[attr-defined]


def test_the_cost_of_many_topics_is_bounded(page: Page, watching: Watching) -> None:
    """The page subscribes to the visible topics, and not to the other 500."""
    with observer(watching) as read:
        found = read()
        assert not any(topic.startswith('/a/') for topic in found)
        assert len(found) < 20, found


def test_topics_that_are_not_logged_have_figures(page: Page, watching: Watching) -> None:
    """Rate, size and age, and when they were sampled, without a click, while the table is in view.

    At most two of the 510 topics without another subscriber are subscribed to at a time, and none once the table is out of view.
    """
    with observer(watching) as read:

        def sampled() -> set[str]:
            return {topic for topic in read() if topic.startswith('/a/')}

        def cells(topic: str) -> list[str]:
            return [text(page, f'[data-topic="{topic}"][data-field={name}]') for name in ('rate', 'size', 'age')]

        def search(words: str, *topics: str) -> None:
            page.get_by_label('Search topics and types').fill(words)
            page.evaluate('document.querySelector("table.topics").scrollIntoView({block: "center", behavior: "instant"})')
            began_s = time.monotonic()
            for topic in topics:
                until(lambda topic=topic: 'sampled' in text(page, f'tr[data-row="{topic}"]'), f'{topic} is sampled')  # type: ignore[misc]
            assert time.monotonic() - began_s < 30

        search('/wheel', '/wheel/speed', '/wheel/name')
        rate, size, age = cells('/wheel/speed')
        assert 15 < float(rate) < 25
        assert size == '8 B'
        assert 0 <= float(age) < 1
        assert 1.5 < float(cells('/wheel/name')[0]) < 2.5
        assert 'a sample of 2' in page.locator('[data-topic="/wheel/speed"][data-field=rate]').get_attribute('title')  # type: ignore[operator]
        search('/robot_description', '/robot_description')
        rate, size, age = cells('/robot_description')
        assert (rate, size) == ('latched', f'{len(DESCRIPTION) + 9} B')
        assert float(age) > 1
        search('/a/n50', '/a/n50', '/a/n500')
        assert cells('/a/n500') == ['none', '–', '–']
        search('/a/')
        most = 0
        end_s = time.monotonic() + 6
        while time.monotonic() < end_s:
            most = max(most, len(sampled()))
        assert 0 < most <= 2
        page.evaluate('scrollTo({top: 0, behavior: "instant"})')
        until(lambda: not sampled(), 'the table is out of view')
        page.get_by_label('Search topics and types').fill('')
        assert page.evaluate('shadowhound.wrong') == 0


def test_transforms_place_robot_and_sensors(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From map to base: the robot is where they place it, and a sensor with an unknown frame is reported."""
    served = Served(LiveSettings(spool=tmp_path / 'spool', robot='turtle', tokens=tmp_path / 'live', port=0), monkeypatch)
    panel = panel_of('/tf', TF)
    assert panel is not None
    maker = panel.maker()

    def made() -> list[LiveItem]:
        now_ms = time.monotonic() * 1e3
        message = transforms(('map', 'odom'), ('odom', 'base_link'), ('base_link', 'laser'))
        rays = np.full(90, 2000, '<u2').tobytes()
        head = {'at': now_ms, 'frame': 'elsewhere', 'first': -math.pi, 'turn': math.pi / 45, 'step': 0.001}
        return [maker('/tf', TYPES, TF, [(now_ms, cdr(message, TF))]), LiveItem('/scan', 'scan', head=head, body=rays)]

    try:
        graph = {'/tf': (TF, 1), '/scan': ('sensor_msgs/msg/LaserScan', 1)}
        served.loop.call_soon_threadsafe(served.server.viewers.on_graph, graph)
        stop = served.every(0.1, made)
        page = opened(browser, served.server.url)
        note = '/scan: its frame elsewhere is in no transform'
        until(lambda: note in page.locator('[data-note]').all_inner_texts(), 'why the scan is not placed')
        holds(page, 'shadowhound.robot?.()?.place.join() === "2,4,6"')
        assert page.evaluate('shadowhound.wrong') == 0
        stop()
        page.close()
    finally:
        served.close()


def test_a_link_leads_to_a_moment(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The URL contains the displayed time; opening it shows that time."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        patrol(store, tmp_path)
    store_page = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
    with Served(store_page, monkeypatch) as served:
        page = opened(browser, served.server.url)
        holds(page, '(shadowhound.past?.count ?? 0) > 0')
        press(page.get_by_role('button', name='1 second back'))
        at_ms = int(page.locator('[data-moment]').get_attribute('data-moment') or 0)
        holds(page, f'Date.parse(new URLSearchParams(location.hash.slice(1)).get("at")) === {at_ms}')
        second = opened(browser, page.url)
        holds(second, f"Number(document.querySelector('[data-moment]')?.dataset.moment) === {at_ms}")
        holds(second, '(shadowhound.past?.count ?? 0) > 0')
        second.close()
        page.close()


def test_the_page_of_a_store_becomes_a_robots_when_a_node_starts(browser: Browser, tmp_path: Path) -> None:
    """It shows what it waits for, and changes in the browser automatically."""
    pytest.importorskip('rclpy')
    with in_own_domain(tmp_path) as processes:
        (tmp_path / 'home' / 'store').mkdir(parents=True)
        _, url = processes.page(SimpleNamespace(home=tmp_path / 'home', robot=processes.robot))  # type: ignore[arg-type]
        page = opened(browser, url)
        until(lambda: 'No node has run on this machine yet' in text(page, '[data-waits]'), 'what it waits for')
        assert text(page, '.pill') == 'the store'
        processes.node()
        until(lambda: page.locator('.pill').inner_text() == 'recording', 'it is the page of the robot')
        assert page.locator('[data-waits]').count() == 0
        page.close()


def test_three_dimensions_are_loaded_when_they_are_in_view(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two thirds of the page's bytes; on a phone the camera and the save button come first, and one finger scrolls."""
    with Served(LiveSettings(spool=tmp_path / 'spool', robot='turtle', tokens=tmp_path / 'live', port=0), monkeypatch) as served:
        phone = browser.new_context(viewport={'width': 390, 'height': 420}, has_touch=True, is_mobile=True)
        page = phone.new_page()
        page.goto(served.server.url)
        holds(page, 'shadowhound.count.figures > 0 && document.querySelector(".camera") !== null')
        assert page.locator('main button').first.inner_text() == 'Save this moment'
        page.wait_for_timeout(1500)
        loaded = 'performance.getEntriesByType("resource").some(({name}) => /three.js|scene.js/.test(name))'
        assert page.evaluate(f'!{loaded}')
        page.evaluate('document.querySelector(".cloud").scrollIntoView({behavior: "instant"})')
        holds(page, loaded)
        holds(page, 'document.querySelector(".cloud canvas").style.touchAction === "pan-y"')
        manifest = page.request.get(f'{served.server.url}manifest.webmanifest')
        assert manifest.headers['content-type'].startswith('application/manifest+json')
        assert manifest.json()['display'] == 'standalone'
        phone.close()


@pytest.mark.parametrize('tiles', ['', 'https://tile.example/{z}/{x}/{y}.png'])
def test_tiles_come_from_the_server_that_the_operator_names(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiles: str
) -> None:
    """And from nowhere if none is named; the page may load images from that server alone."""
    settings = LiveSettings(spool=tmp_path / 'spool', robot='turtle', tokens=tmp_path / 'live', port=0, tiles=tiles)
    served = Served(settings, monkeypatch)
    rest = {'lat_rest': 0.0, 'lon_rest': 0.0, 'altitude': 1.0, 'status': 0.0, 'error': 1.0}
    row = {'lat': LATITUDE, 'lon': LONGITUDE, **rest}
    stop = served.every(0.1, lambda: [table_item('/fix', KINDS[FIX], [(time.monotonic() * 1e3, row)])])
    try:
        served.loop.call_soon_threadsafe(served.server.viewers.on_graph, {'/fix': (FIX, 1)})
        page: Any = browser.new_page()
        asked: list[str] = []
        page.on('request', lambda request: asked.append(request.url))
        page.route(
            'https://tile.example/**', lambda route: route.fulfill(status=200, content_type='image/svg+xml', body='<svg/>')
        )
        answer = page.goto(served.server.url)
        policy = answer.headers['content-security-policy']
        holds(page, 'shadowhound.count.fix > 5 && document.querySelector("[data-field=lat]")?.textContent.length > 5')
        if tiles:
            assert "img-src 'self' https://tile.example;" in policy
            until(lambda: page.wait_for_timeout(100) or any('tile.example/19/' in url for url in asked), 'tiles are loaded')
        else:
            assert "img-src 'self';" in policy
            page.wait_for_timeout(1200)
            assert not [url for url in asked if not url.startswith(served.server.url)]
        page.close()
    finally:
        stop()
        served.close()
