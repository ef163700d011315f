"""A viewer of the live page without a browser: ``watcher.py URL TOKEN`` prints the cap of uploads with every status."""

from __future__ import annotations

import asyncio
import sys

import aiohttp
from e2e.live_frames import Frames


async def main(url: str, token: str) -> None:
    """Until it is killed."""
    headers, jar = {'Origin': url.rstrip('/')}, aiohttp.CookieJar(unsafe=True)  # an address works as well as a name
    async with aiohttp.ClientSession(headers=headers, cookie_jar=jar, raise_for_status=True) as session:
        await session.post(f'{url}api/session', json={'token': token})
        async with session.ws_connect(f'{url}ws') as ws:
            frames = Frames()
            async for message in ws:
                for head, _ in frames.take(message.data):
                    if head['kind'] == 'figures':
                        sys.stdout.write(f'{head["figures"]["store"]["max_mbps"]}\n')
                        sys.stdout.flush()
                        await ws.send_json({'ping': 1})
                if (report := frames.acknowledgement()) is not None:
                    await ws.send_bytes(report)


if __name__ == '__main__':
    asyncio.run(main(*sys.argv[1:]))
