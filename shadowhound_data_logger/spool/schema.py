"""The tables of the spool's index: objects, their totals (kept by triggers), sessions and accounts; what can be in them."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Final

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import EVENTS_WHEN, PREVIEWS, UPLOAD_WHEN, State
from shadowhound_data_logger.spool.gaps import FORGOTTEN

SCHEMA_VERSION: Final = 1
CATALOGUE: Final = '_catalog'
"""The sensor of the catalogue's own objects, which have no rows in it."""
VERSION_LIMIT: Final = 1000
"""A version from here on is damage, not a future."""
NEXT_VERSION: Final = '(SELECT ifnull(max(version), 0) + 1 FROM gaps)'
MERGE: Final = """
  ON CONFLICT DO UPDATE SET version = excluded.version, count = count + excluded.count, merged = merged + excluded.merged,
    from_ns = CASE WHEN count > 0 THEN min(from_ns, excluded.from_ns) ELSE excluded.from_ns END,
    to_ns = CASE WHEN count > 0 THEN max(to_ns, excluded.to_ns) ELSE excluded.to_ns END"""
"""What an INSERT does where the row is there."""
_STATES: Final = ', '.join(f"'{state.value}'" for state in State)
_BY_BUCKET: Final = """
CREATE INDEX pending ON objects (bucket, priority, id) WHERE state = 'pending';
CREATE INDEX waiting ON objects (bucket, id) WHERE state = 'pending';
"""
"""Each bucket in both orders: while one takes nothing, however much waits for it, the others are found as fast."""
WAITS_FOR: Final = f"""CASE
  WHEN substr(sensor, 1, 1) = '_' OR substr(sensor, -{len(PREVIEWS)}) = '{PREVIEWS}' THEN ''
  WHEN NOT protected THEN '{UPLOAD_WHEN}'
  WHEN json_valid(metadata) AND json_extract(metadata, '$.{words.EVENT}') IS NOT NULL THEN '{EVENTS_WHEN}' ELSE '' END"""
