"""A full-text index of missions' commands, events and errors, and of labels.

The index is one SQLite file (FTS5), built only from the store: from the ``summary.json`` of each mission, which never changes,
and the labels. An update reads only new missions. The index can be deleted and rebuilt at any time.

In scripts without spaces between words (Chinese, Japanese, Thai, ...), each character is a word of the index, and a word of a
query is the phrase of its characters: it is found wherever it occurs, from one character on (docs/decisions/0023). In other
scripts, only the start of a word can be searched: ``küche*`` finds ``Küchentür``.

A query is a list of words that must all occur, in any order, case and accents: ``door handle``; ``"door handle"`` for a phrase,
``door*`` for a prefix, ``-door`` for exclusion, ``door OR gate`` for either. The best match comes first (BM25; a mission's
command and the name of an event or label have four times the weight).
"""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
import tempfile
import time
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import ForeignObject, LakeError, ObjectRefused, SettingError
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.core.untrusted import MAX_SUMMARY_BYTES, from_json
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake import labels
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.names import check_name_of
from shadowhound_data_logger.lake.row_files import robots
from shadowhound_data_logger.lake.select import Wanted
from shadowhound_data_logger.stores.base import ObjectStore

MISSION, EVENT, ERROR, LABEL_KIND = 'mission', 'event', 'error', 'label'
KINDS: Final = (MISSION, EVENT, ERROR, LABEL_KIND)
REMEDY: Final = 'shadowhound-data lake index builds it from the store'
MAX_WORDS: Final = 32
MAX_TEXT: Final = 20_000
"""Characters of a document."""
MAX_DOCUMENTS: Final = 1000
"""Events and errors of one mission."""
AT_A_TIME: Final = 500
MAX_BYTES: Final = 2 << 30
_TRIES: Final = 5
_APPLICATION, _VERSION = 0x53484944, 2
"""An index of another version is deleted and rebuilt from the store."""
_SCHEMA: Final = f"""
CREATE TABLE documents (
  id INTEGER PRIMARY KEY, kind TEXT NOT NULL, robot TEXT NOT NULL, run_id TEXT, mission_id TEXT, mission_type TEXT,
  success INTEGER, since_ns INTEGER, until_ns INTEGER, bucket TEXT, key TEXT, label_id TEXT
);
CREATE INDEX by_run ON documents (robot, run_id) WHERE kind = 'mission';
CREATE INDEX by_label ON documents (robot, kind, since_ns) WHERE kind = 'label';
CREATE TABLE updates (begun_ns INTEGER NOT NULL, waiting INTEGER NOT NULL);
CREATE VIRTUAL TABLE words USING fts5(title, text, tokenize = "unicode61 remove_diacritics 2", prefix = '2 3');
PRAGMA application_id = {_APPLICATION};
PRAGMA user_version = {_VERSION};
"""
_FOUND: Final = (
    'SELECT documents.id AS id, kind, robot, mission_id, run_id, mission_type, success, since_ns, until_ns, bucket, key, title,'
    " snippet(words, -1, '', '', ' ... ', 16) AS excerpt, -bm25(words, 4.0, 1.0) AS score"
    ' FROM words JOIN documents ON documents.id = words.rowid WHERE words MATCH ?'
)
_REACHES: Final = (
    "EXISTS (SELECT 1 FROM json_each(?) AS span WHERE ifnull(json_extract(span.value, '$[0]'), robot) = robot"
    " AND since_ns <= json_extract(span.value, '$[2]') AND until_ns >= json_extract(span.value, '$[1]'))"
)
_OVERLAPPING: Final = (
    "documents AS other JOIN words AS label ON label.rowid = other.id WHERE other.kind = 'label'"
    ' AND other.robot = documents.robot AND other.since_ns <= documents.until_ns AND other.until_ns >= documents.since_ns'
)
"""The labels of a document's time."""
_LABELS: Final = f'SELECT DISTINCT label.title FROM documents, {_OVERLAPPING} AND documents.id = ? AND other.id != ?'  # noqa: S608
_UNSPACED: Final = re.compile(
    '[\u0e00-\u0eff\u0f00-\u0fff\u1000-\u109f\u1780-\u17ff'  # Thai, Lao, Tibetan, Burmese, Khmer
    '\u2e80-\u2fdf\u3005-\u3007\u3021-\u3029\u3040-\u30ff\u3105-\u312f\u31a0-\u31bf\u31f0-\u31ff'  # radicals, kana, bopomofo
    '\u3400-\u4dbf\u4e00-\u9fff\uf900-\ufaff\U00020000-\U0003ffff]'  # Han
)
"""Characters of scripts without spaces between words; https://www.unicode.org/charts/"""
_SEAM: Final = '\x1f'
"""Separates such characters in the index, and is removed from results; FTS5 treats it as a space."""
_TERM: Final = re.compile(r'\s*(?P<not>-)?(?:"(?P<phrase>[^"]*)"|(?P<word>[^\s"]+))(?P<prefix>\*)?')


