"""The node and its spool: whether it runs, what waits and for how long, whether the accounts balance, and who holds the lock."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.status import NodeStatus, SpoolStatus, UndiscoveredTopic
from shadowhound_data_logger.doctor.machine import command, lock_holder
from shadowhound_data_logger.doctor.model import Context, Result, error, info, ok, warning
from shadowhound_data_logger.node.intake.undiscovered import REMEDY
from shadowhound_data_logger.spool import ledger, status
from shadowhound_data_logger.spool.index import Index

NAME: Final = 'spool'
OLD_S: Final = 600.0
"""A backlog this old means more than a short loss of WiFi."""
LONG_S: Final = 3600.0
"""A backlog that takes longer than this to deliver is a finding."""
RECHECK_S: Final = 0.3
"""A mission agent without a node holds the drain lock for moments; a longer hold is reported."""
START: Final = 'ros2 run shadowhound_data_logger sensor_logger_node  # or: sudo systemctl start shadowhound-data-logger'
REBUILD: Final = 'start the node: it rebuilds the index from the files, which are all there'
STORE: Final = 'shadowhound-data doctor --only s3 --only network'


def check(context: Context) -> Iterator[Result]:
    """Check the node, its index, the ledger, the backlog, quarantine and the drain lock."""
    folder, robot = context.settings.spool_path, context.settings.robot
    report = status.read(folder, robot, SystemClock.of_this_machine())
    yield from _node(report, folder)
    path = folder / 'index.db'
    if not path.is_file():
        yield info(
            'spool.index', f'there is no spool in {folder} yet', 'the node has not run here, or SHADOWHOUND_HOME is another one'
        )
        return
    try:
        usage, quarantined = _index(path)
        accounts = ledger.read(folder, robot)
    except (OSError, sqlite3.Error, SpoolError) as problem:
        yield error(
            'spool.index',
            f'the index {path} is damaged or cannot be read: {problem}',
            'a failing disk, a power cut with an unsafe write cache, or another user',
            REBUILD,
        )
        return
    yield ok('spool.index', 'the index is intact')
    yield _ledger(accounts, path)
    yield _backlog(usage, context, runs=report.running)
    yield from _quarantine(quarantined)
    yield from _lock(folder, report, context.root)


def _index(path: Path) -> tuple[SpoolStatus, dict[str, int]]:
    """The state of the spool, and objects in quarantine by reason; raises sqlite3.Error for a damaged file."""
    index = Index(path, read_only=True)
    try:
        index.open()
        index.check()
        return index.usage(time.time_ns()), index.overview.quarantine_reasons()
    finally:
        index.close()


def _node(report: status.NodeReport, folder: Path) -> Iterator[Result]:
    node = report.node
    if report.state == status.NOT_RUNNING:
        yield warning(
            'node.running', f'the node of {report.robot} is not running here', f'by {status.file(folder, report.robot)}', START
        )
        return
    if report.state == status.NOT_ANSWERING:
        yield error(
            'node.running',
            f'the node (process {node.pid}) has been silent for {report.age_s:.0f} s',
            'it hangs, for example on a disk that does not respond',
            f'kill -INT {node.pid} ; {START}',
        )
        return
    yield ok('node.running', f'the node of {report.robot} is running (process {node.pid})')
    store = node.store
    if store.state not in status.FINE_STORE:
        yield warning(
            'node.delivery',
            status.stopped(store.state),
            store.last_error or 'the node reports no reason',
            STORE,
        )
    undiscovered = node.middleware.undiscovered or {}
    yield from _undiscovered(undiscovered)
    yield from _front(node)
    missed = {topic: (row.missed or row.missed_estimated or 0) + row.dropped + row.rejected for topic, row in node.topics.items()}
    listed = (status.stopped(store.state), *(row.text for row in undiscovered.values()))
    for text in report.findings:
        if not text.startswith(('delivery:', 'front fails:', *listed)):
            yield warning('node.status', text, 'reported by the node itself', _status_remedy(text), lost=sum(missed.values()))


def _undiscovered(topics: Mapping[str, UndiscoveredTopic]) -> Iterator[Result]:
    for row in topics.values():
        yield error(
            'node.undiscovered',
            f'{row.text}, for {row.seconds} s',
            'the profile of the node uses other interfaces or peers than programs of the robot, or a firewall is in between',
            f'{REMEDY[0].upper()}{REMEDY[1:]}',
            publishers=row.publishers,
            nodes=list(row.nodes),
        )


def _front(node: NodeStatus) -> Iterator[Result]:
    """Check the front process of a node that listens through another RMW than the robot's."""
    middleware, front = node.middleware, node.workers.get('front')
    cause = (
        f'programs of the robot ({middleware.robot}) find no services, parameters and /diagnostics of the node, and '
        'publishers are not compared with those that the robot finds; messages are still logged'
    )
    if front is not None and front.failing:
        remedy = 'journalctl -u shadowhound-data-logger | grep front  # its last messages; until then: shadowhound-data node'
        yield error('node.front', f'the front fails, {front.failures:,} times so far: {front.last_error}', cause, remedy)
    elif front is None and middleware.rmw != middleware.robot:
        package = f'ros-$ROS_DISTRO-{middleware.robot.replace("_", "-")}'
        seen = f'the front is not running: {middleware.robot} is not installed here'
        yield warning('node.front', seen, cause, f'sudo apt install {package}  # or use: shadowhound-data node')


