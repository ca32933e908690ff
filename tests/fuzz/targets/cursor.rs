//! Cursors and queries of lists.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::query(data);
});
