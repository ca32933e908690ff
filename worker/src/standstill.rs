//! A shard whose count of runs stands still for too long has a run that hangs.

use crate::shard::ShardControl;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Watches the count of a shard's runs.
#[derive(Debug)]
pub(crate) struct Standstill {
    runs_done: u64,
    since: Instant,
}

impl Standstill {
    /// From `now` on.
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            runs_done: 0,
            since: now,
        }
    }

    /// True if no run has ended for longer than the runs that are counted together may take, at `limit` each.
    /// Before the first run begins, a machine is fetched and reduced: no run's time.
    pub(crate) fn is_too_long(&mut self, now: Instant, control: &ShardControl, limit: Duration) -> bool {
        let counted_together = control.counted_together.load(Ordering::Relaxed);
        let runs_done = control.runs_done.load(Ordering::Relaxed);
        if counted_together == 0 || runs_done != self.runs_done {
            *self = Self {
                runs_done,
                since: now,
            };
            return false;
        }
        let runs = u32::try_from(counted_together).unwrap_or(u32::MAX);
        now.duration_since(self.since) > limit.saturating_mul(runs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_of_one_second_is_one_second_for_each_run_that_is_counted_together() {
        let start = Instant::now();
        let after = |seconds: u64| start + Duration::from_secs(seconds);
        let limit = Duration::from_secs(1);
        let control = ShardControl::default();
        let mut standstill = Standstill::new(start);
        assert!(!standstill.is_too_long(after(100), &control, limit), "reducing");
        control.begin(64);
        assert!(!standstill.is_too_long(after(164), &control, limit));
        assert!(standstill.is_too_long(after(165), &control, limit));
        control.runs_done.store(64, Ordering::Relaxed);
        assert!(!standstill.is_too_long(after(165), &control, limit));
        assert!(!standstill.is_too_long(after(229), &control, limit));
        assert!(standstill.is_too_long(after(230), &control, limit));
    }

    #[test]
    fn runs_one_by_one_have_the_limit_each() {
        let start = Instant::now();
        let control = ShardControl::default();
        control.begin(1);
        let mut standstill = Standstill::new(start);
        let limit = Duration::from_secs(1);
        assert!(!standstill.is_too_long(start + Duration::from_millis(900), &control, limit));
        assert!(standstill.is_too_long(start + Duration::from_millis(1100), &control, limit));
    }
}
