//! Steps allocate nothing: a run of twice the length allocates as often as a run of the length.

#![allow(
    unsafe_code,
    reason = "a counting allocator has to implement the unsafe trait GlobalAlloc"
)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use hydroflex_openapi::job::Integrator;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunInput, RunSettings};

thread_local! {
    // Per thread: the test harness's own thread allocates when it likes.
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // A thread that ends has no counter any more; nobody asks for its count.
        let _ = COUNT.try_with(|c| c.set(c.get() + 1));
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A rigid arm with one cylinder: no mesh, the same step loop.
const MACHINE: &str = include_str!("../src/testing_rig.toml");

#[test]
fn the_step_loop_does_not_allocate() {
    let simulator = Simulator::new(Machine::from_toml(MACHINE, &[]).unwrap()).unwrap();
    let input = |samples: usize| RunInput {
        run_id: 0,
        payload_kg: 50.0,
        angles_rad: vec![0.2],
        valves_ratio: vec![(0..samples).map(|k| libm::sin(k as f64 * 1.3)).collect()],
    };
    for integrator in [
        Integrator::TrapezoidalIndex2 { step_s: 0.001 },
        Integrator::GeneralizedAlpha { step_s: 0.001 },
    ] {
        let settings = RunSettings {
            integrator,
            sample_time_s: 0.005,
        };
        let allocations = |samples: usize| {
            let input = input(samples);
            let before = COUNT.with(Cell::get);
            simulator.run(&input, &settings).unwrap();
            COUNT.with(Cell::get) - before
        };
        allocations(10);
        let (short, long) = (allocations(50), allocations(500));
        assert!(short > 0, "the counter counts");
        assert_eq!(short, long);
    }
}

/// The same of the accurate integrator, alone and with runs side by side.
#[test]
fn the_accurate_step_loop_does_not_allocate() {
    let simulator = Simulator::new(Machine::load("lift-boom", &[]).unwrap()).unwrap();
    simulator.prepare(true).unwrap();
    let settings = RunSettings {
        integrator: Integrator::Accurate,
        sample_time_s: 0.005,
    };
    for together in [1_u32, 8] {
        let allocations = |samples: u32| {
            // Zero crossings, so that steps are cut and rejected too.
            let inputs: Vec<RunInput> = (0..together)
                .map(|i| RunInput {
                    run_id: u64::from(i),
                    payload_kg: 60.0,
                    angles_rad: vec![0.1 + 0.05 * f64::from(i)],
                    valves_ratio: vec![
                        (0..samples)
                            .map(|k| libm::sin(0.7 * f64::from(k + 3 * i)))
                            .collect(),
                    ],
                })
                .collect();
            let before = COUNT.with(Cell::get);
            let results = simulator.run_batch(&inputs, &settings);
            let after = COUNT.with(Cell::get);
            assert!(results.iter().all(Result::is_ok));
            after - before
        };
        allocations(10);
        let (short, long) = (allocations(100), allocations(200));
        assert!(short > 0, "the counter counts");
        assert_eq!(short, long, "{together} runs together");
    }
}
