//! Messages of a live session: a first odd byte makes it text.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::message(data);
});
