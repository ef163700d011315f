"""``make demo``: a simulated Go2, the real node and a private Tower for a minute, and a check that nothing was lost.

Exit codes: 0 everything is accounted for and identical in the S3 server, 1 it is not, or something failed or the node logged an
error, 2 usage error.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from rich.console import Console
from shadowhound_tower.embedded import Tower
from shadowhound_tower.mlflow_access import READER

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.stores import open_store
from shadowhound_sim import demo_audit, demo_mission, demo_processes, demo_report, demo_run
from shadowhound_sim.so_arm import NAMESPACE

MARKER: Final = '.shadowhound-demo'
"""Marks a folder that the demo created and may replace."""
MIN_S: Final = 5.0
AT_THE_DOCK_S: Final = 3.0
"""The robot keeps publishing for this long after its mission, so that gaps are known up to its end (docs/datasets.md)."""
NO_PROXY: Final = ('NO_PROXY', 'no_proxy')


class FolderRefused(DataLoggerError):
    """The folder cannot be used for a demo."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    options = _parser().parse_args(arguments)
    if not (options.duration >= MIN_S and 0 <= options.outage <= options.duration / 2):
        print(f'demo: --duration is {MIN_S:g} s or more, --outage at most half of it', file=sys.stderr)
        return 2
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # ignored, as nohup requests
            signal.signal(number, signal.default_int_handler)
    console = Console(highlight=False)
    try:
        with fresh_folder(options.folder) as folder:
            return run(
                folder, options.duration, options.outage, console, mlflow=options.mlflow, keeps=options.keep, arm=options.arm
            )
    except KeyboardInterrupt:
        console.print('\ndemo: stopped. The data so far is in the folder.')
        return 130
    except FolderRefused as error:
        print(f'demo: {error}', file=sys.stderr)
        return 2
    except DataLoggerError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1


def run(folder: Path, duration_s: float, outage_s: float, console: Console, *, mlflow: bool = True,
        keeps: bool = False, arm: bool = False) -> int:  # fmt: skip
    """Run everything, from an empty folder to the verdict; with ``keeps`` the page and the Tower stay until Ctrl-C."""
    console.print(f'[bold]A simulated Go2 on patrol for {duration_s:g} s, its data logger, and a server.')
    console.print(f'Everything runs on this machine, in {folder}/\n')
    if importlib.util.find_spec('go2_interfaces') is None:
        console.print('[yellow]go2_interfaces is not installed[/] (make setup builds it where there is a g++):')
        console.print('/imu, /go2_states and /lowstate are skipped.\n')
    console.print('Starting the server: S3 and MLflow (about ten seconds) ...')
    for name in NO_PROXY:
        os.environ[name] = ','.join(filter(None, (os.environ.get(name), '127.0.0.1')))
    with ExitStack() as stack:
        tower = stack.enter_context(Tower(folder / 'tower', mlflow=mlflow))
        console.print(f'  S3 server  {tower.endpoint_url}')
        if mlflow:
            console.print(f'  MLflow     {tower.tracking_uri}')
        record, run_id, page, address = _patrol(folder, tower, duration_s, outage_s, console, with_mission=mlflow, with_arm=arm,
                                                stack=stack)  # fmt: skip
        drawn = demo_mission.pictures(tower.tracking(READER), run_id, folder / 'mission.png', console) if run_id else []
        console.print('\nReading everything back from the S3 server ...\n')
        store = open_store(tower.store_settings(), UploadSettings())
        try:
            audit = demo_audit.audit(folder / 'home' / 'spool', demo_processes.ROBOT, record.published, store)
        finally:
            store.close()
        from shadowhound_sim import demo_pictures  # noqa: PLC0415 - matplotlib takes a second to load

        drawn += demo_pictures.live_page(address, folder / 'live.jpg')
        code = _report(folder, audit, record, run_id, drawn, console, address if keeps else '')
        if keeps:
            with suppress(KeyboardInterrupt):
                page.wait()
    return code


