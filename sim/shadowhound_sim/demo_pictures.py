"""The demo's plots, made only from objects that were read back from the S3 server, and from the readings of the run."""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from pypcd4.pypcd4 import PointCloud

from shadowhound_data_logger.missions.plots import AMBER, BLUE, DPI, INK, STYLE, TEAL
from shadowhound_sim.demo_run import Record
from shadowhound_sim.floor_plan import FloorPlan

log = logging.getLogger(__name__)

CELL_M: Final = 0.03
"""Cell size of the map that is drawn from the point clouds."""
FLOOR_M: Final = 0.08
LINTEL_M: Final = 1.9
"""Heights in between are walls and furniture, as seen from above."""
SHEET: Final = (4, 3)
"""Columns and rows of the contact sheet."""
THUMB: Final = (240, 180)
GAP: Final = 8
PAGE_MS: Final = 90_000
SETTLE_MS: Final = 3000
"""Time for the page to render; the screenshot is only for people."""
CAPTION: Final = 18


def draw(folder: Path, bodies: Mapping[str, bytes], record: Record) -> list[Path]:
    """Write the PNG files into the folder; returns the paths of those with data."""
    with mpl.rc_context(STYLE):
        made = [
            contact_sheet(_objects_of_sensor(bodies, 'camera'), folder / 'frames.png'),
            patrol(_objects_of_sensor(bodies, 'lidar'), _objects_of_sensor(bodies, 'odom'), record, folder / 'patrol.png'),
            delivery(record, folder / 'delivery.png'),
        ]
    return [path for path in made if path is not None]


def live_page(address: str, path: Path) -> list[Path]:
    """The live page at the middle of the patrol, rendered by this machine's Chromium; empty if there is none."""
    chromium = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
    if chromium is None or find_spec('playwright') is None:
        return []
    from playwright.sync_api import Error, sync_playwright  # noqa: PLC0415 - for tests; a demo may be without

    flags = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', *(['--no-sandbox'] if os.geteuid() == 0 else [])]
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=flags)
            page = browser.new_page(viewport={'width': 1280, 'height': 1382})
            page.set_default_timeout(PAGE_MS)
            page.goto(address)
            page.get_by_role('button', name='Back in time').click()
            page.locator('rect.recorded[data-topic="/odom"]').first.wait_for()
            missions = page.locator('select[aria-label=Mission]')
            if missions.count():
                missions.select_option(index=1)
            else:
                page.get_by_role('button', name='1 min', exact=True).click()
            page.wait_for_timeout(SETTLE_MS)
            recorded = page.locator('rect.recorded[data-topic="/odom"]').last
            recorded.scroll_into_view_if_needed()
            box = recorded.bounding_box()
            if box is not None:
                page.mouse.click(box['x'] + 0.6 * box['width'], box['y'] + 0.5 * box['height'])
            page.wait_for_timeout(SETTLE_MS)
            page.evaluate("scrollTo({top: 0, behavior: 'instant'})")
            page.wait_for_timeout(SETTLE_MS / 6)
            page.screenshot(path=path, type='jpeg', quality=82, timeout=PAGE_MS)
            browser.close()
    except Error as error:
        log.warning('there is no screenshot of the live page: %s', error)
        return []
    return [path]