@dataclass(frozen=True, slots=True)
class Indexed:
    """The result of an update."""

    missions: int
    """Missions that were added."""
    documents: int
    """Documents in the index now."""
    waiting: int
    """Missions without a summary yet."""


def update(path: Path, source: Bucket, findings: Findings | None = None) -> Indexed:
    """Create or update the index from the store. Raises StoreError, and LakeError for a file that is not an index."""
    findings = Findings() if findings is None else findings
    path.parent.mkdir(parents=True, exist_ok=True)
    if _is_outdated(path):
        path.unlink()
    is_new = not path.exists() or path.stat().st_size == 0
    begun_ns = time.time_ns()
    with _opened(path, is_new=is_new) as db:
        added, waiting = 0, 0
        for robot in robots(source):
            known = {run for (run,) in db.execute("SELECT run_id FROM documents WHERE kind = 'mission' AND robot = ?", (robot,))}
            new = [run for run in source.folders(f'{robot}/missions/') if run not in known]
            for start in range(0, len(new), AT_A_TIME):
                some = new[start : start + AT_A_TIME]
                with ThreadPoolExecutor(THREADS, 'lake-index') as pool:
                    summaries = list(pool.map(lambda run, of=robot: summary(source, of, run, findings), some))
                with db:
                    for run, each in zip(some, summaries, strict=True):
                        if each is not None:
                            add(db, of_mission(robot, run, each))
                            added += 1
                waiting += summaries.count(None)
        with db:
            db.execute("DELETE FROM words WHERE rowid IN (SELECT id FROM documents WHERE kind = 'label')")
            db.execute("DELETE FROM documents WHERE kind = 'label'")
            add(db, (_of_label(each) for each in labels.read(source, findings=findings)))
            db.execute('DELETE FROM updates')
            db.execute('INSERT INTO updates VALUES (?, ?)', (begun_ns, waiting))
        (count,) = db.execute('SELECT count(*) FROM documents').fetchone()
    return Indexed(added, count, waiting)


def search(path: Path, text: str, asked: Wanted, *, kind: str | None = None, limit: int = 20) -> list[dict[str, Any]]:
    """The best matching documents, the best first.

    Each has ``kind robot mission_id run_id mission_type success since_ns until_ns bucket key title excerpt score``, and
    ``labels``, the labels of its time. Raises SettingError for an invalid query, LakeError for a file that is not an index.
    """
    match = match_of(text)
    conditions, values = _conditions(asked, kind)
    query = ' AND '.join((_FOUND, *conditions)) + ' ORDER BY score DESC, since_ns LIMIT ?'
    with _opened(path) as db:
        db.row_factory = sqlite3.Row
        found = [dict(row) for row in db.execute(query, (match, *values, limit))]
        if not found:
            _check_names(db, asked)
        for row in found:
            number = row.pop('id')
            row['labels'] = sorted(_unspaced(name) for (name,) in db.execute(_LABELS, (number, number)))
            row['title'], row['excerpt'] = _unspaced(row['title']), _unspaced(row['excerpt'])
    return [{**row, 'success': None if row['success'] is None else bool(row['success'])} for row in found]


