"""S3 stores with a secret, and the messages of their errors."""

from __future__ import annotations

import traceback
from collections.abc import Callable

import pytest

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.core.errors import DataLoggerError, ObjectRefused

SECRET = 'a-Secret-that-nobody-may-see'


def settings_for(url: str) -> StoreSettings:
    return StoreSettings(endpoint_url=url, access_key_id='KEYID', secret_access_key=SECRET)


def error_of(kind: type[DataLoggerError], ask: Callable[[], object], secret: str = SECRET) -> str:
    """The message of the error, after a check that the secret is not in it."""
    with pytest.raises(kind) as caught:
        ask()
    assert type(caught.value) is kind
    whole = ''.join(traceback.format_exception(caught.value)) + repr(caught.value) + repr(caught.value.data)
    assert secret not in whole
    assert caught.value.remedy or kind is ObjectRefused
    return str(caught.value)
