-- API keys: 256 random bits each, of which only the hash is kept.

CREATE TABLE api_keys (
    id         TEXT PRIMARY KEY,                 -- time-ordered UUID: names the key to people
    title      TEXT NOT NULL,
    sha256     TEXT NOT NULL UNIQUE,
    scopes     TEXT NOT NULL,                    -- JSON list: submit, read, predict, admin
    created_ms BIGINT NOT NULL,
    expires_ms BIGINT,                           -- NULL: never
    revoked_ms BIGINT                            -- NULL: not revoked
);

-- What workers wait for between their shards of a job: the ledger, and the next shard.
ALTER TABLE jobs ADD COLUMN wait_s DOUBLE PRECISION NOT NULL DEFAULT 0;
