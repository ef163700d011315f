"""Serves JPEGs from standard input over RTSP: a script for the system's Python, which has GStreamer's bindings (python3-gi).

It imports nothing of this package. Each record of its input is two uint32 (little-endian) with the lengths of a head in JSON and
of a body, and these. The first head has ``address``, ``port``, ``user``, ``password``, and an encoder under ``h264`` as
``h264_process.py`` has it, or null: JPEGs are sent as they are. Later ones name ``topics`` that are served, and which of these
are sent as JPEG (``jpegs``); or a ``topic`` with ``width`` and ``height`` of the JPEG in the body, and the ``size`` in
which it is encoded. What it says are lines of JSON: ``port``, ``watched`` (topics that clients play) and which of these they get
as JPEG (``jpegs``), ``players`` (the addresses of these clients), a topic of which the encoder has ``failed`` and ``why``, or
``error``. It ends with its input.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import threading
from typing import Any, BinaryIO

FRAMES = 'appsrc name=frames is-live=true format=time do-timestamp=true max-buffers=2 leaky-type=downstream'
AS_JPEG = f'( {FRAMES} ! rtpjpegpay name=pay0 pt=26 )'
AS_H264 = f'( {FRAMES} ! {{launch}} ! rtph264pay name=pay0 pt=96 )'
AF41 = 34
"""DSCP of interactive video (RFC 4594)."""
MOST_SESSIONS = 16
TRIES = 30
"""Frames of which an encoder makes something before it has failed."""
CLEAN_S = 5
ROLE = 'viewer'
writing = threading.Lock()


def say(**what: Any) -> None:
    """A line for the process that feeds this one."""
    with writing:
        sys.stdout.write(json.dumps(what) + '\n')
        sys.stdout.flush()


def read(stream: BinaryIO) -> tuple[dict[str, Any], bytes] | None:
    """The next record; None at the end."""
    lengths = stream.read(8)
    if len(lengths) < 8:
        return None
    head, body = struct.unpack('<II', lengths)
    text, frame = stream.read(head), stream.read(body)
    return (json.loads(text), frame) if len(text) + len(frame) == head + body else None


class Cameras:
    """The server and its pipelines: one a topic, shared by all who play it. The lock guards the sources."""

    def __init__(self, rtsp: Any, gst: Any, digest: Any, given: dict[str, Any]) -> None:
        self._rtsp, self._gst = rtsp, gst
        self._lock = threading.Lock()
        self._sources: dict[str, Any] = {}
        self._caps: dict[str, tuple[Any, ...]] = {}
        self._fed: dict[str, int] = {}
        """By topic of which nothing came yet that could be described to a player: how many frames the encoder was given."""
        self._h264: dict[str, Any] | None = given['h264']
        self._factories: dict[str, Any] = {}
        self._players: dict[Any, str] = {}
        self.server = rtsp.RTSPServer()
        self.server.set_address(given['address'])
        self.server.set_service(str(given['port']))
        self.server.get_session_pool().set_max_sessions(MOST_SESSIONS)
        auth, token = rtsp.RTSPAuth(), rtsp.RTSPToken()
        token.set_string('media.factory.role', ROLE)
        auth.set_supported_methods(digest)
        auth.add_digest(given['user'], given['password'], token)
        self.server.set_auth(auth)
        self.server.connect('client-connected', self._meet)

    def mount(self, topics: list[str], jpegs: list[str]) -> None:
        """Serve these; others that were served before stay. Whoever plays one already goes on as he does."""
        for topic in topics:
            factory = self._factories.get(topic) or self._mount(topic)
            encoder = None if topic in jpegs else self._h264
            factory.set_launch(AS_JPEG if encoder is None else AS_H264.format(launch=encoder['launch']))

    def _mount(self, topic: str) -> Any:
        factory = self._factories[topic] = self._rtsp.RTSPMediaFactory()
        factory.set_shared(True)
        factory.set_dscp_qos(AF41)
        permissions = self._rtsp.RTSPPermissions()
        for right in ('media.factory.access', 'media.factory.construct'):
            permissions.add_permission_for_role(ROLE, right, True)
        factory.set_permissions(permissions)
        factory.connect('media-configure', self._begin, topic)
        self.server.get_mount_points().add_factory(topic, factory)
        return factory

    def push(self, head: dict[str, Any], jpeg: bytes) -> None:
        topic, width, height = head['topic'], head['width'], head['height']
        size: Any = head.get('size')
        with self._lock:
            source, scaled = self._sources.get(topic, (None, None))
            if source is None or (scaled is not None and size is None):  # the latter was sent to a player who has left
                return
            if self._caps.get(topic) != (width, height, size):
                self._caps[topic] = width, height, size
                caps = f'image/jpeg,width={width},height={height}'
                if scaled is None:
                    caps += ',framerate=0/1'
                else:
                    caps += ',framerate=30/1'
                    scaled.set_property('caps', self._gst.Caps.from_string(
                        f'video/x-raw,width={size[0]},height={size[1]},pixel-aspect-ratio=1/1'))  # fmt: skip
                source.set_property('caps', self._gst.Caps.from_string(caps))
            if topic in self._fed:
                self._fed[topic] += 1
            source.emit('push-buffer', self._gst.Buffer.new_wrapped(jpeg))

    def _meet(self, _: Any, client: Any) -> None:
        client.connect('play-request', self._play)
        for end in ('pause-request', 'teardown-request', 'closed'):
            client.connect(end, self._stop)

    def _play(self, client: Any, _: Any) -> None:
        self._follow(client, client.get_connection().get_ip())

    def _stop(self, client: Any, *_: Any) -> None:
        self._follow(client, '')

    def _follow(self, client: Any, address: str) -> None:
        """Say from where clients play; without an address it plays no more."""
        with self._lock:
            self._players.pop(client, None)
            if address:
                self._players[client] = address
            say(players=sorted({*self._players.values()}))

    def _begin(self, _: Any, media: Any, topic: str) -> None:
        pipeline = media.get_element()
        frames, scaled = pipeline.get_by_name('frames'), pipeline.get_by_name('size')
        if self._h264 is not None and scaled is not None:
            encoder = pipeline.get_by_name('h264')
            for name, text in self._h264['set'].items():
                if encoder.find_property(name) is not None:  # as other versions have it
                    self._gst.util_set_object_arg(encoder, name, text)
            pipeline.get_parent().get_bus().set_sync_handler(self._on_message, topic)
        with self._lock:
            self._sources[topic] = frames, scaled
            self._caps.pop(topic, None)
            self._fed[topic] = 0
            media.connect('prepared', self._on_prepared, topic)
            media.connect('unprepared', self._end, topic, frames)
            self._tell()

    def _on_prepared(self, _: Any, topic: str) -> None:
        with self._lock:
            self._fed.pop(topic, None)

    def _on_message(self, _: Any, message: Any, topic: str) -> Any:
        if message.type == self._gst.MessageType.ERROR:
            error, _ = message.parse_error()
            say(failed=topic, why=error.message.rstrip('.'))
        return self._gst.BusSyncReply.PASS

    def _end(self, _: Any, topic: str, frames: Any) -> None:
        with self._lock:
            own, scaled = self._sources.get(topic, (None, None))
            if own is frames:  # and not those of one that has taken its place
                del self._sources[topic]
                if self._fed.pop(topic, 0) >= TRIES and scaled is not None:
                    say(failed=topic, why=f'nothing came of {TRIES} frames')
            self._tell()

    def _tell(self) -> None:
        jpegs = [topic for topic, (_, scaled) in self._sources.items() if scaled is None]
        say(watched=sorted(self._sources), jpegs=sorted(jpegs))


def main() -> None:
    """Until the input ends."""
    sys.stdout = os.fdopen(os.dup(1), 'w')  # ours alone: what drivers print, as NVIDIA's do, goes where errors go
    os.dup2(2, 1)
    first = read(sys.stdin.buffer)
    if first is None:
        return
    try:
        import gi  # noqa: PLC0415 - the system's Python has it, or not

        for name in ('Gst', 'GstRtsp', 'GstRtspServer'):
            gi.require_version(name, '1.0')
        from gi.repository import GLib, Gst, GstRtsp, GstRtspServer  # noqa: PLC0415
    except (ImportError, ValueError) as error:
        say(error=f'the system has no RTSP server: {error}')
        return
    Gst.init(None)
    needs = ('appsrc', 'rtpjpegpay') if first[0]['h264'] is None else ('rtph264pay',)
    lacks = [name for name in needs if Gst.ElementFactory.find(name) is None]
    if lacks:
        say(error=f'GStreamer has no {" and no ".join(lacks)}')
        return
    cameras = Cameras(GstRtspServer, Gst, GstRtsp.RTSPAuthMethod.DIGEST, first[0])
    if not cameras.server.attach(None):
        say(error=f'nobody can listen at {first[0]["address"]} port {first[0]["port"]}', remedy='name a free port: --rtsp PORT')
        return
    loop = GLib.MainLoop()

    def follow() -> None:
        while (record := read(sys.stdin.buffer)) is not None:
            head, jpeg = record
            if 'topics' in head:
                GLib.idle_add(cameras.mount, head['topics'], head['jpegs'])
            else:
                cameras.push(head, jpeg)
        GLib.idle_add(loop.quit)

    def forget() -> bool:
        """Sessions of players that went without a word; until this returns False."""
        cameras.server.get_session_pool().cleanup()
        return True

    GLib.timeout_add_seconds(CLEAN_S, forget)
    say(port=cameras.server.get_bound_port())
    threading.Thread(target=follow, daemon=True).start()
    loop.run()


if __name__ == '__main__':
    main()
