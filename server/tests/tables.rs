//! Recordings as Arrow and Parquet: any length, several runs, everything wrong with its place.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::type_complexity,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use arrow::array::{Array, ArrayRef, AsArray, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow::compute::concat_batches;
use arrow::datatypes::{DataType, Field, Float64Type, Int64Type, Schema};
use bytes::Bytes;
use common::Desk;
use common::models::{interval, synthetic};
use hydroflex_ml::predict::synthetic::signal;
use hydroflex_openapi::prediction::PredictResponse;
use hydroflex_openapi::problem::Problem;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use proptest::prelude::*;
use std::sync::Arc;

const ARROW: &str = "application/vnd.apache.arrow.stream";
const PARQUET: &str = "application/vnd.apache.parquet";
const INPUTS: [&str; 5] = [
    "valve_lift_ratio",
    "length_lift_m",
    "velocity_lift_m_per_s",
    "pressure_lift_piston_pa",
    "pressure_lift_rod_pa",
];

/// A recording of runs of these lengths, in columns.
fn recording(lengths: &[usize]) -> Vec<(String, ArrayRef)> {
    let rows: usize = lengths.iter().sum();
    let samples = signal(0, rows);
    let mut columns: Vec<(String, ArrayRef)> = Vec::new();
    let of_runs = |value: &dyn Fn(usize, usize) -> f64| -> Vec<f64> {
        let runs = lengths.iter().enumerate();
        runs.flat_map(|(run, &length)| (0..length).map(move |step| (run, step)))
            .map(|(run, step)| value(run, step))
            .collect()
    };
    let integers =
        |values: Vec<f64>| -> ArrayRef { Arc::new(values.iter().map(|v| *v as i64).collect::<Int64Array>()) };
    columns.push(("run_id".to_owned(), integers(of_runs(&|run, _| run as f64 + 3.0))));
    columns.push(("step".to_owned(), integers(of_runs(&|_, step| step as f64))));
    let time = of_runs(&|_, step| step as f64 * 0.005);
    columns.push(("time_s".to_owned(), Arc::new(Float64Array::from(time))));
    for (i, name) in INPUTS.iter().enumerate() {
        let column: Vec<f64> = samples.iter().skip(i).step_by(5).copied().collect();
        columns.push(((*name).to_owned(), Arc::new(Float64Array::from(column))));
    }
    let remarks: StringArray = (0..rows).map(|_| Some("as it was")).collect();
    columns.push(("remark".to_owned(), Arc::new(remarks)));
    columns
}

fn batch(columns: &[(String, ArrayRef)]) -> RecordBatch {
    let fields: Vec<Field> = columns
        .iter()
        .map(|(name, column)| Field::new(name, column.data_type().clone(), true))
        .collect();
    let arrays = columns.iter().map(|(_, column)| column.clone()).collect();
    RecordBatch::try_new(Arc::new(Schema::new(fields)), arrays).unwrap()
}

fn to_arrow(batch: &RecordBatch, rows_per_batch: usize) -> Vec<u8> {
    let mut writer = arrow::ipc::writer::StreamWriter::try_new(Vec::new(), &batch.schema()).unwrap();
    for first in (0..batch.num_rows()).step_by(rows_per_batch) {
        let rows = rows_per_batch.min(batch.num_rows() - first);
        writer.write(&batch.slice(first, rows)).unwrap();
    }
    writer.into_inner().unwrap()
}

fn to_parquet(batch: &RecordBatch) -> Vec<u8> {
    let mut writer = ArrowWriter::try_new(Vec::new(), batch.schema(), None).unwrap();
    writer.write(batch).unwrap();
    writer.into_inner().unwrap()
}

fn from_arrow(bytes: &[u8]) -> RecordBatch {
    let reader = arrow::ipc::reader::StreamReader::try_new(bytes, None).unwrap();
    let schema = reader.schema();
    let batches: Vec<RecordBatch> = reader.map(Result::unwrap).collect();
    concat_batches(&schema, &batches).unwrap()
}

