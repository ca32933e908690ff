//! Meshes over REST.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::post("meshes", "text/plain", data);
});
