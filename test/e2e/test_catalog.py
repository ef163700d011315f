"""The catalog of a simulated robot: read by pyarrow, compared with the bucket and with the simulator's positions."""

from __future__ import annotations

import json
import math
import signal
from collections import Counter
from typing import Any

import pyarrow as pa
import pytest
from e2e.processes import Processes, until
from e2e.session import DURATION_S, Session
from shadowhound_sim.world import World
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger, lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.tables import arrow_schema
from shadowhound_data_logger.stores.s3 import S3Store

SEED = 1
ODOMETRY_HZ = 50
START_S = 60
"""The robot started less than this before its first odometry was stored."""
NEAR_M = 0.1
TURNED_RAD = 0.1
TOLD_OTHERWISE = {'t_start', 't_end', 'content_type'}
"""Times are datetimes, and SeaweedFS guesses the type of an application/octet-stream."""
WITH_HEADER = ('camera', 'joints', 'lidar', 'odom')
"""Sensors with poses at their header's time. Objects encoded while odometry is late, on a busy machine, have none."""
FAST = {'catalog.period_s': 2.0, 'lowstate.batch_s': 2.0}


def listed(store: S3Store, robot: str) -> dict[tuple[str, str], ObjectInfo]:
    """All objects of a robot, with their metadata; except the catalog."""
    found = {}
    for bucket in ('sensor-data', 'trajectories'):
        for info in store.list(bucket, f'{robot}/'):
            if catalog.is_row(bucket, info.key) and (report := store.head(bucket, info.key)) is not None:
                found[bucket, info.key] = report
    return found


def cataloged(store: S3Store, robot: str) -> list[dict[str, Any]]:
    """All rows of all parts; each has the schema and the date of its folder."""
    rows = []
    for info in store.list(catalog.BUCKET, catalog.OBJECTS.prefix(robot)):
        found = read_rows(store.get(catalog.BUCKET, info.key), robot)
        assert not found.findings
        for row in pa.Table.from_pylist(found.rows[catalog.SENSOR], schema=arrow_schema()).to_pylist():
            assert f'/date={row["t_start"]:%Y-%m-%d}/' in info.key
            rows.append(row)
    return rows


def started_ns(rows: list[dict[str, Any]], store: S3Store) -> int:
    """When the simulated robot started: the time from which its odometry is the simulator's."""
    odometry = [json.loads(store.get(row['bucket'], row['key'])) for row in rows if row['sensor'] == 'odom']
    assert len(odometry) > 3
    world = World.of(SEED)

    def off(start_ns: int) -> float:
        truths = [world.motion((pose['stamp_ns'] - start_ns) / 1e9) for pose in odometry]
        places = [pose['position'] for pose in odometry]
        return max(math.hypot(truth.x - at['x'], truth.y - at['y']) for truth, at in zip(truths, places, strict=True))

    first_ns = min(pose['stamp_ns'] for pose in odometry)
    best = min((first_ns - round(number / ODOMETRY_HZ * 1e9) for number in range(START_S * ODOMETRY_HZ)), key=off)
    assert off(best) < 1e-6
    return best


def check(rows: list[dict[str, Any]], objects: dict[tuple[str, str], ObjectInfo], store: S3Store) -> None:
    """Each object of the bucket except the catalog is in it once, with equal values and poses within 10 cm of the simulator's."""
    assert Counter((row['bucket'], row['key']) for row in rows) == Counter(objects.keys())
    for row in rows:
        info = objects[row['bucket'], row['key']]
        again = catalog.row_of(info.bucket, info.key, info.size, info.content_type, info.metadata)
        assert [row[name] for name in catalog.COLUMNS if name not in TOLD_OTHERWISE] == [
            again[name] for name in catalog.COLUMNS if name not in TOLD_OTHERWISE
        ]
    for sensor in WITH_HEADER:
        found = [row['x'] is not None for row in rows if row['sensor'] == sensor]
        assert sum(found) >= len(found) / 2 > 0, f'{sensor}: {found.count(False)} of {len(found)} objects have no pose'
    world, start_ns = World.of(SEED), started_ns(rows, store)
    assert any(row['battery_pct'] is not None for row in rows)
    for row in (row for row in rows if row['x'] is not None):
        t = ((row['t_start_ns'] + row['t_end_ns']) / 2 - start_ns) / 1e9
        truth = world.motion(t)
        assert math.hypot(row['x'] - truth.x, row['y'] - truth.y) < NEAR_M, row
        assert abs((row['yaw'] - truth.yaw + math.pi) % math.tau - math.pi) < TURNED_RAD, row
        assert row['pose_frame'] == 'odom'
        assert row['battery_pct'] is None or abs(row['battery_pct'] - world.power(t).soc) < 4.0, row