def contact_sheet(frames: Mapping[str, bytes], path: Path) -> Path | None:
    """Evenly spaced camera frames in order of time, each with its name in the bucket."""
    columns, rows = SHEET
    keys = sorted(frames)
    chosen = [keys[round(place)] for place in np.linspace(0, len(keys) - 1, min(columns * rows, len(keys)))] if keys else []
    if not chosen:
        return None
    width, height = THUMB[0] + GAP, THUMB[1] + CAPTION + GAP
    sheet = Image.new('RGB', (columns * width + GAP, -(-len(chosen) // columns) * height + GAP), 'white')
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(11)
    for place, key in enumerate(chosen):
        x, y = GAP + place % columns * width, GAP + place // columns * height
        sheet.paste(Image.open(io.BytesIO(frames[key])).convert('RGB').resize(THUMB, Image.Resampling.LANCZOS), (x, y))
        pen.text((x, y + THUMB[1] + 3), key.partition('/')[2], fill=INK, font=font)
    sheet.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    return path


def patrol(clouds: Mapping[str, bytes], poses: Mapping[str, bytes], record: Record, path: Path) -> Path | None:
    """The building from the point clouds, seen from above, and the path through it; in amber while the Tower was unreachable."""
    if not clouds or not poses:
        return None
    plan = FloorPlan.build()
    x0, y0 = plan.corner
    x1, y1 = max(room.x1 for room in plan.rooms), max(room.y1 for room in plan.rooms)
    edge = 0.4
    extent = (x0 - edge, x1 + edge, y0 - edge, y1 + edge)
    density = _from_above(clouds, extent)
    way = [json.loads(poses[key]) for key in sorted(poses)]
    times = np.array([pose['stamp_ns'] for pose in way]) / 1e9
    xy = np.array([(pose['position']['x'], pose['position']['y']) for pose in way])
    figure = Figure(figsize=(9, 6.4), dpi=DPI, layout='constrained')
    axes = figure.add_subplot()
    axes.imshow(density, extent=extent, origin='lower', cmap='Greys', vmin=0, vmax=1, interpolation='nearest')
    axes.grid(visible=False)
    for room in plan.rooms:
        name = axes.text((room.x0 + room.x1) / 2, room.y1 - 0.5, room.name, color=INK, ha='center', fontsize=11, style='italic')
        name.set_path_effects([withStroke(linewidth=4, foreground='white')])
    axes.plot(*xy.T, color=BLUE, lw=2, marker='o', ms=4, label=f'odometry, {len(xy)} poses')
    if record.outage is not None:
        away = [record.outage[0] <= t <= record.outage[1] for t in times - times[0]]
        axes.plot(*xy[away].T, color=AMBER, lw=3, marker='o', ms=5, label='recorded while the S3 server was unreachable')
    axes.plot(*xy[0], marker='o', ms=11, mfc='white', mec=BLUE, mew=2, ls='', label='start')
    axes.set(xlabel='x [m], frame odom', ylabel='y [m]', aspect='equal')
    axes.set_title(f'The patrol, from {len(clouds)} point clouds and {len(xy)} poses in the bucket')
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.09), ncols=3)
    figure.savefig(path)
    return path


def delivery(record: Record, path: Path) -> Path:
    """Objects over time: spooled, delivered, and the backlog in between."""
    t = [reading.t for reading in record.readings]
    spooled = [reading.spooled for reading in record.readings]
    delivered = [reading.delivered for reading in record.readings]
    pending = [reading.pending for reading in record.readings]
    figure = Figure(figsize=(9, 5.2), dpi=DPI, layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    if record.outage is not None:
        for axes in (above, below):
            axes.axvspan(*record.outage, color=AMBER, alpha=0.16, lw=0)
        above.text(sum(record.outage) / 2, 0.97, 'S3 server down', transform=above.get_xaxis_transform(), ha='center', va='top',
                   color=AMBER, fontweight='bold')  # fmt: skip
    above.plot(t, spooled, color=BLUE, lw=2, label='on disk, in the spool (durable)')
    above.plot(t, delivered, color=TEAL, lw=2, label='in the S3 server (confirmed)')
    above.set(ylabel='objects', ylim=(0, None))
    above.set_title('Disk before network: the effect of the outage on delivery')
    above.legend(loc='upper left')
    below.fill_between(t, pending, color=AMBER, alpha=0.75, lw=0, step='post')
    below.set(xlabel='time since the first message [s]', ylabel='waiting', ylim=(0, None), xlim=(0, max(t)))
    figure.savefig(path)
    return path


def _objects_of_sensor(bodies: Mapping[str, bytes], sensor: str) -> dict[str, bytes]:
    return {key: body for key, body in bodies.items() if key.split('/')[1] == sensor}


def _from_above(clouds: Mapping[str, bytes], extent: tuple[float, float, float, float]) -> NDArray[Any]:
    """How often something solid was seen in each cell, 0 to 1, rows along y."""
    x0, x1, y0, y1 = extent
    shape = (round((y1 - y0) / CELL_M), round((x1 - x0) / CELL_M))
    seen = np.zeros(shape)
    for body in clouds.values():
        points = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(body))).numpy(('x', 'y', 'z'))
        solid = points[(points[:, 2] > FLOOR_M) & (points[:, 2] < LINTEL_M)]
        seen += np.histogram2d(solid[:, 1], solid[:, 0], bins=shape, range=((y0, y1), (x0, x1)))[0]
    strength = np.log1p(seen)
    return strength / max(np.quantile(strength[strength > 0], 0.95) if (strength > 0).any() else 1.0, 1e-9)