def _report(folder: Path, audit: demo_audit.DemoAudit, record: demo_run.Record, run_id: str, drawn: list[Path],
          console: Console, page: str) -> int:  # fmt: skip
    """Print the result; returns the exit code."""
    (folder / 'ledger.json').write_text(json.dumps(audit.ledger, indent=2), encoding='utf-8')
    demo_report.show_result(audit, record, console)
    if run_id and (summary := demo_mission.summary(audit.bodies, run_id)) is not None:
        demo_report.show_mission(summary, console)
    from shadowhound_sim import demo_pictures  # noqa: PLC0415

    pictures = demo_pictures.draw(folder, audit.bodies, record)
    demo_report.show_where(folder, [*pictures, *drawn], os.environ, console, page)
    return 1 if audit.problems or record.errors else 0


def _patrol(folder: Path, tower: Tower, duration_s: float, outage_s: float, console: Console, *,  # noqa: PLR0913 - as asked for
            with_mission: bool, with_arm: bool, stack: ExitStack
            ) -> tuple[demo_run.Record, str, demo_processes.Child, str]:  # fmt: skip
    """The minute itself, the id of its mission's run if any, and the live page, which the stack stops; other processes have
    exited.
    """
    environ = demo_processes.environment(folder / 'home', tower.environment(), demo_processes.free_domain())
    console.print(f'Starting the node and the robot (ROS_DOMAIN_ID={environ["ROS_DOMAIN_ID"]}, this machine only) ...')
    with (
        demo_processes.start_logger(folder, environ, arm=NAMESPACE if with_arm else '') as node,
        demo_run.StoreOutage(tower, (duration_s - outage_s) / 2, outage_s) as outage,
    ):
        page, address = demo_processes.start_page(folder, environ)
        stack.enter_context(page)
        console.print(f'Watch it live, while it walks: {address}')
        if outage_s:
            console.print(f'In the middle the S3 server is unreachable for {outage_s:g} s.\n')
        with ExitStack() as agents:
            if with_arm:
                module = 'shadowhound_sim.so_arm'
                agents.enter_context(demo_processes.Child(module, (), environ, folder / 'so_arm.log'))
            if with_mission:
                agent = agents.enter_context(demo_mission.start(folder, environ))
            with demo_report.progress(console, duration_s) as show:

                def poll(reading: demo_run.SpoolReading) -> None:
                    show(reading)
                    if with_mission and reading.t > duration_s - AT_THE_DOCK_S:
                        agent.ask_to_stop()

                record = demo_run.patrol(folder, node, outage, environ, duration_s, poll)
            run_id = demo_mission.end(agent, console) if with_mission else ''
        began = time.monotonic()
        node.stop(demo_processes.STOP_S)
        node.check()
        console.print(f'The robot has stopped. On SIGINT the node exited in {time.monotonic() - began:.1f} s.')
    return replace(record, errors=tuple(node.errors())), run_id, page, address


@contextmanager
def fresh_folder(folder: Path) -> Iterator[Path]:
    """An empty folder for this demo; the data of an earlier demo is deleted. Raises FolderRefused."""
    marker = folder / MARKER
    if folder.exists() and not marker.is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise FolderRefused(f'{folder} exists and was not created by a demo', remedy='name another one with --folder')
    folder.mkdir(parents=True, exist_ok=True)
    with flock(marker, wait=False) as is_mine:
        if not is_mine:
            raise FolderRefused(f'another demo is running in {folder}', remedy='name another one with --folder')
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path != marker:
                path.unlink()
        yield folder


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='python -m shadowhound_sim.demo', description=__doc__.partition('\n')[0])
    parser.add_argument('--duration', type=float, default=60.0, metavar='S', help='seconds the robot walks (default 60)')
    parser.add_argument(
        '--outage', type=float, default=10.0, metavar='S', help='seconds without the S3 server (default 10; 0: none)'
    )
    parser.add_argument('--folder', type=Path, default=Path('demo'), help='folder of the demo (default demo)')
    parser.add_argument('--keep', action='store_true', help='keep the live page and the server running afterwards, until Ctrl-C')
    parser.add_argument('--arm', action='store_true', help='with a simulated SO-ARM100, its clock 37 ms ahead (docs/datasets.md)')
    parser.add_argument('--no-mlflow', dest='mlflow', action='store_false', help='the S3 server only, which starts sooner')
    return parser


if __name__ == '__main__':
    sys.exit(main())
