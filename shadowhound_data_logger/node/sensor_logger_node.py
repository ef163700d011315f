"""``sensor_logger_node``: stores what the robot publishes, and accounts for every message in the ledger.

    ros2 run shadowhound_data_logger sensor_logger_node --ros-args --params-file go2.yaml -r __ns:=/tachi

Exit codes: 0 stopped on request, 1 a failure, 2 invalid settings.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys

from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.node.intake.middleware import choose, requested_rmw


def main(args: list[str] | None = None) -> int:
    """The console script; ``args`` are ROS arguments without the program's name."""
    atexit.register(gc.freeze)  # the interpreter collects garbage at its end, which takes as long as all of a clean stop
    arguments = sys.argv[1:] if args is None else args
    try:
        middleware = choose(requested_rmw(arguments), os.environ)
    except SettingError as error:
        print(f'sensor_logger_node: {error}', file=sys.stderr)  # noqa: T201 - there is no logger yet
        return 2
    robot = dict(os.environ)
    middleware.enter(os.environ)
    from shadowhound_data_logger.node.node import run  # noqa: PLC0415 - loads the RMW that the environment names

    return run(arguments, middleware, robot)


if __name__ == '__main__':
    sys.exit(main())
