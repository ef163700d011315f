"""A neighbor in the robot's ROS domain creates many topics, and publishers that come and go: the node's memory must stay bounded.

The node records all topics into a bag and keeps them for events. Its resident memory above the level before is measured.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from domains import free_domain
from e2e.processes import Node, Processes

from shadowhound_data_logger.spool.ledger import imbalances
from torture._command import Check, parser, progress, verdict, workshop

TOPICS: Final = 600
PUBLISHERS: Final = 3000
SHORT_PUBLISHERS: Final = 300
MESSAGE_BYTES: Final = 1000
STEP: Final = 300
"""Publishers between two measurements."""
PEAK_BYTES: Final = 84 << 20
AFTER_BYTES: Final = 72 << 20
"""200 of the topics become sensors by their type, whose subscriptions stay."""
SETTLE_S: Final = 6.0
LEFT_S: Final = 100.0
"""Subscriptions are closed after 30 s without a publisher, and the heap is trimmed once per minute."""
PARAMETERS: Final[dict[str, Any]] = {
    'bag.record': 'always', 'bag.regex': '.*', 'events.regex': '.*', 'mission.join': False,
}  # fmt: skip
PROGRAM: Final = Path(__file__).parents[1] / 'test/e2e/crowd.py'


class Crowd:
    """The neighbor, controlled line by line."""

    def __init__(self, processes: Processes) -> None:
        self._popen = subprocess.Popen(
            [sys.executable, str(PROGRAM)], env=processes.environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def do(self, line: str) -> None:
        """Returns when it is done."""
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        self._popen.stdin.write(line + '\n')
        self._popen.stdin.flush()
        assert self._popen.stdout.readline() == 'done\n', line

    def end(self) -> None:
        self._popen.kill()
        self._popen.wait()
        for pipe in (self._popen.stdin, self._popen.stdout):
            if pipe is not None:
                pipe.close()


def resident(node: Node) -> int:
    """Private memory of the process (proc(5), RssAnon): shared memory belongs to the middleware's segment."""
    status = Path(f'/proc/{node.popen.pid}/status').read_text(encoding='ascii')
    return int(status.partition('RssAnon:')[2].split()[0]) << 10


def attack(processes: Processes, topics: int, publishers: int, *, wait_s: float) -> dict[str, Any]:
    """Results: memory before, at its peak, and after (bytes); and the node's final ledger."""
    node = processes.node(None, PARAMETERS)
    time.sleep(SETTLE_S)
    before = peak = resident(node)
    crowd = Crowd(processes)
    try:
        crowd.do(f'topics {topics} {MESSAGE_BYTES}')
        for _ in range(round(SETTLE_S)):
            time.sleep(1.0)
            peak = max(peak, resident(node))
        for done in range(0, publishers, STEP):
            crowd.do(f'churn {min(STEP, publishers - done)}')
            peak = max(peak, resident(node))
            progress(f'{done + STEP} publishers: {(resident(node) - before) / 1e6:.1f} MB above {before / 1e6:.1f} MB')
        crowd.do('leave')
        time.sleep(wait_s)
        after = resident(node)
    finally:
        crowd.end()
    found = node.stop()
    return {
        'before': before, 'peak': peak, 'after': after, 'failures': node.log.count('failed'),
        'imbalances': imbalances(found), 'topics': len(found['bags']),
        'publishers': sum(row['received'] for row in found['bags'].values()),
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if every bar is met."""
    options = parser('crowd', __doc__ or '')
    options.add_argument('--topics', type=int, default=TOPICS, help='how many at once')
    options.add_argument('--publishers', type=int, default=0, help=f'that come and go (default {PUBLISHERS})')
    given = options.parse_args(argv)
    publishers = given.publishers or (SHORT_PUBLISHERS if given.short else PUBLISHERS)
    with workshop(given) as shop, free_domain() as domain:
        processes = Processes(shop.folder, domain, 'crowded')
        try:
            found = attack(processes, given.topics, publishers, wait_s=LEFT_S)
        finally:
            processes.end()
        above, left = found['peak'] - found['before'], found['after'] - found['before']
        bars = [
            Check('memory at most', above <= PEAK_BYTES, f'{above / 1e6:.1f} MB above {found["before"] / 1e6:.1f} MB'),
            Check('memory afterwards', left <= AFTER_BYTES, f'{left / 1e6:.1f} MB above it'),
            Check('the ledger balances', not found['imbalances'], '; '.join(found['imbalances'])),
            Check('no thread fails', not found['failures'], f'{found["failures"]} in the log' if found['failures'] else ''),
        ]
        shop.passed = all(bar.holds for bar in bars)
        return verdict(found, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
