//! What coordinator and workers share: jobs, shards, epochs, events and blobs
