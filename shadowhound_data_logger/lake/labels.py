"""Labels that people give to a time, an object, or a box in an image. They are stored in immutable layers.

A layer is a row file, ``<robot>/_labels/date=YYYY-MM-DD/<robot>_<YYYYMMDDTHHMMSS>_<digest>.jsonl.zst``, with the date (UTC) of
its creation. Each row adds or removes a label. The ``id`` of a label is a hash of its content, so that a label that is imported
repeatedly exists once. The newest row about a label counts.
"""

from __future__ import annotations

import csv
import hashlib
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.keys import check_name, is_name
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, check_size, csv_rows, from_json, is_path
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import BUCKET, Row
from shadowhound_data_logger.formats.rows.labels import LABEL, LABELS, MAX_TEXT, REMOVED
from shadowhound_data_logger.lake.bucket import Bucket, put_part
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.select import TimeSpan, Wanted, within
from shadowhound_data_logger.lake.views import rows_of
from shadowhound_data_logger.stores.base import ObjectStore

MAX_LABELS_PER_LAYER: Final = 50_000
_BOX: Final = ('x', 'y', 'width', 'height')
_CSV: Final = frozenset({'label', 'since', 'until', 'robot', 'bucket', 'key', 'note', *_BOX})


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """A label of a time of one robot (both ends inclusive), of an object if it has a key, or of a box in an image, in pixels."""

    robot: str
    label: str
    since_ns: int
    until_ns: int
    bucket: str | None = None
    key: str | None = None
    x: float | None = None
    y: float | None = None
    """Position of the box's upper left corner, from that of the image."""
    width: float | None = None
    height: float | None = None
    note: str = ''
    by: str = ''
    made_ns: int = 0
    id: str = ''
    """A hash of the label without its author, creation time and note."""

    @property
    def box(self) -> tuple[float, float, float, float] | None:
        """x, y, width and height; None for a label of a whole object."""
        if self.x is None or self.y is None or self.width is None or self.height is None:
            return None
        return self.x, self.y, self.width, self.height

    def checked(self) -> Label:
        """The label with its id. Raises SettingError, NameRefused if it is invalid."""
        check_name(self.robot, 'the robot name')
        if not self.label.strip() or len(self.label) > MAX_TEXT or not self.label.isprintable():
            raise SettingError('label', self.label[:80], f'a text on one line, of at most {MAX_TEXT} characters')
        if len(self.note) > 10 * MAX_TEXT:
            raise SettingError('note', self.note[:80], f'a text of at most {10 * MAX_TEXT:,} characters')
        if not 0 <= self.since_ns <= self.until_ns < 1 << 63:
            raise SettingError('until', self.until_ns, f'a time after since, which is {self.since_ns}')
        box = [getattr(self, name) for name in _BOX]
        are_sides = all(one is not None and math.isfinite(one) for one in box) and self.key is not None and min(box[2:]) > 0
        if not are_sides and any(one is not None for one in box):
            raise SettingError('box', box, 'x, y, width and height in pixels, of an object')
        if self.key is not None and not (
            is_path(self.key) and self.key.startswith(f'{self.robot}/') and is_name(self.bucket or '')
        ):
            raise SettingError('key', self.key[:200], f'the key of an object of {self.robot}, which starts with {self.robot}/')
        identity = [self.robot, self.label, self.since_ns, self.until_ns, self.bucket, self.key, *box]
        return replace(self, id=hashlib.blake2b('\0'.join(map(str, identity)).encode(), digest_size=8).hexdigest())


FIELDS: Final = tuple(each.name for each in fields(Label))
"""The columns of a label."""


def write(store: ObjectStore, robot: str, found: Sequence[Label], *, by: str, is_removal: bool = False) -> str:
    """Upload a layer that adds or removes these labels of one robot; returns its key. Raises SettingError, StoreError."""
    if not 0 < len(found) <= MAX_LABELS_PER_LAYER:
        raise SettingError('labels', len(found), f'1 to {MAX_LABELS_PER_LAYER:,} at a time')
    made_ns = time.time_ns()
    rows: list[Row] = []
    for each in found:
        one = each.checked()
        columns = {name: getattr(one, name) for name in FIELDS}
        rows.append({**columns, 'what': REMOVED if is_removal else LABEL, 'by': by, 'made_ns': made_ns, 'made': made_ns // 1000,
                     'format_version': 1})  # fmt: skip
    body = parts.encode(rows, LABELS)
    digest = hashlib.blake2b(body, digest_size=8).hexdigest()
    made = utc(made_ns)
    key = LABELS.part_key(robot, f'{made:%Y-%m-%d}', f'{made:%Y%m%dT%H%M%S}_{digest}')
    put_part(store, key, robot, body, len(rows))
    return key


