"""Checks whether the names in a query exist: a misspelled name must not look like a result without objects."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any, Final

from shadowhound_data_logger.core.config import DEFAULT_SENSORS
from shadowhound_data_logger.core.errors import UnknownName
from shadowhound_data_logger.formats.rows.catalog import KEPT
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import robots
from shadowhound_data_logger.lake.tables import answer, literal
from shadowhound_data_logger.lake.views import views

MAX_SUGGESTIONS: Final = 10
"""Names in a remedy."""
SHORT: Final = 3
"""In a name of this length, one wrong letter is a third or half of it."""
_WORD: Final = re.compile(r'[A-Za-z_]\w*', re.ASCII)
_COLUMNS: Final = ('sensor', 'topic', 'mission_type')


def check_name_of(what: str, name: str, known: Iterable[str | None]) -> None:
    """Raises UnknownName, with the most similar names, for a name that is not known. If no name is known, accepts any."""
    there = sorted({each for each in known if each})
    if not there or name in there:
        return
    near = nearest(name, there)
    if near:
        remedy = f'is it {" or ".join(map(repr, near))}?'
    else:
        more = f' and {len(there) - MAX_SUGGESTIONS:,} more' if len(there) > MAX_SUGGESTIONS else ''
        remedy = f'there are {", ".join(there[:MAX_SUGGESTIONS])}{more}'
    raise UnknownName(f'there is no {what} {name!r}', remedy=remedy, kind=what, name=name, near=near)


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """At most three of the known names, the most similar first; empty if none is similar."""
    folded = {each.casefold(): each for each in known}
    cutoff = 0.5 if len(name) <= SHORT else 0.6
    return [folded[each] for each in get_close_matches(name.casefold(), folded, cutoff=cutoff)]


def misspelled(query: str, error: str, known: Iterable[str]) -> str:
    """A remedy for invalid SQL: the known names most similar to an unknown one that both the query and the error contain, or ''.

    ``known`` are the columns and views. It does not depend on the wording of the engine's errors.
    """
    there = set(known)
    unknown = set(_WORD.findall(query)) - there
    for name in _WORD.findall(error):
        if name in unknown and len(name) > SHORT and (near := nearest(name, there)):
            return f'is {name!r} {" or ".join(map(repr, near))}?'
    return ''


def check_names(source: Bucket, findings: Findings, **flags: Any) -> None:
    """Raises UnknownName for the first name in the flags of ``lake.objects`` that neither stored nor kept objects have.

    Reads the names of all objects of the robot, so call it only after an empty result. Raises StoreError, LakeError.
    """
    from shadowhound_data_logger.lake import labels, query  # noqa: PLC0415 - imports names

    robot = flags.get('robot')
    if robot:
        check_name_of('robot', robot, robots(source))
    columns = [name for name in _COLUMNS if flags.get(name)]
    if flags.get('mission'):
        columns += ['mission_id', 'run_id']
    if columns:
        found = query.objects(source, findings=findings, robot=robot, columns=columns, distinct=True).to_pydict()
        kept = _kept(source, findings, robot, columns)
        known: dict[str, list[str | None]] = {name: [*found[name], *kept[name]] for name in columns}
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
        found = query.missions(source, findings=findings, robot=robot).select(['policy', 'policies']).to_pydict()
        ids = [name for text in (*found['policy'], *found['policies']) for name in (text or '').split(', ')]
        versions = [each.partition('#')[0] for each in ids if each]
        if not any('#' in flags['policy'] and each.startswith(flags['policy']) for each in ids if each):
            check_name_of('policy', flags['policy'], [*versions, *(each.partition('@')[0] for each in versions)])


def _kept(source: Bucket, findings: Findings, robot: str | None, columns: Sequence[str]) -> dict[str, list[str | None]]:
    """The names of objects that are only on robots."""
    with views(source, [KEPT], findings, robot=robot) as ready:
        of_robot = f' WHERE robot = {literal(robot)}' if robot else ''
        rows = answer(ready, f'SELECT DISTINCT {", ".join(columns)} FROM all_kept{of_robot}')  # noqa: S608 - own names
    return {name: rows[name].to_pylist() for name in columns}
