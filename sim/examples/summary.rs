//! Prints what there is to know about a machine, as JSON: `summary [MACHINE [MESH…]]`.
#![allow(clippy::print_stdout, reason = "an example talks to its user")]

use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::summary::summarise;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let machine = arguments.next().unwrap_or_else(|| "lift-boom".to_owned());
    let machine = Machine::load(&machine, &arguments.collect::<Vec<_>>())?;
    let summary = summarise(&Simulator::new(machine)?)?;
    println!("{}", serde_json::to_string_pretty(&summary)?);
    Ok(())
}
