"""All checks, in the order in which a person would ask: the guide's checklist, from the shell to the store."""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.doctor import (
    clock,
    disk,
    environment,
    missions,
    mlflow,
    network,
    ros,
    ros_environment,
    s3,
    seaweedfs,
    secrets,
    sockets,
    spool,
    tower,
    versions,
)
from shadowhound_data_logger.doctor.model import THOR, TOWER, Check

CHECKS: Final = (
    Check(name='versions', run=versions.check),
    Check(name='environment', run=environment.check),
    Check(name='secrets', run=secrets.check),
    Check(name='clock', run=clock.check),
    Check(name='network.s3', run=network.check_s3, deadline_s=5.0),
    Check(name='network.mlflow', run=network.check_mlflow, deadline_s=5.0),
    Check(name='s3', run=s3.check, deadline_s=8.0, after=('network.s3',)),
    Check(name='seaweedfs', run=seaweedfs.check, after=('network.s3',)),
    Check(name='mlflow', run=mlflow.check, deadline_s=8.0, after=('network.mlflow',)),
    Check(name='tower', run=tower.check, roles=TOWER),
    Check(name='ros.environment', run=ros_environment.check, roles=THOR),
    Check(name='ros', run=ros.check, roles=THOR, deadline_s=11.5, apart=True),
    Check(name='sockets', run=sockets.check, roles=THOR),
    Check(name='disk', run=disk.check, roles=THOR, deadline_s=8.0, apart=True),
    Check(name='spool', run=spool.check, roles=THOR, deadline_s=6.0, after=('s3',)),
    Check(name='missions', run=missions.check, roles=THOR),
)
