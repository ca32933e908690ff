//! Models with random weights: for benchmarks and tests of whatever serves models, where how well
//! a model estimates does not matter and a training would only take time.

use super::Predictor;
use crate::model::weights::{Auxiliary, LinearWeights, SkipWeights, Weights};
use crate::model::{ModelError, write};
use crate::network::init::initial_parameters;
use crate::structure::{Structure, StructureError};
use hydroflex_openapi::model::{
    DenseLayer, EmptyMachine, FollowedPayload, GoldenPrediction, ModelConfig, PayloadWidths, Schedule,
};
use serde_json::json;
use std::path::Path;

/// Channels in, with a typical value and its variation.
const INPUTS: [(&str, &str, f64, f64); 5] = [
    ("valve_lift_ratio", "1", 0.0, 0.5),
    ("length_lift_m", "m", 1.05, 0.1),
    ("velocity_lift_m_per_s", "m/s", 0.0, 0.05),
    ("pressure_lift_piston_pa", "Pa", 5e6, 2e6),
    ("pressure_lift_rod_pa", "Pa", 4e6, 2e6),
];
/// Channels out.
const TARGETS: [(&str, &str, f64, f64); 3] = [
    ("deflection_tip_y_m", "m", -2e-3, 1e-3),
    ("strain_tip_xy", "1", 0.0, 1e-5),
    ("stress_root_xx_pa", "Pa", 1e7, 5e6),
];
const SAMPLE_TIME_S: f64 = 0.005;
/// Directions of the envelope.
const ENVELOPE_COMPONENTS: usize = 24;

/// What to make.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SyntheticSpec {
    /// As in a training: `best`, `RLR`, …
    pub structure: String,
    /// Samples in a window of the five usual sensors.
    pub window_steps: usize,
    /// Channels out, at most three.
    pub targets: usize,
    /// Of the weights.
    pub seed: u64,
}

/// A model's parts.
#[derive(Debug, Clone)]
pub struct SyntheticModel {
    /// Configuration, with intervals, envelope and golden predictions.
    pub config: ModelConfig,
    /// Weights.
    pub weights: Weights,
    /// Envelope.
    pub auxiliary: Auxiliary,
}

impl SyntheticModel {
    /// Random weights, the same for the same specification.
    ///
    /// # Errors
    /// An unknown structure.
    ///
    /// # Panics
    /// Without a window or targets, or with more targets than three.
    pub fn new(spec: &SyntheticSpec) -> Result<Self, StructureError> {
        assert!(
            spec.window_steps > 0 && (1..=TARGETS.len()).contains(&spec.targets),
            "a window and one to three targets"
        );
        let structure = Structure::parse(&spec.structure, spec.window_steps, None)?;
        let values = spec.window_steps * INPUTS.len();
        let layers = structure.layers(values, spec.targets);
        let mut weights = Weights {
            layers: random(&layers, spec.seed),
            skip: structure
                .linear_skip
                .then(|| in_f64(&random(&[map("skip", values, spec.targets)], spec.seed + 1).remove(0))),
            payload: Vec::new(),
            empty: None,
            guard: None,
        };
        let linear = random(
            &[
                map("least_squares", values, spec.targets),
                map("quasi_static", INPUTS.len(), spec.targets),
                map("envelope", values, ENVELOPE_COMPONENTS),
                map("guard", values, spec.targets),
            ],
            spec.seed + 2,
        );
        let [least_squares, quasi_static, envelope, guard] = <[LinearWeights; 4]>::try_from(linear)
            .unwrap_or_else(|maps| unreachable!("four maps were asked for, not {}", maps.len()));
        weights.guard = Some(guard);
        let auxiliary = Auxiliary {
            least_squares,
            quasi_static,
            envelope: Some(envelope),
        };
        let mut config = config(spec, structure.linear_skip, &layers);
        config.golden = golden(&config, &weights, &auxiliary);
        Ok(Self {
            config,
            weights,
            auxiliary,
        })
    }

