"""``shadowhound-data label``: labels on the data, stored next to the data in layers that are never changed."""

from __future__ import annotations

import getpass
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import click

from shadowhound_data_logger.cli.common import (
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    robot_name,
    store_hint,
    the_robot,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import (
    counted,
    number,
    plain,
    plain_table,
    print_json,
    print_lines,
    print_page,
    shown_time,
)
from shadowhound_data_logger.cli.question import asking, quietly, ranges_option, report_skipped
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, visible

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.bucket import Bucket
    from shadowhound_data_logger.lake.labels import Label

SHOWN: Final = 100
_robot = click.option('--robot', metavar='NAME', callback=robot_name,
                      help='The robot  [default: SHADOWHOUND_ROBOT, otherwise that of this machine or store]')  # fmt: skip
_only_robot = click.option('--robot', metavar='NAME', callback=robot_name, help='Only of this robot.')
_user = click.option('--user', metavar='NAME', help='Name recorded as the author  [default: the user of this machine]')


@click.group(epilog=examples('label add stairs --robot thor --since 2026-11-20T12:30 --until 2026-11-20T12:31', 'label list'))
def label() -> None:
    """Label times, objects and boxes in images.

    Labels are in the store, next to the data. Nothing is overwritten: a removal is also added. `query`, `fetch`, `search` and
    `export` take --label NAME.
    """


@label.command(
    'add',
    epilog=examples(
        'label add stairs --robot thor --since 2026-11-20T12:30 --until 2026-11-20T12:31 --note "the cellar"',
        'label add person --robot thor --object thor/camera/20261120/123005_front.jpg --box 40,60,120,300',
        'label add bump --robot thor --ranges bumps.json',
    ),
)
@click.argument('name')
@_robot
@click.option('--since', metavar='TIME', help='From TIME on: yesterday, 2h, 2026-11-20, 2026-11-20T12:30 (UTC).')
@click.option('--until', metavar='TIME', help='Before TIME.')
@click.option('--object', 'key', metavar='KEY', help='Label this object instead of a time, as `query --format keys` prints it.')
@click.option('--box', metavar='X,Y,W,H', help='Label this box of the object, in pixels from the upper left corner.')
@ranges_option
@click.option('--note', default='', metavar='TEXT', help='A remark.')
@_user
@as_json
def label_add(*, name: str, robot: str | None, since: str | None, until: str | None, key: str | None, box: str | None,  # noqa: PLR0913 - one an option
              ranges: list[Any] | None, note: str, user: str | None, as_json: bool) -> ExitCode:  # fmt: skip
    """Label a time, an object, or the times of an answer."""
    ways = (bool(since and until), key is not None, ranges is not None)
    if sum(ways) != 1 or bool(since) != bool(until) or (box and not key):
        raise BadUsage('give either --since and --until, or --object, or --ranges; --box needs --object', 'label add --help')
    with asking():
        from shadowhound_data_logger.lake.labels import Label  # noqa: PLC0415
        from shadowhound_data_logger.lake.select import spans_of  # noqa: PLC0415

        of: dict[str, Any] = {'label': name, 'note': note}
        if ranges is not None:
            found = [Label(robot=span.robot or _named(robot), since_ns=span.since_ns,
                           until_ns=span.until_ns, **of) for span in spans_of(ranges)]  # fmt: skip
        elif key is not None:
            bucket, key = _place(key, _named(robot))
            found = [
                Label(
                    robot=_named(robot),
                    since_ns=0,
                    until_ns=0,
                    bucket=bucket,
                    key=key,
                    **{**of, **_box(box)},
                )
            ]
        else:
            now_ns = SystemClock.of_this_machine().wall_ns()
            found = [Label(robot=_named(robot), since_ns=moment('--since', since or '', now_ns),
                           until_ns=moment('--until', until or '', now_ns), **of)]  # fmt: skip
    return _add(found, user, is_json=as_json)


@label.command('import', epilog=examples('label import labels.csv --robot thor', 'label import coco.json'))
@click.argument('file', type=click.File('rb'))
@_robot
@_user
@as_json
def label_import(*, file: Any, robot: str | None, user: str | None, as_json: bool) -> ExitCode:
    """Import labels from a CSV, or boxes from a COCO file.

    A CSV names its columns: label, since and until, or key; and any of robot bucket x y width height note. The file names of a
    COCO file are keys, as `fetch` arranges images. Exit code 1 if the catalog lacks one of them: the others are imported.
    """
    body = file.read(MAX_DOCUMENT_BYTES + 1)
    now_ns = SystemClock.of_this_machine().wall_ns()
    robot = robot or os.environ.get('SHADOWHOUND_ROBOT') or ''
    with asking():
        from shadowhound_data_logger.lake import labels  # noqa: PLC0415

        is_json = body.lstrip()[:1] == b'{'
        found = labels.from_coco(body, robot) if is_json else labels.from_csv(body, _named(robot), now_ns)
    return _add(found, user, is_json=as_json)


@label.command('list', epilog=examples('label list', 'label list --label stairs --json'))
@_only_robot
@click.option('--label', 'name', metavar='NAME', help='Only with this label.')
@as_json
def label_list(*, robot: str | None, name: str | None, as_json: bool) -> ExitCode:
    """List the labels."""
    with asking():
        from shadowhound_data_logger.lake import labels  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

        left_out, source = quietly(), default_source(the_store_settings())
        found = labels.read(source, robot, label=name, findings=left_out)
        if not found:
            _check(source, labels.read(source, None, findings=quietly()), robots={robot}, labels={name})
    if as_json:
        print_json([asdict(each) for each in found])
        return report_skipped(left_out)
    table = plain_table('', _COLUMNS, _COLUMNS)
    table.title = None
    for each in found[:SHOWN]:
        of = each.key or ''
        if each.box is not None:
            of += ' ' + ','.join(f'{side:g}' for side in each.box)
        table.add_row(*map(plain, (each.id, each.robot, each.label, shown_time(each.since_ns), shown_time(each.until_ns), of,
                                   each.by, each.note)))  # fmt: skip
    print_page(*([table] if found else [plain(f'There are no labels in {source.describe()}.{store_hint()}')]))
    if len(found) > SHOWN:
        click.echo(f'{number(len(found))} labels; the first {SHOWN} are shown (--json has all)')
    return report_skipped(left_out)


_COLUMNS: Final = ('id', 'robot', 'label', 'from (UTC)', 'to (UTC)', 'object', 'by', 'note')


@label.command('remove', epilog=examples('label remove 3f2a9c0d11e45b67', 'label remove --label stairs --robot thor'))
@click.argument('ids', nargs=-1)
@_only_robot
@click.option('--label', 'name', metavar='NAME', help='Only with this label.')
@_user
@as_json
def label_remove(*, ids: Sequence[str], robot: str | None, name: str | None, user: str | None, as_json: bool) -> ExitCode:
    """Remove labels by id, or all with a name.

    The removal is recorded; what was labeled stays in the store. Exit code 1 if some of the ids do not exist.
    """
    if bool(ids) == bool(name):
        raise BadUsage('give either ids or --label', 'shadowhound-data label list')
    with asking():
        from shadowhound_data_logger.lake import labels  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

        left_out, source = quietly(), default_source(the_store_settings())
        standing = labels.read(source, robot, label=name, findings=left_out)
        found = [each for each in standing if name or each.id in ids]
        if not found:
            _check(source, labels.read(source, None, findings=quietly()), robots={robot}, labels={name}, ids=ids)
    unknown = sorted(set(ids) - {each.id for each in found})
    with the_store() as store:
        keys = [labels.write(store, of, some, by=user or _me(), is_removal=True) for of, some in labels.by_robot(found)]
    if as_json:
        print_json({'removed': len(found), 'unknown': unknown, 'layers': keys})
    else:
        print_lines(
            f'{counted(len(found), "label")} removed.', *(f'{visible(each)} is not the id of a label.' for each in unknown)
        )
    return exit_code(finding=unknown or report_skipped(left_out))


def _add(found: Sequence[Label], user: str | None, *, is_json: bool) -> ExitCode:
    from shadowhound_data_logger.lake import labels  # noqa: PLC0415
    from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415

    left_out, source = quietly(), default_source(the_store_settings())
    with asking():
        _check(source, (), robots={each.robot for each in found})
        kept, absent = labels.with_times(source, found, left_out)
        checked = [each.checked() for each in kept]
        with the_store() as store:
            keys = [labels.write(store, robot, some, by=user or _me()) for robot, some in labels.by_robot(checked)]
    if is_json:
        print_json({'added': len(checked), 'ids': [each.id for each in checked], 'absent': absent, 'layers': keys})
    else:
        print_lines(f'{counted(len(checked), "label")} added, in {counted(len(keys), "layer")}.',
                    *(f'{visible(key)} is not in the catalog.' for key in absent[:SHOWN]))  # fmt: skip
    return exit_code(finding=absent or report_skipped(left_out))


def _check(source: Bucket, there: Sequence[Label], *, robots: Iterable[str | None], labels: Iterable[str | None] = (),
           ids: Iterable[str] = ()) -> None:  # fmt: skip
    """Raises UnknownName for a robot that the store does not have, or for a label or an id that is not among those there are."""
    from shadowhound_data_logger.lake import names, row_files  # noqa: PLC0415

    known = {'robot': row_files.robots(source), 'label': [each.label for each in there], 'label id': [each.id for each in there]}
    for what, wanted in (('robot', robots), ('label', labels), ('label id', ids)):
        for name in filter(None, wanted):
            names.check_name_of(what, name, known[what])


def _me() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):  # a container without an entry for its user
        return 'unknown'


def _named(robot: str | None) -> str:
    return the_robot(robot, in_store=True)


def _place(key: str, robot: str) -> tuple[str, str]:
    """Bucket and key of an object, which may be given as BUCKET/KEY."""
    from shadowhound_data_logger.formats.rows.catalog import BUCKET  # noqa: PLC0415

    bucket, _, rest = key.partition('/')
    return (BUCKET, key) if bucket == robot else (bucket, rest)


def _box(text: str | None) -> Mapping[str, float]:
    if text is None:
        return {}
    try:
        x, y, width, height = map(float, text.split(','))
    except ValueError:
        raise BadUsage(f'--box {text} is not a box', 'x,y,width,height in pixels, such as 40,60,120,300') from None
    return {'x': x, 'y': y, 'width': width, 'height': height}
