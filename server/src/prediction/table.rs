//! Recordings as Arrow or Parquet, of any length: read, estimated and written a batch of rows at a time.
//!
//! A table has a column per input of the model, and may have `run_id` (the window begins anew with
//! every run), `step` (has to count up by one within a run) and `time_s` (has to advance by the
//! model's sample time); other columns are not looked at. The answer has a row per row: what the
//! table had of `run_id`, `step` and `time_s`, then `X`, `X_lower`, `X_upper` per target and
//! `inside_envelope`, empty until a run has filled its first window.

use super::spool::{Spool, SpoolReader};
use super::{LoadedModel, columns};
use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, Float64Array, Int64Array, RecordBatch, RecordBatchOptions,
};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Float64Type, Int64Type, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;
use hydroflex_openapi::model::ModelConfig;
use hydroflex_openapi::prediction::PredictResponse;
use hydroflex_openapi::problem::FieldError;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ParquetRecordBatchReaderBuilder};
use parquet::arrow::{ArrowWriter, ProjectionMask};
use parquet::basic::{Compression, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use std::collections::HashMap;
use std::io::{BufReader, BufWriter, Write};
use std::sync::Arc;

/// Rows estimated and written at once.
const BATCH_ROWS: usize = 8192;
/// Rows of a row group of the answer: what a Parquet writer holds in memory.
const GROUP_ROWS: usize = 64 * BATCH_ROWS;
/// Steps of time may differ from the sample time by this part: clocks of loggers jitter in their last digits.
const TIME_STEP_TOLERANCE: f64 = 1e-3;

const RUN_ID: &str = "run_id";
const STEP: &str = "step";
const TIME: &str = "time_s";

/// How a table is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TableForm {
    /// Arrow IPC stream.
    Arrow,
    /// Parquet.
    Parquet,
}

impl TableForm {
    /// Its media type.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Arrow => "application/vnd.apache.arrow.stream",
            Self::Parquet => "application/vnd.apache.parquet",
        }
    }

    /// The form of this media type.
    #[must_use]
    pub fn from_media_type(text: &str) -> Option<Self> {
        [Self::Arrow, Self::Parquet]
            .into_iter()
            .find(|form| form.media_type() == text)
    }
}

/// Why a table was not answered.
#[derive(Debug)]
pub enum TableError {
    /// It is not a table of the form that it is said to be.
    Malformed(String),
    /// It says something that is not allowed.
    Invalid(Vec<FieldError>),
    /// The service could not read or write its own files.
    Failed(String),
}

impl From<FieldError> for TableError {
    fn from(error: FieldError) -> Self {
        Self::Invalid(vec![error])
    }
}

fn malformed(error: impl std::fmt::Display) -> TableError {
    TableError::Malformed(error.to_string())
}

fn failed(error: impl std::fmt::Display) -> TableError {
    TableError::Failed(error.to_string())
}

type Batches = Box<dyn Iterator<Item = Result<RecordBatch, ArrowError>>>;

/// Estimates for every row of a table.
///
/// # Errors
/// If the table cannot be read, lacks an input, has a gap, or is shorter than a window.
pub fn predict(
    model: &LoadedModel,
    table: Spool,
    form: TableForm,
    answer_form: TableForm,
    answer: Spool,
) -> Result<Spool, TableError> {
    let (schema, batches) = guard(|| open(table, form, model.config()))?;
    let mut estimator = Estimator::new(model, &schema)?;
    let mut writer = TableWriter::new(answer, answer_form, estimator.schema.clone())?;
    for batch in guarded(batches) {
        let batch = batch?;
        // An Arrow batch is as long as its sender made it.
        for first in (0..batch.num_rows()).step_by(BATCH_ROWS) {
            let part = batch.slice(first, BATCH_ROWS.min(batch.num_rows() - first));
            writer.write(&estimator.estimate(&part)?)?;
        }
    }
    estimator.finish()?;
    writer.finish()
}

/// The inputs of a table of one run, for an answer as JSON.
///
/// # Errors
/// As [`predict`], and for a table of more rows than `limit_rows` or of several runs.
pub fn read_columns(
    model: &LoadedModel,
    table: Spool,
    form: TableForm,
    limit_rows: usize,
) -> Result<Vec<Vec<f64>>, TableError> {
    let (schema, batches) = guard(|| open(table, form, model.config()))?;
    let mut estimator = Estimator::new(model, &schema)?;
    let mut columns = vec![Vec::new(); model.config().inputs.len()];
    for batch in guarded(batches) {
        let rows = estimator.read(&batch?)?;
        if columns[0].len() + rows.count > limit_rows || rows.segments.len() > 1 {
            let error = FieldError::new("", "too much for an answer as JSON").allowed(format!(
                "one run of at most {limit_rows} rows; Accept an Arrow stream or Parquet"
            ));
            return Err(error.into());
        }
        for (column, values) in columns.iter_mut().zip(rows.inputs) {
            column.extend(values);
        }
    }
    Ok(columns)
}

