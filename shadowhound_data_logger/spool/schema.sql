-- The spool's index: what every object is, where it is, and the accounts of all messages (docs/decisions/0001).
--
-- One version until 1.0. schema.py creates it, checks it and defines which values are plausible.
-- Triggers only keep sums: tally (objects, bytes and messages by topic and state) and the messages of lost objects in gaps.
-- Everything else that follows from a new state is written by ObjectTable, in the same transaction.

-- Objects in the spool, and those that left it within spool.remember_days.
CREATE TABLE objects (
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  bucket TEXT NOT NULL,
  key TEXT NOT NULL,
  state TEXT NOT NULL CHECK (state IN ('pending', 'held', 'delivered', 'evicted', 'quarantined', 'deduplicated', 'kept')),
  reason TEXT,
  priority INTEGER NOT NULL,
  protected INTEGER NOT NULL,   -- never evicted
  waits_for TEXT NOT NULL,      -- the setting that delays its upload: 'upload.when', 'events.when' or '' (model.waits_for)
  on_request INTEGER NOT NULL,  -- stays on the robot until it is requested
  event INTEGER NOT NULL,       -- part of the bag of an event
  mission TEXT NOT NULL,        -- mission id; '' outside of missions
  sensor TEXT NOT NULL,
  topic TEXT,                   -- NULL: bookkeeping, or several topics (contents)
  type TEXT NOT NULL,
  samples INTEGER NOT NULL,     -- messages
  bytes INTEGER NOT NULL,
  sha256 TEXT NOT NULL,
  content_type TEXT NOT NULL,
  metadata TEXT NOT NULL,       -- JSON, as the store gets it
  t_start_ns INTEGER NOT NULL,
  t_end_ns INTEGER NOT NULL,
  created_ns INTEGER NOT NULL,
  settled_ns INTEGER,           -- when it left the spool, or was set aside
  UNIQUE (bucket, key));
-- Each bucket in both orders, so that objects are found as fast while other buckets accept nothing.
CREATE INDEX pending ON objects (bucket, priority, id) WHERE state = 'pending';
CREATE INDEX waiting ON objects (bucket, id) WHERE state = 'pending';
-- Objects that are uploaded while upload.when is false.
CREATE INDEX exempt ON objects (bucket, priority, id) WHERE state = 'pending' AND waits_for <> 'upload.when';
CREATE INDEX held ON objects (reason, id) WHERE state = 'held';
CREATE INDEX kept ON objects (id, bytes) WHERE state = 'kept';
CREATE INDEX evictable ON objects (priority DESC, id, bytes) WHERE state IN ('pending', 'held') AND NOT protected;
CREATE INDEX quarantined ON objects (reason, bytes) WHERE state = 'quarantined';
-- Lost objects, which a request for kept objects must name.
CREATE INDEX lost ON objects (id) WHERE state IN ('evicted', 'quarantined') AND on_request;
CREATE INDEX settled ON objects (settled_ns) WHERE state IN ('delivered', 'deduplicated', 'evicted');
-- The past of a sensor by either of its two times, which the live page seeks in.
CREATE INDEX begun ON objects (sensor, t_start_ns);
CREATE INDEX arrived ON objects (sensor, ifnull(CASE WHEN json_valid(metadata)
  THEN CAST(json_extract(metadata, '$.received_start_ns') AS INTEGER) END, t_start_ns));

