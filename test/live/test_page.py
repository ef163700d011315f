"""The page in a real Chromium, of a real node and a simulated robot."""

from __future__ import annotations

import asyncio
import json
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from domains import free_domain
from e2e.machines import ROBOT, Machines
from e2e.processes import Node, Processes, until
from lake.making import add, add_part, folder_store
from lake.test_pull import Field
from live.test_history import jpeg, patrol, told

from shadowhound_data_logger.live import server as server_module
from shadowhound_data_logger.live.access import make_tokens
from shadowhound_data_logger.live.kinds import KINDS, LiveItem, table_item
from shadowhound_data_logger.live.server import LiveServer, LiveSettings
from shadowhound_data_logger.options import COMPRESSED_IMAGE, UploadSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
FLAGS = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-sandbox']
RATES = 'rate_scale:=0.2'
IMU = 'sensor_msgs/msg/Imu'
pytestmark = [
    pytest.mark.ros,
    pytest.mark.long('a Chromium, a robot and a node'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]


class Watching:
    """A node, a robot and the live page of them in a browser."""

    def __init__(self, processes: Processes) -> None:
        self.processes = processes
        self.node: Node = processes.node()
        self.sim = processes.sim(RATES)
        self.home = self.node.home
        self.serve(0)

    def serve(self, port: int) -> None:
        self.live, self.url = self.processes.page(self.node, port=port)

    def ledger(self) -> dict[str, Any]:
        return self.node.ledger()['topics']


@pytest.fixture(scope='module')
def watching(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watching]:
    pytest.importorskip('rclpy')
    with free_domain() as domain:
        processes = Processes(tmp_path_factory.mktemp('live'), domain, f'r{secrets.token_hex(4)}')
        try:
            yield Watching(processes)
        finally:
            processes.end()


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    """One for all of them."""
    api = pytest.importorskip('playwright.sync_api')
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def opened(browser: Browser, url: str) -> Page:
    """A tab that remembers what it asked for (``asked``) and what went wrong in it (``wrong``)."""
    page: Any = browser.new_page(viewport={'width': 1280, 'height': 800})
    page.set_default_timeout(120_000)
    page.wrong = []
    page.asked = []
    page.on('pageerror', lambda error: page.wrong.append(str(error)))
    page.on('console', lambda message: page.wrong.append(message.text) if message.type == 'error' else None)
    page.on('request', lambda request: page.asked.append(request.url))
    page.goto(url)
    return page


@pytest.fixture(scope='module')
def page(watching: Watching, browser: Browser) -> Page:
    return opened(browser, watching.url)


def press(button: Locator) -> None:
    """Without waiting for frames, of which a software GL on a busy machine draws few."""
    button.dispatch_event('click')


def holds(page: Page, script: str) -> None:
    """Wait until it is so in the page, which lets nobody else evaluate text (``script-src 'self'``)."""
    until(lambda: page.evaluate(script), script)


def counted(page: Page, kind: str) -> int:
    return int(page.evaluate(f'shadowhound.count[{json.dumps(kind)}] ?? 0'))


def test_everything_is_shown(page: Page) -> None:
    """Camera, cloud, path, plots and figures come; every request goes to the page's own origin; nothing fails in the browser."""
    for kind in ('camera', 'cloud', 'odom', 'imu', 'joints', 'battery', 'figures'):
        holds(page, f'(shadowhound.count[{json.dumps(kind)}] ?? 0) > 3')
    holds(page, 'shadowhound.drawn.camera?.length > 0 && shadowhound.drawn.cloud?.length > 0')
    origin = page.url.rstrip('/')
    assert [url for url in page.asked if not url.startswith((origin, 'blob:'))] == []
    assert page.wrong == []


def test_a_viewer_has_no_buttons_that_act(page: Page) -> None:
    """Until somebody signs in with the operator's token; then the node answers, and says in its log who asked."""
    assert page.locator('[data-act]').count() == 0


def test_an_operator_acts(page: Page, watching: Watching) -> None:
    """The answer of the node is on the page, and in the node's log stands who asked; the token is in no address."""
    token = (watching.home / 'live' / 'operator.token').read_text().strip()
    press(page.get_by_role('button', name='Sign in', exact=True))
    page.locator('dialog input[name=token]').fill('not-the-token')
    press(page.locator('dialog button.primary'))
    page.locator('dialog [role=alert]').wait_for()
    page.locator('dialog input[name=token]').fill(token)
    press(page.locator('dialog button.primary'))
    for act, words in (('flush', 'spooled'), ('bag start', ''), ('bag stop', '')):
        before = page.locator('.answers li').count()
        press(page.locator(f'[data-act="{act}"]'))
        holds(page, f'document.querySelectorAll(".answers li").length > {before}')
        answer = page.locator('.answers li').first.inner_text()
        assert act in answer
        assert words in answer
        assert page.locator('.answers li').first.get_attribute('class') != 'bad', answer
    until(lambda: 'operator at 127.0.0.1: flush' in watching.node.log, 'the log names the operator')
    assert not any(token in url for url in page.asked)
    assert token not in watching.live.log
    page.wrong.clear()  # the browser's own line about the wrong token (401)


@pytest.fixture
def graph(watching: Watching) -> Iterator[Any]:
    """A node of ROS that sees those of the robot."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=int(watching.processes.environ['ROS_DOMAIN_ID']))
    node = rclpy.create_node('observer', context=context, start_parameter_services=False, enable_rosout=False)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_a_hidden_tab_watches_nothing(page: Page, watching: Watching, graph: Any) -> None:
    """Its subscriptions end, as ROS sees them, and begin again when it is seen."""

    def is_read(topic: str) -> bool:
        return any(each.node_name == 'shadowhound_live' for each in graph.get_subscriptions_info_by_topic(topic))

    watched = ('/imu', '/camera/compressed', '/point_cloud2')
    until(lambda: all(map(is_read, watched)), 'what is shown is read')
    page.evaluate("Object.defineProperty(document, 'hidden', {configurable: true, get: () => true});"
                  " document.dispatchEvent(new Event('visibilitychange'))")  # fmt: skip
    quiet = 'async () => { const before = shadowhound.count.imu; await new Promise(done => setTimeout(done, 1500)); return %s }'
    holds(page, quiet % 'shadowhound.count.imu === before')
    until(lambda: not any(map(is_read, watched)), 'nothing is read', 10.0)
    before = counted(page, 'imu')
    page.evaluate("delete document.hidden; document.dispatchEvent(new Event('visibilitychange'))")
    holds(page, f'shadowhound.count.imu > {before + 3}')
    until(lambda: all(map(is_read, watched)), 'what is shown is read again')


def test_after_a_kill_the_page_goes_on_by_itself(page: Page, watching: Watching) -> None:
    """Without a reload and without a new sign-in; meanwhile everything is marked as old, and the ages go on growing."""
    port = int(watching.url.rstrip('/').rpartition(':')[2])
    watching.live.signal(signal.SIGKILL)
    watching.live.wait()
    holds(page, "document.querySelector('.pill').textContent.includes('no connection')")
    holds(page, "[...document.querySelectorAll('[data-age=camera]')].every(each => each.classList.contains('old'))")
    first = int(page.locator('[data-age=camera]').get_attribute('data-ms') or 0)
    holds(page, f"document.querySelector('[data-age=camera]').dataset.ms >= {first + 700}")
    before = counted(page, 'camera')
    watching.serve(port)
    holds(page, f'shadowhound.count.camera > {before}')
    page.locator('[data-act="flush"]').wait_for()
    page.wrong.clear()  # what the browser says of connections that were refused


def test_the_figures_are_those_of_the_ledger(page: Page, watching: Watching) -> None:
    """Once the robot is silent: received, stored and missed of each topic, as ``ledger --json`` has them."""
    watching.sim.signal(signal.SIGINT)
    watching.sim.wait()
    press(page.locator('[data-act="flush"]'))

    def shown() -> dict[str, dict[str, str]]:
        cells = page.locator('td[data-topic][data-field]').evaluate_all(
            'cells => cells.map(cell => [cell.dataset.topic, cell.dataset.field, cell.textContent])'
        )
        found: dict[str, dict[str, str]] = {}
        for topic, name, text in cells:
            found.setdefault(topic, {})[name] = text
        return found

    def same() -> bool:
        page.wait_for_timeout(200)
        on_page, ledger = shown(), watching.ledger()
        return bool(ledger) and all(
            on_page.get(topic, {}).get(name) == str(row[name])
            for topic, row in ledger.items()
            for name in ('received', 'stored', 'missed')
        )

    until(same, lambda: f'{shown()} is {watching.ledger()}')
    assert all({'rate', 'age'} <= fields.keys() for fields in shown().values())


def test_a_gap_stands_on_the_timeline_at_its_time(page: Page, watching: Watching) -> None:
    """What was published while the node was away, by the cause restart, and whatever else ``ledger --gaps`` tells."""
    watching.sim = watching.processes.sim(RATES)
    received = watching.node.topic('/imu')['received']
    watching.node.received('/imu', received + 20)
    watching.node.kill()
    time.sleep(3.0)  # for this long messages are lost: it is what is tested
    watching.node = watching.processes.node()
    received = watching.node.topic('/imu')['received']
    watching.node.received('/imu', received + 20)

    watching.sim.signal(signal.SIGINT)
    watching.sim.wait()

    def lacks() -> list[dict[str, Any]]:
        """What ``ledger --gaps`` has and the page has not."""
        command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'ledger', '--gaps', '--json']
        environ = {**watching.processes.environ, 'SHADOWHOUND_HOME': str(watching.home), 'SHADOWHOUND_ROBOT': watching.node.robot}
        ran = subprocess.run(command, env=environ, capture_output=True, text=True, check=True, timeout=120)
        known = [gap for gap in json.loads(ran.stdout)['gaps'] if gap['from_ns'] is not None]
        assert {'restart'} <= {gap['cause'] for gap in known if gap['topic'] == '/imu'}
        on_page = page.locator('rect.gap').evaluate_all('gaps => gaps.map(gap => ({...gap.dataset}))')
        return [
            gap for gap in known
            if not any(
                (each['topic'], each['kind'], each['cause']) == (gap['topic'], gap['kind'], gap['cause'])
                and abs(float(each['from']) - gap['from_ns'] / 1e6) < 1 and abs(float(each['to']) - gap['to_ns'] / 1e6) < 1
                for each in on_page
            )
        ]  # fmt: skip

    until(lambda: not lacks(), lambda: f'the page lacks {lacks()}')
    assert page.wrong == []


@pytest.mark.slow
def test_back_in_time(page: Page, watching: Watching) -> None:
    """A click on the timeline shows that moment: frame, cloud, path and plots of then; it plays on from there.

    The commands that the page tells do what they say, once the catalogue of that minute has arrived.
    """
    press(page.get_by_role('button', name='Back in time'))
    holds(page, '(shadowhound.past?.count ?? 0) > 0')
    holds(page, "document.querySelectorAll('rect.recorded').length > 5")
    assert {'/imu', '/camera/compressed'} <= set(
        page.locator('rect.recorded').evaluate_all('all => all.map(one => one.dataset.topic)')
    )
    press(page.get_by_role('button', name='15 min'))
    slider = "document.querySelector('svg[role=slider]')"
    holds(page, f'{slider}.ariaValueMax - {slider}.ariaValueMin < 1000000')
    spot = page.locator('rect.recorded[data-topic="/imu"]').first.bounding_box()
    assert spot is not None
    page.mouse.click(spot['x'] + spot['width'] / 2, spot['y'])
    kinds = "['camera', 'cloud', 'odom', 'imu', 'joints', 'battery']"
    holds(page, f'{kinds}.every(each => shadowhound.past.shown.some(([, kind]) => kind === each))')
    live = counted(page, 'imu')
    before = int(page.locator('[data-moment]').get_attribute('data-moment') or 0)
    press(page.locator('[data-play]'))
    holds(page, f'shadowhound.past.at > {before + 1000}')
    press(page.locator('[data-play]'))
    assert counted(page, 'imu') <= live + 3  # nobody watches the live topics meanwhile
    home = {**watching.processes.environ, 'SHADOWHOUND_HOME': str(watching.home)}
    query = shlex.split(page.locator('[data-command=query]').inner_text())
    assert query[0] == 'shadowhound-data'
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', *query[1:], '--json']

    def answered() -> bool:
        ran = subprocess.run(command, env=home, capture_output=True, text=True, check=False, timeout=120)
        return {'camera', 'imu'} <= {row['sensor'] for row in json.loads(ran.stdout)}

    until(answered, f'{query} finds what is shown', 240.0)
    press(page.get_by_role('button', name='Back to now'))
    page.locator('#data').wait_for()


def wider(page: Page, width: int) -> list[Any]:
    """What reaches beyond the right edge of a screen that is so wide, once the page is laid out for it."""
    page.set_viewport_size({'width': width, 'height': 850})
    holds(page, f'innerWidth === {width} && document.querySelector("main").clientWidth <= {width}')
    page.evaluate('new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))')
    script = """() => {
        if (document.documentElement.scrollWidth <= innerWidth) return [];
        const found = [], range = document.createRange();
        const nodes = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT | NodeFilter.SHOW_ELEMENT);
        for (let each = nodes.nextNode(); each; each = nodes.nextNode()) {
            const element = each.nodeType === Node.TEXT_NODE ? each.parentElement : each;
            if (element.closest(".scroll, .stage, .timeline-box")) continue;
            range.selectNode(each);
            const right = Math.max(...[...range.getClientRects()].map(box => box.right));
            if (right > innerWidth) found.push([element.tagName, element.className, right, each.textContent.slice(0, 40)]);
        }
        return [document.documentElement.scrollWidth, ...found];
    }"""
    return list(page.evaluate(script))


def fits(page: Page, width: int) -> None:
    """Wait until nothing does."""
    until(lambda: not wider(page, width), lambda: f'{width}: {wider(page, width)}')


def test_nothing_is_wider_than_the_screen(page: Page) -> None:
    """Of the page of the robot, as it is after all of this, on a laptop and on phones."""
    for width in (1440, 390, 320):
        fits(page, width)
    page.set_viewport_size({'width': 1280, 'height': 800})


HOSTILE = '<img src=x onerror="window.attacked = 1">'
LONG = 'unbroken_' * 14
NAMES = (HOSTILE, LONG)


class Served:
    """A live page in this process, on a thread of its own, until it is closed."""

    def __init__(self, settings: LiveSettings, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(server_module, 'find_spec', lambda _: None)  # no ROS here
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, name='served')
        self.thread.start()
        self.server = LiveServer(settings)
        self.run(self.server.open())

    def run(self, doing: Coroutine[Any, Any, Any]) -> None:
        asyncio.run_coroutine_threadsafe(doing, self.loop).result(120)

    def every(self, seconds: float, made: Callable[[], list[LiveItem]]) -> Callable[[], object]:
        """Show what is made then as what came from the robot; what ends it."""

        async def show() -> None:
            while True:
                self.server._on_items(made())
                await asyncio.sleep(seconds)

        return asyncio.run_coroutine_threadsafe(show(), self.loop).cancel

    def close(self) -> None:
        self.run(self.server.close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join()
        self.loop.close()


def test_an_outage_of_ten_seconds(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the link, of which nobody is told: the page goes on by itself, and its ages are meanwhile those of the robot's clock."""
    with ExitStack() as stack:
        machines = Machines(stack)
        listener = machines.listener()
        listener.setblocking(False)
        monkeypatch.setattr(server_module, '_listener', lambda *_: listener)
        served = Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', bind=ROBOT), monkeypatch)
        stack.callback(served.close)
        served.loop.call_soon_threadsafe(served.server._on_graph, {'/imu': IMU})
        stack.callback(served.every(0.03, lambda: [table_item('/imu', KINDS[IMU], [(time.monotonic() * 1e3, {'rpy.x': 1.0})])]))
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
        wrong_ms = []
        while time.monotonic() < cut_s + 10:
            shown = "[Number(document.querySelector('[data-age=imu]').dataset.ms), shadowhound.at().imu]"
            before_ms = time.monotonic() * 1e3
            age_ms, at_ms = page.evaluate(shown)
            true_ms = (before_ms + time.monotonic() * 1e3) / 2 - at_ms  # one machine: the page's robot has this very clock
            wrong_ms.append(abs(true_ms - age_ms))
        assert len(tried) > 3  # it waits for no connection that TCP still tries to revive
        count = counted(page, 'imu')
        machines.mend()
        holds(page, f'shadowhound.count.imu > {count}')
        assert page.evaluate('window.same')
        assert sorted(wrong_ms)[len(wrong_ms) // 2] < 2500  # ages that stand still would be off by 5 s; how exact: bench/live.py


def test_a_sign_in_that_has_ended_asks_for_the_token(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An open page says so and tries no more connections; with the new token it goes on, without a reload."""
    settings = LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', bind='0.0.0.0', port=0)
    served = Served(settings, monkeypatch)
    try:
        page = opened(browser, f'http://127.0.0.1:{served.server.port}/')
        tried: list[str] = []
        page.on('websocket', lambda socket: tried.append(socket.url))

        def sign_in() -> None:
            page.locator('input[name=token]').fill((tmp_path / 'live' / 'viewer.token').read_text().strip())
            press(page.locator('button.primary'))

        sign_in()
        holds(page, 'shadowhound.count.figures > 0')
        page.evaluate('window.same = true')
        make_tokens(tmp_path / 'live', anew=True)
        page.get_by_text('Your sign-in has ended.').wait_for()
        before = len(tried)
        page.wait_for_timeout(4000)  # it would have tried three times
        assert len(tried) == before
        count = counted(page, 'figures')
        sign_in()
        holds(page, f'shadowhound.count.figures > {count}')
        assert page.evaluate('window.same')
        assert len(tried) == before + 1
        page.close()
    finally:
        served.close()


def test_where_everybody_may_watch_an_operator_becomes_a_viewer(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once the sign-in has ended: the page has no button that acts any more, and goes on."""
    served = Served(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0), monkeypatch)
    try:
        page = opened(browser, served.server.url)
        press(page.get_by_role('button', name='Sign in', exact=True))
        page.locator('dialog input[name=token]').fill((tmp_path / 'live' / 'operator.token').read_text().strip())
        press(page.locator('dialog button.primary'))
        page.locator('[data-act=flush]').wait_for()
        page.reload()  # with the cookie, by which the connection is known
        page.locator('[data-act=flush]').wait_for()
        make_tokens(tmp_path / 'live', anew=True)
        page.locator('[data-act=flush]').wait_for(state='detached')
        count = counted(page, 'figures')
        holds(page, f'shadowhound.count.figures > {count}')
        page.close()
    finally:
        served.close()


def test_a_first_question_that_is_lost_is_asked_again(browser: Browser, watching: Watching) -> None:
    """On a bad link the page may be there, and what it asks first is not answered."""
    page: Any = browser.new_page()
    lost: list[str] = []

    def lose(route: Any) -> None:
        if len(lost) < 2:
            lost.append(route.request.url)
            route.abort()
        else:
            route.continue_()

    page.route('**/api/session', lose)
    page.goto(watching.url)
    holds(page, '(window.shadowhound.count.figures ?? 0) > 0')
    assert len(lost) == 2
    page.close()


def told_of_names(now_ms: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures and gaps in which every text is hostile or long."""
    counts = dict.fromkeys(('received', 'stored', 'skipped', 'missed', 'pending', 'lost'), 1_234_567_890)
    topics = [
        {'topic': f'/{name}', 'type': f'a/msg/{name}', 'sensor': name, 'missed_estimated': None, 'unavailable': name,
         'rate_hz': 12345.6, 'age_s': 12345.6, 'publishers': 1, 'may_be_silent': False, **counts} for name in NAMES
    ]  # fmt: skip
    figures = {
        'robot': 'thor', 'state': 'not_answering', 'age_s': 1.0, 'paused': False,
        'mission': {'mission_id': LONG, 'policy': f'go2_patrol@7#{HOSTILE}{LONG}'},
        'queue': {'messages': 123_456_789, 'bytes': 10**12, 'max_messages': 10**9}, 'findings': list(NAMES), 'balanced': False,
        'spool': {'pending': 10**9, 'bytes': 10**12, 'max_bytes': 10**13, 'free_bytes': 10**13, 'quarantined': 10**9},
        'store': {'target': LONG, 'state': LONG, 'last_error': HOSTILE + LONG, 'mbps': 1.0, 'max_mbps': 4}, 'bag': {'name': LONG},
        'objects': {'delivered': 10**12, 'pending': 10**9}, 'bytes': {'pending': 10**12}, 'topics': topics,
    }  # fmt: skip
    columns = ['sink', 'topic', 'kind', 'cause', 'from', 'to', 'count', 'grade']
    gaps = [
        ['objects', f'/{name}', name, name, now_ms - 500_000, now_ms - 400_000, 10**9, 'exact'] for name in NAMES
    ]  # fmt: skip
    day_ms = {'from': now_ms - 3_600_000, 'to': now_ms, 'now': now_ms}
    return figures, {**day_ms, 'columns': columns, 'gaps': gaps, 'known': [[f'/{name}', *day_ms.values()][:3] for name in NAMES]}


def test_names_are_text_and_fit(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names, reasons and answers that are code or have no space in them: nothing of them runs, and a phone shows them."""
    settings = LiveSettings(spool=tmp_path / 'spool', robot=LONG[:60], tokens=tmp_path / 'live', port=0)
    served = Served(settings, monkeypatch)
    try:
        figures, gaps = told_of_names(time.time() * 1e3)
        monkeypatch.setattr(served.server, '_figures', SimpleNamespace(now=lambda **_: figures, gaps=lambda *_: gaps))
        monkeypatch.setattr(served.server, '_ask', lambda *_: {'ok': True, 'message': HOSTILE + LONG})
        graph = {f'/{name}/{place}': 'sensor_msgs/msg/Imu' for name in NAMES for place in (1, 2)}
        served.loop.call_soon_threadsafe(served.server._on_graph, graph)
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
    finally:
        served.close()


def test_the_page_of_a_store(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a robot: the last day, a moment of it, and labels that an operator adds to it; names in it are text."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        patrol(store, tmp_path)
        rows = [told(6, 'camera', f'/{name}', COMPRESSED_IMAGE, 'jpg', mission_id=name, mission_type=name) for name in NAMES]
        for place, row in enumerate(rows):
            row['key'] = f'thor/names/{place}.jpg'
            add(store, tmp_path / 'tmp', row['key'], jpeg(9))
        add_part(store, rows, 'names', tmp_path / 'tmp')
    store_page = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
    served = Served(store_page, monkeypatch)
    try:
        page = opened(browser, served.server.url)
        holds(page, "document.querySelectorAll('rect.recorded').length > 2 && shadowhound.past?.shown.length > 2")
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
    finally:
        served.close()


def test_an_operator_asks_a_robot_for_what_it_keeps(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the page of a store: how much of a time is on the robot alone, asking for it, and what became of that."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    with closing(Field(tmp_path)) as field:
        field.records(*range(20))
        settings = LiveSettings(spool=tmp_path / 'none', robot='thor', tokens=tmp_path / 'live', port=0, is_of_store=True)
        served = Served(settings, monkeypatch)
        try:
            page = opened(browser, served.server.url)
            ask, said = page.locator('[data-act=pull]'), page.locator('.pull')
            holds(page, "document.querySelectorAll('rect.kept').length === 1 && document.querySelector('[data-offer]')")
            assert ask.count() == 0
            assert 'an operator may ask for them' in said.inner_text()
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
        finally:
            served.close()