/// An answer to a JSON request as a table: a row per estimate.
///
/// # Errors
/// If the table cannot be written.
pub fn write_response(
    model: &LoadedModel,
    response: &PredictResponse,
    form: TableForm,
    answer: Spool,
) -> Result<Spool, TableError> {
    let schema = Arc::new(answer_schema(model, [false, true, false]));
    let rows = usize::try_from(response.count).unwrap_or(usize::MAX);
    let first = i64::try_from(response.first_step).unwrap_or(i64::MAX);
    let mut columns: Vec<ArrayRef> = vec![Arc::new(Int64Array::from_iter_values((first..).take(rows)))];
    for target in &model.config().targets {
        let groups = [
            Some(&response.estimates),
            response.lower.as_ref(),
            response.upper.as_ref(),
        ];
        for group in groups.into_iter().flatten() {
            let values = group.get(&target.name).cloned().unwrap_or_default();
            columns.push(Arc::new(Float64Array::from(values)));
        }
    }
    if let Some(inside) = &response.inside_envelope {
        columns.push(Arc::new(BooleanArray::from(inside.clone())));
    }
    let batch = RecordBatch::try_new(schema.clone(), columns).map_err(failed)?;
    let mut writer = TableWriter::new(answer, form, schema)?;
    writer.write(&batch)?;
    writer.finish()
}

/// Batches of a reader that may meet any bytes: where they contradict themselves, some readers panic.
fn guarded(mut batches: Batches) -> impl Iterator<Item = Result<RecordBatch, TableError>> {
    let mut ended = false;
    std::iter::from_fn(move || {
        if ended {
            return None;
        }
        let next = guard(|| batches.next().transpose().map_err(malformed));
        ended = next.is_err();
        next.transpose()
    })
}

fn guard<T>(read: impl FnOnce() -> Result<T, TableError>) -> Result<T, TableError> {
    // A reader that panicked is never asked again, so its state does not matter.
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(read))
        .unwrap_or_else(|_| Err(malformed("its parts contradict each other")))
}

fn open(table: Spool, form: TableForm, config: &ModelConfig) -> Result<(SchemaRef, Batches), TableError> {
    match (form, table.into_reader().map_err(failed)?) {
        (TableForm::Parquet, SpoolReader::Memory(bytes)) => open_parquet(bytes, config),
        (TableForm::Parquet, SpoolReader::File(file)) => open_parquet(file, config),
        (TableForm::Arrow, SpoolReader::Memory(bytes)) => open_arrow(std::io::Cursor::new(bytes), config),
        (TableForm::Arrow, SpoolReader::File(file)) => open_arrow(BufReader::new(file), config),
    }
}

fn wanted(schema: &Schema, config: &ModelConfig) -> Vec<usize> {
    let is_wanted = |name: &str| {
        [RUN_ID, STEP, TIME].contains(&name) || config.inputs.iter().any(|input| input.name == name)
    };
    let fields = schema.fields().iter().enumerate();
    fields
        .filter(|(_, field)| is_wanted(field.name()))
        .map(|(place, _)| place)
        .collect()
}

fn open_parquet<R: parquet::file::reader::ChunkReader + 'static>(
    reader: R,
    config: &ModelConfig,
) -> Result<(SchemaRef, Batches), TableError> {
    let metadata =
        ArrowReaderMetadata::load(&reader, parquet::arrow::arrow_reader::ArrowReaderOptions::new())
            .map_err(malformed)?;
    let schema = metadata.schema().clone();
    let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(reader, metadata);
    let mask = ProjectionMask::roots(builder.parquet_schema(), wanted(&schema, config));
    let batches = builder
        .with_projection(mask)
        .with_batch_size(BATCH_ROWS)
        .build()
        .map_err(|error: ParquetError| malformed(error))?;
    Ok((schema, Box::new(batches)))
}

