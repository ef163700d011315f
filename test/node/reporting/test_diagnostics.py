"""The level and message on ``/diagnostics`` for each state of the node."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.stamps import StampReport, describe
from shadowhound_data_logger.core.status import NodeStatus
from shadowhound_data_logger.node.reporting.diagnostics import ERROR, OK, STALE, WARN, _text, entries

TOPIC = {
    'sensor': 'imu', 'type': 'go2_interfaces/msg/IMU', 'enabled': True, 'publishers': 1, 'rate_hz': 100.0, 'age_s': 0.02,
    'received': 1200, 'stored': 1100, 'skipped': 0, 'rejected': 2, 'dropped': 3, 'missed': 4, 'open': 91, 'accounting': 'exact',
    'missed_estimated': None, 'other_types': {}, 'stamps': None,
}  # fmt: skip
STATUS: dict[str, Any] = {
    'robot': 'thor', 'version': '0.1.0', 'pid': 7, 'uptime_s': 12.3, 'paused': False, 'topics': {'/imu': TOPIC},
    'events': {'enabled': True, 'seconds': 30.0, 'bytes': 10, 'max_bytes': 100, 'bag': '', 'refused': '', 'triggers': 1,
               'written': 1, 'last': {'name': 'fall', 'by': 'log_event'}, 'topics': {'/imu': {'dropped': 2}}},
    'middleware': {'undiscovered': None},
    'bag': {'recording': True, 'paused': False, 'bag': 'patrol_1', 'dropped': 3, 'refused': '', 'topics': {}},
    'queue': {'batches': 0, 'messages': 0, 'bytes': 0, 'max_messages': 10, 'max_bytes': 100},
    'spool': {'path': '/s', 'pending': 3, 'held': 0, 'quarantined': 1, 'evicted': 2, 'bytes': 10, 'max_bytes': 100,
              'free_bytes': 5, 'oldest_age_s': None},
    'store': {'target': 'the S3 server', 'state': 'idle', 'last_error': 'refused', 'delivered': 5, 'in_flight': 0, 'deferred': 0,
              'retries': 0, 'quarantined': 1, 'blocked_buckets': {}, 'waits_for': {}, 'mbps': 0.0, 'max_mbps': 0.0},
    'workers': {'intake': {'failing': False, 'failures': 1, 'deaths': 0, 'last_error': 'ValueError: x'}}, 'stalls': {},
    'consumers': {'Sampler': {'failures': 1, 'last_error': 'ValueError: x'}},
    'clock': {'is_set': True, 'gave_up': False, 'unset_s': 0.0, 'steps': 2, 'last_step_s': 3.5, 'last_step_age_s': 61.0},
}  # fmt: skip


def changed(**values: Any) -> NodeStatus:
    """The status with other values: ``section__name``, or ``topic__name`` for the only topic."""
    status = deepcopy(STATUS)
    for name, value in values.items():
        section, _, key = name.partition('__')
        if section == 'topic':
            status['topics']['/imu'][key] = value
        elif key:
            status[section][key] = value
        else:
            status[section] = value
    return parse(NodeStatus, status)


LATE = {'publisher': 'p', 'state': 'offset', 'offset_s': 146.0, 'spread_s': 0.1, 'since_ns': 0, 'cause': 'late'}


def entry_of(name: str, **values: Any) -> tuple[Any, str]:
    """Level and message of an entry, after a while without problems."""
    found = {entry[0]: entry for entry in entries(changed(**values), changed())}
    return found[name][1], found[name][2]


def test_undiscovered_publishers_are_an_error() -> None:
    """They are reported for their topic, which has an entry then, whether or not any message was received."""
    undiscovered = {
        topic: {'publishers': 1, 'nodes': [], 'seconds': 40, 'text': f'{topic} is not all heard'} for topic in ('/imu', '/odom')
    }
    for topic in undiscovered:
        assert entry_of(topic, middleware__undiscovered=undiscovered) == (ERROR, f'{topic} is not all heard')


def test_a_healthy_node_is_ok() -> None:
    """Each topic, the bag, events, spool, store, clock, workers and the node have an entry; old losses are reported once."""
    found = list(entries(changed(), changed()))
    assert [entry[0] for entry in found] == ['node', '/imu', 'bag', 'events', 'spool', 'store', 'clock', 'workers']
    assert {entry[1] for entry in found} == {OK}
    assert entry_of('/imu')[1] == '100 Hz'


@pytest.mark.parametrize(
    ('values', 'level', 'words'),
    [
        ({'topic__missed': 6}, WARN, '2 missed recently'),
        ({'topic__dropped': 4, 'topic__rejected': 7}, WARN, '1 dropped, 5 rejected recently'),
        ({'topic__paused': 9}, OK, '100 Hz'),
        ({'topic__missed': 6, 'paused': True}, WARN, '2 missed recently'),
        ({'topic__missed': None}, OK, '100 Hz'),
        ({'topic__missed': None, 'topic__missed_estimated': 7}, WARN, '~7 missed recently'),
        ({'topic__publishers': 0}, STALE, 'nobody publishes it'),
        ({'topic__publishers': 0, 'topic__missed': 5}, WARN, '1 missed recently'),
        ({'topic__enabled': False, 'topic__publishers': 0}, OK, 'not enabled'),
        ({'stalls': {'/imu': 'silent for 7 s'}}, WARN, 'silent for 7 s'),
        ({'stalls': {'/imu': 'silent for 7 s'}, 'topic__publishers': 0}, STALE, 'nobody publishes it'),
        ({'stalls': {'/odom': 'silent for 7 s'}}, OK, '100 Hz'),
        ({'topic__age_s': None}, OK, '100 Hz'),
        ({'topic__stamps': LATE}, WARN, describe(StampReport(**LATE))),
        ({'topic__stamps': LATE, 'topic__missed': 6}, WARN, '2 missed recently'),
        ({'topic__other_types': {'B': {}}}, WARN, 'it was published as B too; only go2_interfaces/msg/IMU is logged'),
    ],
)  # fmt: skip
def test_the_state_of_a_topic_has_its_level(values: dict[str, Any], level: Any, words: str) -> None:
    """Recent losses and silence are a warning; a topic without a publisher is stale, a disabled one is OK."""
    assert entry_of('/imu', **values) == (level, words)


@pytest.mark.parametrize(
    ('name', 'values', 'level', 'words'),
    [
        ('node', {'paused': True}, WARN, 'paused'),
        ('bag', {}, OK, 'patrol_1 is recorded'),
        ('bag', {'bag__recording': False}, OK, 'nothing is recorded'),
        ('bag', {'bag__paused': True}, OK, 'patrol_1 is paused'),
        ('bag', {'bag__dropped': 5}, WARN, 'patrol_1 dropped 2 messages recently'),
        ('bag', {'bag__dropped': 5, 'bag__bag': 'patrol_2'}, OK, 'patrol_2 is recorded'),
        ('bag', {'bag__refused': 'no_room'}, ERROR, 'patrol_1 records nothing now: no_room'),
        ('events', {}, OK, 'the last 30 s are kept'),
        ('events', {'events__enabled': False}, OK, 'nothing is kept'),
        ('events', {'events__bag': 'event_1'}, OK, 'writing event_1'),
        ('events', {'events__topics': {'/imu': {'dropped': 5}}}, WARN, '3 messages of an event were dropped recently'),
        ('events', {'events__bag': 'event_1', 'events__refused': 'unwritable'}, ERROR, 'event_1 is not written: unwritable'),
        ('clock', {'clock__is_set': False, 'clock__unset_s': 12.0}, WARN, 'not set for 12 s: objects wait for their date'),
        ('clock', {'clock__is_set': False, 'clock__gave_up': True}, WARN, 'objects are uploaded under _unsynced'),
        ('clock', {'clock__last_step_age_s': 59.0}, WARN, 'stepped by 3.5 s 59 s ago'),
        ('clock', {'clock__last_step_s': None, 'clock__last_step_age_s': None}, OK, 'set'),
        ('spool', {'spool__bytes': 80}, OK, '80%'),
        ('spool', {'spool__evicted': 5}, ERROR, '3 objects were evicted recently'),
        ('spool', {'spool__bytes': 81}, WARN, '81% of its limit'),
        ('store', {'store__state': 'not_draining'}, OK, 'not draining'),
        ('store', {'store__state': 'store_down'}, WARN, 'store down: refused'),
        ('store', {'store__state': 'paused'}, ERROR, 'paused: refused'),
        ('store', {'store__quarantined': 3}, ERROR, '2 objects were quarantined recently: refused'),
        ('store', {'store__blocked_buckets': {'trajectories': 'no'}}, WARN, 'trajectories'),
        ('store', {'stalls': {'delivery': '3 objects wait'}}, WARN, '3 objects wait'),
        ('workers', {'workers__intake': {'failing': True, 'failures': 2, 'deaths': 0, 'last_error': 'KeyError: y'}}, ERROR,
         'intake fails: KeyError: y'),
        ('workers', {'workers__intake': {'failing': False, 'failures': 2, 'deaths': 1, 'last_error': 'SystemExit: '}}, ERROR,
         'intake failed recently and works again: SystemExit'),
        ('workers', {'consumers__RobotTrack': {'failures': 1, 'last_error': 'KeyError: y'}}, ERROR,
         'RobotTrack recently failed to take messages: KeyError: y'),
        ('workers', {'stalls': {'intake': 'it takes no messages'}}, WARN, 'intake: it takes no messages'),
        ('workers', {'stalls': {'encode': 'no batch', 'delivery': 'x'}}, WARN, 'encode: no batch'),
    ],
)  # fmt: skip
def test_every_other_part_has_its_level(name: str, values: dict[str, Any], level: Any, words: str) -> None:
    """An unreachable store and a spool filling up are warnings; refused credentials, quarantine and defects are errors."""
    found = entry_of(name, **values)
    assert found[0] == level
    assert words in found[1]


def test_every_figure_fits_its_message() -> None:
    """A value that rclpy refuses would end the node: levels are bytes, values text, and unknown values are empty."""
    for name, level, text, figures in entries(changed(store__blocked_buckets={'b': 'why'}), changed()):
        values = [KeyValue(key=key, value=_text(value)) for key, value in figures.items()]
        message = DiagnosticStatus(name=name, level=bytes([level]), message=text, values=values)
        assert message.level[0] in {OK, WARN, ERROR, STALE}
    assert _text(None) == ''
    assert _text({'b': 'why'}) == 'b: why'
