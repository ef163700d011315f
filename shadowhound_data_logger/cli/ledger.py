"""``shadowhound-data ledger``: what became of every message, as a table or as JSON."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import click
from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, as_json, examples, exit_code, spool_folder, the_spool
from shadowhound_data_logger.cli.output import (
    duration,
    figure,
    number,
    plain,
    plain_table,
    print_json,
    print_page,
    shown_time,
    unsure,
    volume,
)
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.stamps import SAME_NS, StampReport, describe
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.spool.gaps import ESTIMATED, EXACT, Gap
from shadowhound_data_logger.spool.ledger import (
    ClockFigures,
    GradeFigures,
    Ledger,
    OtherTypeFigures,
    SpoolLedger,
    TopicFigures,
    imbalances,
    journal,
    rows_of,
)
from shadowhound_data_logger.spool.ledger import read as read_ledger
from shadowhound_data_logger.spool.local_robot import local_robots, robots
from shadowhound_data_logger.spool.status import not_logged
from shadowhound_data_logger.spool.topic_account import GRADES, RECEIVED_ONLY

COLUMNS: Final = ('published', 'received', 'missed', 'skipped', 'rejected', 'dropped', 'stored', 'open')
ALWAYS: Final = frozenset({'published', 'received', 'missed', 'skipped', 'stored'})
"""The other columns appear once there is something in them."""
LOSSES: Final = frozenset({'missed', 'rejected', 'dropped'})
GRADED: Final = ('published', 'received', 'missed')
"""Figures of each grade separately."""
ACCOUNTING: Final = {
    ESTIMATED: 'its messages carry no numbers here: what was missed is estimated (~) from the rhythm of those that came',
    RECEIVED_ONLY: 'its messages carry no numbers here, and no rhythm: what was missed is not known',
}


@click.command(
    epilog=examples(
        'ledger',
        'ledger --gaps --since 2h',
        'ledger --verify',
    )
)
@as_json
@spool_folder
@click.option('--verify', 'ask', is_flag=True, help='Check that the store has every delivered object, with its checksum.')
@click.option('--deep', is_flag=True, help='Compare the contents too, not only sizes and checksums.')
@click.option('--again', is_flag=True, help='Verify from the start, even if a run was interrupted.')
@click.option('--gaps', 'when', is_flag=True, help='Show when messages were lost, how many, why, and in which mission.')
@click.option('--topic', default='', metavar='NAME', help='Only of this topic.')
@click.option('--since', default='', metavar='TIME', help='From TIME on: yesterday, 2h, 2026-11-20, 2026-11-20T12:30 (UTC).')
@click.option('--until', default='', metavar='TIME', help='Before TIME.')
@click.option('--cause', default='', metavar='WORD', help='Only of this cause or kind, such as restart, missed or no_room.')
def ledger(*, as_json: bool, spool: Path | None, ask: bool, deep: bool, again: bool, when: bool, topic: str, since: str,  # noqa: PLR0913 - one an option
           until: str, cause: str) -> ExitCode:  # fmt: skip
    """Account for every message: stored, or lost and why.

    ~ marks an estimate, - an unknown figure.

    It works whether or not the node runs. Exit code 1 if the ledger does not balance, or if the store lacks delivered
    objects; an interrupted --verify resumes where it stopped. --verify and --deep need the AWS_... variables of the node.
    Times are UTC.
    """
    folder = the_spool(spool)
    if when:
        now_ns = SystemClock.of_this_machine().wall_ns()
        begin_ns, end_ns = (moment(name, given, now_ns) if given else None
                            for name, given in (('--since', since), ('--until', until)))  # fmt: skip
        rows = [gap for gap in journal(folder, _robot(folder)) if _is_asked_for(gap, topic, begin_ns, end_ns, cause)]
        if as_json:
            print_json({'gaps': [gap.as_dict() for gap in rows]})
        else:
            print_page(*gaps_page(rows))
        return ExitCode.FINE
    if topic or since or until or cause:
        raise BadUsage('--topic, --since, --until and --cause choose among gaps', 'add --gaps')
    if ask or deep:
        from shadowhound_data_logger.cli.audit import verify_delivered  # noqa: PLC0415 - needs a tenth of a second to load

        return verify_delivered(folder, deep=deep, again=again, as_json=as_json)
    if again:
        raise BadUsage('--again is for --verify and --deep', 'add --verify')
    names, robot = robots(folder), _robot(folder)
    found: LedgerPage = {
        **read_ledger(folder, robot),
        'not_logged': dict(not_logged(folder, robot)),
        'robots': names if len(names) > 1 else [robot],  # a spool that several share has one ledger of them all
    }
    if as_json:
        print_json({**found, 'robot': robot or None, 'robots': [name for name in found['robots'] if name]})
    else:
        print_page(*page(found))
    return exit_code(finding=not found['balanced'])


def _robot(folder: Path) -> str:
    """Empty if no node has run here."""
    return next(iter(local_robots(os.environ, folder)), '')


def _is_asked_for(gap: Gap, topic: str, begin_ns: int | None, end_ns: int | None, cause: str) -> bool:
    """A gap without a time is skipped if a time is requested."""
    if (topic and gap.topic != topic) or (cause and cause not in {gap.cause, gap.kind}):
        return False
    if begin_ns is not None and (gap.to_ns is None or gap.to_ns < begin_ns):
        return False
    return end_ns is None or (gap.from_ns is not None and gap.from_ns <= end_ns)


def gaps_page(rows: Sequence[Gap]) -> list[RenderableType]:
    """One line per gap, the oldest first, gaps without a time before them.

    ``from`` is a stamp. ``received``, when that message arrived, is shown if it differs from the stamp by more than a second.
    """
    if not rows:
        return [Text('No gaps are known.')]
    columns = ['topic', 'sink', 'from', 'for', 'received', 'messages', 'gaps', 'what', 'cause', 'mission']
    optional = {'mission': any(gap.mission_id for gap in rows), 'received': any(_is_apart(gap) for gap in rows)}
    shown = [name for name in columns if optional.get(name, True)]
    table = plain_table('Gaps (UTC)', shown, left=('topic', 'sink', 'from', 'received', 'what', 'cause', 'mission'))
    for gap in rows:
        span = '-' if gap.from_ns is None or gap.to_ns is None else duration((gap.to_ns - gap.from_ns) / SECOND)
        count = number(gap.count) if gap.grade == EXACT else f'~{number(gap.count)}'
        cells = {'topic': gap.topic, 'sink': gap.sink, 'from': shown_time(gap.from_ns), 'for': span, 'messages': count,
                 'received': shown_time(gap.received_from_ns),
                 'gaps': number(gap.merged), 'what': gap.kind, 'cause': gap.cause, 'mission': gap.mission_id or ''}  # fmt: skip
        table.add_row(*(plain(cells[name]) for name in shown))
    lost = sum(gap.count or 0 for gap in rows)
    return [table, '', Text(f'{lost:,} messages in {len(rows):,} rows; gaps of one kind and cause within a second are one row.')]


def _is_apart(gap: Gap) -> bool:
    """Whether the messages around a gap arrived more than a second before or after their stamps."""
    pairs = (gap.from_ns, gap.received_from_ns), (gap.to_ns, gap.received_to_ns)
    return any(stamp_ns and received_ns and abs(received_ns - stamp_ns) > SAME_NS for stamp_ns, received_ns in pairs)


class LedgerPage(SpoolLedger):
    """What the command shows, and ``--json`` prints."""

    not_logged: dict[str, str]
    """Topics that the node found and does not log, and why."""
    robots: list[str]


def page(found: LedgerPage) -> list[RenderableType]:
    """The ledger as tables, notes about topics, and a verdict."""
    titles = {'Messages recorded into bags of': found['bags'], 'Messages that events requested of': found['events']}
    tables = [_table(f'{title} {_whose(found)}', rows) for title, rows in titles.items() if rows]
    files = [part for table in tables for part in (table, '')]
    return [
        topics_table(found),
        '',
        *files,
        objects_table(found),
        *_section(notes(found)),
        '',
        verdict(found, found['not_logged']),
    ]


def topics_table(found: LedgerPage) -> RenderableType:
    """One row per topic with messages; a dash is a figure that the middleware does not provide."""
    present = {topic: row for topic, row in found['topics'].items() if not _is_silent(row)}
    if not present:
        return Text(f'No message of {_whose(found)} has been received yet.')
    return _table(f'Messages of {_whose(found)}', present)


def _is_silent(row: TopicFigures) -> bool:
    """Whether no message of a topic has ever been received."""
    return row['accounting'] is None and not row['received']


def _whose(found: LedgerPage) -> str:
    return ' and '.join(filter(None, found['robots'])) or 'this spool'


def _table(title: str, topics: Mapping[str, TopicFigures]) -> RenderableType:
    rows = {topic: _figures(row) for topic, row in topics.items()}
    columns = [name for name in COLUMNS if name in ALWAYS or any(row[name] for row in rows.values())]
    graded = any(set(row['by_grade']) - {EXACT} for row in topics.values())
    table = plain_table(title, ('topic', *(['grade'] if graded else []), *columns), left=('topic', 'grade'))
    for topic, row in rows.items():
        grade = [topics[topic]['accounting'] or '-'] if graded else []
        table.add_row(plain(topic), *grade, *(_lossy(name, row) for name in columns))
        parts = topics[topic]['by_grade']
        for name, part in parts.items() if len(parts) > 1 else ():
            graded_figures = _graded_figures(part)
            cells = (_lossy(column, graded_figures) if column in GRADED else '' for column in columns)
            table.add_row('', name, *cells, style='dim')
    if len(rows) > 1:
        table.add_section()
        total = _total([row for topic, row in rows.items() if topics[topic]['accounting']], columns)
        table.add_row('all', *([''] if graded else []), *(_lossy(name, total) for name in columns), style='bold')
    return table


def objects_table(found: LedgerPage) -> RenderableType:
    """Where the objects are that the stored messages became."""
    first = ('spooled', 'delivered', 'pending')
    states = [*first, *(state for state, count in found['objects'].items() if count and state not in first)]
    table = plain_table('Objects', ('', *states))
    table.add_row('objects', *(number(found['objects'][state]) for state in states))
    table.add_row('size', *(volume(found['bytes'][state]) for state in states))
    return table


def notes(found: LedgerPage) -> list[str]:
    """Causes of what was lost, where stored messages are that are not delivered, and accounting that is not exact."""
    lines = []
    for topic, row in rows_of(found).items():
        for grade, part in row['by_grade'].items():
            if part['missed_by']:
                mark = '~' if part['missed'] is None else ''
                lines.append(f'{topic}: missed by {_listed(part["missed_by"], mark)}{f" ({grade})" * (len(row["by_grade"]) > 1)}')
        lost = {'rejected': row['rejected'], 'dropped': row['dropped']}
        lines += [f'{topic}: {name} by {_listed(counts)}' for name, counts in lost.items() if counts]
        if row['corrected']:
            lines.append(f'{topic}: of the stored messages, corrected: {_listed(row["corrected"])}')
        if row['stamps']:
            lines.append(f'{topic}: {describe(parse(StampReport, row["stamps"]))}')
        if row['by_arrival']:
            lines.append(f'{topic}: dated by arrival, not by the message: {_listed(row["by_arrival"])}')
        elsewhere = {state: count for state, count in row['stored_in'].items() if count and state != 'delivered'}
        if elsewhere:
            lines.append(f'{topic}: of {row["stored"]:,} stored, {_listed(elsewhere)}')
        lines += [f'{topic}: {_other_type(name, other)}' for name, other in row['other_types'].items()]
        if row['accounting'] in ACCOUNTING:
            lines.append(f'{topic}: {ACCOUNTING[row["accounting"]]}')
    if silent := [topic for topic, row in found['topics'].items() if _is_silent(row)]:
        lines.append(f'no message was received of {", ".join(silent)}')
    lines += [f'{topic}: not logged: {why}' for topic, why in found['not_logged'].items()]
    return [*lines, *clock_notes(found['clock'])]


def _other_type(name: str, other: OtherTypeFigures) -> str:
    by = ', '.join(other['publishers']) or 'a program that is not a ROS node'
    if other['messages'] is None:
        return f'published as {name} too, by {by}; it was not listened to, so the number of messages is not known'
    return f'published as {name} too, by {by}; of that {other["messages"]:,} messages were rejected (wrong_type)'


def clock_notes(clock: ClockFigures) -> Iterator[str]:
    """What the clock of the robot did that matters to a reader of dates."""
    if clock['held']:
        yield f'{clock["held"]:,} objects wait for their date: the clock of the robot was not set when they were taken'
    if clock['steps']:
        by = '' if clock['last_step_s'] is None else f', last by {clock["last_step_s"]:,.3f} s at {clock["last_step_time"]}'
        yield f'the clock of the robot stepped {clock["steps"]:,} times{by}'


def verdict(found: Ledger, not_logged: Collection[str]) -> Text:
    """One line, or one for each identity that does not hold."""
    if found['balanced']:
        return Text.assemble(('The ledger balances', 'green'), f': {_known(found, not_logged)}')
    return Text('\n').join(Text.assemble(('Does not balance', 'red'), f': {line}') for line in imbalances(found))


def _known(found: Ledger, not_logged: Collection[str]) -> str:
    """What the ledger says of all messages: no more than the worst grade among them, and only of what was listened to."""
    topics = found['topics']
    uncounted = [other for row in topics.values() for other in row['other_types'].values() if other['messages'] is None]
    if uncounted or not_logged:
        return 'every message that was received is stored, skipped, or listed as lost; what is not logged is listed above.'
    graded = [{*row['by_grade'], *filter(None, [row['accounting']])} for row in topics.values()]
    worst = [max(grades, key=GRADES.index) for grades in graded if grades]
    if not set(worst) - {EXACT}:
        return 'every message is stored, skipped, or listed as lost.'
    return f'every message that was received is stored, skipped, or listed as lost; what was missed is {unsure(worst)}.'


def _figures(row: TopicFigures) -> dict[str, int | None]:
    return {**_graded_figures(row), 'skipped': row['skipped'], 'rejected': sum(row['rejected'].values()),
            'dropped': sum(row['dropped'].values()), 'stored': row['stored'], 'open': row['open']}  # fmt: skip


def _graded_figures(part: GradeFigures) -> dict[str, int | None]:
    return {'published': part['published'], 'published_estimated': part['published_estimated'], 'received': part['received'],
            'missed': part['missed'], 'missed_estimated': part['missed_estimated']}  # fmt: skip


def _total(rows: Sequence[Mapping[str, int | None]], columns: Iterable[str]) -> dict[str, int | None]:
    """Of topics that were received: an estimate as soon as one figure is, None as soon as one is not known."""
    total: dict[str, int | None] = {}
    for name in columns:
        about = f'{name}_estimated'
        known = [row[name] if row.get(about) is None else row[about] for row in rows]
        is_estimated = any(row.get(about) is not None for row in rows)
        total[about if is_estimated else name] = None if None in known else sum(value or 0 for value in known)
        total.setdefault(name, None)
    return total


def _lossy(name: str, row: Mapping[str, int | None]) -> str:
    exact, estimated = row[name], row.get(f'{name}_estimated')
    is_loss = name in LOSSES and (exact or estimated)
    return f'[yellow]{figure(exact, estimated)}[/]' if is_loss else figure(exact, estimated)


def _listed(counts: Mapping[str, int], mark: str = '') -> str:
    """``restart 12, transport 3``, the largest first."""
    return ', '.join(f'{name} {mark}{count:,}' for name, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _section(lines: list[str]) -> list[RenderableType]:
    return ['', *(plain(line) for line in lines)] if lines else []
