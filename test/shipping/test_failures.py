from __future__ import annotations

import pytest

from shadowhound_data_logger.core import errors
from shadowhound_data_logger.shipping.failures import Verdict, decide, quarantine_reason

TABLE = [
    (errors.StoreUnavailable, Verdict.RETRY),
    (errors.CredentialsRejected, Verdict.PAUSE),
    (errors.StoreUntrusted, Verdict.PAUSE),
    (errors.BucketMissing, Verdict.BUCKET),
    (errors.AccessDenied, Verdict.DENIED),
    (errors.ObjectRefused, Verdict.QUARANTINE),
    (errors.ForeignObject, Verdict.QUARANTINE),
    (errors.StoreError, Verdict.RETRY),
]


@pytest.mark.parametrize(('kind', 'verdict'), TABLE, ids=lambda value: getattr(value, '__name__', value))
def test_each_error_of_a_store_has_its_verdict(kind: type[errors.StoreError], verdict: Verdict) -> None:
    """Each class of the tree leads to exactly this, and its subclasses to the same."""
    assert decide(kind('x')) is verdict
    assert decide(type('Special', (kind,), {})('x')) is verdict


def test_the_table_names_every_store_error() -> None:
    """A class that is added to the tree without a decision here fails this test."""
    kinds = {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.StoreError)}
    assert kinds == {kind for kind, _ in TABLE}


@pytest.mark.parametrize(('error', 'reason'), [
    (errors.ObjectRefused('x', reason='damaged'), 'damaged'),
    (errors.ObjectRefused('x', reason='KeyTooLongError'), 'KeyTooLongError'),
    (errors.ObjectRefused('x'), 'refused'),
    (errors.ObjectRefused('x', reason='../../etc'), 'refused'),
    (errors.ObjectRefused('x', reason='a' * 65), 'refused'),
    (errors.ObjectRefused('x', reason=7), 'refused'),
    (errors.ForeignObject('x', reason='other'), 'foreign'),
    (errors.AccessDenied('x', reason='AccessDenied'), 'access_denied'),
])  # fmt: skip
def test_a_reason_can_name_a_folder(error: errors.StoreError, reason: str) -> None:
    """A word from a server becomes part of a path only where it is harmless there."""
    assert quarantine_reason(error) == reason
