"""The keys of an object's S3 metadata, each defined only here; docs/formats.md explains them.

In addition an encoder's facts about the content (``width``, ``points``, ...) become metadata under their own names.
"""

from __future__ import annotations

from typing import Final

# Origin.
ROBOT: Final = 'robot'
SENSOR: Final = 'sensor'
TOPIC: Final = 'topic'
TYPE: Final = 'type'
COUNT: Final = 'count'
SHA256: Final = 'sha256'

# The mission during which it began, and the state of the robot at that time.
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
"""The stamps of messages whose stamps were not trusted."""
BY_ARRIVAL: Final = 'by_arrival'
"""How many messages are dated by their arrival."""
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
"""Set on a repeat, in the index only: the key of the object with its content, in the same bucket."""
REPEATS: Final = 'repeats'
REPEATS_OF: Final = 'repeats_of'
REPEATS_UNTIL_NS: Final = 'repeats_until_ns'

# A part of the gap journal.
GAP_VERSION: Final = 'gap_version'
"""The last change of the index's journal that this part covers (``spool/gaps.py``); in the last part of those written together.
"""

# Data kept on the robot until requested.
SHIP: Final = 'ship'
ON_REQUEST: Final = 'on_request'
"""The one value of ``ship``."""
THINNED: Final = 'thinned'
"""Set if messages were removed to save space: one of this many is left, on topics with images and clouds."""
PREVIEW_OF: Final = 'preview_of'
"""Set on a preview: the key of the original image, in the same bucket."""

# A file of a bag.
BAG: Final = 'bag'
SLICE: Final = 'slice'
MESSAGES: Final = 'messages'
EVENT: Final = 'event'
CUT_OF: Final = 'cut_of'
"""Set on a bag that was cut from kept slices for a request: their bag."""
# A recording that was imported: the identity of the episode (datasets/imports.py).
IMPORTED_FROM: Final = 'imported_from'
