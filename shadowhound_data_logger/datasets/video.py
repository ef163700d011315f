"""Encodes images to mp4 and decodes them, with PyAV: LeRobot's settings, and the same bytes on every machine.

SVT-AV1 output does not depend on the number of threads; x264's does, so it has one. A frame's time is exactly its number divided
by the frames per second: the stream's time base is that or a fraction of it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Final

import av
import numpy as np

from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.features import AV1, H264

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

PIXELS: Final = 'yuv420p'
CODECS: Final = {
    AV1: ('libsvtav1', {'g': '2', 'crf': '30', 'preset': '12'}),
    H264: ('libx264', {'g': '2', 'crf': '23', 'preset': 'fast', 'threads': '1', 'bf': '0'}),
}
"""lerobot 0.6.1, configs/video.py: a key frame every second frame, so that a random one is decoded quickly."""
_NAMES: Final = {AV1: 'av1', H264: 'h264'}
BLOCK: Final = 8
"""Block size of the comparison, pixels."""


class VideoWriter:
    """Writes frames of one size. Enter once; a file that an error leaves behind is incomplete."""

    def __init__(self, path: Path, fps: int, size: tuple[int, int], codec: str) -> None:
        """``size`` is (height, width), both even. Raises LakeError otherwise."""
        if size[0] % 2 or size[1] % 2:
            raise LakeError(
                f'images of {size[1]} x {size[0]} cannot be {PIXELS} video',
                remedy='export them with lossless: true in the file of --config',
            )
        self._path, self._fps, self._size = path, fps, size
        self._encoder, self._options = CODECS[codec]
        self._count = 0
        self._file: Any = None
        self._stream: Any = None

    def __enter__(self) -> Self:
        os.environ.setdefault('SVT_LOG', '1')  # only errors
        self._file = av.open(str(self._path), 'w', format='mp4')
        self._stream = self._file.add_stream(self._encoder, rate=self._fps, options=dict(self._options))
        self._stream.height, self._stream.width = self._size
        self._stream.pix_fmt = PIXELS
        self._stream.codec_context.time_base = Fraction(1, self._fps)
        with _same_scheduling():
            self._stream.codec_context.open(strict=False)
        return self

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """``pixels`` is (height, width, 3) RGB."""
        frame = av.VideoFrame.from_ndarray(pixels, format='rgb24')
        frame.pts, frame.time_base = self._count, Fraction(1, self._fps)
        self._count += 1
        self._file.mux(self._stream.encode(frame))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self._file.mux(self._stream.encode(None))
        self._file.close()


@contextmanager
def _same_scheduling() -> Iterator[None]:
    """Threads started within it keep the caller's scheduling.

    SVT-AV1, run as root, gives its threads and its caller SCHED_FIFO at 99 (seen with PyAV 18.1): all other programs would wait.
    """
    if sys.platform != 'linux':
        yield
        return
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    yield
    for thread in Path('/proc/self/task').iterdir():
        with suppress(ProcessLookupError):
            if os.sched_getscheduler(int(thread.name)) == os.SCHED_FIFO != before:
                os.sched_setscheduler(int(thread.name), before, parameters)


@dataclass(frozen=True, slots=True)
class Clip:
    """A range of frames in one of our videos: of an episode, whose first frame is a key frame."""

    path: Path
    first: int
    frames: int


def frames_of(clip: Clip, fps: int) -> Iterator[NDArray[np.uint8]]:
    """The RGB pixels of each frame. Raises LakeError for an unreadable video."""
    try:
        with av.open(str(clip.path)) as file:
            stream = file.streams.video[0]
            first = round(clip.first / (fps * stream.time_base))
            if clip.first:
                file.seek(first, stream=stream)
            found = (frame for frame in file.decode(stream) if frame.pts >= first)
            yield from (frame.to_ndarray(format='rgb24') for frame in islice(found, clip.frames))
    except (av.error.FFmpegError, IndexError, OSError) as error:
        raise LakeError(f'{clip.path} is not a readable video: {error}') from error


def count_frames(path: Path) -> int:
    """From the file's index. Raises LakeError for an unreadable video."""
    try:
        with av.open(str(path)) as file:
            return int(file.streams.video[0].frames)
    except (av.error.FFmpegError, IndexError, OSError) as error:
        raise LakeError(f'{path} is not a readable video: {error}') from error


