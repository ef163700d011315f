"""All checks, in the order of the guide's checklist: from the shell to the store.

As a program, ``python -m shadowhound_data_logger.doctor.checks NAME``, it is the process of one check: context on standard input,
results on standard output.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Final

from shadowhound_data_logger.doctor import (
    clock,
    disk,
    environment,
    missions,
    mlflow,
    network,
    policies,
    ros,
    ros_environment,
    s3,
    seaweedfs,
    secrets,
    sockets,
    spool,
    versions,
)
from shadowhound_data_logger.doctor.context import from_child
from shadowhound_data_logger.doctor.model import ROBOT, SERVER, Check

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
    Check(name='tower', run=network.check_tower, roles=SERVER),
    Check(name='ros.environment', run=ros_environment.check, roles=ROBOT),
    Check(name='ros', run=ros.check, roles=ROBOT, deadline_s=11.5, isolated=True),
    Check(name='sockets', run=sockets.check, roles=ROBOT),
    Check(name='disk', run=disk.check, roles=ROBOT, deadline_s=8.0, isolated=True),
    Check(name='spool', run=spool.check, roles=ROBOT, deadline_s=6.0, after=('s3',)),
    Check(name='missions', run=missions.check, roles=ROBOT),
    Check(name='policies', run=policies.check, roles=ROBOT),
)


def main() -> None:
    """Print one line of JSON per result. Output of libraries is redirected to standard error."""
    answers = os.fdopen(os.dup(1), 'w', encoding='utf-8')
    os.dup2(2, 1)
    context = from_child(sys.stdin.buffer.read())
    check = next(check for check in CHECKS if check.name == sys.argv[1])
    for result in check.run(context):
        answers.write(json.dumps(result.as_dict()) + '\n')
        answers.flush()


if __name__ == '__main__':
    main()
