"""The error tree: each error has a message, data and a remedy.

``str(error)`` is one sentence an operator can act on; ``error.data`` is for programs; an error never contains a secret. An error
without a specific remedy has ``DEFAULT_REMEDY`` of its class.
"""

from __future__ import annotations

from typing import Any, ClassVar


class DataLoggerError(Exception):
    """Base of all errors of this package."""

    DEFAULT_REMEDY: ClassVar[str] = 'shadowhound-data doctor looks for the cause'

    def __init__(self, message: str, *, remedy: str = '', **data: Any) -> None:
        super().__init__(message)
        self.remedy = remedy
        self.data = data

    @property
    def what(self) -> str:
        """The message without the remedy."""
        return super().__str__()

    def __str__(self) -> str:
        return f'{self.what} ({self.remedy})' if self.remedy else self.what


class SettingError(DataLoggerError):
    """A parameter or environment variable is unknown or invalid; ``data`` has name, value and allowed."""

    DEFAULT_REMEDY = 'docs/parameters.md describes each parameter and environment variable'

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(
            f'{name} = {value!r} is refused', remedy=f'allowed is {allowed}', name=name, value=value, allowed=allowed
        )

    def __str__(self) -> str:
        return f'{self.what}; {self.remedy}'


class UnknownName(DataLoggerError):
    """A query names something that does not exist; ``data['near']`` has the most similar names that exist."""

    DEFAULT_REMEDY = 'shadowhound-data query "SELECT * FROM topics" lists what is stored'


class NameRefused(DataLoggerError):
    """A name cannot be part of an object key."""

    DEFAULT_REMEDY = 'use letters, digits, "-", "_" and "."'


class Rejected(DataLoggerError):
    """A message could not be encoded; the ledger counts it under ``reason``."""

    DEFAULT_REMEDY = 'shadowhound-data ledger counts rejected messages by reason'

    def __init__(self, reason: str, detail: str = '', *, remedy: str = '') -> None:
        super().__init__(f'{reason}: {detail}' if detail else reason, remedy=remedy, reason=reason)
        self.reason = reason


class SpoolError(DataLoggerError):
    """The spool cannot be opened or written (another process, no space, no permission)."""

    DEFAULT_REMEDY = 'shadowhound-data doctor --only spool looks for the cause'


class NodeUnavailable(DataLoggerError):
    """No node runs here, it cannot be chosen among several, or the one that runs does not answer."""

    DEFAULT_REMEDY = 'shadowhound-data status reports whether a node runs here'


class StoreError(DataLoggerError):
    """Base of errors of a request to a store; the subclass decides what delivery does next."""

    DEFAULT_REMEDY = 'shadowhound-data doctor --only s3 looks for the cause'


class StoreUnavailable(StoreError):
    """Transient: refused, reset, timed out, 5xx, throttled. The same request may succeed later."""


class StoreUntrusted(StoreUnavailable):
    """The store's certificate is not trusted: nothing is sent until it is."""


class CredentialsRejected(StoreError):
    """The store rejects the access key, the signature or the clock. All uploads wait."""


class BucketMissing(StoreError):
    """The bucket does not exist and could not be created; its objects wait."""


class AccessDenied(StoreError):
    """The credentials are valid, but not for this object."""


class ObjectRefused(StoreError):
    """The store will never accept this object (bad key, too large, ...)."""


class ForeignObject(StoreError):
    """The key already has other content, which is never overwritten."""


class TrackingError(DataLoggerError):
    """Base of errors of a request to the tracking server (MLflow)."""

    DEFAULT_REMEDY = 'shadowhound-data doctor --only mlflow looks for the cause'


class TrackingUnavailable(TrackingError):
    """Transient: unreachable, overloaded, credentials rejected. The same request may succeed later."""


class TrackingRefused(TrackingError):
    """The server will never accept this request."""


class BagError(DataLoggerError):
    """A bag, or a file that should be a bag, does not allow the operation."""

    DEFAULT_REMEDY = 'shadowhound-data bag list shows the bags'


class UnknownBag(BagError, UnknownName):
    """The store has no bag of this name."""

    DEFAULT_REMEDY = BagError.DEFAULT_REMEDY


class BagDamaged(BagError):
    """A file of a bag is damaged or incomplete; ``data['path']`` names it."""

    DEFAULT_REMEDY = (
        'shadowhound-data bag verify lists damaged files; bag repair recovers what they hold, bag fetch downloads them again'
    )


class LakeError(DataLoggerError):
    """A query of the catalog cannot be answered: the query is invalid, or the catalog is inconsistent."""

    DEFAULT_REMEDY = 'shadowhound-data query --help has examples; lake status describes the catalog'


class SinkUnavailable(LakeError):
    """The server that receives the catalog does not answer, or is overloaded."""

    DEFAULT_REMEDY = 'run it again: it continues where it stopped'


class PolicyError(DataLoggerError):
    """A policy cannot be packed, published, activated or rolled back."""

    DEFAULT_REMEDY = 'shadowhound-data policy list shows the policies of this robot'


class PolicyRefused(PolicyError):
    """A policy must not run here; ``data['reason']`` is one of the reasons in docs/policies.md."""

    DEFAULT_REMEDY = 'docs/policies.md explains each reason'

    def __init__(self, reason: str, message: str, *, remedy: str = '', **data: Any) -> None:
        super().__init__(message, remedy=remedy, reason=reason, **data)
        self.reason = reason