    /// The same with a linear part whose coefficients follow the cylinder length and a payload that is estimated twice. Windows whose
    /// estimate is low, about half of those of [`signal`], have a map of their own, and narrower intervals.
    #[must_use]
    pub fn following_payload(mut self) -> Self {
        let (size, targets) = (self.config.window_steps * INPUTS.len(), self.config.targets.len());
        let (_, _, length_m, variation_m) = INPUTS[1];
        let schedule = |exponents: &[&[u32]]| Schedule {
            inputs: vec![1],
            centre: vec![length_m],
            half_range: vec![variation_m],
            exponents: exponents.iter().map(|e| e.to_vec()).collect(),
        };
        let maps = |rows: usize, seed: u64| in_f64(&random(&[map("map", size, rows)], seed).remove(0));
        let limit_kg = 50.0;
        let main = schedule(&[&[0, 0], &[1, 0], &[0, 1], &[2, 1], &[0, 3]]);
        self.weights.skip = Some(maps(main.exponents.len() * targets, 11));
        self.weights.payload = vec![maps(2, 12), maps(4, 13)];
        self.weights.empty = Some(maps(2 * targets, 14));
        self.config.linear_skip = true;
        self.config.schedule = Some(main);
        self.config.payload = Some(FollowedPayload {
            centre_kg: 50.0,
            half_range_kg: 65.0,
            estimates: vec![
                schedule(&[&[0], &[1]]),
                schedule(&[&[0, 0], &[0, 1], &[1, 1], &[0, 2]]),
            ],
            empty: Some(EmptyMachine {
                below_kg: limit_kg,
                schedule: schedule(&[&[0], &[1]]),
                network_gain: [0.25, 1.0, 3.0][..targets].to_vec(),
            }),
        });
        for table in &mut self.config.intervals {
            table.payload = Some(PayloadWidths {
                upper_edges_kg: vec![limit_kg],
                factors: vec![0.5, 2.0],
            });
        }
        self.config.golden = golden(&self.config, &self.weights, &self.auxiliary);
        self
    }

    /// Ready to estimate.
    #[must_use]
    pub fn predictor(&self) -> Predictor {
        Predictor::new(&self.config, &self.weights, &self.auxiliary)
    }

    /// Writes the model folder, replacing what is there.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ModelError> {
        write::write_parts(&self.config, &self.weights, &self.auxiliary, &[], folder)
    }
}

/// Estimates of a few windows of [`signal`].
fn golden(config: &ModelConfig, weights: &Weights, auxiliary: &Auxiliary) -> Vec<GoldenPrediction> {
    let predictor = Predictor::new(config, weights, auxiliary);
    let mut workspace = predictor.workspace();
    (0..3)
        .map(|number| {
            let window = signal(number * config.window_steps, config.window_steps);
            let mut estimates = vec![0.0; config.targets.len()];
            predictor.predict_window(&window, &mut estimates, &mut workspace);
            GoldenPrediction { window, estimates }
        })
        .collect()
}

/// A smooth signal of all inputs: `rows` samples from sample `first` on, row by row.
#[must_use]
pub fn signal(first: usize, rows: usize) -> Vec<f64> {
    (first..first + rows)
        .flat_map(|row| {
            let t = row as f64 * SAMPLE_TIME_S;
            INPUTS.iter().enumerate().map(move |(i, (_, _, mean, size))| {
                mean + size * ((1.3 + i as f64) * t + 0.7 * i as f64).sin()
            })
        })
        .collect()
}

fn map(name: &str, inputs: usize, outputs: usize) -> DenseLayer {
    DenseLayer {
        name: name.to_owned(),
        inputs,
        outputs,
        activations: Vec::new(),
    }
}

fn random(layers: &[DenseLayer], seed: u64) -> Vec<LinearWeights> {
    let parameters = initial_parameters(layers, seed, 1.0);
    let mut rest = parameters.as_slice();
    layers
        .iter()
        .map(|layer| {
            let (weight, after) = rest.split_at(layer.inputs * layer.outputs);
            let (bias, after) = after.split_at(layer.outputs);
            rest = after;
            LinearWeights {
                weight: weight.to_vec(),
                bias: bias.to_vec(),
            }
        })
        .collect()
}

