"""Our Fast DDS profile, ``launch_configs/fastdds_shm.xml``: the variables that name it, and which processes do not load it."""

from __future__ import annotations

import logging
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

PROFILE_FILES: Final = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
"""Variables that name a profile for Fast DDS 2, and for Fast DDS 3; neither reads the other's."""
SHIPPED: Final = 'fastdds_shm.xml'
TRANSPORTS: Final = 'FASTDDS_BUILTIN_TRANSPORTS'
"""An operator's choice of transports, which our profile would override."""


@contextmanager
def without_our_profile(environ: MutableMapping[str, str]) -> Iterator[None]:
    """Hide our profile, or another file of its name, while this process creates its first participant, when Fast DDS reads it.

    For processes that publish nothing and may be discovered late (docs/decisions/0004). If the operator chose transports, the
    profile is loaded, as everywhere else. No other thread may read the environment during that time.
    """
    has_choice = bool(environ.get(TRANSPORTS))
    ours = {name: environ[name] for name in PROFILE_FILES if not has_choice and Path(environ.get(name, '')).name == SHIPPED}
    for name, file in ours.items():
        log.info('the Fast DDS profile %s is not loaded: this process publishes nothing', file)
        del environ[name]
    try:
        yield
    finally:
        environ.update(ours)
