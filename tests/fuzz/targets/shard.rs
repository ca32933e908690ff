//! Shards as workers put them into the store.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    if let Ok(runs) = hydroflex_dataset::ShardReader::open(data) {
        runs.take_while(Result::is_ok).for_each(drop);
    }
});
