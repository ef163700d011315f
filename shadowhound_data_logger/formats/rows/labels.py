"""The table of labels (lake/labels.py): what people say of times, objects and boxes in them."""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.formats.rows.schema import DOUBLE, INT32, INT64, LABELS_FOLDER, STRING, TIME, TableSchema

LABEL, REMOVED = 'label', 'removed'
LABEL_KINDS: Final = (LABEL, REMOVED)
"""What a row can be (``what``)."""
MOST_TEXT: Final = 200
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
    about={'shadowhound.labels': '1'},
)
"""``since_ns`` to ``until_ns``, both included, of all labels; ``bucket key`` of those of an object; ``x y width height``, in
pixels, of those of a box in it. ``by`` whom and when it was ``made``; an ``id`` counts by its newest row."""
