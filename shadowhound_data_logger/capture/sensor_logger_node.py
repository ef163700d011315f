"""``sensor_logger_node``: what the robot publishes goes to the store, and the ledger says what became of it.

    ros2 run shadowhound_data_logger sensor_logger_node --ros-args --params-file go2.yaml -r __ns:=/tachi

Exit codes: 0 asked to stop, 1 a failure, 2 settings refused.
"""

from __future__ import annotations

import sys


def main(args: list[str] | None = None) -> int:
    """The console script; ``args`` are ROS arguments without the program's name."""
    from shadowhound_data_logger.capture.node import run  # noqa: PLC0415 - the environment decides which middleware it loads

    return run(sys.argv[1:] if args is None else args)


if __name__ == '__main__':
    sys.exit(main())
