"""A simulated S3 server and the network to it: acts as S3Requests, in virtual time, with the faults of a script."""

from __future__ import annotations

import hashlib
import random
from collections import Counter
from collections.abc import Callable, Iterator
from typing import IO, Final, TypeVar

from faults.kinds import Condition, Fault, Script
from faults.virtual_time import VirtualTime

from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.content import object_metadata
from shadowhound_data_logger.stores.s3_requests import Sent

READ_TIMEOUT_S: Final = 30.0
REFUSE_S: Final = 60.0
LATEST_S: Final = 600.0
"""The time after sending within which an abandoned object may still arrive."""
SLOW_BYTES_PER_S: Final = 1024.0
Where = tuple[str, str]
T = TypeVar('T')


class Server:
    """The stored objects, and the changes; every change is immediate."""

    def __init__(self, condition: Condition) -> None:
        self.condition = condition
        self.buckets: set[str] = set()
        self.objects: dict[Where, tuple[bytes, ObjectInfo]] = {}
        self.created: Counter[Where] = Counter()
        self.repeated: Counter[Where] = Counter()
        """Written again with the same content."""
        self.overwritten: list[Where] = []
        """Written again with different content: this must never happen."""

    def put(self, info: ObjectInfo, body: bytes, *, conditional: bool) -> Sent:
        where = info.bucket, info.key
        if info.bucket not in self.buckets:
            raise BucketMissing('no such bucket')
        if conditional and self.condition is Condition.NOT_IMPLEMENTED:
            return Sent.NOT_IMPLEMENTED
        if where in self.objects:
            if conditional and self.condition is Condition.HONOURED:
                return Sent.TAKEN
            same = self.objects[where][0] == body
            self.repeated[where] += same
            self.overwritten += [] if same else [where]
        else:
            self.created[where] += 1
        self.objects[where] = body, info
        return Sent.CREATED

    def holds(self, item: SpooledObject) -> bool:
        """Whether it is there, byte for byte."""
        held = self.objects.get((item.bucket, item.key))
        return held is not None and hashlib.sha256(held[0]).hexdigest() == item.sha256


class Line:
    """The network between one process and a server. ``started`` is called for each put that starts."""

    endpoint = 'simulated'
    generation = 0
    """Of its keys."""

    def __init__(self, time: VirtualTime, server: Server, script: Script, rng: random.Random) -> None:
        self.pace = Pace()
        self.requests = 0
        self.denied: Counter[Where] = Counter()
        self._time = time
        self.server = server
        self._script = script
        self._rng = rng
        self._refused_until = 0.0

    # -- as S3Requests -----------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Nothing to acquire."""

    def close(self) -> None:
        """Nothing to release."""

    def put(self, item: SpooledObject, body: bytes | IO[bytes], *, conditional: bool) -> Sent:
        assert isinstance(body, bytes)
        info = ObjectInfo(item.bucket, item.key, len(body), item.sha256, object_metadata(item), item.content_type)

        def reach(fault: Fault) -> Sent:
            if fault is Fault.NO_CONDITION and conditional:
                return Sent.NOT_IMPLEMENTED
            return self.server.put(info, body, conditional=conditional)

        return self._ask(reach, (item.bucket, item.key), len(body))

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        def reach(_: Fault) -> ObjectInfo | None:
            held = self.server.objects.get((bucket, key))
            return held[1] if held else None

        return self._ask(reach, (bucket, key))

    def content(self, bucket: str, key: str) -> Iterator[bytes]:
        def reach(_: Fault) -> bytes:
            if (bucket, key) not in self.server.objects:
                raise ObjectRefused('no such key', reason='missing')
            return self.server.objects[bucket, key][0]

        yield self._ask(reach, (bucket, key))

    def list(self, bucket: str, prefix: str) -> Iterator[ObjectInfo]:
        def reach(_: Fault) -> list[ObjectInfo]:
            return [info for (where, key), (_, info) in self.server.objects.items() if where == bucket and key.startswith(prefix)]

        yield from self._ask(reach, (bucket, prefix))

    def create_bucket(self, bucket: str) -> None:
        self._ask(lambda _: self.server.buckets.add(bucket), (bucket, ''))

    def probe(self) -> None:
        self._ask(lambda _: None, ('', ''))

    # -- the faults --------------------------------------------------------------------------------------------------

    def _ask(self, reach: Callable[[Fault], T], where: Where, size: int = 0) -> T:
        """One request: latency, the server's handling if any, and latency of the response if any."""
        self.requests += 1
        self._time.sleep(self._rng.uniform(0.001, 0.05))
        if self._time.now < self._refused_until:
            raise StoreUnavailable('refused')
        fault = self._script()
        if fault in {Fault.NONE, Fault.NO_CONDITION}:
            answer = reach(fault)
            self._time.sleep(self._rng.uniform(0.001, 0.05))
            return answer
        if fault in {Fault.CUT, Fault.ACK_LOST}:
            self._land(reach)
        elif fault is Fault.SLOW:
            if (seconds := size / SLOW_BYTES_PER_S + 1.0) < READ_TIMEOUT_S:
                self._time.sleep(seconds)
                return reach(fault)
            self._time.after(seconds, lambda: self._land(reach))
        elif fault is Fault.HUNG and self._rng.random() < 0.5:  # it is still in flight
            self._time.after(self._rng.uniform(1.0, LATEST_S), lambda: self._land(reach))
        self._fail(fault, where)
        raise AssertionError(f'{fault} is not a failure')

    def _land(self, reach: Callable[[Fault], object]) -> None:
        """It reaches the server, and the response is lost."""
        try:
            reach(Fault.NONE)
        except (BucketMissing, ObjectRefused):
            return

    def _fail(self, fault: Fault, where: Where) -> None:
        """What the client receives, and when."""
        if fault is Fault.REFUSED:
            self._refused_until = self._time.now + self._rng.uniform(0.0, REFUSE_S)
        elif fault in {Fault.HUNG, Fault.SLOW} or (fault is Fault.ACK_LOST and self._rng.random() < 0.5):
            self._time.sleep(READ_TIMEOUT_S)
        else:
            self._time.sleep(self._rng.uniform(0.001, 0.05))
        if fault is Fault.DENIED:
            self.denied[where] += 1
            raise AccessDenied('denied', reason='AccessDenied')
        if fault is Fault.SKEWED:
            raise StoreUnavailable('the clocks differ')
        raise StoreUnavailable(fault.value)
