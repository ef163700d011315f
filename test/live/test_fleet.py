"""All robots of a store at a glance: their states, their order, and the table in a real Chromium."""

from __future__ import annotations

import shlex
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from lake.gap_parts import lost, mark, tell
from lake.making import DAY_NS, NOON_NS, add, add_part, folder_store, row
from live.browsing import CHROMIUM, HOSTILE, Served, fits, holds, opened, press
from live.test_history import MISSION

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.live.fleet import BAD, GOOD, SILENT, WATCH, overview
from shadowhound_data_logger.live.server import LiveSettings
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def store_of(folder: Path, now_ns: int) -> None:
    """Four robots last seen a moment ago, two days ago, or a month ago, and a folder that is not a robot's."""
    with closing(open_store(folder_store(folder), UploadSettings())) as store:
        for name, at_ns in (('thor', now_ns), ('loki', now_ns), ('odin', now_ns - 2 * DAY_NS), ('freya', now_ns - 30 * DAY_NS)):
            rows = [
                row('camera', at_ns + second * SECOND, name, mission_id=HOSTILE, mission_type='patrol') for second in range(3)
            ]
            add_part(store, rows, 'a', folder / 'tmp')
    (folder / 'store' / 'sensor-data' / '<img src=x onerror=attacked=1>').mkdir()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home with a directory store."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    return tmp_path


@pytest.fixture
def robots(home: Path) -> Path:
    """The robots at noon, and the losses of one of them."""
    store_of(home, NOON_NS)
    tell(folder_store(home), home, lost('1', 3, 4, cause='transport', topic='/imu', count=7), mark(8, topic='/imu'))
    return home


def test_robots_that_need_attention_come_first(robots: Path) -> None:
    """Those with losses today first, then healthy ones, then those offline; of a long-silent robot the last day is known."""
    found = overview(Bucket(folder_store(robots), 'sensor-data'), Findings(lambda _: None), NOON_NS + 60 * SECOND)
    reports = [(one.robot, one.state(NOON_NS + 60 * SECOND)[0], sum(one.lost.values())) for one in found]
    assert reports[0] == ('thor', WATCH, 7)
    assert [state for _, state, _ in reports[2:]] == [SILENT, SILENT]
    by_name = {one.robot: one for one in found}
    assert list(by_name) == ['thor', 'loki', 'odin', 'freya']
    assert by_name['thor'].known_ns == NOON_NS + 8 * SECOND
    assert by_name['thor'].mission == HOSTILE
    assert by_name['loki'].last_ns == NOON_NS + 2 * SECOND
    assert by_name['freya'].last_ns == 0
    assert by_name['freya'].last_date == '2026-09-28'


def test_a_new_robot_is_not_silent(home: Path) -> None:
    """Its folder is in the store before the first rows of its catalog: then nothing is known about its last message."""
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        add(store, home / 'tmp', 'loki/camera/20261028/120000_x.jpg', b'x')
    (found,) = overview(Bucket(folder_store(home), 'sensor-data'), Findings(lambda _: None), NOON_NS)
    assert found.state(NOON_NS) == (SILENT, 'the catalog has no data of it yet')


