"""Serves JPEGs from standard input over RTSP: a script for the system's Python, which has GStreamer's bindings (python3-gi).

It imports nothing from this package. Each record of its input is two uint32 (little-endian) with the lengths of a head in JSON
and of a body, and these. The first head has ``address``, ``port``, ``user`` and ``password``. Later ones have the served
``topics``, or a ``topic`` with ``width`` and ``height`` of the JPEG in the body. It prints lines of JSON: ``port``, ``watched``
(topics that clients play), ``players`` (the addresses of these clients), or ``error``. It exits at the end of its input.
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
AF41 = 34
"""DSCP of interactive video (RFC 4594)."""
MAX_SESSIONS = 16
CLEAN_S = 5
ROLE = 'viewer'
writing = threading.Lock()


def report(**what: Any) -> None:
    """Print a line for the parent process."""
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
    """The server and its pipelines: one per topic, shared by all clients. The lock guards the sources."""

    def __init__(self, rtsp: Any, gst: Any, digest: Any, given: dict[str, Any]) -> None:
        self._rtsp, self._gst = rtsp, gst
        self._lock = threading.Lock()
        self._sources: dict[str, Any] = {}
        self._caps: dict[str, tuple[int, int]] = {}
        self._mounted: set[str] = set()
        self._players: dict[Any, str] = {}
        self.server = rtsp.RTSPServer()
        self.server.set_address(given['address'])
        self.server.set_service(str(given['port']))
        self.server.get_session_pool().set_max_sessions(MAX_SESSIONS)
        auth, token = rtsp.RTSPAuth(), rtsp.RTSPToken()
        token.set_string('media.factory.role', ROLE)
        auth.set_supported_methods(digest)
        auth.add_digest(given['user'], given['password'], token)
        self.server.set_auth(auth)
        self.server.connect('client-connected', self._meet)

    def mount(self, topics: list[str]) -> None:
        """Serve these topics; earlier ones stay."""
        for topic in topics:
            if topic not in self._mounted:
                self._mounted.add(topic)
                self._mount(topic)

    def _mount(self, topic: str) -> None:
        factory = self._rtsp.RTSPMediaFactory()
        factory.set_shared(True)
        factory.set_dscp_qos(AF41)
        factory.set_launch(AS_JPEG)
        permissions = self._rtsp.RTSPPermissions()
        for right in ('media.factory.access', 'media.factory.construct'):
            permissions.add_permission_for_role(ROLE, right, True)
        factory.set_permissions(permissions)
        factory.connect('media-configure', self._begin, topic)
        self.server.get_mount_points().add_factory(topic, factory)

    def push(self, head: dict[str, Any], jpeg: bytes) -> None:
        topic, size = head['topic'], (head['width'], head['height'])
        with self._lock:
            source = self._sources.get(topic)
            if source is None:
                return
            if self._caps.get(topic) != size:
                self._caps[topic] = size
                caps = f'image/jpeg,width={size[0]},height={size[1]},framerate=0/1'
                source.set_property('caps', self._gst.Caps.from_string(caps))
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
        """Report the addresses of clients that play; empty: it stopped."""
        with self._lock:
            self._players.pop(client, None)
            if address:
                self._players[client] = address
            report(players=sorted({*self._players.values()}))

    def _begin(self, _: Any, media: Any, topic: str) -> None:
        frames = media.get_element().get_by_name('frames')
        with self._lock:
            self._sources[topic] = frames
            self._caps.pop(topic, None)
            media.connect('unprepared', self._end, topic, frames)
            self._report()

    def _end(self, _: Any, topic: str, frames: Any) -> None:
        with self._lock:
            if self._sources.get(topic) is frames:  # and not the source that has replaced it
                del self._sources[topic]
            self._report()

    def _report(self) -> None:
        report(watched=sorted(self._sources))


def main() -> None:
    """Until the input ends."""
    sys.stdout = os.fdopen(os.dup(1), 'w')  # stdout is for our protocol; prints of drivers go to stderr
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
        report(error=f'the system has no RTSP server: {error}')
        return
    Gst.init(None)
    lacks = [name for name in ('appsrc', 'rtpjpegpay') if Gst.ElementFactory.find(name) is None]
    if lacks:
        report(error=f'GStreamer has no {" and no ".join(lacks)}')
        return
    cameras = Cameras(GstRtspServer, Gst, GstRtsp.RTSPAuthMethod.DIGEST, first[0])
    if not cameras.server.attach(None):
        report(error=f'cannot listen at {first[0]["address"]} port {first[0]["port"]}', remedy='name a free port: --rtsp PORT')
        return
    loop = GLib.MainLoop()

    def follow() -> None:
        while (record := read(sys.stdin.buffer)) is not None:
            head, jpeg = record
            if 'topics' in head:
                GLib.idle_add(cameras.mount, head['topics'])
            else:
                cameras.push(head, jpeg)
        GLib.idle_add(loop.quit)

    def forget() -> bool:
        """Remove sessions of players that disappeared; until this returns False."""
        cameras.server.get_session_pool().cleanup()
        return True

    GLib.timeout_add_seconds(CLEAN_S, forget)
    report(port=cameras.server.get_bound_port())
    threading.Thread(target=follow, daemon=True).start()
    loop.run()


if __name__ == '__main__':
    main()
