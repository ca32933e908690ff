-- A sweep is a request and its trainings: what state it is in follows from theirs.

CREATE TABLE sweeps (
    id         TEXT PRIMARY KEY,
    dataset_id TEXT NOT NULL REFERENCES datasets (id),
    spec       TEXT NOT NULL,
    created_ms BIGINT NOT NULL
);
ALTER TABLE trainings ADD COLUMN sweep_id TEXT REFERENCES sweeps (id);
CREATE INDEX trainings_sweep ON trainings (sweep_id, id);