@pytest.mark.timeout(300 + 2 * DURATION_S)
def test_every_object_has_one_row_and_the_right_pose(session: Session, store: S3Store) -> None:
    """Those of the sensors and the slices of the bag, in several parts."""
    check(cataloged(store, session.robot), listed(store, session.robot), store)
    assert len(list(store.list(catalog.BUCKET, catalog.OBJECTS.prefix(session.robot)))) > 1


def judge_gaps(source: Bucket, robot: str, ledger: dict[str, Any]) -> None:
    """The gaps in the store add up to the ledger, and the watermark covers them."""
    report = Counter[tuple[str, str, str]]()
    for row in lake.sql('SELECT sink, topic, kind, count FROM gaps', source, robot=robot).to_pylist():
        report[row['sink'], row['topic'], row['kind']] += row['count']
    for sink, accounts in (('objects', ledger['topics']), ('bags', ledger['bags'])):
        for topic, account in accounts.items():
            missed = account['missed'] if account['missed'] is not None else report[sink, topic, 'missed']
            figures = missed, sum(account['dropped'].values()), sum(account['rejected'].values())
            assert tuple(report[sink, topic, kind] for kind in ('missed', 'dropped', 'rejected')) == figures, topic


def spans(source: Bucket, robot: str, topic: str) -> list[tuple[int, int]]:
    """The periods of its watermarks, one per session."""
    query = "SELECT from_ns, to_ns FROM watermarks WHERE sink = 'objects' ORDER BY from_ns"
    return [(row['from_ns'], row['to_ns']) for row in lake.sql(query, source, robot=robot, topic=topic).to_pylist()]


@pytest.mark.timeout(300 + 2 * DURATION_S)
def test_gaps_and_watermarks_reach_the_store(session: Session, seaweed: Tower) -> None:
    """The journal in the store adds up to the ledger; a node that stopped properly leaves no received message open."""
    source = Bucket(seaweed.store_settings(), catalog.BUCKET)
    judge_gaps(source, session.robot, session.ledger)
    for topic in ('/imu', '/odom', '/joint_states'):
        ((first_ns, last_ns),) = spans(source, session.robot, topic)
        stamps = sorted(session.by_stamp[topic])
        assert first_ns - stamps[0] < 10 * SECOND
        assert stamps[-1] - SECOND // 2 < last_ns <= session.ended_ns, 'the node listens until it ends'
        known = lake.known(session.robot, topic, stamps[0], max(stamps[-1], last_ns) + SECOND, source=source)
        assert [each.is_open for each in known.stretches][-1], 'the time after the last message is unknown'
        assert not any(each.is_open for each in known.between(first_ns, last_ns).stretches)


@pytest.mark.long('a kill')
def test_a_killed_node_reports_all_gaps(processes: Processes, seaweed: Tower, store: S3Store) -> None:
    """During a mission, once a part is there, and restarted: each object has one row, with its mission."""
    node = processes.node(seaweed.environment(), FAST)
    robot = processes.sim(f'seed:={SEED}', 'image_raw:=false')
    logger = MissionDataLogger(home=node.home, robot=processes.robot, replay=False, start_timeout_s=0.0)
    try:
        until(lambda: node.topic('/odom').get('stored', 0) >= 2, 'the robot walks')
        logger.start_mission('patrol', 'go round')
        until(
            lambda: any(store.list(catalog.BUCKET, catalog.OBJECTS.prefix(processes.robot))),
            'a part is there while the robot walks',
        )
        node.kill()
        node = processes.node(seaweed.environment(), FAST)
        stored = node.topic('/odom')['stored']
        until(lambda: node.topic('/odom')['stored'] >= stored + 3, "the robot's messages are received again")
        robot.signal(signal.SIGINT)
        assert robot.wait() == 0
        logger.end_mission(True, 0.0, 0.0)
    finally:
        logger.close()
    ledger = node.stop()
    assert ledger['objects']['pending'] == 0
    source = Bucket(seaweed.store_settings(), catalog.BUCKET)
    judge_gaps(source, processes.robot, ledger)
    (_, died_ns), (again_ns, _) = spans(source, processes.robot, '/odom')
    known = lake.known(processes.robot, '/odom', died_ns, again_ns, source=source)
    assert ('restart',) in [each.causes for each in known.stretches]
    rows = cataloged(store, processes.robot)
    check(rows, listed(store, processes.robot), store)
    assert {row['mission_type'] for row in rows} == {None, 'patrol'}
