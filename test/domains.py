"""ROS domains for tests; one test at a time uses a domain on this machine."""

from __future__ import annotations

import fcntl
import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from shadowhound_sim.demo_processes import DOMAINS

from shadowhound_data_logger.doctor.machine import domains
from shadowhound_data_logger.ros.shared_memory import orphans


@contextmanager
def free_domain() -> Iterator[int]:
    """An unused ROS domain, locked against other runs of these tests."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        lock = os.open(Path(tempfile.gettempdir()) / f'shadowhound-test-domain-{domain}.lock', os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        if domain in domains(Path('/')):
            os.close(lock)
            continue
        try:
            yield domain
        finally:
            os.close(lock)
            orphans(free=True)
        return
    pytest.fail('no ROS domain is free')
