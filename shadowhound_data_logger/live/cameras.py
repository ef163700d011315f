"""Cameras as video, for viewers (WebRTC) and players (RTSP) of one page: both use the JPEGs that are shown."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

from shadowhound_data_logger.live.kinds import FULL, LiveItem
from shadowhound_data_logger.live.rtsp import RtspServer

if TYPE_CHECKING:
    from shadowhound_data_logger.live.webrtc import CameraVideo

NO_WEBRTC: Final = 'the robot has no WebRTC: install the extra webrtc of shadowhound_data_logger'


class Cameras:
    """The video of a page. Lifecycle: New; ``open_rtsp`` at most once; close once. Used by one event loop."""

    def __init__(self, changed: Callable[[], None], pool: Executor) -> None:
        """``changed`` is called when the set of topics changes."""
        self._changed, self._pool = changed, pool
        self.video: CameraVideo | None = None
        self.rtsp: RtspServer | None = None
        self.no_video = '' if find_spec('aiortc') and find_spec('av') else NO_WEBRTC
        """Why cameras are sent as JPEG only; empty if WebRTC is available."""

    async def open_rtsp(self, bind: str, port: int, password: str) -> None:
        """Raises RtspUnavailable."""
        self.rtsp = RtspServer(bind, port, password, self._changed)
        await self.rtsp.open()

    async def close(self) -> None:
        for each in (self.video, self.rtsp):
            if each is not None:
                await each.close()

    @property
    def topics(self) -> frozenset[str]:
        """Topics that a viewer or a player takes."""
        return frozenset().union(*(each.topics for each in (self.video, self.rtsp) if each is not None))

    def serve(self, topics: Iterable[str]) -> None:
        """Offer these topics over RTSP."""
        if self.rtsp is not None:
            self.rtsp.serve(topics)

    def offer(self, item: LiveItem) -> None:
        """A message that is shown; only complete frames of cameras are used."""
        if item.kind == 'camera' and item.size == FULL:
            for each in (self.video, self.rtsp):
                if each is not None:
                    each.offer(item)

    async def take(self, who: object, request: Mapping[str, Any], addresses: tuple[str, str],
                   tell: Callable[[Mapping[str, Any]], None]) -> None:  # fmt: skip
        """A viewer requests a topic as video; arguments as in ``CameraVideo.take``."""
        if not self.no_video and self.video is None:
            loading = asyncio.get_running_loop().run_in_executor(self._pool, import_module, 'shadowhound_data_logger.live.webrtc')
            try:
                webrtc = await loading
            except ImportError as error:
                self.no_video = f'{NO_WEBRTC} ({error})'
            else:
                if self.video is None:  # another viewer may have requested it at the same time
                    self.video = webrtc.CameraVideo(self._changed)
        if self.video is None:
            tell({'problem': self.no_video})
        else:
            await self.video.take(who, request, addresses, tell)

    def end(self, who: object) -> None:
        """A viewer stops its video."""
        if self.video is not None:
            self.video.end(who)

    def has(self, who: object) -> bool:
        """Whether a viewer takes video and is connected."""
        return self.video is not None and self.video.has(who)