"""``model.waits_for`` of a row."""
EXEMPT: Final = f"""
CREATE INDEX IF NOT EXISTS exempt ON objects (bucket, priority, id) WHERE state = 'pending' AND {WAITS_FOR} <> '{UPLOAD_WHEN}';
"""
"""What goes while ``upload.when`` does not hold, however much waits for it. Only spools of nodes with such a rule have it."""
_BY_REASON: Final = "CREATE INDEX held ON objects (reason, id) WHERE state = 'held';"
_ARRIVED: Final = f"state IN ('{State.DELIVERED.value}', '{State.DEDUPLICATED.value}')"
_CATALOGUE: Final = f"""
CREATE TABLE uncatalogued (id INTEGER PRIMARY KEY);
CREATE TRIGGER arrived AFTER UPDATE OF state ON objects
    WHEN NEW.{_ARRIVED} AND OLD.state <> NEW.state AND NEW.sensor <> '{CATALOGUE}' BEGIN
  INSERT OR IGNORE INTO uncatalogued VALUES (NEW.id);
END;
CREATE TRIGGER known AFTER INSERT ON objects WHEN NEW.{_ARRIVED} AND NEW.sensor <> '{CATALOGUE}' BEGIN
  INSERT OR IGNORE INTO uncatalogued VALUES (NEW.id);
END;
CREATE TRIGGER forgotten AFTER DELETE ON objects BEGIN
  DELETE FROM uncatalogued WHERE id = OLD.id;
END;
"""  # noqa: S608 - own constants only
"""What the store holds and no part of the catalogue has a row of (``Index.uncatalogued``)."""
_STATISTICS: Final = """
CREATE TABLE statistics (id INTEGER PRIMARY KEY, said BLOB NOT NULL);
CREATE TRIGGER statistics_told AFTER DELETE ON uncatalogued BEGIN
  DELETE FROM statistics WHERE id = OLD.id;
END;
CREATE TRIGGER statistics_lost AFTER UPDATE OF state ON objects WHEN NEW.state = 'evicted' BEGIN
  DELETE FROM statistics WHERE id = NEW.id;
END;
CREATE TRIGGER statistics_forgotten AFTER DELETE ON objects BEGIN
  DELETE FROM statistics WHERE id = OLD.id;
END;
"""
"""Of the numbers in an object, until a part of the catalogue tells them. An index that is made again has none of them."""
_CONTENTS: Final = """
CREATE TABLE contents (
  id INTEGER NOT NULL, topic TEXT NOT NULL, samples INTEGER NOT NULL, PRIMARY KEY (id, topic)) WITHOUT ROWID;
CREATE TRIGGER contained AFTER INSERT ON contents BEGIN
  INSERT INTO tally VALUES (NEW.topic, 'spooled', 0, 0, NEW.samples)
    ON CONFLICT DO UPDATE SET samples = samples + NEW.samples;
  INSERT INTO tally VALUES (NEW.topic, (SELECT state FROM objects WHERE id = NEW.id), 0, 0, NEW.samples)
    ON CONFLICT DO UPDATE SET samples = samples + NEW.samples;
END;
CREATE TRIGGER contents_moved AFTER UPDATE OF state ON objects WHEN OLD.state <> NEW.state AND NEW.topic IS NULL BEGIN
  UPDATE tally SET samples = samples - (SELECT samples FROM contents WHERE id = OLD.id AND topic = tally.topic)
    WHERE state = OLD.state AND topic IN (SELECT topic FROM contents WHERE id = OLD.id);
  INSERT INTO tally SELECT topic, NEW.state, 0, 0, samples FROM contents WHERE id = NEW.id
    ON CONFLICT DO UPDATE SET samples = samples + excluded.samples;
END;
CREATE TRIGGER contents_forgotten AFTER DELETE ON objects WHEN OLD.topic IS NULL BEGIN
  DELETE FROM contents WHERE id = OLD.id;
END;
"""
"""What an object of several topics holds of each; the totals follow it."""
_OTHER_TYPES: Final = """
CREATE TABLE other_types (
  session INTEGER NOT NULL, topic TEXT NOT NULL, type TEXT NOT NULL, publishers TEXT NOT NULL, messages INTEGER,
  PRIMARY KEY (session, topic, type)) WITHOUT ROWID;
"""
"""Types that a topic was published under and that were not logged; messages is NULL where nobody counted them all."""
_REMARKS: Final = """
CREATE TABLE remarks (
  session INTEGER NOT NULL, topic TEXT NOT NULL, kind TEXT NOT NULL, reason TEXT NOT NULL, messages INTEGER NOT NULL,
  PRIMARY KEY (session, topic, kind, reason)) WITHOUT ROWID;
"""
"""Messages that were accounted for like all others although something was wrong with them. Kinds: ``by_arrival``, dated by their
arrival because their own time was not trusted; ``corrected``, stored by the only reading that their data allow."""
_ESTIMATES: Final = """
CREATE TABLE estimates (
  session INTEGER NOT NULL, topic TEXT NOT NULL, estimated INTEGER NOT NULL, unknown INTEGER NOT NULL, missed TEXT NOT NULL,
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
CREATE TABLE rhythms (
  topic TEXT NOT NULL PRIMARY KEY, publisher TEXT NOT NULL, of TEXT NOT NULL, period REAL NOT NULL, last INTEGER NOT NULL
  ) WITHOUT ROWID;
"""
"""Of accounts with messages that have no numbers: how many of the received ones those are."""
_ACCOUNTS: Final = """
CREATE TABLE accounts (
  session INTEGER NOT NULL, topic TEXT NOT NULL, type TEXT NOT NULL, accounting TEXT NOT NULL,
  received INTEGER NOT NULL, skipped INTEGER NOT NULL, stored INTEGER NOT NULL,
  rejected TEXT NOT NULL, dropped TEXT NOT NULL, last_kept_ns INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, heard_ns INTEGER NOT NULL, complete_ns INTEGER NOT NULL,
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
CREATE TABLE publishers (
  session INTEGER NOT NULL, topic TEXT NOT NULL, publisher TEXT NOT NULL, first INTEGER, last INTEGER,
  published INTEGER NOT NULL, received INTEGER NOT NULL, missed TEXT NOT NULL, heard_ns INTEGER NOT NULL,
  PRIMARY KEY (session, topic, publisher)) WITHOUT ROWID;
"""
_RECORDINGS: Final = """
CREATE TABLE recordings (
  owner TEXT NOT NULL, folder TEXT NOT NULL, said TEXT NOT NULL, channels TEXT NOT NULL,
  PRIMARY KEY (owner, folder)) WITHOUT ROWID;
CREATE TABLE slices (
  owner TEXT NOT NULL, folder TEXT NOT NULL, number INTEGER NOT NULL, bytes INTEGER NOT NULL, sha256 TEXT NOT NULL,
  t_start_ns INTEGER NOT NULL, t_end_ns INTEGER NOT NULL, messages INTEGER NOT NULL, counts TEXT NOT NULL,
  PRIMARY KEY (owner, folder, number)) WITHOUT ROWID;
CREATE TABLE missing (
  owner TEXT NOT NULL, folder TEXT NOT NULL, place INTEGER NOT NULL, file TEXT NOT NULL, what TEXT NOT NULL,
  messages INTEGER, topic TEXT, reason TEXT, PRIMARY KEY (owner, folder, place)) WITHOUT ROWID;
"""
"""Bags that are not whole in the spool yet, with their closed slices and what is missing in them (``model.RecordingRows``).

``owner`` is the robot's name, of the node, or that of ``bag record``.
"""
_LOST: Final = f"('{State.EVICTED.value}', '{State.QUARANTINED.value}')"
_IS_ON_REQUEST: Final = (
    f"CASE WHEN json_valid(NEW.metadata) THEN json_extract(NEW.metadata, '$.{words.SHIP}') = '{words.ON_REQUEST}' ELSE 0 END"
)
_KEEP: Final = f"""
CREATE INDEX kept ON objects (id, bytes) WHERE state = 'kept';
CREATE TABLE untold (id INTEGER NOT NULL, state TEXT NOT NULL, PRIMARY KEY (id, state)) WITHOUT ROWID;
CREATE TRIGGER kept_here AFTER INSERT ON objects WHEN NEW.state = 'kept' BEGIN
  INSERT OR IGNORE INTO untold VALUES (NEW.id, 'kept');
END;
CREATE TRIGGER kept_again AFTER UPDATE OF state ON objects WHEN NEW.state = 'kept' AND OLD.state <> NEW.state BEGIN
  INSERT OR IGNORE INTO untold VALUES (NEW.id, 'kept');
END;
CREATE TRIGGER kept_lost AFTER UPDATE OF state ON objects
    WHEN NEW.state IN {_LOST} AND OLD.state <> NEW.state AND {_IS_ON_REQUEST} BEGIN
  INSERT OR IGNORE INTO untold VALUES (NEW.id, 'lost');
END;
CREATE TRIGGER never_kept AFTER INSERT ON objects WHEN NEW.state IN {_LOST} AND {_IS_ON_REQUEST} BEGIN
  INSERT OR IGNORE INTO untold VALUES (NEW.id, 'lost');
END;
CREATE TRIGGER kept_forgotten AFTER DELETE ON objects BEGIN
  DELETE FROM untold WHERE id = OLD.id;
END;
CREATE TABLE requests (
  id TEXT NOT NULL PRIMARY KEY, requester TEXT NOT NULL, priority INTEGER NOT NULL, made_ns INTEGER NOT NULL,
  expires_ns INTEGER NOT NULL, received_ns INTEGER NOT NULL, wanted TEXT NOT NULL, state TEXT NOT NULL, why TEXT NOT NULL,
  objects INTEGER NOT NULL, bytes INTEGER NOT NULL, gone TEXT NOT NULL,
  answers INTEGER NOT NULL, told TEXT NOT NULL, told_ns INTEGER NOT NULL)
  WITHOUT ROWID;
CREATE TABLE requested (
  request TEXT NOT NULL, id INTEGER NOT NULL, bytes INTEGER NOT NULL, outcome TEXT NOT NULL,
  PRIMARY KEY (request, id)) WITHOUT ROWID;
CREATE INDEX requested_objects ON requested (id);
CREATE INDEX requested_waiting ON requested (request, id) WHERE outcome = 'kept';
CREATE INDEX requested_released ON requested (request, id, bytes) WHERE outcome = 'pending';
CREATE TRIGGER answered AFTER UPDATE OF state ON objects
    WHEN OLD.state <> NEW.state AND EXISTS (SELECT 1 FROM requested WHERE requested.id = NEW.id) BEGIN
  UPDATE requested SET outcome = NEW.state, bytes = NEW.bytes WHERE id = NEW.id;
END;
"""  # noqa: S608 - own constants only
"""What stays on the robot until somebody asks for it, and who asked (request_table.py).

``untold`` are the rows that the table of what is kept in the store lacks: (id, ``kept``, ``thinned`` and the step, or ``lost``).
"""


