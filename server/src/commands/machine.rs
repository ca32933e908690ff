//! `hydroflex machine`: inspect machine files.

use anyhow::Context;
use hydroflex_dataset::window::{band_steps, closing_step, paper_steps};
use hydroflex_openapi::job::{Integrator, JobSpec};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_settling_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::summary::{BodySummary, MachineSummary, payloads_kg, summarise};
use hydroflex_sim::trajectory::RunSettings;
use serde::Serialize;
use std::fmt::Write;

/// Settling runs per payload from which `show` takes its windows.
const SETTLING_RUNS: u64 = 8;

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
    let windows = windows(&simulator)?;
    if json {
        let shown = Shown {
            summary: &summary,
            windows: &windows,
        };
        println!(
            "{}",
            serde_json::to_string_pretty(&shown).context("writing the summary")?
        );
    } else {
        let mut out = text(&summary).context("writing the summary")?;
        windows_text(&mut out, &summary, &windows).context("writing the summary")?;
        print!("{out}");
    }
    Ok(())
}

/// What `--json` prints.
#[derive(Serialize)]
struct Shown<'a> {
    #[serde(flatten)]
    summary: &'a MachineSummary,
    /// SLIDE windows from settling runs, by payload and deflection channel.
    windows: &'a [WindowRow],
}

/// Windows of one payload and channel.
#[derive(Debug, Serialize)]
struct WindowRow {
    payload_kg: f64,
    channel: String,
    /// Means over the runs that settle: within a band about the end value, and the paper's rule.
    band_s: Option<f64>,
    paper_s: Option<f64>,
    runs: u64,
}

/// Windows from a few settling runs of 2 s at random configurations, by both rules.
fn windows(simulator: &Simulator) -> anyhow::Result<Vec<WindowRow>> {
    let file = simulator.machine().file();
    let channels = simulator.channels();
    let is = |quantity: &'static str| {
        move |(_, c): &(usize, &hydroflex_openapi::channel::Channel)| c.quantity == quantity
    };
    let valves: Vec<usize> = channels
        .iter()
        .enumerate()
        .filter(is("valve opening"))
        .map(|c| c.0)
        .collect();
    let mut rows = Vec::new();
    for payload_kg in payloads_kg(file) {
        let spec: JobSpec = serde_json::from_value(serde_json::json!({
            "runs": 1, "payload_kg": payload_kg, "duration_s": 2.0, "settling_runs": SETTLING_RUNS,
        }))?;
        let settings = RunSettings {
            integrator: Integrator::Accurate,
            sample_time_s: spec.sample_time_s,
        };
        let mut runs = Vec::new();
        for index in 0..SETTLING_RUNS {
            let input = plan_settling_run(&spec, file, simulator, index)?;
            runs.extend(simulator.run(&input, &settings));
        }
        for (k, channel) in channels.iter().enumerate().filter(is("deflection")) {
            let mean_s = |steps: Vec<usize>| {
                let sum: usize = steps.iter().sum();
                (!steps.is_empty()).then(|| sum as f64 / steps.len() as f64 * spec.sample_time_s)
            };
            let band = runs.iter().filter_map(|run| {
                let signals: Vec<&[f64]> = valves.iter().map(|&v| run.columns[v].as_slice()).collect();
                band_steps(&run.columns[k], closing_step(&signals))
            });
            rows.push(WindowRow {
                payload_kg,
                channel: channel.name.clone(),
                band_s: mean_s(band.collect()),
                paper_s: mean_s(
                    runs.iter()
                        .filter_map(|run| paper_steps(&run.columns[k]))
                        .collect(),
                ),
                runs: runs.len() as u64,
            });
        }
    }
    Ok(rows)
}

fn windows_text(out: &mut String, machine: &MachineSummary, windows: &[WindowRow]) -> std::fmt::Result {
    writeln!(
        out,
        "\nsmall motions in the middle of the range, valves shut: decay 1/s (frequency Hz), slowest first"
    )?;
    for row in &machine.small_motions {
        write!(out, "  {:10.1} kg ", row.payload_kg)?;
        if let Some(failure) = &row.failure {
            writeln!(out, "{failure}")?;
            continue;
        }
        for (decay, hz) in row.decay_per_s.iter().zip(&row.frequency_hz) {
            write!(out, " {decay:9.3} ({hz:.2})")?;
        }
        writeln!(out)?;
    }
    writeln!(
        out,
        "\nwindows: decay of the slowest motion to 1 %, and {SETTLING_RUNS} settling runs, s"
    )?;
    writeln!(
        out,
        "  {:>10} {:>12} {:>8} {:>8}  channel",
        "payload kg", "eigenvalues", "band", "paper"
    )?;
    let seconds = |s: Option<f64>| s.map_or_else(|| "none".to_owned(), |s| format!("{s:.3}"));
    for row in windows {
        let small = machine
            .small_motions
            .iter()
            .find(|s| s.payload_kg.total_cmp(&row.payload_kg).is_eq());
        writeln!(
            out,
            "  {:10.1} {:>12} {:>8} {:>8}  {}",
            row.payload_kg,
            seconds(small.and_then(|s| s.window_s)),
            seconds(row.band_s),
            seconds(row.paper_s),
            row.channel
        )?;
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
        for row in &basis.deflections {
            let micrometres = row.reduced_m_per_n.map(|m| 1e9 * m);
            let lost = row.lost_ratio.map(|part| 100.0 * part.max(0.0));
            writeln!(
                out,
                "    1 kN at {:10} x {:.3} (-{:.3} %)  y {:.3} (-{:.3} %)  z {:.3} (-{:.3} %) µm",
                row.interface, micrometres[0], lost[0], micrometres[1], lost[1], micrometres[2], lost[2]
            )?;
        }
    }
    if flexible.bases.iter().any(|basis| !basis.deflections.is_empty()) {
        writeln!(
            out,
            "  (deflection along a force on an interface, first interface held; in brackets what the reduction lost of it)"
        )?;
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
