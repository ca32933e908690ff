-- One text for SQLite and PostgreSQL: TEXT, BIGINT and DOUBLE PRECISION only, times as
-- milliseconds since 1970, JSON as TEXT, identifiers and hashes as the contract writes them.

CREATE TABLE jobs (
    id               TEXT PRIMARY KEY,           -- time-ordered UUID
    state            TEXT NOT NULL,
    priority         BIGINT NOT NULL,
    spec             TEXT NOT NULL,
    machine_sha256   TEXT NOT NULL,
    runs             BIGINT NOT NULL,
    settling_runs    BIGINT NOT NULL,
    runs_planned     BIGINT NOT NULL DEFAULT 0,  -- runs 0..runs_planned are cut into shards
    settling_planned BIGINT NOT NULL DEFAULT 0,
    runs_done        BIGINT NOT NULL DEFAULT 0,
    runs_failed      BIGINT NOT NULL DEFAULT 0,
    settling_done    BIGINT NOT NULL DEFAULT 0,
    simulate_s       DOUBLE PRECISION NOT NULL DEFAULT 0,
    encode_s         DOUBLE PRECISION NOT NULL DEFAULT 0,
    put_s            DOUBLE PRECISION NOT NULL DEFAULT 0,
    last_sequence    BIGINT NOT NULL DEFAULT 0,  -- of its events
    reason           TEXT,
    dataset_id       TEXT,
    collected        BIGINT NOT NULL DEFAULT 0,  -- 1 when its shard objects are deleted
    created_ms       BIGINT NOT NULL,
    started_ms       BIGINT,
    finished_ms      BIGINT
);
CREATE INDEX jobs_state ON jobs (state);

-- A worker is one process start; its name is never used again.
CREATE TABLE workers (
    name       TEXT PRIMARY KEY,
    state      TEXT NOT NULL,                    -- alive, gone
    beat       BIGINT NOT NULL,                  -- counts up while the process lives
    started_ms BIGINT NOT NULL
);

CREATE TABLE shards (
    id          TEXT PRIMARY KEY,
    job_id      TEXT NOT NULL REFERENCES jobs (id),
    kind        TEXT NOT NULL,                   -- runs, settling
    first_run   BIGINT NOT NULL,
    run_count   BIGINT NOT NULL,
    state       TEXT NOT NULL,                   -- open, running, committed, halved, dead, cancelled
    epoch       BIGINT NOT NULL DEFAULT 0,       -- fencing token: one more with every begin
    attempt     BIGINT NOT NULL DEFAULT 0,
    worker      TEXT,
    object      TEXT,
    sha256      TEXT,
    size_bytes  BIGINT,
    is_half     BIGINT NOT NULL DEFAULT 0,       -- 1 if it came from halving
    failed_runs BIGINT NOT NULL DEFAULT 0,
    simulate_s  DOUBLE PRECISION,
    reason      TEXT
);
CREATE INDEX shards_state ON shards (state, job_id, kind, first_run);
CREATE INDEX shards_order ON shards (job_id, kind, first_run);

CREATE TABLE events (
    job_id   TEXT NOT NULL REFERENCES jobs (id),
    sequence BIGINT NOT NULL,
    at_ms    BIGINT NOT NULL,
    body     TEXT NOT NULL,
    PRIMARY KEY (job_id, sequence)
);

CREATE TABLE datasets (
    id         TEXT PRIMARY KEY,                 -- first half of sha256
    sha256     TEXT NOT NULL,
    job_id     TEXT NOT NULL REFERENCES jobs (id),
    spec       TEXT NOT NULL,
    runs       BIGINT NOT NULL,
    files      TEXT NOT NULL,                    -- JSON: path, size_bytes, sha256
    created_ms BIGINT NOT NULL
);
CREATE INDEX datasets_created ON datasets (created_ms, id);

CREATE TABLE trainings (
    id          TEXT PRIMARY KEY,
    job_id      TEXT REFERENCES jobs (id),
    dataset_id  TEXT NOT NULL REFERENCES datasets (id),
    spec        TEXT NOT NULL,
    state       TEXT NOT NULL,
    epoch       BIGINT NOT NULL DEFAULT 0,
    attempt     BIGINT NOT NULL DEFAULT 0,
    worker      TEXT,
    progress    TEXT,
    reason      TEXT,
    model_id    TEXT,
    created_ms  BIGINT NOT NULL,
    finished_ms BIGINT
);
CREATE INDEX trainings_job ON trainings (job_id);
CREATE INDEX trainings_state ON trainings (state);

CREATE TABLE models (
    id          TEXT PRIMARY KEY,                -- first half of sha256
    sha256      TEXT NOT NULL,
    training_id TEXT NOT NULL REFERENCES trainings (id),
    dataset_id  TEXT NOT NULL REFERENCES datasets (id),
    spec        TEXT NOT NULL,
    metrics     TEXT NOT NULL,
    files       TEXT NOT NULL,
    created_ms  BIGINT NOT NULL
);
CREATE INDEX models_created ON models (created_ms, id);

CREATE TABLE idempotency_keys (
    key         TEXT PRIMARY KEY,
    body_sha256 TEXT NOT NULL,
    resource    TEXT NOT NULL,                   -- identifier of what the first request made
    created_ms  BIGINT NOT NULL
);
