"""``trajectory.png`` and ``battery.png``: the plots of a mission, 800 pixels wide.

They share the style of all our plots. Importing this module loads matplotlib, which takes a second and 60 MB: code that runs in
an agent or the node must not import it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

INK: Final = '#22303c'
BLUE: Final = '#1f6fb2'
TEAL: Final = '#16917f'
AMBER: Final = '#e08a1e'
STYLE: Final = {
    'font.family': 'DejaVu Sans', 'font.size': 10, 'text.color': INK, 'axes.labelcolor': INK, 'axes.edgecolor': '#c7cfd6',
    'xtick.color': INK, 'ytick.color': INK, 'axes.spines.top': False, 'axes.spines.right': False, 'axes.grid': True,
    'grid.color': '#e9edf0', 'axes.axisbelow': True, 'legend.frameon': False, 'axes.titlelocation': 'left',
    'axes.titleweight': 'bold', 'axes.titlesize': 12, 'axes.titlepad': 10,
}  # fmt: skip
DPI: Final = 120
MAX_POINTS: Final = 4000
"""Per line: more cannot be distinguished at this size."""
SPEED_WINDOW_S: Final = 1.0
"""Speeds are averaged over this time: from one sample to the next, the noise of odometry would hide them."""
CELL_M: Final = 0.05
"""Size of a cell of the floor plan."""
MAX_CELLS: Final = 1000
"""Along an axis of the floor plan."""
MIN_SPAN_M: Final = 2.0
"""Of an axis: a robot at rest must not look as if it had walked."""
MIN_SPAN: Final = 10.0
"""Percent and degrees Celsius, for the same reason."""
WIDTH_IN: Final = 800 / DPI
Array = NDArray[np.float64]


def trajectory(path: Array, floor: Array | None, title: str, target: Path) -> None:
    """Plot a path (rows of time in s, x and y in m) over the floor (rows of x and y in m).

    Raises ValueError for fewer than two poses.
    """
    if len(path) < 2:
        raise ValueError(f'{len(path)} poses are not a path')
    time, xy = path[:, 0], path[:, 1:3]
    length = float(np.hypot(*np.diff(xy, axis=0).T).sum())
    speed = _speed(time, xy)
    kept = np.unique(np.linspace(0, len(xy) - 1, min(len(xy), MAX_POINTS)).round().astype(int))
    xy, speed = xy[kept], speed[kept]
    extent = _extent(xy, floor)
    with mpl.rc_context(STYLE):
        tall = (extent[3] - extent[2]) / (extent[1] - extent[0])
        figure = Figure(figsize=(WIDTH_IN, 5.2 * tall + 0.95), dpi=DPI, layout='constrained')
        axes = figure.add_subplot()
        if floor is not None and len(floor):
            axes.imshow(_from_above(floor, extent), extent=extent, origin='lower', cmap='Greys', vmin=0, vmax=1.6,
                        interpolation='nearest')  # fmt: skip
            axes.grid(visible=False)
        fastest = max(float(np.quantile(speed, 0.98)), 0.1)
        line = LineCollection(list(np.stack([xy[:-1], xy[1:]], axis=1)), cmap='viridis', norm=Normalize(0, fastest),
                              array=(speed[:-1] + speed[1:]) / 2, linewidth=2.6, capstyle='round')  # fmt: skip
        axes.add_collection(line)
        axes.plot(*xy[0], marker='o', ms=10, mfc='white', mec=INK, mew=2, ls='', label='start', zorder=4)
        axes.plot(*xy[-1], marker='s', ms=9, mfc=AMBER, mec=INK, mew=1.5, ls='', label='end', zorder=5)
        axes.set(xlabel='x [m]', ylabel='y [m]', xlim=extent[:2], ylim=extent[2:], aspect='equal')
        axes.set_title(f'{title}: {length:.1f} m')
        axes.legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2, handletextpad=0.3)
        bar = figure.colorbar(line, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)), label='speed [m/s]',
                              extend='max' if speed.max() > 1.02 * fastest else 'neither')  # fmt: skip
        bar.outline.set_visible(False)
        figure.savefig(target, format='png')


def battery(series: Mapping[str, Sequence[tuple[float, float]]], title: str, target: Path) -> None:
    """Plot battery (%) and temperature (degrees Celsius) over time (s since the start).

    Raises ValueError if neither has two points.
    """
    panels = [(name, np.array(series[name])) for name in series if len(series[name]) > 1]
    if not panels:
        raise ValueError('neither battery nor temperature was logged twice')
    longest = max(float(points[:, 0].max()) for _, points in panels)
    scale, of_time = (60.0, 'min') if longest > 300 else (1.0, 's')
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 1.2 + 1.9 * len(panels)), dpi=DPI, layout='constrained')
        for axes, (name, logged) in zip(np.ravel(figure.subplots(len(panels), 1, sharex=True)), panels, strict=True):
            color, label, unit = _LOOKS[name]
            points = logged[np.argsort(logged[:, 0], kind='stable')]
            axes.plot(points[:, 0] / scale, points[:, 1], color=color, lw=2, marker='o' if len(points) < 30 else '', ms=4)
            low, high = float(points[:, 1].min()), float(points[:, 1].max())
            room = max(MIN_SPAN, 1.25 * (high - low)) / 2
            axes.set(ylabel=f'{label} [{unit}]', ylim=((low + high) / 2 - room, (low + high) / 2 + room))
            axes.set_title(f'{points[0, 1]:.1f} to {points[-1, 1]:.1f} {unit}', loc='right', fontsize=10, fontweight='normal')
        axes.set(xlabel=f'time since the start [{of_time}]')
        axes.margins(x=0.02)
        figure.axes[0].set_title(title)
        figure.savefig(target, format='png')


_LOOKS: Final[Mapping[str, tuple[str, str, str]]] = {
    'battery_pct': (BLUE, 'battery', '%'), 'temperature_c': (AMBER, 'temperature', '\N{DEGREE SIGN}C'),
}  # fmt: skip
"""Color, label and unit."""


def _speed(time: Array, xy: Array) -> Array:
    """The speed in m/s at each pose, over a window around it; 0 where time does not pass."""
    order = np.maximum.accumulate(time)
    before, after = np.clip(order - SPEED_WINDOW_S / 2, order[0], None), np.clip(order + SPEED_WINDOW_S / 2, None, order[-1])
    steps = np.stack([np.interp(after, order, column) - np.interp(before, order, column) for column in xy.T])
    passed = after - before
    speed = np.zeros_like(passed)
    np.divide(np.hypot(*steps), passed, out=speed, where=passed > 0)
    return speed


def _extent(xy: Array, floor: Array | None) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 of the plot: the whole path, and the floor without outliers."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    if floor is not None and len(floor):
        low, high = np.minimum(low, np.quantile(floor, 0.005, axis=0)), np.maximum(high, np.quantile(floor, 0.995, axis=0))
    edge = 0.06 * float((high - low).max()) + 0.2
    middle, half = (low + high) / 2, np.maximum((high - low) / 2 + edge, MIN_SPAN_M / 2)
    half = np.maximum(half, (half[1], half[0] / 3))  # limits the aspect ratio to 1:1 to 3:1
    return (float(middle[0] - half[0]), float(middle[0] + half[0]), float(middle[1] - half[1]), float(middle[1] + half[1]))


def _from_above(floor: Array, extent: tuple[float, float, float, float]) -> Any:
    """How often each cell was occupied, from 0 to 1, rows along y."""
    x0, x1, y0, y1 = extent
    cell = max(CELL_M, max(x1 - x0, y1 - y0) / MAX_CELLS)
    shape = (max(1, round((y1 - y0) / cell)), max(1, round((x1 - x0) / cell)))
    strength = np.log1p(np.histogram2d(floor[:, 1], floor[:, 0], bins=shape, range=((y0, y1), (x0, x1)))[0])
    seen = strength[strength > 0]
    return np.minimum(strength / np.quantile(seen, 0.95), 1.0) if len(seen) else strength
