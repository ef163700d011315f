"""A fault of the store is reported so that an operator can act on it; nothing is lost, and delivery resumes automatically."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import boto3
import pytest
from e2e.processes import Node, Processes, Publisher, until
from e2e.reading import STRING, Objects, texts
from e2e.wire import HANG, PASS, REFUSE, Wire
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.stores.s3 import S3Store

TOPIC = '/talk'
COUNT = 20
TALK = {
    'sensors': ['talk'], 'talk.topics': ['talk'], 'talk.types': [STRING], 'talk.rate_hz': 0.0, 'talk.batch_s': 0.1,
    'upload.max_backoff_s': 0.2, 'upload.read_timeout_s': 1.0,
}  # fmt: skip


class Talk:
    """A node, and a publisher with numbers from 0 on."""

    def __init__(self, node: Node, publisher: Publisher) -> None:
        self.node, self.publisher, self.count = node, publisher, 0

    def publish(self) -> None:
        """Publish more numbers, which are durable in the spool on return."""
        self.publisher.publish(TOPIC, texts(range(self.count, self.count + COUNT)))
        self.count += COUNT
        until(lambda: self.node.topic(TOPIC).get('stored', 0) == self.count, 'all is spooled')

    def delivered(self, objects: Callable[[], Objects]) -> None:
        """All numbers so far are eventually in the store, once."""
        self.node.settled(TOPIC, self.count)
        assert objects().numbers('talk') == list(range(self.count))


def talk(processes: Processes, store: dict[str, str], **parameters: Any) -> Talk:
    node = processes.node(store, {**TALK, **parameters})
    publisher = processes.publisher()
    publisher.create(TOPIC, STRING)
    publisher.matched(TOPIC)
    return Talk(node, publisher)


@pytest.fixture(scope='module')
def wire(seaweed: Tower) -> Iterator[Wire]:
    with Wire(seaweed.endpoint_url) as proxy:
        yield proxy


MORE = pytest.mark.long('four seconds each')


@pytest.fixture(scope='module')
def wired(shared: Processes, seaweed: Tower, wire: Wire) -> Talk:
    """A node that reaches the server over the wire."""
    return talk(shared, {**seaweed.environment(), 'AWS_ENDPOINT_URL': wire.url})


@pytest.mark.parametrize(
    ('mode', 'words'),
    [
        pytest.param(REFUSE, 'refused the connection (is the S3 server running?', id='refused connection'),
        pytest.param(HANG, 'gave no answer within 1 s (does the server hang?', id='hung connection'),
        pytest.param((500, 'InternalError'), 'answers with a server error (500 InternalError)', id='server error', marks=MORE),
        pytest.param((503, 'SlowDown'), 'is overloaded (503 SlowDown)', id='overload'),
        pytest.param((403, 'SignatureDoesNotMatch'), 'refuses the signature: the secret key is wrong', id='wrong secret'),
        pytest.param((403, 'RequestTimeTooSkewed'), 'the clocks of this machine and of', id='wrong clock', marks=MORE),
    ],
)
def test_everything_is_delivered_after_the_store_recovers(
    wired: Talk, wire: Wire, shared: Processes, stored: Callable[..., Objects], mode: str | tuple[int, str], words: str
) -> None:
    """Each fault has a separate message; what is published during it waits, and is delivered when the fault ends."""
    wired.publish()
    wired.node.settled(TOPIC, wired.count)
    assert words not in wired.node.log
    recovered = wired.node.log.count('delivery continues')
    wire.set(mode)
    try:
        wired.publish()
        wired.node.await_log(words)
        row = wired.node.topic(TOPIC)
        assert row['stored_in']['pending'] >= 1
        assert row['stored_in']['quarantined'] == 0
    finally:
        wire.set(PASS)
    wired.delivered(lambda: stored(shared.robot))
    until(lambda: wired.node.log.count('delivery continues') == recovered + 1, 'the node reports the recovery')
    assert wired.node.ledger()['objects']['quarantined'] == 0


@pytest.mark.long('a Tower of its own')
def test_objects_wait_for_a_server_that_starts_later(processes: Processes, tmp_path: Path) -> None:
    """A node that starts before its server delivers once the server is running."""
    with Tower(tmp_path / 'tower') as late, closing(S3Store(late.store_settings(), UploadSettings())) as store:
        late.stop_s3()
        talking = talk(processes, late.environment())
        talking.publish()
        talking.node.await_log('refused the connection')
        assert talking.node.topic(TOPIC)['stored_in']['pending'] == COUNT
        late.start_s3()
        store.open()
        talking.delivered(lambda: Objects.of(store, 'sensor-data', processes.robot))


def test_a_wrong_secret_pauses_delivery_and_is_not_shown(
    processes: Processes, seaweed: Tower, stored: Callable[..., Objects]
) -> None:
    """A real server's refusal pauses delivery and names the variables, never the secret; a valid secret delivers everything."""
    wrong = {**seaweed.environment(), 'AWS_SECRET_ACCESS_KEY': 'not-the-secret'}
    talking = talk(processes, wrong)
    talking.publish()
    talking.node.await_log('delivery is paused')
    assert 'the secret key is wrong (check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY' in talking.node.log
    assert 'not-the-secret' not in talking.node.log
    assert talking.node.stop()['objects']['pending'] >= 1
    processes.node(seaweed.environment(), TALK).delivered()
    assert stored(processes.robot).numbers('talk') == list(range(COUNT))


def test_a_missing_bucket_is_created(processes: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> None:
    """If the credentials allow it, the bucket is created, and the log reports it."""
    bucket = f'fresh-{processes.robot}'
    talking = talk(processes, seaweed.environment(), **{'talk.bucket': bucket})
    talking.publish()
    talking.delivered(lambda: stored(processes.robot, bucket))
    assert f'created the bucket {bucket}' in talking.node.log


@pytest.fixture
def owner(seaweed: Tower) -> Iterator[Any]:
    """A client of the server's owner."""
    settings = seaweed.store_settings()
    client = boto3.client(
        's3', endpoint_url=settings.endpoint_url, region_name='us-east-1',
        aws_access_key_id=settings.access_key_id, aws_secret_access_key=settings.secret_access_key,
    )  # fmt: skip
    yield client
    client.close()


def test_a_bucket_that_cannot_be_created_blocks_only_its_objects(
    processes: Processes, seaweed: Tower, owner: Any, stored: Callable[..., Objects]
) -> None:
    """If they do not, the error explains how to create it; its objects wait and are delivered once it exists."""
    talking = talk(processes, seaweed.environment('limited'), **{'talk.bucket': 'later'})
    talking.publish()
    talking.node.await_log('bucket later gets nothing')
    assert 's3 mb s3://later' in talking.node.log
    assert talking.node.topic(TOPIC)['stored_in']['delivered'] == 0
    owner.create_bucket(Bucket='later')
    try:
        talking.delivered(lambda: stored(processes.robot, 'later'))
    finally:  # other tests start without it
        processes.end()
        for item in owner.list_objects_v2(Bucket='later').get('Contents', []):
            owner.delete_object(Bucket='later', Key=item['Key'])
        owner.delete_bucket(Bucket='later')
