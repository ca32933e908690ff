//! How much is estimated at once. What is beyond is refused at once, so that what is accepted keeps
//! its latency: a queue without an end would make everybody wait.
//!
//! Small requests are answered on the threads that read them. Each first joins the end of the queue
//! (see [`Gate::inline`]), so that everything that has arrived is known before anything is computed, and
//! is refused when what stands before it would take longer than [`WAIT`]: the bytes that wait times
//! what a byte took lately. Long ones wait for a thread of their own. Large bodies (see
//! [`crate::http::body`]) are asked about before they are received, since nobody can count what nobody has
//! read yet: a few at once have a [place](Gate::large), the others wait no longer than small requests may.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// What a request may have to wait for those before it.
pub const WAIT: Duration = Duration::from_millis(25);
/// What a request costs beside its body: reading the head, finding the model, writing the answer.
/// `tests/bench/serving.py --only http` measures it with the rest; this is the smaller part of it.
const REQUEST_NS: u64 = 10_000;
/// Smallest body that says what a byte costs.
const TELLING_BYTES: u64 = 1 << 10;
/// Weight of a new measurement: one in this many.
const MEMORY: u64 = 16;
/// What is believed of a byte, in ps: a machine that stands still for a moment is no slow machine.
const BELIEVED_PS: [u64; 2] = [50, 100_000];
/// Recordings that wait for a thread, per core.
const WAITING_PER_CORE: usize = 4;
/// Recordings that are received at once.
const UPLOADS: usize = 64;
/// Large bodies that are received or computed at once, per core: one while another is computed.
const LARGE_PER_CORE: usize = 2;
/// Refused bodies whose rest is read away at once.
const LEFTOVERS: usize = 16;
/// Streaming sessions at once.
const SESSIONS: usize = 10_000;

/// The service estimates as much as it can already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Busy;

/// What a body is: what a byte of it costs depends on that.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Numbers written out.
    Text,
    /// Numbers as they are in memory.
    Bytes,
}

/// What is being done now.
pub struct Gate {
    /// Expected time of all that waits or is computed on the threads that answer everybody.
    backlog_ns: AtomicU64,
    most_ns: u64,
    /// What a byte took lately, by [`Work`].
    byte_ps: [AtomicU64; 2],
    threads: Arc<Semaphore>,
    waiting: AtomicUsize,
    waiting_limit: usize,
    uploads: Arc<Semaphore>,
    wait: Duration,
    large: Arc<Semaphore>,
    leftovers: Arc<Semaphore>,
    sessions: Arc<Semaphore>,
}

impl Default for Gate {
    fn default() -> Self {
        Self::new(crate::service::cores(), WAIT)
    }
}

/// Work that counts until this is dropped.
pub struct Ticket<'g> {
    gate: &'g Gate,
    work: Work,
    bytes: u64,
    expected_ns: u64,
    begun: Option<Instant>,
}

