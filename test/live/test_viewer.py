"""What one browser gets: the newest, small things first, and never more than it acknowledges."""

from __future__ import annotations

from typing import Any

import pytest
from e2e.live_frames import Frames

from shadowhound_data_logger.live.kinds import FULL, SMALLEST, LiveItem
from shadowhound_data_logger.live.viewer import (
    BESIDE_VIDEO,
    CHUNK_S,
    FIRST_RATE,
    MAX_CHUNK,
    MAX_QUEUE,
    MAX_RATE,
    MAX_ROUND_S,
    MAX_ROWS_WAITING,
    MIN_CHUNK,
    MIN_QUEUE,
    SMALL_FRAME,
    SMALL_ROOM,
    SMALLER,
    Viewer,
)


class Browser:
    """The other end: puts frames together, and acknowledges when it is told to."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.items: list[dict[str, Any]] = []
        self._frames = Frames()

    @property
    def received(self) -> int:
        return self._frames.bytes

    def read(self, most: int = 10_000) -> list[dict[str, Any]]:
        """What comes until nothing more may be sent."""
        before = len(self.items)
        while most and (frame := self.viewer.next_frame()) is not None:
            most -= 1
            assert len(frame) <= MAX_CHUNK + 4
            self.items += [{**head, 'body': body} for head, body in self._frames.take(frame)]
        return self.items[before:]

    def acknowledge(self) -> None:
        self.viewer.acknowledge(self.received & 0xFFFF_FFFF)


def frame(number: int, size: int = 100_000, topic: str = '/camera') -> LiveItem:
    return LiveItem(topic, 'camera', FULL, {'number': number}, bytes([number % 251]) * size)


def row(number: int, topic: str = '/imu') -> LiveItem:
    return LiveItem(topic, 'imu', FULL, {'number': number}, b'12345678')


@pytest.fixture
def now() -> list[float]:
    """A clock that tests turn."""
    return [0.0]


@pytest.fixture
def browser(now: list[float]) -> Browser:
    return Browser(Viewer(lambda: now[0]))


def all_of(browser: Browser) -> list[dict[str, Any]]:
    """What comes to a browser that acknowledges everything."""
    found: list[dict[str, Any]] = []
    while True:
        before = browser.received
        found += browser.read()
        browser.acknowledge()
        if browser.received == before:
            return found


def test_an_item_arrives_unchanged(browser: Browser) -> None:
    """Its head and its body, whatever was cut into frames."""
    browser.viewer.offer(frame(7))
    (item,) = all_of(browser)
    assert (item['topic'], item['kind'], item['number'], item['body']) == ('/camera', 'camera', 7, bytes([7]) * 100_000)


def test_a_browser_that_reads_nothing_is_sent_a_window_and_holds_one_item_a_topic(browser: Browser) -> None:
    """However much comes: what is under way, the item that was begun, and the newest one."""
    for number in range(500):
        browser.viewer.offer(frame(number))
        browser.viewer.offer(row(number))
        browser.read()
    assert MIN_QUEUE <= browser.received <= MAX_QUEUE + MAX_CHUNK
    browser.acknowledge()
    items = all_of(browser)
    frames = [item['number'] for item in items if item['topic'] == '/camera']
    assert len(frames) <= 2
    assert frames[-1] == 499
    rows = [item['number'] for item in items if item['topic'] == '/imu']
    assert rows == list(range(500 - MAX_ROWS_WAITING, 500))
    assert browser.viewer.replaced > 400


def test_small_items_are_sent_before_the_rest_of_a_large_one(browser: Browser) -> None:
    """A row that comes while a frame is under way is in the next frame of the WebSocket."""
    browser.viewer.offer(frame(1))
    assert browser.read(2) == []
    browser.viewer.offer(row(1))
    assert [item['topic'] for item in browser.read(1)] == ['/imu']


def test_small_items_are_sent_together(browser: Browser) -> None:
    """In one frame, of each topic in turn, as long as it is small; the rest in the next."""
    for number in range(3):
        for topic in ('/imu', '/odom'):
            browser.viewer.offer(row(number, topic))
    browser.viewer.offer(LiveItem('/joints', 'joints', FULL, {'number': 0}, bytes(2 * SMALL_FRAME)))
    browser.viewer.offer(row(1, '/joints'))
    found = [[(item['topic'], item['number']) for item in browser.read(1)] for _ in range(3)]
    assert found == [
        [('/imu', 0), ('/odom', 0), ('/joints', 0)],
        [('/imu', 1), ('/odom', 1), ('/joints', 1), ('/imu', 2), ('/odom', 2)],
        [],
    ]


def test_bulk_topics_share_a_link_by_weight(browser: Browser) -> None:
    """A cloud in between costs a camera a fifth, not a half; one that was silent has no claim on what it did not use."""
    for number in range(50):
        browser.viewer.offer(frame(number, 20_000))
        all_of(browser)
    sizes = {'/camera': 0, '/cloud': 0}
    for number in range(400):
        browser.viewer.offer(frame(number, 200_000))
        browser.viewer.offer(LiveItem('/cloud', 'cloud', FULL, {}, bytes(200_000)))
        for item in browser.read(2):
            sizes[item['topic']] += len(item['body'])
        browser.acknowledge()
    assert 3.0 < sizes['/camera'] / sizes['/cloud'] < 5.0


def test_a_slow_link_gets_smaller_pictures_and_a_better_one_larger_again(browser: Browser, now: list[float]) -> None:
    """The size follows what the browser acknowledges."""
    viewer = browser.viewer

    def through(bytes_per_s: float, seconds: float) -> None:
        end = now[0] + seconds
        while now[0] < end:
            size = viewer.size('/camera')
            viewer.offer(LiveItem('/camera', 'camera', size, {}, bytes(int(60_000 * SMALLER[size]))))
            for _ in range(12):
                before = browser.received
                browser.read(1)
                now[0] += max(browser.received - before, 1) / bytes_per_s
                browser.acknowledge()
            viewer.choose_sizes()

    through(5e6, 5.0)
    assert viewer.size('/camera') == FULL
    through(60_000, 30.0)
    assert viewer.size('/camera') == SMALLEST
    assert viewer.window < 30_000
    through(5e6, 10.0)
    assert viewer.size('/camera') == FULL


@pytest.mark.parametrize('said', [0, 1, 0xFFFF_FFFF, 0x8000_0000])
def test_an_acknowledgement_of_what_was_not_sent_opens_no_window(browser: Browser, said: int) -> None:
    """A browser that lies gets no more than one that is silent."""
    browser.viewer.offer(frame(1, 400_000))
    browser.read()
    before = browser.received
    browser.viewer.acknowledge(said)
    browser.read()
    assert browser.received - before <= MAX_CHUNK + 4


def test_topics_that_are_no_longer_watched_are_not_sent(browser: Browser) -> None:
    """A hidden tab watches nothing, and gets at most what was begun."""
    browser.viewer.watch(['/camera', '/imu'])
    browser.viewer.offer(row(1))
    browser.viewer.offer(frame(1))
    browser.viewer.watch([])
    assert all_of(browser) == []


class Link:
    """Carries what a viewer is sent at a rate, after which an acknowledgement takes the rest of a round. Times are in s."""

    def __init__(self, viewer: Viewer, now: list[float], rate: float, round_s: float) -> None:
        self.viewer, self.now, self.rate, self.round_s = viewer, now, rate, round_s
        self.carried = 0
        self._received = Frames()
        self._free_s = 0.0
        self._answers: list[tuple[float, int]] = []
        self.late_s: list[float] = []

    def run(self, seconds: float, camera_bytes: int = 60_000, camera_hz: float = 30.0) -> None:
        """A camera, and rows at 100 Hz, each of which says when it was offered."""
        camera_s = row_s = self.now[0]
        sizes_s, end_s = self.now[0] + 1, self.now[0] + seconds
        while self.now[0] < end_s:
            if self.now[0] >= camera_s:
                camera_s += 1 / camera_hz
                size = self.viewer.size('/camera')
                self.viewer.offer(LiveItem('/camera', 'camera', size, {}, bytes(int(camera_bytes * SMALLER[size]))))
            if self.now[0] >= row_s:
                row_s += 0.01
                self.viewer.offer(LiveItem('/imu', 'imu', FULL, {'at': self.now[0]}, bytes(60)))
            if self.now[0] >= sizes_s:
                sizes_s += 1
                self.viewer.choose_sizes()
            while self._answers and self._answers[0][0] <= self.now[0]:
                self.viewer.acknowledge(self._answers.pop(0)[1] & 0xFFFF_FFFF)
            while (sent := self.viewer.next_frame()) is not None:
                self._free_s = max(self._free_s, self.now[0]) + len(sent) / self.rate
                self.carried += len(sent)
                for head, _ in self._received.take(sent):
                    if head['topic'] == '/imu':
                        self.late_s.append(self._free_s + self.round_s / 2 - head['at'])
                self._answers.append((self._free_s + self.round_s, self._received.bytes))
            self.now[0] += 0.001


@pytest.mark.parametrize('round_s', [0.0, 0.02, 0.1, 0.25])
def test_a_link_with_a_long_round_trip_is_filled(now: list[float], round_s: float) -> None:
    """However far the robot is, a link that carries everything does: in full size, and small items are as late as the way is."""
    viewer = Viewer(lambda: now[0])
    viewer.round_s = round_s
    link = Link(viewer, now, 4e6, round_s)
    link.run(5.0)
    link.late_s.clear()
    link.carried = 0
    link.run(10.0)
    assert viewer.size('/camera') == FULL
    assert link.carried > 10 * 30 * 60_000 * 0.9
    late = sorted(link.late_s)
    assert late[int(len(late) * 0.95)] < round_s / 2 + 0.03


@pytest.mark.parametrize('round_s', [0.0, 0.1])
@pytest.mark.parametrize('rate', [60_000.0, 250_000.0, 1e6])
def test_a_narrow_link_is_not_filled_beyond_what_it_holds(now: list[float], rate: float, round_s: float) -> None:
    """Nor is a far one taken for a faster one: a row is late by the way and by what may wait on it."""
    viewer = Viewer(lambda: now[0])
    viewer.round_s = round_s
    link = Link(viewer, now, rate, round_s)
    link.run(10.0)
    link.late_s.clear()
    link.run(20.0)
    late = sorted(link.late_s)
    assert 0.5 * rate < viewer.rate < 1.5 * rate
    assert late[int(len(late) * 0.95)] < round_s / 2 + (MIN_QUEUE + 2 * 4_096) / rate + 0.08


def test_with_video_large_items_get_a_share_of_the_link(now: list[float]) -> None:
    """Of the link as it was before: what goes beside video tells nothing of it. Rows wait for no more than that part of a way."""
    viewer = Viewer(lambda: now[0])
    viewer.round_s = 0.1
    link = Link(viewer, now, 2e6, 0.1)
    link.run(5.0)
    before = viewer.window
    viewer.has_video, rate = True, viewer.rate
    link.rate = 125_000.0  # video has the rest
    link.run(2.0)
    link.carried = 0
    link.late_s.clear()
    link.run(10.0)
    assert viewer.rate == rate
    assert viewer.window < before / 3
    assert link.carried < 10 * rate * BESIDE_VIDEO * 1.3
    viewer.has_video = False
    link.rate = 2e6
    link.carried = 0
    link.run(10.0)
    assert link.carried > 10 * rate * BESIDE_VIDEO * 2


@pytest.mark.parametrize(('rate', 'chunk'), [(5e6, MAX_CHUNK), (60_000.0, MIN_CHUNK), (FIRST_RATE, int(FIRST_RATE * CHUNK_S))])
def test_a_piece_of_a_large_item_does_not_keep_a_link_for_long(browser: Browser, rate: float, chunk: int) -> None:
    """What comes after it waits 13 ms, where the link is not slower than is worth while."""
    browser.viewer.rate = rate
    browser.viewer.offer(frame(1))
    sent = browser.viewer.next_frame()
    assert sent is not None
    assert len(sent) == chunk + 4


def test_with_video_frames_of_large_items_are_sized_by_their_share(browser: Browser) -> None:
    """Not as the whole link: rows and video would wait for it."""
    browser.viewer.rate, browser.viewer.has_video = 4e6, True
    browser.viewer.offer(frame(1))
    sent = browser.viewer.next_frame()
    assert sent is not None
    assert len(sent) == int(4e6 * BESIDE_VIDEO * CHUNK_S) + 4


def test_small_items_are_sent_while_a_window_is_full(browser: Browser) -> None:
    """They do not wait until a large one is acknowledged; for who acknowledges nothing, that ends."""
    browser.viewer.offer(frame(1, 400_000))
    browser.read()
    before = browser.received
    browser.viewer.offer(row(1))
    assert [item['topic'] for item in browser.read()] == ['/imu']
    for number in range(1000):
        browser.viewer.offer(row(number))
        browser.read()
    assert browser.received - before <= SMALL_ROOM + SMALL_FRAME


def test_an_implausible_link_rate_is_not_trusted(now: list[float]) -> None:
    """A kernel, or who stands in between, may say anything."""
    viewer = Viewer(lambda: now[0])
    viewer.rate, viewer.round_s = 1e12, 1e6
    assert viewer.window <= MAX_QUEUE + MAX_RATE * MAX_ROUND_S
