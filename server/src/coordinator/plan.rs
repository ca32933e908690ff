//! A job into shards: sizes from measured cost, a bounded number open at a time.
//!
//! Sizes decide how fast a job runs and nothing else: what is published never depends on them.

/// Work in a shard, by measured cost. Long enough that claiming, hashing and flushing to the disk
/// vanish beside it, short enough that a lost one is soon done again.
const SHARD_S: f64 = 1.0;

/// Work that is worth a shard: a smaller one costs more to claim, flush and commit than it does to share
/// it out.
const LEAST_S: f64 = 0.1;

/// Samples a shard may hold uncompressed: bounds the memory of a worker, which has one shard in work and one
/// on its way to the store.
const SHARD_BYTES: u64 = 64 << 20;

/// Runs of a shard while no run of the job has been measured.
const UNMEASURED_RUNS: u64 = 8;

/// Shards of a job that wait or run at a time, per worker: enough that nobody waits for the next
/// planning, few enough that a job of millions of runs costs nobody memory.
const OPEN_PER_WORKER: u64 = 4;

/// What is known when shards are planned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Situation {
    /// Runs not yet in any shard.
    pub remaining: u64,
    /// Shards that wait or run.
    pub open: u64,
    /// Workers, at least 1.
    pub workers: u64,
    /// Cost of a run, once measured.
    pub run_cost_s: Option<f64>,
    /// Uncompressed size of a run.
    pub run_bytes: u64,
}

/// Sizes of the next shards, in run order.
#[must_use]
pub fn shard_sizes(situation: Situation) -> Vec<u64> {
    let Situation {
        mut remaining,
        open,
        workers,
        run_cost_s,
        run_bytes,
    } = situation;
    let workers = workers.max(1);
    let wanted = match run_cost_s {
        // Two rounds to measure with, then the real sizes.
        None => UNMEASURED_RUNS,
        Some(cost_s) => runs_in(SHARD_S, cost_s),
    };
    let most = wanted.min((SHARD_BYTES / run_bytes.max(1)).max(1));
    let limit = match run_cost_s {
        None => 2 * workers,
        Some(_) => OPEN_PER_WORKER * workers,
    };
    // What is left evens out over the workers, and where they have other shards not below what is worth one.
    let least = run_cost_s.map_or(UNMEASURED_RUNS, |cost_s| runs_in(LEAST_S, cost_s));
    let least = if open < workers {
        least.min(remaining / workers)
    } else {
        least
    };
    let mut sizes = Vec::new();
    while remaining > 0 && open + (sizes.len() as u64) < limit {
        // Every worker gets at least two more shards out of what is left, so that none idles while
        // another one finishes a long last shard.
        let fair = remaining.div_ceil(2 * workers);
        let size = fair.max(least).min(most).clamp(1, remaining);
        sizes.push(size);
        remaining -= size;
    }
    sizes
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 1..=1e6 before the conversion"
)]
fn runs_in(seconds: f64, cost_s: f64) -> u64 {
    (seconds / cost_s.max(1e-9)).clamp(1.0, 1e6) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOOM_RUN_BYTES: u64 = 201 * 17 * 8;

    fn situation(remaining: u64, workers: u64, run_cost_s: Option<f64>) -> Situation {
        Situation {
            remaining,
            open: 0,
            workers,
            run_cost_s,
            run_bytes: BOOM_RUN_BYTES,
        }
    }

    #[test]
    fn a_small_job_reaches_every_worker() {
        for workers in 1..=16 {
            let sizes = shard_sizes(situation(80, workers, Some(1e-4)));
            assert!(
                sizes.len() as u64 >= workers,
                "{workers} workers, shards {sizes:?}"
            );
            assert_eq!(sizes.iter().sum::<u64>().min(80), sizes.iter().sum::<u64>());
        }
    }

    #[test]
    fn no_shard_is_too_small_to_be_worth_it() {
        let mut remaining = 2560;
        let mut sizes = Vec::new();
        while remaining > 0 {
            // Both workers have one when the next round is planned.
            let open = if sizes.is_empty() { 0 } else { 2 };
            let next = shard_sizes(Situation {
                open,
                ..situation(remaining, 2, Some(6e-4))
            });
            remaining -= next.iter().sum::<u64>();
            sizes.extend(next);
        }
        // 166 runs take a tenth of a second; only the very last one may be smaller.
        let (last, others) = sizes.split_last().unwrap();
        assert!(others.iter().all(|size| *size >= 166), "{sizes:?}");
        assert!(*last > 0 && sizes.len() < 12, "{sizes:?}");
    }

    #[test]
    fn a_huge_job_has_few_open_shards() {
        let sizes = shard_sizes(situation(10_000_000, 4, Some(3e-4)));
        assert_eq!(sizes.len(), 16);
        // 64 MiB of samples come before a second of work here.
        assert!(
            sizes.iter().all(|size| *size == (64 << 20) / BOOM_RUN_BYTES),
            "{sizes:?}"
        );
        let slow = shard_sizes(situation(10_000_000, 4, Some(0.2)));
        assert!(slow.iter().all(|size| *size == 5), "{slow:?}");
    }

    #[test]
    fn planning_round_by_round_covers_every_run_once() {
        let mut remaining = 1234;
        let mut rounds = 0;
        while remaining > 0 {
            let sizes = shard_sizes(situation(remaining, 3, (rounds > 0).then_some(0.01)));
            assert!(!sizes.is_empty());
            assert!(sizes.iter().all(|size| *size > 0));
            remaining -= sizes.iter().sum::<u64>();
            rounds += 1;
        }
    }

    #[test]
    fn nothing_is_planned_while_enough_is_open() {
        let full = Situation {
            open: 4,
            ..situation(80, 2, None)
        };
        assert!(shard_sizes(full).is_empty());
        assert!(shard_sizes(situation(0, 2, None)).is_empty());
    }
}
