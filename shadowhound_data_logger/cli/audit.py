"""Whether the store still holds what it confirmed: ``shadowhound-data ledger --verify``, and how findings are printed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from shadowhound_data_logger.cli.common import ExitCode, exit_code, the_home, the_store
from shadowhound_data_logger.cli.output import number, plain, print_json, print_page, shown_time
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.shipping.audit import KEYS, THREADS, Audit, AuditProgress, Deliveries, audit
from shadowhound_data_logger.spool.status import targets
from shadowhound_data_logger.stores.verify import KINDS


def verify_delivered(spool: Path, *, deep: bool, again: bool, as_json: bool) -> ExitCode:
    """Ask the store that the environment names; 0 if all objects are there unchanged, otherwise 1."""
    with the_store(THREADS) as store, closing(Deliveries(spool)) as deliveries:
        deliveries.open()
        question = f'{deliveries.first_session()} {store.describe()} {deep}'
        with (AuditProgress(the_home() / 'verify', question, again=again) as earlier,
              progress('read back' if deep else 'checked', deliveries.known(), of='objects') as bar):  # fmt: skip
            found = audit(deliveries.pages(), earlier, store, deep=deep, tell=bar.have)
        report = _report(found, deliveries, store.describe(), deep=deep)
        report['delivered_to'] = targets(spool)
    if as_json:
        print_json(report)
    else:
        print_page(plain(_scope(report)), *finding_lines(report['findings'], KINDS), '', _verdict(report), *_doubt(report))
    return exit_code(finding=not report['ok'])


def _report(found: Audit, deliveries: Deliveries, store: str, *, deep: bool) -> dict[str, Any]:
    return {
        'store': store, 'deep': deep, 'since_ns': deliveries.since_ns(),
        'known': deliveries.known(), 'forgotten': deliveries.forgotten(),
        'asked': found.asked, 'asked_earlier': found.earlier, 'sound': found.earlier + found.sound,
        'findings': findings(found),
        'unreachable': None if found.away is None else str(found.away), 'ok': found.away is None and not found.counts,
    }  # fmt: skip


def findings(found: Audit) -> dict[str, Any]:
    """Kind -> how many there are, and those that the audit lists."""
    listed = {
        kind: [{'bucket': one.bucket, 'key': one.key, 'detail': one.detail} for one in first]
        for kind, first in found.first.items()
    }  # fmt: skip
    return {kind: {'count': count, 'first': listed[kind]} for kind, count in found.counts.items()}


def finding_lines(found: Mapping[str, Any], words: Mapping[str, str]) -> Iterator[RenderableType]:
    """Each kind of finding in these words, and the first of it by name."""
    for kind, piled in found.items():
        first = piled['first'][:KEYS]
        yield from ('', Text.assemble((f'{number(piled["count"])} {words[kind]}', 'red')))
        yield from (plain(f'  {one["bucket"]}/{one["key"]}: {one["detail"]}') for one in first)
        if piled['count'] > len(first):
            yield f'  ... and {number(piled["count"] - len(first))} more'


def _scope(report: Mapping[str, Any]) -> str:
    since = report['since_ns']
    text = f'{report["store"]} was checked for {number(report["asked"])} of {number(report["known"])} delivered objects'
    text += f' ({number(report["asked_earlier"])} more by an earlier run)' if report['asked_earlier'] else ''
    if since is not None:
        text += f', those since {shown_time(since)[:19]} UTC'
    forgotten = report['forgotten']
    return f'{text}; {number(forgotten)} older ones are not remembered (spool.remember_days).' if forgotten > 0 else f'{text}.'


def _doubt(report: Mapping[str, Any]) -> list[RenderableType]:
    """Where the node named another store than this shell does, that is the likeliest cause of what was found."""
    if not report['findings'] or not report['delivered_to'] or report['store'] in report['delivered_to']:
        return []
    other = ' and '.join(report['delivered_to'])
    return [plain(f'But the node delivered to {other}: is AWS_ENDPOINT_URL set here as for the node?', 'yellow')]


def _verdict(report: Mapping[str, Any]) -> Text:
    how = 'every byte read back' if report['deep'] else 'by size and checksum'
    if report['unreachable']:
        left = max(report['known'] - report['asked'] - report['asked_earlier'], 0)
        reason = plain(f': {report["unreachable"]}. {number(left)} objects are not checked yet: run it again to continue there.')
        return Text.assemble(('The store cannot be reached', 'yellow'), reason)
    if report['ok']:
        return Text.assemble(('All of them are there', 'green'), f', {how}.')
    count = sum(piled['count'] for piled in report['findings'].values())
    return Text.assemble((f'{number(count)} are not what was delivered', 'red'), f', {how}.')
