"""``shadowhound-data lake verify`` and ``lake coverage``: what the store still has, and which hours are complete."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.cli.audit import finding_lines, findings
from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    store_hint,
    the_home,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import (
    duration,
    number,
    plain,
    plain_table,
    print_json,
    print_page,
    shown_by,
)
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import asking, by_option, question, quietly, report_skipped
from shadowhound_data_logger.core.clock import SECOND, SystemClock, utc
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.shipping.audit import Audit, AuditProgress, audit
from shadowhound_data_logger.stores import open_reader
from shadowhound_data_logger.stores.verify import KINDS

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.gaps import Coverage
    from shadowhound_data_logger.lake.verify import Rows

from shadowhound_data_logger.cli.lake import THREADS, only_robot

UNLISTED: Final = 'unlisted'
DAY_NS: Final = 24 * 3600 * SECOND
MAX_COVERED_NS: Final = 400 * DAY_NS
WORDS: Final = {**KINDS, UNLISTED: "not in the store's own catalog; `lake reindex` adds those that are there"}


@click.command('verify', epilog=examples('lake verify --since 7d', 'lake verify --robot thor --deep'))
@question
@click.option('--catalog', type=click.Path(exists=True, file_okay=False, path_type=Path), metavar='DIR',
              help='Catalog of another store, downloaded by `fetch ROBOT/_catalog/ --to DIR`.')  # fmt: skip
@click.option('--deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@click.option('--again', is_flag=True, help='Verify from the start, even if a run was interrupted.')
@as_json
def lake_verify(*, flags: Mapping[str, Any], catalog: Path | None, deep: bool, again: bool, as_json: bool) -> ExitCode:
    """Check that the store has what the catalog says.

    It checks the size and checksum of every object.

    It checks all objects, or those that the flags select. If data was moved to another store, name the catalog of the old
    store too: only it shows what was lost together with its rows. A run that was interrupted resumes where it stopped if it
    is started with the same flags within a week. Exit code 1 if an object does not match the catalog, or if none was
    selected.
    """
    if catalog and 'success' in flags:
        raise BadUsage('a catalog does not say which missions failed', 'omit --failed and --succeeded, or --catalog')
    with asking():
        from shadowhound_data_logger.lake import selecting  # noqa: PLC0415 - the extra lake
        from shadowhound_data_logger.lake import verify as library  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.names import check_names  # noqa: PLC0415

        store = the_store_settings()
        begun_s = time.monotonic()
        left_out = quietly()
        own = library.rows(default_source(store), left_out, **flags)
        theirs = library.rows(selecting.fetched(catalog), left_out, **flags) if catalog else own
        if not len(theirs) and catalog:
            raise BadUsage(f'there are no rows in {catalog}', f'shadowhound-data fetch ROBOT/_catalog/ --to {catalog}')
        if not len(own) and not catalog:
            check_names(default_source(store), left_out, **flags)
        rows, lacking = (theirs.joined(own), theirs.lacking(own)) if catalog else (own, [])
    with closing(open_reader(store)) as target:
        where = target.describe()
        asked = json.dumps([where, deep, catalog and str(catalog.resolve()), flags], sort_keys=True)
        with (AuditProgress(the_home() / 'verify', asked, again=again) as earlier,
              progress('read back' if deep else 'checked', len(rows), of='objects') as bar):  # fmt: skip
            found = audit(rows.pages(), earlier, target, deep=deep, threads=THREADS, keys=None, tell=bar.have)
    report = {'store': where, 'catalog': catalog and str(catalog), **_report(rows, found, lacking, deep=deep)}
    report['took_s'] = round(time.monotonic() - begun_s, 3)
    report['left_out'] = [asdict(one) for one in left_out]
    report['ok'] = report['ok'] and not report['left_out']
    if as_json:
        print_json(report)
    else:
        print_page(*_page(report))
        report_skipped(left_out)
    return exit_code(finding=not report['ok'])


@click.command(
    'coverage',
    epilog=examples(
        'lake coverage --since yesterday',
        'lake coverage --topic /imu --chart imu.png',
        'lake coverage --since 7d --wifi wifi.png',
    ),
)
@only_robot
@click.option('--topic', metavar='NAME', help='Only of this topic.')
@click.option('--sink', type=click.Choice(['objects', 'bags', 'events']), default='objects', show_default=True,
              help='Messages stored by sensors, recorded in bags, or kept by events.')  # fmt: skip
@click.option(
    '--since',
    metavar='TIME',
    default='1d',
    show_default=True,
    help='From TIME on: yesterday, 2h, 2026-11-20, 2026-11-20T12:30 (UTC).',
)
@click.option('--until', metavar='TIME', default='now', show_default=True, help='Before TIME.')
@by_option
@click.option('--chart', type=click.Path(path_type=Path), metavar='FILE.png', help='Draw a chart with one line per topic.')
@click.option('--wifi', type=click.Path(path_type=Path), metavar='FILE.png',
              help='Draw a map of upload speed by position instead: where to dock.')  # fmt: skip
@as_json
def lake_coverage(*, robot: str | None, topic: str | None, sink: str, since: str, until: str, by: str,  # noqa: PLR0913 - one an option
                  chart: Path | None, wifi: Path | None, as_json: bool) -> ExitCode:  # fmt: skip
    """Show which hours of a topic are stored or lost.

    It shows each topic and hour, with the causes of losses, and what is still unknown.

    Up to a topic's watermark everything is known: it is stored, downsampled by the settings, or in a gap. After it, and while
    the robot was off or unreachable, it is unknown.
    """
    with asking():
        from shadowhound_data_logger.lake import gaps as library  # noqa: PLC0415 - pyarrow takes a moment
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

        now_ns = SystemClock.of_this_machine().wall_ns()
        since_ns, until_ns = moment('--since', since, now_ns), moment('--until', until, now_ns)
        if not 0 < until_ns - since_ns <= MAX_COVERED_NS:
            raise BadUsage(
                f'--since {since} --until {until} is not a span of time',
                f'--since before --until, up to {MAX_COVERED_NS // DAY_NS} days',
            )
        left_out = quietly()
        if wifi is not None:
            return _wifi(wifi, robot, since_ns, until_ns, left_out, as_json=as_json)
        found = library.coverage(since_ns, until_ns, robot=robot, topic=topic, sink=sink, findings=left_out,
                                 source=default_source(the_store_settings()), by=by)  # fmt: skip
        if chart and found:
            from shadowhound_data_logger.lake import pictures  # noqa: PLC0415

            span = f'{utc(since_ns):%Y-%m-%d %H:%M} to {utc(until_ns):%Y-%m-%d %H:%M} UTC'
            pictures.coverage(found, f'{sink}, {span}, by {by}', chart)
            click.echo(f'Wrote {chart}', err=True)
    if as_json:
        print_json([_coverage_row(each, by) for each in found])
    else:
        print_page(*_covered(found, by))
    return report_skipped(left_out)


def _wifi(target: Path, robot: str | None, since_ns: int, until_ns: int, left_out: Any, *, as_json: bool) -> ExitCode:
    from shadowhound_data_logger.lake import link, pictures, row_files  # noqa: PLC0415
    from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

    source = default_source(the_store_settings())
    names = [robot] if robot else row_files.robots(source)
    found = [one for name in names for one in link.samples(source, name, since_ns, until_ns, left_out)]
    pictures.wifi(found, f'{" ".join(names)}, {utc(since_ns):%Y-%m-%d %H:%M} to {utc(until_ns):%Y-%m-%d %H:%M} UTC', target)
    click.echo(f'Wrote {target}', err=True)
    if as_json:
        print_json([one._asdict() for one in found])
    return report_skipped(left_out)


def _coverage_row(each: Coverage, by: str) -> dict[str, Any]:
    known = each.known
    return {
        'robot': known.robot, 'sink': known.sink, 'topic': known.topic, 'since_ns': known.begin_ns, 'until_ns': known.end_ns,
        'complete_ns': known.complete_ns, 'gaps': len(known.gaps), 'untimed': len(known.untimed), 'by': by,
        'hours': [{'begin': f'{utc(begin_ns):%Y-%m-%dT%H:%MZ}', 'seconds': seconds} for begin_ns, seconds in each.hours],
    }  # fmt: skip


def _covered(found: Sequence[Coverage], by: str) -> Iterator[RenderableType]:
    """One line per hour; consecutive hours without information share one line."""
    from shadowhound_data_logger.lake.gaps import DOWNSAMPLED, NOT_KNOWN, STORED  # noqa: PLC0415

    if not found:
        yield plain('Nothing is known yet: no robot has uploaded its gap journal. A node does so each minute while it delivers.')
        return
    table = plain_table('', ('robot', 'topic', 'hour (UTC)', 'stored', 'downsampled', 'gaps', 'unknown', 'why'),
                        ('robot', 'topic', 'hour (UTC)', 'why'))  # fmt: skip
    table.title = None
    for each in found:
        for is_open, hours in groupby(each.hours, lambda hour: set(hour[1]) <= {NOT_KNOWN}):
            some = list(hours)
            for begin_ns, seconds in some[:1] if is_open else some:
                lost = {word: part for word, part in seconds.items() if word not in {STORED, DOWNSAMPLED, NOT_KNOWN}}
                whole = sum(seconds.values())
                shares = (
                    seconds.get(STORED, 0.0),
                    seconds.get(DOWNSAMPLED, 0.0),
                    sum(lost.values()),
                    seconds.get(NOT_KNOWN, 0.0),
                )
                hour = f'{utc(begin_ns):%m-%d %H:%M}' + (f' and {len(some) - 1} more' if is_open and len(some) > 1 else '')
                why = ', '.join(f'{word} {duration(part)}' for word, part in sorted(lost.items(), key=lambda pair: -pair[1]))
                table.add_row(*map(plain, (each.known.robot, each.known.topic, hour)), *(_share(part, whole) for part in shares),
                              plain(why))  # fmt: skip
    yield table
    yield plain(shown_by(by))
    for each in (each for each in found if each.known.untimed):
        count = sum(gap.count or 0 for gap in each.known.untimed)
        yield plain(f'{each.known.robot} {each.known.topic}: {number(count)} messages were lost at unknown times.')


def _share(part: float, whole: float) -> str:
    """Nothing is 100 % that is not all of it, nor 0 % that is some."""
    if not part:
        return '-'
    return '100 %' if part == whole else f'{min(99.9, max(0.1, 100 * part / whole)):.1f} %'


def _report(rows: Rows, found: Audit, lacking: list[Any], *, deep: bool) -> dict[str, Any]:
    piled = findings(found)
    if lacking:
        first = [{'bucket': one.bucket, 'key': one.key, 'detail': f'{one.size} bytes'} for one in lacking]
        piled[UNLISTED] = {'count': len(first), 'first': first}
    return {
        'deep': deep, 'known': len(rows), 'asked': found.asked, 'asked_earlier': found.earlier,
        'sound': found.earlier + found.sound, 'unproved': rows.unverified(),
        'findings': piled, 'unreachable': None if found.away is None else str(found.away),
        'ok': found.away is None and not piled and len(rows) > 0,
    }  # fmt: skip


def _page(report: Mapping[str, Any]) -> list[Any]:
    by = f'its own catalog and the one in {report["catalog"]}' if report['catalog'] else 'its own catalog'
    asked = f'{report["store"]} was checked for {number(report["asked"])} of the {number(report["known"])} objects of {by}'
    asked += f' ({number(report["asked_earlier"])} more by an earlier run)' if report['asked_earlier'] else ''
    lines: list[Any] = [plain(f'{asked}, in {duration(report["took_s"])}.')]
    if report['unproved']:
        lines.append(plain(f'Of {number(report["unproved"])} no checksum is known: only their sizes are compared.', 'yellow'))
    return [*lines, *finding_lines(report['findings'], WORDS), '', _verdict(report)]


def _verdict(report: Mapping[str, Any]) -> Text:
    how = 'every byte read back' if report['deep'] else 'by size and checksum'
    if report['unreachable']:
        left = plain(
            f': {report["unreachable"]}. {number(report["known"] - report["asked"] - report["asked_earlier"])} '
            'objects are not checked yet: run it again to continue there.'
        )
        return Text.assemble(('The store cannot be reached', 'yellow'), left)
    if not report['known']:
        return Text.assemble(('Nothing is verified', 'yellow'), f': the catalog has no such objects.{store_hint()}')
    if report['ok']:
        return Text.assemble(('All of them are there', 'green'), f', {how}.')
    if not report['findings']:
        return Text.assemble(('All objects that it names are there', 'yellow'), f', {how}; but it is not whole.')
    wrong = len({(one['bucket'], one['key']) for piled in report['findings'].values() for one in piled['first']})
    return Text.assemble((f'{number(wrong)} are not as the catalog says', 'red'), f', {how}.')
