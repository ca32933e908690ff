//! Time from the mesh file to a body that is reduced already: `load_machine MACHINE [MESH]…`.
//!
//! ```text
//! cargo run --release -p hydroflex-sim --example load_machine -- lift-boom
//! ```
//!
//! The first load reduces the body and stores it in the cache; the smallest and the median of the following
//! ones are printed, with the part for reading and checking the mesh. Payload and no payload together.

#![allow(clippy::print_stdout, reason = "this program's output is its purpose")]

use hydroflex_sim::machine::Machine;
use std::time::Instant;

const REPETITIONS: usize = 15;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let machine = arguments.next().unwrap_or_else(|| "lift-boom".to_owned());
    let meshes: Vec<String> = arguments.collect();
    let cache = std::env::temp_dir().join(format!("hydroflex-load-{}", std::process::id()));
    let mut times_ms = Vec::new();
    for _ in 0..=REPETITIONS {
        let start = Instant::now();
        let loaded = Machine::load(&machine, &meshes)?;
        let read_ms = 1e3 * start.elapsed().as_secs_f64();
        for with_payload in [false, true] {
            std::hint::black_box(loaded.reduce(with_payload, Some(&cache))?);
        }
        times_ms.push((1e3 * start.elapsed().as_secs_f64(), read_ms));
    }
    std::fs::remove_dir_all(&cache)?;
    let first = times_ms.remove(0);
    times_ms.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (least, median) = (times_ms[0], times_ms[REPETITIONS / 2]);
    println!(
        "{machine}: {:.0} ms the first time; from the cache {:.1} ms at least, {:.1} ms in the median; \
         reading and checking the mesh {:.1} and {:.1} ms of it",
        first.0, least.0, median.0, least.1, median.1,
    );
    Ok(())
}
