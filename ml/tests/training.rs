//! Training end to end on synthetic runs: a damped oscillator seen through two sensors.
//!
//! The target is non-linear in the window (a product of two states), so that a network must beat
//! the linear map, and the oscillator forgets its past within the window, as a SLIDE network needs.

#![allow(clippy::unwrap_used, reason = "tests")]

use hydroflex_ml::evaluate;
use hydroflex_ml::model::Model;
use hydroflex_ml::predict::Predictor;
use hydroflex_ml::runs::{RunSamples, Runs};
use hydroflex_ml::train::comparison::Comparison;
use hydroflex_ml::train::prepare::TrainingData;
use hydroflex_ml::train::{Progress, TrainError, train};
use hydroflex_openapi::channel::{Channel, ChannelRole};
use hydroflex_openapi::job::{NoiseSpec, TrainingSpec, WindowCut, WindowRule};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

fn oscillators(count: u64, first_id: u64) -> Runs {
    let channel = |name: &str, unit: &str, role| Channel {
        name: name.to_owned(),
        unit: unit.to_owned(),
        quantity: String::new(),
        frame: None,
        role,
    };
    let channels = vec![
        channel("valve_lift_ratio", "1", ChannelRole::Command),
        channel("length_lift_m", "m", ChannelRole::Sensor),
        channel("deflection_tip_y_m", "m", ChannelRole::Target),
    ];
    let runs = (first_id..first_id + count)
        .map(|run_id| {
            let mut state = run_id.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let mut random = || {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                (state >> 40) as f64 / f64::from(1 << 23) - 1.0
            };
            let (mut x, mut v, mut u) = (random(), 0.0, 0.0);
            let mut columns = vec![Vec::new(), Vec::new(), Vec::new()];
            for step in 0..120 {
                if step % 10 == 0 {
                    u = random();
                }
                v += 0.1 * (4.0 * (u - x) - 2.5 * v);
                x += 0.1 * v;
                columns[0].push(u);
                columns[1].push(1.0 + 0.1 * x);
                columns[2].push(1e-3 * (x + 0.4 * x * v + 0.2 * x * x));
            }
            RunSamples { run_id, columns }
        })
        .collect();
    Runs {
        channels,
        sample_time_s: 0.005,
        runs,
    }
}

fn data() -> TrainingData {
    TrainingData {
        train: oscillators(16, 0),
        validation: oscillators(4, 100),
        calibration: vec![oscillators(4, 100)],
        payloads_kg: std::collections::HashMap::new(),
        dataset_sha256: "0".repeat(64),
    }
}