def _check_names(db: sqlite3.Connection, asked: Wanted) -> None:
    """Raises UnknownName for a name in the query that no document has."""
    for name in ('robot', 'mission_type'):
        if (value := getattr(asked, name)) is not None:
            known = (each for (each,) in db.execute(f'SELECT DISTINCT {name} FROM documents'))  # noqa: S608 - our own
            check_name_of(name.replace('_', ' '), value, known)
    if asked.mission is not None:
        ids = [each for pair in db.execute('SELECT DISTINCT mission_id, run_id FROM documents') for each in pair if each]
        if not any(each.startswith(asked.mission) for each in ids):
            check_name_of('mission', asked.mission, ids)
    if asked.label is not None:
        titles = db.execute("SELECT DISTINCT words.title FROM documents JOIN words ON words.rowid = id WHERE kind = 'label'")
        check_name_of('label', asked.label, (_unspaced(each) for (each,) in titles))


def updated(path: Path) -> tuple[int, int] | None:
    """The start of the last update, by the clock of the updating machine, and how many missions had no summary; None before it.

    Raises LakeError.
    """
    with _opened(path) as db:
        found: tuple[int, int] | None = db.execute('SELECT begun_ns, waiting FROM updates').fetchone()
    return found


def match_of(text: str) -> str:
    """Translate a query to FTS5, with every word quoted, so that no FTS5 syntax is injected. Raises SettingError."""
    allowed = 'words, "a phrase", begin*, -without, this OR that'
    if any(unicodedata.category(letter)[0] == 'C' and letter not in '\t\n' for letter in text):
        raise SettingError('query', text, f'{allowed}, without control characters')
    if text.count('"') % 2:
        raise SettingError('query', text, f'{allowed}; a quotation mark is not closed')
    groups: list[list[str]] = [[]]
    without: list[str] = []
    for term in _TERM.finditer(text.strip()):
        word = term['phrase'] if term['phrase'] is not None else term['word']
        if word == 'OR' and term['phrase'] is None and not term['not']:
            groups.append([])
            continue
        is_prefix = bool(term['prefix']) or (term['phrase'] is None and word.endswith('*'))
        word = word.rstrip('*') if term['phrase'] is None else word
        if not any(letter.isalnum() for letter in word):
            continue
        quoted = '"{}"{}'.format(_spaced(word).replace('"', '""'), '*' if is_prefix else '')
        (without if term['not'] else groups[-1]).append(quoted)
    if not all(groups) or sum(map(len, groups)) + len(without) > MAX_WORDS:
        raise SettingError('query', text, f'{allowed}: at least one word on each side of OR, at most {MAX_WORDS} in all')
    match = ' OR '.join(f'({" AND ".join(group)})' for group in groups)
    return f'({match}) NOT ({" OR ".join(without)})' if without else match


def _spaced(text: str) -> str:
    """The text in a normal form, with a separator between the characters of scripts without spaces."""
    seamed = _UNSPACED.sub(f'{_SEAM}\\g<0>{_SEAM}', unicodedata.normalize('NFKC', text.replace(_SEAM, ' ')))
    return seamed.replace(2 * _SEAM, _SEAM)


def _unspaced(text: str) -> str:
    return text.replace(_SEAM, '')


def _conditions(asked: Wanted, kind: str | None) -> tuple[list[str], list[Any]]:
    conditions: list[str] = []
    values: list[Any] = []

    def must(condition: str, *given: Any) -> None:
        conditions.append(condition)
        values.extend(given)

    for name, value in (('kind', kind), ('robot', asked.robot), ('mission_type', asked.mission_type), ('success', asked.success)):
        if value is not None:
            must(f'{name} = ?', value)
    if asked.mission is not None:
        must('(substr(mission_id, 1, ?) = ? OR substr(run_id, 1, ?) = ?)', *(len(asked.mission), asked.mission) * 2)
    if asked.since_ns is not None:
        must('until_ns >= ?', asked.since_ns)
    if asked.until_ns is not None:
        must('since_ns < ?', asked.until_ns)
    for chosen in asked.chosen:
        must(_REACHES, json.dumps(chosen.spans))
    if asked.label is not None:
        must(f'EXISTS (SELECT 1 FROM {_OVERLAPPING} AND label.title = ?)', _spaced(asked.label))  # noqa: S608 - our own
    return conditions, values