fn in_f64(map: &LinearWeights) -> SkipWeights {
    SkipWeights {
        weight: map.weight.iter().map(|&w| f64::from(w)).collect(),
        bias: map.bias.iter().map(|&b| f64::from(b)).collect(),
    }
}

fn config(spec: &SyntheticSpec, linear_skip: bool, layers: &[DenseLayer]) -> ModelConfig {
    let channels = |all: &[(&str, &str, f64, f64)]| -> Vec<serde_json::Value> {
        all.iter()
            .map(|(name, unit, offset, scale)| {
                json!({"name": name, "unit": unit, "offset": offset, "scale": scale})
            })
            .collect()
    };
    let targets = &TARGETS[..spec.targets];
    let half_widths: Vec<serde_json::Value> = targets
        .iter()
        .map(|(_, _, offset, scale)| {
            json!({
                "centre": offset, "upper_edges": [0.1 * scale],
                "half_widths": [0.01 * scale, 0.02 * scale],
            })
        })
        .collect();
    let bounds = |sign: f64| -> Vec<f64> {
        INPUTS
            .iter()
            .map(|(_, _, mean, size)| mean + sign * 1.5 * size)
            .collect()
    };
    // Through JSON: what a later version adds to the configuration has a default there.
    let value = json!({
        "format_version": hydroflex_openapi::model::MODEL_FORMAT_VERSION,
        "structure": spec.structure,
        "window_steps": spec.window_steps,
        "window_s": spec.window_steps as f64 * SAMPLE_TIME_S,
        "sample_time_s": SAMPLE_TIME_S,
        "inputs": channels(&INPUTS),
        "targets": channels(targets),
        "linear_skip": linear_skip,
        "layers": layers,
        "guard": {
            // Random weights make estimates of about one scale: wide enough for `signal`, and no wider than needed.
            "slack": targets.iter().map(|t| 4.0 * t.3).collect::<Vec<_>>(),
            "min": targets.iter().map(|t| t.2 - 10.0 * t.3).collect::<Vec<_>>(),
            "max": targets.iter().map(|t| t.2 + 10.0 * t.3).collect::<Vec<_>>(),
        },
        "provenance": {
            "spec": {"structure": spec.structure, "seed": spec.seed},
            "dataset_sha256": "0".repeat(64),
            "train_runs": 0, "validation_runs": 0, "train_windows": 0,
            "epochs": 0, "best_epoch": 0, "learning_rate": 0.0, "batch": 0,
            "history": [], "ended_by": "epochs",
            "hydroflex_version": env!("CARGO_PKG_VERSION"), "burn_version": "none",
        },
        "validation": [],
        "validation_least_squares": [],
        "intervals": half_widths,
        "envelope": {
            "components": ENVELOPE_COMPONENTS,
            "groups": [{ "components": ENVELOPE_COMPONENTS, "limit": 1e3 }],
            "min": bounds(-1.0), "max": bounds(1.0),
        },
        "golden": [],
    });
    serde_json::from_value(value)
        .unwrap_or_else(|error| unreachable!("a configuration with every required field: {error}"))
}

#[cfg(test)]
mod tests {
    use super::super::sliding::SlidingWindow;
    use super::*;
    use crate::predict::PerWindow;

    fn model(structure: &str) -> SyntheticModel {
        SyntheticModel::new(&SyntheticSpec {
            structure: structure.to_owned(),
            window_steps: 12,
            targets: 3,
            seed: 7,
        })
        .unwrap()
    }

    #[test]
    fn low_estimates_of_the_payload_take_the_map_of_the_empty_machine() {
        let model = following();
        let mut without = following();
        without.weights.empty.as_mut().unwrap().bias.fill(1.0);
        let samples = signal(0, 12 * 60);
        let estimates = |model: &SyntheticModel| {
            let predictor = model.predictor();
            let mut out = vec![0.0; 60 * 3];
            predictor.predict_windows(&samples, &mut out, &mut predictor.workspace());
            out
        };
        let (with, without) = (estimates(&model), estimates(&without));
        let differ = with
            .chunks(3)
            .zip(without.chunks(3))
            .filter(|(a, b)| a != b)
            .count();
        assert!(
            (10..50).contains(&differ),
            "{differ} of 60 windows count as empty"
        );
    }

