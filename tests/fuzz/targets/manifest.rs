//! Manifests of data sets.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let _ = serde_json::from_slice::<hydroflex_openapi::dataset::Manifest>(data);
});
