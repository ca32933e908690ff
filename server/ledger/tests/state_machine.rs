//! The ledger against a model of it, under any order of begin, commit, loss, release and cancel, by
//! workers that may be late or gone.

#![allow(
    clippy::too_many_lines,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

use hydroflex_ledger::transition::{AfterLoss, ShardState, after_loss};
use hydroflex_ledger::{Claim, CommitOutcome, Ledger, NewJob, ShardKind, ShardResult};
use hydroflex_openapi::status::{JobState, TimeSplit};
use proptest::prelude::*;
use std::collections::BTreeMap;

#[derive(Debug, Clone)]
enum Step {
    Begin(usize),
    /// Commits, loses or releases one of the claims ever handed out, valid or not.
    Commit(usize),
    Lose(usize),
    Release(usize),
    GiveUpWorker(usize),
    Cancel,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        6 => (0_usize..3).prop_map(Step::Begin),
        4 => (0_usize..64).prop_map(Step::Commit),
        5 => (0_usize..64).prop_map(Step::Lose),
        1 => (0_usize..64).prop_map(Step::Release),
        1 => (0_usize..3).prop_map(Step::GiveUpWorker),
        1 => Just(Step::Cancel),
    ]
}

/// What the model knows about a shard: keyed by its first run and number of runs, which never occur
/// twice in a tree of halvings.
#[derive(Debug, Clone, Copy)]
struct Shard {
    state: ShardState,
    epoch: u64,
    attempt: u64,
    is_half: bool,
    holder: usize,
}

struct Model {
    shards: BTreeMap<(u64, u64), Shard>,
    done: u64,
    failed: u64,
    cancelled: bool,
}

impl Model {
    fn lose(&mut self, key: (u64, u64), epoch: u64) -> bool {
        let shard = self.shards.get_mut(&key).unwrap();
        if shard.state != ShardState::Running || shard.epoch != epoch {
            return false;
        }
        match after_loss(shard.attempt, key.1, shard.is_half) {
            AfterLoss::Retry => shard.state = ShardState::Open,
            AfterLoss::Halve { left, right } => {
                shard.state = ShardState::Halved;
                let half = Shard {
                    state: ShardState::Open,
                    epoch: 0,
                    attempt: 0,
                    is_half: true,
                    holder: usize::MAX,
                };
                self.shards.insert((key.0, left), half);
                self.shards.insert((key.0 + left, right), half);
            }
            AfterLoss::GiveUp => {
                shard.state = ShardState::Dead;
                self.done += 1;
                self.failed += 1;
            }
        }
        true
    }

    fn valid(&self, claim: &Claim) -> bool {
        let shard = self.shards[&key(claim)];
        shard.state == ShardState::Running && shard.epoch == claim.shard.epoch
    }
}

fn key(claim: &Claim) -> (u64, u64) {
    (claim.shard.first_run, claim.shard.run_count)
}

const SIZES: [u64; 3] = [3, 1, 2];

