"""``report.png``: one row per episode of a dataset: some frames, the path, and when each stream was stale."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from PIL import Image, ImageDraw

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.datasets.lerobot import OURS, EpisodeRow, Lerobot
from shadowhound_data_logger.missions.contact_sheet import INK, evenly_spaced

if TYPE_CHECKING:
    from numpy.typing import NDArray

WIDTH: Final = 1200
HEIGHT: Final = 150
"""Per episode."""
GAP: Final = 8
FRAMES: Final = 5
MOST: Final = 60
"""Maximum number of episodes, evenly spaced."""
PALE, RED, GREEN = '#9aa7b3', '#d62828', '#4c9f70'


def draw(made: Lerobot, target: Path) -> None:
    """Draw a dataset that has at least one episode. Raises LakeError, OSError."""
    rows = evenly_spaced(made.rows, MOST)
    sheet = Image.new('RGB', (WIDTH, len(rows) * (HEIGHT + GAP) + GAP), 'white')
    for index, row in enumerate(rows):
        _episode(made, row, sheet, GAP + index * (HEIGHT + GAP))
    with io.BytesIO() as body:
        sheet.save(body, 'PNG')
        target.write_bytes(body.getvalue())


def _episode(made: Lerobot, row: EpisodeRow, sheet: Image.Image, top: int) -> None:
    pen = ImageDraw.Draw(sheet)
    name = f'{row["episode_index"]}  {row[f"{OURS}mission_id"]}  {utc(row[f"{OURS}first_tick_ns"]):%Y-%m-%d %H:%M:%S}'
    title = f'{name}  {row["tasks"][0]}  {row["length"]} frames  {row[f"{OURS}split"]}'
    pen.text((GAP, top), title[:150].encode('latin-1', 'replace').decode('latin-1'), fill=INK)
    wanted = sorted({round(share * (row['length'] - 1)) for share in np.linspace(0, 1, FRAMES)})
    left, height = GAP, HEIGHT - 50
    for key in made.image_keys()[:1]:
        for pixels in made.images_at(row, key, wanted):
            picture = Image.fromarray(pixels)
            picture = picture.resize((max(1, min(170, round(picture.width * height / picture.height))), height))
            sheet.paste(picture, (left, top + 16))
            left += picture.width + GAP
    state, stale = (made.numbers(row, key) for key in ('observation.state', 'shadowhound.stale'))
    assert made.info is not None
    names = made.info['features']['observation.state']['names']
    if 'pose.x' in names:
        path = state[:, [names.index('pose.x'), names.index('pose.y')]]
        _path(pen, path, np.asarray(stale.any(axis=1)), (WIDTH - 220, top + 16, WIDTH - GAP, top + HEIGHT - 34))
    _bars(pen, stale, row['length'] / made.info['fps'], top + HEIGHT - 30)


def _path(pen: ImageDraw.ImageDraw, path: NDArray[Any], stale: NDArray[np.bool_], box: tuple[int, int, int, int]) -> None:
    low = path.min(axis=0)
    scale = min((box[2] - box[0]) / max(np.ptp(path[:, 0]), 0.5), (box[3] - box[1]) / max(np.ptp(path[:, 1]), 0.5))
    points = [(box[0] + float(x) * scale, box[3] - float(y) * scale) for x, y in path - low]
    if len(points) > 1:
        pen.line(points, fill=GREEN, width=2)
    for x, y in (point for point, is_stale in zip(points, stale, strict=True) if is_stale):
        pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill=RED)


def _bars(pen: ImageDraw.ImageDraw, stale: NDArray[Any], seconds: float, top: int) -> None:
    """A timeline of each stream, stale ticks in red."""
    count, streams = stale.shape
    width, each = WIDTH - 2 * GAP, max(2, 22 // streams)
    for stream in range(streams):
        y = top + stream * each
        pen.rectangle((GAP, y, GAP + width, y + each - 2), fill=PALE)
        for tick in np.flatnonzero(stale[:, stream]):
            left = GAP + width * int(tick) / count
            pen.rectangle((left, y, max(left + 1, left + width / count), y + each - 2), fill=RED)
    pen.text((WIDTH - 60, top - 14), f'{seconds:.0f} s', fill=INK)