def test_data_that_the_robot_had_and_lost_is_worse(robots: Path) -> None:
    """Than messages that it never received."""
    settings = folder_store(robots)
    tell(settings, robots, lost('2', 5, 6, kind='quarantined', cause='access_denied', topic='/imu', count=1), name='b')
    found = overview(Bucket(settings, 'sensor-data'), Findings(lambda _: None), NOON_NS + 60 * SECOND)
    assert (found[0].robot, found[0].state(NOON_NS + 60 * SECOND)[0]) == ('thor', BAD)
    tomorrow_ns = NOON_NS + DAY_NS
    tomorrow = {one.robot: one for one in overview(Bucket(settings, 'sensor-data'), Findings(lambda _: None), tomorrow_ns)}
    assert tomorrow['thor'].state(tomorrow_ns)[0] == GOOD


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_the_table_of_robots_is_ordered_and_leads_to_each(browser: Browser, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, with names as text; a click shows the past of that robot."""
    store_of(home, time.time_ns() - 10 * SECOND)
    settings = LiveSettings(spool=home / 'none', robot='', tokens=home / 'live', port=0, is_of_store=True)
    with Served(settings, monkeypatch) as served:
        page = opened(browser, served.server.url)
        holds(page, 'document.querySelectorAll("tr[data-robot]:not([data-state=unknown])").length === 4')
        rows = 'document.querySelectorAll("tr[data-robot]")'
        assert page.evaluate(f'[...{rows}].map(row => row.dataset.robot)') == ['loki', 'thor', 'odin', 'freya']
        assert HOSTILE in page.locator('.fleet').inner_text()
        page.locator('tr[data-robot=odin] button').dispatch_event('click')
        holds(page, 'document.querySelector("tr.shown").dataset.robot === "odin"')
        for width in (1280, 390):
            fits(page, width)
        assert page.evaluate('[window.attacked ?? null, document.querySelectorAll("img[src=x]").length]') == [None, 0]
        assert page.wrong == []  # type: ignore[attr-defined]
        page.close()


NAMES = (
    '\u202egnp.exe',
    '\x1b]0;title\x07\x00',
    'mission ' * 1250,
    MISSION,
    '\u05d0\u05d1 \u0627\u0628',
    f'"><{HOSTILE}',
    '${7*7}',
)
"""Mission names: text that changes the direction or moves a cursor, 10 kB, right-to-left words, code."""


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_hostile_names_of_missions_are_text(browser: Browser, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the table of robots, on the timeline, in the list of missions and in commands: on one line, truncated if long.

    Commands quote them for a shell; what is copied is the text that is shown.
    """
    now_ns = time.time_ns() - 60 * SECOND
    with closing(open_store(folder_store(home), UploadSettings())) as store:
        for place, name in enumerate(NAMES):
            of_timeline = row('camera', now_ns + place * SECOND, 'thor', mission_id=name, mission_type=name)
            of_table = row('camera', now_ns, f'r{place}', mission_id=name, mission_type=name)
            add_part(store, [of_timeline], f'a{place}', home / 'tmp')
            add_part(store, [of_table], 'a', home / 'tmp')
    settings = LiveSettings(spool=home / 'none', robot='thor', tokens=home / 'live', port=0, is_of_store=True)
    with Served(settings, monkeypatch) as served:
        page = opened(browser, served.server.url)
        holds(page, f'document.querySelectorAll("[data-mark=mission]").length === {len(NAMES)}')
        holds(page, f'document.querySelectorAll("tr[data-state]:not([data-state=unknown])").length === {len(NAMES) + 1}')
        shown = page.locator('[data-mark=mission]').evaluate_all('all => all.map(one => one.dataset.name)')
        assert all(name.isprintable() and len(name) < 500 for name in shown)
        assert {*NAMES[3:]} <= set(shown)
        assert all(each.isprintable() for each in page.locator('body').inner_text().split())
        page.get_by_label('Of which time').select_option('range')
        exports = page.locator('[data-command=export]')
        exports.first.wait_for()
        lines = [shlex.split(line) for line in exports.all_text_contents()]
        assert [line[line.index('--mission') + 1] for line in lines] == list(NAMES[3:6])
        page.context.grant_permissions(['clipboard-read', 'clipboard-write'])
        press(page.locator('p:has(> [data-command=export]) button').first)
        holds(page, "navigator.clipboard.readText().then(text => text.includes('--mission'))")
        assert page.evaluate('navigator.clipboard.readText()') == exports.first.text_content()
        page.get_by_label('Mission', exact=True).select_option('2')
        page.evaluate('document.querySelectorAll("details").forEach(each => { each.open = true; })')
        for width in (1280, 390):
            fits(page, width)
        assert page.evaluate('[window.attacked ?? null, document.querySelectorAll("img[src=x]").length]') == [None, 0]
        assert page.wrong == []  # type: ignore[attr-defined]
        page.close()