    #[test]
    fn a_written_model_loads_and_a_changed_weight_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        let mut model = model("best");
        model.write(&path).unwrap();
        crate::model::Model::load(&path).unwrap();
        // Right hashes, wrong weights: only the golden predictions can tell.
        model.weights.layers[0].bias[0] += 0.1;
        model.write(&path).unwrap();
        let error = crate::model::Model::load(&path).unwrap_err();
        assert!(
            matches!(error, crate::model::ModelError::Golden { .. }),
            "{error}"
        );
    }

    #[test]
    fn a_sliding_window_estimates_what_a_recording_gives() {
        let models = ["best", "RLR", "TLTLT"].map(|structure| (structure, model(structure)));
        for (structure, model) in models.into_iter().chain([("following", following())]) {
            let predictor = model.predictor();
            let rows = 40;
            let samples = signal(0, rows);
            let columns: Vec<Vec<f64>> = (0..5)
                .map(|c| samples.iter().skip(c).step_by(5).copied().collect())
                .collect();
            let views: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            let series = predictor.predict_series(&views);
            let mut workspace = predictor.workspace();
            let mut window = SlidingWindow::new(&predictor);
            let mut out = [0.0; 3];
            for (row, sample) in samples.chunks(5).enumerate() {
                window.push(&predictor, sample);
                let found = window.predict(&predictor, &mut out, &mut workspace);
                match row.checked_sub(series.first_row) {
                    None => assert_eq!(found, None, "row {row}"),
                    Some(k) => {
                        let found = found.unwrap();
                        assert_eq!(found.inside, series.inside[k]);
                        let payload_kg = series.payload_kg.get(k).copied();
                        assert_eq!(found.payload_kg, payload_kg, "{structure} row {row}");
                        assert_eq!(found.payload_kg.is_some(), structure == "following");
                        for (t, value) in out.iter().enumerate() {
                            // The same bits, however many windows are estimated at once.
                            assert_eq!(
                                value.to_bits(),
                                series.columns[t][k].to_bits(),
                                "{structure} row {row}"
                            );
                        }
                    }
                }
            }
        }
    }

    /// The network as its configuration says, layer by layer in f64.
    fn definition(model: &SyntheticModel, window: &[f64]) -> Vec<f64> {
        use hydroflex_openapi::model::Activation;
        let config = &model.config;
        let scaled: Vec<f64> = window
            .iter()
            .enumerate()
            .map(|(i, v)| {
                let channel = &config.inputs[i % config.inputs.len()];
                (v - channel.offset) / channel.scale
            })
            .collect();
        let apply = |map: &LinearWeights, x: &[f64]| -> Vec<f64> {
            map.weight
                .chunks(x.len())
                .zip(&map.bias)
                .map(|(row, &b)| {
                    row.iter().zip(x).map(|(&w, v)| f64::from(w) * v).sum::<f64>() + f64::from(b)
                })
                .collect()
        };
        let mut x = scaled.clone();
        for (layer, map) in config.layers.iter().zip(&model.weights.layers) {
            x = apply(map, &x);
            for activation in &layer.activations {
                for v in &mut x {
                    *v = match activation {
                        Activation::Tanh => v.tanh(),
                        Activation::Sigmoid => 1.0 / (1.0 + (-*v).exp()),
                        Activation::Relu => v.max(0.0),
                        Activation::Elu => v.max(v.min(0.0).exp_m1()),
                        Activation::Silu => *v / (1.0 + (-*v).exp()),
                    };
                }
            }
        }
        if let Some(skip) = &model.weights.skip {
            let (linear, gain) = linear_part(model, skip, window, &scaled);
            for (v, (linear, gain)) in x.iter_mut().zip(linear.iter().zip(gain)) {
                *v = gain * *v + linear;
            }
        }
        x.iter()
            .zip(&config.targets)
            .map(|(v, channel)| channel.offset + channel.scale * v)
            .collect()
    }

    /// Scaled targets of the linear part and the gain of the network's, as the configuration describes them.
    fn linear_part(
        model: &SyntheticModel,
        skip: &SkipWeights,
        window: &[f64],
        scaled: &[f64],
    ) -> (Vec<f64>, Vec<f64>) {
        let config = &model.config;
        let targets = config.targets.len();
        let last = &window[window.len() - config.inputs.len()..];
        let map = |map: &SkipWeights, schedule: Option<&Schedule>, estimate: Option<f64>, targets: usize| {
            let mut u: Vec<f64> = schedule.map_or_else(Vec::new, |s| {
                (0..s.inputs.len())
                    .map(|c| ((last[s.inputs[c]] - s.centre[c]) / s.half_range[c]).clamp(-1.0, 1.0))
                    .collect()
            });
            u.extend(estimate.map(|e| e.clamp(-1.0, 1.0)));
            let constant = vec![Vec::new()];
            let exponents = schedule.map_or(&constant, |s| &s.exponents);
            let mut sum = vec![0.0; targets];
            for (row, (weights, bias)) in map.weight.chunks(scaled.len()).zip(&map.bias).enumerate() {
                let linear = bias + weights.iter().zip(scaled).map(|(w, v)| w * v).sum::<f64>();
                let factors = u.iter().zip(&exponents[row / targets]);
                let factor: f64 = factors.map(|(u, &e)| u.powi(e.try_into().unwrap())).product();
                sum[row % targets] += factor * linear;
            }
            sum
        };
        let mut estimate = None;
        if let Some(payload) = &config.payload {
            for (schedule, weights) in payload.estimates.iter().zip(&model.weights.payload) {
                estimate = Some(map(weights, Some(schedule), estimate, 1)[0]);
            }
            if let (Some(empty), Some(weights)) = (&payload.empty, &model.weights.empty)
                && payload.centre_kg + payload.half_range_kg * estimate.unwrap() < empty.below_kg
            {
                let linear = map(weights, Some(&empty.schedule), None, targets);
                return (linear, empty.network_gain.clone());
            }
        }
        let linear = map(skip, config.schedule.as_ref(), estimate, targets);
        (linear, vec![1.0; targets])
    }

    /// See [`SyntheticModel::following_payload`].
    fn following() -> SyntheticModel {
        model("best").following_payload()
    }

    /// A skip connection whose coefficients follow the second input.
    fn scheduled() -> SyntheticModel {
        let mut model = model("best");
        let skip = model.weights.skip.as_mut().unwrap();
        let terms = |of: &[f64]| -> Vec<f64> {
            [1.0, 0.3, -0.2]
                .iter()
                .flat_map(|factor| of.iter().map(move |value| factor * value))
                .collect()
        };
        *skip = SkipWeights {
            weight: terms(&skip.weight),
            bias: terms(&skip.bias),
        };
        model.config.schedule = Some(Schedule {
            inputs: vec![1],
            centre: vec![1.05],
            half_range: vec![0.1],
            exponents: vec![vec![0], vec![1], vec![2]],
        });
        model
    }

    #[test]
    fn an_estimate_has_the_same_bits_whatever_stands_beside_it() {
        let models = ["L", "RLR", "TLTLT", "ELE", "best"].map(model);
        for (number, model) in models.into_iter().chain([scheduled(), following()]).enumerate() {
            let predictor = model.predictor();
            let mut workspace = predictor.workspace();
            let samples = signal(0, 12 * 130);
            let mut alone = vec![0.0; 130 * 3];
            let mut payload_alone = vec![0.0; 130];
            let places = alone.chunks_mut(3).zip(payload_alone.chunks_mut(1));
            for (window, (out, payload_kg)) in samples.chunks(60).zip(places) {
                let asked = PerWindow {
                    payload_kg: Some(payload_kg),
                    ..PerWindow::default()
                };
                predictor.predict_windows_with(window, out, asked, &mut workspace);
            }
            let bits = |values: &[f64]| -> Vec<u64> { values.iter().map(|v| v.to_bits()).collect() };
            assert_eq!(payload_alone[0].is_nan(), !predictor.follows_payload());
            for count in [2, 7, 8, 16, 33, 45, 48, 49, 130] {
                let mut together = vec![0.0; count * 3];
                let mut inside = vec![false; count];
                let mut payload_kg = vec![0.0; count];
                predictor.predict_windows_with(
                    &samples[..count * 60],
                    &mut together,
                    PerWindow {
                        inside: Some(&mut inside),
                        payload_kg: Some(&mut payload_kg),
                    },
                    &mut workspace,
                );
                assert_eq!(together, alone[..count * 3], "model {number}, {count} windows");
                assert_eq!(bits(&payload_kg), bits(&payload_alone[..count]), "model {number}");
                assert!(inside.iter().all(|inside| *inside));
            }
            // The same windows, overlapping: those of a recording.
            let columns: Vec<Vec<f64>> = (0..5)
                .map(|input| samples.iter().skip(input).step_by(5).copied().collect())
                .collect();
            let columns: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            let series = predictor.predict_series_with(&columns, &mut workspace);
            for (window, row) in alone.chunks(3).enumerate() {
                if let Some(found) = series.payload_kg.get(12 * window) {
                    assert_eq!(found.to_bits(), payload_alone[window].to_bits());
                }
                for (target, value) in row.iter().enumerate() {
                    let found = series.columns[target][12 * window];
                    assert_eq!(value.to_bits(), found.to_bits(), "model {number}");
                }
            }
        }
    }

    #[test]
    fn every_structure_agrees_with_its_definition_in_f64() {
        let structures = [
            "L",
            "RLR",
            "TLT",
            "TLTLT",
            "TLSLTLSLT",
            "ELE",
            "LLL",
            "RLLR",
            "best",
        ];
        for model in structures
            .map(model)
            .into_iter()
            .chain([scheduled(), following()])
        {
            let structure = &model.config.structure;
            let predictor = model.predictor();
            let samples = signal(0, 12 * 50);
            let mut out = vec![0.0; 50 * 3];
            predictor.predict_windows(&samples, &mut out, &mut predictor.workspace());
            for (window, estimates) in samples.chunks(60).zip(out.chunks(3)) {
                let truth = definition(&model, window);
                for ((found, truth), channel) in estimates.iter().zip(truth).zip(&model.config.targets) {
                    // The promise is 1e-6 of range; a range is several scales.
                    assert!(
                        (found - truth).abs() < 1e-6 * channel.scale,
                        "{structure}, {}: {found} {truth}",
                        channel.name
                    );
                }
            }
        }
    }

    #[test]
    fn estimates_of_wild_signals_stay_at_their_bounds_and_are_flagged_on_every_path() {
        for structure in ["best", "RLR"] {
            let model = model(structure);
            let predictor = model.predictor();
            let mut workspace = predictor.workspace();
            let guard = model.config.guard.as_ref().unwrap();
            let guide = model.weights.guard.as_ref().unwrap();
            // Alternating samples, each in the range of its channel, as no machine makes them.
            let rows = 40;
            let mut samples = signal(0, rows);
            for (i, value) in samples.iter_mut().enumerate() {
                let (_, _, mean, size) = INPUTS[i % 5];
                let sign = if (i / 5 + i) % 2 == 0 { 1.0 } else { -1.0 };
                *value = if i / 5 < 12 {
                    *value
                } else {
                    mean + sign * 1.49 * size * 1e3
                };
            }
            let columns: Vec<Vec<f64>> = (0..5)
                .map(|c| samples.iter().skip(c).step_by(5).copied().collect())
                .collect();
            let columns: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            let series = predictor.predict_series(&columns);
            let mut sliding = SlidingWindow::new(&predictor);
            let mut limited = 0;
            for row in 0..rows {
                sliding.push(&predictor, &samples[row * 5..row * 5 + 5]);
                let mut streamed = [0.0; 3];
                let inside = sliding.predict(&predictor, &mut streamed, &mut workspace);
                let Some(k) = row.checked_sub(11) else { continue };
                let window = &samples[k * 5..(k + 12) * 5];
                let (mut single, mut flag) = ([0.0; 3], [true]);
                let asked = PerWindow {
                    inside: Some(&mut flag),
                    ..PerWindow::default()
                };
                predictor.predict_windows_with(window, &mut single, asked, &mut workspace);
                assert_eq!(
                    (Some(flag[0]), flag[0]),
                    (inside.map(|found| found.inside), series.inside[k])
                );
                for (t, channel) in model.config.targets.iter().enumerate() {
                    let scaled = |(i, v): (usize, &f64)| (v - INPUTS[i % 5].2) / INPUTS[i % 5].3;
                    let sum: f64 = guide.weight[t * 60..(t + 1) * 60]
                        .iter()
                        .zip(window.iter().enumerate().map(scaled))
                        .map(|(&w, x)| f64::from(w) * x)
                        .sum();
                    let near = channel.offset + channel.scale * (sum + f64::from(guide.bias[t]));
                    // f32 sums of a thousand scales.
                    let rounding = 1e-3 * channel.scale;
                    assert!((guard.min[t]..=guard.max[t]).contains(&single[t]) || flag[0]);
                    let at_range = (single[t] - guard.min[t])
                        .abs()
                        .min((single[t] - guard.max[t]).abs());
                    assert!(
                        (single[t] - near).abs() <= guard.slack[t] + rounding || at_range <= rounding,
                        "{structure}, window {k}: {} is not near {near}",
                        single[t]
                    );
                    for other in [streamed[t], series.columns[t][k]] {
                        assert!((other - single[t]).abs() <= rounding);
                    }
                }
                limited += usize::from(!flag[0]);
            }
            assert!(limited >= rows - 12, "{structure}: {limited}");
        }
    }

    #[test]
    fn a_replaced_sample_counts_from_then_on() {
        let predictor = model("RLR").predictor();
        let mut workspace = predictor.workspace();
        let (mut right, mut mended) = (SlidingWindow::new(&predictor), SlidingWindow::new(&predictor));
        let samples = signal(0, 20);
        for (row, sample) in samples.chunks(5).enumerate() {
            right.push(&predictor, sample);
            let held = if row == 15 { &samples[..5] } else { sample };
            mended.push(&predictor, held);
        }
        let (mut a, mut b) = ([0.0; 3], [0.0; 3]);
        right.predict(&predictor, &mut a, &mut workspace);
        mended.predict(&predictor, &mut b, &mut workspace);
        assert_ne!(a, b);
        mended.replace(&predictor, 4, &samples[75..80]);
        mended.predict(&predictor, &mut b, &mut workspace);
        assert_eq!(a, b);
    }

    #[test]
    fn a_value_outside_its_range_is_outside_until_it_has_left_the_window() {
        let predictor = model("L").predictor();
        let mut workspace = predictor.workspace();
        let mut window = SlidingWindow::new(&predictor);
        let samples = signal(0, 60);
        let mut flags = Vec::new();
        for (row, sample) in samples.chunks(5).enumerate() {
            let mut sample = sample.to_vec();
            if row == 20 {
                sample[3] = 1e9;
            }
            window.push(&predictor, &sample);
            let found = window.predict(&predictor, &mut [0.0; 3], &mut workspace);
            flags.push(found.map(|found| found.inside));
        }
        assert_eq!(flags[19], Some(true));
        assert!(flags[20..32].iter().all(|flag| *flag == Some(false)), "{flags:?}");
        assert_eq!(flags[32], Some(true));
        let mut batch = [true; 1];
        let mut outlier = samples[..60].to_vec();
        outlier[13] = 1e9;
        let asked = PerWindow {
            inside: Some(&mut batch),
            ..PerWindow::default()
        };
        predictor.predict_windows_with(&outlier, &mut [0.0; 3], asked, &mut workspace);
        assert_eq!(batch, [false]);
    }
}
