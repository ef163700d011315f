"""What an operator sees on the live page, in a real Chromium, while the store is unreachable, and while the node is killed."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING

import pytest
from e2e.processes import GENTLE, Node, Processes, until
from e2e.wire import PASS, REFUSE, Wire
from live.browsing import CHROMIUM, holds, opened, press
from shadowhound_tower.embedded import Tower

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [
    pytest.mark.slow,
    pytest.mark.long('a robot, a node, its page, a store and a Chromium'),
    pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium'),
]
KEPT = {
    'camera.rate_hz': 0.0, 'camera.batch_s': 1.0, 'camera.format': 'tar', 'camera.ship': 'on_request',
    'keep.max_bytes': 10**9, 'keep.poll_s': 1.0, 'events.topics': ['/imu'], 'events.pre_s': 1.0, 'events.post_s': 0.5,
    'upload.max_backoff_s': 0.5,
}  # fmt: skip


def signed_in(browser: Browser, node: Node, url: str) -> Page:
    """The page of an operator, with data."""
    page = opened(browser, url)
    press(page.get_by_role('button', name='Sign in as operator'))
    page.locator('dialog input[name=token]').fill((node.home / 'live/operator.token').read_text().strip())
    press(page.locator('dialog button.primary'))
    page.locator('.controls [data-act=event]').wait_for()
    return page


def shows(page: Page, selector: str, words: str) -> None:
    """Wait until some element contains the words."""
    texts = f'[...document.querySelectorAll({json.dumps(selector)})].map((each) => each.textContent)'
    until(lambda: any(words in text for text in page.evaluate(texts)), lambda: f'{words!r} in {page.evaluate(texts)}')


def test_an_operator_works_while_the_store_is_unreachable(processes: Processes, browser: Browser, seaweed: Tower) -> None:
    """Events are saved, bags are cut and kept data is requested, and sent later; only a label needs the store, and reports it."""
    with Wire(seaweed.endpoint_url) as wire:
        store = {**seaweed.environment(), 'AWS_ENDPOINT_URL': wire.url}
        node = processes.node(store, KEPT)
        processes.sim('image_raw:=false', GENTLE)
        until(lambda: node.ledger()['objects']['delivered'] > 5, 'objects are delivered')
        _, url = processes.page(node, environ=store)
        page = signed_in(browser, node, url)
        wire.set(REFUSE)
        shows(page, '[data-field=store]', 'the store is unreachable')
        shows(page, '[data-field=left]', 'once the store can be reached')
        press(page.locator('.controls [data-act=event]'))
        shows(page, '.answers li:not(.bad)', 'event_manual')
        until(lambda: any((node.home / 'spool').rglob('event_manual*.mcap')), 'the bag of the event is complete')
        press(page.get_by_role('button', name='Back in time'))
        page.get_by_label('Of which time').select_option('range')
        press(page.locator('[data-act=pull]'))
        shows(page, '[data-waits-for-node]', 'accepts it once the store can be reached')
        holds(page, 'document.querySelector("[data-cut]") !== null')
        press(page.locator('[data-cut]').first)
        page.locator('[data-piece]').wait_for()
        page.locator('input[name=label]').fill('stairs')
        press(page.locator('[data-act=label]'))
        shows(page, '.label-form .note.bad', 'not labeled: the S3 server')
        wire.set(PASS)
        holds(page, 'document.querySelector("[data-request]")?.dataset.state === "done"')
        assert page.locator('[data-waits-for-node]').count() == 0
        press(page.get_by_role('button', name='Back to now'))
        holds(page, '!/unreachable/.test(document.querySelector("[data-field=store]")?.textContent ?? "unreachable")')
        assert page.locator('.cards .bad:not(i)').count() == 0
        page.close()


def test_a_killed_node_is_not_shown_as_recording(processes: Processes, browser: Browser) -> None:
    """No topic is marked as recorded then, and no time as complete; after a restart the losses are red until they are seen."""
    node = processes.node(None, KEPT)
    processes.sim('image_raw:=false', GENTLE)
    _, url = processes.page(node)
    page = signed_in(browser, node, url)
    mark = 'document.querySelector(\'tr[data-row="/imu"] .mark\')?.className'
    holds(page, f'{mark} === "mark good"')
    node.signal(signal.SIGKILL)
    node.wait()
    shows(page, '.pill', 'the node is not running')
    holds(page, 'document.querySelectorAll("table.topics .mark.good").length === 0')
    press(page.locator('.controls [data-act=event]'))
    shows(page, '.answers li.bad', f'no node of {node.robot} is running')
    shows(page, '.losses', 'No loss is known since')
    node = processes.node(None, KEPT)
    shows(page, '.pill', 'recording')
    holds(page, f'{mark} === "mark bad" || {mark} === "mark watch"')
    shows(page, '.losses', 'The node was not running.')
    press(page.get_by_role('button', name='I have seen them'))
    holds(page, f'{mark} === "mark good"')
    assert page.locator('.pill').inner_text() == 'recording'
    assert page.wrong == []  # type: ignore[attr-defined]
    page.close()
