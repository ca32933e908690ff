//! The linear part of our network where the payload differs from run to run and nobody tells it.
//!
//! A boom with another payload is another boom: the coefficients of the best linear map follow the payload as they
//! follow the lengths. The window itself tells the payload, from how much oil pressure moved the boom how fast, but only
//! once something is known about it: a map whose coefficients follow the lengths alone is some kilograms off, one whose
//! coefficients also follow this first estimate some hundred grams, and so on.
//!
//! ```text
//! e₀ = map₀(window; lengths),   e_k = map_k(window; lengths, e_{k−1}),   y = map(window; lengths, e_last)
//! ```
//!
//! in units of the payload's range in training. Exactly without payload a machine is another one: no mass hangs on the interface,
//! and its modes differ. Where training runs are of both kinds, windows whose estimate is next to nothing get a map of their own.

use crate::evaluate::metrics::quantile;
use crate::least_squares::TargetRows;
use crate::scaling::Scaling;
use crate::scheduled::{Effort, NormalEquationsError, RANGE_FACTOR, Sample, ScheduledMap};
use faer::Mat;
use hydroflex_openapi::model::{EmptyMachine, FollowedPayload, Schedule};
use rayon::prelude::*;

/// Degrees of the later estimates, and of the map that follows the last one. (Two estimates fewer leave
/// half as much error again on the published boom.)
const ESTIMATE_DEGREES: [u32; 3] = [3, 3, 4];
const DEGREE: u32 = 4;
/// Most unknowns of these maps, and windows for each: fewer would be learnt by heart.
const MAX_UNKNOWNS: usize = 7600;
const WINDOWS_PER_UNKNOWN: usize = 8;
/// Ridges tried, from the smallest possible: these maps have many windows, and small ridges win.
const RIDGES_TRIED: usize = 4;
/// Fewest runs without payload in training, and in validation, for a map of their own.
const EMPTY_RUNS: [usize; 2] = [8, 2];

/// Part of the windows without payload whose estimates are below the limit, where that costs the others little.
const EMPTY_PART: f64 = 0.999;
/// How little, in the least error.
const SPARED: f64 = 0.1;
/// Most mean error, in that of the plain map, with which the payload is followed. The network makes up for more of a plain map's error, which
/// is smooth, than of one that jumps where the empty machine begins: on 2,560 `accurate` runs of the built-in boom (0 to 100 kg, a fifth empty)
/// 0.76, 0.70 and 0.58 of the plain map's error became 1.36, 1.31 and 1.15 of its network's, 0.30 and 0.23 became 0.74 and 0.48.
const WORTHWHILE: f64 = 0.5;

/// Payloads of the training and of the validation runs, kg, run by run.
#[derive(Debug, Clone, Copy)]
pub struct Payloads<'a> {
    /// Of the training runs.
    pub train: &'a [f64],
    /// Of the validation runs.
    pub judge: &'a [f64],
}

/// The linear part of a network.
#[derive(Debug, Clone, PartialEq)]
pub struct Skip {
    /// What is added to the network.
    pub map: ScheduledMap,
    /// The payload that its coefficients follow too.
    pub payload: Option<Following>,
}

/// The payload, estimate by estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct Following {
    /// Middle of the range, kg.
    pub centre_kg: f64,
    /// Half of it, kg, a little wider than the training's.
    pub half_range_kg: f64,
    /// First to last, in units of the range.
    pub estimates: Vec<ScheduledMap>,
    /// Limit in units of the range below which a machine counts as empty, and the map of empty ones.
    pub empty: Option<(f64, ScheduledMap)>,
}

impl Skip {
    /// Fits as [`ScheduledMap::fit`]; follows the payload where payloads differ and that at least halves the mean error on `judge`.
    ///
    /// # Errors
    /// As there.
    pub fn fit(
        train: Sample<'_>,
        judge: Sample<'_>,
        payloads: Option<Payloads<'_>>,
        scaling: &Scaling,
        scheduling: &[usize],
        noise: Option<&Mat<f64>>,
    ) -> Result<Self, NormalEquationsError> {
        let map = ScheduledMap::fit(train, judge, scaling, scheduling, noise, &Effort::LENGTHS)?;
        let plain = Self { map, payload: None };
        // With noise an estimate wavers, and the fits of clean windows would trust it too much.
        let Some(payloads) = payloads.filter(|_| noise.is_none()) else {
            return Ok(plain);
        };
        let Some(following) = Self::following(train, judge, payloads, scaling, scheduling) else {
            return Ok(plain);
        };
        let is_better = following.judged(judge, scaling) < WORTHWHILE * plain.judged(judge, scaling);
        Ok(if is_better { following } else { plain })
    }

