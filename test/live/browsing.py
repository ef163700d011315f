"""The live page in Chromium, with a server in this process: opening it, pressing its buttons, and waiting for its contents."""

from __future__ import annotations

import ast
import asyncio
import json
import re
import secrets
import shutil
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from domains import free_domain
from e2e.processes import Processes, until

import shadowhound_data_logger
from shadowhound_data_logger.bags.recording import UNWRITABLE
from shadowhound_data_logger.bags.ring import RING_FULL
from shadowhound_data_logger.lake.prune import CAUSE as RETENTION
from shadowhound_data_logger.live import server as server_module
from shadowhound_data_logger.live.kinds import LiveItem
from shadowhound_data_logger.live.server import LiveServer, LiveSettings
from shadowhound_data_logger.node.encoding.encode_pool import ENCODER_FAILED
from shadowhound_data_logger.node.intake.sampling import QUEUE_FULL, SAMPLER_FAILED
from shadowhound_data_logger.spool.estimator import RESTART, SILENCE, TRANSPORT
from shadowhound_data_logger.spool.object_table import MISSING
from shadowhound_data_logger.spool.recovery import DAMAGED
from shadowhound_data_logger.spool.retention import KEEP_DAYS, KEEP_LIMIT, NO_ROOM, THINNED
from shadowhound_data_logger.spool.topic_account import PAUSED, WRONG_TYPE

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page
    from typing_extensions import Self


CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
FLAGS = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-sandbox']


def opened(browser: Browser, url: str) -> Page:
    """A tab that records its requests (``asked``) and its errors (``wrong``)."""
    page: Any = browser.new_page(viewport={'width': 1280, 'height': 800})
    page.set_default_timeout(120_000)
    page.wrong = []
    page.asked = []
    page.on('pageerror', lambda error: page.wrong.append(str(error)))
    page.on('console', lambda message: page.wrong.append(message.text) if message.type == 'error' else None)
    page.on('request', lambda request: page.asked.append(request.url))
    page.goto(url)
    return page


def press(button: Locator) -> None:
    """Click without waiting for frames: a software GL on a busy machine draws few."""
    button.dispatch_event('click')


def holds(page: Page, script: str) -> None:
    """Wait until the expression is true in the page, which does not allow evaluating text (``script-src 'self'``)."""
    until(lambda: page.evaluate(script), script)


def wider(page: Page, width: int) -> list[Any]:
    """Everything that extends beyond the right edge of a screen with this width, once the page is laid out for it."""
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


HOSTILE = '<img src=x onerror="window.attacked = 1">'
LONG = 'unbroken_' * 14
NAMES = (HOSTILE, LONG)


@contextmanager
def in_own_domain(folder: Path) -> Iterator[Processes]:
    """A robot's processes in a separate ROS domain; all are stopped at the end."""
    with free_domain() as domain:
        started = Processes(folder, domain, f'r{secrets.token_hex(4)}')
        try:
            yield started
        finally:
            started.end()


class Served:
    """A live page in this process, on a separate thread; a context manager that closes it."""

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
        """Repeatedly show what ``make`` returns as data from the robot; returns a function that stops it."""

        async def show() -> None:
            while True:
                self.server.viewers.on_items(made())
                await asyncio.sleep(seconds)

        return asyncio.run_coroutine_threadsafe(show(), self.loop).cancel

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.run(self.server.close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join()
        self.loop.close()


def told_of_names(now_ms: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values and gaps in which every text is hostile or long."""
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


def literals(folder: str, error: str, keyword: str = '') -> set[str]:
    """The string literals with which that part of the package raises an error."""
    found: set[str] = set()
    for path in (Path(shadowhound_data_logger.__file__).parent / folder).rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == error:
                given = [each.value for each in node.keywords if each.arg == keyword] if keyword else node.args[:1]
                found |= {str(each.value) for each in given if isinstance(each, ast.Constant)}
    return found


CAUSES = [
    TRANSPORT, RESTART, SILENCE, PAUSED, WRONG_TYPE, DAMAGED, MISSING, NO_ROOM, KEEP_LIMIT, KEEP_DAYS, THINNED, QUEUE_FULL,
    SAMPLER_FAILED, ENCODER_FAILED, UNWRITABLE, RING_FULL, RETENTION, 'shutdown', 'stopped', 'foreign', 'access_denied',
    'refused', *literals('encode', 'Rejected'), *literals('stores', 'ObjectRefused', 'reason'),
]  # fmt: skip
"""The causes of missing messages that the code knows; a server may have others."""
IMU = 'sensor_msgs/msg/Imu'


def counted(page: Page, kind: str) -> int:
    return int(page.evaluate(f'shadowhound.count[{json.dumps(kind)}] ?? 0'))


def rgb(color: str) -> list[int]:
    """A computed color as RGB."""
    return [int(part) for part in re.findall(r'\d+', color)[:3]]


def most_of(found: list[float]) -> float:
    """19 of 20 are no larger: occasionally a busy machine makes a page wait."""
    return sorted(found)[len(found) * 19 // 20]
