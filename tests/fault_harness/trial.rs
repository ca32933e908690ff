//! One trial: a job on processes that are started, watched and replaced.

use crate::disk::SmallDisk;
use crate::fault::{Choices, Fault, Setup};
use crate::{COORDINATORS, PILOTS, job};
use anyhow::{Context, ensure};
use hydroflex_openapi::status::JobStatus;
use hydroflex_tests::clock::{self, Clock};
use hydroflex_tests::network::{Network, forward};
use hydroflex_tests::proxy::Proxy;
use hydroflex_tests::servers::{moto, postgres::Postgres};
use hydroflex_tests::{Pilot, ServiceUnderTest, Start, signal};
use nix::sys::signal::Signal;
use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Servers that all trials share.
pub(super) struct Servers {
    pub(super) postgres: Option<Postgres>,
    pub(super) moto: Option<moto::Moto>,
}

/// Everything of one trial.
pub(super) struct Trial {
    pub(super) setup: Setup,
    pub(super) choices: Choices,
    pub(super) data: Vec<tempfile::TempDir>,
    pub(super) cache: PathBuf,
    pub(super) disk: Option<SmallDisk>,
    /// Machines of their own for two coordinators and two pilots, in this order.
    pub(super) network: Option<Network>,
    /// Their clocks, and the library by which they jump.
    pub(super) clocks: Vec<Clock>,
    pub(super) clock_library: Option<PathBuf>,
    pub(super) database: String,
    pub(super) store: String,
    pub(super) environment: Vec<(&'static str, String)>,
    pub(super) proxy: Option<Proxy>,
    pub(super) coordinators: Vec<Option<ServiceUnderTest>>,
    /// Whether a coordinator is to die by itself when it publishes.
    pub(super) armed: [bool; 2],
    pub(super) pilots: Vec<Pilot>,
    /// Processes that are stopped, and when they go on.
    pub(super) stopped: Vec<(u32, Instant)>,
    /// Machines that are cut off, and when they join again.
    pub(super) cut: Vec<(usize, Instant)>,
    pub(super) counts: BTreeMap<Fault, usize>,
}

impl Trial {
    pub(super) fn new(setup: Setup, seed: u64, servers: &Servers, cache: &Path) -> anyhow::Result<Self> {
        let data = vec![tempfile::tempdir()?, tempfile::tempdir()?];
        let disk = (setup == Setup::SqliteDirectory)
            .then(|| SmallDisk::mount(data[0].path()))
            .flatten();
        let network = (setup == Setup::PostgresS3)
            .then(|| Network::new(COORDINATORS + PILOTS))
            .flatten();
        let here = network.as_ref().map_or(Ipv4Addr::LOCALHOST, Network::here);
        let database = match &servers.postgres {
            Some(postgres) if setup.has_postgres() => {
                let url = postgres.database(&format!("trial_{seed:016x}"));
                let port = match network {
                    Some(_) => forward(here, postgres.port(), None)?,
                    None => postgres.port(),
                };
                url.replace(
                    &format!("127.0.0.1:{}", postgres.port()),
                    &format!("{here}:{port}"),
                )
            }
            _ => format!("sqlite:{}", data[0].path().join("ledger.sqlite").display()),
        };
        let mut environment = Vec::new();
        let mut proxy = None;
        let store = match &servers.moto {
            Some(moto) if setup.has_s3() => {
                let bucket = format!("trial-{seed:016x}");
                moto.bucket(&bucket);
                let between = Proxy::start_at(here, moto.port())?;
                environment = moto::environment_at(&here.to_string(), between.port());
                proxy = Some(between);
                format!("s3://{bucket}/night")
            }
            _ => format!("file://{}", data[0].path().join("store").display()),
        };
        let clocks = (0..COORDINATORS + PILOTS)
            .map(|machine| Clock::new(data[1].path(), &machine.to_string()))
            .collect::<Result<_, _>>()?;
        let mut trial = Self {
            setup,
            choices: Choices(seed),
            data,
            cache: cache.to_owned(),
            disk,
            network,
            clocks,
            clock_library: clock::library(),
            database,
            store,
            environment,
            proxy,
            coordinators: Vec::new(),
            armed: [false; 2],
            pilots: Vec::new(),
            stopped: Vec::new(),
            cut: Vec::new(),
            counts: BTreeMap::new(),
        };
        let coordinators = if setup.has_postgres() { COORDINATORS } else { 1 };
        for index in 0..coordinators {
            let service = trial.start_coordinator(index, None)?;
            trial.coordinators.push(Some(service));
        }
        for index in 0..PILOTS {
            let pilot = trial.start_pilot(index, None)?;
            trial.pilots.push(pilot);
        }
        Ok(trial)
    }

