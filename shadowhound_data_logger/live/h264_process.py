"""Encodes JPEGs from standard input as H.264: a script for the system's Python, which has GStreamer's bindings (python3-gi).

It imports nothing of this package. Each record of its input and output is two uint32 (little-endian) with the lengths of a head
in JSON and of a body, and these. The first head has the encoder under ``encode`` (its ``name``, the part of a pipeline from JPEG
to H.264 to ``launch``, in which it is called ``h264`` and the filter of its input ``size``, and its properties to ``set``), or
under ``find`` a list of such. Later ones have properties to ``set``, ask for a ``key`` frame, or are of a JPEG in the body: when
it came (``at``, ms), its ``width`` and ``height``, and the ``size`` in which it is encoded. It answers with access units (annex
B), of which ``at`` and ``key`` tell the frame; with the name of the first encoder of the list that encodes the JPEG, as
``found``; or with an ``error``. It ends with its input.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import threading
from collections.abc import Callable
from typing import Any, BinaryIO

PIPELINE = (
    'appsrc name=frames is-live=true format=time max-buffers=2 leaky-type=downstream ! {launch}'
    ' ! video/x-h264,stream-format=byte-stream,alignment=au ! appsink name=units emit-signals=true sync=false max-buffers=4'
)
TRIES, TRY_S = 30, 0.1
"""Frames that an encoder may take before the first comes out."""
MOST_TEXT = 300
writing = threading.Lock()


def say(head: dict[str, Any], body: bytes = b'') -> None:
    """A record for the process that feeds this one."""
    text = json.dumps(head).encode()
    with writing:
        sys.stdout.buffer.write(struct.pack('<II', len(text), len(body)) + text + body)
        sys.stdout.buffer.flush()


def read(stream: BinaryIO) -> tuple[dict[str, Any], bytes] | None:
    """The next record; None at the end."""
    lengths = stream.read(8)
    if len(lengths) < 8:
        return None
    head, body = struct.unpack('<II', lengths)
    text, frame = stream.read(head), stream.read(body)
    return (json.loads(text), frame) if len(text) + len(frame) == head + body else None


def choose(elements: list[dict[str, Any]], is_there: Callable[[str], bool],
           problem: Callable[[dict[str, Any]], str]) -> dict[str, str]:  # fmt: skip
    """``found``: the name of the first that is there and of which no problem is known; or the ``error`` of the last."""
    error = ''
    for element in elements:
        error = problem(element) if is_there(element['name']) else f'GStreamer has no {element["name"]}'
        if not error:
            return {'found': element['name']}
    return {'error': error[:MOST_TEXT]}


class H264Pipeline:
    """A pipeline for frames of one size. ``made`` and ``failed`` are called on GStreamer's threads. New; end once."""

    def __init__(self, gi: Any, element: dict[str, Any], size: tuple[int, int], made: Callable[[float, bool, bytes], None],
                 failed: Callable[[str], None]) -> None:  # fmt: skip
        """Raises RuntimeError, of which GLib's errors are."""
        self._gi, self._made, self._failed, self.size = gi, made, failed, size
        self._first_ms: float | None = None
        self._shape: tuple[int, int] | None = None
        self._pipeline = gi.Gst.parse_launch(PIPELINE.format(launch=element['launch']))
        self._frames, self._encoder, sink, scaled = map(self._pipeline.get_by_name, ('frames', 'h264', 'units', 'size'))
        width, height = size
        caps = f'video/x-raw,width={width},height={height},pixel-aspect-ratio=1/1'
        scaled.set_property('caps', gi.Gst.Caps.from_string(caps))
        self.set(element['set'])
        sink.connect('new-sample', self._on_sample)
        self._pipeline.get_bus().set_sync_handler(self._on_message)
        self._pipeline.set_state(gi.Gst.State.PLAYING)

    def set(self, properties: dict[str, str]) -> None:
        """Those that this version of the encoder has."""
        for name, text in properties.items():
            if self._encoder.find_property(name) is not None:
                self._gi.Gst.util_set_object_arg(self._encoder, name, text)

    def ask_key(self) -> None:
        """By NVIDIA's signal where there is one: its encoder knows no event for it."""
        if self._gi.GObject.signal_lookup('force-IDR', self._encoder):
            self._encoder.emit('force-IDR')
        else:
            event = self._gi.GstVideo.video_event_new_upstream_force_key_unit(self._gi.Gst.CLOCK_TIME_NONE, True, 0)
            self._encoder.get_static_pad('src').send_event(event)

    def push(self, at_ms: float, shape: tuple[int, int], jpeg: bytes) -> None:
        gst = self._gi.Gst
        if self._shape != shape:
            self._shape = shape
            caps = f'image/jpeg,width={shape[0]},height={shape[1]},framerate=30/1'
            self._frames.set_property('caps', gst.Caps.from_string(caps))
        if self._first_ms is None:
            self._first_ms = at_ms
        buffer = gst.Buffer.new_wrapped(jpeg)
        buffer.pts = round((at_ms - self._first_ms) * 1e6)
        self._frames.emit('push-buffer', buffer)

    def end(self) -> None:
        self._pipeline.set_state(self._gi.Gst.State.NULL)

    def _on_sample(self, sink: Any) -> Any:
        gst = self._gi.Gst
        sample = sink.emit('pull-sample')
        if sample is None:
            return gst.FlowReturn.EOS
        buffer = sample.get_buffer()
        # Encoders may begin at another time and tell so in the segment.
        after_ns = sample.get_segment().to_running_time(gst.Format.TIME, buffer.pts)
        if self._first_ms is not None and gst.CLOCK_TIME_NONE not in (buffer.pts, after_ns):
            is_key = not buffer.has_flags(gst.BufferFlags.DELTA_UNIT)
            self._made(round(self._first_ms + after_ns / 1e6, 3), is_key, buffer.extract_dup(0, buffer.get_size()))
        return gst.FlowReturn.OK

    def _on_message(self, _: Any, message: Any) -> Any:
        if message.type == self._gi.Gst.MessageType.ERROR:
            error, _ = message.parse_error()
            self._failed(error.message.rstrip('.'))
        return self._gi.Gst.BusSyncReply.DROP


