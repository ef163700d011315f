"""The keys with which an S3 client signs, and the certificates that it trusts.

Keys in the settings (``AWS_ACCESS_KEY_ID``, ``AWS_SECRET_ACCESS_KEY``) come first and stay: the environment of a process cannot
change. Otherwise they are those of a profile, which botocore finds and parses as for every program of AWS
(https://docs.aws.amazon.com/sdkref/latest/guide/file-location.html), and which are read again once a server refuses them. For a
server of one's own nobody in a network is asked for keys. No message and no repr holds a secret.
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
"""Refused keys are not read again sooner: a file is read, a program (``credential_process``) run."""
NETWORKED: Final = ('assume-role', 'assume-role-with-web-identity', 'sso', 'login', 'container-role', 'iam-role')
"""Those of botocore's providers that ask Amazon's services."""
BUNDLES: Final = ('AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE')
"""The first that is set, as in botocore's own client."""

_log = logging.getLogger(__name__)


class Keys(Credentials):
    """Finds the keys that one store signs with, and reads them again when they are refused.

    Thread-safe; ``_lock`` guards what was found, and is held while a file is read.
    """

    def __init__(self, settings: StoreSettings, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Raises SettingError for one half of a pair. Nothing is read yet."""
        if bool(settings.access_key_id) != bool(settings.secret_access_key):
            name = 'AWS_SECRET_ACCESS_KEY' if settings.access_key_id else 'AWS_ACCESS_KEY_ID'
            raise SettingError(name, '', 'both of AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or neither')
        super().__init__('', '')  # botocore asks for the frozen ones
        self.are_given = bool(settings.access_key_id)
        """By the settings, and so for good."""
        self._settings = settings
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._found: Credentials | None = None
        self._read_s = float('-inf')
        self._generation = 0

    @property
    def generation(self) -> int:
        """Counts the changes."""
        return self._generation

    def get_frozen_credentials(self) -> ReadOnlyCredentials:
        """Raises BotoCoreError where there are none, or none that can be read."""
        with self._lock:
            if self._found is None:
                self._found = self._read()
            if self._found is None:
                raise NoCredentialsError
            return self._found.get_frozen_credentials()

    def renew(self, generation: int) -> bool:
        """A server refused what was signed with this generation: whether there is another one by now."""
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
        except BotoCoreError as error:  # a file that is being written; what was there before stays
            _log.debug('no keys can be read: %s', type(error).__name__)
            return
        self._found = found
        self._generation += 1
        if before:
            _log.info('the keys were refused, and the file has other keys now: using those')

    def _read(self) -> Credentials | None:
        given = self._settings
        if given.access_key_id and given.secret_access_key:
            return Credentials(given.access_key_id, given.secret_access_key, given.session_token)
        self._read_s = self._monotonic()
        providers: Any = Session().get_component('credential_provider')  # a new session: one reads its files once
        if not _is_amazon(given.endpoint_url or ''):
            for name in NETWORKED:
                providers.remove(name)
        try:
            found: Credentials | None = providers.load_credentials()
        except OSError as error:  # the program of a profile cannot be started
            raise CredentialRetrievalError(provider='custom-process', error_msg=type(error).__name__) from error
        return found


def has_keys(settings: StoreSettings) -> bool:
    """Whether there are keys for this store, here or given. Raises SettingError for half a pair, or a profile that is missing."""
    keys = Keys(settings)
    try:
        keys.get_frozen_credentials()
    except ProfileNotFound as error:
        raise no_profile(error) from error
    except BotoCoreError:
        return False
    return True


def no_profile(error: ProfileNotFound) -> SettingError:
    """The same for every client."""
    allowed = (
        'a profile in ~/.aws/credentials or ~/.aws/config, or in the files of AWS_SHARED_CREDENTIALS_FILE and AWS_CONFIG_FILE'
    )
    return SettingError('AWS_PROFILE', error.kwargs['profile'], allowed)


def with_keys(settings: StoreSettings) -> StoreSettings:
    """The settings, with the keys of a profile if they have none. Raises SettingError for a profile that is missing."""
    if settings.access_key_id or not has_keys(settings):
        return settings
    found = Keys(settings).get_frozen_credentials()
    return replace(settings, access_key_id=found.access_key, secret_access_key=found.secret_key, session_token=found.token)


class _Provider:
    """Gives botocore the keys that are known already, in place of its own providers."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys

    def load_credentials(self) -> Keys:
        return self._keys


def session_with(keys: Keys) -> Session:
    """A session of botocore that signs with these keys; keys in hand need no profile."""
    variables: dict[str, Any] = {'ca_bundle': ('ca_bundle', [*BUNDLES], None, None)}
    if keys.are_given:
        variables['profile'] = (None, None, None, None)
    session = Session(session_vars=variables)
    session.register_component('credential_provider', _Provider(keys))
    return session


def trusted(session: Session, endpoint: str) -> str | bool:
    """The file of authorities to trust (``BUNDLES``, else the profile's ``ca_bundle``); True for those of the system.

    Raises SettingError for a file that holds no certificate or cannot be read: nothing could be sent with it.
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
