//! Recordings in Parquet: read into [`Runs`], and estimates written beside them.
//!
//! A recording is a table with `run_id`, `step` and one column per signal, sorted by run and step
//! within each run; other columns are left alone.

use crate::model::Model;
use crate::runs::{RunSamples, Runs, RunsError};
use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, Float64Array, RecordBatch, UInt32Array, UInt64Array,
};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Float64Type, Schema, UInt64Type};
use arrow::error::ArrowError;
use hydroflex_dataset::guard;
use hydroflex_openapi::channel::{Channel, ChannelRole};
use parquet::arrow::{ArrowWriter, ProjectionMask};
use parquet::basic::{Compression, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Why a recording cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// File.
    #[error("cannot {action} {}", path.display())]
    File {
        /// `open` or `create`.
        action: &'static str,
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: std::io::Error,
    },
    /// Not a Parquet file, or a damaged one.
    #[error("{} is not a readable Parquet file", path.display())]
    Parquet {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: ParquetError,
    },
    /// Columns of an unexpected type.
    #[error("{}: column {column:?} is not numeric", path.display())]
    Column {
        /// File.
        path: PathBuf,
        /// Column.
        column: String,
        /// Cause.
        #[source]
        source: ArrowError,
    },
    /// An empty cell.
    #[error("{}: run {run_id}, step {step}: column {column:?} has no value", path.display())]
    Missing {
        /// File.
        path: PathBuf,
        /// Run.
        run_id: u64,
        /// Step.
        step: u64,
        /// Column.
        column: String,
    },
    /// Steps that do not follow each other.
    #[error("{}: run {run_id}: step {found} stands where {expected} should; sort by run_id and step", path.display())]
    Order {
        /// File.
        path: PathBuf,
        /// Run.
        run_id: u64,
        /// Expected.
        expected: u64,
        /// There.
        found: u64,
    },
    /// A column that is not there.
    #[error("{}: {source}", path.display())]
    Channels {
        /// File.
        path: PathBuf,
        /// Cause.
        source: RunsError,
    },
}

/// Reads the columns `names` of a recording with `sample_time_s` between samples.
///
/// The time between samples is checked against `time_s` where the file has that column and two
/// rows of a run.
///
/// # Errors
/// The file is not readable, lacks a column, has an empty cell or unsorted steps.
pub fn read_parquet(
    path: &Path,
    names: &[String],
    default_sample_time_s: f64,
) -> Result<Runs, RecordingError> {
    let parquet_error = |source| RecordingError::Parquet {
        path: path.to_owned(),
        source,
    };
    let file = File::open(path).map_err(|source| RecordingError::File {
        action: "open",
        path: path.to_owned(),
        source,
    })?;
    let builder = guard::open_parquet(file).map_err(parquet_error)?;
    let schema = Arc::clone(builder.schema());
    for name in names.iter().map(String::as_str).chain(["run_id", "step"]) {
        if schema.index_of(name).is_err() {
            return Err(RecordingError::Channels {
                path: path.to_owned(),
                source: RunsError::MissingChannel {
                    name: name.to_owned(),
                    available: schema.fields().iter().map(|f| f.name().clone()).collect(),
                },
            });
        }
    }
    let wanted = schema.fields().iter().enumerate().filter_map(|(i, field)| {
        let name = field.name();
        (names.contains(name) || ["run_id", "step", "time_s"].contains(&name.as_str())).then_some(i)
    });
    let mask = ProjectionMask::roots(builder.parquet_schema(), wanted);
    let reader = guard::batches(builder.with_projection(mask)).map_err(parquet_error)?;
    let mut runs: Vec<RunSamples> = Vec::new();
    let mut sample_time_s = None;
    let mut first_time = 0.0;
    for batch in reader {
        let batch = batch.map_err(|source| parquet_error(ParquetError::ArrowError(source.to_string())))?;
        let ids = integers(path, &batch, "run_id")?;
        let steps = integers(path, &batch, "step")?;
        let columns = names
            .iter()
            .map(|name| floats(path, &batch, name))
            .collect::<Result<Vec<_>, _>>()?;
        let times = if batch.column_by_name("time_s").is_some() {
            Some(floats(path, &batch, "time_s")?)
        } else {
            None
        };
        for row in 0..batch.num_rows() {
            let (run_id, step) = (ids.value(row), steps.value(row));
            if runs.last().is_none_or(|run| run.run_id != run_id) {
                runs.push(RunSamples {
                    run_id,
                    columns: vec![Vec::new(); names.len()],
                });
            }
            let Some(run) = runs.last_mut() else { continue };
            let expected = run.len() as u64;
            if step != expected {
                return Err(RecordingError::Order {
                    path: path.to_owned(),
                    run_id,
                    expected,
                    found: step,
                });
            }
            for ((column, values), name) in run.columns.iter_mut().zip(&columns).zip(names) {
                if values.is_null(row) {
                    return Err(RecordingError::Missing {
                        path: path.to_owned(),
                        run_id,
                        step,
                        column: name.clone(),
                    });
                }
                column.push(values.value(row));
            }
            if let (Some(times), None) = (&times, sample_time_s) {
                match step {
                    0 => first_time = times.value(row),
                    1 => sample_time_s = Some(times.value(row) - first_time),
                    _ => {}
                }
            }
        }
    }
    let channels = names
        .iter()
        .map(|name| Channel {
            name: name.clone(),
            unit: field_metadata(&schema, name, "unit"),
            quantity: field_metadata(&schema, name, "quantity"),
            frame: None,
            role: ChannelRole::Sensor,
        })
        .collect();
    Ok(Runs {
        channels,
        sample_time_s: sample_time_s.unwrap_or(default_sample_time_s),
        runs,
    })
}

