"""``shadowhound-data pull``: requests kept data from a robot, and reports how far the request is."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Final

import click

from shadowhound_data_logger.cli.common import (
    Age,
    BadUsage,
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_robot,
    the_store,
    the_store_settings,
)
from shadowhound_data_logger.cli.output import duration, number, plain, plain_table, print_json, print_page, volume
from shadowhound_data_logger.cli.question import asking, question, quietly, report_skipped
from shadowhound_data_logger.core.dataclass_json import as_plain
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.mailbox import (
    BAG_SENSOR,
    DEFAULT_PRIORITY,
    MAX_EXPIRY_NS,
    MAX_KEYS,
    KeptFilter,
    Offer,
    RequestAnswer,
    offer,
)
from shadowhound_data_logger.core.untrusted import visible

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.pull import PullState
    from shadowhound_data_logger.lake.select import Wanted

_BAG: Final = re.compile(r'[A-Za-z0-9_.*?-]+')


@click.command(
    epilog=examples(
        'pull --sensor camera --near=-0.6,3.1,2 --since yesterday --wait',
        'pull --bag patrol_20261120_090000 --since 2026-11-20T09:04 --until 2026-11-20T09:06',
        'pull --list',
    )
)
@question
@click.option('--bag', metavar='NAME', help="Slices of this bag; '*' matches any characters.")
@click.option(
    '--priority',
    type=click.IntRange(0, 9),
    default=DEFAULT_PRIORITY,
    show_default=True,
    help='Priority of the request; 0 is sent first.',
)
@click.option(
    '--expires',
    type=Age(MAX_EXPIRY_NS),
    metavar='AGE',
    default='7d',
    show_default=True,
    help='How long it is valid, such as 2h or 30d.',
)
@click.option('--user', metavar='NAME', help='Name recorded as the author  [default: the user of this machine]')
@click.option('--wait', 'is_waiting', is_flag=True, help='Wait until the data has arrived.')
@click.option('--dry-run', is_flag=True, help='Only show what would be done.')
@click.option('--list', 'is_listing', is_flag=True, help='List the requests and their progress.')
@click.option('--cancel', metavar='ID', help='Cancel a request.')
@as_json
def pull(*, flags: Mapping[str, Any], bag: str | None, priority: int, expires: int, user: str | None, is_waiting: bool,  # noqa: PLR0913 - one an option
         dry_run: bool, is_listing: bool, cancel: str | None, as_json: bool) -> ExitCode:  # fmt: skip
    """Request data that a robot keeps (ship: on_request).

    It prints the number of objects and bytes and puts the request into the store; the robot polls every ten seconds.

    Exit code 1 if some of the data is lost, or the robot rejected the request.
    """
    with asking():
        from shadowhound_data_logger.lake import link  # noqa: PLC0415 - pyarrow takes a while
        from shadowhound_data_logger.lake import pull as lake  # noqa: PLC0415
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.names import check_name_of  # noqa: PLC0415
        from shadowhound_data_logger.lake.row_files import robots  # noqa: PLC0415

        source, left_out = default_source(the_store_settings()), quietly()
        robot = the_robot(flags.get('robot'), in_store=True)
        check_name_of('robot', robot, robots(source))
        name = user or lake.requester()
        if not is_name(name):
            raise BadUsage(f'--user {name!r} is not a name', 'use letters, digits, "_", "-" and "."')
        if is_listing:
            return _list(lake.listed(source, robot), is_json=as_json)
        with the_store() as store:
            if cancel is not None:
                lake.cancel(store, source, robot, cancel, by=name)
                click.echo(f'Asked {robot} to cancel request {cancel}.', err=True)
                return ExitCode.FINE
            want, asked = _want(source, robot, flags, bag, left_out)
            table, want = _named(lake.known(source, robot, want, left_out), want, asked)
            rows = table.to_pylist()
            if not rows:
                _check_names(source, robot, flags, bag, left_out)
            offered = offer(want, rows, link.pace_mbps(source, robot, left_out))
            if not as_json:
                click.echo(_found_sentence(robot, offered))
            answer: RequestAnswer | None = None
            request_id = None
            if not dry_run and offered.objects:
                request = lake.put_request(store, source, robot, want, by=name, priority=priority, expiry_ns=expires)
                request_id = request.id
                if not as_json:
                    click.echo(f'Requested: request {request.id}.')
                if is_waiting:
                    answer = lake.wait(source, robot, request.id, tell=AnswerPrinter(is_quiet=as_json), made_ns=request.made_ns)
                    if answer.state == 'done':
                        lake.await_rows(source, robot, want, rows, left_out)
    if as_json:
        shown = {'robot': robot, 'want': want.to_json(), **offered.to_json(), 'id': request_id}
        print_json({**shown, 'answer': as_plain(answer)})
    code = report_skipped(left_out)
    return exit_code(finding=code is not ExitCode.FINE or (answer is not None and _is_finding(answer)))


def _found_sentence(robot: str, offered: Offer) -> str:
    """What the robot keeps and what it has lost."""
    text = f'{robot} keeps {number(offered.objects)} such objects, {volume(offered.bytes)}'
    if offered.lost:
        reasons = ', '.join(f'{reason} {count:,}' for reason, count in offered.lost.items())
        text += f'; {sum(offered.lost.values()):,} are lost ({visible(reasons)})'
    if offered.objects and offered.seconds is None:
        text += '. How long that takes is unknown: it has not reported the pace of its uploads yet'
    elif offered.objects and offered.mbps and offered.seconds is not None:
        text += f'. At its pace, {offered.mbps:.1f} Mbit/s, that takes {duration(offered.seconds)}'
    return f'{text}.'


class AnswerPrinter:
    """Prints each answer once, on standard error."""

    def __init__(self, *, is_quiet: bool) -> None:
        self._is_quiet = is_quiet
        self._number = 0

    def __call__(self, answer: RequestAnswer | None) -> None:
        if answer is not None and not self._is_quiet and answer.number != self._number:
            self._number = answer.number
            click.echo(visible(_sentence(answer)), err=True)


def _sentence(answer: RequestAnswer) -> str:
    """An answer as a sentence."""
    counts = ', '.join(f'{state} {count.objects}' for state, count in answer.outcomes.items()) or 'none'
    why = f' ({answer.why})' if answer.why else ''
    cut = f'; cut out as bag {", ".join(answer.bags)}' if answer.bags else ''
    return f'{answer.time}  {answer.state}{why}: of {answer.objects} objects {counts}{cut}'


def _is_finding(answer: RequestAnswer) -> bool:
    """Whether some of a request did not arrive, or never will."""
    return answer.state != 'done' or bool(answer.lost)


def _list(found: Sequence[PullState], *, is_json: bool) -> ExitCode:

    if is_json:
        print_json([asdict(one) for one in found])
        return ExitCode.FINE
    table = plain_table('', ('request', 'by', 'priority', 'state', 'objects', 'delivered'), {'request', 'by', 'state'})
    table.title = None
    for one in found:
        counts = (one.answer.objects, one.answer.delivered.objects) if one.answer else ('-', '-')
        cells = (one.id, one.by, one.priority, one.state, *counts)
        table.add_row(*(plain(str(cell)) for cell in cells))
    print_page(*([table] if found else ['Nothing is requested.']))
    return ExitCode.FINE


def _want(source: Any, robot: str, flags: Mapping[str, Any], bag: str | None, left_out: Any) -> tuple[KeptFilter, Wanted]:
    """The request of the flags, as a robot understands it, and the complete query, with the times of labels."""
    from shadowhound_data_logger.lake import labels, select  # noqa: PLC0415 - pyarrow

    if not {'success', 'policy'}.isdisjoint(flags):
        raise BadUsage('a robot cannot select by the result or the policy of a mission', 'name the --mission')
    asked = select.wanted(time.time_ns(), **flags)
    sensor, patterns = asked.sensor, tuple[str, ...]()
    if bag is not None:
        if not _BAG.fullmatch(bag) or sensor not in {None, BAG_SENSOR}:
            raise BadUsage(
                f'--bag {bag!r} is not the name of a bag, or another sensor is requested', '`shadowhound-data bag list`'
            )
        sensor, patterns = BAG_SENSOR, (f'{robot}/rosbags/{bag}/*',)
    asked = labels.with_label_resolved(source, asked, left_out)
    want = KeptFilter(
        sensor=sensor, topic=asked.topic, since_ns=asked.since_ns, until_ns=asked.until_ns, near=asked.near,
        near_gps=asked.near_gps, mission=asked.mission, mission_type=asked.mission_type, patterns=patterns,
    )  # fmt: skip
    if not want.to_json() and asked.where is None:
        raise BadUsage('nothing is requested', "name a --sensor, a --bag or a time; --bag '*' is all bags")
    return want, asked


def _check_names(source: Any, robot: str, flags: Mapping[str, Any], bag: str | None, left_out: Any) -> None:
    """Raises UnknownName for a name that nothing has: neither the catalog nor what the robot keeps."""
    from shadowhound_data_logger.lake import names  # noqa: PLC0415
    from shadowhound_data_logger.lake import pull as lake  # noqa: PLC0415

    kept = lake.known(source, robot, KeptFilter(), left_out)
    if bag is None:
        names.check_names(source, left_out, **{**flags, 'robot': robot})
    elif not {'*', '?'} & {*bag}:
        prefix = f'{robot}/rosbags/'
        keys = [key.removeprefix(prefix) for key in kept['key'].to_pylist() if key.startswith(prefix)]
        names.check_name_of('bag', bag, (key.partition('/')[0] for key in keys))


def _named(rows: Any, want: KeptFilter, asked: Wanted) -> tuple[Any, KeptFilter]:
    """The rows that SQL and times select, which are requested by name."""
    from shadowhound_data_logger.lake import query  # noqa: PLC0415 - the extra lake

    if asked.where is None and not asked.chosen:
        return rows, want
    rows = query.within_chosen(rows, asked)
    rows = rows if asked.where is None else query.chosen(rows, asked.where)
    if len(rows) > MAX_KEYS:
        raise BadUsage(f'this chooses {len(rows):,} objects: more than {MAX_KEYS:,} cannot be requested by name', 'request less')
    return rows, replace(want, patterns=(), keys=frozenset(rows['key'].to_pylist()))