def problem_of(gi: Any, element: dict[str, Any], head: dict[str, Any], jpeg: bytes) -> str:
    """Why this JPEG is not encoded; empty where it is."""
    came = threading.Event()
    problems: list[str] = []
    try:
        encoding = H264Pipeline(gi, element, tuple(head['size']), lambda *_: came.set(), problems.append)
    except RuntimeError as error:
        return str(error)
    for number in range(TRIES):
        encoding.push(33.0 * number, (head['width'], head['height']), jpeg)
        if came.wait(TRY_S) or problems:
            break
    encoding.end()
    return '' if came.is_set() else '; '.join(problems) or f'nothing came of {TRIES} frames'


def encode(gi: Any, element: dict[str, Any]) -> None:
    """Until the input ends."""

    def made(at_ms: float, is_key: bool, unit: bytes) -> None:
        say({'at': at_ms, 'key': is_key}, unit)

    def failed(why: str) -> None:
        say({'error': why[:MOST_TEXT]})
        os._exit(1)

    encoding: H264Pipeline | None = None
    while (record := read(sys.stdin.buffer)) is not None:
        head, jpeg = record
        if 'set' in head:
            element['set'].update(head['set'])
            if encoding is not None:
                encoding.set(head['set'])
        elif 'key' in head:
            if encoding is not None:
                encoding.ask_key()
        else:
            size = tuple(head['size'])
            if encoding is None or encoding.size != size:
                if encoding is not None:
                    encoding.end()
                encoding = H264Pipeline(gi, element, size, made, failed)
            encoding.push(head['at'], (head['width'], head['height']), jpeg)


def main() -> None:
    """Encode, or find an encoder."""
    sys.stdout = os.fdopen(os.dup(1), 'w')  # ours alone: what drivers print, as NVIDIA's do, goes where errors go
    os.dup2(2, 1)
    first = read(sys.stdin.buffer)
    if first is None:
        return
    try:
        import gi  # noqa: PLC0415 - the system's Python has it, or not

        for name in ('Gst', 'GstVideo'):
            gi.require_version(name, '1.0')
        from gi import repository  # noqa: PLC0415
        from gi.repository import GObject, Gst, GstVideo  # noqa: F401, PLC0415 - they become parts of ``repository``
    except (ImportError, ValueError) as error:
        say({'error': f'the system has no GStreamer: {error}'})
        return
    Gst.init(None)
    try:
        if 'encode' in first[0]:
            encode(repository, first[0]['encode'])
        elif (record := read(sys.stdin.buffer)) is not None:
            head, jpeg = record

            def is_there(name: str) -> bool:
                return Gst.ElementFactory.find(name) is not None

            say(choose(first[0]['find'], is_there, lambda element: problem_of(repository, element, head, jpeg)))
    except RuntimeError as error:
        say({'error': str(error)[:MOST_TEXT]})
    os._exit(0)  # whatever drivers still do


if __name__ == '__main__':
    main()
