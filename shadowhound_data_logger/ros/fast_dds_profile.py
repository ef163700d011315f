"""Our profile of Fast DDS, ``launch_configs/fastdds_shm.xml``: what names it, and who does not load it."""

from __future__ import annotations

import logging
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

PROFILE_FILES: Final = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
"""What names a profile for Fast DDS 2, and for Fast DDS 3; neither reads the other's."""
SHIPPED: Final = 'fastdds_shm.xml'
TRANSPORTS: Final = 'FASTDDS_BUILTIN_TRANSPORTS'
"""An operator's choice of transports, which our profile overrules."""


@contextmanager
def without_our_profile(environ: MutableMapping[str, str]) -> Iterator[None]:
    """Hide our profile, or another file of its name, while this process makes its first participant, when Fast DDS reads it.

    For processes that publish nothing and may be discovered late (docs/decisions/0004). Where an operator chose transports it
    is loaded, as by all others. No other thread may read the environment meanwhile.
    """
    ours = {name: environ[name] for name in PROFILE_FILES if Path(environ.get(name, '')).name == SHIPPED}
    if environ.get(TRANSPORTS):
        ours = {}
    for name, file in ours.items():
        log.info('%s is not loaded here: this process publishes nothing', file)
        del environ[name]
    try:
        yield
    finally:
        environ.update(ours)
