//! Columns as an Arrow stream.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::post("predict", "application/vnd.apache.arrow.stream", data);
});