fn open_arrow<R: std::io::Read + 'static>(
    reader: R,
    config: &ModelConfig,
) -> Result<(SchemaRef, Batches), TableError> {
    let reader = StreamReader::try_new(reader, None).map_err(malformed)?;
    let schema = reader.schema();
    let wanted = wanted(&schema, config);
    let batches = reader.map(move |batch| batch?.project(&wanted));
    Ok((schema, Box::new(batches)))
}

/// Rows of one batch, checked.
struct Rows {
    count: usize,
    inputs: Vec<Vec<f64>>,
    run_id: Option<Int64Array>,
    step: Option<Int64Array>,
    time_s: Option<Float64Array>,
    /// Ends of the stretches of one run, and whether each goes on with the run before.
    segments: Vec<(usize, bool)>,
}

/// Slides the window over batches of rows.
struct Estimator<'m> {
    model: &'m LoadedModel,
    schema: SchemaRef,
    has: [bool; 3],
    /// Rows of the current run that the next window still needs, per input.
    carried: Vec<Vec<f64>>,
    /// Last row of the current run: run, step, time.
    last: Option<(i64, i64, f64)>,
    rows: usize,
    estimates: usize,
}

impl<'m> Estimator<'m> {
    fn new(model: &'m LoadedModel, table: &Schema) -> Result<Self, TableError> {
        let config = model.config();
        let present: Vec<&str> = table.fields().iter().map(|field| field.name().as_str()).collect();
        let missing = columns::missing(config, &present, |name| format!("/inputs/{name}"));
        if !missing.is_empty() {
            return Err(TableError::Invalid(missing));
        }
        for place in wanted(table, config) {
            let field = table.field(place);
            if !field.data_type().is_numeric() {
                return Err(FieldError::new(
                    format!("/inputs/{}", field.name()),
                    "the column is not numeric",
                )
                .value(field.data_type().to_string())
                .into());
            }
            if table
                .fields()
                .iter()
                .filter(|other| other.name() == field.name())
                .count()
                > 1
            {
                return Err(FieldError::new(
                    format!("/inputs/{}", field.name()),
                    "the column is there twice",
                )
                .into());
            }
        }
        let has = [RUN_ID, STEP, TIME].map(|name| present.contains(&name));
        Ok(Self {
            model,
            schema: Arc::new(answer_schema(model, has)),
            has,
            carried: vec![Vec::new(); config.inputs.len()],
            last: None,
            rows: 0,
            estimates: 0,
        })
    }

    /// One batch of the answer for one of the table.
    fn estimate(&mut self, batch: &RecordBatch) -> Result<RecordBatch, TableError> {
        let rows = self.read(batch)?;
        let predictor = self.model.predictor();
        let targets = predictor.target_count();
        let keep = predictor.window_steps() - 1;
        let mut estimates: Vec<Vec<Option<f64>>> = vec![Vec::with_capacity(rows.count); targets];
        let mut inside: Vec<Option<bool>> = Vec::with_capacity(rows.count);
        let mut payload_kg: Vec<Option<f64>> = Vec::new();
        let mut first = 0;
        for &(end, goes_on) in &rows.segments {
            if !goes_on {
                self.carried.iter_mut().for_each(Vec::clear);
            }
            for (carried, values) in self.carried.iter_mut().zip(&rows.inputs) {
                carried.extend_from_slice(&values[first..end]);
            }
            let views: Vec<&[f64]> = self.carried.iter().map(Vec::as_slice).collect();
            let series = self
                .model
                .with_workspace(|workspace| predictor.predict_series_with(&views, workspace));
            let found = series.columns.first().map_or(0, Vec::len);
            let blind = end - first - found;
            if predictor.follows_payload() {
                payload_kg.extend(std::iter::repeat_n(None, blind));
                payload_kg.extend(series.payload_kg.into_iter().map(Some));
            }
            for (all, column) in estimates.iter_mut().zip(series.columns) {
                all.extend(std::iter::repeat_n(None, blind));
                all.extend(column.into_iter().map(Some));
            }
            if predictor.has_envelope() {
                inside.extend(std::iter::repeat_n(None, blind));
                inside.extend(series.inside.into_iter().map(Some));
            }
            for carried in &mut self.carried {
                carried.drain(..carried.len().saturating_sub(keep));
            }
            self.estimates += found;
            first = end;
        }
        let mut columns: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        columns.extend(rows.run_id.map(|column| Arc::new(column) as ArrayRef));
        columns.extend(rows.step.map(|column| Arc::new(column) as ArrayRef));
        columns.extend(rows.time_s.map(|column| Arc::new(column) as ArrayRef));
        for (target, values) in estimates.into_iter().enumerate() {
            let bound = |sign: f64| -> ArrayRef {
                let ends = values.iter().enumerate().map(|(row, y)| {
                    let y = (*y)?;
                    let payload_kg = payload_kg.get(row).copied().flatten();
                    predictor
                        .half_width(target, y, payload_kg)
                        .map(|half| y + sign * half)
                });
                Arc::new(ends.collect::<Float64Array>())
            };
            let bounds = predictor.has_intervals().then(|| [bound(-1.0), bound(1.0)]);
            columns.push(Arc::new(Float64Array::from(values)));
            columns.extend(bounds.into_iter().flatten());
        }
        if predictor.has_envelope() {
            columns.push(Arc::new(BooleanArray::from(inside)));
        }
        let options = RecordBatchOptions::new().with_row_count(Some(rows.count));
        RecordBatch::try_new_with_options(self.schema.clone(), columns, &options).map_err(failed)
    }

