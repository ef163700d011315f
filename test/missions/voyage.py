"""A mission that is sent to the tracking server of the environment, with this Python's MLflow, and sent again as after a kill.

``python -m missions.voyage FOLDER`` prints the server's data of it as JSON.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from missions.fakes import FakeSpooler, journalling

from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import MissionSent, missions
from shadowhound_data_logger.missions.replay import open_tracking

POINTS = 1200


def fly(home: Path) -> None:
    """Texts that are difficult for some databases, and more points than one batch takes."""
    with journalling(home, frame_artifact_every_s=0.0) as logger:
        logger.start_mission('patrol', 'Küche\0 \N{DOG FACE} ' + 'x' * 7000)
        for number in range(POINTS):
            logger.log_robot_state(90.0 - number / 100, 40.0, number)
        logger.log_metric('big/one', 1.5e300, (1 << 62))
        logger.log_camera_frame(b'\xff\xd8 a picture', 0)
        logger.end_mission(True, 12.5, 60.0)


def send(home: Path) -> Delivery:
    """All of it, twice: the second time as by a sender that was killed before it recorded its progress."""
    (folder,) = missions(home)
    tracking, spooler = open_tracking(home, 'thor_missions'), FakeSpooler()
    for _ in range(2):
        delivery = Delivery(folder, tracking, spooler)  # type: ignore[arg-type]
        while any([delivery.track(), delivery.attach(), delivery.spool()]):
            pass
        folder.set_sent(MissionSent())
    return delivery


def poll(client: Any) -> dict[str, Any]:
    """Artifacts by a direct request: the list of the 3.17 client also requests models, which a server of 2.x does not have."""
    from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

    experiment = client.get_experiment_by_name('thor_missions')
    (run,) = client.search_runs([experiment.experiment_id], "params.mission_type = 'patrol' and attributes.status != 'RUNNING'")
    files = get_artifact_repository(run.info.artifact_uri)
    history = client.get_metric_history(run.info.run_id, 'battery_pct')
    return {
        'status': run.info.status, 'metrics': run.data.metrics, 'steps': [point.step for point in history],
        'params': {name: value for name, value in run.data.params.items() if name != 'timestamp'},
        'artifacts': sorted(item.path for folder in ('', 'camera') for item in files.list_artifacts(folder)),
    }  # fmt: skip


def main(home: str) -> None:
    fly(Path(home))
    delivery = send(Path(home))
    sys.stdout.write(json.dumps(poll(delivery._tracking._client)) + '\n')  # type: ignore[attr-defined]


if __name__ == '__main__':
    main(sys.argv[1])
