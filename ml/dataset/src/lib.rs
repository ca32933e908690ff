//! Trajectory data sets on disk: shards in, published Parquet out
