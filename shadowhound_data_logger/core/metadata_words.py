"""The words of an object's S3 metadata, each defined only here; docs/formats.md explains them.

Beside them an encoder's facts of the content (``width``, ``points``, ...) become metadata, under the names that it gives them.
"""

from __future__ import annotations

from typing import Final

# Where it comes from.
ROBOT: Final = 'robot'
SENSOR: Final = 'sensor'
TOPIC: Final = 'topic'
TYPE: Final = 'type'
COUNT: Final = 'count'
SHA256: Final = 'sha256'

# The mission that it began in, and what the robot was doing then.
MISSION_ID: Final = 'mission_id'
MISSION_TYPE: Final = 'mission_type'
RUN_ID: Final = 'run_id'
FRAME_ID: Final = 'frame_id'
POSE: Final = 'pose'
"""``x y yaw frame``, as in ``3.214 -1.502 0.7854 odom``."""
GPS: Final = 'gps'
"""``latitude longitude altitude``, as in ``48.1351000 11.5820000 519.00``: degrees and meters (WGS 84)."""
BATTERY: Final = 'battery_pct'

# Its time, by both clocks, and how well it is known.
T_START_NS: Final = 't_start_ns'
T_END_NS: Final = 't_end_ns'
RECEIVED_START_NS: Final = 'received_start_ns'
RECEIVED_END_NS: Final = 'received_end_ns'
STAMP_START_NS: Final = 'stamp_start_ns'
STAMP_END_NS: Final = 'stamp_end_ns'
"""Of messages whose stamps were not trusted: what these were."""
BY_ARRIVAL: Final = 'by_arrival'
"""How many of its messages are dated by their arrival."""
BOOT_ID: Final = 'boot_id'
BOOT_START_NS: Final = 'boot_start_ns'
BOOT_END_NS: Final = 'boot_end_ns'
CLOCK: Final = 'clock'
SET: Final = 'set'
PUBLISHER: Final = 'publisher'
SET_LATER: Final = 'set_later'
UNSET: Final = 'unset'
"""The four values of ``clock``."""
CLOCK_OFFSET_NS: Final = 'clock_offset_ns'
KEY_PATTERN: Final = 'key_pattern'

# Repeats of the content before it.
CONTENT_KEY: Final = 'content_key'
"""Of a repeat, in the index alone: the key of the object that holds its content, in the same bucket."""
REPEATS: Final = 'repeats'
REPEATS_OF: Final = 'repeats_of'
REPEATS_UNTIL_NS: Final = 'repeats_until_ns'

# A part of the gap journal.
GAP_VERSION: Final = 'gap_version'
"""Up to which change of the journal in the index all is told (``spool/gaps.py``), in the last part of those of one moment."""

# What stays on the robot until somebody asks for it.
SHIP: Final = 'ship'
ON_REQUEST: Final = 'on_request'
"""The one value of ``ship``."""
THINNED: Final = 'thinned'
"""Of what has lost messages because room ran short: one of so many is left, of the topics with pictures and clouds."""
PREVIEW_OF: Final = 'preview_of'
"""Of a preview: the key of the object that it is a small picture of, in the same bucket."""

# A file of a bag.
BAG: Final = 'bag'
SLICE: Final = 'slice'
MESSAGES: Final = 'messages'
EVENT: Final = 'event'
CUT_OF: Final = 'cut_of'
"""Of a bag that was cut out of kept slices for a request: the bag that those are of."""
# A recording that was imported: the identity of the episode (datasets/imports.py).
IMPORTED_FROM: Final = 'imported_from'
