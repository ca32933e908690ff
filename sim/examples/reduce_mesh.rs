//! From a mesh file to frequencies and times: `reduce_mesh MACHINE [MESH]`.
//!
//! ```text
//! cargo run --release -p hydroflex-sim --example reduce_mesh -- lift-boom
//! ```
#![allow(clippy::print_stdout, reason = "an example talks to its user")]

use hydroflex_sim::fe::{assemble_mass, assemble_stiffness};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::reduction::free_free_hz;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let machine = arguments.next().unwrap_or_else(|| "lift-boom".to_owned());
    let meshes: Vec<String> = arguments.collect();
    let start = Instant::now();
    let machine = Machine::load(&machine, &meshes)?;
    println!("read and checked in {:.3} s", start.elapsed().as_secs_f64());
    for with_payload in [false, true] {
        let start = Instant::now();
        for body in machine.reduce(with_payload, None)? {
            println!(
                "{}: {} nodes, {} elements, {} modes, {:.3} kg, fixed-interface {:.3?} Hz, in {:.3} s",
                body.name,
                body.report.node_count,
                body.report.element_count,
                body.mode_count(),
                body.mass_kg,
                body.report.fixed_interface_hz,
                start.elapsed().as_secs_f64(),
            );
        }
    }
    for body in machine.flexible_bodies() {
        let start = Instant::now();
        let stiffness = assemble_stiffness(&body.mesh, &body.material);
        let mass = assemble_mass(&body.mesh, &body.material, body.mass_kind);
        let assembled = start.elapsed().as_secs_f64();
        let free = free_free_hz(&stiffness, &mass, 100.0, 6)?;
        println!(
            "assembled in {assembled:.3} s; free-free {free:.3?} Hz in {:.3} s",
            start.elapsed().as_secs_f64()
        );
    }
    Ok(())
}
