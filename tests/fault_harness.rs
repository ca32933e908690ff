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

use anyhow::{Context, ensure};
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::transition::ShardState;
use hydroflex_ledger::{Ledger, ShardKind};
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::status::{JobState, JobStatus};
use hydroflex_tests::clock::{self, Clock};
use hydroflex_tests::network::{Network, forward};
use hydroflex_tests::proxy::{Mode, Proxy};
use hydroflex_tests::servers::{moto, postgres::Postgres};
use hydroflex_tests::{Pilot, ServiceUnderTest, Start, sha256, signal};
use nix::sys::signal::Signal;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

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

/// Seeded choices: splitmix64.
struct Choices(u64);

impl Choices {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        usize::try_from(self.next() % end as u64).unwrap()
    }

    fn of<'a, T>(&mut self, some: &'a [T]) -> &'a T {
        &some[self.below(some.len())]
    }

    fn between(&mut self, least_ms: usize, most_ms: usize) -> Duration {
        Duration::from_millis((least_ms + self.below(most_ms - least_ms)) as u64)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    KillWorker,
    StopWorker,
    KillCoordinator,
    StopCoordinator,
    CrashPoint,
    KillPostgres,
    StoreFails,
    StoreHangs,
    StoreCutOff,
    DiskFull,
    NetworkCut,
    ClockJump,
}

impl Fault {
    fn name(self) -> &'static str {
        match self {
            Self::KillWorker => "kill -9 of a worker",
            Self::StopWorker => "worker stopped, later continued",
            Self::KillCoordinator => "kill -9 of a coordinator",
            Self::StopCoordinator => "coordinator stopped, later continued",
            Self::CrashPoint => "death at begin, put, commit or publishing",
            Self::KillPostgres => "kill -9 of PostgreSQL",
            Self::StoreFails => "S3 answers 500",
            Self::StoreHangs => "S3 does not answer",
            Self::StoreCutOff => "S3 connections cut",
            Self::DiskFull => "disk full",
            Self::NetworkCut => "machine cut off the network, later joined again",
            Self::ClockJump => "wall clock of a process jumps by up to a day",
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Setup {
    SqliteDirectory,
    SqliteS3,
    PostgresDirectory,
    PostgresS3,
}

impl Setup {
    const ALL: [Self; 4] = [
        Self::SqliteDirectory,
        Self::PostgresS3,
        Self::SqliteS3,
        Self::PostgresDirectory,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::SqliteDirectory => "SQLite, directory",
            Self::SqliteS3 => "SQLite, S3",
            Self::PostgresDirectory => "PostgreSQL, directory",
            Self::PostgresS3 => "PostgreSQL, S3",
        }
    }

    fn has_postgres(self) -> bool {
        matches!(self, Self::PostgresDirectory | Self::PostgresS3)
    }

    fn has_s3(self) -> bool {
        matches!(self, Self::SqliteS3 | Self::PostgresS3)
    }
}

/// Servers that all trials share.
struct Servers {
    postgres: Option<Postgres>,
    moto: Option<moto::Moto>,
}

/// A small file system of its own for the data directory; only root can make one.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount(at: &Path) -> Option<Self> {
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=48m", "hydroflex-test"])
            .arg(at)
            .status();
        mounted
            .is_ok_and(|status| status.success())
            .then(|| Self(at.to_owned()))
    }

    fn filler(&self) -> PathBuf {
        self.0.join("filler")
    }

    fn fill(&self) {
        use std::io::Write;
        let Ok(mut file) = std::fs::File::create(self.filler()) else {
            return;
        };
        let block = vec![1_u8; 1 << 16];
        while file.write_all(&block).is_ok() {}
        // The last bytes too.
        while file.write_all(&block[..512]).is_ok() {}
    }

    fn empty(&self) {
        let _ = std::fs::remove_file(self.filler());
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(&self.0).status();
    }
}

