"""Whether the names in a question exist: a misspelt one must not look like an answer without objects."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any, Final

from shadowhound_data_logger.core.config import DEFAULT_SENSORS
from shadowhound_data_logger.core.errors import UnknownName
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.live_files import robots

MOST_NAMED: Final = 10
"""Names in a remedy."""
SHORT: Final = 3
"""Of such a name one wrong letter is a third of it, or half."""
_COLUMNS: Final = ('sensor', 'topic', 'mission_type')


def check_name_of(what: str, name: str, known: Iterable[str | None]) -> None:
    """Raises UnknownName, with the nearest names, for one that is not among the known ones; where none is known, it may exist."""
    there = sorted({each for each in known if each})
    if not there or name in there:
        return
    folded = {each.casefold(): each for each in there}
    near = [folded[each] for each in get_close_matches(name.casefold(), folded, cutoff=0.5 if len(name) <= SHORT else 0.6)]
    if near:
        remedy = f'is it {" or ".join(map(repr, near))}?'
    else:
        more = f' and {len(there) - MOST_NAMED:,} more' if len(there) > MOST_NAMED else ''
        remedy = f'there are {", ".join(there[:MOST_NAMED])}{more}'
    raise UnknownName(f'there is no {what} {name!r}', remedy=remedy, kind=what, name=name, near=near)


def check_names(source: Bucket, findings: Findings, **flags: Any) -> None:
    """Raises UnknownName for the first name in the flags of ``lake.objects`` that nothing in the catalogue has.

    It reads the names of all objects of the robot: ask only where there was no answer. Raises StoreError, LakeError.
    """
    from shadowhound_data_logger.lake import labels, query  # noqa: PLC0415 - Daft takes half a second

    robot = flags.get('robot')
    if robot:
        check_name_of('robot', robot, robots(source))
    columns = [name for name in _COLUMNS if flags.get(name)]
    if flags.get('mission'):
        columns += ['mission_id', 'run_id']
    if columns:
        with query.answering():
            found = query.objects(source, findings=findings, robot=robot).select(*columns).distinct().to_pydict()
        known: dict[str, list[str | None]] = {name: found[name] for name in columns}
        for name in _COLUMNS:
            if name in known and not (name == 'sensor' and flags[name] in DEFAULT_SENSORS):  # one of these may have nothing yet
                check_name_of(name.replace('_', ' '), flags[name], known[name])
        if flags.get('mission'):
            ids = [*known['mission_id'], *known['run_id']]
            if not any(each and each.startswith(flags['mission']) for each in ids):
                check_name_of('mission', flags['mission'], ids)
    if flags.get('label'):
        check_name_of('label', flags['label'], (each.label for each in labels.read(source, robot, findings=findings)))
    if flags.get('policy'):
        with query.answering():
            told = query.missions(source, findings=findings, robot=robot).select('policy', 'policies').to_pydict()
        ids = [name for text in (*told['policy'], *told['policies']) for name in (text or '').split(', ')]
        versions = [each.partition('#')[0] for each in ids if each]
        if not any('#' in flags['policy'] and each.startswith(flags['policy']) for each in ids if each):
            check_name_of('policy', flags['policy'], [*versions, *(each.partition('@')[0] for each in versions)])