fn from_parquet(bytes: Vec<u8>) -> RecordBatch {
    let builder = ParquetRecordBatchReaderBuilder::try_new(Bytes::from(bytes)).unwrap();
    let schema = builder.schema().clone();
    let batches: Vec<RecordBatch> = builder.build().unwrap().map(Result::unwrap).collect();
    concat_batches(&schema, &batches).unwrap()
}

fn floats<'a>(batch: &'a RecordBatch, name: &str) -> &'a Float64Array {
    batch
        .column_by_name(name)
        .unwrap_or_else(|| panic!("no {name}"))
        .as_primitive::<Float64Type>()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_table_is_answered_row_by_row_in_any_form() {
    let desk = Desk::new().await;
    let model = synthetic("best", 1).following_payload();
    let id = desk.register(&model).await;
    let path = format!("/v1/models/{id}/predict");
    // More rows than are estimated at once, a run shorter than the window, batches cut anywhere.
    let lengths = [9000, 5, 12, 700];
    let table = batch(&recording(&lengths));
    let bodies = [
        (ARROW, to_arrow(&table, 1001)),
        (ARROW, to_arrow(&table, 1 << 20)),
        (PARQUET, to_parquet(&table)),
    ];
    let mut answers = Vec::new();
    for (form, body) in bodies {
        for accept in [ARROW, PARQUET] {
            let headers = [("content-type", form), ("accept", accept)];
            let answer = desk.send("POST", &path, &headers, body.clone()).await;
            assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
            assert_eq!(answer.header("content-type"), accept);
            assert_eq!(answer.header("content-length"), answer.body.len().to_string());
            answers.push(if accept == ARROW {
                from_arrow(&answer.body)
            } else {
                from_parquet(answer.body)
            });
        }
    }
    let first = &answers[0];
    assert_eq!(first.num_rows(), lengths.iter().sum::<usize>());
    let metadata = first.schema().metadata().clone();
    assert_eq!(metadata["hydroflex.model_id"], id.as_str());
    assert_eq!(metadata["hydroflex.model_sha256"][..32], *id.as_str());
    for answer in &answers[1..] {
        for (place, (a, b)) in first.columns().iter().zip(answer.columns()).enumerate() {
            assert_eq!(a.data_type(), b.data_type());
            let name = first.schema().field(place).name().clone();
            // Batches cut elsewhere are estimated in other blocks: equal up to f32 rounding.
            if let (Some(a), Some(b)) = (
                a.as_primitive_opt::<Float64Type>(),
                b.as_primitive_opt::<Float64Type>(),
            ) {
                for row in 0..a.len() {
                    assert_eq!(a.is_null(row), b.is_null(row));
                    if a.is_null(row) {
                        continue;
                    }
                    let (a, b) = (a.value(row), b.value(row));
                    let scale = model
                        .config
                        .targets
                        .iter()
                        .find(|target| name.starts_with(&target.name));
                    let tolerance = 1e-6 * scale.map_or(0.0, |target| target.scale);
                    assert!((a - b).abs() <= tolerance, "{name}, row {row}: {a} {b}");
                }
            } else {
                assert_eq!(a, b);
            }
        }
    }
    // Against the model itself, run by run.
    let predictor = model.predictor();
    let samples = signal(0, first.num_rows());
    let columns: Vec<Vec<f64>> = (0..5)
        .map(|i| samples.iter().skip(i).step_by(5).copied().collect())
        .collect();
    let runs = first
        .column_by_name("run_id")
        .unwrap()
        .as_primitive::<Int64Type>();
    let mut row = 0;
    for (run, &length) in lengths.iter().enumerate() {
        let views: Vec<&[f64]> = columns.iter().map(|column| &column[row..row + length]).collect();
        let series = predictor.predict_series(&views);
        for step in 0..length {
            assert_eq!(runs.value(row + step), run as i64 + 3);
            for (target, channel) in model.config.targets.iter().enumerate() {
                let found = floats(first, &channel.name);
                let lower = floats(first, &format!("{}_lower", channel.name));
                match step.checked_sub(series.first_row) {
                    None => assert!(found.is_null(row + step) && lower.is_null(row + step)),
                    Some(k) => {
                        let truth = series.columns[target][k];
                        let value = found.value(row + step);
                        assert!(
                            (value - truth).abs() <= 1e-6 * channel.scale,
                            "run {run} step {step}"
                        );
                        let [wanted, _] = interval(&model, target, value, Some(series.payload_kg[k]));
                        assert!(
                            (lower.value(row + step) - wanted).abs() <= 1e-6 * channel.scale,
                            "run {run} step {step}"
                        );
                    }
                }
            }
        }
        row += length;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_short_table_can_be_answered_as_json_and_json_as_a_table() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let path = format!("/v1/models/{id}/predict");
    let table = batch(&recording(&[40]));
    let headers = [("content-type", PARQUET), ("accept", "application/json")];
    let answer = desk.send("POST", &path, &headers, to_parquet(&table)).await;
    let from_table: PredictResponse = answer.json();
    assert_eq!(from_table.count, 29);
    let inputs: serde_json::Map<String, serde_json::Value> = INPUTS
        .iter()
        .map(|name| {
            (
                (*name).to_owned(),
                serde_json::json!(floats(&table, name).values().to_vec()),
            )
        })
        .collect();
    let body = serde_json::json!({ "inputs": inputs }).to_string();
    let from_json: PredictResponse = desk.post(&path, &body).await.json();
    assert_eq!(from_json, from_table);
    let headers = [("content-type", "application/json"), ("accept", ARROW)];
    let answer = from_arrow(&desk.send("POST", &path, &headers, body).await.body);
    assert_eq!(
        floats(&answer, "deflection_tip_y_m").values().to_vec(),
        from_json.estimates["deflection_tip_y_m"]
    );
    assert_eq!(
        answer
            .column_by_name("step")
            .unwrap()
            .as_primitive::<Int64Type>()
            .value(0),
        11
    );
    let several = batch(&recording(&[40, 40]));
    let headers = [("content-type", PARQUET), ("accept", "application/json")];
    let answer = desk.send("POST", &path, &headers, to_parquet(&several)).await;
    assert!(answer.problem(422).errors[0].detail.contains("JSON"));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_with_a_table_is_said_with_column_and_row() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let path = format!("/v1/models/{id}/predict");
    let refused = async |change: &dyn Fn(&mut Vec<(String, ArrayRef)>)| -> Problem {
        let mut columns = recording(&[9000, 30]);
        change(&mut columns);
        let table = batch(&columns);
        let headers = [("content-type", ARROW)];
        let arrow = desk
            .send("POST", &path, &headers, to_arrow(&table, 4096))
            .await
            .problem(422);
        let headers = [("content-type", PARQUET)];
        let parquet = desk
            .send("POST", &path, &headers, to_parquet(&table))
            .await
            .problem(422);
        assert_eq!(arrow, parquet);
        arrow
    };
    let replace =
        |columns: &mut Vec<(String, ArrayRef)>, name: &str, change: &dyn Fn(&mut Vec<Option<f64>>)| {
            let place = columns.iter().position(|(column, _)| column == name).unwrap();
            let column = arrow::compute::cast(&columns[place].1, &DataType::Float64).unwrap();
            let mut values: Vec<Option<f64>> = column.as_primitive::<Float64Type>().iter().collect();
            change(&mut values);
            columns[place].1 = Arc::new(Float64Array::from(values));
        };
    let missing = refused(&|columns| columns.retain(|(name, _)| name != "length_lift_m")).await;
    assert_eq!(missing.errors[0].pointer, "/inputs/length_lift_m");
    let unit = refused(&|columns| {
        let place = columns
            .iter()
            .position(|(name, _)| name == "pressure_lift_rod_pa")
            .unwrap();
        "pressure_lift_rod_bar".clone_into(&mut columns[place].0);
    })
    .await;
    assert_eq!(unit.errors[0].pointer, "/inputs/pressure_lift_rod_bar");
    assert!(
        unit.errors[0]
            .detail
            .contains("give it in pa, as pressure_lift_rod_pa")
    );
    for (value, pointer) in [
        (None, "no value"),
        (Some(f64::NAN), "finite"),
        (Some(f64::INFINITY), "finite"),
    ] {
        let hole =
            refused(&|columns| replace(columns, "length_lift_m", &|values| values[8500] = value)).await;
        assert_eq!(hole.errors[0].pointer, "/inputs/length_lift_m/8500");
        assert!(hole.errors[0].detail.contains(pointer), "{hole:?}");
    }
    let gap = refused(&|columns| replace(columns, "step", &|values| values[8193] = Some(9.0))).await;
    assert_eq!(gap.errors[0].pointer, "/inputs/step/8193");
    let clock = refused(&|columns| {
        replace(columns, "time_s", &|values| {
            values[8999] = values[8999].map(|t| t + 0.001);
        });
    })
    .await;
    assert_eq!(clock.errors[0].pointer, "/inputs/time_s/8999");
    assert_eq!(clock.errors[0].allowed.as_deref(), Some("0.005"));
    let text = refused(&|columns| {
        let place = columns
            .iter()
            .position(|(name, _)| name == "length_lift_m")
            .unwrap();
        columns[place].1 = columns.last().unwrap().1.clone();
    })
    .await;
    assert!(text.errors[0].detail.contains("not numeric"), "{text:?}");
    let short = batch(&recording(&[11, 5]));
    let headers = [("content-type", PARQUET)];
    let short = desk
        .send("POST", &path, &headers, to_parquet(&short))
        .await
        .problem(422);
    assert!(short.errors[0].detail.contains("window"), "{short:?}");
    let query = format!("{path}?sample_time_s=0.004");
    let body = to_parquet(&batch(&recording(&[40])));
    desk.send("POST", &query, &headers, body).await.problem(422);
}

/// Whatever the bytes are, the answer is a refusal and the service lives.
async fn survives(desk: &Desk, path: &str, form: &str, body: Vec<u8>) {
    let answer = desk.send("POST", path, &[("content-type", form)], body).await;
    let status = answer.status.as_u16();
    assert!(
        status == 200 || (400..500).contains(&status),
        "{status}: {}",
        String::from_utf8_lossy(&answer.body)
    );
}

#[test]
fn damaged_bodies_are_refused_and_harm_nobody() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (desk, id) = runtime.block_on(async {
        let desk = Desk::new().await;
        let id = desk.register(&synthetic("L", 1)).await;
        (desk, id)
    });
    let table = batch(&recording(&[40]));
    let (predict, infer) = (
        format!("/v1/models/{id}/predict"),
        format!("/v2/models/{id}/infer"),
    );
    let samples = signal(0, 12);
    let request = serde_json::json!({"inputs": [{"name": "window", "datatype": "FP64", "shape": [1, 12, 5], "data": samples}]});
    let inputs: serde_json::Map<String, serde_json::Value> = INPUTS
        .iter()
        .map(|name| {
            (
                (*name).to_owned(),
                serde_json::json!(floats(&table, name).values().to_vec()),
            )
        })
        .collect();
    let good: [(&str, &str, Vec<u8>); 4] = [
        (&predict, ARROW, to_arrow(&table, 13)),
        (&predict, PARQUET, to_parquet(&table)),
        (&infer, "application/json", request.to_string().into_bytes()),
        (
            &predict,
            "application/json",
            serde_json::json!({ "inputs": inputs }).to_string().into_bytes(),
        ),
    ];
    let config = ProptestConfig {
        cases: 150,
        failure_persistence: None,
        ..ProptestConfig::default()
    };
    let mut runner = proptest::test_runner::TestRunner::new(config);
    let changes = (
        0..good.len(),
        proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        proptest::option::of(any::<prop::sample::Index>()),
        proptest::collection::vec(any::<u8>(), 0..40),
    );
    runner
        .run(&changes, |(which, flips, cut, tail)| {
            let (path, form, body) = &good[which];
            let mut body = body.clone();
            for (place, value) in flips {
                let place = place.index(body.len());
                body[place] = value;
            }
            if let Some(cut) = cut {
                body.truncate(cut.index(body.len()));
            }
            body.extend(tail);
            runtime.block_on(survives(&desk, path, form, body));
            Ok(())
        })
        .unwrap();
    for (path, form, body) in good {
        let answer = runtime.block_on(desk.send("POST", path, &[("content-type", form)], body));
        assert_eq!(answer.status, 200, "a good body after all the bad ones");
    }
}