fn field_metadata(schema: &Schema, name: &str, key: &str) -> String {
    schema
        .field_with_name(name)
        .ok()
        .and_then(|f| f.metadata().get(key).cloned())
        .unwrap_or_default()
}

fn as_type(
    path: &Path,
    batch: &RecordBatch,
    name: &str,
    data_type: &DataType,
) -> Result<ArrayRef, RecordingError> {
    let error = |source| RecordingError::Column {
        path: path.to_owned(),
        column: name.to_owned(),
        source,
    };
    let column = batch
        .column_by_name(name)
        .ok_or_else(|| error(ArrowError::SchemaError("no such column".to_owned())))?;
    cast(column, data_type).map_err(error)
}

fn integers(path: &Path, batch: &RecordBatch, name: &str) -> Result<UInt64Array, RecordingError> {
    Ok(as_type(path, batch, name, &DataType::UInt64)?
        .as_primitive::<UInt64Type>()
        .clone())
}

fn floats(path: &Path, batch: &RecordBatch, name: &str) -> Result<Float64Array, RecordingError> {
    Ok(as_type(path, batch, name, &DataType::Float64)?
        .as_primitive::<Float64Type>()
        .clone())
}

/// One target's estimates in a [`PredictionTable`].
#[derive(Debug, Clone, PartialEq)]
pub struct PredictedColumn {
    /// Column of the target.
    pub name: String,
    /// Estimates; absent before the first whole window.
    pub values: Estimates,
    /// Lower and upper ends of the 90 % intervals, where the model has them.
    pub bounds: Option<(Estimates, Estimates)>,
}

/// One number per row of a recording; absent before the first whole window.
pub type Estimates = Vec<Option<f64>>;

/// Estimates of a recording, one row per sample.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PredictionTable {
    /// Run of each row.
    pub run_id: Vec<u64>,
    /// Step of each row.
    pub step: Vec<u32>,
    /// One per target.
    pub targets: Vec<PredictedColumn>,
    /// Whether the window is inside the envelope, where the model has one.
    pub inside_envelope: Option<Vec<Option<bool>>>,
}

