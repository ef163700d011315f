"""The tables of the spool's index: objects, their totals (kept by triggers), sessions and accounts; and that they are there."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Final

from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import State

SCHEMA_VERSION: Final = 5
CATALOGUE: Final = '_catalog'
"""The sensor of the catalogue's own objects, which have no rows in it."""
REGRADED: Final = 5
"""The version from which on accounts have grades as they are now."""
VERSION_LIMIT: Final = 1000
"""A version from here on is damage, not a future."""
_STATES: Final = ', '.join(f"'{state.value}'" for state in State)
_BY_BUCKET: Final = """
CREATE INDEX pending ON objects (bucket, priority, id) WHERE state = 'pending';
CREATE INDEX waiting ON objects (bucket, id) WHERE state = 'pending';
"""
"""Each bucket in both orders: while one takes nothing, however much waits for it, the others are found as fast."""
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
"""What the store holds and no part of the catalogue has a row of (uncatalogued.py)."""
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
_ESTIMATES: Final = """
CREATE TABLE estimates (
  session INTEGER NOT NULL, topic TEXT NOT NULL, estimated INTEGER NOT NULL, unknown INTEGER NOT NULL, missed TEXT NOT NULL,
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
CREATE TABLE rhythms (
  topic TEXT NOT NULL PRIMARY KEY, publisher TEXT NOT NULL, of TEXT NOT NULL, period REAL NOT NULL, last INTEGER NOT NULL
  ) WITHOUT ROWID;
"""
"""Of accounts with messages that have no numbers: how many of the received ones those are."""
_REGRADED: Final = """
INSERT INTO estimates SELECT session, topic, 0, received, '{}' FROM accounts WHERE accounting <> 'exact';
UPDATE accounts SET accounting = 'received-only' WHERE accounting <> 'exact';
UPDATE publishers SET published = 0, received = 0, missed = '{}'
  WHERE (session, topic) IN (SELECT session, topic FROM estimates);
"""
"""What a middleware reported to have lost was no account: those sessions know what was received."""
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
CREATE TABLE accounts (
  session INTEGER NOT NULL, topic TEXT NOT NULL, type TEXT NOT NULL, accounting TEXT NOT NULL,
  received INTEGER NOT NULL, skipped INTEGER NOT NULL, stored INTEGER NOT NULL,
  rejected TEXT NOT NULL, dropped TEXT NOT NULL, last_kept_ns INTEGER NOT NULL,
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
CREATE TABLE publishers (
  session INTEGER NOT NULL, topic TEXT NOT NULL, publisher TEXT NOT NULL, first INTEGER, last INTEGER,
  published INTEGER NOT NULL, received INTEGER NOT NULL, missed TEXT NOT NULL,
  PRIMARY KEY (session, topic, publisher)) WITHOUT ROWID;
{_CATALOGUE}
{_CONTENTS}
{_OTHER_TYPES}
{_ESTIMATES}
PRAGMA user_version = {SCHEMA_VERSION};
"""  # noqa: S608 - own constants only
MIGRATIONS: Final = {
    1: f'DROP INDEX pending; DROP INDEX waiting; {_BY_BUCKET} {_BY_REASON}',
    2: f'{_CONTENTS} {_CATALOGUE} INSERT INTO uncatalogued SELECT id FROM objects WHERE {_ARRIVED};',  # noqa: S608 - own constants only
    3: _OTHER_TYPES,
    4: f'{_ESTIMATES} {_REGRADED}',
}
"""Version -> what makes the next one of it. Robots in the field have spools of every version that was ever released."""
_AS_NOW: Final = f"""
CREATE TEMP TABLE accounts AS SELECT * FROM main.accounts;
CREATE TEMP TABLE publishers AS SELECT * FROM main.publishers;
{_ESTIMATES.replace('CREATE TABLE', 'CREATE TEMP TABLE')}
{_REGRADED}
"""  # noqa: S608 - own constants only
"""What makes the accounts of an older index readable where it may not be changed: a node of that version may be at it."""


def prepare(connection: sqlite3.Connection, path: Path, *, read_only: bool) -> None:
    """Make the tables where there are none, bring older ones up to date, and have commits be durable.

    Raises sqlite3.DatabaseError for a version that is none, SpoolError for a newer one, which has other tables than ours.
    """
    version = connection.execute('PRAGMA user_version').fetchone()[0]
    if not 0 <= version < VERSION_LIMIT or (version > SCHEMA_VERSION and definitions(connection) == expected()):
        raise sqlite3.DatabaseError(f'the version {version} is none')
    if version > SCHEMA_VERSION:
        raise SpoolError(f'the spool index {path} is of version {version}, this program knows {SCHEMA_VERSION}',
                         remedy='update shadowhound_data_logger')  # fmt: skip
    if read_only:
        if 0 < version < REGRADED:
            connection.executescript(_AS_NOW)
        return
    connection.execute('PRAGMA journal_mode = WAL')
    connection.execute('PRAGMA synchronous = FULL')
    if version == 0:
        connection.executescript(f'BEGIN IMMEDIATE; {SCHEMA} COMMIT;')
    elif version < SCHEMA_VERSION:
        steps = ''.join(MIGRATIONS[older] for older in range(version, SCHEMA_VERSION))
        connection.executescript(f'BEGIN IMMEDIATE; {steps} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;')


def definitions(db: sqlite3.Connection) -> set[tuple[str, str]]:
    """Name and text of all tables, indexes and triggers."""
    return set(db.execute('SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL'))


def expected() -> set[tuple[str, str]]:
    """The definitions of an index that is whole."""
    with closing(sqlite3.connect(':memory:')) as db:
        db.executescript(SCHEMA)
        return definitions(db)
