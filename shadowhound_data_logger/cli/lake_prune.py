"""``shadowhound-data lake prune``: delete old objects from the store."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import click
from rich.console import RenderableType

from shadowhound_data_logger.cli.common import (
    ExitCode,
    Size,
    as_json,
    examples,
    exit_code,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.export_datasets import all_datasets
from shadowhound_data_logger.cli.output import (
    number,
    plain,
    plain_table,
    print_json,
    print_page,
    volume,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import asking, quietly, report_skipped
from shadowhound_data_logger.core.clock import SystemClock

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.prune import PrunePlan

from shadowhound_data_logger.cli.lake import THREADS, only_robot


@click.command(
    'prune',
    epilog=examples(
        'lake prune --keep "camera 90d, lidar 14d, events forever" --dry-run',
        'lake prune --keep "camera 90d, lidar 14d, bags 30d" --max-bytes 2TB',
    ),
)
@click.option('--keep', 'rules', required=True, metavar='RULES', help='Sensors, and how long to keep each: "camera 90d, ..."')
@click.option('--max-bytes', 'most', type=Size(), metavar='SIZE',
              help='Keep at most SIZE, such as 2TB.')  # fmt: skip
@only_robot
@click.option('--dry-run', is_flag=True, help='Only show what would be done.')
@click.option('--force', is_flag=True, help='Also delete what datasets, labels and open requests refer to.')
@click.option('--yes', is_flag=True, help='Do not ask for confirmation.')
@as_json
def lake_prune(
    *, rules: str, most: int | None, robot: str | None, dry_run: bool, force: bool, yes: bool, as_json: bool
) -> ExitCode:
    """Delete old objects from the store.

    Objects are deleted by sensor and age; `bags`, `events` and `missions` count as sensors and are deleted as a whole.
    Objects that no rule names are kept, and so is what a dataset, a label or an open request (`pull`) refers to. With
    --max-bytes, the oldest days of the named sensors are deleted too, until no more is left. The catalog keeps the rows and
    marks them as forgotten.

    It asks for confirmation before it deletes all objects of a sensor or, with --force, referenced objects; without a
    terminal it then deletes nothing. Exit code 1 if it deleted nothing for that reason, or if more than --max-bytes is left.
    """
    with asking():
        now_ns = SystemClock.of_this_machine().wall_ns()
        from shadowhound_data_logger.lake import prune as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.names import check_name_of  # noqa: PLC0415
        from shadowhound_data_logger.lake.row_files import robots  # noqa: PLC0415

        keep = library.keep_rules(rules, now_ns)
        how: dict[str, Any] = {'robot': robot, 'max_bytes': most, 'is_forced': force}
    source, left_out = default_source(the_store_settings()), quietly()
    with progress('looking at what there is') as bar:
        made = library.plan(source, keep, exported=_exported(bar.say), findings=left_out, tell=bar.say, **how)
    with asking():
        check_name_of('robot', robot or '', robots(source) if robot else ())
        for rule in keep:
            check_name_of('sensor', rule.sensor, made.known_sensors())
    if not as_json:
        print_page(*_planned(made, dry_run=dry_run))
    if dry_run or not (made.going or made.unfinished):
        if as_json:
            print_json(_prune_report(made))
        return exit_code(finding=made.over_bytes or report_skipped(left_out))
    if (reasons := list(_reasons(made))) and not yes:
        for reason in reasons:
            click.echo(reason, err=True)
        if not (sys.stdin.isatty() and click.confirm('Delete it?', err=True)):
            click.echo('Nothing is deleted. --yes deletes it without asking.', err=True)
            return ExitCode.FINDING
        made = library.plan(
            source, keep, exported=_exported(), findings=quietly(), **how
        )  # an object may have been labeled since
    with the_store(THREADS) as target, progress() as bar:
        done = library.apply(source, target, made, now_ns=now_ns, findings=left_out, tell=bar.say)
    if as_json:
        print_json({**_prune_report(made), 'deleted': done.objects, 'deleted_bytes': done.bytes, 'resumed': done.resumed})
    else:
        click.echo(f'{number(done.objects)} objects ({volume(done.bytes)}) are deleted.')
        if done.resumed:
            click.echo(f'So are {number(done.resumed)} that an earlier run did not come to.')
    return exit_code(finding=made.over_bytes or report_skipped(left_out))


def _exported(say: Callable[[str], None] = lambda _: None) -> dict[tuple[str, str], str]:
    """(bucket, key) -> a dataset that has values of it."""
    from shadowhound_data_logger.datasets import verify  # noqa: PLC0415
    from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415

    found: dict[tuple[str, str], str] = {}
    folders, stored = all_datasets()
    for folder in folders:
        say(str(folder))
        found |= dict.fromkeys(verify.sources_in_folder(folder), str(folder))
    for place in stored:
        say(str(place))
        found |= dict.fromkeys(verify.sources_in_store(Bucket(the_store_settings(), place.bucket), place), str(place))
    return found


def _prune_report(made: PrunePlan) -> dict[str, Any]:
    sensors = [{'sensor': each.sensor, 'rule': each.rule, 'objects': each.objects, 'bytes': each.bytes, 'going': each.going,
                'going_bytes': each.going_bytes, 'protected': dict(each.protected), 'referrers': sorted(each.referrers)}
               for each in made.sensors.values()]  # fmt: skip
    return {'sensors': sensors, 'going': made.going, 'going_bytes': made.going_bytes, 'over_bytes': made.over_bytes,
            'unfinished': made.unfinished}  # fmt: skip


def _planned(made: PrunePlan, *, dry_run: bool) -> Iterator[RenderableType]:
    table = plain_table('', ('sensor', 'keep', 'objects', 'size', 'to delete', 'size', 'protected', 'by'),
                        ('sensor', 'keep', 'by'))  # fmt: skip
    table.title = None
    for each in sorted(made.sensors.values(), key=lambda each: each.sensor):
        by = ', '.join(sorted(each.referrers)[:3]) + (', ...' if len(each.referrers) > 3 else '')
        keep = each.rule.removeprefix(each.sensor).strip() or 'no rule'
        table.add_row(plain(each.sensor), plain(keep), number(each.objects), volume(each.bytes), number(each.going),
                      volume(each.going_bytes), number(sum(each.protected.values())), plain(by))  # fmt: skip
    yield table
    for each in made.sensors.values():
        if not each.objects:
            yield plain(f'There are no objects of {each.sensor}.', 'yellow')
    will = 'would be' if dry_run else 'will be'
    if made.going or not made.unfinished:
        yield plain(f'{number(made.going)} objects ({volume(made.going_bytes)}) {will} deleted.' if made.going
                    else 'There is nothing to delete.')  # fmt: skip
    if made.unfinished:
        yield plain(f'What an earlier run had begun to delete and did not come to {will} deleted, too.', 'yellow')
    if made.over_bytes:
        yield plain(f'{volume(made.over_bytes)} more than --max-bytes stays: no rule lets it go.', 'yellow')


def _reasons(made: PrunePlan) -> Iterator[str]:
    """Why to ask first, with what would go."""
    for each in made.sensors.values():
        if each.is_all:
            yield f'This deletes all {number(each.objects)} objects of {each.sensor} ({volume(each.bytes)}).'
        if made.is_forced and each.protected:
            kinds = ', '.join(f'{number(count)} by a {why}' for why, count in each.protected.items())
            by = ', '.join(sorted(each.referrers))
            yield f'This deletes objects of {each.sensor} that are referred to: {kinds}. By: {by}.'