    /// Refuses a table without a single window.
    fn finish(self) -> Result<(), TableError> {
        if self.estimates > 0 {
            return Ok(());
        }
        let steps = self.model.predictor().window_steps();
        Err(FieldError::new("/inputs", "no run is as long as one window")
            .value(self.rows)
            .allowed(format!("at least {steps} rows"))
            .into())
    }

    /// Checks a batch and notes where it ends.
    fn read(&mut self, batch: &RecordBatch) -> Result<Rows, TableError> {
        let config = self.model.config();
        let count = batch.num_rows();
        let inputs = config
            .inputs
            .iter()
            .map(|input| {
                self.finite(batch, &input.name)
                    .map(|column| column.values().to_vec())
            })
            .collect::<Result<Vec<_>, TableError>>()?;
        let run_id = self.has[0].then(|| self.integers(batch, RUN_ID)).transpose()?;
        let step = self.has[1].then(|| self.integers(batch, STEP)).transpose()?;
        let time_s = self.has[2].then(|| self.finite(batch, TIME)).transpose()?;
        let narrow_time = batch
            .column_by_name(TIME)
            .is_some_and(|column| matches!(column.data_type(), DataType::Float32 | DataType::Float16));
        let mut segments: Vec<(usize, bool)> = Vec::new();
        for row in 0..count {
            let run = run_id.as_ref().map_or(0, |column| column.value(row));
            let step = step.as_ref().map(|column| column.value(row));
            let time = time_s.as_ref().map(|column| column.value(row));
            let before = self.last.filter(|(last_run, _, _)| *last_run == run);
            if let Some((_, last_step, last_time)) = before {
                if let Some(step) = step
                    && last_step.checked_add(1) != Some(step)
                {
                    return Err(self
                        .at(STEP, row, "steps of a run have to count up by one")
                        .value(step)
                        .allowed(last_step.saturating_add(1).to_string())
                        .into());
                }
                if let Some(time) = time {
                    let rounding = if narrow_time { 2.4e-7 } else { 4.5e-16 } * time.abs();
                    let expected = config.sample_time_s;
                    if ((time - last_time) - expected).abs() > TIME_STEP_TOLERANCE * expected + rounding {
                        return Err(self
                            .at(
                                TIME,
                                row,
                                "the time since the row before is not the model's sample time",
                            )
                            .value(time - last_time)
                            .allowed(expected.to_string())
                            .into());
                    }
                }
                match segments.last_mut() {
                    Some((end, _)) => *end = row + 1,
                    None => segments.push((row + 1, true)),
                }
            } else {
                segments.push((row + 1, false));
            }
            self.last = Some((run, step.unwrap_or(0), time.unwrap_or(0.0)));
        }
        self.rows += count;
        Ok(Rows {
            count,
            inputs,
            run_id,
            step,
            time_s,
            segments,
        })
    }

    /// An error at a row of the batch that is being read, counted from the table's first row.
    fn at(&self, column: &str, row: usize, detail: &str) -> FieldError {
        FieldError::new(format!("/inputs/{column}/{}", self.rows + row), detail)
    }

    fn column(&self, batch: &RecordBatch, name: &str, data_type: &DataType) -> Result<ArrayRef, TableError> {
        let column = batch
            .column_by_name(name)
            .ok_or_else(|| malformed(format!("a batch without column {name:?}")))?;
        let cast = cast(column, data_type).map_err(malformed)?;
        // What does not fit its type has no value after the cast either.
        if let Some(nulls) = cast.nulls()
            && let Some(row) = nulls.iter().position(|is_there| !is_there)
        {
            return Err(self.at(name, row, "there is no value").into());
        }
        Ok(cast)
    }