def join(clips: Sequence[Clip], fps: int, target: IO[bytes]) -> None:
    """Concatenate all clips without re-encoding; the same clips give the same bytes. Raises LakeError."""
    stream, extradata, count = None, None, 0
    try:
        with av.open(target, 'w', format='mp4', options={'write_btrt': '0'}) as out:  # a bit rate that depends on the sources
            for clip in clips:
                with av.open(str(clip.path)) as file:
                    source = file.streams.video[0]
                    if stream is None:
                        extradata = source.codec_context.extradata
                        stream = out.add_stream_from_template(source, opaque=True)
                        stream.time_base = Fraction(1, fps)
                    elif source.codec_context.extradata != extradata:
                        raise LakeError(f'{clip.path} was encoded by another version or in another way than the videos before it',
                                        remedy='export to another folder')  # fmt: skip
                    for packet in _packets(file, clip, fps):
                        packet.stream, packet.time_base = stream, Fraction(1, fps)
                        packet.pts = packet.dts = count
                        packet.duration = 1
                        out.mux(packet)
                        count += 1
    except (av.error.FFmpegError, IndexError) as error:
        raise LakeError(f'videos cannot be joined: {error}', remedy='export verify names the file that is damaged') from error
    if count != (wanted := sum(clip.frames for clip in clips)):
        raise LakeError(f'the videos have {count} of {wanted} frames', remedy='export verify names the file')


def _packets(file: Any, clip: Clip, fps: int) -> Iterator[Any]:
    stream = file.streams.video[0]
    if clip.first:
        file.seek(round(clip.first / (fps * stream.time_base)), stream=stream)
    for packet in file.demux(stream):
        if packet.pts is None:
            return  # the end
        number = round(packet.pts * stream.time_base * fps)
        if number >= clip.first + clip.frames:
            return
        if number >= clip.first:
            yield packet


def frames_at(path: Path, fps: int, numbers: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """RGB pixels of these frames, counted from 0; decodes only those and their reference frames. Raises LakeError."""
    try:
        with av.open(str(path)) as file:
            stream = file.streams.video[0]
            for number in numbers:
                pts = round(number / (fps * stream.time_base))
                file.seek(pts, stream=stream)
                yield next(frame for frame in file.decode(stream) if frame.pts >= pts).to_ndarray(format='rgb24')
    except (av.error.FFmpegError, IndexError, StopIteration, OSError) as error:
        raise LakeError(f'{path} is not a video that has the frames {", ".join(map(str, numbers))}: {error}') from error


def feature_info(codec: str, fps: int, size: tuple[int, int]) -> dict[str, Any]:
    """What lerobot writes about a video to ``info.json`` (video_utils.get_video_info)."""
    _, options = CODECS[codec]
    return {
        'video.height': size[0], 'video.width': size[1], 'video.codec': _NAMES[codec], 'video.pix_fmt': PIXELS, 'video.fps': fps,
        'video.channels': 3, 'has_audio': False, 'video.g': int(options['g']), 'video.crf': int(options['crf']),
        'video.preset': int(options['preset']) if options['preset'].isdigit() else options['preset'], 'is_depth_map': False,
    }  # fmt: skip


def ssim(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """The mean structural similarity of two images' luminance in blocks of 8 x 8, 1 for equal ones.

    Wang, Bovik, Sheikh, Simoncelli: Image quality assessment, IEEE TIP 13 (2004), with uniform weights.
    """
    first, second = (_blocks(each) for each in (one, other))
    means = first.mean(axis=-1), second.mean(axis=-1)
    variances = first.var(axis=-1), second.var(axis=-1)
    shared = ((first - means[0][..., None]) * (second - means[1][..., None])).mean(axis=-1)
    small, large = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    above = (2 * means[0] * means[1] + small) * (2 * shared + large)
    below = (means[0] ** 2 + means[1] ** 2 + small) * (variances[0] + variances[1] + large)
    return float((above / below).mean())


def _blocks(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    gray = pixels.astype(np.float64) @ np.array([0.299, 0.587, 0.114])
    height, width = (side - side % BLOCK for side in gray.shape)
    cut = gray[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    return np.asarray(cut.transpose(0, 2, 1, 3).reshape(height // BLOCK, width // BLOCK, BLOCK * BLOCK))
