"""Publishers whose stamps and arrivals differ in a known way, and the witness file of what they published.

``python -m torture._skewed WITNESS SECONDS`` waits until each topic has a subscriber, publishes for this long and exits. It
does not import the package under test.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

SECOND: Final = 10**9
ODOMETRY: Final = 'nav_msgs/msg/Odometry'
IMAGE: Final = 'sensor_msgs/msg/CompressedImage'
DEPTH: Final = 1000
BLOCK: Final = 8
BITS: Final = 16
"""An image shows its number as this many squares, black or white."""
DRIFT: Final = 500e-6
MATCH_S: Final = 60.0
SIM_BEGIN_S: Final = 1000.0


class Turn(NamedTuple):
    """The position of a publisher in its run."""

    now_ns: int
    """The true time of measurement."""
    elapsed_s: float
    share: float
    """Fraction of the run, 0 to 1."""


Stamp = Callable[[Turn], int]


@dataclass(frozen=True, slots=True)
class Skewed:
    """One topic. Its sensor has the name of the topic."""

    name: str
    stamps: tuple[Stamp, ...]
    """One per publisher: turn -> stamp in ns."""
    causes: frozenset[str] = frozenset()
    """The causes that the node may report at the end of the run; empty: it must not be reported."""
    offset_s: tuple[float, ...] = ()
    """Received minus stamp at the end of the run, for each publisher that may be reported."""
    by_arrival: bool = False
    """Whether some of its stamps are not trusted: those messages are dated by their arrival."""
    held: tuple[tuple[float, float], ...] = ()
    """Fractions of the run during which due messages wait in a queue of the publisher."""
    type: str = ODOMETRY
    hz: float = 10.0

    @property
    def topic(self) -> str:
        return f'/{self.name}'


def constant(ahead_s: float) -> Stamp:
    """A clock that is this far ahead."""
    return lambda turn: turn.now_ns + round(ahead_s * SECOND)


def drifting(ahead_s: float) -> Stamp:
    """Slower than true time."""
    return lambda turn: turn.now_ns + round((ahead_s - DRIFT * turn.elapsed_s) * SECOND)


def stepped(turn: Turn) -> int:
    """A clock that is set forward by 100 s, and later back by 40 s."""
    return turn.now_ns + (0 if turn.share < 0.2 else 100 if turn.share < 0.75 else 60) * SECOND


def repeating() -> Stamp:
    """One stamp for a third of the run, and one until its end."""
    stuck: dict[int, int] = {}

    def stamp(turn: Turn) -> int:
        which = 1 if 0.15 <= turn.share < 0.4 else 2 if turn.share >= 0.8 else 0
        return stuck.setdefault(which, turn.now_ns) if which else turn.now_ns

    return stamp


def simulated(turn: Turn) -> int:
    """Simulated time that restarts in the middle."""
    return round((SIM_BEGIN_S + (turn.elapsed_s if turn.share < 0.5 else turn.elapsed_s / 2)) * SECOND)


LATE, EARLY = frozenset({'late'}), frozenset({'early'})
STREAMS: Final = (
    Skewed('fine', (constant(0.0),)),
    Skewed('ahead_1ms', (constant(0.001),)),
    Skewed('behind_1ms', (constant(-0.001),)),
    Skewed('ahead_1s', (constant(1.0),), EARLY, (-1.0,)),
    Skewed('behind_2s', (constant(-2.0),), LATE, (2.0,)),
    Skewed('behind_146s', (constant(-146.0),), LATE, (146.0,)),
    Skewed('ahead_1h', (constant(3600.0),), EARLY, (-3600.0,)),
    Skewed('behind_1h', (constant(-3600.0),), LATE, (3600.0,)),
    Skewed('drift', (drifting(-300.0),), LATE, (300.0,)),
    Skewed('steps', (stepped,), EARLY, (-60.0,), by_arrival=True),
    Skewed('stuck', (repeating(),), frozenset({'stuck'}), (0.0,), by_arrival=True),
    Skewed('held', (constant(0.0),), held=((0.1, 0.2), (0.8, 0.88))),
    Skewed('two', (constant(0.0), constant(-300.0)), LATE, (300.0,)),
    Skewed('simulated', (simulated,), frozenset({'sim_time'}), by_arrival=True),
    Skewed('camera_fine', (constant(0.0),), type=IMAGE, hz=4.0),
    Skewed('camera_late', (constant(-146.0),), LATE, (146.0,), type=IMAGE, hz=4.0),
)
BORDER: Final = frozenset({'ahead_1s'})
"""So close to a second that jitter decides whether it is reported."""


class Published(NamedTuple):
    """One message, as known to its publisher."""

    topic: str
    publisher: int
    number: int
    stamp_ns: int
    sent_ns: int


def witnessed(path: Path) -> Iterator[Published]:
    """What was published."""
    with path.open(encoding='utf-8') as file:
        for line in file:
            yield Published(*json.loads(line))


def picture(number: int) -> bytes:
    """A JPEG that shows a number."""
    import simplejpeg  # noqa: PLC0415 - only where there are pictures

    bits = np.array([number >> bit & 1 for bit in range(BITS)], np.uint8) * 255
    return bytes(simplejpeg.encode_jpeg(np.kron(bits, np.ones((2 * BLOCK, 2 * BLOCK), np.uint8))[..., None], 90, 'GRAY'))


def number_in(pixels: Any) -> int:
    """The number in a decoded image."""
    middle = np.asarray(pixels)[BLOCK, BLOCK :: 2 * BLOCK]
    return sum(int(np.atleast_1d(middle[bit]).mean() > 127) << bit for bit in range(BITS))


def _message(stream: Skewed, publisher: int, number: int, stamp_ns: int) -> Any:
    if stream.type == IMAGE:
        from sensor_msgs.msg import CompressedImage  # noqa: PLC0415 - of ROS

        made = CompressedImage(format='jpeg', data=picture(number))
    else:
        from nav_msgs.msg import Odometry  # noqa: PLC0415

        made = Odometry()
        made.pose.pose.position.x, made.pose.pose.position.y = float(number), float(publisher)
        made.pose.pose.orientation.w = 1.0
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp_ns, SECOND)
    return made


class _Sender:
    """One publisher of a topic."""

    def __init__(self, stream: Skewed, number: int, publisher: Any) -> None:
        self._stream, self._of, self._publisher = stream, number, publisher
        self._stamp = stream.stamps[number]
        self._waiting: list[tuple[int, int, Any]] = []
        self._next = 0

    @property
    def is_heard(self) -> bool:
        return bool(self._publisher.get_subscription_count())

    def turn(self, began_ns: int, seconds: float) -> Iterator[Published]:
        """Publish what is due."""
        now_ns = time.time_ns()
        elapsed_s = (now_ns - began_ns) / SECOND
        if elapsed_s * self._stream.hz >= self._next:
            stamp_ns = self._stamp(Turn(now_ns, elapsed_s, elapsed_s / seconds))
            self._waiting.append((self._next, stamp_ns, _message(self._stream, self._of, self._next, stamp_ns)))
            self._next += 1
        if not any(begin <= elapsed_s / seconds < end for begin, end in self._stream.held):
            for number, stamp_ns, message in self._waiting:
                sent_ns = time.time_ns()
                self._publisher.publish(message)
                yield Published(self._stream.topic, self._of, number, stamp_ns, sent_ns)
            self._waiting.clear()


def main(witness: str, seconds: float) -> None:
    import rclpy  # noqa: PLC0415 - of ROS
    from nav_msgs.msg import Odometry  # noqa: PLC0415
    from rclpy.node import Node  # noqa: PLC0415
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy  # noqa: PLC0415
    from sensor_msgs.msg import CompressedImage  # noqa: PLC0415

    rclpy.init()
    node = Node('skewed', start_parameter_services=False, enable_rosout=False)
    profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE)
    kinds = {ODOMETRY: Odometry, IMAGE: CompressedImage}
    senders = [
        _Sender(stream, number, node.create_publisher(kinds[stream.type], stream.topic, profile))
        for stream in STREAMS for number in range(len(stream.stamps))
    ]  # fmt: skip
    end_s = time.monotonic() + MATCH_S
    while not all(sender.is_heard for sender in senders):
        if time.monotonic() > end_s:
            raise TimeoutError('a topic has no subscriber')
        time.sleep(0.01)
    began_ns = time.time_ns()
    with Path(witness).open('w', encoding='utf-8', buffering=1) as file:
        while time.time_ns() - began_ns < seconds * SECOND:
            for sender in senders:
                file.writelines(json.dumps(published) + '\n' for published in sender.turn(began_ns, seconds))
            time.sleep(0.002)
    time.sleep(1.0)  # reliable publishers resend until the reader has everything
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main(sys.argv[1], float(sys.argv[2]))
