"""``shadowhound-data doctor``: what is wrong on this machine, why, and what to do, as text or as JSON."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.text import Text

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, as_json, examples, exit_code
from shadowhound_data_logger.cli.output import plain, print_json
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.core.ros_arguments import ParametersUnreadable
from shadowhound_data_logger.doctor.checks import CHECKS
from shadowhound_data_logger.doctor.context import make
from shadowhound_data_logger.doctor.model import Check, Context, Result, Role, Severity
from shadowhound_data_logger.doctor.run import TIMEOUT_S, Examination
from shadowhound_data_logger.doctor.run import fix as fix_results

STYLES: Final = {
    Severity.ERROR: 'red',
    Severity.WARNING: 'yellow',
    Severity.INFO: 'dim',
    Severity.SKIPPED: 'dim',
    Severity.OK: 'green',
}
INDENT: Final = (0, 0, 0, 4)
WORDS: Final = {Severity.ERROR: 'error', Severity.WARNING: 'warning'}


def _rates(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> dict[str, float]:
    found = {}
    for text in given:
        topic, _sign, rate = text.rpartition('=')
        try:
            found[topic] = float(rate)
        except ValueError:
            topic = ''
        if not topic:
            raise BadUsage(f'--rate {text!r} is not a topic and its rate', '--rate /imu=50 is one')
    return found


def _selected(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> tuple[Check, ...]:
    """Those whose name is one that was given, or begins with it."""
    names = [check.name for check in CHECKS]
    for name in given:
        if not any(_is_of(each, name) for each in names):
            raise BadUsage(f'there is no check {name!r}', f'there are {", ".join(names)}')
    return tuple(check for check in CHECKS if not given or any(_is_of(check.name, name) for name in given))


def _is_of(check: str, name: str) -> bool:
    return check == name or check.startswith(f'{name}.')


@click.command(epilog=examples('doctor', 'doctor --only s3 --only clock', 'doctor --fix'))
@click.option('--role', type=click.Choice([role.value for role in Role]), help='Role of this machine  [default: detected]')
@click.option(
    '--only', 'checks', multiple=True, metavar='CHECK', callback=_selected, help='Run only this check; may be repeated.'
)
@as_json
@click.option(
    '--fix',
    is_flag=True,
    help='Repair what is safe (modes of files, missing buckets, orphaned shared memory); for the rest, commands are printed.',
)
@click.option(
    '--timeout',
    type=click.FloatRange(0.5, 600.0),
    default=TIMEOUT_S,
    show_default=True,
    metavar='S',
    help='Give up after S seconds.',
)
@click.option('--params-file', type=click.Path(path_type=Path, dir_okay=False, exists=True), envvar='SHADOWHOUND_PARAMETERS',
              help="The node's parameter file  [default: none]")  # fmt: skip
@click.option('--namespace', default='/', metavar='NAME', show_default=True, help='Namespace of the node, as in -r __ns:=/tachi.')
@click.option('--rate', 'rates', multiple=True, metavar='TOPIC=HZ', callback=_rates, help='Expect this rate; may be repeated.')
@click.option('-v', '--verbose', is_flag=True, help='Also show checks that passed.')
def doctor(  # noqa: PLR0913 - one for each option
    *, role: str | None, checks: tuple[Check, ...], as_json: bool, fix: bool, timeout: float, params_file: Path | None,
    namespace: str, rates: dict[str, float], verbose: bool,
) -> ExitCode:  # fmt: skip
    """Check this machine, its network and the store, and say what to do.

    It also checks ROS and MLflow.

    It writes probe objects of 64 bytes below ROBOT/_doctor/ in the store and in the missions of MLflow; without --fix it
    changes nothing else. Exit code 1 if there are errors or warnings.
    """
    try:
        context = make(
            os.environ, role=Role(role) if role else None, parameter_file=params_file, namespace=namespace, rates_hz=rates
        )
    except ParametersUnreadable as error:
        raise BadUsage(error.what, error.remedy or error.DEFAULT_REMEDY) from error
    began_s = time.monotonic()
    results = _examine([check for check in checks if context.role in check.roles], context, timeout)
    fixed = list(fix_results(results, context)) if fix else []
    took_s = time.monotonic() - began_s
    left = [result for result in results if result.is_finding and not _is_fixed(result, fixed)]
    if as_json:
        print_json(_report(results, fixed, context, took_s, ok=not left))
    else:
        for part in report(results, fixed, context, took_s, verbose=verbose):
            console().print(part)
        if role is None and context.role is not Role.ROBOT:
            guessed = f'This machine was taken for {context.role.value}: --role robot also checks ROS, the disk and the spool.'
            console().print(plain(f'\n{guessed}', 'dim'))
    return exit_code(finding=left)


def console() -> Console:
    """Without a terminal no line is wrapped, so that commands can be pasted."""
    made = Console(highlight=False)
    if not made.is_terminal:
        made.width = 10_000
    return made


def _examine(checks: Sequence[Check], context: Context, timeout_s: float) -> list[Result]:
    """Checks in progress are shown on standard error if that is a terminal."""
    waiting = [check.name for check in checks]
    with progress(f'checking {", ".join(waiting)}') as bar:

        def on_end(check: Check) -> None:
            waiting.remove(check.name)
            bar.say(f'checking {", ".join(waiting)}')

        return Examination(checks, context, timeout_s=timeout_s, on_end=on_end).run()


def _is_fixed(result: Result, fixed: Sequence[tuple[Result, str]]) -> bool:
    return bool(result.fix) and any(one.fix == result.fix and not what.startswith('not') for one, what in fixed)


def _report(results: Sequence[Result], fixed: Sequence[tuple[Result, str]], context: Context, took_s: float,
          *, ok: bool) -> dict[str, Any]:  # fmt: skip
    return {
        'role': context.role.value, 'robot': context.settings.robot, 'ok': ok, 'took_s': round(took_s, 3),
        'findings': sum(result.is_finding for result in results), 'results': [result.as_dict() for result in results],
        'fixed': [{'check': result.check, 'what': what} for result, what in fixed],
    }  # fmt: skip


def report(results: Sequence[Result], fixed: Sequence[tuple[Result, str]], context: Context, took_s: float,
         *, verbose: bool) -> list[RenderableType]:  # fmt: skip
    """The verdict, each finding with cause and remedy, what was done, what is good to know, and what is fine."""
    findings = sorted(
        (result for result in results if result.is_finding), key=lambda result: result.severity is not Severity.ERROR
    )
    parts: list[RenderableType] = [_verdict(findings, context, took_s), *(part for each in findings for part in _finding(each))]
    if fixed:
        parts += [
            '',
            *(plain(f'--fix: {what}  ({result.check})', 'red' if what.startswith('not') else 'green') for result, what in fixed),
        ]
    notes = [each for each in results if each.severity in {Severity.INFO, Severity.SKIPPED}]
    if notes:
        parts.append('')
        parts += [plain(f'{each.check}: {each.seen}' + (f' ({each.cause})' if each.cause else ''), 'dim') for each in notes]
    fine = [each for each in results if each.severity is Severity.OK]
    if verbose:
        parts += ['', *(Text.assemble(('ok ', 'green'), plain(f'{each.check}: {each.seen}')) for each in fine)]
    elif fine:
        counts = Counter(each.check.partition('.')[0] for each in fine)
        parts += ['', Text.assemble(('Fine: ', 'green'), ', '.join(f'{name} {count}' for name, count in counts.items()),
                                    (' (-v shows them)', 'dim'))]  # fmt: skip
    return parts


def _verdict(findings: Sequence[Result], context: Context, took_s: float) -> Text:
    """``3 findings: 1 error, 2 warnings``, and the machine."""
    robot = f'robot {context.settings.robot}' if context.is_named else f'no robot found, checked as {context.settings.robot}'
    where = plain(f'  role {context.role.value}, {robot}, {took_s:.1f} s', 'dim')
    if not findings:
        return Text.assemble(('Nothing is wrong', 'bold green'), where)
    counts = Counter(result.severity for result in findings)
    parts = [f'{counts[severity]} {word}{"s" * (counts[severity] > 1)}' for severity, word in WORDS.items() if counts[severity]]
    style = 'bold red' if counts[Severity.ERROR] else 'bold yellow'
    return Text.assemble((f'{len(findings)} finding{"s" * (len(findings) > 1)}: {", ".join(parts)}', style), where)


def _finding(result: Result) -> list[RenderableType]:
    lines: list[RenderableType] = [
        '',
        Text.assemble(plain(result.check, f'bold {STYLES[result.severity]}'), '  ', plain(result.seen)),
    ]
    if result.cause:
        lines.append(Padding(plain(result.cause, 'dim'), INDENT, expand=False))
    if result.remedy:
        lines.append(Padding(Text.assemble(('-> ', 'cyan'), plain(result.remedy, 'cyan')), INDENT, expand=False))
    return lines
