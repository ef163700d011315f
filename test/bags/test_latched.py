"""Each slice of a bag starts with the latched messages that a new subscriber would receive; they count once, as received."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest
from bags.recording import STRING, Desk, batch, desk, journaled, manifest, messages, mission, start, write_out
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from shadowhound_data_logger.bags.latched import MAX_PER_TOPIC, MESSAGE_BYTES, Latched
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.recording import REPEAT_LEAD_NS
from shadowhound_data_logger.bags.verify import verify_folder

STATIC = '/tf_static'


class Recorded(NamedTuple):
    """A message of a slice, as the `mcap` package reads it."""

    topic: str
    number: int
    repeated: bool
    log_ns: int
    publish_ns: int
    sequence: int


def messages_in(path: Path) -> list[Recorded]:
    """In file order."""
    with path.open('rb') as file:
        return [
            Recorded(channel.topic, int(message.data[4:12]), channel.metadata.get('shadowhound_repeated') == 'true',
                     message.log_time, message.publish_time, message.sequence)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        ]  # fmt: skip


def repeats(path: Path) -> list[tuple[str, int]]:
    return [(each.topic, each.number) for each in messages_in(path) if each.repeated]


def slices(it: Desk, bag: str) -> list[Path]:
    found = it.objects()
    return [found[f'{bag}/{bag}_{number}.mcap'] for number in range(len(found)) if f'{bag}/{bag}_{number}.mcap' in found]


def test_each_slice_begins_with_what_is_latched(tmp_path: Path) -> None:
    """With the last message of each publisher, before all others by log time, with its publish time and number."""
    with desk(tmp_path) as it:
        bag = start(it.recorder)
        it.hear(range(1, 3), STATIC, latched=2)
        it.hear(range(5, 6), STATIC, latched=2, publisher='q')
        it.hear(range(10, 20))
        assert it.recorder.split()[0]
        it.hear(range(20, 30))
        assert it.recorder.split()[0]
        it.hear(range(3, 4), STATIC, latched=2)
        it.hear(range(30, 40))
        it.recorder.stop()
        first, second, third = slices(it, bag)
        assert repeats(first) == []
        assert repeats(second) == repeats(third) == [(STATIC, 2), (STATIC, 5)]
        (received,) = messages(range(2, 3))
        early = [each for each in messages_in(second) if each.repeated]
        began_ns = messages(range(20, 21))[0].received_ns
        assert (early[0].publish_ns, early[0].sequence) == (received.source_ns, 2)
        assert {each.log_ns for each in early} == {began_ns - REPEAT_LEAD_NS}
        assert min(each.log_ns for each in messages_in(second) if not each.repeated) == began_ns


def test_a_slice_is_played_on_its_own(tmp_path: Path) -> None:
    """Another reader opens it alone, and finds the latched topic first."""
    with desk(tmp_path, compression='zstd') as it:
        bag = start(it.recorder)
        it.hear(range(1, 2), STATIC, latched=1)
        it.hear(range(10, 20))
        assert it.recorder.split()[0]
        it.hear(range(20, 30))
        it.recorder.stop()
        alone = tmp_path / 'alone.mcap'
        shutil.copy(slices(it, bag)[1], alone)
    with AnyReader([alone]) as reader:
        found = [(connection.topic, bytes(cdr)) for connection, _, cdr in reader.messages()]
    assert found[0] == (STATIC, messages(range(1, 2))[0].cdr)
    assert [topic for topic, _ in found[1:]] == ['/talk'] * 10


def test_repeats_are_not_received(tmp_path: Path) -> None:
    """The ledger counts received messages; metadata and manifest count those in the files, and which of them are repeated."""
    with desk(tmp_path) as it:
        bag = start(it.recorder)
        it.hear(range(1, 3), STATIC, latched=1)
        for number in range(3):
            it.hear(range(10 * number, 10 * number + 10))
            assert it.recorder.split()[0]
        assert it.recorder.stop()[1] == f'{bag}: 32 messages in 3 slices'
        row, found = it.row(STATIC), it.objects()
        assert (row['received'], row['stored'], row['open'], row['missed'], row['dropped']) == (2, 2, 0, 0, {})
        assert not journaled(it.spool.root, 'bags')
        written = manifest(found, bag)
        assert [each['counts'] for each in written['slices']] == [{STATIC: 2, '/talk': 10}] + [{STATIC: 1, '/talk': 10}] * 2
        assert [each['repeated'] for each in written['slices']] == [{}, {STATIC: 1}, {STATIC: 1}]
        assert written['state'] == 'complete'
        folder = tmp_path / 'fetched'
        folder.mkdir()
        for key, path in found.items():
            shutil.copy(path, folder / key.partition('/')[2])
    assert not verify_folder(folder, deep=True).findings
    with AnyReader([folder]) as reader:
        assert {topic: info.msgcount for topic, info in reader.topics.items()} == {STATIC: 4, '/talk': 30}
        assert Counter(connection.topic for connection, _, _ in reader.messages()) == {STATIC: 4, '/talk': 30}


@pytest.mark.parametrize('is_lost', [False, True], ids=['killed', 'index lost'])
def test_after_a_crash_repeats_are_not_received_either(tmp_path: Path, *, is_lost: bool) -> None:
    """The open slice is recovered with them, and the next start counts each message once."""
    home = tmp_path / 'home'
    with desk(home) as it:
        bag = start(it.recorder)
        it.hear(range(1, 2), STATIC, latched=1)
        it.hear(range(10, 20))
        assert it.recorder.split()[0]
        it.hear(range(20, 30))
        write_out(it)
        it.row()
        killed = tmp_path / 'killed'
        shutil.copytree(home, killed)
        it.recorder.stop()
    if is_lost:
        for path in (killed / 'spool').glob('index.db*'):
            path.unlink()
    with desk(killed) as it:
        it.recorder._recovery.worker.join(60)
        assert [(each.topic, each.repeated) for each in messages_in(slices(it, bag)[1])] == [(STATIC, True)] + [
            ('/talk', False)
        ] * 10
        rows = {topic: it.row(topic) for topic in (STATIC, '/talk')}
        assert [(row['received'], row['stored'], row['open']) for row in rows.values()] == [(1, 1, 0), (20, 20, 0)]
        written = manifest(it.objects(), bag)
        assert [each['repeated'] for each in written['slices']] == [{}, {STATIC: 1}]


def test_a_slice_of_only_repeats_is_not_written(tmp_path: Path) -> None:
    """A split without messages after it leaves no slice, nor does a crash then."""
    with desk(tmp_path) as it:
        bag = start(it.recorder)
        it.hear(range(1, 2), STATIC, latched=1)
        assert it.recorder.split()[0]
        it.recorder.stop()
        assert len(slices(it, bag)) == 1


def test_a_bag_does_not_depend_on_the_previous_one(tmp_path: Path) -> None:
    """Its publishers are queried again (``Consumer.begin``): the first messages are received, and counted."""
    with desk(tmp_path, record='always') as it:
        it.hear(range(1, 2), STATIC, latched=1)
        it.recorder.on_mission(mission())
        bag = it.recorder.status().bag
        it.hear(range(10, 20))
        it.recorder.stop()
        assert repeats(slices(it, bag)[0]) == []


def test_messages_latched_during_a_pause_are_in_later_slices(tmp_path: Path) -> None:
    """Not recorded, and counted as paused, but no slice begins with a map that was replaced."""
    with desk(tmp_path) as it:
        bag = start(it.recorder)
        it.hear(range(1, 2), STATIC, latched=1)
        it.queue.put(batch(range(2, 3), STATIC)._replace(latched=1, paused=True))
        assert it.recorder.split()[0]
        it.hear(range(10, 20))
        it.recorder.stop()
        first, second = slices(it, bag)
        assert [each.number for each in messages_in(first)] == [1]
        assert repeats(second) == [(STATIC, 2)]
        assert it.row(STATIC)['dropped'] == {}


def test_messages_latched_while_the_disk_is_full_are_in_later_slices(tmp_path: Path) -> None:
    """It was dropped, and counted as such; the next slice starts with it."""
    with desk(tmp_path) as it:
        bag = start(it.recorder)
        it.hear(range(1, 2), STATIC, latched=1)
        write_out(it)
        it.room[0] = False
        assert it.recorder.split()[0]
        it.hear(range(2, 3), STATIC, latched=1)
        write_out(it)
        it.room[0] = True
        it.recorder._current.recording._retry_at_s = 0.0  # type: ignore[union-attr]
        it.hear(range(10, 20))
        it.recorder.stop()
        assert it.row(STATIC)['dropped'] == {'no_room': 1}
        assert repeats(slices(it, bag)[1]) == [(STATIC, 2)]


def test_a_large_map_does_not_end_slices_early(tmp_path: Path) -> None:
    """Slices are measured without repeats; a message above the slice size is not repeated."""
    with desk(tmp_path, slice_bytes=1 << 20) as it:
        bag = start(it.recorder)
        it.hear(range(1, 2), '/map', size=900_000, latched=1)
        it.hear(range(2, 3), '/large', size=1 << 20, latched=1)
        for number in range(10):
            it.hear(range(10 * number, 10 * number + 10), size=20_000)
        it.recorder.stop()
        found = slices(it, bag)
        assert len(found) == 3
        assert [repeats(path) for path in found[1:]] == [[('/map', 1)]] * 2


def kept(latched: Latched) -> list[tuple[str, str | None, int | None]]:
    return [(batch.topic, batch.messages[0].publisher, batch.messages[0].number) for batch in latched]


def of(publisher: str | None, number: int, topic: str = STATIC, size: int = 0, publishers: int = 2) -> MessageBatch:
    (message,) = messages(range(number, number + 1), size)
    return MessageBatch(topic, STRING, '', [message._replace(publisher=publisher)], publishers)


def test_one_latched_message_is_kept_per_publisher() -> None:
    """The newest, in order of arrival; without publisher ids as many as there are publishers; equal content counts once."""
    latched = Latched(1 << 20)
    for one in (of('p', 1), of('q', 2), of('p', 3), of('r', 3)):
        latched.keep(one)
    assert kept(latched) == [(STATIC, 'q', 2), (STATIC, 'r', 3)]
    for number in (1, 2, 3, 3):
        latched.keep(of(None, number, '/map'))
    assert kept(latched)[2:] == [('/map', None, 2), ('/map', None, 3)]
    assert latched.bytes == 4 * (12 + MESSAGE_BYTES)


def test_memory_is_bounded() -> None:
    """A topic with changing publishers drops its oldest messages; one that is too large drops none of the others."""
    latched = Latched(1 << 20)
    latched.keep(of('p', 1))
    for number in range(2, 20):
        latched.keep(of(f'map server {number}', number, '/map', 300_000))
        assert latched.bytes <= 1 << 20
    assert kept(latched) == [(STATIC, 'p', 1), *(('/map', f'map server {number}', number) for number in (17, 18, 19))]
    latched.keep(of('large', 1, '/large', 1 << 20))
    latched.keep(of('map server 20', 20, '/map', 2 << 20))
    assert len(kept(latched)) == 4
    for number in range(MAX_PER_TOPIC + 10):
        latched.keep(of(f'p{number}', number, '/many'))
    assert sum(topic == '/many' for topic, _, _ in kept(latched)) == MAX_PER_TOPIC