    fn integers(&self, batch: &RecordBatch, name: &str) -> Result<Int64Array, TableError> {
        Ok(self
            .column(batch, name, &DataType::Int64)?
            .as_primitive::<Int64Type>()
            .clone())
    }

    fn finite(&self, batch: &RecordBatch, name: &str) -> Result<Float64Array, TableError> {
        let column = self
            .column(batch, name, &DataType::Float64)?
            .as_primitive::<Float64Type>()
            .clone();
        match column.values().iter().position(|value| !value.is_finite()) {
            Some(row) => Err(self
                .at(name, row, "not a finite number")
                .value(column.value(row).to_string())
                .into()),
            None => Ok(column),
        }
    }
}

/// Columns of the answer, with the model's provenance beside them.
fn answer_schema(model: &LoadedModel, has: [bool; 3]) -> Schema {
    let predictor = model.predictor();
    let config = model.config();
    let types = [DataType::Int64, DataType::Int64, DataType::Float64];
    let mut fields: Vec<Field> = [RUN_ID, STEP, TIME]
        .into_iter()
        .zip(types)
        .zip(has)
        .filter(|(_, has)| *has)
        .map(|((name, data_type), _)| Field::new(name, data_type, false))
        .collect();
    for target in &config.targets {
        let field = |suffix: &str| {
            Field::new(format!("{}{suffix}", target.name), DataType::Float64, true)
                .with_metadata(HashMap::from([("unit".to_owned(), target.unit.clone())]))
        };
        fields.push(field(""));
        if predictor.has_intervals() {
            fields.extend([field("_lower"), field("_upper")]);
        }
    }
    if predictor.has_envelope() {
        fields.push(Field::new("inside_envelope", DataType::Boolean, true));
    }
    Schema::new_with_metadata(fields, provenance(model).into_iter().collect::<HashMap<_, _>>())
}

fn provenance(model: &LoadedModel) -> Vec<(String, String)> {
    let provenance = model.provenance();
    let config = model.config();
    let mut pairs = vec![
        ("model_id", model.id().to_string()),
        ("model_sha256", provenance.model_sha256.clone()),
        ("dataset_id", model.dataset_id().to_string()),
        ("dataset_sha256", provenance.dataset_sha256.clone()),
        ("trained_by_version", provenance.trained_by_version.clone()),
        ("sample_time_s", config.sample_time_s.to_string()),
        ("window_steps", config.window_steps.to_string()),
        ("interval_level", "0.9".to_owned()),
    ];
    pairs.extend(
        provenance
            .simulator_version
            .clone()
            .map(|version| ("simulator_version", version)),
    );
    let named = |(name, value): (&str, String)| (format!("hydroflex.{name}"), value);
    pairs.into_iter().map(named).collect()
}

enum TableWriter {
    Arrow(Box<StreamWriter<BufWriter<Spool>>>),
    Parquet(Box<ArrowWriter<Spool>>),
}

impl TableWriter {
    fn new(answer: Spool, form: TableForm, schema: SchemaRef) -> Result<Self, TableError> {
        Ok(match form {
            TableForm::Arrow => {
                let writer = StreamWriter::try_new_buffered(answer, &schema).map_err(failed)?;
                Self::Arrow(Box::new(writer))
            }
            TableForm::Parquet => {
                let properties = WriterProperties::builder()
                    // Estimates hardly repeat: a dictionary would be built and thrown away.
                    .set_dictionary_enabled(false)
                    .set_statistics_enabled(EnabledStatistics::Chunk)
                    .set_compression(Compression::ZSTD(ZstdLevel::default()))
                    .set_max_row_group_row_count(Some(GROUP_ROWS))
                    .build();
                Self::Parquet(Box::new(
                    ArrowWriter::try_new(answer, schema, Some(properties)).map_err(failed)?,
                ))
            }
        })
    }

    fn write(&mut self, batch: &RecordBatch) -> Result<(), TableError> {
        match self {
            Self::Arrow(writer) => writer.write(batch).map_err(failed),
            Self::Parquet(writer) => writer.write(batch).map_err(failed),
        }
    }

    fn finish(self) -> Result<Spool, TableError> {
        match self {
            Self::Arrow(mut writer) => {
                writer.finish().map_err(failed)?;
                let mut buffered = writer.into_inner().map_err(failed)?;
                buffered.flush().map_err(failed)?;
                buffered.into_inner().map_err(failed)
            }
            Self::Parquet(writer) => writer.into_inner().map_err(failed),
        }
    }
}
