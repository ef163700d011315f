"""The keys and the trusted certificates of an S3 client.

Keys in the settings (``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY``) take precedence and never change. Otherwise the keys are
those of a profile, which botocore finds and parses as for every AWS program
(https://docs.aws.amazon.com/sdkref/latest/guide/file-location.html); they are read again once a server refuses them. Network
services provide keys only if the server is Amazon's. No message or repr contains a secret.
"""

from __future__ import annotations

import logging
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final
from urllib.parse import urlsplit

from botocore.credentials import Credentials, ReadOnlyCredentials
from botocore.exceptions import BotoCoreError, CredentialRetrievalError, NoCredentialsError, ProfileNotFound
from botocore.session import Session

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.core.errors import SettingError

REREAD_S: Final = 1.0
"""Refused keys are not read again sooner, because that reads files or runs a program (``credential_process``)."""
NETWORK_PROVIDERS: Final = ('assume-role', 'assume-role-with-web-identity', 'sso', 'login', 'container-role', 'iam-role')
"""botocore's providers that ask Amazon's services."""
BUNDLES: Final = ('AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE')
"""The first one that is set counts, as in botocore's client."""

_log = logging.getLogger(__name__)


class Keys(Credentials):
    """Finds the keys of one store, and reads them again when they are refused.

    Thread-safe: ``_lock`` guards the found keys, and is held while files are read.
    """

    def __init__(self, settings: StoreSettings, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Raises SettingError for half a pair. Reads nothing yet."""
        if bool(settings.access_key_id) != bool(settings.secret_access_key):
            name = 'AWS_SECRET_ACCESS_KEY' if settings.access_key_id else 'AWS_ACCESS_KEY_ID'
            raise SettingError(name, '', 'both of AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or neither')
        super().__init__('', '')  # botocore uses the frozen ones
        self.are_given = bool(settings.access_key_id)
        """Whether the keys are in the settings, and so never change."""
        self._settings = settings
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._found: Credentials | None = None
        self._read_s = float('-inf')
        self._generation = 0

    @property
    def generation(self) -> int:
        """How often the keys have changed."""
        return self._generation

    def get_frozen_credentials(self) -> ReadOnlyCredentials:
        """The current keys. Raises BotoCoreError if there are none or they cannot be read."""
        with self._lock:
            if self._found is None:
                self._found = self._read()
            if self._found is None:
                raise NoCredentialsError
            return self._found.get_frozen_credentials()

    def renew(self, generation: int) -> bool:
        """Read the keys again after a server refused this generation; whether they have changed."""
        if self.are_given:
            return False
        with self._lock:
            if self._generation == generation and self._monotonic() - self._read_s >= REREAD_S:
                self._renew()
            return self._generation != generation

    def _renew(self) -> None:
        before = self._found
        try:
            found = self._read()
            if found is None or (before and found.get_frozen_credentials() == before.get_frozen_credentials()):
                return
        except BotoCoreError as error:  # such as a file that is being written: keep the current keys
            _log.debug('cannot read the keys: %s', type(error).__name__)
            return
        self._found = found
        self._generation += 1
        if before:
            _log.info('the keys were refused; using the new keys in the file')

    def _read(self) -> Credentials | None:
        given = self._settings
        if given.access_key_id and given.secret_access_key:
            return Credentials(given.access_key_id, given.secret_access_key, given.session_token)
        self._read_s = self._monotonic()
        providers: Any = Session().get_component('credential_provider')  # a new session, because each one reads its files once
        if not _is_amazon(given.endpoint_url or ''):
            for name in NETWORK_PROVIDERS:
                providers.remove(name)
        try:
            found: Credentials | None = providers.load_credentials()
        except OSError as error:  # the program of a profile cannot be started
            raise CredentialRetrievalError(provider='custom-process', error_msg=type(error).__name__) from error
        return found


def has_keys(settings: StoreSettings) -> bool:
    """Whether there are keys for this store. Raises SettingError for half a pair or a missing profile."""
    keys = Keys(settings)
    try:
        keys.get_frozen_credentials()
    except ProfileNotFound as error:
        raise no_profile(error) from error
    except BotoCoreError:
        return False
    return True


def no_profile(error: ProfileNotFound) -> SettingError:
    """The error for a missing profile."""
    allowed = (
        'a profile in ~/.aws/credentials or ~/.aws/config, or in the files of AWS_SHARED_CREDENTIALS_FILE and AWS_CONFIG_FILE'
    )
    return SettingError('AWS_PROFILE', error.kwargs['profile'], allowed)


def with_keys(settings: StoreSettings) -> StoreSettings:
    """The settings, with the keys of the profile if they have none. Raises SettingError for a missing profile."""
    if settings.access_key_id or not has_keys(settings):
        return settings
    found = Keys(settings).get_frozen_credentials()
    return replace(settings, access_key_id=found.access_key, secret_access_key=found.secret_key, session_token=found.token)


class _Provider:
    """Replaces botocore's providers by known keys."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys

    def load_credentials(self) -> Keys:
        return self._keys


def session_with(keys: Keys) -> Session:
    """A botocore session that signs with these keys; ignores AWS_PROFILE if they are in the settings."""
    variables: dict[str, Any] = {'ca_bundle': ('ca_bundle', [*BUNDLES], None, None)}
    if keys.are_given:
        variables['profile'] = (None, None, None, None)
    session = Session(session_vars=variables)
    session.register_component('credential_provider', _Provider(keys))
    return session


def trusted(session: Session, endpoint: str) -> str | bool:
    """The file of trusted certificates (``BUNDLES``, otherwise the profile's ``ca_bundle``); True for those of the system.

    Raises SettingError for a file that contains no certificate or cannot be read.
    """
    path = session.get_config_variable('ca_bundle')
    if path and urlsplit(endpoint).scheme == 'https':
        try:
            ssl.create_default_context(cafile=path)
        except OSError as error:
            allowed = f'a file of certificates (PEM) that this user can read ({error.strerror or error})'
            raise SettingError(BUNDLES[0], path, allowed) from error
    return path or True


def _is_amazon(endpoint: str) -> bool:
    return (urlsplit(endpoint).hostname or '').endswith('.amazonaws.com')
