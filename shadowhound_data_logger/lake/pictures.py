"""Pictures of an answer: a contact sheet of the images that were found, and where the objects lie on the ground.

Importing this loads Pillow; ``ground`` loads matplotlib.
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
from shadowhound_data_logger.core.untrusted import MOST_OBJECT_BYTES, visible
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
MOST_LINES: Final = 60
LINE_DOTS: Final = 700
"""Across a line of coverage: a gap is drawn at least so wide."""
DAY_NS: Final = 24 * 3600 * SECOND
FARTHEST_M: Final = 1e6
LETTERS: Final = 56
"""Of a line of the title."""
SQUARE_M: Final = 1.0
"""Side of a square of ground whose link is one colour."""
DOTS: Final = 60
"""Area of an object on the ground, in square points, where there are few."""


def sheet(rows: Sequence[Mapping[str, Any]], open_bucket: Callable[[str], Bucket], title: str, target: Path) -> None:
    """A JPEG with up to twenty of the images among the rows, evenly chosen; a frame's number is its row's, from 1.

    Raises LakeError where there is none, StoreError.
    """
    images = [(number, row) for number, row in enumerate(rows, 1) if str(row['key']).lower().endswith(IMAGES)]
    if not images:
        raise LakeError('no image was found', remedy='query with --sensor camera')

    def save(numbered: tuple[int, Mapping[str, Any]]) -> LoggedFrame | None:
        number, row = numbered
        path = Path(folder, str(number))
        try:
            path.write_bytes(open_bucket(row['bucket']).get(row['key'], MOST_OBJECT_BYTES))
        except ObjectRefused:  # the catalogue outlives what is deleted
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
    """A PNG: the objects by their places, coloured by battery where that is known, over all poses of that time.

    Raises LakeError where none has a place.
    """
    from matplotlib import rc_context  # noqa: PLC0415 - a second, for this picture alone
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.patches import Circle  # noqa: PLC0415

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415

    placed = [row for row in rows if _is_place(row.get('x'), row.get('y'))]
    path = [pair for pair in path if _is_place(*pair)]
    if not placed:
        raise LakeError('no object that was found has a place', remedy='was there odometry when it was recorded?')
    with rc_context(plots.STYLE):
        figure = Figure(dpi=plots.DPI, layout='constrained')
        axes = figure.add_subplot()
        if path:
            east, north = zip(*path, strict=True)
            axes.scatter(east, north, s=5, c=PALE, lw=0, label='all poses')
        if near is not None:
            axes.add_patch(Circle(near[:2], near[2], fill=False, ec=plots.AMBER, lw=1.6, ls='--'))
            axes.plot([], [], c=plots.AMBER, lw=1.6, ls='--', label='asked for')
        charge = [float('nan') if row.get('battery_pct') is None else row['battery_pct'] for row in placed]
        is_known = any(value == value for value in charge)  # noqa: PLR0124 - not all are NaN
        look = {'c': charge, 'cmap': 'viridis', 'plotnonfinite': True} if is_known else {'c': plots.BLUE}
        xs, ys = [row['x'] for row in placed], [row['y'] for row in placed]
        size = max(8.0, min(DOTS, 6000 / len(placed)))
        dots = axes.scatter(xs, ys, s=size, ec='white', lw=0.5, label='found', zorder=3, **look)
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
    """A PNG: a line a topic over the time, each stretch in the colour of what became of it. Raises LakeError.

    At least one topic, and no more than ``MOST_LINES``.
    """
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415

    if len(found) > MOST_LINES:
        raise LakeError(f'{len(found):,} topics do not fit into a picture', remedy='select with --robot or --topic')
    spans: dict[str, dict[int, list[tuple[int, int]]]] = {STORED: {}, DOWNSAMPLED: {}}
    for line, each in enumerate(found):
        for begin_ns, end_ns, word in named(each.known, each.downsampled):
            spans.setdefault(word, {}).setdefault(line, []).append((begin_ns, end_ns))
    open_ = spans.pop(NOT_KNOWN, {})
    causes = sorted(spans.keys() - {STORED, DOWNSAMPLED})
    colours = {STORED: plots.BLUE, DOWNSAMPLED: SKY, **{cause: LOST[place % len(LOST)] for place, cause in enumerate(causes)},
               NOT_KNOWN: PALE}  # fmt: skip
    begin_ns, end_ns = found[0].known.begin_ns, found[0].known.end_ns
    least_ns = (end_ns - begin_ns) // LINE_DOTS
    with rc_context({**plots.STYLE, 'text.parse_math': False}):  # a topic's name is not a formula
        figure = Figure(figsize=(plots.WIDTH_IN, 1.8 + 0.42 * len(found)), dpi=plots.DPI, layout='constrained')
        axes = figure.add_subplot()
        for word, lines in {**spans, NOT_KNOWN: open_}.items():
            widest = least_ns if word in causes else 0  # a short gap is as wide as can be seen
            for line, some in lines.items():
                axes.broken_barh([(date2num(utc(first)), max(last - first, widest) / DAY_NS) for first, last in some],
                                 (line - 0.36, 0.72), fc=colours[word], lw=0, zorder=3 if word in causes else 2)  # fmt: skip
        axes.set_yticks(range(len(found)), [visible(f'{each.known.robot} {each.known.topic}') for each in found])
        axes.set(xlim=(date2num(utc(begin_ns)), date2num(utc(end_ns))), ylim=(len(found) - 0.5, -0.5))
        axes.xaxis.set_major_locator(locator := AutoDateLocator())
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        axes.set_title('\n'.join(textwrap.wrap(title, LETTERS)))
        shown = [word for word in colours if spans.get(word) or (word == NOT_KNOWN and open_)]
        figure.legend(
            handles=[Patch(fc=colours[word], label=visible(word)) for word in shown], loc='outside lower center', ncols=4
        )
        try:
            figure.savefig(target, format='png')
        except OSError as error:
            raise LakeError(f'{target} cannot be written: {error.strerror or error}', remedy=UNWRITABLE) from error


def wifi(found: Sequence[LinkSample], title: str, target: Path) -> None:
    """A PNG: squares of ground in the colour of how fast uploads went there. Raises LakeError where no sample has a place."""
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    from shadowhound_data_logger.missions import plots  # noqa: PLC0415

    squares: dict[tuple[int, int], list[float]] = {}
    for one in found:
        if one.x is not None and one.y is not None and _is_place(one.x, one.y):
            squares.setdefault((math.floor(one.x / SQUARE_M), math.floor(one.y / SQUARE_M)), []).append(one.mbps)
    if not squares:
        raise LakeError('no sample of the link has a place', remedy='was there odometry, and something to upload?')
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


def _is_place(x: float | None, y: float | None) -> bool:
    """Whether a robot can have been there: what somebody made up would set the scale for all the others."""
    return x is not None and y is not None and abs(x) < FARTHEST_M and abs(y) < FARTHEST_M
