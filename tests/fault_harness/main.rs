//! Random faults, black-box: real processes are killed, stopped and cut off from database and store, and
//! every job must end with the data set of an undisturbed one-worker run.
//!
//! ```text
//! cargo test --release --workspace --test fault_harness -- --nocapture                 a few dozen faults
//! HYDROFLEX_FAULTS=1000 HYDROFLEX_FAULT_REPORT=$PWD/docs/faults.md cargo test … (the same)  a long night
//! ```
//!
//! `HYDROFLEX_FAULT_SEED` repeats the choices of a trial: which fault, on whom, when. What a fault meets
//! still depends on the operating system's schedule.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod disk;
mod fault;
mod inject;
mod judge;
mod trial;

use fault::{Choices, Fault, Setup};
use hydroflex_tests::servers::{moto, postgres::Postgres};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;
use trial::{Servers, Trial};

/// Faults without a budget from outside: enough that every kind comes up on every pair of engine and store.
const SHORT: usize = 40;

/// Faults of one trial. A shard is halved after four lost attempts and a lone run given up after four
/// more: with a handful of faults per job, no run can be given up by bad luck alone.
const PER_TRIAL: usize = 14;

const RUNS: u64 = 600;

/// On PostgreSQL; SQLite is for one machine and one coordinator.
const COORDINATORS: usize = 2;
/// Workers that no coordinator supervises.
const PILOTS: usize = 2;

fn job() -> serde_json::Value {
    serde_json::json!({
        "runs": RUNS,
        "seed": 11,
        "duration_s": 0.5,
        "integrator": { "kind": "generalized-alpha" },
        "settling_runs": 3,
    })
}

#[derive(Default)]
struct Tally {
    trials: BTreeMap<Setup, u64>,
    faults: BTreeMap<(Fault, Setup), usize>,
}

impl Tally {
    fn total(&self) -> usize {
        self.faults.values().sum()
    }

    fn table(&self, setups: &[Setup]) -> String {
        let mut kinds: Vec<Fault> = self.faults.keys().map(|(fault, _)| *fault).collect();
        kinds.dedup();
        let mut text = String::from("| fault |");
        for setup in setups {
            let _ = write!(text, " {} |", setup.name());
        }
        text.push_str(" all |\n|---|");
        text.push_str(&"---:|".repeat(setups.len() + 1));
        text.push('\n');
        let mut line = |name: &str, count: &dyn Fn(Setup) -> usize| {
            let _ = write!(text, "| {name} |");
            for setup in setups {
                let _ = write!(text, " {} |", count(*setup));
            }
            let _ = writeln!(
                text,
                " {} |",
                setups.iter().map(|setup| count(*setup)).sum::<usize>()
            );
        };
        for kind in kinds {
            line(kind.name(), &|setup| {
                self.faults.get(&(kind, setup)).copied().unwrap_or(0)
            });
        }
        line("**all faults**", &|setup| {
            self.faults
                .iter()
                .filter(|((_, of), _)| *of == setup)
                .map(|(_, count)| count)
                .sum()
        });
        let trials = |setup: Setup| usize::try_from(self.trials.get(&setup).copied().unwrap_or(0)).unwrap();
        line("jobs", &trials);
        let runs = usize::try_from(RUNS).unwrap();
        line("runs accounted for exactly once", &|setup| trials(setup) * runs);
        line("runs lost or doubled", &|_| 0);
        line("orphans left after collection", &|_| 0);
        line("data sets with another hash than an undisturbed run's", &|_| 0);
        text
    }
}

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| {
        text.parse()
            .unwrap_or_else(|_| panic!("{name} is {text:?}, allowed is a whole number"))
    })
}

#[test]
fn random_faults_lose_nothing_and_change_no_byte() {
    let budget = number("HYDROFLEX_FAULTS").map_or(SHORT, |faults| usize::try_from(faults).unwrap());
    let seed = number("HYDROFLEX_FAULT_SEED").unwrap_or(1);
    let servers = Servers {
        postgres: Postgres::start(),
        moto: moto::Moto::start(),
    };
    let setups: Vec<Setup> = Setup::ALL
        .into_iter()
        .filter(|setup| !setup.has_postgres() || servers.postgres.is_some())
        .filter(|setup| !setup.has_s3() || servers.moto.is_some())
        .collect();
    let cache = tempfile::tempdir().unwrap();
    let mut tally = Tally::default();
    let start = Instant::now();
    let mut number = 0_u64;
    while tally.total() < budget {
        let setup = setups[usize::try_from(number).unwrap() % setups.len()];
        let trial_seed = Choices(seed.wrapping_add(number << 32)).next();
        let mut trial = Trial::new(setup, trial_seed, &servers, cache.path()).unwrap();
        let most = PER_TRIAL.min(budget - tally.total());
        if let Err(error) = trial.run(&servers, most) {
            panic!(
                "trial {number} (HYDROFLEX_FAULT_SEED={seed}) on {}, after {:?}: {error:#}",
                setup.name(),
                trial.counts
            );
        }
        *tally.trials.entry(setup).or_default() += 1;
        for (fault, count) in &trial.counts {
            *tally.faults.entry((*fault, setup)).or_default() += count;
        }
        if let Some(path) = std::env::var_os("HYDROFLEX_FAULT_REPORT") {
            report(Path::new(&path), &tally, &setups, seed).unwrap();
        }
        number += 1;
        eprintln!(
            "trial {number} on {}: {} faults so far, {:.0} s",
            setup.name(),
            tally.total(),
            start.elapsed().as_secs_f64()
        );
    }
    eprintln!("{}", tally.table(&setups));
}

/// What has been injected so far, for people; written after every trial, so that a long night may be cut
/// short.
fn report(path: &Path, tally: &Tally, setups: &[Setup], seed: u64) -> std::io::Result<()> {
    let text = format!(
        "# Faults injected, and what they changed\n\n\
         Each job is {RUNS} runs of the built-in boom on three or four worker processes and, on PostgreSQL, two\n\
         coordinators. After each job every run must be accounted for once in the ledger, every file of the data\n\
         set must have its SHA-256, no object may be left that nobody owns, and the data set must be byte for\n\
         byte that of one undisturbed worker on SQLite and a directory; one violation ends the harness. Readers\n\
         look at every listed data set in between, and never meet a half-written file.\n\n\
         Written by\n\n```sh\nHYDROFLEX_FAULTS={} HYDROFLEX_FAULT_SEED={seed} HYDROFLEX_FAULT_REPORT=$PWD/docs/faults.md \\\n  \
         cargo test --release --workspace --test fault_harness -- --nocapture\n```\n\n{}\n\
         A worker or coordinator that is stopped is continued after 0.2 to 6 s; the lease is 3 s. S3 is `moto`\n\
         behind a proxy that answers 500, does not answer, or cuts connections. The disk is a tmpfs of 48 MB\n\
         (SQLite and directory, as root). On PostgreSQL and S3 every coordinator and pilot has a network namespace of\n\
         its own, whose cable is pulled for 0.5 to 9 s: packets vanish, nobody is told. A clock jump sets the wall\n\
         clock of one process (by `libfaketime`), at most a day ahead or behind. Not injected: power cuts.\n",
        tally.total(),
        tally.table(setups)
    );
    std::fs::write(path, text)
}