    /// None where the payloads are all the same, there are too few windows, or a fit fails.
    fn following(
        train: Sample<'_>,
        judge: Sample<'_>,
        payloads: Payloads<'_>,
        scaling: &Scaling,
        scheduling: &[usize],
    ) -> Option<Self> {
        let (low, high) = (payloads.train.iter())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &kg| {
                (low.min(kg), high.max(kg))
            });
        let unknowns = MAX_UNKNOWNS.min(train.windows.len() / WINDOWS_PER_UNKNOWN);
        let window_values = train.windows.steps * train.series.width;
        // At least one product with each of the lengths and the payload.
        if high <= low || unknowns < (2 + scheduling.len()) * (window_values + 1) {
            return None;
        }
        let (centre_kg, half_range_kg) = (0.5 * (low + high), 0.5 * RANGE_FACTOR * (high - low));
        let effort = |degree| Effort {
            degree,
            unknowns,
            tried: Some(RIDGES_TRIED),
            ..Effort::LENGTHS
        };
        let wanted = [(train, payloads.train), (judge, payloads.judge)].map(|(sample, payloads)| {
            let rows = sample.series.run_rows.windows(2).zip(payloads);
            TargetRows {
                width: 1,
                values: rows
                    .flat_map(|(rows, kg)| {
                        std::iter::repeat_n((kg - centre_kg) / half_range_kg, rows[1] - rows[0])
                    })
                    .collect(),
            }
        });
        let mut found: Option<[Vec<f64>; 2]> = None;
        let mut estimates = Vec::with_capacity(1 + ESTIMATE_DEGREES.len());
        let efforts = std::iter::once(Effort::LENGTHS).chain(ESTIMATE_DEGREES.into_iter().map(effort));
        for effort in efforts {
            let [a, b] = [(train, 0), (judge, 1)].map(|(sample, part)| Sample {
                targets: &wanted[part],
                estimates: found.as_ref().map(|found| &*found[part]),
                ..sample
            });
            let map = ScheduledMap::fit(a, b, scaling, scheduling, None, &effort).ok()?;
            found = Some([a, b].map(|sample| apply_to_all(&map, sample, scaling)));
            estimates.push(map);
        }
        let [of_train, of_judge] = found?;
        let empty = empty_windows(train, judge, payloads);
        let loaded = empty.as_ref().map(|[a, b]| [rest(train, a), rest(judge, b)]);
        let [a, b] = [(train, 0, &of_train), (judge, 1, &of_judge)].map(|(sample, part, estimates)| Sample {
            only: loaded.as_ref().map(|loaded| &*loaded[part]),
            estimates: Some(estimates),
            ..sample
        });
        let map = ScheduledMap::fit(a, b, scaling, scheduling, None, &effort(DEGREE)).ok()?;
        let empty = match &empty {
            None => None,
            Some([in_train, in_judge]) => {
                let [a, b] = [(train, in_train), (judge, in_judge)].map(|(sample, only)| Sample {
                    only: Some(only),
                    ..sample
                });
                let map = ScheduledMap::fit(a, b, scaling, scheduling, None, &Effort::LENGTHS).ok()?;
                Some((map, in_judge))
            }
        };
        let empty = empty.and_then(|(of_empty, in_judge)| {
            let errors: Vec<[f64; 2]> = (0..judge.windows.len())
                .into_par_iter()
                .map(|index| {
                    [
                        error(judge, index, |window, out| {
                            map.apply(scaling, window, Some(of_judge[index]), out);
                        }),
                        error(judge, index, |window, out| {
                            of_empty.apply(scaling, window, None, out);
                        }),
                    ]
                })
                .collect();
            Some((limit(&of_judge, &errors, in_judge)?, of_empty))
        });
        Some(Self {
            map,
            payload: Some(Following {
                centre_kg,
                half_range_kg,
                estimates,
                empty,
            }),
        })
    }

    /// Scaled targets of a scaled window, and whether it took the map of empty machines.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn apply(&self, scaling: &Scaling, window: &[f32], out: &mut [f64]) -> bool {
        let Some(following) = &self.payload else {
            self.map.apply(scaling, window, None, out);
            return false;
        };
        let mut estimate = None;
        for map in &following.estimates {
            let mut next = [0.0];
            map.apply(scaling, window, estimate, &mut next);
            estimate = Some(next[0]);
        }
        match &following.empty {
            Some((below, map)) if estimate.is_some_and(|estimate| estimate < *below) => {
                map.apply(scaling, window, None, out);
                true
            }
            _ => {
                self.map.apply(scaling, window, estimate, out);
                false
            }
        }
    }

    /// The mean over the windows of the absolute error, targets summed. (Not a quantile: the few windows that take the map of
    /// another machine may be far off, and must count.)
    fn judged(&self, judge: Sample<'_>, scaling: &Scaling) -> f64 {
        let errors: Vec<f64> = (0..judge.windows.len())
            .into_par_iter()
            .map(|index| {
                error(judge, index, |window, out| {
                    self.apply(scaling, window, out);
                })
            })
            .collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    }
}