def _gap_of(row: str, topic: str, samples: str) -> str:
    """The values of the gap that the samples of a lost object are."""
    named = f"0, {topic}, {row}.state, ifnull({row}.reason, ''), 'exact', '', {_mission_of(row)}, {_begin_of(row)}"
    return f'{named}, {row}.t_start_ns, {row}.t_end_ns, {samples}, 1, {NEXT_VERSION}'


def _mission_of(row: str) -> str:
    return f"CASE WHEN json_valid({row}.metadata) THEN ifnull(json_extract({row}.metadata, '$.mission_id'), '') ELSE '' END"


def _begin_of(row: str) -> str:
    start, end = f'{row}.t_start_ns', f'{row}.t_end_ns'
    return f'CASE WHEN {end} - {start} < 1000000000 THEN {start} / 1000000000 * 1000000000 ELSE {start} END'


_GAP_TABLE: Final = f"""
CREATE TABLE gaps (
  session INTEGER NOT NULL, topic TEXT NOT NULL, kind TEXT NOT NULL, cause TEXT NOT NULL, grade TEXT NOT NULL,
  publisher TEXT NOT NULL, mission TEXT NOT NULL, begin_ns INTEGER NOT NULL, from_ns INTEGER, to_ns INTEGER,
  count INTEGER NOT NULL, merged INTEGER NOT NULL, version INTEGER NOT NULL,
  PRIMARY KEY (session, topic, kind, cause, grade, begin_ns, publisher, mission)) WITHOUT ROWID;
CREATE INDEX gaps_changed ON gaps (version);
CREATE INDEX gaps_begun ON gaps (begin_ns);
CREATE TRIGGER object_lost AFTER INSERT ON objects
    WHEN NEW.state IN {_LOST} AND NEW.topic IS NOT NULL AND NEW.samples > 0 BEGIN
  INSERT INTO gaps VALUES ({_gap_of('NEW', 'NEW.topic', 'NEW.samples')}) {MERGE};
END;
CREATE TRIGGER contents_lost AFTER INSERT ON contents
    WHEN NEW.samples > 0 AND (SELECT state FROM objects WHERE id = NEW.id) IN {_LOST} BEGIN
  INSERT INTO gaps SELECT {_gap_of('objects', 'NEW.topic', 'NEW.samples')} FROM objects WHERE id = NEW.id {MERGE};
END;
CREATE TRIGGER lost_or_found AFTER UPDATE OF state, reason ON objects
    WHEN (OLD.state <> NEW.state OR OLD.reason IS NOT NEW.reason) AND (OLD.state IN {_LOST} OR NEW.state IN {_LOST}) BEGIN
  UPDATE gaps SET version = {NEXT_VERSION}, merged = max(0, merged - 1), count = count - (
      SELECT CASE WHEN OLD.topic IS NULL
        THEN (SELECT samples FROM contents WHERE id = OLD.id AND topic = gaps.topic) ELSE OLD.samples END)
    WHERE OLD.state IN {_LOST} AND session = 0 AND kind = OLD.state AND cause = ifnull(OLD.reason, '') AND grade = 'exact'
      AND begin_ns = {FORGOTTEN} AND publisher = '' AND mission = ''
      AND (topic = OLD.topic OR (OLD.topic IS NULL
        AND topic IN (SELECT topic FROM contents WHERE id = OLD.id AND samples > 0)))
      AND NOT EXISTS (SELECT 1 FROM gaps AS own WHERE own.session = 0 AND own.topic = gaps.topic AND own.kind = OLD.state
        AND own.cause = ifnull(OLD.reason, '') AND own.grade = 'exact' AND own.begin_ns = {_begin_of('OLD')}
        AND own.publisher = '' AND own.mission = {_mission_of('OLD')});
  UPDATE gaps SET version = {NEXT_VERSION}, merged = max(0, merged - 1), count = count - (
      SELECT CASE WHEN OLD.topic IS NULL
        THEN (SELECT samples FROM contents WHERE id = OLD.id AND topic = gaps.topic) ELSE OLD.samples END)
    WHERE OLD.state IN {_LOST} AND session = 0 AND kind = OLD.state AND cause = ifnull(OLD.reason, '') AND grade = 'exact'
      AND begin_ns = {_begin_of('OLD')} AND publisher = ''
      AND mission = {_mission_of('OLD')}
      AND (topic = OLD.topic OR (OLD.topic IS NULL
        AND topic IN (SELECT topic FROM contents WHERE id = OLD.id AND samples > 0)));
  INSERT INTO gaps SELECT {_gap_of('NEW', 'NEW.topic', 'NEW.samples')}
    WHERE NEW.state IN {_LOST} AND NEW.topic IS NOT NULL AND NEW.samples > 0 {MERGE};
  INSERT INTO gaps SELECT {_gap_of('NEW', 'contents.topic', 'contents.samples')} FROM contents
    WHERE NEW.state IN {_LOST} AND NEW.topic IS NULL AND contents.id = NEW.id AND contents.samples > 0 {MERGE};
END;
"""  # noqa: S608 - own constants only
"""What was lost, and when (gaps.py). What the samples of lost objects are in it follows the objects: session 0."""