# -- documents -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """The index entry of a mission, an event, an error or a label."""

    kind: str
    robot: str
    title: str
    text: str
    run_id: str | None = None
    mission_id: str | None = None
    mission_type: str | None = None
    success: bool | None = None
    since_ns: int | None = None
    until_ns: int | None = None
    bucket: str | None = None
    key: str | None = None
    label_id: str | None = None


def add(db: sqlite3.Connection, found: Iterable[Document]) -> None:
    """Add documents to an open index, within a transaction."""
    for each in found:
        number = db.execute(
            'INSERT INTO documents (kind, robot, run_id, mission_id, mission_type, success, since_ns, until_ns, bucket, key,'
            ' label_id) VALUES (?,?,?,?,?,?,?,?,?,?,?)',
            (each.kind, each.robot, each.run_id, each.mission_id, each.mission_type, each.success, each.since_ns, each.until_ns,
             each.bucket, each.key, each.label_id),
        ).lastrowid  # fmt: skip
        db.execute('INSERT INTO words (rowid, title, text) VALUES (?,?,?)', (number, _spaced(each.title), _spaced(each.text)))


def of_mission(robot: str, run_id: str, content: Mapping[str, Any]) -> Iterator[Document]:
    """The documents of a ``summary.json``, whose fields may have any value."""
    common: dict[str, Any] = {
        'robot': robot, 'run_id': run_id, 'mission_id': _text(content.get('mission_id')) or None,
        'mission_type': _text(content.get('mission_type')) or None,
        'success': content.get('success') if isinstance(content.get('success'), bool) else None,
    }  # fmt: skip
    since_ns, until_ns = _stamp(content.get('start_ns')), _stamp(content.get('end_ns'))
    errors, events = _listed(content.get('errors')), _listed(content.get('events'))
    text = _text([*(content.get(name) for name in ('mission_type', 'result', 'run_name', 'ended_by', 'last')), robot])
    yield Document(kind=MISSION, title=_text(content.get('mission_command')), text=text, since_ns=since_ns, until_ns=until_ns,
                   bucket=BUCKET, key=f'{robot}/missions/{run_id}/summary.json', **common)  # fmt: skip
    for kind, some in ((ERROR, errors), (EVENT, events)):
        for each in some[:MAX_DOCUMENTS]:
            fields = dict(each) if isinstance(each, dict) else {'text': each}
            at_ns = _moment(fields.pop('time', None), since_ns)
            name = _text(fields.pop('name', '')) if kind == EVENT else ''
            yield Document(kind=kind, title=name, text=_text(fields), since_ns=at_ns, until_ns=at_ns, **common)


def _of_label(each: labels.Label) -> Document:
    return Document(kind=LABEL_KIND, robot=each.robot, title=each.label, text=_text([each.note, each.by]), since_ns=each.since_ns,
                    until_ns=each.until_ns, bucket=each.bucket, key=each.key, label_id=each.id)  # fmt: skip


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _text(value: Any) -> str:
    """All words of a JSON value, including the names of fields."""
    return ' '.join(_words(value, 0))[:MAX_TEXT].encode(errors='replace').decode()


def _words(value: Any, depth: int) -> Iterator[str]:
    if depth > 8:
        return
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield str(name)
            yield from _words(inner, depth + 1)
    elif isinstance(value, list):
        for inner in value:
            yield from _words(inner, depth + 1)
    elif value is not None:
        yield str(value)


def _stamp(value: Any) -> int | None:
    return value if type(value) is int and 0 <= value < 1 << 63 else None


