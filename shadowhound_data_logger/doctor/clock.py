"""The clock of this machine: set at all, kept by somebody, and whether it stepped while the node ran. Tower's is in s3.clock."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.doctor.model import Context, Result, Role, error, info, ok
from shadowhound_data_logger.spool import clock_record

NAME: Final = 'clock'
TIME_ERROR: Final = 5
"""What adjtimex(2) returns while nobody keeps the clock."""
TIMEX_BYTES: Final = 256
"""struct timex has 208 on 64-bit Linux."""


def check(context: Context) -> Iterator[Result]:
    """See the module."""
    if time.time_ns() < EARLIEST_SANE_NS:
        yield error(
            'clock.set',
            f'this machine thinks it is {time.strftime("%Y-%m-%d", time.gmtime())}',
            'its clock was never set',
            'timedatectl ; sudo timedatectl set-ntp true  # docs/thor.md, Wrong clock',
        )
        return
    yield ok('clock.set', time.strftime('it is %Y-%m-%d %H:%M:%S UTC', time.gmtime()))
    yield _kept()
    if context.role is Role.THOR:
        known = clock_record.read(context.settings.spool_path, context.settings.robot)
        if known.steps:
            yield info(
                'clock.steps',
                f'the clock stepped {known.steps} times while the node ran, last by {known.last_step_s} s',
                'dates before and after do not follow on each other; the boot clock is in every object',
            )


def _kept() -> Result:
    """By the kernel, which NTP daemons tell."""
    adjtimex = getattr(ctypes.CDLL(None), 'adjtimex', None)
    if adjtimex is None or adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)) == TIME_ERROR:  # all zero: it is only read
        return info(
            'clock.kept',
            'no time service (NTP) is running on this machine',
            'its clock drifts by seconds a day',
            'sudo apt install chrony ; timedatectl',
        )
    return ok('clock.kept', 'the clock is kept by NTP')
