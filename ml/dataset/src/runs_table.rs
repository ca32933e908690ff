//! `meta/runs.parquet`: one row per run, whether it ended well or not.

use crate::publish::{HashingFile, PublishError, PublishSpec, parquet_error};
use crate::record::RunRecord;
use crate::samples::common_properties;
use crate::sink::Sink;
use arrow::array::{
    ArrayRef, Float64Builder, ListBuilder, RecordBatch, StringBuilder, UInt32Builder, UInt64Builder,
};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use hydroflex_openapi::dataset::{ManifestFile, SplitName};
use hydroflex_openapi::job::{RunStatus, SolverPath};
use parquet::arrow::ArrowWriter;
use std::sync::Arc;

/// Path of the table.
pub const RUNS_PATH: &str = "meta/runs.parquet";

/// Rows that are collected before they are encoded.
const BATCH_RUNS: usize = 8192;

/// Where the samples of a run are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunPlace {
    /// File, relative to the data set.
    pub file: String,
    /// Row group in that file.
    pub row_group: u32,
}

/// Columns: `run_id, split, seed, payload_kg, material, angle_*_rad, status, reason, flags, solver_*, file,
/// row_group`.
#[must_use]
pub fn runs_schema(angles: &[String]) -> SchemaRef {
    let described = |name: &str, data_type, nullable, unit: &str, quantity: &str| {
        Field::new(name, data_type, nullable).with_metadata([("unit", unit), ("quantity", quantity)])
    };
    let mut fields = vec![
        Field::new("run_id", DataType::UInt64, false),
        Field::new("split", DataType::Utf8, false),
        Field::new("seed", DataType::UInt64, true),
        described("payload_kg", DataType::Float64, false, "kg", "mass"),
        Field::new("material", DataType::Utf8, true),
    ];
    for angle in angles {
        let name = format!("angle_{angle}_rad");
        fields.push(described(&name, DataType::Float64, false, "rad", "initial angle"));
    }
    fields.push(Field::new("status", DataType::Utf8, false));
    fields.push(Field::new("reason", DataType::Utf8, true));
    let flag = Arc::new(Field::new("item", DataType::Utf8, false));
    fields.push(Field::new("flags", DataType::List(flag), false));
    for count in SOLVER_COLUMNS {
        fields.push(Field::new(count, DataType::UInt64, false));
    }
    fields.push(Field::new("solver_path", DataType::Utf8, true));
    fields.push(Field::new("file", DataType::Utf8, true));
    fields.push(Field::new("row_group", DataType::UInt32, true));
    Arc::new(Schema::new(fields))
}

const SOLVER_COLUMNS: [&str; 4] = [
    "solver_steps",
    "solver_rejected_steps",
    "solver_iterations",
    "solver_factorisations",
];

/// The table while runs come in.
pub(crate) struct RunsTable {
    schema: SchemaRef,
    writer: ArrowWriter<HashingFile>,
    columns: Columns,
    waiting: usize,
    rows: u64,
}

struct Columns {
    run_id: UInt64Builder,
    split: StringBuilder,
    seed: UInt64Builder,
    payload_kg: Float64Builder,
    material: StringBuilder,
    angles_rad: Vec<Float64Builder>,
    status: StringBuilder,
    reason: StringBuilder,
    flags: ListBuilder<StringBuilder>,
    solver: [UInt64Builder; 4],
    solver_path: StringBuilder,
    file: StringBuilder,
    row_group: UInt32Builder,
}

impl RunsTable {
    pub(crate) fn create<S: Sink>(spec: &PublishSpec, sink: &mut S) -> Result<Self, PublishError> {
        let schema = runs_schema(&spec.machine.angles);
        let properties = common_properties().map_err(parquet_error(RUNS_PATH))?.build();
        let file = HashingFile::create(RUNS_PATH, sink)?;
        let writer = ArrowWriter::try_new(file, Arc::clone(&schema), Some(properties))
            .map_err(parquet_error(RUNS_PATH))?;
        Ok(Self {
            schema,
            writer,
            columns: Columns::new(spec.machine.angles.len()),
            waiting: 0,
            rows: 0,
        })
    }

