//! Which workers are gone: by their beats, counted with our own monotonic clock, and, on this
//! machine, by their process.

use hydroflex_ledger::{Beat, JobRecord, identity};
use hydroflex_openapi::id::JobId;
use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

/// A gap between two looks counts for at most this much: if the database or this process stood still
/// for a minute, no worker is to blame for a beat that nobody could write or see.
const LONGEST_STEP: Duration = Duration::from_secs(1);

/// Watches beats over time.
#[derive(Debug)]
pub struct Watch {
    lease: Duration,
    last_look: Option<Instant>,
    seen: HashMap<String, (u64, Duration)>,
    stranded: HashSet<JobId>,
}

impl Watch {
    /// Gives workers up whose beat stands still for `lease`.
    #[must_use]
    pub fn new(lease: Duration) -> Self {
        Self {
            lease,
            last_look: None,
            seen: HashMap::new(),
            stranded: HashSet::new(),
        }
    }

    /// Takes the beats of the workers that count as alive; returns those that are gone, with why.
    pub fn look(&mut self, now: Instant, beats: &[Beat]) -> Vec<(String, String)> {
        let step = self
            .last_look
            .map_or(Duration::ZERO, |last| now.saturating_duration_since(last));
        self.last_look = Some(now);
        let mut gone = Vec::new();
        let mut seen = HashMap::with_capacity(beats.len());
        for Beat { worker, beat, .. } in beats {
            let still = match self.seen.get(worker) {
                Some((last, still)) if last == beat => *still + step.min(LONGEST_STEP),
                _ => Duration::ZERO,
            };
            if identity::is_dead_here(worker) {
                gone.push((worker.clone(), "its worker process has ended".to_owned()));
            } else if still >= self.lease {
                let reason = format!("its worker was silent for {} s", self.lease.as_secs_f64());
                gone.push((worker.clone(), reason));
            } else {
                seen.insert(worker.clone(), (*beat, still));
            }
        }
        self.seen = seen;
        gone
    }

    /// True if a begun job waits for workers of an instruction-set level that no worker has, while others
    /// are there; once for each time that it comes to that.
    pub fn becomes_stranded(&mut self, job: &JobRecord, beats: &[Beat]) -> bool {
        let mut levels = beats
            .iter()
            .filter_map(|beat| beat.instruction_set.as_ref())
            .peekable();
        let stranded = job
            .instruction_set
            .as_ref()
            .is_some_and(|needed| levels.peek().is_some() && levels.all(|level| level != needed));
        if stranded {
            self.stranded.insert(job.id)
        } else {
            self.stranded.remove(&job.id);
            false
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn beat(worker: &str, beat: u64) -> Beat {
        Beat {
            worker: worker.to_owned(),
            beat,
            instruction_set: None,
        }
    }

    #[test]
    fn a_silent_worker_is_gone_and_a_beating_one_is_not() {
        let start = Instant::now();
        let mut watch = Watch::new(Duration::from_secs(3));
        for second in 0..10 {
            let now = start + Duration::from_secs(second);
            let gone = watch.look(now, &[beat("quiet", 7), beat("lively", second)]);
            let names: Vec<&str> = gone.iter().map(|(name, _)| name.as_str()).collect();
            // Ours is a watch, not a ledger: it names the worker again and again until it is given up.
            assert_eq!(
                names.contains(&"quiet"),
                second >= 3 && (second - 3) % 4 == 0,
                "second {second}"
            );
            assert!(!names.contains(&"lively"));
        }
    }

    #[test]
    fn a_pause_of_the_watcher_is_nobodys_silence() {
        let start = Instant::now();
        let mut watch = Watch::new(Duration::from_secs(3));
        assert!(watch.look(start, &[beat("a", 1)]).is_empty());
        let an_hour_later = start + Duration::from_hours(1);
        assert!(watch.look(an_hour_later, &[beat("a", 1)]).is_empty());
    }
}
