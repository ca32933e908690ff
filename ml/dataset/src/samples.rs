//! The samples of published files: columns, encodings, metadata.
//!
//! Columns are `run_id` (uint64), `step` (int32), `time_s` (float64), then one per channel. A run
//! is contiguous and never crosses a row group; runs are sorted by `run_id`.

use crate::publish::PublishSpec;
use arrow::array::{ArrayRef, Float32Array, Float64Array, Int32Array, RecordBatch, UInt64Array};
use arrow::datatypes::{DataType, Field, Metadata, Schema, SchemaRef};
use arrow::error::ArrowError;
use hydroflex_openapi::channel::{Channel, ChannelRole};
use hydroflex_openapi::job::SampleType;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::{KeyValue, SortingColumn};
use parquet::file::properties::{EnabledStatistics, WriterProperties, WriterVersion};
use parquet::schema::types::ColumnPath;
use std::sync::Arc;

/// Columns before the channels.
pub const KEY_COLUMNS: [&str; 3] = ["run_id", "step", "time_s"];

/// zstd level of samples; `README.md` has the figures behind it.
pub const ZSTD_LEVEL: i32 = 1;

/// Schema of `data/*.parquet` and `meta/settling.parquet`.
#[must_use]
pub fn sample_schema(channels: &[Channel], sample_type: SampleType) -> SchemaRef {
    let described = |field: Field, unit: &str, quantity: &str| {
        field.with_metadata([("unit", unit), ("quantity", quantity)])
    };
    let mut fields = vec![
        described(Field::new("run_id", DataType::UInt64, false), "1", "run"),
        described(Field::new("step", DataType::Int32, false), "1", "sample number"),
        described(Field::new("time_s", DataType::Float64, false), "s", "time"),
    ];
    let data_type = match sample_type {
        SampleType::Float64 => DataType::Float64,
        SampleType::Float32 => DataType::Float32,
    };
    for channel in channels {
        let mut metadata = Metadata::from([
            ("unit", channel.unit.as_str()),
            ("quantity", channel.quantity.as_str()),
            ("role", role_name(channel.role)),
        ]);
        if let Some(frame) = &channel.frame {
            metadata.insert("frame", frame);
        }
        fields.push(Field::new(&channel.name, data_type.clone(), false).with_metadata(metadata));
    }
    Arc::new(Schema::new(fields))
}

fn role_name(role: ChannelRole) -> &'static str {
    match role {
        ChannelRole::Command => "command",
        ChannelRole::Sensor => "sensor",
        ChannelRole::Motion => "motion",
        ChannelRole::Target => "target",
    }
}

/// Uncompressed bytes of a row.
#[must_use]
pub fn bytes_per_row(channels: usize, sample_type: SampleType) -> u64 {
    let width = match sample_type {
        SampleType::Float64 => 8,
        SampleType::Float32 => 4,
    };
    20 + channels as u64 * width
}

/// How sample files are encoded: a function of the specification alone.
///
/// # Errors
/// The zstd level is out of range, which a test excludes.
pub fn sample_properties(spec: &PublishSpec) -> Result<WriterProperties, ParquetError> {
    let mut builder = common_properties()?
        .set_key_value_metadata(Some(file_key_values(spec)))
        .set_sorting_columns(Some([0, 1].map(ascending).to_vec()))
        .set_max_row_group_row_count(None) // row groups are cut at runs, by the publisher
        .set_data_page_row_count_limit(20_000)
        .set_column_bloom_filter_enabled(ColumnPath::from("run_id"), true)
        .set_column_bloom_filter_fpp(ColumnPath::from("run_id"), 0.01)
        .set_column_bloom_filter_max_ndv(ColumnPath::from("run_id"), BLOOM_RUNS)
        .set_column_encoding(ColumnPath::from("run_id"), Encoding::DELTA_BINARY_PACKED)
        .set_column_encoding(ColumnPath::from("step"), Encoding::DELTA_BINARY_PACKED)
        // the same few hundred times in every run
        .set_column_dictionary_enabled(ColumnPath::from("time_s"), true);
    for channel in &spec.channels {
        builder = builder.set_column_encoding(
            ColumnPath::from(channel.name.as_str()),
            Encoding::BYTE_STREAM_SPLIT,
        );
    }
    Ok(builder.build())
}

