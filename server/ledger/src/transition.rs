//! The life of a shard as a pure function: what a lost attempt leads to.
//!
//! ```text
//! open ── begin (epoch + 1, attempt + 1) ──► running ── commit (same epoch) ──► committed
//!   ▲                                          │ lost: worker gone, panic, out of limits
//!   └── attempts left ◄────────────────────────┤
//!       two open halves, shard `halved` ◄──────┤ attempts used up, several runs
//!       `dead` with its reason ◄───────────────┘ attempts used up, one run
//! ```

use std::fmt;
use std::str::FromStr;

/// Attempts at a shard before it is halved, or, if it holds one run, given up. Four, because a busy
/// night may kill a worker twice for reasons that have nothing to do with the runs in its hands.
pub const ATTEMPT_LIMIT: u64 = 4;

/// Attempts at each half of a shard that used up its own: its parent has been tried before, and a bad
/// run among 1024 good ones is ten halvings away.
pub const HALF_ATTEMPT_LIMIT: u64 = 2;

/// State of a shard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ShardState {
    /// Waits for a worker.
    Open,
    /// A worker has it.
    Running,
    /// Its object is part of the job.
    Committed,
    /// Replaced by its two halves.
    Halved,
    /// One run that could not be done; the reason is recorded.
    Dead,
    /// The job was cancelled or failed.
    Cancelled,
}

impl ShardState {
    /// As written in the database.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Running => "running",
            Self::Committed => "committed",
            Self::Halved => "halved",
            Self::Dead => "dead",
            Self::Cancelled => "cancelled",
        }
    }
}

impl fmt::Display for ShardState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for ShardState {
    type Err = ();
    fn from_str(text: &str) -> Result<Self, ()> {
        [
            Self::Open,
            Self::Running,
            Self::Committed,
            Self::Halved,
            Self::Dead,
            Self::Cancelled,
        ]
        .into_iter()
        .find(|state| state.as_str() == text)
        .ok_or(())
    }
}

/// What happens to a shard whose attempt was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterLoss {
    /// It is open again.
    Retry,
    /// It is replaced by two shards of these sizes, in run order.
    Halve {
        /// Runs of the first half.
        left: u64,
        /// Runs of the second half.
        right: u64,
    },
    /// Its only run is given up.
    GiveUp,
}

/// Decides about a shard of `run_count` runs after `attempt` attempts, all lost. `is_half` marks
/// shards that came from halving. A single run gets the full number of attempts in any case: giving
/// up loses data, halving does not.
#[must_use]
pub fn after_loss(attempt: u64, run_count: u64, is_half: bool) -> AfterLoss {
    let limit = if is_half && run_count > 1 {
        HALF_ATTEMPT_LIMIT
    } else {
        ATTEMPT_LIMIT
    };
    if attempt < limit {
        AfterLoss::Retry
    } else if run_count > 1 {
        AfterLoss::Halve {
            left: run_count / 2,
            right: run_count - run_count / 2,
        }
    } else {
        AfterLoss::GiveUp
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_isolates_one_bad_run_and_delivers_the_others() {
        let bad = 617;
        let mut open = vec![(0_u64, 1024_u64, false)];
        let (mut delivered, mut given_up, mut attempts) = (0, Vec::new(), 0);
        while let Some((first, count, is_half)) = open.pop() {
            if !(first..first + count).contains(&bad) {
                delivered += count;
                continue;
            }
            let mut attempt = 0;
            loop {
                attempt += 1;
                attempts += 1;
                match after_loss(attempt, count, is_half) {
                    AfterLoss::Retry => {}
                    AfterLoss::Halve { left, right } => {
                        open.push((first, left, true));
                        open.push((first + left, right, true));
                        break;
                    }
                    AfterLoss::GiveUp => {
                        given_up.push(first);
                        break;
                    }
                }
            }
        }
        assert_eq!(delivered, 1023);
        assert_eq!(given_up, [bad]);
        // The whole, nine halvings with two attempts each, and four attempts at the run alone.
        assert_eq!(attempts, ATTEMPT_LIMIT + 9 * HALF_ATTEMPT_LIMIT + ATTEMPT_LIMIT);
    }
}
