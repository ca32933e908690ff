-- How often a job was begun again by a retry: a publisher that was stopped across one must not publish what
-- it read before.

ALTER TABLE jobs ADD COLUMN round BIGINT NOT NULL DEFAULT 0;
