//! Trainings over REST.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::post("trainings", "application/json", data);
});