/// Estimates for every sample of `runs`, whose channels are the model's inputs in their order.
///
/// # Panics
/// When the channels are not the model's inputs.
#[must_use]
pub fn predict_runs(model: &Model, runs: &Runs) -> PredictionTable {
    let predictor = model.predictor();
    let mut workspace = predictor.workspace();
    let mut table = PredictionTable {
        targets: model
            .config()
            .targets
            .iter()
            .map(|channel| PredictedColumn {
                name: channel.name.clone(),
                values: Vec::new(),
                bounds: predictor.has_intervals().then(|| (Vec::new(), Vec::new())),
            })
            .collect(),
        inside_envelope: predictor.has_envelope().then(Vec::new),
        ..PredictionTable::default()
    };
    for run in &runs.runs {
        let columns: Vec<&[f64]> = run.columns.iter().map(Vec::as_slice).collect();
        let series = predictor.predict_series_with(&columns, &mut workspace);
        let blind = series.first_row.min(run.len());
        table.run_id.extend(std::iter::repeat_n(run.run_id, run.len()));
        table
            .step
            .extend((0..run.len()).map(|step| u32::try_from(step).unwrap_or(u32::MAX)));
        for (t, (target, column)) in table.targets.iter_mut().zip(&series.columns).enumerate() {
            target.values.extend(std::iter::repeat_n(None, blind));
            target.values.extend(column.iter().copied().map(Some));
            if let Some((lower, upper)) = &mut target.bounds {
                for (bound, sign) in [(lower, -1.0), (upper, 1.0)] {
                    bound.extend(std::iter::repeat_n(None, blind));
                    bound.extend(column.iter().enumerate().map(|(k, &y)| {
                        let payload_kg = series.payload_kg.get(k).copied();
                        predictor.half_width(t, y, payload_kg).map(|half| y + sign * half)
                    }));
                }
            }
        }
        if let Some(inside) = &mut table.inside_envelope {
            inside.extend(std::iter::repeat_n(None, blind));
            inside.extend(series.inside.iter().copied().map(Some));
        }
    }
    table
}

/// Writes `run_id`, `step`, then per target `X`, `X_lower`, `X_upper`, and `inside_envelope`.
///
/// # Errors
/// The file cannot be written.
pub fn write_predictions(path: &Path, table: &PredictionTable) -> Result<(), RecordingError> {
    let parquet_error = |source| RecordingError::Parquet {
        path: path.to_owned(),
        source,
    };
    let mut fields = vec![
        Field::new("run_id", DataType::UInt64, false),
        Field::new("step", DataType::UInt32, false),
    ];
    let mut columns: Vec<ArrayRef> = vec![
        Arc::new(UInt64Array::from(table.run_id.clone())),
        Arc::new(UInt32Array::from(table.step.clone())),
    ];
    for target in &table.targets {
        fields.push(Field::new(&target.name, DataType::Float64, true));
        columns.push(Arc::new(Float64Array::from(target.values.clone())));
        if let Some((lower, upper)) = &target.bounds {
            for (suffix, values) in [("lower", lower), ("upper", upper)] {
                fields.push(Field::new(
                    format!("{}_{suffix}", target.name),
                    DataType::Float64,
                    true,
                ));
                columns.push(Arc::new(Float64Array::from(values.clone())));
            }
        }
    }
    if let Some(inside) = &table.inside_envelope {
        fields.push(Field::new("inside_envelope", DataType::Boolean, true));
        columns.push(Arc::new(BooleanArray::from(inside.clone())));
    }
    let schema = Arc::new(Schema::new(fields));
    let batch = RecordBatch::try_new(Arc::clone(&schema), columns)
        .map_err(|source| parquet_error(ParquetError::ArrowError(source.to_string())))?;
    let file = File::create(path).map_err(|source| RecordingError::File {
        action: "create",
        path: path.to_owned(),
        source,
    })?;
    let properties = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .build();
    let mut writer = ArrowWriter::try_new(file, schema, Some(properties)).map_err(parquet_error)?;
    writer.write(&batch).map_err(parquet_error)?;
    writer.close().map_err(parquet_error)?;
    Ok(())
}
