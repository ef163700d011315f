"""``shadowhound-data bag``: recordings, wherever they are. The verbs stand in bag_*.py."""

from __future__ import annotations

import click

from shadowhound_data_logger.cli.bag_send import record, upload, watch
from shadowhound_data_logger.cli.bag_show import info, list_, verify
from shadowhound_data_logger.cli.bag_take import cut, fetch


@click.group()
def bag() -> None:
    """Recordings in rosbag2's format: find, look at, check, download, cut out, send and record them.

    BAG is the name of a bag of the store, as `bag list` tells it. The store is the S3 server that AWS_ENDPOINT_URL names, else
    the folder SHADOWHOUND_HOME/store. A bag in a folder is named by a path with a slash in it: ./patrol_20251018_120000
    """


for verb in (list_, info, verify, fetch, cut, upload, watch, record):
    bag.add_command(verb)
