"""Program of a test: the node as on a robot with another RMW, with a front that uses the same RMW as the node itself."""

import sys

from shadowhound_data_logger.node.intake.middleware import Middleware
from shadowhound_data_logger.node.sensor_logger_node import main

Middleware.is_foreign = property(lambda _: True)  # type: ignore[assignment, method-assign]
sys.exit(main())