def _status_remedy(text: str) -> str:
    remedies = {
        'missed': 'shadowhound-data ledger  # by restart: no node ran; by transport: doctor --only sockets --only ros',
        'dropped': 'top -H -p $(pgrep -f sensor_logger_node)  # the encoders cannot keep up: set a lower rate_hz',
        'dated by arrival': 'date -u ; ros2 topic echo --once --field header.stamp TOPIC  # a wrong clock, sim time, a replayed '
        'bag, or a forgery: docs/formats.md, Which stamps are trusted',
        'the node is paused': 'ros2 service call /sensor_logger_node/pause std_srvs/srv/SetBool "{data: false}"',
        'bucket': 'shadowhound-data doctor --only s3',
        'the clock': 'timedatectl  # docs/thor.md, Wrong clock',
        'quarantined': 'shadowhound-data spool list --state quarantined',
    }
    return next((remedy for start, remedy in remedies.items() if text.startswith(start)), 'shadowhound-data status')


def _ledger(accounts: ledger.Ledger, index: Path) -> Result:
    wrong = ledger.imbalances(accounts)
    if not wrong:
        return ok(
            'spool.ledger',
            f'the ledger balances over {len(accounts["topics"])} topics and {accounts["objects"]["spooled"]:,} objects',
        )
    return error(
        'spool.ledger',
        f'the ledger does not balance: {wrong[0]}' + (f'; and {len(wrong) - 1} more' if wrong[1:] else ''),
        'another program wrote to the index, or this is a bug in this package',
        f'shadowhound-data ledger --json > /tmp/ledger.json ; cp {index}* /tmp/  # and send us these files',
        imbalances=wrong,
    )


def _backlog(usage: SpoolStatus, context: Context, *, runs: bool) -> Result:
    """The backlog, and how long it takes at the rate measured by the check of the store."""
    count, size, oldest_s = usage.pending, usage.bytes, usage.oldest_age_s
    if not count:
        return ok('spool.backlog', 'no object waits for delivery', pending=0)
    figures: dict[str, Any] = {'pending': count, 'bytes': size, 'oldest_age_s': oldest_s}
    drain_s = _drain_s(count, size, context)
    seen = f'{count:,} objects ({size / 1e6:,.1f} MB) wait' + (f', the oldest for {oldest_s / 60:,.0f} min' if oldest_s else '')
    if drain_s is not None:
        seen += f'; at the measured rate they are delivered in {drain_s / 60:,.1f} min'
        figures['drain_s'] = round(drain_s, 1)
    if (oldest_s or 0.0) < OLD_S and (drain_s or 0.0) < LONG_S:
        return ok('spool.backlog', seen, **figures)
    if not runs:
        return warning('spool.backlog', seen, 'nothing is delivered while the node is not running', START, **figures)
    if drain_s is None:
        return warning('spool.backlog', seen, 'the server is unreachable, or accepts nothing', STORE, **figures)
    return warning(
        'spool.backlog',
        seen,
        'the server was unreachable for long, or more is logged than the network can carry',
        'move the robot to a better network; log less: camera.rate_hz, lidar.rate_hz; upload.max_mbps 0',
        **figures,
    )


def _drain_s(count: int, size: int, context: Context) -> float | None:
    """None if the store was not checked, or did not answer."""
    figures: dict[str, float] = {}
    for result in context.earlier.get('s3', ()):
        figures |= result.data
    mbps, upload = figures.get('upload_mbps'), context.settings.upload
    if not mbps:
        return None
    mbps = min(mbps, upload.max_mbps) if upload.max_mbps else mbps
    return max(8e-6 * size / mbps, count * 2 * figures.get('latency_s', 0.0) / upload.threads)


def _quarantine(reasons: Mapping[str, int]) -> Iterator[Result]:
    if reasons:
        text = ', '.join(f'{count:,} ({reason})' for reason, count in sorted(reasons.items()))
        yield warning(
            'spool.quarantine',
            f'objects in quarantine: {text}',
            'the store will never accept them unchanged; nothing is lost',
            'shadowhound-data spool list --state quarantined  # and once the cause is gone: shadowhound-data spool retry',
        )


def _lock(folder: Path, report: status.NodeReport, root: Path) -> Iterator[Result]:
    """Which process holds the drain lock."""
    path = folder / 'drain.lock'
    holder = lock_holder(root, path)
    if holder is None or holder == report.node.pid:
        return
    time.sleep(RECHECK_S)
    if lock_holder(root, path) != holder:
        return
    who = command(root, holder) or 'a process that this user may not see'
    yield warning(
        'spool.lock',
        f'process {holder} holds the drain lock: {who[:120]}',
        'another node, a program that rescues the spool, or one that hangs; until it exits, no node delivers',
        f'ps -fp {holder}  # and if it is not needed: kill {holder}',
    )