fn spec(structure: &str, epochs: usize) -> TrainingSpec {
    TrainingSpec {
        structure: structure.to_owned(),
        window: WindowRule::Given { window_s: 0.1 },
        epochs: Some(epochs),
        batch: Some(256),
        width: Some(32),
        seed: 4,
        ..TrainingSpec::default()
    }
}

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("hydroflex-ml-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }

    fn files(&self, sub: &str) -> BTreeMap<String, Vec<u8>> {
        std::fs::read_dir(self.0.join(sub))
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .map(|path| {
                (
                    path.file_name().unwrap().to_string_lossy().into_owned(),
                    std::fs::read(&path).unwrap(),
                )
            })
            .collect()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn go_on(_: Progress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn run(
    spec: &TrainingSpec,
    dir: &Path,
    name: &str,
) -> Result<hydroflex_openapi::model::ModelSummary, TrainError> {
    train(
        &data(),
        spec,
        &mut go_on,
        &dir.join("checkpoint"),
        &dir.join(name),
    )
}

#[test]
fn our_network_beats_least_squares_and_its_folder_predicts_the_same() {
    let folder = Folder::new("best");
    let summary = run(&spec("best", 300), &folder.0, "model").unwrap();
    let (network, linear) = (summary.validation[0].mae, summary.validation_least_squares[0].mae);
    assert!(
        network < 0.2 * linear,
        "network {network:e}, least squares {linear:e}"
    );

    let model = Model::load(&folder.0.join("model")).unwrap();
    assert_eq!(model.sha256(), summary.model_sha256);
    let unseen = oscillators(5, 1000);
    let evaluation = hydroflex_ml::evaluate::evaluate(&model, &unseen, "").unwrap();
    let (network, linear) = (
        &evaluation.report.targets[0],
        &evaluation.report.baselines[0].targets[0],
    );
    assert!(
        network.mae < 0.3 * linear.mae,
        "unseen: {:e}, {:e}",
        network.mae,
        linear.mae
    );
    assert_eq!(network.samples, 5 * 101, "120 samples have 101 windows of 20");

    // One by one, in a batch and along the series: three ways through the kernel.
    let predictor = model.predictor();
    let columns: Vec<&[f64]> = unseen.runs[0].columns[..2].iter().map(Vec::as_slice).collect();
    let series = predictor.predict_series(&columns);
    let windows: Vec<f64> = (0..101)
        .flat_map(|w| (w..w + 20).flat_map(|r| [columns[0][r], columns[1][r]]))
        .collect();
    let mut batch = vec![0.0; 101];
    let mut workspace = predictor.workspace();
    predictor.predict_windows(&windows, &mut batch, &mut workspace);
    for w in 0..101 {
        let mut single = [0.0];
        predictor.predict_window(&windows[w * 40..(w + 1) * 40], &mut single, &mut workspace);
        // Another blocking sums in the same order, so these agree to f32 rounding of 1e-3 m.
        assert!((single[0] - series.columns[0][w]).abs() < 1e-9 && (batch[w] - single[0]).abs() < 1e-9);
    }
}

#[test]
fn bounds_leave_known_signals_alone_and_hold_unknown_ones() {
    let folder = Folder::new("bounds");
    run(&spec("best", 60), &folder.0, "model").unwrap();
    let model = Model::load(&folder.0.join("model")).unwrap();
    let predictor = model.predictor();
    let mut free = model.config().clone();
    let guard = free.guard.take().unwrap();
    let unbounded = Predictor::new(&free, model.weights(), model.auxiliary());
    for run in data().train.runs.iter().chain(&oscillators(5, 1000).runs) {
        let columns: Vec<&[f64]> = run.columns[..2].iter().map(Vec::as_slice).collect();
        assert_eq!(
            predictor.predict_series(&columns).columns,
            unbounded.predict_series(&columns).columns
        );
    }
    // With hardly any slack the bounds are reached, and every limited estimate is flagged.
    let mut narrow = model.config().clone();
    narrow.guard = Some(hydroflex_openapi::model::Guard {
        slack: guard.slack.iter().map(|s| 1e-3 * s).collect(),
        ..guard
    });
    let narrow = Predictor::new(&narrow, model.weights(), model.auxiliary());
    let run = oscillators(1, 2000).runs.remove(0);
    let columns: Vec<&[f64]> = run.columns[..2].iter().map(Vec::as_slice).collect();
    let (free, limited) = (
        predictor.predict_series(&columns),
        narrow.predict_series(&columns),
    );
    let changed = |k: &usize| free.columns[0][*k].to_bits() != limited.columns[0][*k].to_bits();
    assert!((0..free.inside.len()).filter(changed).all(|k| !limited.inside[k]));
    assert!((0..free.inside.len()).filter(changed).count() > free.inside.len() / 2);
}

#[test]
fn a_network_trained_for_noise_is_better_under_noise_and_resumes_to_the_same_bytes() {
    let folder = Folder::new("noise");
    let stds = [
        ("valve_lift_ratio".to_owned(), 0.2),
        ("length_lift_m".to_owned(), 1e-2),
    ];
    let noise = NoiseSpec::Channels(stds.into());
    let trained_for = TrainingSpec {
        noise: Some(noise),
        ..spec("best", 60)
    };
    run(&spec("best", 60), &folder.0, "clean").unwrap();
    run(&trained_for, &folder.0, "noisy").unwrap();
    let [clean, noisy] = ["clean", "noisy"].map(|name| Model::load(&folder.0.join(name)).unwrap());
    let unseen = evaluate::with_noise_of_training(&noisy, &oscillators(10, 1000), 1).unwrap();
    let mae = |model| evaluate::evaluate(model, &unseen, "").unwrap().report.targets[0].mae;
    assert!(
        mae(&noisy) < 0.9 * mae(&clean),
        "{:e} {:e}",
        mae(&noisy),
        mae(&clean)
    );
    let report = evaluate::evaluate(&noisy, &unseen, "").unwrap().report;
    // Four runs calibrate and ten judge: a coarse check that noise is in the intervals.
    assert!(
        (0.8..0.97).contains(&report.targets[0].coverage.unwrap()),
        "{report:?}"
    );
    let mut stop = |progress: Progress| {
        if progress.epoch >= 20 {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let checkpoint = folder.0.join("checkpoint");
    train(
        &data(),
        &trained_for,
        &mut stop,
        &checkpoint,
        &folder.0.join("resumed"),
    )
    .unwrap_err();
    run(&trained_for, &folder.0, "resumed").unwrap();
    assert_eq!(folder.files("noisy"), folder.files("resumed"));
    let wrong = TrainingSpec {
        noise: Some(NoiseSpec::Channels(
            [("deflection_tip_y_m".to_owned(), 1.0)].into(),
        )),
        ..spec("best", 1)
    };
    let error = run(&wrong, &folder.0, "wrong").unwrap_err().to_string();
    assert!(
        error.contains("deflection_tip_y_m") && error.contains("no input"),
        "{error}"
    );
}

#[test]
fn stuck_and_swapped_sensors_are_flagged_and_honest_runs_are_not() {
    let folder = Folder::new("faults");
    let data = TrainingData {
        train: oscillators(64, 0),
        validation: oscillators(8, 100),
        calibration: vec![oscillators(64, 200)],
        payloads_kg: std::collections::HashMap::new(),
        dataset_sha256: "0".repeat(64),
    };
    train(
        &data,
        &spec("best", 2),
        &mut go_on,
        &folder.0.join("c"),
        &folder.0.join("model"),
    )
    .unwrap();
    let model = Model::load(&folder.0.join("model")).unwrap();
    let unseen = oscillators(64, 1000);
    let inside = evaluate::evaluate(&model, &unseen, "")
        .unwrap()
        .report
        .inside_envelope;
    assert!(inside.unwrap() > 0.99, "{inside:?}");
    let rates = evaluate::faults::fault_rates(&model, &unseen).unwrap();
    let names: Vec<&str> = rates.iter().map(|rate| rate.fault.as_str()).collect();
    assert_eq!(
        names,
        [
            "valve_lift_ratio stuck",
            "length_lift_m stuck",
            "valve_lift_ratio and length_lift_m swapped"
        ]
    );
    for rate in rates {
        assert!(rate.windows > 1000 && rate.cases > 50, "{rate:?}");
        assert!(rate.flagged > 0.7 && rate.found > 0.9, "{rate:?}");
    }
}

#[test]
fn every_published_structure_trains() {
    let folder = Folder::new("letters");
    for name in ["L", "RLR", "TLTLT", "ELE", "TLSLTLSLT", "TLT", "TLSLT"] {
        let summary = run(&spec(name, 100), &folder.0, name).unwrap();
        let metrics = &summary.validation[0];
        assert!(metrics.r2 > 0.8, "{name}: R² {}", metrics.r2);
    }
}

#[test]
fn the_published_recipe_uses_disjoint_windows_and_fixed_scales() {
    let folder = Folder::new("published");
    let spec = TrainingSpec {
        windows: WindowCut::Disjoint,
        batch: None,
        ..spec("RLR", 40)
    };
    run(&spec, &folder.0, "model").unwrap();
    let model = Model::load(&folder.0.join("model")).unwrap();
    let config = model.config();
    assert_eq!(
        config.provenance.train_windows,
        16 * 6,
        "floor(120 / 20) windows per run"
    );
    assert_eq!(config.provenance.batch, 2, "an eighth of the runs");
    assert!((config.inputs[1].scale - 1.355).abs() < 1e-12);
}

#[test]
fn the_same_seed_gives_the_same_bytes_even_when_killed_and_resumed() {
    let folder = Folder::new("resume");
    let spec = spec("best", 12);
    run(&spec, &folder.0, "whole").unwrap();
    let mut stop = |progress: Progress| {
        if progress.epoch >= 5 {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let checkpoint = folder.0.join("checkpoint");
    let error = train(&data(), &spec, &mut stop, &checkpoint, &folder.0.join("resumed")).unwrap_err();
    assert!(matches!(error, TrainError::Cancelled { .. }));
    assert!(!folder.0.join("resumed").exists());
    let mut resumed_at = None;
    let mut watch = |progress: Progress| {
        resumed_at = progress.resumed_at;
        ControlFlow::Continue(())
    };
    train(&data(), &spec, &mut watch, &checkpoint, &folder.0.join("resumed")).unwrap();
    assert_eq!(resumed_at, Some(5), "the checkpoint was taken up");
    assert_eq!(folder.files("whole"), folder.files("resumed"));
}

#[test]
fn networks_for_comparison_learn_and_are_judged_as_the_others() {
    let folder = Folder::new("comparison");
    for structure in ["RNN", "LSTM", "CNN"] {
        let spec = TrainingSpec {
            width: Some(16),
            learning_rate: Some(1e-2),
            ..spec(structure, 40)
        };
        let train = || Comparison::train(&data(), &spec, &mut go_on, &folder.0.join("checkpoint")).unwrap();
        let network = train();
        let unseen = oscillators(5, 1000);
        let report = network.evaluate(&unseen, "").unwrap();
        assert_eq!(
            report.targets[0].samples,
            5 * 101,
            "120 samples have 101 windows of 20"
        );
        assert!(report.targets[0].r2 > 0.9, "{structure}: {:?}", report.targets[0]);
        assert_eq!(
            report,
            train().evaluate(&unseen, "").unwrap(),
            "{structure}: same seed, same errors"
        );
    }
}

#[test]
fn impossible_trainings_are_refused_with_the_reason() {
    let folder = Folder::new("refused");
    let message = |data: &TrainingData, spec: &TrainingSpec| {
        train(data, spec, &mut go_on, &folder.0.join("c"), &folder.0.join("m"))
            .unwrap_err()
            .to_string()
    };
    let missing = TrainingSpec {
        targets: vec!["strain_tip_xy".to_owned()],
        ..spec("best", 1)
    };
    assert!(message(&data(), &missing).contains("strain_tip_xy"));
    let long = TrainingSpec {
        window: WindowRule::Given { window_s: 2.0 },
        ..spec("best", 1)
    };
    assert!(message(&data(), &long).contains("longer than the longest run"));
    let mut few = data();
    few.train.runs.truncate(1);
    assert!(message(&few, &spec("best", 1)).contains("too few"));
    let mut broken = data();
    broken.train.runs[3].columns[1][7] = f64::NAN;
    assert!(message(&broken, &spec("best", 1)).contains("run 3, step 7"));
    let wild = TrainingSpec {
        learning_rate: Some(1e6),
        ..spec("RLR", 20)
    };
    assert!(message(&data(), &wild).contains("diverged"));
    assert!(message(&data(), &spec("RXR", 1)).contains("'X'"));
    assert!(message(&data(), &spec("LSTM", 1)).contains("neither exported nor served"));
}

#[test]
fn a_changed_file_is_not_loaded() {
    let folder = Folder::new("changed");
    run(&spec("L", 2), &folder.0, "model").unwrap();
    let path = folder.0.join("model/config.json");
    let text = std::fs::read_to_string(&path)
        .unwrap()
        .replace("\"structure\": \"L\"", "\"structure\": \"T\"");
    std::fs::write(&path, text).unwrap();
    let error = Model::load(&folder.0.join("model")).unwrap_err();
    assert!(error.to_string().contains("SHA256SUMS"), "{error}");
}

#[test]
fn a_model_card_shows_how_the_data_lie_and_how_the_network_learned() {
    let folder = Folder::new("card");
    run(&spec("RLR", 3), &folder.0, "model").unwrap();
    let files = folder.files("model");
    let text = |name: &str| String::from_utf8(files[name].clone()).unwrap();
    let card = text("README.md");
    for name in ["distribution.svg", "learning.svg"] {
        assert!(card.contains(&format!("]({name})")), "{card}");
        let svg = text(name);
        assert!(
            !svg.contains("NaN") && svg.trim_end().ends_with("</svg>"),
            "{svg}"
        );
    }
    // A histogram and its normal distribution for both sensors and the target.
    let distribution = text("distribution.svg");
    assert_eq!(distribution.matches("<path").count(), 3);
    assert_eq!(distribution.matches("<polyline").count(), 3);
    for name in ["Lift valve", "Tip deflection y"] {
        assert!(distribution.contains(name), "{name}");
    }
    assert_eq!(text("learning.svg").matches("<polyline").count(), 2);
}

/// Why a training with this specification is not begun.
fn refusal(folder: &Folder, spec: &TrainingSpec) -> TrainError {
    let (checkpoint, model) = (folder.0.join("c"), folder.0.join("n"));
    train(&data(), spec, &mut go_on, &checkpoint, &model).unwrap_err()
}

#[test]
fn a_network_of_several_steps_estimates_the_end_of_its_window() {
    let folder = Folder::new("several");
    let spec = TrainingSpec {
        output_steps: Some(10),
        width: None,
        width_windows: Some(2),
        ..spec("TLT", 60)
    };
    train(
        &data(),
        &spec,
        &mut go_on,
        &folder.0.join("c"),
        &folder.0.join("m"),
    )
    .unwrap();
    let model = Model::load(&folder.0.join("m")).unwrap();
    let config = model.config();
    // Every estimated sample has the window of 20 steps before it.
    assert_eq!((config.window_steps, config.output_steps), (30, 10));
    let outputs: Vec<usize> = config.layers.iter().map(|layer| layer.outputs).collect();
    assert_eq!(outputs, [40, 40, 10]);
    let unseen = oscillators(4, 200);
    let report = evaluate::evaluate(&model, &unseen, "").unwrap().report;
    assert!(report.targets[0].r2 > 0.9, "{:?}", report.targets[0]);
    let names: Vec<&str> = report.baselines.iter().map(|b| b.name.as_str()).collect();
    assert_eq!(names, ["least_squares", "quasi_static", "persistence"]);

    let predictor = model.predictor();
    let mut workspace = predictor.workspace();
    let run = &unseen.runs[0];
    let window: Vec<f64> = (40..70)
        .flat_map(|row| [run.columns[0][row], run.columns[1][row]])
        .collect();
    let all = predictor.predict_all_steps(&window, &mut workspace);
    let mut last = [0.0];
    predictor.predict_window(&window, &mut last, &mut workspace);
    assert_eq!(all.len(), predictor.output_steps());
    assert!((all[9] - last[0]).abs() < 1e-9, "{} {}", all[9], last[0]);
    let worst = (60..70)
        .zip(&all)
        .map(|(row, estimate)| (run.columns[2][row] - estimate).abs())
        .fold(0.0, f64::max);
    assert!(worst < 0.3e-3, "{worst}");

    let wrong = TrainingSpec {
        output_steps: Some(0),
        ..spec
    };
    let refused = refusal(&folder, &wrong);
    assert!(matches!(refused, TrainError::NotPositive { .. }), "{refused:?}");
}

#[test]
fn our_network_of_several_steps_has_a_linear_map_for_each() {
    let folder = Folder::new("several-best");
    let spec = TrainingSpec {
        output_steps: Some(10),
        ..spec("best", 60)
    };
    train(
        &data(),
        &spec,
        &mut go_on,
        &folder.0.join("c"),
        &folder.0.join("m"),
    )
    .unwrap();
    let model = Model::load(&folder.0.join("m")).unwrap();
    let config = model.config();
    assert_eq!(
        (config.window_steps, config.output_steps, config.skip_steps()),
        (30, 10, 21)
    );
    let predictor = model.predictor();
    let mut workspace = predictor.workspace();
    let unseen = oscillators(4, 200);
    let run = &unseen.runs[0];
    let window_at = |last: usize| -> Vec<f64> {
        (last - 29..=last)
            .flat_map(|row| [run.columns[0][row], run.columns[1][row]])
            .collect()
    };
    let all = predictor.predict_all_steps(&window_at(69), &mut workspace);
    let scale = config.targets[0].scale;
    for (row, estimate) in (60..70).zip(&all) {
        let error = (run.columns[2][row] - estimate).abs();
        assert!(error < 0.01 * scale, "sample {row}: {error:.1e} of {scale:.1e}");
    }
    // One after the other, few together, and a whole recording: the same estimates of the last samples.
    let mut last = [0.0];
    predictor.predict_window(&window_at(69), &mut last, &mut workspace);
    assert!((all[9] - last[0]).abs() < 1e-6 * scale, "{} {}", all[9], last[0]);
    let columns = [&run.columns[0][..], &run.columns[1][..]];
    let series = predictor.predict_series(&columns);
    assert_eq!(series.first_row, 29);
    let windows: Vec<f64> = (60..80).flat_map(window_at).collect();
    let mut together = vec![0.0; 20];
    predictor.predict_windows(&windows, &mut together, &mut workspace);
    assert_eq!(&together[..], &series.columns[0][31..51]);
    assert!((together[9] - last[0]).abs() < 1e-12);
}

#[test]
fn dropout_is_for_training_alone() {
    let folder = Folder::new("dropout");
    let spec = spec("TDLT", 40);
    let files = |name: &str, spec: &TrainingSpec| {
        train(
            &data(),
            spec,
            &mut go_on,
            &folder.0.join("c"),
            &folder.0.join(name),
        )
        .unwrap();
        folder.files(name)
    };
    let dropped = files("a", &spec);
    assert_eq!(dropped, files("b", &spec), "the same seed gives the same bytes");
    let stronger = TrainingSpec {
        dropout: Some(0.4),
        ..spec.clone()
    };
    assert_ne!(
        dropped["model.safetensors"],
        files("d", &stronger)["model.safetensors"]
    );
    // The golden predictions were checked: twice the same estimate, whatever was left out in training.
    let model = Model::load(&folder.0.join("a")).unwrap();
    let names: Vec<&str> = model.config().layers.iter().map(|l| l.name.as_str()).collect();
    assert_eq!(names, ["net.0", "net.3", "net.5"]);
    let report = evaluate::evaluate(&model, &oscillators(4, 200), "")
        .unwrap()
        .report;
    assert!(report.targets[0].r2 > 0.8, "{:?}", report.targets[0]);
    let without = TrainingSpec {
        structure: "TLT".to_owned(),
        ..stronger
    };
    let refused = refusal(&folder, &without);
    assert!(matches!(refused, TrainError::NoDropout { .. }), "{refused:?}");
}
