//! The step loop of the accurate integrator leaves the heap alone: a run of twice the length
//! allocates exactly as often.
#![allow(
    unsafe_code,
    reason = "an allocator is unsafe by nature; this one counts and passes on"
)]

use hydroflex_openapi::job::Integrator;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunInput, RunSettings};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    // Per thread: a process-wide count would also see the test harness.
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: every call is passed on unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract is passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's contract is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

fn runs(count: usize, samples: usize) -> Vec<RunInput> {
    (0..count)
        .map(|i| RunInput {
            run_id: i as u64,
            payload_kg: 60.0,
            angles_rad: vec![0.1 + 0.05 * i as f64],
            // Zero crossings, so that steps are cut and rejected too.
            valves_ratio: vec![(0..samples).map(|k| (0.7 * (k + 3 * i) as f64).sin()).collect()],
        })
        .collect()
}

#[test]
fn a_longer_run_allocates_no_more_often() {
    let simulator = Simulator::new(Machine::load("lift-boom", &[]).unwrap()).unwrap();
    let settings = RunSettings {
        integrator: Integrator::Accurate,
        sample_time_s: 0.005,
    };
    simulator.prepare(true).unwrap();
    for runs_together in [1, 8] {
        let count = |samples: usize| {
            let inputs = runs(runs_together, samples);
            let before = ALLOCATIONS.get();
            let results = simulator.run_batch(&inputs, &settings);
            let after = ALLOCATIONS.get();
            assert!(
                results
                    .iter()
                    .all(|r| r.as_ref().unwrap().sample_count == samples + 1)
            );
            after - before
        };
        count(10);
        let (short, long) = (count(100), count(200));
        assert!(short > 0, "the counter counts");
        assert_eq!(short, long, "{runs_together} runs together");
    }
}
