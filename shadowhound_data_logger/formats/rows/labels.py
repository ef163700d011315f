"""The table of labels of times, objects and boxes in objects (lake/labels.py)."""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.formats.rows.catalog import DOUBLE, INT32, INT64, LABELS_FOLDER, STRING, TIME, TableSchema

LABEL, REMOVED = 'label', 'removed'
LABEL_KINDS: Final = (LABEL, REMOVED)
"""Values of ``what``."""
MAX_TEXT: Final = 200
LABELS: Final = TableSchema(
    folder=LABELS_FOLDER,
    columns={
        'robot': STRING,
        'what': STRING,
        'id': STRING,
        'label': STRING,
        'since_ns': INT64,
        'until_ns': INT64,
        'bucket': STRING,
        'key': STRING,
        'x': DOUBLE,
        'y': DOUBLE,
        'width': DOUBLE,
        'height': DOUBLE,
        'note': STRING,
        'by': STRING,
        'made': TIME,
        'made_ns': INT64,
        'format_version': INT32,
    },
    required=('robot', 'what', 'id', 'label', 'since_ns', 'until_ns', 'made_ns', 'format_version'),
)
"""Every label has ``since_ns`` to ``until_ns``, both included. The label of an object also has ``bucket key``, and the label of a
box in it ``x y width height``, in pixels. ``by`` is the author and ``made`` the time; the newest row of an ``id`` is valid."""
