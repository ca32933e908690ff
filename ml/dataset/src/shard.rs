//! Shards: a worker's runs on their way to the publisher. Private: nothing outside reads them.
//!
//! An Arrow IPC stream with one row per run and one list column per channel, uncompressed. It was
//! chosen over Parquet because encoding is a copy (a few microseconds per run, `README.md` has the
//! figures), because runs of any length and failed runs fit without a second table, and because
//! writer and reader need memory for one batch only.

use crate::record::{RunKind, RunOutcome, RunRecord, RunSamples, RunStatistics};
use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, Float64Array, ListArray, PrimitiveArray, RecordBatch,
    StringArray, UInt32Array, UInt64Array,
};
use arrow::buffer::{OffsetBuffer, ScalarBuffer};
use arrow::datatypes::{
    ArrowPrimitiveType, DataType, Field, Float32Type, Float64Type, Schema, SchemaRef, UInt32Type, UInt64Type,
};
use arrow::error::ArrowError;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;
use hydroflex_openapi::job::{RunFlag, SampleType, SolverPath};
use std::io::{Read, Write};
use std::sync::Arc;

/// Version of the shard format; a shard of another version is refused.
pub const SHARD_FORMAT: &str = "hydroflex-shard-2";

/// A batch is written once it has this many samples per channel.
const BATCH_ROWS: usize = 16_384;

/// What every run of a shard has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShardSchema {
    /// Names of the channels.
    pub channels: Vec<String>,
    /// Names of the angles.
    pub angles: Vec<String>,
    /// Type in which samples are kept.
    pub sample_type: SampleType,
}

/// Why a shard could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ShardError {
    /// Arrow reports an error, or the medium does.
    #[error("shard cannot be written or read")]
    Arrow(#[from] ArrowError),
    /// A record does not have the shard's shape.
    #[error("run {run_id} has {found} {what}, the shard has {expected}")]
    Shape {
        /// Run.
        run_id: u64,
        /// What was counted.
        what: &'static str,
        /// Count in the record.
        found: usize,
        /// Count in the schema.
        expected: usize,
    },
    /// Columns of one record differ in length.
    #[error("channel {channel} of run {run_id} has {found} samples, the run has {expected}")]
    Length {
        /// Run.
        run_id: u64,
        /// Channel.
        channel: String,
        /// Samples in the column.
        found: usize,
        /// Samples of the run.
        expected: usize,
    },
    /// The file is a shard of another version, or no shard.
    #[error("not a shard of format {SHARD_FORMAT}: found {found:?}")]
    Format {
        /// What its metadata say.
        found: String,
    },
    /// A value that this version never writes.
    #[error("shard column {column} holds {value:?}")]
    Value {
        /// Column.
        column: &'static str,
        /// Value.
        value: String,
    },
}

/// Writes runs one after the other; memory for one batch.
pub struct ShardWriter<W: Write> {
    schema: ShardSchema,
    writer: StreamWriter<W>,
    batch: Batch,
}

/// Fixed columns, in order; then one per angle, then one per channel.
fn fixed_fields() -> Vec<Field> {
    vec![
        Field::new("settling", DataType::Boolean, false),
        Field::new("run_id", DataType::UInt64, false),
        Field::new("seed", DataType::UInt64, true),
        Field::new("payload_kg", DataType::Float64, false),
        Field::new("reason", DataType::Utf8, true),
        Field::new("flags", DataType::UInt32, false),
        Field::new("steps", DataType::UInt64, false),
        Field::new("rejected", DataType::UInt64, false),
        Field::new("iterations", DataType::UInt64, false),
        Field::new("factorisations", DataType::UInt64, false),
        Field::new("path", DataType::Utf8, true),
        Field::new("material", DataType::Utf8, true),
    ]
}

fn sample_data_type(sample_type: SampleType) -> DataType {
    match sample_type {
        SampleType::Float64 => DataType::Float64,
        SampleType::Float32 => DataType::Float32,
    }
}

fn item_field(sample_type: SampleType) -> Arc<Field> {
    Arc::new(Field::new("item", sample_data_type(sample_type), false))
}

fn arrow_schema(schema: &ShardSchema) -> SchemaRef {
    let mut fields = fixed_fields();
    fields.extend(
        schema
            .angles
            .iter()
            .map(|name| Field::new(format!("angle {name}"), DataType::Float64, false)),
    );
    let item = item_field(schema.sample_type);
    fields.extend(
        schema
            .channels
            .iter()
            .map(|name| Field::new(name, DataType::List(Arc::clone(&item)), false)),
    );
    Arc::new(Schema::new(fields).with_metadata([("format", SHARD_FORMAT)]))
}