impl Following {
    /// As a model's configuration has it; `empty_gain`: see [`EmptyMachine::network_gain`].
    #[must_use]
    pub fn config(&self, empty_gain: &[f64]) -> FollowedPayload {
        let schedule = |map: &ScheduledMap| -> Schedule { map.schedule.clone() };
        FollowedPayload {
            centre_kg: self.centre_kg,
            half_range_kg: self.half_range_kg,
            estimates: self.estimates.iter().map(schedule).collect(),
            empty: self.empty.as_ref().map(|(below, map)| EmptyMachine {
                below_kg: self.centre_kg + self.half_range_kg * below,
                schedule: schedule(map),
                network_gain: empty_gain.to_vec(),
            }),
        }
    }
}

/// Estimates of all windows.
fn apply_to_all(map: &ScheduledMap, sample: Sample<'_>, scaling: &Scaling) -> Vec<f64> {
    (0..sample.windows.len())
        .into_par_iter()
        .map(|index| {
            let window = sample
                .series
                .window(sample.windows.first_row(index), sample.windows.steps);
            let mut estimate = [0.0];
            map.apply(scaling, window, sample.estimates.map(|e| e[index]), &mut estimate);
            estimate[0]
        })
        .collect()
}

/// Absolute error of an estimator of one window, scaled targets summed.
fn error(sample: Sample<'_>, index: usize, estimate: impl Fn(&[f32], &mut [f64])) -> f64 {
    let windows = &sample.windows;
    let mut found = vec![0.0; sample.targets.width];
    estimate(
        sample.series.window(windows.first_row(index), windows.steps),
        &mut found,
    );
    let wanted = sample.targets.row(windows.last_row(index));
    found.iter().zip(wanted).map(|(e, y)| (e - y).abs()).sum()
}

/// The limit of the estimates below which the second of two maps is taken, that of the windows that are `second`; none if the first is best
/// everywhere. It is the highest, up to [`EMPTY_PART`] of these windows, that leaves at most [`SPARED`] more than the least error in sum: an
/// empty machine is common, one with next to nothing on it is not.
fn limit(estimates: &[f64], errors: &[[f64; 2]], second: &[usize]) -> Option<f64> {
    let mut of_second: Vec<f64> = second.iter().map(|&index| estimates[index]).collect();
    let highest = quantile(&mut of_second, EMPTY_PART);
    let mut order: Vec<usize> = (0..estimates.len()).collect();
    order.sort_by(|a, b| estimates[*a].total_cmp(&estimates[*b]));
    let without: f64 = errors.iter().map(|of| of[0]).sum();
    // Error in sum with the limit above each window.
    let sums = order.iter().scan(without, |sum, &index| {
        *sum += errors[index][1] - errors[index][0];
        Some(*sum)
    });
    let sums: Vec<f64> = sums.collect();
    let least = sums.iter().copied().fold(f64::INFINITY, f64::min);
    if least >= without {
        return None;
    }
    let of_place = |place: usize| {
        let here = estimates[order[place]];
        let next = order.get(place + 1).map_or(here + 1.0, |next| estimates[*next]);
        0.5 * (here + next)
    };
    let is_good = |place: &usize| sums[*place] <= (1.0 + SPARED) * least;
    let best = sums.iter().position(|sum| *sum <= least)?;
    let high = (0..sums.len())
        .rev()
        .filter(|place| of_place(*place) <= highest)
        .find(is_good);
    Some(of_place(high.map_or(best, |high| high.max(best))))
}

