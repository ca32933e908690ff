//! Intervals that follow the payload, in recordings and evaluations.

#![allow(clippy::unwrap_used, reason = "a test stops at what it did not expect")]

use hydroflex_ml::evaluate;
use hydroflex_ml::model::Model;
use hydroflex_ml::predict::synthetic::{SyntheticModel, SyntheticSpec, signal};
use hydroflex_ml::recording::predict_runs;
use hydroflex_ml::runs::{RunSamples, Runs};
use hydroflex_openapi::channel::{Channel, ChannelRole};

/// Rows of a run: enough that its windows tell payloads of both widths.
const ROWS: usize = 300;

fn model() -> Model {
    let spec = SyntheticSpec {
        structure: "RLR".to_owned(),
        window_steps: 12,
        targets: 3,
        seed: 7,
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model");
    let synthetic = SyntheticModel::new(&spec).unwrap().following_payload();
    synthetic.write(&path).unwrap();
    Model::load(&path).unwrap()
}

/// Two runs, the model's inputs and then `extra` columns.
fn runs(model: &Model, extra: &[(&str, Vec<Vec<f64>>)]) -> Runs {
    let width = model.config().inputs.len();
    let channel = |name: &str| Channel {
        name: name.to_owned(),
        unit: String::new(),
        quantity: String::new(),
        frame: None,
        role: ChannelRole::Sensor,
    };
    let inputs = model.config().inputs.iter().map(|input| input.name.as_str());
    Runs {
        channels: inputs
            .chain(extra.iter().map(|(name, _)| *name))
            .map(channel)
            .collect(),
        sample_time_s: model.config().sample_time_s,
        runs: (0..2_usize)
            .map(|run| {
                let samples = signal(run * ROWS, ROWS);
                let inputs = (0..width).map(|i| samples.iter().skip(i).step_by(width).copied().collect());
                RunSamples {
                    run_id: run as u64,
                    columns: inputs
                        .chain(extra.iter().map(|(_, runs)| runs[run].clone()))
                        .collect(),
                }
            })
            .collect(),
    }
}

#[test]
fn every_row_has_the_interval_of_its_own_payload() {
    let model = model();
    let inputs = runs(&model, &[]);
    let table = predict_runs(&model, &inputs);
    let mut light = 0;
    for (run, samples) in inputs.runs.iter().enumerate() {
        let columns: Vec<&[f64]> = samples.columns.iter().map(Vec::as_slice).collect();
        let series = model.predictor().predict_series(&columns);
        for (k, &payload_kg) in series.payload_kg.iter().enumerate() {
            light += usize::from(payload_kg <= 50.0);
            for (target, widths) in table.targets.iter().zip(&model.config().intervals) {
                let row = run * ROWS + 11 + k;
                let estimate = target.values[row].unwrap();
                let (lower, upper) = target.bounds.as_ref().unwrap();
                // By the configuration: two classes of amplitude, two of payload.
                let class = usize::from((estimate - widths.centre).abs() > widths.upper_edges[0]);
                let factors = &widths.payload.as_ref().unwrap().factors;
                let half = widths.half_widths[class] * factors[usize::from(payload_kg > 50.0)];
                // The same product, added in f64.
                let off = |end: &[Option<f64>], wanted: f64| (end[row].unwrap() - wanted).abs();
                let rounding = 1e-15 * (estimate.abs() + half);
                assert!(off(lower, estimate - half) <= rounding, "run {run}, window {k}");
                assert!(off(upper, estimate + half) <= rounding, "run {run}, window {k}");
            }
        }
    }
    assert!((1..2 * (ROWS - 11)).contains(&light), "{light} windows are light");
}

#[test]
fn an_evaluation_counts_with_the_width_of_each_payload() {
    let model = model();
    let inputs = runs(&model, &[]);
    let table = predict_runs(&model, &inputs);
    // A truth that stands at nine tenths of each interval's own half width is inside, one beyond it is not.
    let truth = |part: f64| -> Vec<(&str, Vec<Vec<f64>>)> {
        let of_run = |values: &[f64], run: usize| values[run * ROWS..(run + 1) * ROWS].to_vec();
        (table.targets.iter())
            .map(|target| {
                let upper = &target.bounds.as_ref().unwrap().1;
                let at = |(value, end): (&Option<f64>, &Option<f64>)| {
                    value
                        .zip(*end)
                        .map_or(0.0, |(value, end)| value + part * (end - value))
                };
                let values: Vec<f64> = target.values.iter().zip(upper).map(at).collect();
                (
                    target.name.as_str(),
                    (0..2).map(|run| of_run(&values, run)).collect(),
                )
            })
            .collect()
    };
    for (part, covered) in [(0.9, 1.0), (1.1, 0.0)] {
        let report = evaluate::evaluate(&model, &runs(&model, &truth(part)), "")
            .unwrap()
            .report;
        for target in &report.targets {
            assert_eq!(target.coverage, Some(covered), "{}", target.target);
        }
    }
}
