"""The page in a real Chromium, with a real node and a simulated robot."""

from __future__ import annotations

import json
import math
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from e2e.processes import Node, Processes, until
from live.browsing import CHROMIUM, counted, fits, holds, in_own_domain, most_of, opened, press, rgb
from live.page.test_past import played
from live.test_kinds import cdr, header, new
from ros.ports import locked

from shadowhound_data_logger.ros.endpoints import POLL_S
from shadowhound_data_logger.ros.fast_dds_profile import SHIPPED

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


RATES = 'rate_scale:=0.2'
SHOWN_HZ = {'/imu': 20.0, '/odom': 10.0, '/joint_states': 10.0, '/lowstate': 4.0, '/camera/compressed': 6.0}
"""The simulator's rates at that scale, for some topics."""
EVENTS = {'events.topics': ['/imu'], 'events.pre_s': 2.0, 'events.post_s': 0.5}
JOINTS = 'sensor_msgs/msg/JointState'
pytestmark = [
    pytest.mark.ros,
    pytest.mark.long('a Chromium, a robot and a node'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]


class Watching:
    """A node, a robot and their live page in a browser."""

    def __init__(self, processes: Processes) -> None:
        self.processes = processes
        self.node: Node = processes.node(parameters=EVENTS)
        self.sim = processes.sim(RATES)
        self.home = self.node.home
        self.serve(0)

    def serve(self, port: int) -> None:
        self.live, self.url = self.processes.page(self.node, port=port)

    def ledger(self) -> dict[str, Any]:
        return self.node.ledger()['topics']

    def bagged(self) -> int:
        """The messages received for bags."""
        return sum(row['received'] for row in self.node.ledger()['bags'].values())


@pytest.fixture(scope='module')
def watching(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watching]:
    pytest.importorskip('rclpy')
    with in_own_domain(tmp_path_factory.mktemp('live')) as started:
        yield Watching(started)


@pytest.fixture(scope='module')
def page(watching: Watching, browser: Browser) -> Page:
    return opened(browser, watching.url)


def test_everything_is_shown(page: Page) -> None:
    """Camera, cloud, path, plots and values appear; every request goes to the page's origin; the browser reports no errors."""
    for kind in ('camera', 'cloud', 'odom', 'imu', 'joints', 'battery', 'figures'):
        holds(page, f'(shadowhound.count[{json.dumps(kind)}] ?? 0) > 3')
    holds(page, 'shadowhound.drawn.camera?.length > 0 && shadowhound.drawn.cloud?.length > 0')
    origin = page.url.rstrip('/')
    assert [url for url in page.asked if not url.startswith((origin, 'blob:'))] == []
    assert page.wrong == []


def cell(page: Page, topic: str, field: str) -> float:
    """The value in the table for a topic; NaN for a dash."""
    text = page.locator(f'td[data-topic="{topic}"][data-field="{field}"]').inner_text()
    return float(text) if text.replace('.', '').isdecimal() else math.nan


def test_the_rates_are_the_robots(page: Page) -> None:
    """Within a tenth of what is published; a topic at 10 Hz is at most 0.2 s older, for two polls of the node."""

    def wrong() -> dict[str, tuple[float, float]]:
        found = {}
        end_s = time.monotonic() + 2.5
        while not found and time.monotonic() < end_s:
            fields = {topic: (cell(page, topic, 'rate'), cell(page, topic, 'age'), hz) for topic, hz in SHOWN_HZ.items()}
            found = {topic: (rate, age_s) for topic, (rate, age_s, hz) in fields.items()
                     if not (abs(rate - hz) <= hz / 10 and age_s <= (0.3 if hz >= 10 else 1.0))}  # fmt: skip
        return found

    until(lambda: not wrong(), lambda: f'rates and ages are shown as {wrong()}')


def test_a_viewer_has_no_buttons_that_act(page: Page) -> None:
    """Only one to sign in as operator: a viewer may watch."""
    page.locator('.controls').wait_for()
    assert page.locator('.controls button').all_inner_texts() == ['Sign in as operator']
    assert page.locator('[data-act]').count() == 0


def answer_to(page: Page, act: str) -> str:
    """The node's newest response on the page, once it is for this command; the button can be pressed again then."""
    holds(page, f'document.querySelector(".answers li b")?.textContent === {json.dumps(act)}')
    holds(page, 'document.querySelectorAll(".controls button:disabled").length === 0')
    first = page.locator('.answers li').first
    assert first.get_attribute('class') != 'bad', first.inner_text()
    return first.inner_text()


def test_an_operators_action_reaches_the_node(page: Page, watching: Watching) -> None:
    """The response of the node is on the page, and the node's log names the requester; no URL contains the token."""
    token = (watching.home / 'live' / 'operator.token').read_text().strip()
    press(page.get_by_role('button', name='Sign in', exact=True))
    page.locator('dialog input[name=token]').fill('not-the-token')
    press(page.locator('dialog button.primary'))
    page.locator('dialog [role=alert]').wait_for()
    page.locator('dialog input[name=token]').fill(token)
    press(page.locator('dialog button.primary'))
    page.get_by_label('Name of the event').fill('bump')
    page.get_by_label('Note', exact=True).fill('against the shelf')
    for act, words in (
        ('bag start', ''), ('event', 'event_bump_'), ('bag split', 'has 1 closed slices'), ('pause', 'are counted'),
        ('resume', 'messages are stored again'), ('bag stop', ' messages in 2 slices'), ('flush', ' spooled'),
    ):  # fmt: skip
        if act in {'bag split', 'bag stop'}:  # the slice has messages
            recorded = watching.bagged()
            until(lambda recorded=recorded: watching.bagged() > recorded, 'messages come into the bag')
        press(page.locator(f'[data-act="{act}"]'))
        assert words in answer_to(page, act)
        assert watching.node.log.count(f'operator at 127.0.0.1: {act}: ') == 1
        if act == 'pause':
            page.locator('.pill', has_text='paused').wait_for()
    page.locator('[data-act=pause]').wait_for()
    assert 'event bump (page)' in watching.node.log
    assert not any(token in url for url in page.asked)
    assert token not in watching.live.log
    page.wrong.clear()  # the browser's message about the wrong token (401)


def tabbed(page: Page, selector: str) -> None:
    """Press Tab until the element has the focus."""
    for _ in range(80):
        page.keyboard.press('Tab')
        if page.evaluate(f'document.activeElement.matches({json.dumps(selector)})'):
            assert page.evaluate('getComputedStyle(document.activeElement).outlineStyle') == 'solid'
            return
    raise AssertionError(f'no Tab leads to {selector}')


def test_the_page_works_with_the_keyboard(page: Page) -> None:
    """A button with the focus reacts to space and enter; arrows on the timeline move the time by one second and by ten."""
    page.evaluate('document.activeElement.blur()')
    for act, key in (('pause', 'Space'), ('resume', 'Enter')):
        page.locator(f'[data-act={act}]').wait_for()
        tabbed(page, f'[data-act={act}]')
        page.keyboard.press(key)
        answer_to(page, act)
        page.evaluate('document.activeElement.blur()')
    page.locator('[data-act=pause]').wait_for()
    page.locator('svg[role=slider]').wait_for()
    tabbed(page, 'svg[role=slider]')
    page.keyboard.press('ArrowLeft')
    moment = page.locator('[data-moment]')
    at_ms = int(moment.get_attribute('data-moment') or 0)
    for key, moved_ms in (('ArrowLeft', -1000), ('Shift+ArrowLeft', -11_000), ('ArrowRight', -10_000), ('Shift+ArrowRight', 0)):
        page.keyboard.press(key)
        holds(page, f'Number(document.querySelector("[data-moment]").dataset.moment) === {at_ms + moved_ms}')
    holds(page, '(shadowhound.past?.count ?? 0) > 0')
    tabbed(page, '.timeline .panel-head button.primary')
    page.keyboard.press('Enter')
    page.locator('#data').wait_for()


def test_motion_and_colors_are_as_the_user_wants_them(page: Page) -> None:
    """With reduced motion nothing moves automatically; and the page is dark on a dark system."""
    moving = """() => [...document.querySelectorAll('*')].filter((each) => {
        const style = getComputedStyle(each);
        return style.animationName !== 'none' || !/^0s(, 0s)*$/.test(style.transitionDuration) || style.scrollBehavior !== 'auto';
    }).map((each) => each.tagName)"""
    try:
        page.emulate_media(reduced_motion='no-preference')
        assert page.evaluate(moving) == ['HTML']  # it scrolls smoothly to the clicked part
        page.emulate_media(reduced_motion='reduce')
        assert page.evaluate(moving) == []
        assert page.evaluate('document.getAnimations().length') == 0
        shades = {}
        for scheme in ('light', 'dark'):
            page.emulate_media(color_scheme=scheme)
            for part in ('body', '.panel'):
                style = f'getComputedStyle(document.querySelector("{part}"))'
                colors = page.evaluate(f'[{style}.backgroundColor, {style}.color]')
                shades[scheme, part] = [sum(rgb(color)) for color in colors]
        assert all(back > text + 300 for (scheme, _), (back, text) in shades.items() if scheme == 'light')
        assert all(back < text - 300 for (scheme, _), (back, text) in shades.items() if scheme == 'dark')
    finally:
        page.emulate_media(reduced_motion='no-preference', color_scheme='light')


@pytest.fixture
def graph(watching: Watching) -> Iterator[Any]:
    """A ROS node that discovers those of the robot."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=int(watching.processes.environ['ROS_DOMAIN_ID']))
    node = rclpy.create_node('observer', context=context, start_parameter_services=False, enable_rosout=False)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_a_hidden_tab_has_no_subscriptions(page: Page, watching: Watching, graph: Any) -> None:
    """Its subscriptions end, according to ROS, and start again when it is visible."""

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


def test_the_page_takes_no_shared_memory_for_images(watching: Watching) -> None:
    """It publishes none, and does not load our profile named in its environment."""
    if SHIPPED not in Path(f'/proc/{watching.live.popen.pid}/environ').read_text():
        pytest.skip('the tests run without our profile here')
    segments = locked(watching.live.popen.pid, '[0-9a-f]{16}')
    if not segments:
        pytest.skip('this middleware has no segments')
    assert sum(path.stat().st_size for path in segments) < 1 << 20


def test_after_a_kill_the_page_reconnects(page: Page, watching: Watching) -> None:
    """Without a reload or a new sign-in; until then everything is marked as old, and the ages keep growing."""
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
    page.wrong.clear()  # the browser's messages about refused connections


def test_the_figures_are_those_of_the_ledger(page: Page, watching: Watching) -> None:
    """Once the robot is silent: received, stored and missed of each topic, as in ``ledger --json``."""
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


def test_the_age_of_a_silent_topic_is_the_publishers(page: Page, watching: Watching) -> None:
    """Within 200 ms, counted from the last published message, whenever that was between two polls of the node."""
    watching.sim.signal(signal.SIGINT)
    watching.sim.wait()
    turned = np.array([0.5])
    message = cdr(new(JOINTS, header=header(), name=['hip'], position=turned, velocity=turned, effort=turned), JOINTS)
    publisher = watching.processes.publisher()
    publisher.create('/joint_states', JOINTS)
    publisher.heard('/joint_states', watching.node, message)
    for phase_s in (0.17, 0.05):  # the last message is just after a poll, and just before one
        until(lambda phase_s=phase_s: (time.time() - phase_s) % POLL_S < 0.02, 'it is time')
        publisher.publish('/joint_states', [message] * 60, 0.05)
        sent_s = time.monotonic()

        def is_told(sent_s: float = sent_s) -> bool:
            silent_s = time.monotonic() - sent_s
            return silent_s > 0.5 and abs(cell(page, '/joint_states', 'age') - silent_s) < 0.3

        until(is_told, lambda: f'the age on the page: {cell(page, "/joint_states", "age")}', 10.0)
        wrong_s = []
        while time.monotonic() < sent_s + 5.0:
            before_s = time.monotonic()
            age_s, after_s = cell(page, '/joint_states', 'age'), time.monotonic()
            wrong_s.append(max(0.0, abs(age_s - ((before_s + after_s) / 2 - sent_s)) - (after_s - before_s) / 2))
        print(f'its age differs by at most {most_of(wrong_s) * 1e3:.0f} ms from the truth')  # noqa: T201 - a measurement
        assert most_of(wrong_s) <= 0.2
    publisher.end()


def test_a_gap_is_on_the_timeline_at_its_time(page: Page, watching: Watching) -> None:
    """Messages published while the node was down, with cause restart, and the other gaps of ``ledger --gaps``."""
    watching.sim = watching.processes.sim(RATES)
    received = watching.node.topic('/imu')['received']
    watching.node.received('/imu', received + 20)
    watching.node.kill()
    time.sleep(3.0)  # messages are lost for this long, which is what is tested
    watching.node = watching.processes.node(parameters=EVENTS)
    received = watching.node.topic('/imu')['received']
    watching.node.received('/imu', received + 20)

    watching.sim.signal(signal.SIGINT)
    watching.sim.wait()

    def lacks() -> list[dict[str, Any]]:
        """Gaps of ``ledger --gaps`` that the page does not have."""
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
def test_a_click_on_the_timeline_shows_that_moment(page: Page, watching: Watching, tmp_path: Path) -> None:
    """A click on the timeline shows that time: frame, cloud, path and plots; playback continues from there.

    The commands on the page work unchanged, once the catalog of that minute has arrived: query finds the data, fetch and bag cut
    create files.
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
    print(f'{played(page, 5)[0]:.1f} moments a second of camera, cloud and plots')  # noqa: T201 - a measurement
    press(page.locator('[data-play]'))
    assert counted(page, 'imu') <= live + 3  # no viewer watches the live topics during that time
    home = {**watching.processes.environ, 'SHADOWHOUND_HOME': str(watching.home)}
    query = shlex.split(page.locator('[data-command=query]').inner_text())
    assert query[0] == 'shadowhound-data'
    command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', *query[1:], '--json']

    def answered() -> bool:
        ran = subprocess.run(command, env=home, capture_output=True, text=True, check=False, timeout=120)
        return {'camera', 'imu'} <= {row['sensor'] for row in json.loads(ran.stdout)}

    until(answered, f'{query} finds what is shown', 240.0)
    (bag,) = [
        name
        for name in page.locator('[data-mark=bag]').evaluate_all('all => all.map(mark => mark.dataset.name)')
        if not name.startswith('event_')
    ]
    of_bag = page.locator(f'[data-mark=bag][data-name="{bag}"] rect')
    cut = page.locator('[data-command="bag cut"]', has_text=bag)
    for minutes in (15, 1):  # by a click on the bag; the second time the timeline has little besides it
        press(page.get_by_role('button', name=f'{minutes} min', exact=True))
        at_ms = int(page.locator('[data-moment]').get_attribute('data-moment') or 0)
        for end, there in (('Min', at_ms - minutes * 30_000), ('Max', at_ms + minutes * 30_000)):
            holds(page, f'Math.abs({slider}.ariaValue{end} - {there}) < 10')
        page.evaluate('scrollTo({top: 0, behavior: "instant"})')
        spot = of_bag.bounding_box()
        assert spot is not None
        page.mouse.click(spot['x'] + spot['width'] / 2, spot['y'] + spot['height'] / 2)
        cut.wait_for()
    fetch = page.locator('[data-command=fetch]').inner_text()
    for line, folder, kinds in ((fetch, 'data', {'.jpg', '.json'}), (cut.inner_text(), 'cut', {'.mcap', '.yaml'})):
        shell = ['sh', '-c', line]
        ran = subprocess.run(shell, cwd=tmp_path, env=home, capture_output=True, text=True, check=False, timeout=120)
        assert ran.returncode == 0, (line, ran.stdout, ran.stderr)
        assert kinds <= {path.suffix for path in (tmp_path / folder).rglob('*') if path.stat().st_size}, (line, ran.stdout)
    press(page.get_by_role('button', name='Back to now'))
    page.locator('#data').wait_for()


def test_nothing_is_wider_than_the_screen(page: Page) -> None:
    """The robot's page, after all of these tests, on a laptop and on phones."""
    for width in (1440, 390, 320):
        fits(page, width)
    page.set_viewport_size({'width': 1280, 'height': 800})


def test_a_lost_first_request_is_repeated(browser: Browser, watching: Watching) -> None:
    """On a bad link the page may load, and its first request may get no response."""
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
