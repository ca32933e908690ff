//! Specifications of jobs, and whether their runs can be drawn.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::job(data);
});
