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

/// Instruction set of what is compiled several times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstructionSet {
    /// What every machine of the architecture has.
    Portable,
    /// AVX2: four runs in lock-step on the fast path.
    Avx2,
    /// AVX-512: eight of them.
    Avx512,
}

impl InstructionSet {
    /// The widest that this machine has.
    #[must_use]
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
            {
                return Self::Avx512;
            }
            if is_x86_feature_detected!("avx2") {
                return Self::Avx2;
            }
        }
        Self::Portable
    }

    /// All that this machine has.
    #[must_use]
    pub fn available() -> Vec<Self> {
        match Self::detect() {
            Self::Portable => vec![Self::Portable],
            Self::Avx2 => vec![Self::Portable, Self::Avx2],
            Self::Avx512 => vec![Self::Portable, Self::Avx2, Self::Avx512],
        }
    }
}

/// A function that is compiled for every instruction set, and runs as the widest of this machine. All of them
/// compute the same bits: the compiler neither fuses nor reorders what is written.
macro_rules! widest {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)? $body:block) => {
        $(#[$meta])*
        $vis fn $name($($argument: $type),*) $(-> $result)? {
            #[allow(clippy::inline_always, reason = "has to be part of the function that enables the instructions")]
            #[inline(always)]
            fn portable($($argument: $type),*) $(-> $result)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx2")]
            fn avx512($($argument: $type),*) $(-> $result)? {
                portable($($argument),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2($($argument: $type),*) $(-> $result)? {
                portable($($argument),*)
            }
            match $crate::instruction_set::InstructionSet::detect() {
                // SAFETY: this machine was asked whether it has these instructions.
                #[cfg(target_arch = "x86_64")]
                #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
                $crate::instruction_set::InstructionSet::Avx512 => unsafe { avx512($($argument),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
                $crate::instruction_set::InstructionSet::Avx2 => unsafe { avx2($($argument),*) },
                _ => portable($($argument),*),
            }
        }
    };
}
pub(crate) use widest;
