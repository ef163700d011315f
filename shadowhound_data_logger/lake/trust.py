"""Whose certificates the lake believes: those that delivery does, told to libraries that bring a TLS of their own."""

from __future__ import annotations

from pathlib import Path

from shadowhound_data_logger.options import StoreSettings


def authorities(settings: StoreSettings) -> bytes | None:
    """Certificates (PEM) of the authorities that are named for this store (``AWS_CA_BUNDLE``); None where the system's count.

    Raises SettingError for a file that holds none.
    """
    endpoint = settings.endpoint_url or ''
    if not endpoint.lower().startswith('https:'):
        return None
    from shadowhound_data_logger.stores.credentials import Keys, session_with, trusted  # noqa: PLC0415 - botocore takes a while

    path = trusted(session_with(Keys(settings)), endpoint)
    return Path(path).read_bytes() if isinstance(path, str) else None