impl<W: Write> ShardWriter<W> {
    /// Starts a shard.
    ///
    /// # Errors
    /// The medium reports one.
    pub fn new(schema: ShardSchema, out: W) -> Result<Self, ShardError> {
        let writer = StreamWriter::try_new(out, &arrow_schema(&schema))?;
        let batch = Batch::new(&schema);
        Ok(Self {
            schema,
            writer,
            batch,
        })
    }

    /// Adds a run.
    ///
    /// # Errors
    /// The record does not have the shard's shape, or the medium reports an error.
    pub fn push(&mut self, record: &RunRecord) -> Result<(), ShardError> {
        check_shape(record, self.schema.angles.len(), &self.schema.channels)?;
        self.batch.push(record);
        if self.batch.rows() >= BATCH_ROWS {
            self.flush()?;
        }
        Ok(())
    }

    fn flush(&mut self) -> Result<(), ShardError> {
        // The next batch will be as large.
        let next = Batch::with_capacity(&self.schema, self.batch.rows());
        let batch = std::mem::replace(&mut self.batch, next);
        self.writer.write(&batch.into_arrow(&self.schema)?)?;
        Ok(())
    }

    /// Ends the shard and gives the medium back.
    ///
    /// # Errors
    /// The medium reports one.
    pub fn finish(mut self) -> Result<W, ShardError> {
        if !self.batch.run_id.is_empty() {
            self.flush()?;
        }
        self.writer.finish()?;
        Ok(self.writer.into_inner()?)
    }
}

/// Checks that a record has one value per angle and, if it ended well, one full column per channel.
pub(crate) fn check_shape(record: &RunRecord, angles: usize, channels: &[String]) -> Result<(), ShardError> {
    let shape = |what, found, expected| ShardError::Shape {
        run_id: record.run_id,
        what,
        found,
        expected,
    };
    if record.angles_rad.len() != angles {
        return Err(shape("angles", record.angles_rad.len(), angles));
    }
    if let Some(samples) = record.samples() {
        if samples.columns.len() != channels.len() {
            return Err(shape("channels", samples.columns.len(), channels.len()));
        }
        for (column, channel) in samples.columns.iter().zip(channels) {
            if column.len() != samples.sample_count {
                return Err(ShardError::Length {
                    run_id: record.run_id,
                    channel: channel.clone(),
                    found: column.len(),
                    expected: samples.sample_count,
                });
            }
        }
    }
    Ok(())
}

/// Columns of the runs that wait to be written.
#[derive(Debug)]
struct Batch {
    settling: Vec<bool>,
    run_id: Vec<u64>,
    seed: Vec<Option<u64>>,
    payload_kg: Vec<f64>,
    reason: Vec<Option<String>>,
    flags: Vec<u32>,
    statistics: [Vec<u64>; 4],
    path: Vec<Option<&'static str>>,
    material: Vec<Option<String>>,
    angles: Vec<Vec<f64>>,
    offsets: Vec<i32>,
    samples: SampleColumns,
}

#[derive(Debug)]
enum SampleColumns {
    F64(Vec<Vec<f64>>),
    F32(Vec<Vec<f32>>),
}

impl Batch {
    fn new(schema: &ShardSchema) -> Self {
        Self::with_capacity(schema, 0)
    }

    fn with_capacity(schema: &ShardSchema, rows: usize) -> Self {
        let channels = schema.channels.len();
        Self {
            settling: Vec::new(),
            run_id: Vec::new(),
            seed: Vec::new(),
            payload_kg: Vec::new(),
            reason: Vec::new(),
            flags: Vec::new(),
            statistics: Default::default(),
            path: Vec::new(),
            material: Vec::new(),
            angles: vec![Vec::new(); schema.angles.len()],
            offsets: vec![0],
            samples: match schema.sample_type {
                SampleType::Float64 => {
                    SampleColumns::F64((0..channels).map(|_| Vec::with_capacity(rows)).collect())
                }
                SampleType::Float32 => {
                    SampleColumns::F32((0..channels).map(|_| Vec::with_capacity(rows)).collect())
                }
            },
        }
    }

    fn rows(&self) -> usize {
        usize::try_from(self.offsets.last().copied().unwrap_or(0)).unwrap_or(usize::MAX)
    }