    pub(crate) fn push(
        &mut self,
        record: &RunRecord,
        split: SplitName,
        place: Option<RunPlace>,
    ) -> Result<(), PublishError> {
        self.columns.push(record, split, place);
        self.rows += 1;
        self.waiting += 1;
        if self.waiting == BATCH_RUNS {
            self.flush()?;
        }
        Ok(())
    }

    fn flush(&mut self) -> Result<(), PublishError> {
        let batch = RecordBatch::try_new(Arc::clone(&self.schema), self.columns.take())?;
        self.waiting = 0;
        self.writer.write(&batch).map_err(parquet_error(RUNS_PATH))
    }

    pub(crate) fn finish(mut self) -> Result<ManifestFile, PublishError> {
        self.flush()?;
        let file = self.writer.into_inner().map_err(parquet_error(RUNS_PATH))?;
        file.finish(RUNS_PATH, Some(self.rows))
    }
}

impl Columns {
    fn new(angles: usize) -> Self {
        let flag = Field::new("item", DataType::Utf8, false);
        Self {
            run_id: UInt64Builder::new(),
            split: StringBuilder::new(),
            seed: UInt64Builder::new(),
            payload_kg: Float64Builder::new(),
            material: StringBuilder::new(),
            angles_rad: (0..angles).map(|_| Float64Builder::new()).collect(),
            status: StringBuilder::new(),
            reason: StringBuilder::new(),
            flags: ListBuilder::new(StringBuilder::new()).with_field(flag),
            solver: Default::default(),
            solver_path: StringBuilder::new(),
            file: StringBuilder::new(),
            row_group: UInt32Builder::new(),
        }
    }

    fn push(&mut self, record: &RunRecord, split: SplitName, place: Option<RunPlace>) {
        self.run_id.append_value(record.run_id);
        self.split.append_value(split.as_str());
        self.seed.append_option(record.seed);
        self.payload_kg.append_value(record.payload_kg);
        self.material.append_option(record.material.as_deref());
        for (column, angle) in self.angles_rad.iter_mut().zip(&record.angles_rad) {
            column.append_value(*angle);
        }
        self.status.append_value(match record.status() {
            RunStatus::Ok => "ok",
            RunStatus::Failed => "failed",
        });
        self.reason.append_option(record.reason());
        for flag in &record.flags {
            self.flags.values().append_value(flag.as_str());
        }
        self.flags.append(true);
        let s = record.statistics;
        let counts = [s.steps, s.rejected, s.iterations, s.factorisations];
        for (column, count) in self.solver.iter_mut().zip(counts) {
            column.append_value(count);
        }
        self.solver_path.append_option(s.path.map(SolverPath::as_str));
        self.row_group
            .append_option(place.as_ref().map(|place| place.row_group));
        self.file.append_option(place.map(|place| place.file));
    }

    fn take(&mut self) -> Vec<ArrayRef> {
        let mut arrays: Vec<ArrayRef> = vec![
            Arc::new(self.run_id.finish()),
            Arc::new(self.split.finish()),
            Arc::new(self.seed.finish()),
            Arc::new(self.payload_kg.finish()),
            Arc::new(self.material.finish()),
        ];
        for angle in &mut self.angles_rad {
            arrays.push(Arc::new(angle.finish()));
        }
        arrays.push(Arc::new(self.status.finish()));
        arrays.push(Arc::new(self.reason.finish()));
        arrays.push(Arc::new(self.flags.finish()));
        for count in &mut self.solver {
            arrays.push(Arc::new(count.finish()));
        }
        arrays.push(Arc::new(self.solver_path.finish()));
        arrays.push(Arc::new(self.file.finish()));
        arrays.push(Arc::new(self.row_group.finish()));
        arrays
    }
}
