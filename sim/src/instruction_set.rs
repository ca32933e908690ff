//! The instruction-set level on which numbers depend in their last digits.
//!
//! The linear algebra and the fast path choose their kernels when they run, by what the processor
//! has. A data set names the level it was made on; on another one it may differ by rounding.

/// `x86-64-v4` (AVX-512), `x86-64-v3` (AVX2 and FMA), `x86-64`, or the name of another architecture.
#[must_use]
pub fn level() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        let v3 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        let v4 = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512cd")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl");
        match (v3, v4) {
            (true, true) => "x86-64-v4",
            (true, false) => "x86-64-v3",
            (false, _) => "x86-64",
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        std::env::consts::ARCH
    }
}