def read(source: Bucket, robot: str | None = None, *, label: str | None = None, findings: Findings | None = None) -> list[Label]:
    """The labels of one robot or of all that were not removed, ordered by time. Raises StoreError."""
    findings = Findings() if findings is None else findings
    newest: dict[tuple[str, str], Row] = {}
    for row in rows_of(source, LABELS, findings, robot=robot).to_pylist():
        name = row['robot'], row['id']
        if name not in newest or (row['made_ns'], row['what']) > (newest[name]['made_ns'], newest[name]['what']):
            newest[name] = row
    standing = (row for row in newest.values() if row['what'] == LABEL and label in {None, row['label']})
    labels = (Label(**{name: row[name] for name in FIELDS if row[name] is not None}) for row in standing)
    return sorted(labels, key=lambda each: (each.robot, each.since_ns, each.label, each.id))


def spans(found: Iterable[Label]) -> tuple[list[TimeSpan], list[tuple[str, str]]]:
    """The labeled times, and (bucket, key) of labeled objects."""
    times, keys = [], []
    for each in found:
        if each.key is None:
            times.append(TimeSpan(each.robot, each.since_ns, each.until_ns))
        else:
            keys.append((each.bucket or BUCKET, each.key))
    return times, keys


def with_label_resolved(source: Bucket, asked: Wanted, findings: Findings) -> Wanted:
    """Replace the label in a query by the times and objects that have it. Raises StoreError."""
    if asked.label is None:
        return asked
    found = read(source, asked.robot, label=asked.label, findings=findings)
    times, keys = spans(found)
    ends = [end_ns for each in found for end_ns in (each.since_ns, each.until_ns)]
    return within(replace(asked, label=None), times, keys, ends)


def column(rows: pa.Table, found: Sequence[Label]) -> list[list[str]]:
    """The labels of each row's object: those of its key, and those of times that it overlaps.

    The rows need the columns ``robot bucket key t_start_ns t_end_ns``.
    """
    of_keys: dict[tuple[str, str], set[str]] = {}
    labels: list[set[str]] = [set() for _ in range(len(rows))]
    first = pc.fill_null(rows['t_start_ns'], -1).to_numpy()
    last = np.maximum(first, pc.fill_null(rows['t_end_ns'], -1).to_numpy())
    robots_of = np.array(rows['robot'].to_pylist(), object)
    for each in found:
        if each.key is not None:
            of_keys.setdefault((each.bucket or BUCKET, each.key), set()).add(each.label)
            continue
        for index in np.flatnonzero(
            (robots_of == each.robot) & (first <= each.until_ns) & (last >= each.since_ns) & (first >= 0)
        ):
            labels[int(index)].add(each.label)
    if of_keys:
        for number, name in enumerate(zip(rows['bucket'].to_pylist(), rows['key'].to_pylist(), strict=True)):
            labels[number] |= of_keys.get(name, set())
    return [sorted(each) for each in labels]


def with_column(rows: pa.Table, found: Sequence[Label]) -> pa.Table:
    """The rows with an additional column ``labels``."""
    return rows.append_column('labels', pa.array(column(rows, found), pa.list_(pa.string())))


# -- files of labels -----------------------------------------------------------------------------------------------------------


def from_csv(body: bytes, robot: str, now_ns: int) -> list[Label]:
    """Read a CSV with the columns ``label since until`` and optionally ``robot bucket key x y width height note``.

    Times are written as in ``query``; those of a row with a key may be empty: ``with_times`` adds them. Raises LakeError.
    """
    try:
        check_size(len(body), MAX_DOCUMENT_BYTES)
        reader = csv_rows(body)
        _check_columns(reader.fieldnames or ())
        return [_of_csv({name: value or '' for name, value in row.items()}, robot, now_ns) for row in reader]
    except (ValueError, csv.Error, TypeError) as error:
        raise LakeError(f'it is not a CSV of labels: {error}') from error


