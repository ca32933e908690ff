//! The step loop compiled for several instruction sets, chosen at run time.
//!
//! All of them compute the same bits: no operation depends on the width of the registers.

use super::constants::Constants;
use super::lockstep::{Common, OwnBodies, RunResult, simulate};
use super::model::PlanarModel;
use super::step::StepBuffer;
use crate::instruction_set::InstructionSet;
use crate::trajectory::RunInput;

/// One run after the other.
pub(super) fn one_by_one<const A: usize, const B: usize, const Q: usize>(
    set: InstructionSet,
    c: &Constants<f64, A, B, Q>,
    common: &Common,
    inputs: &[RunInput],
    jobs: &[usize],
    results: &mut [Option<RunResult>],
) {
    let buffer = &mut StepBuffer::<f64, A, B, Q>::new();
    match set {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the caller's set comes from `detect` or is checked against it.
        #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
        InstructionSet::Avx512 => unsafe {
            x86::one_by_one_avx512(c, common, inputs, jobs, buffer, results);
        },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
        InstructionSet::Avx2 => unsafe {
            x86::one_by_one_avx2(c, common, inputs, jobs, buffer, results);
        },
        _ => simulate(&mut &*c, common, inputs, jobs, buffer, results),
    }
}

/// As many runs at a time as a register holds.
pub(super) fn side_by_side<const A: usize, const B: usize, const Q: usize>(
    set: InstructionSet,
    c: &Constants<f64, A, B, Q>,
    common: &Common,
    inputs: &[RunInput],
    jobs: &[usize],
    results: &mut [Option<RunResult>],
) {
    match set {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the caller's set comes from `detect` or is checked against it.
        #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
        InstructionSet::Avx512 => unsafe {
            x86::side_by_side_avx512(c, common, inputs, jobs, results);
        },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
        InstructionSet::Avx2 => unsafe {
            x86::side_by_side_avx2(c, common, inputs, jobs, results);
        },
        _ => one_by_one(set, c, common, inputs, jobs, results),
    }
}

/// The same for runs of different payloads. Leaves runs without a result where there are no lanes, and
/// those with too many modes.
pub(super) fn mixed<const A: usize, const B: usize, const Q: usize>(
    set: InstructionSet,
    model: &PlanarModel,
    common: &Common,
    inputs: &[RunInput],
    jobs: &[usize],
    results: &mut [Option<RunResult>],
) {
    match set {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the caller's set comes from `detect` or is checked against it.
        #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
        InstructionSet::Avx512 => unsafe {
            x86::mixed_avx512::<A, B, Q>(model, common, inputs, jobs, results);
        },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        #[allow(unsafe_code, reason = "calls code for a detected instruction set")]
        InstructionSet::Avx2 => unsafe {
            x86::mixed_avx2::<A, B, Q>(model, common, inputs, jobs, results);
        },
        _ => {}
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::super::lane_x86::{Pack4, Pack8};
    use super::{Common, Constants, OwnBodies, PlanarModel, RunInput, RunResult, StepBuffer, simulate};

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx2")]
    pub(super) fn one_by_one_avx512<const A: usize, const B: usize, const Q: usize>(
        c: &Constants<f64, A, B, Q>,
        common: &Common,
        inputs: &[RunInput],
        jobs: &[usize],
        buffer: &mut StepBuffer<f64, A, B, Q>,
        results: &mut [Option<RunResult>],
    ) {
        simulate(&mut &*c, common, inputs, jobs, buffer, results);
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn one_by_one_avx2<const A: usize, const B: usize, const Q: usize>(
        c: &Constants<f64, A, B, Q>,
        common: &Common,
        inputs: &[RunInput],
        jobs: &[usize],
        buffer: &mut StepBuffer<f64, A, B, Q>,
        results: &mut [Option<RunResult>],
    ) {
        simulate(&mut &*c, common, inputs, jobs, buffer, results);
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx2")]
    pub(super) fn side_by_side_avx512<const A: usize, const B: usize, const Q: usize>(
        c: &Constants<f64, A, B, Q>,
        common: &Common,
        inputs: &[RunInput],
        jobs: &[usize],
        results: &mut [Option<RunResult>],
    ) {
        let mut buffer = Box::new(StepBuffer::<Pack8, A, B, Q>::new());
        simulate(&mut &*c, common, inputs, jobs, &mut buffer, results);
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn side_by_side_avx2<const A: usize, const B: usize, const Q: usize>(
        c: &Constants<f64, A, B, Q>,
        common: &Common,
        inputs: &[RunInput],
        jobs: &[usize],
        results: &mut [Option<RunResult>],
    ) {
        let mut buffer = Box::new(StepBuffer::<Pack4, A, B, Q>::new());
        simulate(&mut &*c, common, inputs, jobs, &mut buffer, results);
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx2")]
    pub(super) fn mixed_avx512<const A: usize, const B: usize, const Q: usize>(
        model: &PlanarModel,
        common: &Common,
        inputs: &[RunInput],
        jobs: &[usize],
        results: &mut [Option<RunResult>],
    ) {
        let mut buffer = Box::new(StepBuffer::<Pack8, A, B, Q>::new());
        let mut bodies = OwnBodies::new(model, common.tolerance);
        simulate(&mut bodies, common, inputs, jobs, &mut buffer, results);
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn mixed_avx2<const A: usize, const B: usize, const Q: usize>(
        model: &PlanarModel,
        common: &Common,
        inputs: &[RunInput],
        jobs: &[usize],
        results: &mut [Option<RunResult>],
    ) {
        let mut buffer = Box::new(StepBuffer::<Pack4, A, B, Q>::new());
        let mut bodies = OwnBodies::new(model, common.tolerance);
        simulate(&mut bodies, common, inputs, jobs, &mut buffer, results);
    }
}
