"""Pictures of query results: a contact sheet of images, a map of objects, the coverage of topics, and the upload speed on a map.

Importing this module loads Pillow; the plots load matplotlib.
"""

from __future__ import annotations

import math
import tempfile
import textwrap
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused
from shadowhound_data_logger.core.untrusted import MAX_OBJECT_BYTES, visible
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetched import UNWRITABLE
from shadowhound_data_logger.lake.gaps import DOWNSAMPLED, NOT_KNOWN, STORED, Coverage, named
from shadowhound_data_logger.lake.link import LinkSample
from shadowhound_data_logger.missions.contact_sheet import MAX_FRAMES, LoggedFrame, contact_sheet, evenly_spaced

IMAGES: Final = ('.jpg', '.jpeg', '.png')
THREADS: Final = 8
PALE: Final = '#c7cfd6'
SKY: Final = '#9cc4e4'
LOST: Final = ('#c0392b', '#e08e0b', '#8e44ad', '#d35400', '#7f1d1d', '#b0578d')
"""Causes of gaps, by name."""
MAX_LINES: Final = 60
LINE_DOTS: Final = 700
"""Pixels across a line of coverage: a gap is at least one pixel wide."""
DAY_NS: Final = 24 * 3600 * SECOND
MAX_DISTANCE_M: Final = 1e6
LETTERS: Final = 56
"""Per line of the title."""
SQUARE_M: Final = 1.0
"""Side of a square of the map that has one color."""
DOTS: Final = 60
"""Largest area of an object's marker on the map, in square points."""


def sheet(rows: Sequence[Mapping[str, Any]], open_bucket: Callable[[str], Bucket], title: str, target: Path) -> None:
    """Write a JPEG with up to twenty evenly spaced images of these rows; a frame's number is that of its row, from 1.

    Raises LakeError if no row has an image, StoreError.
    """
    images = [(number, row) for number, row in enumerate(rows, 1) if str(row['key']).lower().endswith(IMAGES)]
    if not images:
        raise LakeError('no image was found', remedy='query with --sensor camera')

    def save(numbered: tuple[int, Mapping[str, Any]]) -> LoggedFrame | None:
        number, row = numbered
        path = Path(folder, str(number))
        try:
            path.write_bytes(open_bucket(row['bucket']).get(row['key'], MAX_OBJECT_BYTES))
        except ObjectRefused:  # the catalog has deleted objects, too
            return None
        return LoggedFrame(row.get('t_start_ns') or 0, number, path)

    with tempfile.TemporaryDirectory(prefix='shadowhound-sheet-') as folder, ThreadPoolExecutor(THREADS) as pool:
        frames = [frame for frame in pool.map(save, evenly_spaced(images, MAX_FRAMES)) if frame is not None]
        try:
            contact_sheet(frames, title, min((frame.time_ns for frame in frames), default=0), target)
        except (OSError, ValueError) as error:
            raise LakeError(
                f'{target} cannot be written: {getattr(error, "strerror", None) or error}', remedy=UNWRITABLE
            ) from error