def _moment(value: Any, otherwise: int | None) -> int | None:
    try:
        return moment('time', value, 0) if isinstance(value, str) else otherwise
    except SettingError:
        return otherwise


def summary(source: Bucket, robot: str, run_id: str, findings: Findings) -> Mapping[str, Any] | None:
    """The summary of a mission; None if it does not exist yet. An invalid one is skipped, and read again the next time."""
    key = f'{robot}/missions/{run_id}/summary.json'
    try:
        content = from_json(source.get(key, MAX_SUMMARY_BYTES), MAX_SUMMARY_BYTES)
    except ObjectRefused as error:
        if error.data.get('reason') != 'missing':
            findings.add(key, str(error))
        return None
    except ValueError as error:
        findings.add(key, f'it is not a summary: {error}')
        return None
    if not isinstance(content, dict):
        findings.add(key, 'it is not a summary')
        return None
    return content


# -- the file ------------------------------------------------------------------------------------------------------------------


@contextmanager
def _opened(path: Path, *, is_new: bool = False) -> Iterator[sqlite3.Connection]:
    """Open an index. The file may be hostile: it must have exactly our tables, without views or triggers. Raises LakeError."""
    if not is_new and not path.is_file():
        raise LakeError(f'the search index {path} does not exist', remedy=REMEDY)
    try:
        with closing(sqlite3.connect(path, timeout=30.0)) as db:
            db.execute('PRAGMA trusted_schema = OFF')
            if is_new:
                db.executescript(f'BEGIN; {_SCHEMA} COMMIT;')
            elif _definitions(db) != _expected() or _marks(db) != (_APPLICATION, _VERSION):
                remedy = REMEDY if _marks(db)[0] == _APPLICATION else f'remove it: {REMEDY}'
                raise LakeError(f'{path} is not a search index of this version', remedy=remedy)
            yield db
    except sqlite3.Error as error:
        raise LakeError(f'the search index {path} cannot be used: {error}', remedy=f'remove it: {REMEDY}') from error


def _is_outdated(path: Path) -> bool:
    """Whether it is an index of another version."""
    if not path.is_file():
        return False
    with suppress(sqlite3.Error), closing(sqlite3.connect(path)) as db:
        application, version = _marks(db)
        return application == _APPLICATION and (version != _VERSION or _definitions(db) != _expected())
    return False


def _marks(db: sqlite3.Connection) -> tuple[int, int]:
    (application,), (version,) = (db.execute(f'PRAGMA {name}').fetchone() for name in ('application_id', 'user_version'))
    return application, version


def _definitions(db: sqlite3.Connection) -> list[tuple[str, str]]:
    return sorted(db.execute('SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL'))


def _expected() -> list[tuple[str, str]]:
    with closing(sqlite3.connect(':memory:')) as db:
        db.executescript(_SCHEMA)
        return _definitions(db)


def put(store: ObjectStore, bucket: str, key: str, path: Path) -> None:
    """Upload the index, replacing an existing one. Raises StoreError, LakeError."""
    body = path.read_bytes()
    item = SpooledObject(
        id=0, bucket=bucket, key=key, path=path, size=len(body), sha256=hashlib.sha256(body).hexdigest(),
        content_type='application/vnd.sqlite3', metadata={}, priority=5, created_ns=time.time_ns(),
    )  # fmt: skip
    if store.head(bucket, key) is None:
        with suppress(ForeignObject):
            store.put(item)
            return
    for _ in range(_TRIES):
        there = store.changed(bucket, key, '', MAX_BYTES)
        if there is None or store.replace(bucket, key, body, there[1]):
            return
    raise LakeError(f'other processes kept replacing the index {bucket}/{key}', remedy='run the command again')


@contextmanager
def downloaded(source: Bucket, key: str) -> Iterator[Path]:
    """Download the index at a key to a temporary file. Raises StoreError."""
    with tempfile.TemporaryDirectory(prefix='shadowhound-search-') as folder:
        path = Path(folder, 'search.db')
        path.write_bytes(source.get(key, MAX_BYTES))
        yield path