async fn play(steps: Vec<Step>) {
    let folder = tempfile::tempdir().unwrap();
    let url = format!("sqlite:{}", folder.path().join("ledger.sqlite").display());
    let ledger = Ledger::create(&url).await.unwrap();
    let spec = serde_json::from_value(serde_json::json!({ "runs": 6, "settling_runs": 0 })).unwrap();
    let new = NewJob {
        spec,
        machine_sha256: String::new(),
        settling_shards: Vec::new(),
        run_shards: SIZES.to_vec(),
        notices: Vec::new(),
    };
    let job = ledger.create_job(&new, None).await.unwrap().id();

    let mut model = Model {
        shards: BTreeMap::new(),
        done: 0,
        failed: 0,
        cancelled: false,
    };
    let mut first = 0;
    for size in SIZES {
        let shard = Shard {
            state: ShardState::Open,
            epoch: 0,
            attempt: 0,
            is_half: false,
            holder: usize::MAX,
        };
        model.shards.insert((first, size), shard);
        first += size;
    }
    let mut names: Vec<String> = (0..3).map(|number| format!("w{number}-0")).collect();
    for name in &names {
        ledger.register_worker(name, Some("x86-64-v3")).await.unwrap();
    }
    let mut claims: Vec<Claim> = Vec::new();

    for (number, step) in steps.into_iter().enumerate() {
        match step {
            Step::Begin(worker) => {
                let expected = model
                    .shards
                    .iter()
                    .find(|(_, shard)| shard.state == ShardState::Open && !model.cancelled)
                    .map(|(key, _)| *key);
                let claim = ledger.begin_shard(&names[worker]).await.unwrap();
                assert_eq!(claim.as_ref().map(key), expected);
                if let Some(claim) = claim {
                    let shard = model.shards.get_mut(&key(&claim)).unwrap();
                    shard.state = ShardState::Running;
                    shard.epoch += 1;
                    shard.attempt += 1;
                    shard.holder = worker;
                    assert_eq!(
                        (claim.shard.epoch, claim.shard.attempt),
                        (shard.epoch, shard.attempt)
                    );
                    claims.push(claim);
                }
            }
            Step::Commit(pick) if !claims.is_empty() => {
                let claim = &claims[pick % claims.len()];
                // Every attempt hands in other bytes, so that "the same commit again" means what it says.
                let object = claim.object();
                let result = ShardResult {
                    sha256: object.clone(),
                    object,
                    size_bytes: 1,
                    failed_runs: 0,
                    spent: TimeSplit::default(),
                };
                let shard = model.shards[&key(claim)];
                let again = shard.state == ShardState::Committed && shard.epoch == claim.shard.epoch;
                let valid = model.valid(claim);
                let outcome = ledger.commit_shard(claim, &result).await.unwrap();
                let expected = if valid || again {
                    CommitOutcome::Committed
                } else {
                    CommitOutcome::Fenced
                };
                assert_eq!(outcome, expected, "{claim:?}");
                if valid {
                    model.shards.get_mut(&key(claim)).unwrap().state = ShardState::Committed;
                    model.done += claim.shard.run_count;
                }
            }
            Step::Lose(pick) if !claims.is_empty() => {
                let claim = &claims[pick % claims.len()];
                let lost = ledger
                    .lose_shard(claim.shard.id, claim.shard.epoch, "lost")
                    .await
                    .unwrap();
                assert_eq!(lost, model.lose(key(claim), claim.shard.epoch));
            }
            Step::Release(pick) if !claims.is_empty() => {
                let claim = &claims[pick % claims.len()];
                let valid = model.valid(claim);
                assert_eq!(ledger.release_shard(claim).await.unwrap(), valid);
                if valid {
                    let shard = model.shards.get_mut(&key(claim)).unwrap();
                    shard.state = ShardState::Open;
                    shard.attempt -= 1;
                }
            }
            Step::GiveUpWorker(worker) => {
                ledger.give_up_worker(&names[worker], "gone").await.unwrap();
                let held: Vec<_> = model
                    .shards
                    .iter()
                    .filter(|(_, shard)| shard.state == ShardState::Running && shard.holder == worker)
                    .map(|(key, shard)| (*key, shard.epoch))
                    .collect();
                for (key, epoch) in held {
                    assert!(model.lose(key, epoch));
                }
                names[worker] = format!("w{worker}-{}", number + 1);
                ledger
                    .register_worker(&names[worker], Some("x86-64-v3"))
                    .await
                    .unwrap();
            }
            Step::Cancel => {
                let over = model.cancelled;
                assert_eq!(ledger.cancel_job(job).await.unwrap(), !over);
                model.cancelled = true;
                for shard in model.shards.values_mut() {
                    if matches!(shard.state, ShardState::Open | ShardState::Running) {
                        shard.state = ShardState::Cancelled;
                    }
                }
            }
            Step::Commit(_) | Step::Lose(_) | Step::Release(_) => {}
        }

        // After every step the two agree, and every run is accounted for at most once.
        let record = ledger.job(job).await.unwrap().unwrap();
        assert_eq!(record.progress.runs_done, model.done);
        assert_eq!(record.progress.runs_failed, model.failed);
        assert_eq!(record.state == JobState::Cancelled, model.cancelled);
        let settled = ledger.settled_shards(job, ShardKind::Runs, 0, 100).await.unwrap();
        let mut next = 0;
        for shard in &settled {
            assert!(shard.first_run >= next, "a run is delivered twice");
            next = shard.first_run + shard.run_count;
            assert_eq!(
                shard.state,
                model.shards[&(shard.first_run, shard.run_count)].state
            );
        }
        assert_eq!(
            settled.iter().map(|shard| shard.run_count).sum::<u64>(),
            model.done
        );
        // Nothing is lost: what is not done is open, running or cancelled.
        let alive: u64 = model
            .shards
            .iter()
            .filter(|(_, shard)| {
                matches!(
                    shard.state,
                    ShardState::Open | ShardState::Running | ShardState::Cancelled
                )
            })
            .map(|((_, count), _)| count)
            .sum();
        assert_eq!(alive + model.done, 6);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn the_ledger_agrees_with_its_model(steps in proptest::collection::vec(step(), 1..60)) {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        runtime.block_on(play(steps));
    }
}