    pub(super) fn start_coordinator(
        &self,
        index: usize,
        crash_at: Option<&str>,
    ) -> anyhow::Result<ServiceUnderTest> {
        let mut environment = self.environment_of(index);
        environment.push(("HYDROFLEX_LEASE", "3".to_owned()));
        environment.push(("HYDROFLEX_CACHE", self.cache.display().to_string()));
        if let Some(point) = crash_at {
            environment.push(("HYDROFLEX_CRASH_AT", point.to_owned()));
        }
        ServiceUnderTest::start(
            self.data[index].path(),
            &Start {
                workers: 1,
                environment,
                database: Some(self.database.clone()),
                store: Some(self.store.clone()),
                namespace: self.network.as_ref().map(|network| network.name(index)),
            },
        )
    }

    /// Variables of the processes on a machine: where the store is, and what time it is.
    pub(super) fn environment_of(&self, machine: usize) -> Vec<(&'static str, String)> {
        let mut environment = self.environment.clone();
        if let Some(library) = &self.clock_library {
            environment.extend(self.clocks[machine].environment(library));
        }
        environment
    }

    pub(super) fn start_pilot(&self, index: usize, crash_at: Option<String>) -> anyhow::Result<Pilot> {
        let machine = COORDINATORS + index;
        let mut environment = self.environment_of(machine);
        if let Some(point) = crash_at {
            environment.push(("HYDROFLEX_CRASH_AT", point));
        }
        let namespace = self.network.as_ref().map(|network| network.name(machine));
        Pilot::start_in(
            namespace.as_deref(),
            &self.database,
            &self.store,
            &self.cache,
            &environment,
            &[],
        )
    }

    /// A coordinator that answers, started again if every one has died.
    pub(super) fn coordinator(&mut self) -> anyhow::Result<&ServiceUnderTest> {
        let start = Instant::now();
        loop {
            for index in 0..self.coordinators.len() {
                let dead = self.coordinators[index]
                    .as_mut()
                    .is_none_or(|service| !service.is_running());
                if dead {
                    if std::mem::take(&mut self.armed[index]) {
                        *self.counts.entry(Fault::CrashPoint).or_default() += 1;
                    }
                    self.coordinators[index] = None;
                    // Database or store may be away at this moment.
                    self.coordinators[index] = self.start_coordinator(index, None).ok();
                }
            }
            if let Some(index) = self.coordinators.iter().position(Option::is_some) {
                return self.coordinators[index].as_ref().context("just found");
            }
            ensure!(
                start.elapsed() < Duration::from_mins(2),
                "no coordinator can be started any more"
            );
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    /// Continues who has stood still long enough, and replaces who has died.
    pub(super) fn tend(&mut self, everybody: bool) -> anyhow::Result<()> {
        let now = Instant::now();
        let (due, later) = std::mem::take(&mut self.stopped)
            .into_iter()
            .partition(|(_, at)| everybody || *at <= now);
        self.stopped = later;
        let (whole_again, still_cut) = std::mem::take(&mut self.cut)
            .into_iter()
            .partition(|(_, at)| everybody || *at <= now);
        self.cut = still_cut;
        let whole_again: Vec<(usize, Instant)> = whole_again;
        for (machine, _) in whole_again {
            let network = self.network.as_ref().context("only machines of one are cut")?;
            ensure!(network.mend(machine), "machine {machine} cannot join again");
        }
        let due: Vec<(u32, Instant)> = due;
        for (process, _) in due {
            // Killed meanwhile, by us or by its supervisor: there is nobody to continue.
            let _ = signal(process, Signal::SIGCONT);
        }
        for index in 0..self.pilots.len() {
            if !self.pilots[index].is_running() {
                self.pilots[index] = self.start_pilot(index, None)?;
            }
        }
        self.coordinator().map(drop)
    }

    pub(super) fn status(&mut self, id: &str) -> Option<JobStatus> {
        // One that is stopped would not answer for seconds.
        if !self.stopped.is_empty() || !self.cut.is_empty() {
            return None;
        }
        self.coordinator().ok()?.job(id).ok()
    }

    pub(super) fn run(&mut self, servers: &Servers, most: usize) -> anyhow::Result<()> {
        let id = self.coordinator()?.submit(&job())?.job_id.to_string();
        let start = Instant::now();
        let mut injected = 0;
        loop {
            std::thread::sleep(self.choices.between(50, 500));
            self.tend(false)?;
            if injected < most {
                let fault = *self.choices.of(&self.allowed());
                injected += usize::from(self.inject(fault, servers)?);
            }
            self.look_as_a_reader()?;
            if let Some(status) = self.status(&id)
                && status.state.is_final()
            {
                break;
            }
            ensure!(
                start.elapsed() < Duration::from_secs(400),
                "the job does not end: {:?}\n{}",
                self.status(&id),
                self.logs()
            );
        }
        self.tend(true)?;
        self.judge(&id)
    }

    pub(super) fn logs(&self) -> String {
        self.coordinators
            .iter()
            .flatten()
            .map(ServiceUnderTest::log)
            .collect::<Vec<_>>()
            .join("\n--- the other coordinator\n")
    }
}
