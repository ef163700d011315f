"""Program of a test, ``confined_node.py PID INTERFACE ...``: the node in the network of that process, on that interface.

Its front is not confined, like the robot's other programs, and the comparison interval is short.
"""

import os
import sys
from dataclasses import replace

from e2e.machines import inside

from shadowhound_data_logger.node.intake import undiscovered
from shadowhound_data_logger.node.intake.middleware import RMW, choose

pid, interface, *arguments = sys.argv[1:]
if pid != 'inside':
    os.execvp('nsenter', [*inside(int(pid)), sys.executable, __file__, 'inside', interface, *arguments])  # noqa: S606
undiscovered.SETTLED_S = 2.0  # type: ignore[misc]
general = f'<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces></General>'
uri = f'<CycloneDDS><Domain>{general}</Domain></CycloneDDS>'
robot = dict(os.environ)
middleware = replace(choose('auto', {**robot, RMW: 'rmw_cyclonedds_cpp', 'CYCLONEDDS_URI': uri}), has_robot=True)
middleware.enter(os.environ)
from shadowhound_data_logger.node.node import run  # noqa: E402 - loads the RMW that the environment names

sys.exit(run(arguments, middleware, robot))
