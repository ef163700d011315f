"""The data sent to one browser: the newest, small items first, and never more than it acknowledges."""

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
    PART,
    SMALL_FRAME,
    SMALL_ROOM,
    SMALLER,
    Viewer,
)


class Browser:
    """The receiving end: assembles frames, and acknowledges when the test says so."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.items: list[dict[str, Any]] = []
        self._frames = Frames()

    @property
    def received(self) -> int:
        return self._frames.bytes

    def read(self, most: int = 10_000) -> list[dict[str, Any]]:
        """Everything sent until the window is full."""
        before = len(self.items)
        while most and (frame := self.viewer.next_frame()) is not None:
            most -= 1
            assert len(frame) <= MAX_CHUNK + SMALL_FRAME + 4 * PART.size
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
    """A clock that tests advance."""
    return [0.0]


@pytest.fixture
def browser(now: list[float]) -> Browser:
    return Browser(Viewer(lambda: now[0]))


def all_of(browser: Browser) -> list[dict[str, Any]]:
    """Everything sent to a browser that acknowledges all of it."""
    found: list[dict[str, Any]] = []
    while True:
        before = browser.received
        found += browser.read()
        browser.acknowledge()
        if browser.received == before:
            return found


def test_an_item_arrives_unchanged(browser: Browser) -> None:
    """Its head and its body, however it was split into frames."""
    browser.viewer.offer(frame(7))
    (item,) = all_of(browser)
    assert (item['topic'], item['kind'], item['number'], item['body']) == ('/camera', 'camera', 7, bytes([7]) * 100_000)


def test_a_browser_that_reads_nothing_is_sent_a_window_and_holds_one_item_a_topic(browser: Browser) -> None:
    """However many items there are: those in flight, the one that was started, and the newest one."""
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
    """A row that arrives while a frame is being sent is in the next WebSocket frame."""
    browser.viewer.offer(frame(1))
    assert browser.read(2) == []
    browser.viewer.offer(row(1))
    assert [item['topic'] for item in browser.read(1)] == ['/imu']


def test_small_items_are_sent_together(browser: Browser) -> None:
    """In one frame, one of each topic in turn, up to a size; the rest in the next."""
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
    """A cloud in between costs a camera a fifth, not a half; a topic that was silent does not accumulate a share."""
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
    """The size follows the browser's acknowledgments."""
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
    """A browser with false acknowledgments gets no more than a silent one."""
    browser.viewer.offer(frame(1, 400_000))
    browser.read()
    before = browser.received
    browser.viewer.acknowledge(said)
    browser.read()
    assert browser.received - before <= MAX_CHUNK + PART.size


def test_topics_that_are_no_longer_watched_are_not_sent(browser: Browser) -> None:
    """A hidden tab watches nothing, and gets at most the item already started."""
    browser.viewer.watch(['/camera', '/imu'])
    browser.viewer.offer(row(1))
    browser.viewer.offer(frame(1))
    browser.viewer.watch([])
    assert all_of(browser) == []


class Link:
    """Carries a viewer's data at a rate; an acknowledgment takes the rest of the round trip. Times are in s."""

    def __init__(self, viewer: Viewer, now: list[float], rate: float, round_s: float) -> None:
        self.viewer, self.now, self.rate, self.round_s = viewer, now, rate, round_s
        self.carried = 0
        self._received = Frames()
        self._free_s = 0.0
        self._answers: list[tuple[float, int]] = []
        self.late_s: list[float] = []

    def run(self, seconds: float, camera_bytes: int = 60_000, camera_hz: float = 30.0) -> None:
        """A camera, and rows at 100 Hz, each with the time at which it was offered."""
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
    """At any distance, a link with enough bandwidth carries full size, and small items are only delayed by the latency."""
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
    """Nor is a distant one taken for a faster one: a row is delayed by the latency and by what may be in flight."""
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
    """A share of the earlier estimate: traffic next to video does not measure the link. Rows only wait for that part."""
    viewer = Viewer(lambda: now[0])
    viewer.round_s = 0.1
    link = Link(viewer, now, 2e6, 0.1)
    link.run(5.0)
    before = viewer.window
    viewer.has_video, rate = True, viewer.rate
    link.rate = 125_000.0  # video uses the rest
    link.run(2.0)
    link.carried = 0
    link.late_s.clear()
    link.run(10.0)
    assert viewer.rate == pytest.approx(rate, rel=0.01)  # one item was under way when the video began
    assert viewer.window < before / 3
    assert link.carried < 10 * rate * BESIDE_VIDEO * 1.3
    viewer.has_video = False
    link.rate = 2e6
    link.carried = 0
    link.run(10.0)
    assert link.carried > 10 * rate * BESIDE_VIDEO * 2


@pytest.mark.parametrize(('rate', 'chunk'), [(5e7, MAX_CHUNK), (60_000.0, MIN_CHUNK), (FIRST_RATE, int(FIRST_RATE * CHUNK_S))])
def test_a_piece_of_a_large_item_does_not_keep_a_link_for_long(browser: Browser, rate: float, chunk: int) -> None:
    """The next item waits 13 ms, unless the link is slower than the supported minimum."""
    browser.viewer.rate = rate
    browser.viewer.offer(frame(1, 400_000))
    sent = browser.viewer.next_frame()
    assert sent is not None
    assert len(sent) == chunk + PART.size


def test_with_video_frames_of_large_items_are_sized_by_their_share(browser: Browser) -> None:
    """Not for the full link: rows and video would wait for it."""
    browser.viewer.rate, browser.viewer.has_video = 4e6, True
    browser.viewer.offer(frame(1))
    sent = browser.viewer.next_frame()
    assert sent is not None
    assert len(sent) == int(4e6 * BESIDE_VIDEO * CHUNK_S) + PART.size


def test_small_items_are_sent_while_a_window_is_full(browser: Browser) -> None:
    """They do not wait until a large one is acknowledged; for a browser that acknowledges nothing, that ends."""
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
    """A kernel, or an intermediary, may report any value."""
    viewer = Viewer(lambda: now[0])
    viewer.rate, viewer.round_s = 1e12, 1e6
    assert viewer.window <= MAX_QUEUE + MAX_RATE * MAX_ROUND_S