_COMPACT_OBJECTS: Final = """
CREATE TABLE folders (
  id INTEGER PRIMARY KEY, bucket TEXT NOT NULL, path TEXT NOT NULL, sensor TEXT NOT NULL, UNIQUE (bucket, path, sensor));
CREATE TABLE compact_objects (
  folder INTEGER NOT NULL, name TEXT NOT NULL, id INTEGER NOT NULL, state INTEGER NOT NULL, bytes INTEGER NOT NULL,
  sha256 BLOB NOT NULL, settled_s INTEGER NOT NULL, PRIMARY KEY (folder, name)) WITHOUT ROWID;
"""
"""Objects that left the spool (``Index.compact``): what must be known of a key that was given out, in a tenth of the bytes.

``path`` and ``name`` are the key. The states have numbers (``index.COMPACT_STATES``), since those take no byte.
"""
_GAPS_TOLD: Final = """
CREATE TABLE gaps_told (robot TEXT NOT NULL PRIMARY KEY, version INTEGER NOT NULL, again INTEGER NOT NULL) WITHOUT ROWID;
"""
"""Up to which version of the journal the parts of a robot tell all; and how often it was asked to tell all of it again."""
SCHEMA: Final = f"""
CREATE TABLE objects (
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  bucket TEXT NOT NULL, key TEXT NOT NULL,
  state TEXT NOT NULL CHECK (state IN ({_STATES})), reason TEXT,
  priority INTEGER NOT NULL, protected INTEGER NOT NULL,
  sensor TEXT NOT NULL, topic TEXT, type TEXT NOT NULL,
  samples INTEGER NOT NULL, bytes INTEGER NOT NULL, sha256 TEXT NOT NULL,
  content_type TEXT NOT NULL, metadata TEXT NOT NULL,
  t_start_ns INTEGER NOT NULL, t_end_ns INTEGER NOT NULL,
  created_ns INTEGER NOT NULL, settled_ns INTEGER,
  UNIQUE (bucket, key));
{_BY_BUCKET}
{_BY_REASON}
CREATE INDEX evictable ON objects (priority DESC, id, bytes) WHERE state IN ('pending', 'held') AND NOT protected;
CREATE INDEX quarantined ON objects (reason, bytes) WHERE state = 'quarantined';
CREATE INDEX settled ON objects (settled_ns) WHERE state IN ('delivered', 'deduplicated', 'evicted');
CREATE TABLE tally (
  topic TEXT NOT NULL, state TEXT NOT NULL,
  objects INTEGER NOT NULL DEFAULT 0, bytes INTEGER NOT NULL DEFAULT 0, samples INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (topic, state)) WITHOUT ROWID;
CREATE TRIGGER spooled AFTER INSERT ON objects BEGIN
  INSERT INTO tally VALUES (ifnull(NEW.topic, ''), 'spooled', 1, NEW.bytes, NEW.samples)
    ON CONFLICT DO UPDATE SET objects = objects + 1, bytes = bytes + NEW.bytes, samples = samples + NEW.samples;
  INSERT INTO tally VALUES (ifnull(NEW.topic, ''), NEW.state, 1, NEW.bytes, NEW.samples)
    ON CONFLICT DO UPDATE SET objects = objects + 1, bytes = bytes + NEW.bytes, samples = samples + NEW.samples;
END;
CREATE TRIGGER moved AFTER UPDATE OF state ON objects WHEN OLD.state <> NEW.state BEGIN
  UPDATE tally SET objects = objects - 1, bytes = bytes - OLD.bytes, samples = samples - OLD.samples
    WHERE topic = ifnull(OLD.topic, '') AND state = OLD.state;
  INSERT INTO tally VALUES (ifnull(NEW.topic, ''), NEW.state, 1, NEW.bytes, NEW.samples)
    ON CONFLICT DO UPDATE SET objects = objects + 1, bytes = bytes + NEW.bytes, samples = samples + NEW.samples;
END;
CREATE TABLE sessions (
  id INTEGER PRIMARY KEY AUTOINCREMENT, robot TEXT NOT NULL, boot_id TEXT NOT NULL, pid INTEGER NOT NULL,
  started_ns INTEGER NOT NULL, ended_ns INTEGER);
{_ACCOUNTS}
{_CATALOGUE}
{_CONTENTS}
{_OTHER_TYPES}
{_REMARKS}
{_ESTIMATES}
{_GAP_TABLE}
{_COMPACT_OBJECTS}
{_GAPS_TOLD}
{_RECORDINGS}
{_KEEP}
{_STATISTICS}
PRAGMA user_version = {SCHEMA_VERSION};
"""  # noqa: S608 - own constants only