    fn push(&mut self, record: &RunRecord) {
        self.settling.push(record.kind == RunKind::Settling);
        self.run_id.push(record.run_id);
        self.seed.push(record.seed);
        self.payload_kg.push(record.payload_kg);
        self.reason.push(record.reason().map(str::to_owned));
        self.flags.push(flag_bits(&record.flags));
        let s = record.statistics;
        let counts = [s.steps, s.rejected, s.iterations, s.factorisations];
        for (column, count) in self.statistics.iter_mut().zip(counts) {
            column.push(count);
        }
        self.path.push(s.path.map(SolverPath::as_str));
        self.material.push(record.material.clone());
        for (column, angle) in self.angles.iter_mut().zip(&record.angles_rad) {
            column.push(*angle);
        }
        let end = self.rows() + record.samples().map_or(0, |samples| samples.sample_count);
        self.offsets.push(i32::try_from(end).unwrap_or(i32::MAX));
        let Some(samples) = record.samples() else {
            return;
        };
        match &mut self.samples {
            SampleColumns::F64(columns) => {
                for (column, values) in columns.iter_mut().zip(&samples.columns) {
                    column.extend_from_slice(values);
                }
            }
            SampleColumns::F32(columns) => {
                for (column, values) in columns.iter_mut().zip(&samples.columns) {
                    column.extend(values.iter().map(|&x| narrow(x)));
                }
            }
        }
    }

    fn into_arrow(self, schema: &ShardSchema) -> Result<RecordBatch, ArrowError> {
        let mut columns: Vec<ArrayRef> = vec![
            Arc::new(BooleanArray::from(self.settling)),
            Arc::new(UInt64Array::from(self.run_id)),
            Arc::new(UInt64Array::from(self.seed)),
            Arc::new(Float64Array::from(self.payload_kg)),
            Arc::new(StringArray::from(self.reason)),
            Arc::new(UInt32Array::from(self.flags)),
        ];
        for counts in self.statistics {
            columns.push(Arc::new(UInt64Array::from(counts)));
        }
        columns.push(Arc::new(StringArray::from(self.path)));
        columns.push(Arc::new(StringArray::from(self.material)));
        for angle in self.angles {
            columns.push(Arc::new(Float64Array::from(angle)));
        }
        let item = item_field(schema.sample_type);
        let offsets = OffsetBuffer::new(ScalarBuffer::from(self.offsets));
        match self.samples {
            SampleColumns::F64(values) => {
                push_lists::<Float64Type>(&mut columns, &item, &offsets, values)?;
            }
            SampleColumns::F32(values) => {
                push_lists::<Float32Type>(&mut columns, &item, &offsets, values)?;
            }
        }
        RecordBatch::try_new(arrow_schema(schema), columns)
    }
}

fn push_lists<T: ArrowPrimitiveType>(
    columns: &mut Vec<ArrayRef>,
    item: &Arc<Field>,
    offsets: &OffsetBuffer<i32>,
    values: Vec<Vec<T::Native>>,
) -> Result<(), ArrowError> {
    for values in values {
        let values = PrimitiveArray::<T>::new(ScalarBuffer::from(values), None);
        let list = ListArray::try_new(Arc::clone(item), offsets.clone(), Arc::new(values), None)?;
        columns.push(Arc::new(list));
    }
    Ok(())
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "rounding to the nearest 32-bit float is what the job asked for"
)]
fn narrow(x: f64) -> f32 {
    x as f32
}

fn flag_bits(flags: &[RunFlag]) -> u32 {
    RunFlag::ALL
        .iter()
        .enumerate()
        .filter(|(_, flag)| flags.contains(flag))
        .fold(0, |bits, (index, _)| bits | 1 << index)
}

fn flags_of_bits(bits: u32) -> Result<Vec<RunFlag>, ShardError> {
    if bits >> RunFlag::ALL.len() != 0 {
        return Err(ShardError::Value {
            column: "flags",
            value: format!("{bits:#b}"),
        });
    }
    let mut flags: Vec<RunFlag> = RunFlag::ALL
        .into_iter()
        .enumerate()
        .filter(|(index, _)| bits >> index & 1 == 1)
        .map(|(_, flag)| flag)
        .collect();
    flags.sort_unstable();
    Ok(flags)
}

/// Reads runs one after the other, in the order in which they were written.
#[derive(Debug)]
pub struct ShardReader<R: Read> {
    schema: ShardSchema,
    reader: StreamReader<R>,
    batch: Option<(RecordBatch, usize)>,
}

impl<R: Read> ShardReader<R> {
    /// Opens a shard.
    ///
    /// # Errors
    /// It is not one of this version.
    pub fn open(input: R) -> Result<Self, ShardError> {
        let reader = StreamReader::try_new(input, None)?;
        let schema = read_schema(&reader.schema())?;
        Ok(Self {
            schema,
            reader,
            batch: None,
        })
    }