/// Everything of one trial.
struct Trial {
    setup: Setup,
    choices: Choices,
    data: Vec<tempfile::TempDir>,
    cache: PathBuf,
    disk: Option<SmallDisk>,
    /// Machines of their own for two coordinators and two pilots, in this order.
    network: Option<Network>,
    /// Their clocks, and the library by which they jump.
    clocks: Vec<Clock>,
    clock_library: Option<PathBuf>,
    database: String,
    store: String,
    environment: Vec<(&'static str, String)>,
    proxy: Option<Proxy>,
    coordinators: Vec<Option<ServiceUnderTest>>,
    /// Whether a coordinator is to die by itself when it publishes.
    armed: [bool; 2],
    pilots: Vec<Pilot>,
    /// Processes that are stopped, and when they go on.
    stopped: Vec<(u32, Instant)>,
    /// Machines that are cut off, and when they join again.
    cut: Vec<(usize, Instant)>,
    counts: BTreeMap<Fault, usize>,
}

impl Trial {
    fn new(setup: Setup, seed: u64, servers: &Servers, cache: &Path) -> anyhow::Result<Self> {
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

    fn start_coordinator(&self, index: usize, crash_at: Option<&str>) -> anyhow::Result<ServiceUnderTest> {
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
    fn environment_of(&self, machine: usize) -> Vec<(&'static str, String)> {
        let mut environment = self.environment.clone();
        if let Some(library) = &self.clock_library {
            environment.extend(self.clocks[machine].environment(library));
        }
        environment
    }

    fn start_pilot(&self, index: usize, crash_at: Option<String>) -> anyhow::Result<Pilot> {
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
    fn coordinator(&mut self) -> anyhow::Result<&ServiceUnderTest> {
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

    fn allowed(&self) -> Vec<Fault> {
        use Fault::{
            ClockJump, CrashPoint, DiskFull, KillCoordinator, KillPostgres, KillWorker, NetworkCut,
            StopCoordinator, StopWorker, StoreCutOff, StoreFails, StoreHangs,
        };
        let mut faults = vec![
            KillWorker,
            KillWorker,
            StopWorker,
            KillCoordinator,
            StopCoordinator,
            CrashPoint,
            CrashPoint,
        ];
        if self.setup.has_postgres() {
            faults.push(KillPostgres);
        }
        if self.setup.has_s3() {
            faults.extend([StoreFails, StoreHangs, StoreCutOff]);
        }
        if self.disk.is_some() {
            faults.push(DiskFull);
        }
        if self.network.is_some() {
            faults.extend([NetworkCut, NetworkCut]);
        }
        if self.clock_library.is_some() {
            faults.push(ClockJump);
        }
        faults
    }

    /// Injects a fault. False if there was nothing to do it to.
    fn inject(&mut self, fault: Fault, servers: &Servers) -> anyhow::Result<bool> {
        let happened = match fault {
            Fault::KillWorker => match self.some_worker() {
                Some(worker) => signal(worker, Signal::SIGKILL).is_ok(),
                None => false,
            },
            Fault::StopWorker => match self.some_worker() {
                Some(worker) => self.stop_for(worker, 200, 6000),
                None => false,
            },
            Fault::KillCoordinator | Fault::StopCoordinator => {
                let index = self.choices.below(self.coordinators.len());
                match &self.coordinators[index] {
                    Some(service) if fault == Fault::StopCoordinator => {
                        let process = service.pid();
                        self.stop_for(process, 200, 5000)
                    }
                    Some(service) => {
                        let process = service.pid();
                        self.armed[index] = false;
                        signal(process, Signal::SIGKILL).is_ok()
                    }
                    None => false,
                }
            }
            Fault::CrashPoint => self.arm_a_crash_point()?,
            Fault::KillPostgres => {
                let pause = self.choices.between(0, 1500);
                servers
                    .postgres
                    .as_ref()
                    .context("only chosen where PostgreSQL runs")?
                    .kill_and_restart(pause);
                true
            }
            Fault::StoreFails | Fault::StoreHangs | Fault::StoreCutOff => {
                let pause = self.choices.between(100, 2500);
                let proxy = self.proxy.as_ref().context("only chosen where S3 is used")?;
                proxy.set(match fault {
                    Fault::StoreFails => Mode::Fail,
                    Fault::StoreHangs => Mode::Hang,
                    _ => Mode::Cut,
                });
                std::thread::sleep(pause);
                proxy.set(Mode::Pass);
                true
            }
            Fault::DiskFull => {
                let pause = self.choices.between(200, 2500);
                let disk = self.disk.as_ref().context("only chosen where there is one")?;
                disk.fill();
                std::thread::sleep(pause);
                disk.empty();
                true
            }
            Fault::NetworkCut => {
                let pause = self.choices.between(500, 9000);
                let network = self.network.as_ref().context("only chosen where there is one")?;
                let machine = self.choices.below(network.machines());
                let is_cut = self.cut.iter().any(|(cut, _)| *cut == machine);
                let happened = !is_cut && network.cut(machine);
                if happened {
                    self.cut.push((machine, Instant::now() + pause));
                }
                happened
            }
            Fault::ClockJump => {
                let clock = self.choices.of(&self.clocks);
                let minutes = i64::try_from(self.choices.below(2 * 24 * 60))? - 24 * 60;
                clock.set_ahead(60 * minutes)?;
                true
            }
        };
        if happened {
            *self.counts.entry(fault).or_default() += 1;
        }
        Ok(happened)
    }

    fn some_worker(&mut self) -> Option<u32> {
        let mut workers: Vec<u32> = self.pilots.iter().map(Pilot::pid).collect();
        for service in self.coordinators.iter().flatten() {
            workers.extend(service.children("simulate"));
        }
        workers.retain(|worker| !self.stopped.iter().any(|(stopped, _)| stopped == worker));
        (!workers.is_empty()).then(|| *self.choices.of(&workers))
    }

    fn stop_for(&mut self, process: u32, least_ms: usize, most_ms: usize) -> bool {
        let pause = self.choices.between(least_ms, most_ms);
        if self.stopped.iter().any(|(stopped, _)| *stopped == process)
            || signal(process, Signal::SIGSTOP).is_err()
        {
            return false;
        }
        self.stopped.push((process, Instant::now() + pause));
        true
    }

    /// Lets a process die by itself at a chosen place: counted when the process is gone.
    fn arm_a_crash_point(&mut self) -> anyhow::Result<bool> {
        let points = [
            "begin",
            "put",
            "commit",
            "publish-written",
            "publish-upload",
            "publish-commit",
            "published",
        ];
        let point = *self.choices.of(&points);
        if point.starts_with("publish") {
            let index = self.choices.below(self.coordinators.len());
            self.coordinators[index] = None;
            self.coordinators[index] = self.start_coordinator(index, Some(point)).ok();
            // Killing it to give it its orders is a fault of its own; its death will be another.
            self.armed[index] = self.coordinators[index].is_some();
            *self.counts.entry(Fault::KillCoordinator).or_default() += 1;
            return Ok(false);
        }
        let times = 1 + self.choices.below(3);
        let mut pilot = self.start_pilot(0, Some(format!("{point}:{times}")))?;
        let start = Instant::now();
        while pilot.is_running() {
            // Nothing left to do for it: then it does not die, and is no fault.
            if start.elapsed() > Duration::from_secs(5) {
                return Ok(false);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(true)
    }

    /// Continues who has stood still long enough, and replaces who has died.
    fn tend(&mut self, everybody: bool) -> anyhow::Result<()> {
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

    /// A data set that anybody can see is whole, whenever one looks.
    fn look_as_a_reader(&mut self) -> anyhow::Result<()> {
        if !self.stopped.is_empty() || !self.cut.is_empty() {
            return Ok(());
        }
        let service = self.coordinator()?;
        let Ok(page) = service.get("/v1/datasets") else {
            return Ok(());
        };
        let page: serde_json::Value = serde_json::from_slice(&page)?;
        for dataset in page["datasets"].as_array().into_iter().flatten() {
            for file in dataset["files"].as_array().into_iter().flatten() {
                let path = format!(
                    "/v1/datasets/{}/files/{}",
                    dataset["dataset_id"].as_str().unwrap_or_default(),
                    file["path"].as_str().unwrap_or_default()
                );
                // The service or its store may be away; what it does send must be right.
                if let Ok(content) = service.get(&path) {
                    ensure!(
                        Some(sha256(&content).as_str()) == file["sha256"].as_str(),
                        "{path} is half-written"
                    );
                }
            }
        }
        Ok(())
    }

    fn status(&mut self, id: &str) -> Option<JobStatus> {
        // One that is stopped would not answer for seconds.
        if !self.stopped.is_empty() || !self.cut.is_empty() {
            return None;
        }
        self.coordinator().ok()?.job(id).ok()
    }

    fn run(&mut self, servers: &Servers, most: usize) -> anyhow::Result<()> {
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

    /// What must be true after every trial.
    fn judge(&mut self, id: &str) -> anyhow::Result<()> {
        let expected = undisturbed();
        let start = Instant::now();
        let status = loop {
            // One that was to die at its last step may do so just now.
            match self.coordinator()?.job(id) {
                Ok(status) => break status,
                Err(error) => ensure!(start.elapsed() < Duration::from_mins(1), "{error:#}"),
            }
        };
        ensure!(
            status.state == JobState::Succeeded && status.progress.runs_failed == 0,
            "{status:?}\n{}",
            self.logs()
        );
        ensure!(
            status.dataset_sha256.as_deref() == Some(expected),
            "the data set is another one: {status:?}"
        );
        self.look_as_a_reader()?;
        let runtime = tokio::runtime::Runtime::new()?;
        let job: JobId = id.parse()?;
        runtime.block_on(async {
            let ledger = Ledger::open(&self.database).await?;
            for (kind, runs) in [(ShardKind::Runs, RUNS), (ShardKind::Settling, 3)] {
                let mut next = 0;
                for shard in ledger.settled_shards(job, kind, 0, 10_000).await? {
                    ensure!(
                        shard.first_run == next && shard.state == ShardState::Committed,
                        "run {next} is not accounted for once: {shard:?}"
                    );
                    next += shard.run_count;
                }
                ensure!(next == runs, "{next} of {runs} {kind} are accounted for");
            }
            ledger.close().await;
            anyhow::Ok(())
        })?;
        self.check_orphans(&runtime, &status)
    }

    fn check_orphans(&mut self, runtime: &tokio::runtime::Runtime, status: &JobStatus) -> anyhow::Result<()> {
        // A new coordinator sweeps when it starts: what late workers put goes then.
        for index in 0..self.coordinators.len() {
            self.coordinators[index] = None;
        }
        self.coordinator()?;
        let variables = self
            .environment
            .iter()
            .map(|(name, value)| ((*name).to_owned(), value.clone()));
        let blobs = Blobs::open_with(&self.store, variables)?;
        let start = Instant::now();
        loop {
            let shards = everything_below(runtime, &blobs, "shards")?;
            if shards.is_empty() {
                break;
            }
            ensure!(
                start.elapsed() < Duration::from_secs(30),
                "orphans stay: {shards:?}\n{}",
                self.logs()
            );
            std::thread::sleep(Duration::from_millis(200));
        }
        let id = status.dataset_id.as_ref().context("a published job has one")?;
        let listed = self.coordinator()?.get(&format!("/v1/datasets/{id}"))?;
        let listed: serde_json::Value = serde_json::from_slice(&listed)?;
        let mut listed: Vec<String> = listed["files"]
            .as_array()
            .into_iter()
            .flatten()
            .filter_map(|file| Some(format!("datasets/{id}/{}", file["path"].as_str()?)))
            .collect();
        listed.sort();
        let stored = everything_below(runtime, &blobs, "datasets")?;
        ensure!(stored == listed, "stored {stored:?}, listed {listed:?}");
        Ok(())
    }

    fn logs(&self) -> String {
        self.coordinators
            .iter()
            .flatten()
            .map(ServiceUnderTest::log)
            .collect::<Vec<_>>()
            .join("\n--- the other coordinator\n")
    }
}

/// Hash of the data set as one undisturbed worker makes it, on SQLite and a directory.
fn undisturbed() -> &'static str {
    static HASH: std::sync::OnceLock<String> = std::sync::OnceLock::new();
    HASH.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let start = Start {
            workers: 1,
            ..Start::default()
        };
        let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
        let id = service.submit(&job()).unwrap().job_id.to_string();
        let status = service.wait_for(&id, |status| status.state.is_final()).unwrap();
        service.terminate().unwrap();
        assert_eq!(status.state, JobState::Succeeded, "{status:?}");
        status.dataset_sha256.unwrap()
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

/// What lies below a key, sorted: in a directory every file, also those that its store does not list.
fn everything_below(
    runtime: &tokio::runtime::Runtime,
    blobs: &Blobs,
    key: &str,
) -> anyhow::Result<Vec<String>> {
    fn walk(folder: &Path, key: &str, found: &mut Vec<String>) -> std::io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let key = format!("{key}/{}", entry.file_name().to_string_lossy());
            if entry.file_type()?.is_dir() {
                walk(&entry.path(), &key, found)?;
            } else {
                found.push(key);
            }
        }
        Ok(())
    }
    let Some(folder) = blobs.local_path(key) else {
        return Ok(runtime.block_on(blobs.list(key))?);
    };
    loop {
        let mut found = Vec::new();
        match walk(&folder, key, &mut found) {
            // Something was deleted while it was looked at.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound && folder.exists() => {}
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error.into()),
            _ => {
                found.sort();
                return Ok(found);
            }
        }
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
