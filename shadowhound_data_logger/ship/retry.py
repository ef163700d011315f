"""What a failed put means for delivery, in one table (D8)."""

from __future__ import annotations

import re
from enum import Enum
from typing import Final

from shadowhound_data_logger.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUntrusted,
)

_REASON: Final = re.compile(r'[A-Za-z0-9][A-Za-z0-9_-]{0,63}')


class Verdict(Enum):
    """What delivery does next with the object and with the others."""

    RETRY = 'retry'
    """The store is away, or this object does not get through: wait, then try again, for ever."""
    PAUSE = 'pause'
    """No object's fault: nothing is sent until credentials and certificate are right, but for one probe at a time."""
    BUCKET = 'bucket'
    """The objects of this bucket wait, those of others go on."""
    DENIED = 'denied'
    """This object's fault if others of its bucket are taken, else the bucket waits."""
    QUARANTINE = 'quarantine'
    """Terminal for this object."""


_TABLE: Final[tuple[tuple[type[StoreError], Verdict], ...]] = (
    (CredentialsRejected, Verdict.PAUSE),
    (StoreUntrusted, Verdict.PAUSE),
    (BucketMissing, Verdict.BUCKET),
    (AccessDenied, Verdict.DENIED),
    (ObjectRefused, Verdict.QUARANTINE),
    (ForeignObject, Verdict.QUARANTINE),
)


def decide(error: StoreError) -> Verdict:
    """The first row of the table that fits; what is not known is tried again, for quarantine needs a reason."""
    return next((verdict for kind, verdict in _TABLE if isinstance(error, kind)), Verdict.RETRY)


def quarantine_reason(error: StoreError) -> str:
    """One word for the ledger and for the name of a folder; a server's own word only where it is safe as one."""
    if isinstance(error, ForeignObject):
        return 'foreign'
    if isinstance(error, AccessDenied):
        return 'access_denied'
    reason = error.data.get('reason')
    return reason if isinstance(reason, str) and _REASON.fullmatch(reason) else 'refused'
