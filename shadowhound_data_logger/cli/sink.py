"""``shadowhound-data lake sink``: sends the catalog, gaps, missions and labels to Elasticsearch or OpenSearch."""

from __future__ import annotations

import os
import time
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Final

import click

from shadowhound_data_logger.cli.common import ExitCode, as_json, examples, exit_code, robot_name, the_home, the_store_settings
from shadowhound_data_logger.cli.output import counted, number, plain, print_json, print_lines
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import asking, quietly, report_skipped
from shadowhound_data_logger.core.errors import StoreUnavailable

SHOWN: Final = 10


@click.command('sink', epilog=examples(
    'lake sink http://127.0.0.1:9200', 'lake sink https://elastic.lan:9200 --prefix robots --follow'
))  # fmt: skip
@click.argument('url')
@click.option('--prefix', default='robots', show_default=True, metavar='NAME',
              help='Prefix of the indexes: NAME-objects, NAME-gaps, NAME-missions, NAME-events and NAME-labels.')  # fmt: skip
@click.option('--robot', metavar='NAME', callback=robot_name, help='Only of this robot.')
@click.option('--ca', type=click.Path(exists=True, dir_okay=False, path_type=Path), metavar='FILE',
              help="Certificate of the authority that signed the server's.")  # fmt: skip
@click.option('--follow', is_flag=True, help='Continue until Ctrl-C, with what is new.')
@click.option('--interval', type=click.FloatRange(1.0), default=60.0, show_default=True, metavar='S',
              help='Seconds between two rounds.')  # fmt: skip
@as_json
def lake_sink(
    *, url: str, prefix: str, robot: str | None, ca: Path | None, follow: bool, interval: float, as_json: bool
) -> ExitCode:
    """Send the catalog to Elasticsearch or OpenSearch.

    It sends catalog rows, gaps, missions, their events, and labels. $SHADOWHOUND_HOME/sink records what the server has
    accepted, so an interrupted run resumes there, and no document is created twice. ELASTIC_API_KEY, or
    ELASTIC_USERNAME and ELASTIC_PASSWORD, authenticate.

    Exit code 1 if the server rejected documents, or something was skipped.
    """
    with asking():
        from shadowhound_data_logger.lake import sink as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

    source, left_out, total = default_source(the_store_settings()), quietly(), library.SinkTally()
    with (
        closing(library.SearchServer(url, library.authorization(os.environ), ca)) as server,
        library.opened(server, prefix, the_home()) as position,
        progress(f'sending to {prefix}') as bar,
    ):
        sink = library.Sink(
            source, server, prefix, position, left_out, tries=float('inf') if follow else library.TRIES, tell=bar.say
        )
        while True:
            try:
                total += sink.send(robot)
                bar.say(f'{number(total.added)} sent; waiting for more')
            except StoreUnavailable as error:
                if not follow:
                    raise
                bar.say(f'{error.what}; trying again')
            if not follow:
                break
            time.sleep(interval)
    if as_json:
        print_json(
            {'url': server.url, 'prefix': prefix, 'position': str(position.path), **asdict(total), 'refused': dict(total.refused)}
        )
    else:
        print_lines(f'{counted(total.added, "document")} sent; {number(total.present)} were already there.')
        for one in total.restarted:
            print_lines(f'{one} is not the index of the last run: all was sent again.')
        for reason, count in total.refused.most_common(SHOWN):
            print_lines(plain(f'{number(count)} refused: {reason}'))
        if total.refused:
            print_lines(f'{position.path} lists them, in the table refused.')
    return report_skipped(left_out) or exit_code(finding=total.refused)
