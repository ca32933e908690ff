//! How much is estimated at once. What is beyond is refused at once, so that what is accepted keeps
//! its latency: a queue without an end would make everybody wait.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Windows that wait for or are in computation on the threads that answer everybody: at about a
/// microsecond each, what the last of them waits for.
const INLINE_WINDOWS: usize = 8192;
/// Recordings that wait for a thread, per core.
const WAITING_PER_CORE: usize = 4;
/// Recordings that are received at once.
const UPLOADS: usize = 64;
/// Streaming sessions at once.
const SESSIONS: usize = 10_000;

/// The service estimates as much as it can already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Busy;

/// What is being done now.
pub struct Gate {
    windows: AtomicUsize,
    threads: Arc<Semaphore>,
    waiting: AtomicUsize,
    waiting_limit: usize,
    uploads: Arc<Semaphore>,
    sessions: Arc<Semaphore>,
}

impl Default for Gate {
    fn default() -> Self {
        Self::new(crate::service::cores())
    }
}

/// Windows that are counted until this is dropped.
pub struct Ticket<'g> {
    gate: &'g Gate,
    windows: usize,
}

impl Drop for Ticket<'_> {
    fn drop(&mut self) {
        self.gate.windows.fetch_sub(self.windows, Ordering::Relaxed);
    }
}

/// Counts a waiting recording, even one whose client goes away while it waits.
struct Waiting<'g>(&'g AtomicUsize);

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Gate {
    /// A gate before this many cores.
    #[must_use]
    pub fn new(cores: usize) -> Self {
        Self {
            windows: AtomicUsize::new(0),
            threads: Arc::new(Semaphore::new(cores)),
            waiting: AtomicUsize::new(0),
            waiting_limit: WAITING_PER_CORE * cores,
            uploads: Arc::new(Semaphore::new(UPLOADS)),
            sessions: Arc::new(Semaphore::new(SESSIONS)),
        }
    }

    /// Admits windows to be computed on the caller's thread. A single request is never too large
    /// for an idle service.
    ///
    /// # Errors
    /// If too many are waiting.
    pub fn windows(&self, windows: usize) -> Result<Ticket<'_>, Busy> {
        let before = self.windows.fetch_add(windows, Ordering::Relaxed);
        let ticket = Ticket { gate: self, windows };
        if before > 0 && before + windows > INLINE_WINDOWS {
            return Err(Busy);
        }
        Ok(ticket)
    }

    /// Waits for a thread of its own, for what takes long.
    ///
    /// # Errors
    /// If too many wait already.
    pub async fn thread(&self) -> Result<OwnedSemaphorePermit, Busy> {
        if let Ok(permit) = self.threads.clone().try_acquire_owned() {
            return Ok(permit);
        }
        let before = self.waiting.fetch_add(1, Ordering::Relaxed);
        let _waiting = Waiting(&self.waiting);
        if before >= self.waiting_limit {
            return Err(Busy);
        }
        // The semaphore is never closed.
        self.threads.clone().acquire_owned().await.map_err(|_| Busy)
    }

    /// Admits a recording to be received.
    ///
    /// # Errors
    /// If too many are.
    pub fn upload(&self) -> Result<OwnedSemaphorePermit, Busy> {
        self.uploads.clone().try_acquire_owned().map_err(|_| Busy)
    }

    /// Admits a streaming session.
    ///
    /// # Errors
    /// If there are too many.
    pub fn session(&self) -> Result<OwnedSemaphorePermit, Busy> {
        self.sessions.clone().try_acquire_owned().map_err(|_| Busy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_beyond_the_limit_are_refused_until_others_are_done() {
        let gate = Gate::new(2);
        let large = gate.windows(10 * INLINE_WINDOWS).unwrap();
        assert!(gate.windows(1).is_err(), "nothing beside more than the limit");
        drop(large);
        let most = gate.windows(INLINE_WINDOWS - 1).unwrap();
        let last = gate.windows(1).unwrap();
        assert!(gate.windows(1).is_err());
        drop(last);
        assert!(gate.windows(1).is_ok(), "a refusal leaves nothing behind");
        drop(most);
    }

    #[tokio::test]
    async fn few_wait_for_a_thread_and_the_others_are_refused() {
        let gate = Arc::new(Gate::new(1));
        let running = gate.thread().await.unwrap();
        let waiting: Vec<_> = (0..WAITING_PER_CORE)
            .map(|_| {
                let gate = gate.clone();
                tokio::spawn(async move { gate.thread().await.map(drop) })
            })
            .collect();
        while gate.waiting.load(Ordering::Relaxed) < WAITING_PER_CORE {
            tokio::task::yield_now().await;
        }
        assert_eq!(gate.thread().await.map(drop), Err(Busy));
        drop(running);
        for task in waiting {
            assert_eq!(task.await.unwrap(), Ok(()));
        }
        assert!(gate.thread().await.is_ok());
    }
}
