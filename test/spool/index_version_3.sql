BEGIN TRANSACTION;
CREATE TABLE accounts (
  session INTEGER NOT NULL, topic TEXT NOT NULL, type TEXT NOT NULL, accounting TEXT NOT NULL,
  received INTEGER NOT NULL, skipped INTEGER NOT NULL, stored INTEGER NOT NULL,
  rejected TEXT NOT NULL, dropped TEXT NOT NULL, last_kept_ns INTEGER NOT NULL,
  PRIMARY KEY (session, topic)) WITHOUT ROWID;
INSERT INTO "accounts" VALUES(1,'/odom','nav_msgs/msg/Odometry','exact',5,3,2,'{}','{}',1760788800000000000);
INSERT INTO "accounts" VALUES(2,'/imu','','received-only',20,20,0,'{}','{}',0);
INSERT INTO "accounts" VALUES(2,'/never','x/msg/Y','exact',0,0,0,'{}','{}',0);
INSERT INTO "accounts" VALUES(2,'/odom','nav_msgs/msg/Odometry','reported',10,10,0,'{}','{}',0);
INSERT INTO "accounts" VALUES(2,'bag:/odom','nav_msgs/msg/Odometry','reported',10,0,0,'{}','{}',0);
INSERT INTO "accounts" VALUES(2,'event:/map','','exact',2,2,0,'{}','{}',0);
CREATE TABLE contents (
  id INTEGER NOT NULL, topic TEXT NOT NULL, samples INTEGER NOT NULL, PRIMARY KEY (id, topic)) WITHOUT ROWID;
CREATE TABLE objects (
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  bucket TEXT NOT NULL, key TEXT NOT NULL,
  state TEXT NOT NULL CHECK (state IN ('pending', 'held', 'delivered', 'evicted', 'quarantined', 'deduplicated')), reason TEXT,
  priority INTEGER NOT NULL, protected INTEGER NOT NULL,
  sensor TEXT NOT NULL, topic TEXT, type TEXT NOT NULL,
  samples INTEGER NOT NULL, bytes INTEGER NOT NULL, sha256 TEXT NOT NULL,
  content_type TEXT NOT NULL, metadata TEXT NOT NULL,
  t_start_ns INTEGER NOT NULL, t_end_ns INTEGER NOT NULL,
  created_ns INTEGER NOT NULL, settled_ns INTEGER,
  UNIQUE (bucket, key));
INSERT INTO "objects" VALUES(1,'sensor-data','thor/odom/a.json','pending',NULL,5,0,'odom','/odom','sensor_msgs/msg/CompressedImage',2,7,'ed7002b439e9ac845f22357d822bac1444730fbdb6016d3ec9432297b9ec9f73','image/jpeg','{"sensor": "odom", "topic": "/odom", "type": "sensor_msgs/msg/CompressedImage", "count": "2", "t_start_ns": "1760788800000000000", "t_end_ns": "1760788800000000000", "sha256": "ed7002b439e9ac845f22357d822bac1444730fbdb6016d3ec9432297b9ec9f73"}',1760788800000000000,1760788800000000000,1760788800000000000,NULL);
INSERT INTO "objects" VALUES(2,'sensor-data','thor/imu/h.json','held','clock',5,0,'imu',NULL,'sensor_msgs/msg/CompressedImage',1,4,'c20dea4d876b5b8fb0a1814b43017030cea6d4ac30b2d9ae71b404d2faba49b5','image/jpeg','{"sensor": "imu", "t_start_ns": "1760788800000000000", "t_end_ns": "1760788800000000000", "sha256": "c20dea4d876b5b8fb0a1814b43017030cea6d4ac30b2d9ae71b404d2faba49b5"}',1760788800000000000,1760788800000000000,1760788800000000000,NULL);
CREATE TABLE publishers (
  session INTEGER NOT NULL, topic TEXT NOT NULL, publisher TEXT NOT NULL, first INTEGER, last INTEGER,
  published INTEGER NOT NULL, received INTEGER NOT NULL, missed TEXT NOT NULL,
  PRIMARY KEY (session, topic, publisher)) WITHOUT ROWID;
INSERT INTO "publishers" VALUES(1,'/odom','p',1,7,7,5,'{"transport": 2}');
INSERT INTO "publishers" VALUES(2,'/odom','',NULL,NULL,14,10,'{"transport": 4}');
INSERT INTO "publishers" VALUES(2,'bag:/odom','',NULL,NULL,11,10,'{"transport": 1}');
INSERT INTO "publishers" VALUES(2,'event:/map','q',5,9,5,2,'{"transport": 3}');
CREATE TABLE sessions (
  id INTEGER PRIMARY KEY AUTOINCREMENT, robot TEXT NOT NULL, boot_id TEXT NOT NULL, pid INTEGER NOT NULL,
  started_ns INTEGER NOT NULL, ended_ns INTEGER);
INSERT INTO "sessions" VALUES(1,'thor','a-boot',16719,1760788800000000000,1760788800000000000);
INSERT INTO "sessions" VALUES(2,'thor','a-boot',16719,1760788800000000000,1760788800000000000);
CREATE TABLE tally (
  topic TEXT NOT NULL, state TEXT NOT NULL,
  objects INTEGER NOT NULL DEFAULT 0, bytes INTEGER NOT NULL DEFAULT 0, samples INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (topic, state)) WITHOUT ROWID;
INSERT INTO "tally" VALUES('','held',1,4,1);
INSERT INTO "tally" VALUES('','spooled',1,4,1);
INSERT INTO "tally" VALUES('/odom','pending',1,7,2);
INSERT INTO "tally" VALUES('/odom','spooled',1,7,2);
CREATE TABLE uncatalogued (id INTEGER PRIMARY KEY);
CREATE INDEX pending ON objects (bucket, priority, id) WHERE state = 'pending';
CREATE INDEX waiting ON objects (bucket, id) WHERE state = 'pending';
CREATE INDEX held ON objects (reason, id) WHERE state = 'held';
CREATE INDEX evictable ON objects (priority DESC, id, bytes) WHERE state IN ('pending', 'held') AND NOT protected;
CREATE INDEX quarantined ON objects (reason, bytes) WHERE state = 'quarantined';
CREATE INDEX settled ON objects (settled_ns) WHERE state IN ('delivered', 'deduplicated', 'evicted');
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
CREATE TRIGGER arrived AFTER UPDATE OF state ON objects
    WHEN NEW.state IN ('delivered', 'deduplicated') AND OLD.state <> NEW.state AND NEW.sensor <> '_catalog' BEGIN
  INSERT OR IGNORE INTO uncatalogued VALUES (NEW.id);
END;
CREATE TRIGGER known AFTER INSERT ON objects WHEN NEW.state IN ('delivered', 'deduplicated') AND NEW.sensor <> '_catalog' BEGIN
  INSERT OR IGNORE INTO uncatalogued VALUES (NEW.id);
END;
CREATE TRIGGER forgotten AFTER DELETE ON objects BEGIN
  DELETE FROM uncatalogued WHERE id = OLD.id;
END;
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
DELETE FROM "sqlite_sequence";
INSERT INTO "sqlite_sequence" VALUES('sessions',2);
INSERT INTO "sqlite_sequence" VALUES('objects',2);
COMMIT;
PRAGMA user_version = 3;