-- Messages by topic of an object that has several (a bag's slice).
CREATE TABLE contents (
  id INTEGER NOT NULL,
  topic TEXT NOT NULL,
  samples INTEGER NOT NULL,
  PRIMARY KEY (id, topic)) WITHOUT ROWID;

-- Totals by topic ('' for bookkeeping) and state; state 'spooled' counts all. Objects may be forgotten without a total changing.
CREATE TABLE tally (
  topic TEXT NOT NULL,
  state TEXT NOT NULL,
  objects INTEGER NOT NULL DEFAULT 0,
  bytes INTEGER NOT NULL DEFAULT 0,
  samples INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (topic, state)) WITHOUT ROWID;

CREATE TRIGGER object_counted AFTER INSERT ON objects BEGIN
  INSERT INTO tally VALUES (ifnull(NEW.topic, ''), 'spooled', 1, NEW.bytes, NEW.samples)
    ON CONFLICT DO UPDATE SET objects = objects + 1, bytes = bytes + NEW.bytes, samples = samples + NEW.samples;
  INSERT INTO tally VALUES (ifnull(NEW.topic, ''), NEW.state, 1, NEW.bytes, NEW.samples)
    ON CONFLICT DO UPDATE SET objects = objects + 1, bytes = bytes + NEW.bytes, samples = samples + NEW.samples;
END;
CREATE TRIGGER object_moved AFTER UPDATE OF state ON objects WHEN OLD.state <> NEW.state BEGIN
  UPDATE tally SET objects = objects - 1, bytes = bytes - OLD.bytes, samples = samples - OLD.samples
    WHERE topic = ifnull(OLD.topic, '') AND state = OLD.state;
  INSERT INTO tally VALUES (ifnull(NEW.topic, ''), NEW.state, 1, NEW.bytes, NEW.samples)
    ON CONFLICT DO UPDATE SET objects = objects + 1, bytes = bytes + NEW.bytes, samples = samples + NEW.samples;
END;
CREATE TRIGGER contents_counted AFTER INSERT ON contents BEGIN
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

-- Delivered objects without a row in any part of the catalog, and the statistics of their contents.
CREATE TABLE uncataloged (id INTEGER PRIMARY KEY);
CREATE TABLE statistics (id INTEGER PRIMARY KEY, packed BLOB NOT NULL);
-- Changes of kept objects that are in no part of the table of kept objects yet: 'kept', 'lost', or the step of thinning.
CREATE TABLE unreported (
  id INTEGER NOT NULL,
  state TEXT NOT NULL,
  PRIMARY KEY (id, state)) WITHOUT ROWID;

-- Requests for kept objects, and what became of each object that a request selected.
CREATE TABLE requests (
  id TEXT NOT NULL PRIMARY KEY,
  requester TEXT NOT NULL,
  priority INTEGER NOT NULL,
  made_ns INTEGER NOT NULL,
  expires_ns INTEGER NOT NULL,
  received_ns INTEGER NOT NULL,
  selection TEXT NOT NULL,      -- JSON (mailbox.py)
  state TEXT NOT NULL,          -- 'active', 'done', 'expired', 'cancelled' or 'refused'
  why TEXT NOT NULL,
  objects INTEGER NOT NULL,
  bytes INTEGER NOT NULL,
  unavailable TEXT NOT NULL,    -- JSON: matching objects that were lost before
  answers INTEGER NOT NULL,     -- the number of its newest durable answer ...
  answered_state TEXT NOT NULL, -- ... the state that answer reports ...
  answered_ns INTEGER NOT NULL) -- ... and when it was written
  WITHOUT ROWID;
CREATE TABLE requested (
  request TEXT NOT NULL,
  id INTEGER NOT NULL,
  bytes INTEGER NOT NULL,
  outcome TEXT NOT NULL,        -- the object's state, or 'unsent' once the request has ended
  PRIMARY KEY (request, id)) WITHOUT ROWID;
CREATE INDEX requested_objects ON requested (id);
CREATE INDEX requested_unreleased ON requested (request, id) WHERE outcome = 'kept';
CREATE INDEX requested_released ON requested (request, id, bytes) WHERE outcome = 'pending';

-- Bags that are not complete in the spool yet, their closed slices, and what is missing in them (model.RecordingRows).
CREATE TABLE recordings (
  owner TEXT NOT NULL,          -- the robot, or the name of `bag record`
  folder TEXT NOT NULL,
  facts TEXT NOT NULL,
  channels TEXT NOT NULL,
  PRIMARY KEY (owner, folder)) WITHOUT ROWID;
CREATE TABLE slices (
  owner TEXT NOT NULL,
  folder TEXT NOT NULL,
  number INTEGER NOT NULL,
  bytes INTEGER NOT NULL,
  sha256 TEXT NOT NULL,
  t_start_ns INTEGER NOT NULL,
  t_end_ns INTEGER NOT NULL,
  messages INTEGER NOT NULL,
  counts TEXT NOT NULL,
  PRIMARY KEY (owner, folder, number)) WITHOUT ROWID;
CREATE TABLE missing (
  owner TEXT NOT NULL,
  folder TEXT NOT NULL,
  place INTEGER NOT NULL,
  file TEXT NOT NULL,
  what TEXT NOT NULL,
  messages INTEGER,
  topic TEXT,
  reason TEXT,
  PRIMARY KEY (owner, folder, place)) WITHOUT ROWID;

-- The accounts. A session is one run of a process that counts messages.
CREATE TABLE sessions (
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  robot TEXT NOT NULL,
  boot_id TEXT NOT NULL,
  pid INTEGER NOT NULL,
  started_ns INTEGER NOT NULL,
  ended_ns INTEGER);
CREATE TABLE accounts (
  session INTEGER NOT NULL,
  topic TEXT NOT NULL,
  type TEXT NOT NULL,
  accounting TEXT NOT NULL,     -- the grade
  received INTEGER NOT NULL,
  skipped INTEGER NOT NULL,
  stored INTEGER NOT NULL,
  rejected TEXT NOT NULL,       -- JSON: messages by reason
  dropped TEXT NOT NULL,        -- JSON: messages by reason
  by_arrival TEXT NOT NULL,     -- JSON: messages dated by arrival, by the reason why their own time was not trusted
  corrected TEXT NOT NULL,      -- JSON: messages stored after a correction, by fault
  stamps TEXT NOT NULL,         -- JSON: what was unusual about its publishers' stamps (core/stamps.py, StampReport); '{}' if nothing
  last_stored_ns INTEGER NOT NULL,          -- of the newest durable sample: its stamp ...
  last_stored_received_ns INTEGER NOT NULL, -- ... and when it arrived
  first_ns INTEGER NOT NULL,
  newest_ns INTEGER NOT NULL,             -- of the newest message: the same two
  newest_received_ns INTEGER NOT NULL,
  complete_ns INTEGER NOT NULL,
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
CREATE TABLE publishers (
  session INTEGER NOT NULL,
  topic TEXT NOT NULL,
  publisher TEXT NOT NULL,
  first INTEGER,                -- sequence numbers
  last INTEGER,
  published INTEGER NOT NULL,
  received INTEGER NOT NULL,
  missed TEXT NOT NULL,         -- JSON: messages by cause
  last_ns INTEGER NOT NULL,     -- of the message with the number last
  last_received_ns INTEGER NOT NULL,
  PRIMARY KEY (session, topic, publisher)) WITHOUT ROWID;
-- Types under which a topic was published but not logged; messages is NULL if they were not counted.
CREATE TABLE other_types (
  session INTEGER NOT NULL,
  topic TEXT NOT NULL,
  type TEXT NOT NULL,
  publishers TEXT NOT NULL,     -- JSON: node names
  messages INTEGER,
  PRIMARY KEY (session, topic, type)) WITHOUT ROWID;
-- Messages without sequence numbers among the received ones of an account.
CREATE TABLE estimates (
  session INTEGER NOT NULL,
  topic TEXT NOT NULL,
  estimated INTEGER NOT NULL,
  unknown INTEGER NOT NULL,
  missed TEXT NOT NULL,         -- JSON: messages by cause
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
CREATE TABLE rhythms (
  topic TEXT NOT NULL PRIMARY KEY,
  publisher TEXT NOT NULL,
  source TEXT NOT NULL,         -- 'stamps' or 'counter:FIELD'
  period REAL NOT NULL,
  last INTEGER NOT NULL) WITHOUT ROWID;

-- The gap journal: what was lost, and when (gaps.py). Session 0 has the messages of lost objects.
CREATE TABLE gaps (
  session INTEGER NOT NULL,
  topic TEXT NOT NULL,
  kind TEXT NOT NULL,
  cause TEXT NOT NULL,
  grade TEXT NOT NULL,
  publisher TEXT NOT NULL,
  mission TEXT NOT NULL,
  begin_ns INTEGER NOT NULL,    -- from_ns, rounded down for gaps under a second; -1 without a time, -2 for a sum of forgotten rows
  from_ns INTEGER,              -- stamps of the messages around the gap ...
  to_ns INTEGER,
  received_from_ns INTEGER,     -- ... and when these two arrived
  received_to_ns INTEGER,
  count INTEGER NOT NULL,
  merged INTEGER NOT NULL,      -- gaps in this row
  version INTEGER NOT NULL,     -- increases with each change of any row
  PRIMARY KEY (session, topic, kind, cause, grade, begin_ns, publisher, mission)) WITHOUT ROWID;
CREATE INDEX gaps_changed ON gaps (version);
CREATE INDEX gaps_begun ON gaps (begin_ns);
-- Up to which version a robot's journal has been reported to the store, and how often an operator requested to resend it.
CREATE TABLE gaps_reported (
  robot TEXT NOT NULL PRIMARY KEY,
  version INTEGER NOT NULL,
  again INTEGER NOT NULL) WITHOUT ROWID;

-- The messages of every object, one row per topic.
CREATE VIEW messages AS
  SELECT objects.id, ifnull(objects.topic, contents.topic) AS topic, ifnull(contents.samples, objects.samples) AS samples,
    state, ifnull(reason, '') AS reason, mission, t_start_ns, t_end_ns,
    CAST(json_extract(metadata, '$.received_start_ns') AS INTEGER) AS received_start_ns,
    CAST(json_extract(metadata, '$.received_end_ns') AS INTEGER) AS received_end_ns,
    CASE WHEN t_end_ns - t_start_ns < 1000000000 THEN t_start_ns / 1000000000 * 1000000000 ELSE t_start_ns END AS begin_ns
  FROM objects LEFT JOIN contents ON contents.id = objects.id AND objects.topic IS NULL
  WHERE ifnull(objects.topic, contents.topic) IS NOT NULL AND ifnull(contents.samples, objects.samples) > 0;

-- Messages inserted here are added to their row of gaps.
CREATE VIEW lost_messages AS SELECT * FROM messages;
CREATE TRIGGER messages_lost INSTEAD OF INSERT ON lost_messages BEGIN
  INSERT INTO gaps VALUES (0, NEW.topic, NEW.state, NEW.reason, 'exact', '', NEW.mission, NEW.begin_ns, NEW.t_start_ns, NEW.t_end_ns,
      NEW.received_start_ns, NEW.received_end_ns, NEW.samples, 1, (SELECT ifnull(max(version), 0) + 1 FROM gaps))
    ON CONFLICT DO UPDATE SET version = excluded.version, count = count + excluded.count, merged = merged + excluded.merged,
      from_ns = CASE WHEN count > 0 THEN min(from_ns, excluded.from_ns) ELSE excluded.from_ns END,
      to_ns = CASE WHEN count > 0 THEN max(to_ns, excluded.to_ns) ELSE excluded.to_ns END,
      received_from_ns = CASE WHEN count > 0 THEN min(received_from_ns, excluded.received_from_ns)
        ELSE excluded.received_from_ns END,
      received_to_ns = CASE WHEN count > 0 THEN max(received_to_ns, excluded.received_to_ns) ELSE excluded.received_to_ns END;
END;
CREATE TRIGGER object_lost AFTER INSERT ON objects WHEN NEW.state IN ('evicted', 'quarantined') BEGIN
  INSERT INTO lost_messages SELECT * FROM messages WHERE id = NEW.id;
END;
CREATE TRIGGER contents_lost AFTER INSERT ON contents
    WHEN (SELECT state FROM objects WHERE id = NEW.id) IN ('evicted', 'quarantined') BEGIN
  INSERT INTO lost_messages SELECT * FROM messages WHERE id = NEW.id AND topic = NEW.topic;
END;
-- A lost object may be found, or lost for another reason: subtract its messages from their row, or from the sum that contains it.
CREATE TRIGGER object_found BEFORE UPDATE OF state, reason ON objects
    WHEN OLD.state IN ('evicted', 'quarantined') AND (OLD.state <> NEW.state OR OLD.reason IS NOT NEW.reason) BEGIN
  UPDATE gaps SET version = (SELECT ifnull(max(version), 0) + 1 FROM gaps), merged = max(0, merged - 1), count = count - lost.samples
    FROM (SELECT messages.*, EXISTS (
        SELECT 1 FROM gaps AS own WHERE own.session = 0 AND own.topic = messages.topic AND own.kind = messages.state
          AND own.cause = messages.reason AND own.grade = 'exact' AND own.begin_ns = messages.begin_ns AND own.publisher = ''
          AND own.mission = messages.mission) AS is_known FROM messages WHERE id = OLD.id) AS lost
    WHERE session = 0 AND gaps.topic = lost.topic AND kind = lost.state AND cause = lost.reason AND grade = 'exact'
      AND publisher = '' AND gaps.begin_ns = iif(lost.is_known, lost.begin_ns, -2)
      AND gaps.mission = iif(lost.is_known, lost.mission, '');
END;
CREATE TRIGGER object_lost_later AFTER UPDATE OF state, reason ON objects
    WHEN NEW.state IN ('evicted', 'quarantined') AND (OLD.state <> NEW.state OR OLD.reason IS NOT NEW.reason) BEGIN
  INSERT INTO lost_messages SELECT * FROM messages WHERE id = NEW.id;
END;

PRAGMA user_version = 1;
