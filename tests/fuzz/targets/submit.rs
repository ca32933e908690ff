//! Jobs over REST.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::post("jobs", "application/json", data);
});
