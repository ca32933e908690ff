-- One row per move, so that what an alias has pointed at stays known; the largest generation counts.
CREATE TABLE aliases (
    alias      TEXT NOT NULL,
    generation BIGINT NOT NULL,                  -- counts from 1
    model_id   TEXT NOT NULL REFERENCES models (id),
    moved_ms   BIGINT NOT NULL,
    PRIMARY KEY (alias, generation)
);