def version_of(connection: sqlite3.Connection, path: Path) -> int:
    """The version of an index; 0 where it has no tables yet.

    Raises sqlite3.DatabaseError for an impossible version, SpoolError for that of another program, which is left untouched.
    """
    version = int(connection.execute('PRAGMA user_version').fetchone()[0])
    if not 0 <= version < VERSION_LIMIT or (version > SCHEMA_VERSION and definitions(connection) == expected()):
        raise sqlite3.DatabaseError(f'the version {version} is invalid')
    if version > SCHEMA_VERSION:
        raise SpoolError(f'the spool index {path} has version {version}, this program reads version {SCHEMA_VERSION}',
                         remedy='update shadowhound_data_logger')  # fmt: skip
    return version


def prepare(connection: sqlite3.Connection, path: Path, *, read_only: bool) -> None:
    """Create the tables of a new index and make its commits durable. Raises as ``version_of``."""
    version = version_of(connection, path)
    if read_only:
        return
    connection.execute('PRAGMA journal_mode = WAL')
    connection.execute('PRAGMA synchronous = FULL')
    if version == 0:
        connection.executescript(f'BEGIN IMMEDIATE; {SCHEMA} COMMIT;')


def definitions(db: sqlite3.Connection) -> set[tuple[str, str]]:
    """Name and text of all tables, indexes and triggers."""
    return set(db.execute('SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL'))