def _check_columns(names: Iterable[str]) -> None:
    names = [*names]
    if 'label' not in names or set(names) - _CSV or len(set(names)) != len(names):
        raise ValueError(
            f'its first line must name the columns, each once: label, and any of {" ".join(sorted(_CSV - {"label"}))}'
        )


def _of_csv(row: Mapping[str, str], robot: str, now_ns: int) -> Label:
    if '' in row:
        raise ValueError(f'the row of the label {row["label"]!r} has more cells than the first line')
    key = row.get('key') or None
    if key is None and not (row.get('since') and row.get('until')):
        raise ValueError(f'the label {row["label"]!r} has neither since and until nor a key')
    since_ns, until_ns = (moment(name, row[name], now_ns) if row.get(name) else 0 for name in ('since', 'until'))
    x, y, width, height = (float(row[name]) if row.get(name) else None for name in _BOX)
    return Label(robot=row.get('robot') or robot, label=row['label'], since_ns=since_ns, until_ns=until_ns,
                 bucket=(row.get('bucket') or BUCKET) if key else None, key=key, x=x, y=y, width=width, height=height,
                 note=row.get('note', ''))  # fmt: skip


def from_coco(body: bytes, robot: str) -> list[Label]:
    """Read the boxes of a COCO file, without times. Each ``file_name`` is a key, as ``fetch`` names images. Raises LakeError.

    https://cocodataset.org/#format-data: ``bbox`` is x, y, width, height from the upper left corner, in pixels.
    """
    try:
        document = from_json(body)
        names = {one['id']: str(one['name']) for one in document['categories']}
        keys = {one['id']: str(one['file_name']) for one in document['images']}
        found = []
        for one in document['annotations']:
            x, y, width, height = (float(side) for side in one['bbox'])
            key = keys[one['image_id']]
            found.append(Label(robot=robot or key.partition('/')[0], label=names[one['category_id']], since_ns=0, until_ns=0,
                               bucket=BUCKET, key=key, x=x, y=y, width=width, height=height))  # fmt: skip
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        raise LakeError(
            f'it is not a COCO file of boxes: {" ".join(str(error).split())[:200] or type(error).__name__}'
        ) from error
    return found


def with_times(source: Bucket, found: Sequence[Label], findings: Findings) -> tuple[list[Label], list[str]]:
    """The labels, with the times of labeled objects; and the keys of objects without a row. Raises StoreError."""
    from shadowhound_data_logger.lake import query  # noqa: PLC0415 - imports labels

    wanted_keys = {(each.bucket, each.key) for each in found if each.key is not None}
    if not wanted_keys:
        return list(found), []
    times: dict[tuple[str, str], tuple[int, int]] = {}
    for robot in sorted({each.robot for each in found}):
        columns = ('bucket', 'key', 't_start_ns', 't_end_ns')
        rows = query.objects(source, findings=findings, robot=robot, columns=columns)
        rows = rows.filter(
            pc.is_in(rows['key'].cast(pa.string()), value_set=pa.array([key for _, key in wanted_keys], pa.string()))
        )
        for bucket, key, first, last in zip(*(each.to_pylist() for each in rows.columns), strict=True):
            if first is not None:
                times[bucket, key] = first, first if last is None else max(first, last)
    kept, absent = [], []
    for each in found:
        if each.key is None:
            kept.append(each)
        elif (each.bucket or BUCKET, each.key) in times:
            since_ns, until_ns = times[each.bucket or BUCKET, each.key]
            kept.append(replace(each, since_ns=since_ns, until_ns=until_ns))
        else:
            absent.append(each.key)
    return kept, absent


def by_robot(found: Iterable[Label]) -> Iterator[tuple[str, list[Label]]]:
    """The labels of each robot, in groups of at most ``MAX_LABELS_PER_LAYER``."""
    grouped: dict[str, list[Label]] = {}
    for each in found:
        grouped.setdefault(each.robot, []).append(each)
    for robot, some in grouped.items():
        for start in range(0, len(some), MAX_LABELS_PER_LAYER):
            yield robot, some[start : start + MAX_LABELS_PER_LAYER]
