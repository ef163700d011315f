"""The node, which also records when each object became durable and when the store confirmed it.

It is ``sensor_logger_node`` with two of its calls timed: ``Spool.commit`` (its result is durable) and ``S3Store.put``
(confirmed on return). When it exits it prints ``{"durable": {id: ns}, "confirmed": {id: ns}}``, wall clock. For ``latency.py``:
the index's own times are less precise. ``created_ns`` is taken when a commit starts, before its syncs, and ``settled_ns`` when
the commit starts that records the outcome of a delivery, up to a commit period after the store's answer.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence

from shadowhound_data_logger.core.model import DataObject, Outcome, Put, RecordingRows, SpooledObject
from shadowhound_data_logger.node.sensor_logger_node import main
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.stores.s3 import S3Store

durable_ns: dict[int, int] = {}
confirmed: dict[int, int] = {}
_commit, _put = Spool.commit, S3Store.put


def timed_commit(
    spool: Spool, objects: Sequence[DataObject] = (), outcomes: Sequence[Outcome] = (), rows: Sequence[RecordingRows] = (), *,
    leave_files: bool = False,
) -> list[SpooledObject]:  # fmt: skip
    placed = _commit(spool, objects, outcomes, rows, leave_files=leave_files)
    now_ns = time.time_ns()
    durable_ns.update((item.id, now_ns) for item in placed)
    return placed


def timed_put(store: S3Store, item: SpooledObject) -> Put:
    answer = _put(store, item)
    confirmed[item.id] = time.time_ns()
    return answer


if __name__ == '__main__':
    setattr(Spool, 'commit', timed_commit)  # noqa: B010 - a plain assignment is not a method to mypy
    setattr(S3Store, 'put', timed_put)  # noqa: B010
    code = main()
    print(json.dumps({'durable': durable_ns, 'confirmed': confirmed}), flush=True)
    sys.exit(code)