/// Windows of the runs without payload, in training and validation, where there are enough of both kinds.
fn empty_windows(train: Sample<'_>, judge: Sample<'_>, payloads: Payloads<'_>) -> Option<[Vec<usize>; 2]> {
    let is_empty = |kg: &&f64| **kg == 0.0;
    for (payloads, fewest) in [payloads.train, payloads.judge].into_iter().zip(EMPTY_RUNS) {
        let empty = payloads.iter().filter(is_empty).count();
        if empty < fewest || payloads.len() - empty < fewest {
            return None;
        }
    }
    let windows = |sample: Sample<'_>, payloads: &[f64]| -> Vec<usize> {
        let run_of = |row: usize| sample.series.run_rows.partition_point(|&first| first <= row) - 1;
        (0..sample.windows.len())
            .filter(|&index| payloads[run_of(sample.windows.first_row(index))] == 0.0)
            .collect()
    };
    let found = [windows(train, payloads.train), windows(judge, payloads.judge)];
    found.iter().all(|windows| !windows.is_empty()).then_some(found)
}

/// The windows that are not among `some`, which ascend.
fn rest(sample: Sample<'_>, some: &[usize]) -> Vec<usize> {
    (0..sample.windows.len())
        .filter(|index| some.binary_search(index).is_err())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runs::{RunSamples, Runs};
    use crate::window::{Series, Windows};
    use hydroflex_openapi::channel::{Channel, ChannelRole};
    use hydroflex_openapi::job::WindowCut;

    const STEPS: usize = 4;

    /// A force that is the payload times an acceleration, in a window that shows both, and a signal whose effect goes with the
    /// square of the payload; without payload it is another machine.
    struct Case {
        series: Series,
        windows: Windows,
        targets: TargetRows,
        scaling: Scaling,
        payloads_kg: Vec<f64>,
    }

    fn case(seed: u64, payload_kg: impl Fn(usize, f64) -> f64) -> Case {
        let mut state = seed;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 23) - 1.0
        };
        let names = ["length_lift_m", "acceleration", "force", "signal"];
        let channel = |name: &&str| Channel {
            name: (*name).to_owned(),
            unit: "m".to_owned(),
            quantity: String::new(),
            frame: None,
            role: ChannelRole::Sensor,
        };
        let mut values = Vec::new();
        let mut payloads_kg = Vec::new();
        let runs = (0..80)
            .map(|run: usize| {
                let kg = payload_kg(run, 50.0 + 50.0 * random());
                payloads_kg.push(kg);
                let column = |middle: f64, size: f64, random: &mut dyn FnMut() -> f64| -> Vec<f64> {
                    (0..60).map(|_| middle + size * random()).collect()
                };
                let length = column(1.0, 0.1, &mut random);
                let acceleration = column(1.0, 0.4, &mut random);
                let force = acceleration.iter().map(|a| a * kg).collect();
                let signal = column(0.0, 1.0, &mut random);
                let gain = if kg == 0.0 { 3.0 } else { (kg / 50.0).powi(2) };
                values.extend(signal.iter().map(|s| gain * s));
                RunSamples {
                    run_id: run as u64,
                    columns: vec![length, acceleration, force, signal],
                }
            })
            .collect();
        let runs = Runs {
            channels: names.iter().map(channel).collect(),
            sample_time_s: 0.005,
            runs,
        };
        let scaling = Scaling::fit(&runs);
        let series = Series::new(&runs, &scaling);
        let windows = Windows::new(&series.run_rows, STEPS, WindowCut::Overlapping);
        Case {
            series,
            windows,
            targets: TargetRows { width: 1, values },
            scaling,
            payloads_kg,
        }
    }

    fn sample(case: &Case) -> Sample<'_> {
        Sample {
            series: &case.series,
            windows: &case.windows,
            targets: &case.targets,
            only: None,
            estimates: None,
        }
    }

    fn fit(train: &Case, judge: &Case) -> Skip {
        let payloads = Payloads {
            train: &train.payloads_kg,
            judge: &judge.payloads_kg,
        };
        Skip::fit(
            sample(train),
            sample(judge),
            Some(payloads),
            &train.scaling,
            &[0],
            None,
        )
        .unwrap()
    }

    /// Two parts of one kind of runs, on the scales of the first.
    fn two(payload_kg: impl Fn(usize, f64) -> f64) -> [Case; 2] {
        let (train, mut judge) = (case(1, &payload_kg), case(2, &payload_kg));
        // The judge's values on the training's scales.
        for row in judge.series.values.chunks_mut(4) {
            for (c, value) in row.iter_mut().enumerate() {
                *value = train
                    .scaling
                    .scale(c, judge.scaling.unscale(c, f64::from(*value))) as f32;
            }
        }
        [train, judge]
    }

    #[test]
    fn the_payload_is_found_from_the_window_and_followed() {
        let [train, judge] = two(|_, kg| kg);
        let skip = fit(&train, &judge);
        let following = skip.payload.as_ref().unwrap();
        assert!(following.empty.is_none());
        // Each estimate is nearer than the one before.
        let mut before: Option<Vec<f64>> = None;
        let mut errors = Vec::new();
        for map in &following.estimates {
            let estimates = apply_to_all(
                map,
                Sample {
                    estimates: before.as_deref(),
                    ..sample(&judge)
                },
                &train.scaling,
            );
            let error = |(window, e): (usize, &f64)| {
                let kg = following.centre_kg + following.half_range_kg * e;
                (kg - judge.payloads_kg[judge.windows.first_row(window) / 60]).abs()
            };
            errors.push(estimates.iter().enumerate().map(error).sum::<f64>() / estimates.len() as f64);
            before = Some(estimates);
        }
        assert!(errors.windows(2).all(|pair| pair[1] < pair[0]), "{errors:?}");
        assert!(errors[3] < 0.1 * errors[0], "{errors:?}");
        let plain = Skip {
            map: ScheduledMap::fit(
                sample(&train),
                sample(&judge),
                &train.scaling,
                &[0],
                None,
                &Effort::LENGTHS,
            )
            .unwrap(),
            payload: None,
        };
        let [followed, plain] = [&skip, &plain].map(|skip| skip.judged(sample(&judge), &train.scaling));
        assert!(followed < 0.05 * plain, "{followed} {plain}");
    }

    #[test]
    fn a_machine_without_payload_has_a_map_of_its_own() {
        let [train, judge] = two(|run, kg| if run % 5 == 0 { 0.0 } else { 10.0 + 0.9 * kg });
        let skip = fit(&train, &judge);
        let (below, _) = skip.payload.as_ref().unwrap().empty.as_ref().unwrap();
        let following = skip.payload.as_ref().unwrap();
        let below_kg = following.centre_kg + following.half_range_kg * below;
        assert!((-10.0..10.0).contains(&below_kg), "{below_kg}");
        let mut estimate = [0.0];
        let errors: Vec<f64> = (0..judge.windows.len())
            .filter(|&window| judge.payloads_kg[judge.windows.first_row(window) / 60] == 0.0)
            .map(|window| {
                let first = judge.windows.first_row(window);
                skip.apply(&train.scaling, judge.series.window(first, STEPS), &mut estimate);
                (estimate[0] - judge.targets.row(first + STEPS - 1)[0]).abs()
            })
            .collect();
        // The law of the empty machine is linear: exact where its map is taken, which is nearly always.
        let exact = errors.iter().filter(|e| **e < 1e-6).count();
        assert!(
            exact as f64 > 0.98 * errors.len() as f64,
            "{exact} of {}",
            errors.len()
        );
    }

    #[test]
    fn the_limit_takes_the_empty_machines_but_spares_the_others() {
        // the first map errs by 1 on the empty machine, the second by `worse` on the others; of 100 estimates every fourth is of an
        // empty machine, and the last of these is among the others
        let empty = |k: usize| k < 24 || k == 30;
        let of = |worse: f64| {
            let estimates: Vec<f64> = (0..100).map(f64::from).collect();
            let errors: Vec<[f64; 2]> = (0..100)
                .map(|k| if empty(k) { [1.0, 0.1] } else { [0.1, worse] })
                .collect();
            let second: Vec<usize> = (0..100).filter(|k| empty(*k)).collect();
            limit(&estimates, &errors, &second)
        };
        // six others lie between: worth one empty machine where the second map is as good for them, or nearly
        assert!((30.0..31.0).contains(&of(0.1).unwrap()), "{:?}", of(0.1));
        assert!((30.0..31.0).contains(&of(0.2).unwrap()), "{:?}", of(0.2));
        // not where it costs them more; then as high as a tenth of the least error, 10.9 in sum, allows
        assert!((28.0..29.0).contains(&of(0.3).unwrap()), "{:?}", of(0.3));
        assert!((24.0..25.0).contains(&of(1.0).unwrap()), "{:?}", of(1.0));
        assert!((23.0..24.0).contains(&of(2.0).unwrap()), "{:?}", of(2.0));
        assert_eq!(limit(&[0.0, 1.0], &[[0.0, 1.0], [0.0, 1.0]], &[0]), None);
    }

    #[test]
    fn equal_payloads_and_few_windows_are_not_followed() {
        let [train, judge] = two(|_, _| 50.0);
        assert!(fit(&train, &judge).payload.is_none());
        let [mut train, judge] = two(|_, kg| kg);
        // One run in two: fewer than eight windows for each unknown.
        train.windows = Windows::new(&train.series.run_rows[..8], STEPS, WindowCut::Overlapping);
        assert!(fit(&train, &judge).payload.is_none());
    }
}
