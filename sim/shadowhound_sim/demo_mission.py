"""The demo's patrol as a mission: the agent that logs it, in a separate process, and the result.

The agent reports no distance, so that the node's measurement is used (docs/missions.md). Run as a program, this is the agent.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from base64 import b64encode
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import Request, urlopen

from rich.console import Console

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.missions.folder import missions
from shadowhound_sim.demo_processes import READY_S, STOP_S, Child, DemoFailed

COMMAND: Final = 'go through all six rooms and come back to the dock'
SEND_S: Final = 120.0
"""Time for the run to receive everything: its images take some seconds, longer on a busy machine."""
PLOT: Final = 'trajectory.png'


def start(folder: Path, environ: Mapping[str, str]) -> Child:
    """The agent, once its mission has started. Raises DemoFailed if it does not start."""
    agent = Child(__name__, (), environ, folder / 'agent.log')
    end_s = time.monotonic() + READY_S
    while not any(missions(folder / 'home')):
        if not agent.is_running or time.monotonic() > end_s:
            agent.stop(0.0)
            raise agent.failed('did not start a mission')
        time.sleep(0.1)
    return agent


def end(agent: Child, console: Console) -> str:
    """End the mission; returns the id of its run and prints what has not arrived by then. Raises DemoFailed without a run."""
    agent.stop(SEND_S + STOP_S)
    agent.check()
    found = json.loads(agent.output.splitlines()[-1])
    if not found['run_id']:
        raise DemoFailed(f'the mission has no run: {found["last_error"] or found["waiting_for"]}')
    if not found['complete']:
        reason = '; '.join(filter(None, (found['last_error'], found['remedy'])))
        console.print(f'[yellow]After {SEND_S:g} s the mission still waits for {found["waiting_for"]}[/] ({reason})')
    return str(found['run_id'])


def pictures(tracking: Mapping[str, str], run_id: str, path: Path, console: Console) -> list[Path]:
    """The path on the floor plan, an artifact of the run, as a file; if it is missing the reason is printed."""
    try:
        return [plot(tracking, run_id, path)]
    except DemoFailed as error:
        console.print(f'[yellow]{error}[/]')
        return []


def plot(tracking: Mapping[str, str], run_id: str, path: Path) -> Path:
    """The path on the floor plan, an artifact of the run, as a file. ``tracking`` are MLflow's variables. Raises DemoFailed."""
    url = f'{tracking["MLFLOW_TRACKING_URI"]}/get-artifact?{urlencode({"path": PLOT, "run_uuid": run_id})}'
    login = f'{tracking["MLFLOW_TRACKING_USERNAME"]}:{tracking["MLFLOW_TRACKING_PASSWORD"]}'
    headers = {'Authorization': 'Basic ' + b64encode(login.encode()).decode()}
    try:
        with urlopen(Request(url, headers=headers), timeout=READY_S) as answer:  # noqa: S310 - our own server on 127.0.0.1
            path.write_bytes(answer.read())
    except (URLError, TimeoutError) as error:
        raise DemoFailed(f'the run {run_id} has no {PLOT}: {error}') from error
    return path


def summary(bodies: Mapping[str, bytes], run_id: str) -> dict[str, Any] | None:
    """The mission's summary.json as read from the S3 server; None if it has not arrived."""
    for key, body in bodies.items():
        if key.endswith(f'/missions/{run_id}/summary.json'):
            found: dict[str, Any] = json.loads(body)
            return found
    return None


def main() -> int:
    """Log a mission until SIGINT; prints its result."""
    stop = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    with closing(MissionDataLogger()) as logger:
        began_s = time.monotonic()
        logger.start_mission('patrol', COMMAND)
        stop.wait()
        logger.end_mission(success=True, distance_m=0.0, duration_s=time.monotonic() - began_s)
        found = logger.flush(SEND_S)
    print(json.dumps(asdict(found)), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
