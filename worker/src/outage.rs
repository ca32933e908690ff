//! How a worker bears a store that is away: nothing is charged to the runs, and it asks less and less often.

use std::time::Duration;

/// Pauses between shards while the store takes or gives nothing.
#[derive(Debug)]
pub(crate) struct Outage {
    longest: Duration,
    refusals: u32,
}

impl Outage {
    /// None yet; pauses grow up to `longest`.
    pub(crate) fn new(longest: Duration) -> Self {
        Self { longest, refusals: 0 }
    }

    /// The store has refused what a shard needs.
    pub(crate) fn refused(&mut self) {
        self.refusals = self.refusals.saturating_add(1);
    }

    /// The store has taken an object.
    pub(crate) fn over(&mut self) {
        self.refusals = 0;
    }

    /// How long to wait before the next shard is begun; `None` if all is well.
    pub(crate) fn pause(&self) -> Option<Duration> {
        let doublings = self.refusals.checked_sub(1)?.min(5);
        Some(self.longest / (32 >> doublings))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_to_the_longest_and_end_with_the_outage() {
        let mut outage = Outage::new(Duration::from_secs(32));
        assert_eq!(outage.pause(), None);
        let pauses: Vec<u64> = (0..8)
            .filter_map(|_| {
                outage.refused();
                outage.pause().map(|pause| pause.as_secs())
            })
            .collect();
        assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 32, 32]);
        outage.over();
        assert_eq!(outage.pause(), None);
    }
}
