"""``camera_summary.jpg``: a contact sheet of a mission's frames, 800 pixels wide, each with its id and time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from PIL import Image, ImageDraw, ImageFont

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.untrusted import open_image

WIDTH: Final = 800
MAX_FRAMES: Final = 20
"""Frames on a sheet: four columns, five rows."""
GAP: Final = 8
CAPTION: Final = 22
HEAD: Final = 34
LINE: Final = 20
QUALITY: Final = 88
INK: Final = '#22303c'
PALE: Final = '#6b7884'
_Item = TypeVar('_Item')


class LoggedFrame(NamedTuple):
    """A frame of a mission, or of a query of the lake."""

    time_ns: int
    number: int
    path: Path


class _Thumb(NamedTuple):
    frame: LoggedFrame
    image: Image.Image


def contact_sheet(frames: Sequence[LoggedFrame], title: str, start_ns: int, target: Path, *, below: str = '') -> str:
    """Write the JPEG, with the line ``below`` under its title; returns a note: '' or how many frames are not images.

    Raises ValueError if there is no image.
    """
    if not frames:
        raise ValueError('no camera frame was sampled')
    chosen = evenly_spaced(frames, MAX_FRAMES)
    columns = _columns(len(chosen))
    width = (WIDTH - GAP) // columns - GAP
    thumbs, broken = _thumbs(chosen, width)
    if not thumbs:
        raise ValueError(f'none of {len(chosen)} frames is an image')
    height = max(thumb.image.height for thumb in thumbs)
    step_x, step_y = width + GAP, height + CAPTION + GAP
    rows = -(-len(thumbs) // columns)
    top = HEAD + (LINE if below else 0)
    sheet = Image.new('RGB', (WIDTH, top + rows * step_y), 'white')
    pen = ImageDraw.Draw(sheet)
    pen.text((GAP, 9), title, fill=INK, font=_font(15))
    pen.text((GAP, HEAD - 4), below, fill=PALE, font=_font(12))
    count_text = (
        f'{len(thumbs)} of {len(frames)} frames' if len(thumbs) < len(frames) else f'{len(thumbs)} frame{"s"[: len(thumbs) > 1]}'
    )
    pen.text((WIDTH - GAP - pen.textlength(count_text, font=_font(12)), 12), count_text, fill=PALE, font=_font(12))
    for index, thumb in enumerate(thumbs):
        x, y = GAP + index % columns * step_x, top + index // columns * step_y
        sheet.paste(thumb.image, (x, y))
        _caption(pen, (x, y + thumb.image.height + 3), width, thumb.frame, start_ns)
    sheet.save(target, 'JPEG', quality=QUALITY, optimize=True)
    return f'{broken} of {len(chosen)} frames are not images' if broken else ''


def evenly_spaced(items: Sequence[_Item], limit: int) -> list[_Item]:
    """At most ``limit`` items, evenly spaced, including the first and the last."""
    count = min(limit, len(items))
    return [items[round(index * (len(items) - 1) / max(1, count - 1))] for index in range(count)]


def _columns(count: int) -> int:
    """As few columns as fill the sheet."""
    return {1: 1, 2: 2, 4: 2}.get(count, 3 if count <= 9 else 4)


def _thumbs(frames: Sequence[LoggedFrame], width: int) -> tuple[list[_Thumb], int]:
    """The frames scaled to this width, and how many of them could not be read."""
    thumbs: list[_Thumb] = []
    for frame in frames:
        try:
            with open_image(frame.path) as image:
                image.draft('RGB', (width, width))  # libjpeg scales while it decodes
                height = min(2 * width, max(1, round(image.height * width / image.width)))
                thumbs.append(_Thumb(frame, image.convert('RGB').resize((width, height), Image.Resampling.LANCZOS)))
        except (OSError, ValueError, SyntaxError):  # what Pillow raises for a broken file
            continue
    return thumbs, len(frames) - len(thumbs)


def _caption(pen: ImageDraw.ImageDraw, place: tuple[int, int], width: int, frame: LoggedFrame, start_ns: int) -> None:
    """The id on the left; on the right the time (UTC, followed by the time since the start if it fits)."""
    font = _font(12)
    seconds = max(0, frame.time_ns - start_ns) // SECOND
    time = f'{utc(frame.time_ns):%H:%M:%S}'
    long = f'{time}   +{seconds // 60}:{seconds % 60:02d}'
    name = f'frame {frame.number}'
    room = width - pen.textlength(name, font=font) - 2 * GAP
    label = long if pen.textlength(long, font=font) <= room else time
    pen.text(place, name, fill=INK, font=font)
    pen.text((place[0] + width - pen.textlength(label, font=font), place[1]), label, fill=PALE, font=font)


def _font(size: int) -> Any:
    try:
        return ImageFont.load_default(size)
    except TypeError:  # Pillow before 10.1 has one size
        return ImageFont.load_default()
