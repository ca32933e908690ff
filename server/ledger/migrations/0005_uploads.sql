-- Data sets that a job is putting into the store: announced before the first object, so that what an attempt
-- left behind can be told from what another one is putting right now. The row without a job is there to be
-- locked.

CREATE TABLE uploads (
    dataset_id TEXT NOT NULL,
    job_id TEXT NOT NULL,
    PRIMARY KEY (dataset_id, job_id)
);