def ground(
    rows: Sequence[Mapping[str, Any]], path: Sequence[tuple[float, float]], near: tuple[float, float, float] | None, title: str,
    target: Path,
) -> None:  # fmt: skip
    """Write a PNG with a map of the objects, colored by battery if known, over all poses of that time.

    Raises LakeError if no object has a position.
    """
    from matplotlib import rc_context  # noqa: PLC0415 - takes a second, only for this picture
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.patches import Circle  # noqa: PLC0415

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415

    placed = [row for row in rows if _is_plausible(row.get('x'), row.get('y'))]
    path = [pair for pair in path if _is_plausible(*pair)]
    if not placed:
        raise LakeError('none of the objects has a position', remedy='check that the robot published odometry at that time')
    with rc_context(plots.STYLE):
        figure = Figure(dpi=plots.DPI, layout='constrained')
        axes = figure.add_subplot()
        if path:
            east, north = zip(*path, strict=True)
            axes.scatter(east, north, s=5, c=PALE, lw=0, label='all poses')
        if near is not None:
            axes.add_patch(Circle(near[:2], near[2], fill=False, ec=plots.AMBER, lw=1.6, ls='--'))
            axes.plot([], [], c=plots.AMBER, lw=1.6, ls='--', label='selected')
        charge = [float('nan') if row.get('battery_pct') is None else row['battery_pct'] for row in placed]
        is_known = any(value == value for value in charge)  # noqa: PLR0124 - not all are NaN
        style = {'c': charge, 'cmap': 'viridis', 'plotnonfinite': True} if is_known else {'c': plots.BLUE}
        xs, ys = [row['x'] for row in placed], [row['y'] for row in placed]
        size = max(8.0, min(DOTS, 6000 / len(placed)))
        dots = axes.scatter(xs, ys, s=size, ec='white', lw=0.5, label='found', zorder=3, **style)
        axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')
        axes.set_title('\n'.join(textwrap.wrap(f'{title}: {len(placed):,}' if title else f'{len(placed):,} objects', LETTERS)))
        axes.margins(0.08)
        if is_known:
            bar = figure.colorbar(dots, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)), label='battery [%]')
            bar.outline.set_visible(False)
        (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
        figure.set_size_inches(plots.WIDTH_IN, min(max(0.8 * plots.WIDTH_IN * (y1 - y0) / (x1 - x0), 2.5), 12.0) + 1.3)
        figure.legend(loc='outside lower center', ncols=3)
        try:
            figure.savefig(target, format='png')
        except OSError as error:
            raise LakeError(f'{target} cannot be written: {error.strerror or error}', remedy=UNWRITABLE) from error


def coverage(found: Sequence[Coverage], title: str, target: Path) -> None:
    """Write a PNG with the coverage of topics: one line per topic over time, colored by state.

    Raises LakeError for more than ``MAX_LINES`` topics; there must be at least one.
    """
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415

    if len(found) > MAX_LINES:
        raise LakeError(f'{len(found):,} topics do not fit into a picture', remedy='select with --robot or --topic')
    spans: dict[str, dict[int, list[tuple[int, int]]]] = {STORED: {}, DOWNSAMPLED: {}}
    for line, each in enumerate(found):
        for begin_ns, end_ns, word in named(each.known, each.downsampled):
            spans.setdefault(word, {}).setdefault(line, []).append((begin_ns, end_ns))
    open_ = spans.pop(NOT_KNOWN, {})
    causes = sorted(spans.keys() - {STORED, DOWNSAMPLED})
    colors = {STORED: plots.BLUE, DOWNSAMPLED: SKY, **{cause: LOST[index % len(LOST)] for index, cause in enumerate(causes)},
               NOT_KNOWN: PALE}  # fmt: skip
    begin_ns, end_ns = found[0].known.begin_ns, found[0].known.end_ns
    pixel_ns = (end_ns - begin_ns) // LINE_DOTS
    with rc_context({**plots.STYLE, 'text.parse_math': False}):  # a topic's name is not a formula
        figure = Figure(figsize=(plots.WIDTH_IN, 1.8 + 0.42 * len(found)), dpi=plots.DPI, layout='constrained')
        axes = figure.add_subplot()
        for word, lines in {**spans, NOT_KNOWN: open_}.items():
            min_ns = pixel_ns if word in causes else 0  # so that a short gap is visible
            for line, some in lines.items():
                axes.broken_barh([(date2num(utc(first)), max(last - first, min_ns) / DAY_NS) for first, last in some],
                                 (line - 0.36, 0.72), fc=colors[word], lw=0, zorder=3 if word in causes else 2)  # fmt: skip
        axes.set_yticks(range(len(found)), [visible(f'{each.known.robot} {each.known.topic}') for each in found])
        axes.set(xlim=(date2num(utc(begin_ns)), date2num(utc(end_ns))), ylim=(len(found) - 0.5, -0.5))
        axes.xaxis.set_major_locator(locator := AutoDateLocator())
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        axes.set_title('\n'.join(textwrap.wrap(title, LETTERS)))
        shown = [word for word in colors if spans.get(word) or (word == NOT_KNOWN and open_)]
        figure.legend(
            handles=[Patch(fc=colors[word], label=visible(word)) for word in shown], loc='outside lower center', ncols=4
        )
        try:
            figure.savefig(target, format='png')
        except OSError as error:
            raise LakeError(f'{target} cannot be written: {error.strerror or error}', remedy=UNWRITABLE) from error


def wifi(found: Sequence[LinkSample], title: str, target: Path) -> None:
    """Write a PNG with a map of the upload speed in squares of ground. Raises LakeError if no sample has a position."""
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415

    squares: dict[tuple[int, int], list[float]] = {}
    for one in found:
        if one.x is not None and one.y is not None and _is_plausible(one.x, one.y):
            squares.setdefault((math.floor(one.x / SQUARE_M), math.floor(one.y / SQUARE_M)), []).append(one.mbps)
    if not squares:
        raise LakeError(
            'no sample of the link has a position', remedy='check that the robot had odometry and something to upload'
        )
    with rc_context(plots.STYLE):
        figure = Figure(figsize=(plots.WIDTH_IN, plots.WIDTH_IN), dpi=plots.DPI, layout='constrained')
        axes = figure.add_subplot()
        xs, ys = zip(*(((x + 0.5) * SQUARE_M, (y + 0.5) * SQUARE_M) for x, y in squares), strict=True)
        speeds = [median(each) for each in squares.values()]
        dots = axes.scatter(xs, ys, c=speeds, s=DOTS, marker='s', cmap='viridis', vmin=0.0, lw=0)
        axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')
        axes.set_title('\n'.join(textwrap.wrap(title, LETTERS)))
        axes.margins(0.08)
        figure.colorbar(dots, label=f'uploads, median of {SQUARE_M:g} m squares [Mbit/s]').outline.set_visible(False)
        try:
            figure.savefig(target, format='png')
        except OSError as error:
            raise LakeError(f'{target} cannot be written: {error.strerror or error}', remedy=UNWRITABLE) from error


def _is_plausible(x: float | None, y: float | None) -> bool:
    """Whether a robot can have been there: a forged position would set the scale of the map."""
    return x is not None and y is not None and abs(x) < MAX_DISTANCE_M and abs(y) < MAX_DISTANCE_M