def expected() -> set[tuple[str, str]]:
    """The definitions of an index that is whole."""
    with closing(sqlite3.connect(':memory:')) as db:
        db.executescript(SCHEMA)
        return definitions(db)


_NUMBERS: Final = {
    'objects': ('id', 'priority', 'protected', 'samples', 'bytes', 't_start_ns', 't_end_ns', 'created_ns', 'settled_ns'),
    'sessions': ('id', 'pid', 'started_ns', 'ended_ns'),
    'accounts': ('session', 'received', 'skipped', 'stored', 'last_kept_ns', 'first_ns', 'heard_ns', 'complete_ns'),
    'publishers': ('session', 'first', 'last', 'published', 'received', 'heard_ns'),
    'other_types': ('session', 'messages'),
    'remarks': ('session', 'messages'),
    'estimates': ('session', 'estimated', 'unknown'),
    'rhythms': ('last',),
    'tally': ('objects', 'bytes', 'samples'),
    'contents': ('id', 'samples'),
    'gaps': ('session', 'begin_ns', 'from_ns', 'to_ns', 'count', 'merged', 'version'),
    'folders': ('id',),
    'compact_objects': ('folder', 'id', 'state', 'bytes', 'settled_s'),
    'gaps_told': ('version', 'again'),
    'statistics': ('id',),
    'recordings': (),
    'untold': ('id',),
    'requests': ('priority', 'made_ns', 'expires_ns', 'received_ns', 'objects', 'bytes', 'answers', 'told_ns'),
    'requested': ('id', 'bytes'),
    'slices': ('number', 'bytes', 't_start_ns', 't_end_ns', 'messages'),
    'missing': ('place', 'messages'),
    'sqlite_sequence': ('seq',),
}
_COUNTS: Final = frozenset({'id', 'samples', 'bytes', 'received', 'skipped', 'stored', 'published', 'objects', 'seq', 'session',
                            'messages', 'estimated', 'unknown', 'count', 'merged', 'version', 'folder', 'again', 'number',
                            'place', 'answers'})  # fmt: skip
