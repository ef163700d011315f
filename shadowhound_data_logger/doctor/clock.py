"""The clock of this machine: whether it is set and synchronized, and whether it stepped while the node ran. Tower's: s3.clock."""

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
"""Return value of adjtimex(2) for a clock that is not synchronized."""
TIMEX_BYTES: Final = 256
"""sizeof(struct timex) is 208 on 64-bit Linux."""


def check(context: Context) -> Iterator[Result]:
    """Check the date, steps since the node started, and NTP."""
    if time.time_ns() < EARLIEST_SANE_NS:
        yield error(
            'clock.set',
            f'the date on this machine is {time.strftime("%Y-%m-%d", time.gmtime())}',
            'its clock was never set',
            'timedatectl ; sudo timedatectl set-ntp true  # docs/thor.md, Wrong clock',
        )
        return
    yield ok('clock.set', time.strftime('it is %Y-%m-%d %H:%M:%S UTC', time.gmtime()))
    yield _synchronized()
    if context.role is Role.ROBOT:
        known = clock_record.read(context.settings.spool_path, context.settings.robot)
        if known.steps:
            yield info(
                'clock.steps',
                f'the clock stepped {known.steps} times while the node ran, last by {known.last_step_s} s',
                'times before and after are not continuous; every object also has the boot clock',
            )


def _synchronized() -> Result:
    """Whether the kernel's clock is disciplined, as NTP daemons report to it."""
    adjtimex = getattr(ctypes.CDLL(None), 'adjtimex', None)
    if adjtimex is None or adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)) == TIME_ERROR:  # all zero: read only
        return info(
            'clock.kept',
            'no time service (NTP) is running on this machine',
            'its clock drifts by seconds per day',
            'sudo apt install chrony ; timedatectl',
        )
    return ok('clock.kept', 'the clock is synchronized by NTP')
