#!/usr/bin/env python3
"""The images of the live page in the documentation: a simulated Go2, a node that is killed once, and a store with several robots.

    scripts/with-env python bench/live_images.py [--to docs/images] [--seconds 40]

Writes ``live_desktop.jpg``, ``live_dark.jpg``, ``live_phone.jpg``, ``live_gap.jpg``, ``live_past.jpg`` and ``live_fleet.jpg``.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

sys.path.remove(str(Path(__file__).resolve().parent))  # it has a module lake, and test a folder lake
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
from domains import free_domain
from e2e.processes import COMMANDS, Processes
from lake.gap_parts import IMU
from lake.making import add, add_part, folder_store, row

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.formats.rows.gaps import GAP, GAPS, complete, date_of, statement
from shadowhound_data_logger.stores import open_store

FLAGS = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-sandbox']
DESKTOP, TALL, PHONE = ({'width': width, 'height': height} for width, height in ((1280, 1000), (1280, 1400), (390, 844)))
PARAMETERS = {'events.topics': ['/imu', '/camera/compressed'], 'events.pre_s': 3.0, 'events.post_s': 2.0}
RATES = 'rate_scale:=0.3'
"""The browser draws without a graphics card, next to the simulator."""
AWAY_S = 4.0
"""The node is killed for this long."""
SETTLE_MS = 4000
FRESH_S = 60.0
FLEET = (('rover', 20, 0), ('loki', 40, 1840), ('odin', 3 * 3600, 0), ('freya', 26 * 3600, 0), ('thor', 90, 12))
"""Robots: seconds since the last object, messages missing today."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--to', type=Path, default=Path(__file__).parents[1] / 'docs' / 'images')
    parser.add_argument('--seconds', type=float, default=40.0, help='how long the robot walks before and after the gap')
    options = parser.parse_args()
    program = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        robot(browser, Path(folder), options.to, options.seconds)
        fleet(browser, Path(folder), options.to)
        browser.close()


def robot(browser: Browser, folder: Path, to: Path, seconds: float) -> None:
    """The page of a robot, live and in the past."""
    with free_domain() as domain:
        processes = Processes(folder, domain, f'r{secrets.token_hex(4)}')
        try:
            node = processes.node(parameters=PARAMETERS, robot='rover')
            processes.sim(RATES)
            time.sleep(seconds)
            node.kill()
            time.sleep(AWAY_S)
            node = processes.node(parameters=PARAMETERS, robot='rover')
            _, url = processes.page(node)
            token = (node.home / 'live' / 'operator.token').read_text(encoding='ascii').strip()
            time.sleep(seconds / 2)
            page = opened(browser, url, DESKTOP)
            signed_in(page, token)
            page.locator('[data-act=event]').click()
            time.sleep(seconds / 2)
            shot(page, to / 'live_desktop.jpg')
            page.emulate_media(color_scheme='dark')
            shot(page, to / 'live_dark.jpg')
            page.emulate_media(color_scheme='light')
            phone = opened(browser, url, PHONE, has_touch=True, is_mobile=True, device_scale_factor=2)
            shot(phone, to / 'live_phone.jpg')
            phone.context.close()
            page.get_by_role('button', name='Back in time').click()
            page.locator('rect.recorded[data-topic="/odom"]').first.wait_for()
            page.locator('[data-jump="gap -1"]').click()
            page.locator('.chosen').wait_for()
            shot(page, to / 'live_gap.jpg')
            page.locator('[data-jump="event 1"]').click()
            page.set_viewport_size(TALL)
            shot(page, to / 'live_past.jpg')
            page.context.close()
        finally:
            processes.end()


def fleet(browser: Browser, folder: Path, to: Path) -> None:
    """The page of a store with several robots."""
    home = folder / 'server'
    settings, now_ns = folder_store(home), time.time_ns()
    with closing(open_store(settings, UploadSettings())) as store:
        for name, ago_s, lost in FLEET:
            at_ns = now_ns - ago_s * SECOND
            rows = [row('camera', at_ns - second * SECOND, name, mission_id=f'patrol_{name}', mission_type='patrol')
                    for second in range(60)]  # fmt: skip
            for date in sorted(set(map(catalog.date_of, rows))):
                add_part(store, [one for one in rows if catalog.date_of(one) == date], 'a', folder / 'tmp')
            reported = [complete(name, 'j', 1, from_ns=at_ns - 60 * SECOND, to_ns=at_ns, received=3000, skipped=0, **IMU)]
            if lost:
                reported.append(statement(
                    name, GAP, 'j/1', 1, kind='missed', cause='transport', count=lost, merged=1, publisher='imu', **IMU,
                    from_ns=at_ns - 30 * SECOND, to_ns=at_ns - 20 * SECOND,
                ))  # fmt: skip
            for date in sorted({date_of(one) for one in reported}):
                body = parts.encode([one for one in reported if date_of(one) == date], GAPS)
                add(store, folder / 'tmp', GAPS.part_key(name, date, 'a'), body, {'robot': name})
    with served(home) as url:
        page = opened(browser, url, {**DESKTOP, 'height': 790})
        page.locator('tr[data-robot]:not([data-state=unknown])').first.wait_for()
        shot(page, to / 'live_fleet.jpg')
        page.context.close()


@contextmanager
def served(home: Path) -> Iterator[str]:
    """The page of the store in a folder."""
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(home)}
    environ.pop('AWS_ENDPOINT_URL', None)
    command = [sys.executable, '-m', COMMANDS, 'live', '--port', '0', '--json']
    process = subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        printed = ''
        while not printed.rstrip().endswith('}'):
            printed += process.stdout.readline()
        yield json.loads(printed)['url']
    finally:
        process.terminate()
        process.wait()


def opened(browser: Browser, url: str, size: Any, **more: Any) -> Page:
    page = browser.new_context(viewport=size, **more).new_page()
    page.set_default_timeout(120_000)
    page.goto(url)
    return page


def signed_in(page: Page, token: str) -> None:
    page.get_by_role('button', name='Sign in', exact=True).click()
    page.locator('dialog input[name=token]').fill(token)
    page.locator('dialog button.primary').click()
    page.locator('[data-act=event]').wait_for()


def shot(page: Page, path: Path) -> None:
    """Once nothing on the page is marked as old: a busy machine shows some things late."""
    page.wait_for_timeout(SETTLE_MS)
    end_s = time.monotonic() + FRESH_S
    while page.locator('.age.old').count() and time.monotonic() < end_s:
        page.wait_for_timeout(200)
    page.evaluate("scrollTo({top: 0, behavior: 'instant'})")
    page.wait_for_timeout(500)
    page.screenshot(path=path, type='jpeg', quality=80, timeout=120_000)
    print(path, path.stat().st_size // 1000, 'KB')


if __name__ == '__main__':
    main()
