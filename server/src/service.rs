//! A whole service in one call: coordinator, REST interface, local worker processes.

use crate::coordinator::supervise::{SuperviseConfig, Supervisor};
use crate::coordinator::{Coordinator, CoordinatorConfig};
use crate::http::{self, AppState};
use anyhow::Context;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::{Ledger, clock};
use hydroflex_worker::shard_loop::RunLimits;
use nix::fcntl::{Flock, FlockArg};
use std::fs::File;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// Time for open requests when the service stops.
const GRACE: Duration = Duration::from_secs(3);

/// How long a store that is just starting is waited for.
const PATIENCE: Duration = Duration::from_mins(1);
/// How long objects of no data set are left alone: longer than a coordinator of a build that announces no
/// uploads takes for one.
const ORPHAN_GRACE: Duration = Duration::from_mins(10);

/// How to run a service.
#[derive(Debug, Clone)]
pub struct ServiceConfig {
    /// Directory of the embedded database, store, caches and logs; made if absent.
    pub data: PathBuf,
    /// Database URL; the embedded database if absent.
    pub database: Option<String>,
    /// Store URL; a directory below `data` if absent.
    pub store: Option<String>,
    /// Directory for reduced bodies; below `data` if absent.
    pub cache: Option<PathBuf>,
    /// Local worker processes.
    pub workers: usize,
    /// Local trainer processes: trainings that go on at once. They share the cores.
    pub trainers: usize,
    /// The hydroflex binary, from which local processes are started.
    pub executable: PathBuf,
    /// File for what local processes say; standard error if absent.
    pub worker_log: Option<PathBuf>,
    /// Silence after which a worker is given up.
    pub lease: Duration,
    /// Whether requests need an API key.
    pub keys: bool,
    /// Unfinished jobs above which no more are accepted.
    pub most_jobs: u64,
    /// What a local worker's run may take.
    pub limits: RunLimits,
}

impl ServiceConfig {
    /// The defaults for a data directory: everything embedded, a worker for every core.
    ///
    /// # Errors
    /// If this program cannot tell where its binary is.
    pub fn new(data: impl Into<PathBuf>) -> anyhow::Result<Self> {
        Ok(Self {
            data: data.into(),
            database: None,
            store: None,
            cache: None,
            workers: cores(),
            trainers: 1,
            executable: std::env::current_exe().context("cannot find the hydroflex binary")?,
            worker_log: None,
            lease: Duration::from_secs(10),
            keys: false,
            most_jobs: 1000,
            limits: RunLimits::default(),
        })
    }
}

/// Cores that this process may use.
#[must_use]
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

/// A running service.
pub struct Service {
    address: SocketAddr,
    state: AppState,
    stop: CancellationToken,
    coordinator: JoinHandle<()>,
    server: JoinHandle<std::io::Result<()>>,
    supervisor: Supervisor,
    // Held while we live: the kernel lets go of it however we end.
    _lock: Flock<File>,
}

/// Starts a service on a listener. It answers when this returns.
///
/// # Errors
/// If the directory is in use, the database or the store cannot be opened, or a thread not started.
pub async fn start(config: ServiceConfig, listener: TcpListener) -> anyhow::Result<Service> {
    let data = prepare_directory(&config.data)?;
    let lock = lock_directory(&data)?;
    let database = match &config.database {
        Some(url) => url.clone(),
        None => format!("sqlite:{}", data.join("ledger.sqlite").display()),
    };
    let store = match &config.store {
        Some(url) => url.clone(),
        None => format!("file://{}", data.join("store").display()),
    };
    let cache = prepare_directory(&config.cache.unwrap_or_else(|| data.join("cache")))?;
    let ledger = Ledger::create(&database)
        .await
        .context("cannot open the database")?;
    let blobs = Blobs::open(&store).context("cannot open the store")?;
    blobs
        .wait_until_there(PATIENCE)
        .await
        .context("the store does not answer")?;
    let coordinator = Coordinator::new(
        ledger,
        blobs,
        CoordinatorConfig {
            scratch: data.join("scratch"),
            cache: cache.clone(),
            workers: config.workers,
            lease: config.lease,
            most_jobs: config.most_jobs,
            orphan_grace: ORPHAN_GRACE,
        },
    );
    let mut state = AppState::new(coordinator.clone());
    if config.keys {
        state = state.behind_keys();
        let now_ms = clock::now_ms();
        if state
            .ledger()
            .keys()
            .await?
            .iter()
            .all(|key| key.ended(now_ms).is_some())
        {
            tracing::warn!(
                "every request needs a key, and there is none: `hydroflex key create --scopes submit,read,predict` \
                 with the same --data or --database makes one"
            );
        }
    }
    let stop = CancellationToken::new();
    let supervisor = Supervisor::start(SuperviseConfig {
        executable: config.executable,
        database,
        store,
        cache,
        workers: config.workers,
        trainers: config.trainers,
        trainer_threads: (cores() / config.trainers.max(1)).max(1),
        log: config.worker_log,
        longest_stop: 2 * config.lease,
        limits: config.limits,
    })?;
    let address = listener.local_addr()?;
    let server = http::serve::serve(listener, http::router(state.clone()), stop.clone());
    Ok(Service {
        address,
        state,
        coordinator: tokio::spawn(coordinator.run(stop.clone())),
        server: tokio::spawn(server),
        stop,
        supervisor,
        _lock: lock,
    })
}

impl Service {
    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Base of its URLs, without a slash at the end.
    #[must_use]
    pub fn url(&self) -> String {
        let mut reachable = self.address;
        if reachable.ip().is_unspecified() {
            let loopback = match reachable {
                SocketAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
                SocketAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
            };
            reachable.set_ip(loopback);
        }
        format!("http://{reachable}")
    }

    /// What its handlers use.
    #[must_use]
    pub fn state(&self) -> &AppState {
        &self.state
    }

    /// Stops: no new requests, workers give their shards back, everything is closed.
    pub async fn stop(self) {
        self.stop.cancel();
        let supervisor = self.supervisor;
        let children = tokio::task::spawn_blocking(move || supervisor.stop());
        let _ = self.coordinator.await;
        // Event streams stay open as long as their jobs: they are cut off after a moment.
        let abort = self.server.abort_handle();
        if tokio::time::timeout(GRACE, self.server).await.is_err() {
            abort.abort();
        }
        let _ = children.await;
        self.state.ledger().close().await;
    }
}

/// Waits for Ctrl-C or SIGTERM.
///
/// # Errors
/// If signals cannot be listened for.
pub async fn until_told_to_stop() -> std::io::Result<()> {
    let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
    tokio::select! {
        result = tokio::signal::ctrl_c() => result,
        _ = terminate.recv() => Ok(()),
    }
}

fn prepare_directory(data: &Path) -> anyhow::Result<PathBuf> {
    std::fs::create_dir_all(data)
        .with_context(|| format!("cannot make {}; --data takes another directory", data.display()))?;
    // Workers may run elsewhere: they get absolute paths.
    data.canonicalize()
        .with_context(|| format!("cannot find {}", data.display()))
}

/// Two coordinators on one embedded database would both work, but two supervisors would start twice
/// the workers, and each would clear the other's scratch directory.
fn lock_directory(data: &Path) -> anyhow::Result<Flock<File>> {
    let path = data.join("lock");
    let file = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(&path)
        .with_context(|| format!("cannot open {}", path.display()))?;
    Flock::lock(file, FlockArg::LockExclusiveNonblock)
        .map_err(|(_, error)| anyhow::anyhow!("{} is in use by another hydroflex ({error})", data.display()))
}