fn ascending(column_idx: i32) -> SortingColumn {
    SortingColumn {
        column_idx,
        descending: false,
        nulls_first: false,
    }
}

/// Runs per row group for which the bloom filter is sized; more make it less selective, not wrong.
const BLOOM_RUNS: u64 = 256;

/// Encoding of every Parquet file of a data set.
pub(crate) fn common_properties() -> Result<parquet::file::properties::WriterPropertiesBuilder, ParquetError>
{
    Ok(WriterProperties::builder()
        .set_writer_version(WriterVersion::PARQUET_1_0)
        .set_created_by(format!("hydroflex-dataset {}", env!("CARGO_PKG_VERSION")))
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(ZSTD_LEVEL)?))
        .set_dictionary_enabled(false)
        .set_statistics_enabled(EnabledStatistics::Page)
        .set_max_row_group_row_count(Some(65_536)))
}

fn file_key_values(spec: &PublishSpec) -> Vec<KeyValue> {
    let mut pairs = vec![
        ("hydroflex.version", Some(spec.code.version.clone())),
        (
            "hydroflex.instruction_set",
            Some(spec.code.instruction_set.clone()),
        ),
        ("hydroflex.machine", Some(spec.machine.name.clone())),
        (
            "hydroflex.machine_sha256",
            Some(spec.machine.content_sha256.clone()),
        ),
        ("hydroflex.sample_time_s", Some(spec.sample_time_s.to_string())),
        ("hydroflex.channels", serde_json::to_string(&spec.channels).ok()),
    ];
    if let Some(seed) = spec.seed() {
        pairs.push(("hydroflex.seed", Some(seed.to_string())));
    }
    pairs
        .into_iter()
        .map(|(key, value)| KeyValue::new(key.to_owned(), value))
        .collect()
}

/// Samples of whole runs, waiting to be encoded.
#[derive(Debug)]
pub struct SampleBatch {
    schema: SchemaRef,
    sample_type: SampleType,
    sample_time_s: f64,
    run_id: Vec<u64>,
    step: Vec<i32>,
    time_s: Vec<f64>,
    columns: Vec<Vec<f64>>,
}

impl SampleBatch {
    /// Empty.
    #[must_use]
    pub fn new(spec: &PublishSpec) -> Self {
        Self {
            schema: sample_schema(&spec.channels, spec.sample_type),
            sample_type: spec.sample_type,
            sample_time_s: spec.sample_time_s,
            run_id: Vec::new(),
            step: Vec::new(),
            time_s: Vec::new(),
            columns: vec![Vec::new(); spec.channels.len()],
        }
    }

    /// Rows so far.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.run_id.len()
    }

    /// Adds a run whose shape has been checked.
    pub fn push(&mut self, run_id: u64, samples: &crate::record::RunSamples) {
        let rows = i32::try_from(samples.sample_count).unwrap_or(i32::MAX);
        self.run_id
            .extend(std::iter::repeat_n(run_id, samples.sample_count));
        self.step.extend(0..rows);
        self.time_s
            .extend((0..rows).map(|step| f64::from(step) * self.sample_time_s));
        for (column, values) in self.columns.iter_mut().zip(&samples.columns) {
            column.extend_from_slice(values);
        }
    }

    /// Takes the rows as an Arrow batch and leaves this empty.
    ///
    /// # Errors
    /// Columns differ in length, which `push` excludes.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "rounding to the nearest 32-bit float is what the job asked for"
    )]
    pub fn take(&mut self) -> Result<RecordBatch, ArrowError> {
        // The next row group will be as large.
        fn taken<T>(column: &mut Vec<T>) -> Vec<T> {
            let next = Vec::with_capacity(column.len());
            std::mem::replace(column, next)
        }
        let mut arrays: Vec<ArrayRef> = vec![
            Arc::new(UInt64Array::from(taken(&mut self.run_id))),
            Arc::new(Int32Array::from(taken(&mut self.step))),
            Arc::new(Float64Array::from(taken(&mut self.time_s))),
        ];
        for column in &mut self.columns {
            let values = taken(column);
            arrays.push(match self.sample_type {
                SampleType::Float64 => Arc::new(Float64Array::from(values)),
                SampleType::Float32 => Arc::new(Float32Array::from_iter_values(
                    values.into_iter().map(|x| x as f32),
                )),
            });
        }
        RecordBatch::try_new(Arc::clone(&self.schema), arrays)
    }
}
