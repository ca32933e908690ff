//! `hydroflex machine`: inspect machine files.

use anyhow::Context;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::summary::{BodySummary, MachineSummary, summarise};
use std::fmt::Write;

/// Subcommands of `hydroflex machine`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Mass, inertia, interfaces, frequencies, equilibrium over the range of angles
    Show {
        /// Built-in machine or machine file
        #[arg(default_value = "lift-boom")]
        machine: String,
        /// Mesh file, or BODY=FILE; may be repeated
        #[arg(long)]
        mesh: Vec<String>,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
#[allow(clippy::print_stdout, reason = "this command's output is its purpose")]
pub fn run(command: Command) -> anyhow::Result<()> {
    let Command::Show { machine, mesh, json } = command;
    let machine = Machine::load(&machine, &mesh)?;
    let simulator = Simulator::new(machine)?;
    let summary = summarise(&simulator)?;
    if json {
        println!(
            "{}",
            serde_json::to_string_pretty(&summary).context("writing the summary")?
        );
    } else {
        print!("{}", text(&summary).context("writing the summary")?);
    }
    Ok(())
}

fn text(machine: &MachineSummary) -> Result<String, std::fmt::Error> {
    let mut out = String::new();
    writeln!(out, "{}", machine.name)?;
    writeln!(out, "{}", machine.description.trim())?;
    writeln!(out, "content hash {}", machine.content_hash)?;
    for body in &machine.bodies {
        body_text(&mut out, body)?;
    }
    equilibrium_text(&mut out, machine)?;
    Ok(out)
}

fn body_text(out: &mut String, body: &BodySummary) -> std::fmt::Result {
    let [x, y, z] = body.centre_of_mass_m;
    let kind = if body.flexible.is_some() {
        "flexible"
    } else {
        "rigid"
    };
    writeln!(out, "\nbody {} ({kind})", body.name)?;
    writeln!(out, "  mass             {:12.4} kg", body.mass_kg)?;
    writeln!(out, "  centre of mass   {x:12.6} {y:12.6} {z:12.6} m")?;
    for (i, [a, b, c]) in body.inertia_kg_m2.iter().enumerate() {
        let label = if i == 0 { "inertia about it" } else { "" };
        writeln!(out, "  {label:16} {a:12.5} {b:12.5} {c:12.5} kg m²")?;
    }
    let Some(flexible) = &body.flexible else {
        return Ok(());
    };
    writeln!(
        out,
        "  mesh             {} nodes, {} {} elements, {}",
        flexible.node_count, flexible.element_count, flexible.element_kind, flexible.material
    )?;
    writeln!(
        out,
        "  interface        nodes     point (m)                               boundary"
    )?;
    for interface in &flexible.interfaces {
        let [x, y, z] = interface.position_m;
        writeln!(
            out,
            "    {:14} {:5}     {x:12.6} {y:12.6} {z:12.6}  {}",
            interface.name, interface.node_count, interface.boundary
        )?;
    }
    writeln!(out, "  free-free        {} Hz", hertz(&flexible.free_free_hz))?;
    for basis in &flexible.bases {
        let with = if basis.with_payload { "with" } else { "without" };
        let boundaries = basis.boundaries.join(" + ");
        writeln!(
            out,
            "  {with} payload: {} modes, boundaries {boundaries}",
            basis.mode_count
        )?;
        writeln!(out, "    all clamped    {} Hz", hertz(&basis.fixed_interface_hz))?;
        let lowest = &basis.reduced_hz[..basis.reduced_hz.len().min(6)];
        writeln!(out, "    frame clamped  {} Hz …", hertz(lowest))?;
        if !basis.full_hz.is_empty() {
            writeln!(out, "    full model     {} Hz …", hertz(&basis.full_hz))?;
        }
    }
    Ok(())
}

fn hertz(values: &[f64]) -> String {
    let values: Vec<String> = values.iter().map(|hz| format!("{hz:.3}")).collect();
    values.join(", ")
}

fn equilibrium_text(out: &mut String, machine: &MachineSummary) -> std::fmt::Result {
    writeln!(out, "\nequilibrium (force of the oil, tension positive)")?;
    write!(out, "  {:>10}", "payload kg")?;
    for angle in &machine.angle_names {
        write!(out, " {:>10}", format!("{angle} deg"))?;
    }
    for cylinder in &machine.cylinder_names {
        for (what, width) in [
            ("length m", 9),
            ("force kN", 9),
            ("piston bar", 11),
            ("rod bar", 9),
        ] {
            let label = if machine.cylinder_names.len() > 1 {
                format!("{cylinder} {what}")
            } else {
                what.to_owned()
            };
            write!(out, " {label:>width$}")?;
        }
    }
    writeln!(out)?;
    for row in &machine.equilibria {
        write!(out, "  {:10.1}", row.payload_kg)?;
        for angle in &row.angles_deg {
            write!(out, " {angle:10.2}")?;
        }
        if let Some(failure) = &row.failure {
            writeln!(out, "  {failure}")?;
            continue;
        }
        for k in 0..row.lengths_m.len() {
            let (length, force) = (row.lengths_m[k], row.forces_n[k] / 1e3);
            let (piston, rod) = (row.pressures_piston_pa[k] / 1e5, row.pressures_rod_pa[k] / 1e5);
            write!(out, " {length:9.4} {force:9.3} {piston:11.3} {rod:9.3}")?;
        }
        let note = if row.within_supply {
            ""
        } else {
            "  outside tank…supply"
        };
        writeln!(out, "{note}")?;
    }
    Ok(())
}