"""Never below 0, and no more than can be counted. Times and the numbers of messages are whatever a publisher says."""
_MOST: Final = 1 << 53
_TEXTS: Final = {
    'objects': ('bucket', 'key', 'state', 'reason', 'sensor', 'topic', 'type', 'sha256', 'content_type', 'metadata'),
    'sessions': ('robot', 'boot_id'),
    'accounts': ('topic', 'type', 'accounting', 'rejected', 'dropped'),
    'publishers': ('topic', 'publisher', 'missed'),
    'other_types': ('topic', 'type', 'publishers'),
    'remarks': ('topic', 'kind', 'reason'),
    'estimates': ('topic', 'missed'),
    'rhythms': ('topic', 'publisher', 'of'),
    'tally': ('topic', 'state'),
    'contents': ('topic',),
    'gaps': ('topic', 'kind', 'cause', 'grade', 'publisher', 'mission'),
    'folders': ('bucket', 'path', 'sensor'),
    'compact_objects': ('name',),
    'gaps_told': ('robot',),
    'statistics': (),
    'recordings': ('owner', 'folder', 'said', 'channels'),
    'untold': ('state',),
    'requests': ('id', 'requester', 'wanted', 'state', 'why', 'gone', 'told'),
    'requested': ('request', 'outcome'),
    'slices': ('owner', 'folder', 'sha256', 'counts'),
    'missing': ('owner', 'folder', 'file', 'what', 'topic', 'reason'),
    'sqlite_sequence': ('name',),
}
_JSON: Final = {
    'accounts': ('rejected', 'dropped'), 'publishers': ('missed',), 'estimates': ('missed',), 'objects': ('metadata',),
    'requests': ('wanted', 'gone'),
}  # fmt: skip
_UNSAFE: Final = (
    "length(key) > 1024 OR length(bucket) > 64 OR bucket GLOB '*[^A-Za-z0-9_.-]*' OR bucket IN ('', '.', '..')"
    " OR '/' || key || '/' GLOB '*/../*' OR '/' || key || '/' GLOB '*/./*' OR '/' || key || '/' GLOB '*//*'"
    " OR length(reason) > 200 OR reason GLOB '*/*' OR reason IN ('.', '..')"
)


def _implausible(table: str) -> str:
    """NULL is judged by the table's own constraints."""
    conditions = [f"typeof({column}) NOT IN ('text', 'null')" for column in _TEXTS[table]]
    for column in _NUMBERS[table]:
        conditions.append(f"typeof({column}) NOT IN ('integer', 'null')")
        if column in _COUNTS:
            conditions.append(f'{column} NOT BETWEEN 0 AND {_MOST}')
    if table == 'rhythms':
        conditions.append(f"typeof(period) <> 'real' OR period NOT BETWEEN 0 AND {_MOST}")
    conditions += [f"{column} NOT GLOB '{{*}}'" for column in _JSON.get(table, ())]
    if table == 'compact_objects':
        conditions.append("typeof(sha256) <> 'blob' OR state > 2")
    if table == 'statistics':
        conditions.append("typeof(said) <> 'blob'")
    has_rowid = table in {'objects', 'sessions', 'sqlite_sequence', 'folders', 'statistics'}
    name = 'rowid' if has_rowid else _TEXTS[table][0]
    where = ' OR '.join((*conditions, *([_UNSAFE] if table == 'objects' else [])))
    return f'SELECT {name} FROM {table} WHERE {where} LIMIT 1'  # noqa: S608 - own constants only


IMPLAUSIBLE: Final = {table: _implausible(table) for table in _NUMBERS}
"""Table -> the question for a row with a value that cannot be ours.

A flipped bit gives a record any value, and SQLite sees nothing wrong with it: a text among numbers would end every start, a key
with ``..`` in it lead out of the spool. Asking takes 4 us a row.
"""