impl Drop for Ticket<'_> {
    fn drop(&mut self) {
        self.gate
            .backlog_ns
            .fetch_sub(self.expected_ns, Ordering::Relaxed);
        if let Some(begun) = self.begun {
            self.gate.learn(self.work, self.bytes, begun.elapsed());
        }
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
    /// A gate before this many cores, with what a request may have to wait.
    #[must_use]
    pub fn new(cores: usize, wait: Duration) -> Self {
        let wait_ns = u64::try_from(wait.as_nanos()).unwrap_or(u64::MAX);
        Self {
            backlog_ns: AtomicU64::new(0),
            most_ns: wait_ns.saturating_mul(cores as u64),
            // Until something was measured.
            byte_ps: [AtomicU64::new(5_000), AtomicU64::new(500)],
            threads: Arc::new(Semaphore::new(cores)),
            waiting: AtomicUsize::new(0),
            waiting_limit: WAITING_PER_CORE * cores,
            uploads: Arc::new(Semaphore::new(UPLOADS)),
            wait,
            large: Arc::new(Semaphore::new(LARGE_PER_CORE * cores)),
            leftovers: Arc::new(Semaphore::new(LEFTOVERS)),
            sessions: Arc::new(Semaphore::new(SESSIONS)),
        }
    }

    /// Admits a body to be computed on the caller's thread, as soon as those before it are. A single
    /// request is never too large for an idle service.
    ///
    /// # Errors
    /// If those before it would take too long.
    pub async fn inline(&self, work: Work, bytes: usize) -> Result<Ticket<'_>, Busy> {
        let mut ticket = self.join(work, bytes as u64)?;
        // To the end of the queue: requests that have arrived are read before this one is computed, and
        // so are counted, or refused while it is still cheap.
        tokio::task::yield_now().await;
        ticket.begun = Some(Instant::now());
        Ok(ticket)
    }

    fn join(&self, work: Work, bytes: u64) -> Result<Ticket<'_>, Busy> {
        let byte_ps = self.byte_ps[work as usize].load(Ordering::Relaxed);
        let expected_ns = REQUEST_NS + bytes * byte_ps / 1000;
        let before = self.backlog_ns.fetch_add(expected_ns, Ordering::Relaxed);
        let ticket = Ticket {
            gate: self,
            work,
            bytes,
            expected_ns,
            begun: None,
        };
        if before > self.most_ns {
            return Err(Busy);
        }
        Ok(ticket)
    }

    fn learn(&self, work: Work, bytes: u64, took: Duration) {
        if bytes < TELLING_BYTES {
            return;
        }
        let took_ns = u64::try_from(took.as_nanos()).unwrap_or(u64::MAX);
        let found = (took_ns.saturating_mul(1000) / bytes).clamp(BELIEVED_PS[0], BELIEVED_PS[1]);
        let known = &self.byte_ps[work as usize];
        // A measurement that another one overtakes is lost: there are enough of them.
        let before = known.load(Ordering::Relaxed);
        known.store((before * (MEMORY - 1) + found) / MEMORY, Ordering::Relaxed);
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

    /// Admits a large body to be received and computed.
    ///
    /// # Errors
    /// If there is no place for it within the time that a request may wait.
    pub async fn large(&self) -> Result<OwnedSemaphorePermit, Busy> {
        let large = self.large.clone();
        if let Ok(place) = large.clone().try_acquire_owned() {
            return Ok(place);
        }
        match tokio::time::timeout(self.wait, large.acquire_owned()).await {
            Ok(Ok(place)) => Ok(place),
            // The semaphore is never closed.
            Ok(Err(_)) | Err(_) => Err(Busy),
        }
    }

    /// Turns of those whose rest is read away.
    pub(crate) fn leftovers(&self) -> Arc<Semaphore> {
        self.leftovers.clone()
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
    fn what_would_wait_too_long_is_refused_until_others_are_done() {
        let gate = Gate::new(2, WAIT);
        let large = gate.join(Work::Text, 1 << 30).unwrap();
        assert!(
            gate.join(Work::Bytes, 1).is_err(),
            "nothing behind what takes that long"
        );
        drop(large);
        // 25 ms on each of two cores, 10 µs beside the body, 5 ns for each byte.
        let mut small = Vec::new();
        while let Ok(ticket) = gate.join(Work::Text, 2000) {
            small.push(ticket);
        }
        assert_eq!(small.len(), 2501);
        small.pop();
        assert!(
            gate.join(Work::Text, 2000).is_ok(),
            "a refusal leaves nothing behind"
        );
        drop(small);
        assert_eq!(gate.backlog_ns.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn what_a_byte_costs_is_learned_by_kind_and_an_accident_is_not_believed() {
        let gate = Gate::new(1, WAIT);
        for _ in 0..100 {
            gate.learn(Work::Text, 10_000, Duration::from_millis(1));
        }
        let known = |work: Work| gate.byte_ps[work as usize].load(Ordering::Relaxed);
        assert!((90_000..=100_000).contains(&known(Work::Text)), "100 ns a byte");
        assert_eq!(known(Work::Bytes), 500);
        gate.learn(Work::Bytes, 10_000, Duration::from_hours(1));
        assert!(known(Work::Bytes) <= 500 + BELIEVED_PS[1] / MEMORY);
        gate.learn(Work::Bytes, 10, Duration::from_secs(1));
        assert!(
            known(Work::Bytes) <= 500 + BELIEVED_PS[1] / MEMORY,
            "too short to tell"
        );
    }

    #[tokio::test]
    async fn large_bodies_have_a_few_places() {
        let gate = Gate::new(1, Duration::ZERO);
        let first = gate.large().await.unwrap();
        let _second = gate.large().await.unwrap();
        assert_eq!(gate.large().await.map(drop), Err(Busy));
        drop(first);
        assert!(gate.large().await.is_ok());
    }

    #[tokio::test]
    async fn few_wait_for_a_thread_and_the_others_are_refused() {
        let gate = Arc::new(Gate::new(1, WAIT));
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
