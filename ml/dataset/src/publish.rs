//! From runs in order to a published data set, streaming, with memory for a row group per part.
//!
//! ```text
//! data/{train,validation,test}-NNNNN-of-MMMMM.parquet   samples
//! meta/runs.parquet  meta/stats.json  meta/settling.parquet  meta/window.json
//! README.md  croissant.json  manifest.json  SHA256SUMS
//! ```
//!
//! Every byte is a function of the [`PublishSpec`] and the runs. The hash of a data set is the
//! SHA-256 of its `SHA256SUMS`.

use crate::cut::{self, Cutter};
use crate::record::{RunKind, RunRecord, RunSamples};
use crate::runs_table::{RunPlace, RunsTable};
use crate::sample_file::{Encoders, SampleFile};
use crate::samples::{SampleBatch, bytes_per_row};
use crate::shard::{ShardError, ShardSchema, check_shape};
use crate::sink::{Sink, SinkFile};
use crate::statistics::Accumulator;
use crate::window::WindowCollector;
use crate::{card, croissant};
use arrow::error::ArrowError;
use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::dataset::{
    CodeFacts, DATASET_FORMAT, DatasetSource, DatasetStatistics, MachineFacts, Manifest, ManifestFile,
    RunCounts, SplitName, WindowFacts,
};
use hydroflex_openapi::job::{JobSpec, RunStatus, SampleType, Split};
use parquet::errors::ParquetError;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::thread::JoinHandle;

/// What is published: everything that decides the bytes beside the runs themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishSpec {
    /// What the runs come from.
    pub source: DatasetSource,
    /// The machine.
    pub machine: MachineFacts,
    /// The code.
    pub code: CodeFacts,
    /// Columns of the samples.
    pub channels: Vec<Channel>,
    /// Time between samples.
    pub sample_time_s: f64,
    /// Type of the samples.
    pub sample_type: SampleType,
    /// How runs are divided.
    pub split: Split,
    /// Size of a file of samples, about, in MB.
    pub file_size_mb: u32,
    /// Planned lengths of the runs, failed or not.
    pub lengths: RunLengths,
    /// Window from the eigenvalues of the machine, s, where they are known.
    pub eigenvalue_window_s: Option<f64>,
}

/// Planned rows of each run, in the order of run indices.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RunLengths {
    /// All alike.
    Uniform {
        /// Runs.
        runs: u64,
        /// Rows of a run.
        rows: u64,
    },
    /// One by one.
    Listed(Vec<u64>),
}

impl RunLengths {
    /// Number of runs.
    #[must_use]
    pub fn runs(&self) -> u64 {
        match self {
            Self::Uniform { runs, .. } => *runs,
            Self::Listed(rows) => rows.len() as u64,
        }
    }

    /// Planned rows of a run.
    #[must_use]
    pub fn rows(&self, index: u64) -> u64 {
        match self {
            Self::Uniform { rows, .. } => *rows,
            Self::Listed(rows) => usize::try_from(index)
                .ok()
                .and_then(|index| rows.get(index))
                .copied()
                .unwrap_or(0),
        }
    }
}

impl PublishSpec {
    /// The specification of a job's data set; of the machine's `channels` it has those that the job keeps.
    #[must_use]
    pub fn of_job(spec: JobSpec, machine: MachineFacts, code: CodeFacts, mut channels: Vec<Channel>) -> Self {
        channels.retain(|channel| spec.keeps(&channel.name));
        Self {
            machine,
            code,
            channels,
            sample_time_s: spec.sample_time_s,
            sample_type: spec.sample_type,
            split: spec.split,
            file_size_mb: spec.file_size_mb,
            lengths: RunLengths::Uniform {
                runs: spec.runs,
                rows: spec.steps() as u64 + 1,
            },
            source: DatasetSource::Job { spec: Box::new(spec) },
            eigenvalue_window_s: None,
        }
    }

    /// Shards that this data set is made from.
    #[must_use]
    pub fn shard_schema(&self) -> ShardSchema {
        ShardSchema {
            channels: self.channels.iter().map(|c| c.name.clone()).collect(),
            angles: self.machine.angles.clone(),
            sample_type: self.sample_type,
        }
    }

    /// Seed of the job, if the runs are random.
    #[must_use]
    pub fn seed(&self) -> Option<u64> {
        match &self.source {
            DatasetSource::Job { spec } => Some(spec.seed),
            DatasetSource::RunTable { .. } => None,
        }
    }
}

