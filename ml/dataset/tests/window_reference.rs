//! Windows of the reference boom: the rules against an independent evaluation of the same records.
//!
//! Reference: Exudyn 1.13.6 trajectories of the published boom with `runs.json`, whose
//! `window_text_a` and `window_script_a` were computed beside them, and the table in its README.
//! Needs HYDROFLEX_REFERENCE; says so and passes without.

#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

use arrow::array::AsArray;
use arrow::compute::cast;
use arrow::datatypes::{DataType, Float64Type, Int64Type};
use hydroflex_dataset::window::{band_steps, closing_step, paper_steps, script_steps};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

const SAMPLE_TIME_S: f64 = 0.005;

/// Valve command and deflection of each run, solution a, in the order of steps.
fn runs(folder: &Path) -> BTreeMap<i64, (Vec<f64>, Vec<f64>)> {
    let file = File::open(folder.join("trajectories.parquet")).unwrap();
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    let mut runs: BTreeMap<i64, Vec<(i64, f64, f64)>> = BTreeMap::new();
    for batch in reader.build().unwrap() {
        let batch = batch.unwrap();
        let column = |name: &str, to: &DataType| cast(batch.column_by_name(name).unwrap(), to).unwrap();
        let (run, step) = (column("run", &DataType::Int64), column("step", &DataType::Int64));
        let (u, d) = (
            column("U", &DataType::Float64),
            column("delta_y", &DataType::Float64),
        );
        let solution = column("solution", &DataType::Utf8);
        let (run, step) = (run.as_primitive::<Int64Type>(), step.as_primitive::<Int64Type>());
        let (u, d) = (u.as_primitive::<Float64Type>(), d.as_primitive::<Float64Type>());
        for row in 0..run.len() {
            if solution.as_string::<i32>().value(row) == "a" {
                let sample = (step.value(row), u.value(row), d.value(row));
                runs.entry(run.value(row)).or_default().push(sample);
            }
        }
    }
    let sorted = |mut samples: Vec<(i64, f64, f64)>| {
        samples.sort_by_key(|sample| sample.0);
        samples.into_iter().map(|(_, u, d)| (u, d)).unzip()
    };
    runs.into_iter()
        .map(|(run, samples)| (run, sorted(samples)))
        .collect()
}

#[test]
fn windows_of_the_reference_boom() {
    let Some(folder) = std::env::var_os("HYDROFLEX_REFERENCE") else {
        println!("passes untested: HYDROFLEX_REFERENCE is not set");
        return;
    };
    let folder = Path::new(&folder).join("liftboom");
    // written by a tool that spells missing numbers NaN, which JSON does not know
    let text = std::fs::read_to_string(folder.join("runs.json")).unwrap();
    let facts: serde_json::Value = serde_json::from_str(&text.replace("NaN", "null")).unwrap();
    let runs = runs(&folder);
    let mut compared = 0;
    for fact in facts.as_array().unwrap() {
        let open_part = match fact["kind"].as_str().unwrap() {
            "window20" => 0.2,
            "window10" => 0.1,
            _ => continue,
        };
        let (valve, deflection) = &runs[&fact["run"].as_i64().unwrap()];
        let seconds = |steps: Option<usize>| steps.unwrap() as f64 * SAMPLE_TIME_S;
        // both are whole numbers of samples: the tolerance is for decimal fractions only
        let near = |a: f64, b: &serde_json::Value| (a - b.as_f64().unwrap()).abs() < 1e-9;
        assert!(
            near(seconds(paper_steps(deflection)), &fact["window_text_a"]),
            "{fact}"
        );
        assert!(
            near(seconds(script_steps(deflection)), &fact["window_script_a"]),
            "{fact}"
        );
        let closing = closing_step(&[valve]);
        assert!((closing as f64 / fact["n_steps"].as_f64().unwrap() - open_part).abs() < 1e-9);

        // the band by its definition, sample by sample
        let steps = band_steps(deflection, closing).unwrap();
        let max = deflection.iter().copied().fold(f64::MIN, f64::max);
        let min = deflection.iter().copied().fold(f64::MAX, f64::min);
        let inside = |k: usize| (deflection[k] - deflection[200]).abs() <= 0.05 * (max - min);
        assert!(
            (closing + steps..=200).all(inside) && !inside(closing + steps - 1),
            "{fact}"
        );
        println!(
            "{} kg, {open_part}: band {:.3} s after the closing, paper {:.3} s, script {:.3} s",
            fact["payload"],
            steps as f64 * SAMPLE_TIME_S,
            seconds(paper_steps(deflection)),
            seconds(script_steps(deflection))
        );
        compared += 1;
    }
    assert_eq!(compared, 6);
}
