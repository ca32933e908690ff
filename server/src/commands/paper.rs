//! `hydroflex reproduce-paper`: the published study, made again from nothing.
//!
//! For each payload: a data set of random runs, a calibration set (random 10 s runs), an evaluation set (the published
//! 10 s cycle and other random 10 s runs), the grid of sensors × structures × noise × seeds, and a report; with `--mixed`
//! also networks for payloads that they are not told. Everything lies below one
//! directory; what is there already is not made again, so a study that was stopped goes on.

mod by_runs;
mod cells;
mod choices;
mod report;
mod sets;

pub use choices::{NoiseChoice, Recipe};

use super::simulate::IntegratorName;
use super::{print_json, print_line};
use anyhow::{Context as _, ensure};
use cells::{Cell, Study};
use hydroflex_openapi::sweep::SensorSet;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use sets::{Payload, Sets};
use std::path::PathBuf;

/// Time between samples of the study, s.
const SAMPLE_S: f64 = 0.005;
/// Signals whose errors are reported by default.
const DEFAULT_SIGNALS: u64 = 5;

/// Arguments of `hydroflex reproduce-paper`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Directory for data sets, models and the report
    #[arg(long, default_value = "paper-study")]
    pub out: PathBuf,
    /// Built-in machine or machine file
    #[arg(long, default_value = "lift-boom-published")]
    pub machine: String,
    /// Mesh file, or BODY=FILE, for machines whose mesh is not built in; may be repeated
    #[arg(long)]
    pub mesh: Vec<String>,
    /// Payloads in kg, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "0,50,100")]
    pub payloads: Vec<f64>,
    /// Runs for training, a quarter as many more validate; several numbers, separated by commas, show what more
    /// data are worth
    #[arg(long, value_delimiter = ',', default_value = "256")]
    pub runs: Vec<u64>,
    /// Sensor sets, separated by commas
    #[arg(long, value_parser = choices::sensor_set(), value_delimiter = ',', default_value = "all,usp,us")]
    pub sensors: Vec<SensorSet>,
    /// How the paper's letters are trained, separated by commas: `ours`, `published` (disjoint windows, learning rate
    /// 1e-4, a batch of an eighth of the runs, at most 1,000 epochs); other structures always as we do
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ours")]
    pub recipes: Vec<Recipe>,
    /// Structures, separated by commas: `best`, L, RLR, TLTLT, TLSLTLSLT, ELE, …; for comparison RNN, LSTM, CNN
    #[arg(long, value_delimiter = ',', default_value = "best")]
    pub structures: Vec<String>,
    /// Trainings of each cell, seeds 0, 1, …
    #[arg(long, default_value_t = 5)]
    pub seeds: u64,
    /// Targets, separated by commas (default: each vertical deflection, strain and stress)
    #[arg(long, value_delimiter = ',')]
    pub targets: Vec<String>,
    /// Time integration
    #[arg(long, value_enum, default_value_t = IntegratorName::TrapezoidalIndex2)]
    pub integrator: IntegratorName,
    /// Seed of the study's runs
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Added to the seed for the evaluation, which shares no run with the training; another one judges anew
    #[arg(long, default_value_t = 1_000_003)]
    pub evaluation_seed: u64,
    /// Random 10 s signals whose errors are reported: the first ones that stay within stroke and pressures
    #[arg(long, default_value_t = DEFAULT_SIGNALS, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub signals: u64,
    /// Sensor noise to train and evaluate with, separated by commas: `none`, `crane`
    #[arg(long, value_enum, value_delimiter = ',', default_value = "none")]
    pub noise: Vec<NoiseChoice>,
    /// Also train networks on random payloads over the range of --payloads, as many runs as all payloads together
    #[arg(long)]
    pub mixed: bool,
    /// Part of these runs that carry exactly nothing, where the machine has other modes than with the smallest payload
    /// (default: a quarter where the range begins at 0 kg, else none)
    #[arg(long, requires = "mixed")]
    pub mixed_empty: Option<f64>,
    /// Largest number of epochs of a training
    #[arg(long)]
    pub epochs: Option<usize>,
    /// Largest time of a training in seconds
    #[arg(long)]
    pub time_limit_s: Option<f64>,
    /// A few minutes instead of hours: one payload, one seed, 64 runs unless given otherwise
    #[arg(long)]
    pub short: bool,
    /// Print machine-readable results
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason; what was made until then is kept.
pub fn run(mut args: Args) -> anyhow::Result<()> {
    if args.short {
        shorten(&mut args);
    }
    for runs in &args.runs {
        ensure!(*runs >= 8, "--runs has {runs}, allowed is 8 or more");
    }
    ensure!(
        args.mixed_empty.is_none_or(|part| (0.0..1.0).contains(&part)),
        "--mixed-empty is {}, allowed is 0 or more, below 1",
        args.mixed_empty.unwrap_or_default()
    );
    ensure!(args.seeds >= 1, "--seeds is 0, allowed is 1 or more");
    for payload in &args.payloads {
        ensure!(
            payload.is_finite() && *payload >= 0.0,
            "--payloads has {payload}, allowed is 0 or more"
        );
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    let simulator = Simulator::new(Machine::load(&args.machine, &args.mesh)?)?;
    let mut payloads: Vec<Payload> = args.payloads.iter().map(|&kg| Payload::Fixed(kg)).collect();
    if args.mixed {
        payloads.push(Payload::Range {
            min: args.payloads.iter().copied().fold(f64::INFINITY, f64::min),
            max: args.payloads.iter().copied().fold(0.0, f64::max),
        });
    }
    let sets = payloads
        .into_iter()
        .flat_map(|payload| args.runs.iter().map(move |&runs| (payload, runs)))
        .map(|(payload, runs)| Sets::make(&args, &simulator, payload, runs))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut cells = Vec::new();
    for trained in &sets {
        for &sensors in &args.sensors {
            for structure in &args.structures {
                let recipes = args.recipes.iter().filter(|recipe| recipe.applies_to(structure));
                for (&recipe, &noise) in recipes.flat_map(|r| args.noise.iter().map(move |n| (r, n))) {
                    for seed in 0..args.seeds {
                        let study = Study {
                            args: &args,
                            sets: &sets,
                            trained,
                        };
                        cells.extend(study.cells(sensors, structure, recipe, noise, seed)?);
                    }
                }
            }
        }
    }
    // Seeds of a cell side by side.
    cells.sort_by(|a, b| {
        let key = |c: &Cell| (c.trained.name(), c.payload_kg.to_bits());
        let position = |c: &Cell| sets.iter().position(|set| set.payload == c.trained);
        position(a).cmp(&position(b)).then_with(|| key(a).cmp(&key(b)))
    });
    let text = report::markdown(&args, &simulator.machine().file().name, &cells);
    let path = args.out.join("report.md");
    std::fs::write(&path, &text).with_context(|| format!("cannot write {}", path.display()))?;
    let picture = args.out.join("report.svg");
    std::fs::write(&picture, report::picture(&cells).to_svg())
        .with_context(|| format!("cannot write {}", picture.display()))?;
    if args.runs.len() > 1 {
        let picture = args.out.join("report-runs.svg");
        std::fs::write(&picture, by_runs::picture(&cells))
            .with_context(|| format!("cannot write {}", picture.display()))?;
    }
    if args.json {
        return print_json(&cells);
    }
    print_line(format_args!(
        "{text}\nreport: {}, picture: {}",
        path.display(),
        picture.display()
    ))
}

/// What `--short` stands for; whatever was given differently stays.
fn shorten(args: &mut Args) {
    args.payloads.truncate(1);
    args.seeds = 1;
    args.runs = vec![args.runs.iter().copied().fold(64, u64::min)];
    args.time_limit_s = args.time_limit_s.or(Some(10.0));
}
