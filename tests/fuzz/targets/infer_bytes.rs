//! Open Inference Protocol, binary tensors: two bytes say how long the JSON is.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    hydroflex_fuzz::service::infer_bytes(data);
});