/// Why a data set could not be published.
#[derive(Debug, thiserror::Error)]
pub enum PublishError {
    /// The place it is written to reports an error.
    #[error("{path} cannot be written")]
    Sink {
        /// File.
        path: String,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// Encoding fails, or the medium below it.
    #[error("{path} cannot be encoded")]
    Parquet {
        /// File.
        path: String,
        /// Cause.
        #[source]
        source: ParquetError,
    },
    /// Columns do not fit together.
    #[error("samples cannot be arranged")]
    Arrow(#[from] ArrowError),
    /// A run does not have the shape of the data set.
    #[error(transparent)]
    Shape(#[from] ShardError),
    /// Runs do not come in order, or one is missing or doubled.
    #[error("run {found} came where run {expected} was due")]
    Order {
        /// Run that was due: an index for jobs, the smallest allowed id for tables.
        expected: u64,
        /// Run that came.
        found: u64,
    },
    /// The end came too early.
    #[error("{found} runs of {expected} came")]
    Missing {
        /// Planned runs.
        expected: u64,
        /// Runs that came.
        found: u64,
    },
    /// A sample is not finite.
    #[error("channel {channel} of run {run_id} is {value} at step {step}")]
    NotFinite {
        /// Run.
        run_id: u64,
        /// Channel.
        channel: String,
        /// Step.
        step: usize,
        /// Value.
        value: f64,
    },
    /// Threads that encode cannot be started.
    #[error("threads that encode cannot be started")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// A JSON document cannot be written.
    #[error("{path} cannot be serialised")]
    Json {
        /// File.
        path: String,
        /// Cause.
        #[source]
        source: serde_json::Error,
    },
}

/// What was published.
#[derive(Debug, Clone, PartialEq)]
pub struct Published {
    /// The manifest as written.
    pub manifest: Manifest,
    /// SHA-256 of `SHA256SUMS`, hexadecimal: the identity of the data set.
    pub dataset_sha256: String,
    /// Every file, `manifest.json` and `SHA256SUMS` among them, by path.
    pub files: Vec<ManifestFile>,
    /// Lengths of the SLIDE window.
    pub window: WindowFacts,
    /// Statistics of the channels.
    pub statistics: DatasetStatistics,
}

/// Takes runs in order and writes the data set.
pub struct Publisher<S: Sink> {
    spec: PublishSpec,
    channel_names: Vec<String>,
    output: Output<S>,
    parts: BTreeMap<SplitName, Part>,
    runs_table: RunsTable,
    settling: Settling,
    statistics: [Vec<Accumulator>; 2],
    counts: RunCounts,
    flags: BTreeMap<String, u64>,
    solver_paths: BTreeMap<String, u64>,
    next_index: u64,
    next_run_id: u64,
}

/// The sink, and what has been written to it.
struct Output<S: Sink> {
    sink: S,
    files: Vec<ManifestFile>,
    encoders: Encoders,
    /// Files of samples on their way to the disk.
    syncing: Vec<(String, JoinHandle<io::Result<()>>)>,
}

/// Files of one part of the data set.
struct Part {
    split: SplitName,
    cutter: Cutter,
    files: u32,
    batch: SampleBatch,
    open: Option<OpenFile>,
}

struct OpenFile {
    number: u32,
    planned_group: u32,
    writer: SampleFile,
    rows: u64,
}

struct Settling {
    batch: SampleBatch,
    next_run_id: u64,
    writer: Option<SampleFile>,
    rows: u64,
    windows: WindowCollector,
}

/// Threads that encode, at most: so many that reading and hashing, which one thread does, takes as long.
const MOST_ENCODERS: usize = 8;

const SETTLING_PATH: &str = "meta/settling.parquet";

impl<S: Sink> Publisher<S> {
    /// Starts a data set; `encoders` threads, 8 at most, encode its samples beside the caller's, which encodes them
    /// itself if there are none. The bytes are the same.
    ///
    /// # Errors
    /// The sink reports one, or the threads cannot be started.
    pub fn with_encoders(spec: PublishSpec, sink: S, encoders: usize) -> Result<Self, PublishError> {
        let mut publisher = Self::new(spec, sink)?;
        publisher.output.encoders = Encoders::new(encoders.min(MOST_ENCODERS))?;
        Ok(publisher)
    }

    /// Starts a data set.
    ///
    /// # Errors
    /// The sink reports one.
    pub fn new(spec: PublishSpec, mut sink: S) -> Result<Self, PublishError> {
        let parts = plan_parts(&spec);
        let runs_table = RunsTable::create(&spec, &mut sink)?;
        let channels = spec.channels.len();
        Ok(Self {
            channel_names: spec.channels.iter().map(|c| c.name.clone()).collect(),
            output: Output {
                sink,
                files: Vec::new(),
                encoders: Encoders::new(0)?,
                syncing: Vec::new(),
            },
            parts,
            runs_table,
            settling: Settling {
                batch: SampleBatch::new(&spec),
                next_run_id: 0,
                writer: None,
                rows: 0,
                windows: WindowCollector::new(&spec.channels, spec.sample_time_s),
            },
            statistics: [
                vec![Accumulator::default(); channels],
                vec![Accumulator::default(); channels],
            ],
            counts: RunCounts::default(),
            flags: BTreeMap::new(),
            solver_paths: BTreeMap::new(),
            next_index: 0,
            next_run_id: 0,
            spec,
        })
    }

    /// Adds the next run of the job or table, or the next settling run; the two kinds may be mixed.
    ///
    /// # Errors
    /// The run is out of order, has another shape, or the sink reports an error.
    pub fn push(&mut self, record: &RunRecord) -> Result<(), PublishError> {
        check_shape(record, self.spec.machine.angles.len(), &self.channel_names)?;
        check_finite(record, &self.channel_names)?;
        match record.kind {
            RunKind::Job => self.push_run(record),
            RunKind::Settling => self.push_settling(record),
        }
    }

    fn push_run(&mut self, record: &RunRecord) -> Result<(), PublishError> {
        let job = matches!(self.spec.source, DatasetSource::Job { .. });
        let in_order = if job {
            record.run_id == self.next_run_id
        } else {
            record.run_id >= self.next_run_id
        };
        if !in_order || self.next_index >= self.spec.lengths.runs() {
            return Err(PublishError::Order {
                expected: self.next_run_id,
                found: record.run_id,
            });
        }
        let index = self.next_index;
        self.next_index += 1;
        self.next_run_id = record.run_id + 1;
        let split = self.spec.split.of(index);
        self.count(record, split);
        let planned_rows = self.spec.lengths.rows(index);
        let place = match self.parts.get_mut(&split) {
            Some(part) => part.push(record, planned_rows, &self.spec, &mut self.output)?,
            None => None, // plan_parts made one for every part that has a run
        };
        if let Some(samples) = record.samples() {
            self.add_statistics(samples, split);
        }
        self.runs_table.push(record, split, place)
    }

    fn count(&mut self, record: &RunRecord, split: SplitName) {
        self.counts.total += 1;
        match record.status() {
            RunStatus::Ok => self.counts.ok += 1,
            RunStatus::Failed => self.counts.failed += 1,
        }
        match split {
            SplitName::Train => self.counts.train += 1,
            SplitName::Validation => self.counts.validation += 1,
            SplitName::Test => self.counts.test += 1,
        }
        for flag in &record.flags {
            *self.flags.entry(flag.as_str().to_owned()).or_default() += 1;
        }
        if let Some(path) = record.statistics.path {
            *self.solver_paths.entry(path.as_str().to_owned()).or_default() += 1;
        }
    }

    fn add_statistics(&mut self, samples: &RunSamples, split: SplitName) {
        let [all, train] = &mut self.statistics;
        for (channel, column) in samples.columns.iter().enumerate() {
            let of_run = match self.spec.sample_type {
                SampleType::Float64 => Accumulator::of(column),
                SampleType::Float32 => {
                    let stored: Vec<f64> = column.iter().map(|&x| as_stored_f32(x)).collect();
                    Accumulator::of(&stored)
                }
            };
            all[channel].merge(&of_run);
            if split == SplitName::Train {
                train[channel].merge(&of_run);
            }
        }
    }

    fn push_settling(&mut self, record: &RunRecord) -> Result<(), PublishError> {
        if record.run_id != self.settling.next_run_id {
            return Err(PublishError::Order {
                expected: self.settling.next_run_id,
                found: record.run_id,
            });
        }
        self.settling.next_run_id += 1;
        self.counts.settling += 1;
        let Some(samples) = record.samples() else {
            return Ok(()); // a settling run that fails tells nothing; the counts show it
        };
        self.settling.windows.add(samples);
        self.settling.rows += samples.sample_count as u64;
        self.settling.batch.push(record.run_id, samples);
        if self.settling.batch.rows() as u64 >= cut::ROW_GROUP_ROWS {
            self.flush_settling()?;
        }
        Ok(())
    }

    fn flush_settling(&mut self) -> Result<(), PublishError> {
        if self.settling.writer.is_none() {
            let writer = SampleFile::create(SETTLING_PATH, &self.spec, &mut self.output.sink)?;
            self.settling.writer = Some(writer);
        }
        match &mut self.settling.writer {
            Some(writer) => writer.push_group(&mut self.settling.batch, &self.output.encoders),
            None => Ok(()), // made above
        }
    }

    /// Writes what is left and everything that describes the data set.
    ///
    /// # Errors
    /// Runs are missing, or the sink reports an error.
    pub fn finish(mut self) -> Result<(Published, S), PublishError> {
        if self.next_index != self.spec.lengths.runs() {
            return Err(PublishError::Missing {
                expected: self.spec.lengths.runs(),
                found: self.next_index,
            });
        }
        if self.counts.settling > 0 {
            self.flush_settling()?;
        }
        let statistics = self.statistics();
        let window = WindowFacts {
            eigenvalues_s: self.spec.eigenvalue_window_s,
            ..self.settling.windows.finish()
        };
        let Self {
            spec,
            mut output,
            mut parts,
            runs_table,
            settling,
            counts,
            flags,
            solver_paths,
            ..
        } = self;
        for part in parts.values_mut() {
            part.close(&mut output)?;
        }
        output.files.push(runs_table.finish()?);
        if let Some(writer) = settling.writer {
            output.close_samples(writer, settling.rows)?;
        }
        if counts.settling > 0 || window.eigenvalues_s.is_some() {
            output.write_json("meta/window.json", &window)?;
        }
        output.write_json("meta/stats.json", &statistics)?;
        let croissant = croissant::document(&spec, &counts, &output.sorted());
        output.write_json("croissant.json", &croissant)?;
        let card = card::text(&spec, &counts, &flags, &window, &statistics);
        output.write("README.md", card.as_bytes())?;

        let manifest = Manifest {
            format: DATASET_FORMAT,
            source: spec.source,
            machine: spec.machine,
            code: spec.code,
            sample_time_s: spec.sample_time_s,
            sample_type: spec.sample_type,
            split: spec.split,
            channels: spec.channels,
            runs: counts,
            flags,
            solver_paths,
            files: output.sorted(),
        };
        output.write_json("manifest.json", &manifest)?;
        let mut sums = String::new();
        for file in output.sorted() {
            sums.extend([file.sha256.as_str(), "  ", file.path.as_str(), "\n"]);
        }
        output.write("SHA256SUMS", sums.as_bytes())?;
        output.wait_for_disk()?;
        let published = Published {
            manifest,
            dataset_sha256: hex::encode(Sha256::digest(sums.as_bytes())),
            files: output.sorted(),
            window,
            statistics,
        };
        Ok((published, output.sink))
    }

    fn statistics(&self) -> DatasetStatistics {
        let named = |accumulators: &[Accumulator]| {
            self.channel_names
                .iter()
                .zip(accumulators)
                .filter_map(|(name, of)| Some((name.clone(), of.finish()?)))
                .collect()
        };
        let [all, train] = &self.statistics;
        DatasetStatistics {
            all: named(all),
            train: named(train),
        }
    }
}

impl<S: Sink> Output<S> {
    fn write_json<T: Serialize>(&mut self, path: &str, value: &T) -> Result<(), PublishError> {
        let mut text = serde_json::to_vec_pretty(value).map_err(|source| PublishError::Json {
            path: path.to_owned(),
            source,
        })?;
        text.push(b'\n');
        self.write(path, &text)
    }

    fn write(&mut self, path: &str, bytes: &[u8]) -> Result<(), PublishError> {
        let mut file = HashingFile::create(path, &mut self.sink)?;
        file.write_all(bytes).map_err(sink_error(path))?;
        self.files.push(file.finish(path, None)?);
        Ok(())
    }

    /// Ends a file of samples; it goes to the disk while the next one is written.
    fn close_samples(&mut self, writer: SampleFile, rows: u64) -> Result<(), PublishError> {
        let path = writer.path().to_owned();
        let (entry, file) = writer.close()?.into_entry(&path, Some(rows));
        self.files.push(entry);
        self.syncing
            .push((path, std::thread::spawn(move || file.finish())));
        Ok(())
    }

    fn wait_for_disk(&mut self) -> Result<(), PublishError> {
        for (path, syncing) in self.syncing.drain(..) {
            let synced = syncing
                .join()
                .unwrap_or_else(|_| Err(io::Error::other("the thread that wrote it panicked")));
            synced.map_err(sink_error(&path))?;
        }
        Ok(())
    }

    fn sorted(&self) -> Vec<ManifestFile> {
        let mut files = self.files.clone();
        files.sort_by(|a, b| a.path.cmp(&b.path));
        files
    }
}

/// Numbers of files per part, from the planned lengths: one pass of counting, no list of runs.
fn plan_parts(spec: &PublishSpec) -> BTreeMap<SplitName, Part> {
    let cutter = Cutter::new(
        bytes_per_row(spec.channels.len(), spec.sample_type),
        cut::uncompressed_bytes(spec.file_size_mb),
    );
    let mut cutters = BTreeMap::new();
    for index in 0..spec.lengths.runs() {
        cutters
            .entry(spec.split.of(index))
            .or_insert_with(|| cutter.clone())
            .place(spec.lengths.rows(index));
    }
    cutters
        .into_iter()
        .map(|(split, planned)| {
            let part = Part {
                split,
                cutter: cutter.clone(),
                files: planned.files(),
                batch: SampleBatch::new(spec),
                open: None,
            };
            (split, part)
        })
        .collect()
}

impl Part {
    fn push<S: Sink>(
        &mut self,
        record: &RunRecord,
        planned_rows: u64,
        spec: &PublishSpec,
        output: &mut Output<S>,
    ) -> Result<Option<RunPlace>, PublishError> {
        let place = self.cutter.place(planned_rows);
        if self.open.as_ref().is_some_and(|open| open.number != place.file) {
            self.close(output)?;
        }
        let mut open = match self.open.take() {
            Some(open) => open,
            None => OpenFile {
                number: place.file,
                planned_group: place.row_group,
                writer: SampleFile::create(
                    &cut::file_name(self.split, place.file, self.files),
                    spec,
                    &mut output.sink,
                )?,
                rows: 0,
            },
        };
        if open.planned_group != place.row_group {
            open.planned_group = place.row_group;
            open.writer.push_group(&mut self.batch, &output.encoders)?;
        }
        let found = record.samples().map(|samples| {
            open.rows += samples.sample_count as u64;
            self.batch.push(record.run_id, samples);
            RunPlace {
                file: open.writer.path().to_owned(),
                row_group: open.writer.groups(),
            }
        });
        self.open = Some(open);
        Ok(found)
    }

    fn close<S: Sink>(&mut self, output: &mut Output<S>) -> Result<(), PublishError> {
        if let Some(mut open) = self.open.take() {
            open.writer.push_group(&mut self.batch, &output.encoders)?;
            output.close_samples(open.writer, open.rows)?;
        }
        Ok(())
    }
}

pub(crate) fn parquet_error(path: &str) -> impl Fn(ParquetError) -> PublishError + use<> {
    let path = path.to_owned();
    move |source| PublishError::Parquet {
        path: path.clone(),
        source,
    }
}

fn sink_error(path: &str) -> impl Fn(io::Error) -> PublishError + use<> {
    let path = path.to_owned();
    move |source| PublishError::Sink {
        path: path.clone(),
        source,
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "rounding to the nearest 32-bit float is what the job asked for"
)]
fn as_stored_f32(x: f64) -> f64 {
    f64::from(x as f32)
}

/// The simulator refuses such numbers; this is the last line before they would be published.
fn check_finite(record: &RunRecord, channels: &[String]) -> Result<(), PublishError> {
    let Some(samples) = record.samples() else {
        return Ok(());
    };
    for (column, channel) in samples.columns.iter().zip(channels) {
        if let Some(step) = column.iter().position(|x| !x.is_finite()) {
            return Err(PublishError::NotFinite {
                run_id: record.run_id,
                channel: channel.clone(),
                step,
                value: column[step],
            });
        }
    }
    Ok(())
}

/// A file of the sink whose bytes are hashed and counted as they pass.
pub(crate) struct HashingFile {
    file: Box<dyn SinkFile>,
    hash: Sha256,
    bytes: u64,
}

impl HashingFile {
    pub(crate) fn create<S: Sink>(path: &str, sink: &mut S) -> Result<Self, PublishError> {
        Ok(Self {
            file: sink.create(path).map_err(sink_error(path))?,
            hash: Sha256::new(),
            bytes: 0,
        })
    }

    pub(crate) fn finish(self, path: &str, rows: Option<u64>) -> Result<ManifestFile, PublishError> {
        let (entry, file) = self.into_entry(path, rows);
        file.finish().map_err(sink_error(path))?;
        Ok(entry)
    }

    /// The entry of a file that is written whole, and the file, which is not yet on the disk.
    fn into_entry(self, path: &str, rows: Option<u64>) -> (ManifestFile, Box<dyn SinkFile>) {
        let entry = ManifestFile {
            path: path.to_owned(),
            bytes: self.bytes,
            sha256: hex::encode(self.hash.finalize()),
            rows,
        };
        (entry, self.file)
    }
}

impl Write for HashingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.hash.update(&bytes[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
