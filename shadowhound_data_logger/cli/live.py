"""``shadowhound-data live``: serves the page that shows the robot, its data and what is missing."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import click

from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    only_robot,
    robot_name,
    spool_folder,
    the_home,
    the_spool,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import print_json
from shadowhound_data_logger.core import heap
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.spool.local_robot import local_robots

if TYPE_CHECKING:
    from shadowhound_data_logger.live.server import LiveServer, LiveSettings

PORT = 8765
RTSP_PORT = 8554
LOOK_S = 2.0
"""How often it is checked whose page this is: a node may run here for the first time."""


@click.command(
    epilog=examples(
        'live', 'live --bind 0.0.0.0', 'live --bind 0.0.0.0 --tls tower.crt tower.key',
        'live --rtsp 8554', 'live --alert-url https://ntfy.sh/TOPIC',
        'live --robot thor --robot-url http://thor:8765/ --robot-token thor.token',
    )
)  # fmt: skip
@click.option('--bind', default='127.0.0.1', show_default=True, metavar='ADDRESS', help='Address to listen on.')
@click.option(
    '--port', type=click.IntRange(0, 65535), default=PORT, show_default=True, help='Port to listen on; 0 takes a free one.'
)
@click.option(
    '--tls',
    nargs=2,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar='CERTIFICATE KEY',
    help='Serve https with these files.',
)
@click.option(
    '--hostname', 'names', multiple=True, metavar='HOST', help='Another name of this machine in addresses; may be repeated.'
)
@click.option('--uploads-mbps', type=click.FloatRange(0.0, 10_000.0), default=4.0, show_default=True,
              help='Limit uploads to N Mbit/s while a viewer watches over the network; 0: no limit.')  # fmt: skip
@click.option('--rtsp', type=click.IntRange(0, 65535), is_flag=False, flag_value=RTSP_PORT, metavar='[PORT]',
              help=f'Serve the cameras over RTSP too, at port {RTSP_PORT} or another; 0 takes a free one.')  # fmt: skip
@click.option('--tiles', default='', metavar='URL',
              help='Show places on map tiles from here, such as https://tile.example/{z}/{x}/{y}.png.')  # fmt: skip
@click.option('--alert-url', metavar='URL', envvar='SHADOWHOUND_ALERT_URL',
              help='Send alerts to this webhook or ntfy topic. A URL with a token belongs in the variable '
                   'SHADOWHOUND_ALERT_URL.')  # fmt: skip
@click.option('--alert-silent', type=click.FloatRange(0.1, 1000.0), default=1.0, show_default=True, metavar='HOURS',
              help='Alert if nothing from a robot arrives for longer.')  # fmt: skip
@click.option('--alert-lost', type=click.IntRange(0), default=1000, show_default=True, metavar='MESSAGES',
              help='Alert if more messages of a robot are missing on one day.')  # fmt: skip
@click.option('--new-tokens', is_flag=True, help='Make new tokens: all viewers must sign in again.')
@click.option('--robot-url', metavar='URL', help="Relay the live view from this robot's own page.")
@click.option('--robot-token', type=click.Path(path_type=Path, dir_okay=False), metavar='FILE',
              help="File with a viewer's token for --robot-url.")  # fmt: skip
@click.option('--robot', metavar='NAME', envvar='SHADOWHOUND_ROBOT', callback=robot_name,
              help='The robot  [default: the one that ran here]')  # fmt: skip
@spool_folder
@as_json
def live(*, bind: str, port: int, tls: tuple[Path, Path] | None, names: tuple[str, ...],  # noqa: PLR0913 - one an option
         uploads_mbps: float, rtsp: int | None, tiles: str, alert_url: str | None, alert_silent: float, alert_lost: int,
         new_tokens: bool, robot_url: str | None, robot_token: Path | None, robot: str | None, spool: Path | None,
         as_json: bool) -> ExitCode:  # fmt: skip
    """Serve a web page that shows the robot and its data.

    It shows in a browser what the robot sees now, its data, what is missing, and what was recorded at any earlier moment. On
    a machine without a spool it is the page of the store: the past of every robot that has a folder there. That changes when a
    node starts on this machine.

    Ctrl-C stops it. On 127.0.0.1 every user of this machine can watch; other addresses require a token. Actions (bags,
    events, flush, pause) always require the operator's token. The tokens are files in SHADOWHOUND_HOME/live.
    """
    try:
        from shadowhound_data_logger.live.access import RTSP_FILE, make_tokens  # noqa: PLC0415 - loaded by this verb alone
        from shadowhound_data_logger.live.alerts import AlertSettings  # noqa: PLC0415 - aiohttp
        from shadowhound_data_logger.live.rtsp import USER  # noqa: PLC0415 - the same
        from shadowhound_data_logger.live.server import LiveSettings  # noqa: PLC0415 - aiohttp
    except ImportError as error:
        raise BadUsage(f'the live page needs aiohttp: {error}', 'install requirements/robot.txt') from error
    folder = the_spool(spool)
    tokens = the_home() / 'live'
    paths = make_tokens(tokens, replace=new_tokens)
    check_urls(folder, robot_url, rtsp, tiles, alert_url)
    given = LiveSettings(
        spool=folder, robot=robot or '', tokens=tokens, bind=bind, port=port, names=names, certificate=tls or None, rtsp=rtsp,
        uploads_mbps=uploads_mbps, robot_url=robot_url or '', robot_token=robot_token, tiles=tiles,
        alerts=AlertSettings(url=alert_url, silent_s=3600 * alert_silent, lost=alert_lost) if alert_url else None,
    )  # fmt: skip
    is_robot = spool is not None or rtsp is not None
    settings = as_it_is(given, is_robot=is_robot)
    logging.basicConfig(level=logging.INFO, format='%(message)s')
    heap.keep_free_blocks()

    def announce(server: LiveServer) -> None:
        if as_json:
            print_json({'url': server.url, 'pid': os.getpid(), 'tokens': {role: str(path) for role, path in paths.items()},
                        'rtsp': server.rtsp_url, 'problem': server.viewers.ros_problem})  # fmt: skip
            return
        click.echo(f"{server.url}\nthe operator's token is in {paths['operator']}, a viewer's in {paths['viewer']}")
        if server.rtsp_url:
            click.echo(f'{server.rtsp_url}/TOPIC: user {USER}, password in {tokens / RTSP_FILE}')
        if server.viewers.ros_problem:
            click.echo(server.viewers.ros_problem, err=True)

    asyncio.run(serve(settings, lambda: as_it_is(given, is_robot=is_robot), announce))
    return ExitCode.FINE


def as_it_is(given: LiveSettings, *, is_robot: bool) -> LiveSettings:
    """The settings for what is there now: where no node has run, those of the page of a store, unless ``is_robot``.

    Raises BadUsage.
    """
    has_run, store = given.spool.is_dir(), the_store_settings()
    has_store = bool(store.endpoint_url) or store.directory.is_dir()
    is_of_store = bool(given.robot_url) or (has_store and not is_robot and not has_run)
    waits = ''
    if not has_run and not given.robot_url and find_spec('rclpy') is not None:
        waits = f'No node has run on this machine yet: {given.spool} does not exist. '
        waits += (
            'Until one starts, this page shows the store.' if is_of_store else 'The page shows its data as soon as one starts.'
        )
    robot = given.robot or only_robot([] if is_of_store else local_robots(os.environ, given.spool))
    return replace(given, robot=robot, is_of_store=is_of_store, waits=waits)


async def serve(settings: LiveSettings, poll: Callable[[], LiveSettings], announce: Callable[[LiveServer], None]) -> None:
    """Serve until a signal; another page at the same port when what ``poll`` finds is not what is served any more."""
    from shadowhound_data_logger.live.server import LiveServer  # noqa: PLC0415 - aiohttp

    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    is_first = True
    served: LiveSettings | None = settings
    while served is not None:
        server = LiveServer(served)
        try:
            await server.open()
            if is_first:
                announce(server)
            is_first = False
            served = await changed(replace(served, port=settings.port), poll, stop)
        finally:
            await server.close()
        if served is not None:
            logging.getLogger(__name__).info('this is the page of %s now', 'the store' if served.is_of_store else served.robot)
            served = replace(served, port=server.port)


async def changed(served: LiveSettings, poll: Callable[[], LiveSettings], stop: asyncio.Event) -> LiveSettings | None:
    """The settings once they differ, because a node has started here or its spool is gone; None at the end."""
    while True:
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(stop.wait(), LOOK_S)
            return None
        with suppress(DataLoggerError, BadUsage):  # it cannot be decided now
            if (found := poll()) != served:
                return found


def check_urls(folder: Path, robot_url: str | None, rtsp: int | None, tiles: str, alert_url: str | None) -> None:
    """Raises BadUsage."""
    if alert_url and (urlsplit(alert_url).scheme not in ('http', 'https') or not urlsplit(alert_url).hostname):
        raise BadUsage('--alert-url is not a URL such as https://ntfy.sh/TOPIC')  # it may contain a token
    if robot_url is not None:
        if rtsp is not None:
            raise BadUsage(
                'a page with --robot-url is that of a store, which has no cameras', 'give --rtsp to the page of the robot'
            )
        if folder.is_dir():
            raise BadUsage(f'{folder} is a spool: this is the robot itself', 'omit --robot-url')
        parts = urlsplit(robot_url)
        if parts.scheme not in ('http', 'https') or not parts.hostname or '@' in parts.netloc:
            raise BadUsage(f'--robot-url {robot_url[:100]!r} is not a URL such as http://thor.local:8765/')
    if tiles:
        parts = urlsplit(tiles)
        is_url = parts.scheme in ('http', 'https') and re.fullmatch(r'[A-Za-z0-9.:\[\]-]+', parts.netloc)
        if not is_url or not all(f'{{{name}}}' in tiles for name in 'zxy'):
            raise BadUsage(f'--tiles {tiles[:100]!r} is not a URL such as https://tile.example/{{z}}/{{x}}/{{y}}.png')
