-- The state of a coordinator. Times are RFC 3339 in UTC; digests name blobs in the store beside this file.

CREATE TABLE jobs (
    id              TEXT PRIMARY KEY,           -- sorts by time of submission
    state           TEXT NOT NULL,              -- ingesting, static-model, tracking, frames, assembling, done, failed, cancelled
    failure_kind    TEXT NOT NULL DEFAULT '',   -- set when failed
    failure_message TEXT NOT NULL DEFAULT '',
    clip            TEXT NOT NULL,
    clip_digest     TEXT NOT NULL,
    output          TEXT NOT NULL,              -- folder of the results
    output_request  TEXT NOT NULL,              -- as submitted; empty: the coordinator chose
    settings        TEXT NOT NULL,              -- every setting, JSON
    settings_digest TEXT NOT NULL,              -- over settings, frames, test views, static model and track source
    request         TEXT NOT NULL,              -- frames, test views, static model and track source, JSON
    frame_numbers   TEXT NOT NULL,              -- JSON list; the first is the key frame
    static_digest   TEXT NOT NULL DEFAULT '',
    static_size     INTEGER NOT NULL DEFAULT 0,
    static_report   TEXT NOT NULL DEFAULT '',
    last_sequence   INTEGER NOT NULL DEFAULT 0, -- of the job's events
    submitted_at    TEXT NOT NULL,
    changed_at      TEXT NOT NULL,
    UNIQUE (clip_digest, settings_digest, output_request)
);

CREATE TABLE views (
    job_id   TEXT NOT NULL REFERENCES jobs (id),
    position INTEGER NOT NULL,
    name     TEXT NOT NULL,
    held_out INTEGER NOT NULL,
    camera   TEXT NOT NULL,                     -- JSON
    PRIMARY KEY (job_id, position)
);

CREATE TABLE images (
    job_id       TEXT NOT NULL REFERENCES jobs (id),
    frame        INTEGER NOT NULL,
    position     INTEGER NOT NULL,              -- of the view
    image_digest TEXT NOT NULL,
    image_size   INTEGER NOT NULL,
    mask_digest  TEXT NOT NULL DEFAULT '',      -- empty: no mask
    mask_size    INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (job_id, frame, position)
);

-- What workers do: frames, and the tracks of views.
CREATE TABLE tasks (
    job_id        TEXT NOT NULL REFERENCES jobs (id),
    kind          TEXT NOT NULL,                -- frame, tracks
    number        INTEGER NOT NULL,             -- of the frame, or position of the view
    state         TEXT NOT NULL,                -- ready, leased, done, failed, cancelled
    attempts      INTEGER NOT NULL DEFAULT 0,   -- leases given
    failures      INTEGER NOT NULL DEFAULT 0,   -- attempts that failed
    excluded      TEXT NOT NULL DEFAULT '[]',   -- workers that lack the resources, JSON list
    worker        TEXT NOT NULL DEFAULT '',     -- of the last attempt
    seconds       REAL NOT NULL DEFAULT 0,      -- from lease to result
    changed_at    TEXT NOT NULL,
    -- Of frames only; the fields of tracks are artifacts.
    request       BLOB NOT NULL DEFAULT X'',    -- the frame job, protobuf
    result_key    TEXT NOT NULL DEFAULT '',     -- names the result among the artifacts
    delta_digest  TEXT NOT NULL DEFAULT '',     -- set when done
    delta_size    INTEGER NOT NULL DEFAULT 0,
    report        TEXT NOT NULL DEFAULT '',     -- JSON, set when done
    stage_seconds TEXT NOT NULL DEFAULT '{}',   -- JSON
    PRIMARY KEY (job_id, kind, number)
);

CREATE TABLE attempts (
    job_id     TEXT NOT NULL,
    kind       TEXT NOT NULL,
    number     INTEGER NOT NULL,
    attempt    INTEGER NOT NULL,
    lease_id   TEXT NOT NULL UNIQUE,
    worker     TEXT NOT NULL,
    granted_at TEXT NOT NULL,
    ended_at   TEXT NOT NULL DEFAULT '',
    outcome    TEXT NOT NULL DEFAULT 'running', -- running, done, released, cancelled, or the kind of failure
    message    TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (job_id, kind, number, attempt),
    FOREIGN KEY (job_id, kind, number) REFERENCES tasks (job_id, kind, number)
);

CREATE TABLE events (
    job_id       TEXT NOT NULL REFERENCES jobs (id),
    sequence     INTEGER NOT NULL,              -- from 1, without gaps
    at           TEXT NOT NULL,
    kind         TEXT NOT NULL,                 -- job, frame, tracks
    state        TEXT NOT NULL,
    number       INTEGER NOT NULL DEFAULT 0,    -- of the task
    view         TEXT NOT NULL DEFAULT '',      -- name, of tracks
    attempt      INTEGER NOT NULL DEFAULT 0,
    worker       TEXT NOT NULL DEFAULT '',
    failure_kind TEXT NOT NULL DEFAULT '',
    message      TEXT NOT NULL DEFAULT '',
    report       TEXT NOT NULL DEFAULT '',
    seconds      REAL NOT NULL DEFAULT 0,
    PRIMARY KEY (job_id, sequence)
) WITHOUT ROWID;

CREATE TABLE workers (
    id          TEXT PRIMARY KEY,
    incarnation TEXT NOT NULL,
    engine      TEXT NOT NULL,
    device      TEXT NOT NULL,
    threads     INTEGER NOT NULL,
    version     TEXT NOT NULL,
    connected   INTEGER NOT NULL,
    first_seen  TEXT NOT NULL,
    last_seen   TEXT NOT NULL
);

-- What was computed once and is used again: static models, track fields, frame results.
CREATE TABLE artifacts (
    key        TEXT PRIMARY KEY,                -- digest of everything that decides the content
    kind       TEXT NOT NULL,                   -- static-model, tracks, frame
    digest     TEXT NOT NULL,
    size       INTEGER NOT NULL,
    note       TEXT NOT NULL DEFAULT '',        -- report, JSON
    created_at TEXT NOT NULL
);

CREATE TABLE stages (
    job_id  TEXT NOT NULL REFERENCES jobs (id),
    stage   TEXT NOT NULL,
    seconds REAL NOT NULL,                      -- summed over restarts
    PRIMARY KEY (job_id, stage)
);
