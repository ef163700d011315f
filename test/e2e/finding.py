"""Program of a test, once on each of two machines: which participants receive from which on ``/here`` and ``/there``?

``publish TOPIC CASES`` publishes as a robot with Cyclone DDS in each of the cases, ``listen CASES`` is a reader of such a robot,
and ``find VARIABLES`` subscribes as the node does, in one case. Cases are JSON, a list of variables. What was received is
printed as one line of JSON for each line on standard input.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

TOPICS = ('/here', '/there')
STRING = 'std_msgs/msg/String'
PERIOD_S = 0.05
MESSAGE = b'\0\1\0\0\2\0\0\0x\0'
"""A String in CDR."""


def publish(topic: str, cases: Sequence[Mapping[str, str]]) -> None:
    """Publish in an endless loop."""
    from e2e.cyclone_driver import Driver

    drivers = [Driver(case) for case in cases]
    for driver in drivers:
        driver.obey({'do': 'create', 'topic': topic, 'type': STRING, 'reliable': True, 'latched': False, 'depth': 10})
    say('ready')
    while True:
        time.sleep(PERIOD_S)
        for driver in drivers:
            driver.obey({'do': 'publish', 'topic': topic, 'messages': [MESSAGE.hex()], 'period_s': 0.0})


def listen(cases: Sequence[Mapping[str, str]]) -> None:
    """A list of topics for each case."""
    from e2e.cyclone_driver import Driver

    drivers = [Driver(case) for case in cases]
    for driver in drivers:
        for topic in TOPICS:
            driver.obey({'do': 'listen', 'topic': topic, 'type': STRING, 'reliable': True, 'latched': False, 'depth': 10})

    def topics_received() -> list[list[str]]:
        for driver in drivers:
            driver.poll()
        return [[topic for topic in TOPICS if driver.obey({'do': 'count', 'topic': topic})] for driver in drivers]

    answer(topics_received)


def find(case: Mapping[str, str]) -> None:
    """A list of topics."""
    from shadowhound_data_logger.node.intake.middleware import RMW, choose

    loaded = choose('fastrtps', os.environ | {RMW: case[RMW]}).profile_variable  # whichever version the case simulates
    middleware = replace(choose('fastrtps', os.environ | case), profile_variable=loaded)
    os.environ.update(case)
    middleware.enter(os.environ)
    import rclpy
    from rclpy.node import Node
    from std_msgs.msg import String

    rclpy.init()
    with middleware.profiled(os.environ):
        node = Node('finder', start_parameter_services=False, enable_rosout=False)
    readers = {topic: node.create_subscription(String, topic, print, 10) for topic in TOPICS}
    found: set[str] = set()

    def topics_received() -> list[str]:
        for topic, reader in readers.items():
            with reader.handle:
                if reader.handle.take_message(String, True) is not None:
                    found.add(topic)
        return sorted(found)

    answer(topics_received)


def answer(topics_received: Callable[[], object]) -> None:
    """Respond until the end of standard input."""
    say('ready')
    for _ in sys.stdin:
        say(json.dumps(topics_received()))


def say(line: str) -> None:
    sys.stdout.write(line + '\n')
    sys.stdout.flush()


def end() -> None:
    """Stop a publisher along with its parent."""
    sys.stdin.read()
    os._exit(0)


def main(what: str, *given: str) -> None:
    """Run the command of the arguments."""
    if what == 'publish':
        threading.Thread(target=end, daemon=True).start()
        publish(given[0], json.loads(given[1]))
    elif what == 'listen':
        listen(json.loads(given[0]))
    else:
        find(json.loads(given[0]))


if __name__ == '__main__':
    main(*sys.argv[1:])