    /// What every run of the shard has.
    #[must_use]
    pub fn schema(&self) -> &ShardSchema {
        &self.schema
    }

    fn read(&mut self) -> Result<Option<RunRecord>, ShardError> {
        loop {
            if let Some((batch, row)) = &mut self.batch
                && *row < batch.num_rows()
            {
                *row += 1;
                return record_at(batch, *row - 1, &self.schema).map(Some);
            }
            match self.reader.next().transpose()? {
                Some(batch) => self.batch = Some((batch, 0)),
                None => return Ok(None),
            }
        }
    }
}

impl<R: Read> Iterator for ShardReader<R> {
    type Item = Result<RunRecord, ShardError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// The description from a stream's schema, which must be exactly what the writer makes of it.
fn read_schema(found: &SchemaRef) -> Result<ShardSchema, ShardError> {
    let format = found.metadata().get("format").cloned().unwrap_or_default();
    let error = ShardError::Format {
        found: format.clone(),
    };
    if format != SHARD_FORMAT {
        return Err(error);
    }
    let mut schema = ShardSchema {
        channels: Vec::new(),
        angles: Vec::new(),
        sample_type: SampleType::Float64,
    };
    for field in found.fields().iter().skip(fixed_fields().len()) {
        match (field.data_type(), field.name().strip_prefix("angle ")) {
            (DataType::Float64, Some(angle)) => schema.angles.push(angle.to_owned()),
            (DataType::List(item), _) => {
                if item.data_type() == &DataType::Float32 {
                    schema.sample_type = SampleType::Float32;
                }
                schema.channels.push(field.name().clone());
            }
            _ => return Err(error),
        }
    }
    if arrow_schema(&schema) == *found {
        Ok(schema)
    } else {
        Err(error)
    }
}

fn record_at(batch: &RecordBatch, row: usize, schema: &ShardSchema) -> Result<RunRecord, ShardError> {
    // types were compared with the writer's schema when the shard was opened
    let u64_at = |column: usize| batch.column(column).as_primitive::<UInt64Type>().value(row);
    let f64_at = |column: usize| batch.column(column).as_primitive::<Float64Type>().value(row);
    let seed = batch.column(2);
    let reason = batch.column(4);
    let material = batch.column(11);
    let angles = fixed_fields().len();
    let outcome = if reason.is_valid(row) {
        RunOutcome::Failed {
            reason: reason.as_string::<i32>().value(row).to_owned(),
        }
    } else {
        let first = angles + schema.angles.len();
        let columns: Vec<Vec<f64>> = (first..first + schema.channels.len())
            .map(|column| list_at(batch.column(column).as_list(), row))
            .collect();
        let offsets = batch
            .columns()
            .get(first)
            .map(|column| column.as_list::<i32>().value_length(row));
        RunOutcome::Ok(RunSamples {
            sample_count: usize::try_from(offsets.unwrap_or(0)).unwrap_or(0),
            columns,
        })
    };
    Ok(RunRecord {
        kind: if batch.column(0).as_boolean().value(row) {
            RunKind::Settling
        } else {
            RunKind::Job
        },
        run_id: u64_at(1),
        seed: seed.is_valid(row).then(|| u64_at(2)),
        payload_kg: f64_at(3),
        material: material
            .is_valid(row)
            .then(|| material.as_string::<i32>().value(row).to_owned()),
        angles_rad: (angles..angles + schema.angles.len()).map(f64_at).collect(),
        outcome,
        flags: flags_of_bits(batch.column(5).as_primitive::<UInt32Type>().value(row))?,
        statistics: RunStatistics {
            steps: u64_at(6),
            rejected: u64_at(7),
            iterations: u64_at(8),
            factorisations: u64_at(9),
            path: path_at(batch.column(10), row)?,
        },
    })
}

fn path_at(column: &ArrayRef, row: usize) -> Result<Option<SolverPath>, ShardError> {
    if column.is_null(row) {
        return Ok(None);
    }
    let name = column.as_string::<i32>().value(row);
    match SolverPath::from_name(name) {
        Some(path) => Ok(Some(path)),
        None => Err(ShardError::Value {
            column: "path",
            value: name.to_owned(),
        }),
    }
}

fn list_at(list: &ListArray, row: usize) -> Vec<f64> {
    let values = list.value(row);
    if let Some(values) = values.as_primitive_opt::<Float64Type>() {
        values.values().to_vec()
    } else {
        let values = values.as_primitive::<Float32Type>();
        values.values().iter().map(|&x| f64::from(x)).collect()
    }
}
