"""A mission agent that logs until it is killed, and prints each record whose call has returned."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from shadowhound_data_logger import MissionDataLogger

FRAME_EVERY = 5
PERIOD_S = 0.005
NO_CSV = '-'


def jpeg(number: int) -> bytes:
    return b'\xff\xd8' + b'%06d' % number * 500 + b'\xff\xd9'


def main(home: str, command: str, csv: str, period_s: str = str(PERIOD_S)) -> None:
    """``csv`` is the trajectory that it logs, NO_CSV for none."""
    logger = MissionDataLogger(home=Path(home), start_timeout_s=0.2, frame_artifact_every_s=0.0)
    text = f'{logger.start_mission("patrol", command)}\n'
    number = 0
    if csv != NO_CSV:
        logger.log_trajectory(csv)
    while True:
        os.write(1, text.encode())
        logger.log_robot_state(90.0 - number / 1e4, 40.0, number)
        if number % FRAME_EVERY == 0:
            logger.log_camera_frame(jpeg(number), number)
        text = f'{number}\n'
        number += 1
        time.sleep(float(period_s))


if __name__ == '__main__':
    main(*sys.argv[1:])
