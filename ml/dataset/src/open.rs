//! A published data set as readers see it.

use crate::guard::{self, Batches};
use crate::samples::KEY_COLUMNS;
use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float32Type, Float64Type, UInt64Type};
use arrow::error::ArrowError;
use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::dataset::{DATASET_FORMAT, DatasetStatistics, Manifest, SplitName, WindowFacts};
use hydroflex_openapi::job::{RunFlag, RunStatus, SolverPath};
use parquet::arrow::ProjectionMask;
use parquet::errors::ParquetError;
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// A data set in a directory, written by a job or by `hydroflex simulate`.
#[derive(Debug, Clone)]
pub struct Dataset {
    root: PathBuf,
    manifest: Manifest,
    sha256: String,
    runs: Vec<RunRow>,
}

/// A row of `meta/runs.parquet`.
#[derive(Debug, Clone, PartialEq)]
pub struct RunRow {
    /// Key of the run.
    pub run_id: u64,
    /// Part.
    pub split: SplitName,
    /// Seed of the run, if it was drawn.
    pub seed: Option<u64>,
    /// Payload.
    pub payload_kg: f64,
    /// Material of the flexible bodies, where the job varied it.
    pub material: Option<String>,
    /// Initial angles in the order of the machine file.
    pub angles_rad: Vec<f64>,
    /// How it ended.
    pub status: RunStatus,
    /// Why it failed.
    pub reason: Option<String>,
    /// What it met.
    pub flags: Vec<RunFlag>,
    /// Which equations were solved; absent in data sets that do not say so.
    pub solver_path: Option<SolverPath>,
    /// File with its samples, relative to the data set.
    pub file: Option<String>,
}

/// Samples of one run, the columns asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct RunColumns {
    /// Key of the run.
    pub run_id: u64,
    /// Rows, the same in every column.
    pub sample_count: usize,
    /// Columns in the order in which they were asked for.
    pub columns: Vec<Vec<f64>>,
}

/// Why a data set cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// A file cannot be read.
    #[error("{} cannot be read", path.display())]
    Io {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// A JSON document does not parse.
    #[error("{} is not what this version writes", path.display())]
    Json {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: serde_json::Error,
    },
    /// A Parquet file does not parse.
    #[error("{} is damaged", path.display())]
    Parquet {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: ParquetError,
    },
    /// A batch cannot be decoded.
    #[error("{} is damaged", path.display())]
    Arrow {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: ArrowError,
    },
    /// Another layout.
    #[error("the data set has format {found}, this build reads {DATASET_FORMAT}")]
    Format {
        /// Format in the manifest.
        found: u32,
    },
    /// A file does not have the length or hash that the manifest says.
    #[error("{}: {what} is {found}, the manifest says {expected}", path.display())]
    Damaged {
        /// File.
        path: PathBuf,
        /// `length` or `sha256`.
        what: &'static str,
        /// As found.
        found: String,
        /// As in the manifest.
        expected: String,
    },
    /// A column is missing or of another type.
    #[error("{} has no column {column} of type {expected}", path.display())]
    Column {
        /// File.
        path: PathBuf,
        /// Column.
        column: String,
        /// Type.
        expected: &'static str,
    },
    /// A text that no version writes there.
    #[error("{}: column {column} holds {value:?}", path.display())]
    Value {
        /// File.
        path: PathBuf,
        /// Column.
        column: &'static str,
        /// Value.
        value: String,
    },
    /// The data set has no such channel.
    #[error("the data set has no channel {name:?}; it has {}", available.join(", "))]
    UnknownChannel {
        /// Asked for.
        name: String,
        /// What there is.
        available: Vec<String>,
    },
}

impl Dataset {
    /// Opens a data set: reads its manifest and runs, checks that every file has its length.
    ///
    /// # Errors
    /// See [`OpenError`].
    pub fn open(root: impl AsRef<Path>) -> Result<Self, OpenError> {
        let root = root.as_ref().to_path_buf();
        let sums = read(&root.join("SHA256SUMS"))?;
        let path = root.join("manifest.json");
        let text = read(&path)?;
        // the version first: another format has other fields
        let version: FormatOnly = parse(&path, &text)?;
        if version.format != DATASET_FORMAT {
            return Err(OpenError::Format {
                found: version.format,
            });
        }
        let manifest: Manifest = parse(&path, &text)?;
        for file in &manifest.files {
            let path = root.join(&file.path);
            let length = fs::metadata(&path).map_err(io_error(&path))?.len();
            if length != file.bytes {
                return Err(OpenError::Damaged {
                    path,
                    what: "length",
                    found: length.to_string(),
                    expected: file.bytes.to_string(),
                });
            }
        }
        let runs = read_runs(&root, &manifest)?;
        Ok(Self {
            root,
            manifest,
            sha256: hex::encode(Sha256::digest(&sums)),
            runs,
        })
    }

    /// Compares the hash of every file with the manifest and `SHA256SUMS`.
    ///
    /// # Errors
    /// A file is damaged or cannot be read.
    pub fn verify(&self) -> Result<(), OpenError> {
        let path = self.root.join("SHA256SUMS");
        let sums = String::from_utf8_lossy(&read(&path)?).into_owned();
        let mut verified = std::collections::HashSet::new();
        for (sha256, file) in sums.lines().filter_map(|line| line.split_once("  ")) {
            self.verify_file(file, sha256)?;
            verified.insert((file, sha256));
        }
        for file in &self.manifest.files {
            if !verified.contains(&(file.path.as_str(), file.sha256.as_str())) {
                self.verify_file(&file.path, &file.sha256)?;
            }
        }
        Ok(())
    }

    fn verify_file(&self, file: &str, expected: &str) -> Result<(), OpenError> {
        let path = self.root.join(file);
        let mut hash = Sha256::new();
        let mut input = File::open(&path).map_err(io_error(&path))?;
        io::copy(&mut input, &mut hash).map_err(io_error(&path))?;
        let found = hex::encode(hash.finalize());
        if found == expected {
            Ok(())
        } else {
            Err(OpenError::Damaged {
                path,
                what: "sha256",
                found,
                expected: expected.to_owned(),
            })
        }
    }

    /// Directory.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The manifest.
    #[must_use]
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Hash of the data set, hexadecimal.
    #[must_use]
    pub fn dataset_sha256(&self) -> &str {
        &self.sha256
    }

    /// Channels of the samples.
    #[must_use]
    pub fn channels(&self) -> &[Channel] {
        &self.manifest.channels
    }

    /// Channel of that name.
    ///
    /// # Errors
    /// There is none.
    pub fn channel(&self, name: &str) -> Result<&Channel, OpenError> {
        let found = self.channels().iter().find(|channel| channel.name == name);
        found.ok_or_else(|| OpenError::UnknownChannel {
            name: name.to_owned(),
            available: self.channels().iter().map(|c| c.name.clone()).collect(),
        })
    }

    /// Time between samples, s.
    #[must_use]
    pub fn sample_time_s(&self) -> f64 {
        self.manifest.sample_time_s
    }

    /// Every run, failed ones among them, by `run_id`.
    #[must_use]
    pub fn runs(&self) -> &[RunRow] {
        &self.runs
    }

    /// The run of that id.
    #[must_use]
    pub fn run(&self, run_id: u64) -> Option<&RunRow> {
        let index = self.runs.binary_search_by_key(&run_id, |run| run.run_id);
        index.ok().and_then(|index| self.runs.get(index))
    }

    /// Statistics of the channels.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn statistics(&self) -> Result<DatasetStatistics, OpenError> {
        let path = self.root.join("meta/stats.json");
        parse(&path, &read(&path)?)
    }

    /// Lengths of the SLIDE window; absent without settling runs.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn window(&self) -> Result<Option<WindowFacts>, OpenError> {
        let path = self.root.join("meta/window.json");
        if self
            .manifest
            .files
            .iter()
            .any(|file| file.path == "meta/window.json")
        {
            parse(&path, &read(&path)?).map(Some)
        } else {
            Ok(None)
        }
    }

    /// Samples of every run of a part that ended well, in the order of `run_id`.
    ///
    /// # Errors
    /// A channel is unknown or a file damaged.
    pub fn load(&self, split: SplitName, channels: &[&str]) -> Result<Vec<RunColumns>, OpenError> {
        self.stream(split, channels)?.collect()
    }

    /// As [`Self::load`], all parts, sorted by `run_id`.
    ///
    /// # Errors
    /// A channel is unknown or a file damaged.
    pub fn load_all(&self, channels: &[&str]) -> Result<Vec<RunColumns>, OpenError> {
        let mut all = Vec::new();
        for split in SplitName::ALL {
            all.extend(self.load(split, channels)?);
        }
        all.sort_by_key(|run| run.run_id);
        Ok(all)
    }

    /// Samples of one run; absent if it failed or does not exist. Reads its row group only.
    ///
    /// # Errors
    /// A channel is unknown or a file damaged.
    pub fn load_run(&self, run_id: u64, channels: &[&str]) -> Result<Option<RunColumns>, OpenError> {
        let Some(file) = self.run(run_id).and_then(|run| run.file.clone()) else {
            return Ok(None);
        };
        let runs = RunIter::new(self, vec![file], channels, Some(run_id))?;
        for run in runs {
            let run = run?;
            if run.run_id == run_id {
                return Ok(Some(run));
            }
        }
        Ok(None)
    }

    /// Runs of a part one by one; memory for a batch of rows.
    ///
    /// # Errors
    /// A channel is unknown.
    pub fn stream(&self, split: SplitName, channels: &[&str]) -> Result<RunIter, OpenError> {
        let prefix = format!("data/{split}-");
        let files = self
            .manifest
            .files
            .iter()
            .filter(|file| file.path.starts_with(&prefix))
            .map(|file| file.path.clone())
            .collect();
        RunIter::new(self, files, channels, None)
    }

    /// Settling runs, in order.
    ///
    /// # Errors
    /// A channel is unknown.
    pub fn settling(&self, channels: &[&str]) -> Result<RunIter, OpenError> {
        let path = "meta/settling.parquet";
        let files = self.manifest.files.iter().filter(|file| file.path == path);
        RunIter::new(self, files.map(|f| f.path.clone()).collect(), channels, None)
    }
}

#[derive(serde::Deserialize)]
struct FormatOnly {
    format: u32,
}

/// Runs of some files, one after the other.
pub struct RunIter {
    root: PathBuf,
    files: std::vec::IntoIter<String>,
    channels: Vec<String>,
    only: Option<u64>,
    reader: Option<(PathBuf, Batches)>,
    batch: Option<(RecordBatch, usize)>,
    run: Option<RunColumns>,
}

impl RunIter {
    fn new(
        dataset: &Dataset,
        files: Vec<String>,
        channels: &[&str],
        only: Option<u64>,
    ) -> Result<Self, OpenError> {
        for name in channels {
            dataset.channel(name)?;
        }
        Ok(Self {
            root: dataset.root.clone(),
            files: files.into_iter(),
            channels: channels.iter().map(|&name| name.to_owned()).collect(),
            only,
            reader: None,
            batch: None,
            run: None,
        })
    }

    fn read(&mut self) -> Result<Option<RunColumns>, OpenError> {
        loop {
            if let Some((batch, row)) = &mut self.batch
                && *row < batch.num_rows()
            {
                let path: &Path = self.reader.as_ref().map_or(Path::new(""), |(path, _)| path);
                let done = take_rows(path, batch, row, &self.channels, &mut self.run)?;
                if done.is_some() {
                    return Ok(done);
                }
                continue;
            }
            if let Some((path, reader)) = &mut self.reader {
                let next = reader.next().transpose();
                match next.map_err(|source| OpenError::Arrow {
                    path: path.clone(),
                    source,
                })? {
                    Some(batch) => {
                        self.batch = Some((batch, 0));
                        continue;
                    }
                    None => self.reader = None,
                }
            }
            match self.files.next() {
                Some(file) => {
                    let path = self.root.join(file);
                    let reader = open_samples(&path, &self.channels, self.only)?;
                    self.reader = Some((path, reader));
                }
                None => return Ok(self.run.take()),
            }
        }
    }
}

impl Iterator for RunIter {
    type Item = Result<RunColumns, OpenError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// Moves rows of one run into `run`; returns the previous run when another begins.
fn take_rows(
    path: &Path,
    batch: &RecordBatch,
    row: &mut usize,
    channels: &[String],
    run: &mut Option<RunColumns>,
) -> Result<Option<RunColumns>, OpenError> {
    let ids = batch.column(0).as_primitive_opt::<UInt64Type>();
    let ids = ids.ok_or_else(|| column_error(path, KEY_COLUMNS[0], "uint64"))?;
    let run_id = ids.value(*row);
    if run.as_ref().is_some_and(|run| run.run_id != run_id) {
        return Ok(run.take());
    }
    let run = run.get_or_insert_with(|| RunColumns {
        run_id,
        sample_count: 0,
        columns: vec![Vec::new(); channels.len()],
    });
    let end = ids.values()[*row..]
        .iter()
        .position(|&id| id != run_id)
        .map_or(batch.num_rows(), |length| *row + length);
    for (column, name) in run.columns.iter_mut().zip(channels) {
        let error = || column_error(path, name, "float64 or float32");
        let array = batch.column_by_name(name).ok_or_else(error)?;
        if let Some(values) = array.as_primitive_opt::<Float64Type>() {
            column.extend_from_slice(&values.values()[*row..end]);
        } else {
            let values = array.as_primitive_opt::<Float32Type>().ok_or_else(error)?;
            column.extend(values.values()[*row..end].iter().map(|&x| f64::from(x)));
        }
    }
    run.sample_count += end - *row;
    *row = end;
    Ok(None)
}

fn open_samples(path: &Path, channels: &[String], only: Option<u64>) -> Result<Batches, OpenError> {
    let parquet_error = |source| OpenError::Parquet {
        path: path.to_path_buf(),
        source,
    };
    let file = File::open(path).map_err(io_error(path))?;
    let builder = guard::open_parquet(file).map_err(parquet_error)?;
    let columns = std::iter::once(KEY_COLUMNS[0]).chain(channels.iter().map(String::as_str));
    let mask = ProjectionMask::columns(builder.parquet_schema(), columns);
    let mut builder = builder.with_projection(mask).with_batch_size(16_384);
    if let Some(run_id) = only {
        let groups = builder.metadata().row_groups();
        let holds = |group: &parquet::file::metadata::RowGroupMetaData| {
            let range = group.column(0).statistics();
            let bound = |bytes: Option<&[u8]>| {
                let bytes: Option<[u8; 8]> = bytes.and_then(|bytes| bytes.try_into().ok());
                bytes.map(u64::from_le_bytes)
            };
            let min = range.and_then(|range| bound(range.min_bytes_opt()));
            let max = range.and_then(|range| bound(range.max_bytes_opt()));
            min.is_none_or(|min| min <= run_id) && max.is_none_or(|max| run_id <= max)
        };
        let wanted = (0..groups.len()).filter(|&i| holds(&groups[i])).collect();
        builder = builder.with_row_groups(wanted);
    }
    guard::batches(builder).map_err(parquet_error)
}

fn read_runs(root: &Path, manifest: &Manifest) -> Result<Vec<RunRow>, OpenError> {
    let path = root.join(crate::runs_table::RUNS_PATH);
    let file = File::open(&path).map_err(io_error(&path))?;
    let reader = guard::open_parquet(file)
        .and_then(guard::batches)
        .map_err(|source| OpenError::Parquet {
            path: path.clone(),
            source,
        })?;
    let mut runs = Vec::new();
    for batch in reader {
        let batch = batch.map_err(|source| OpenError::Arrow {
            path: path.clone(),
            source,
        })?;
        for row in 0..batch.num_rows() {
            runs.push(run_row(&path, &batch, row, &manifest.machine.angles)?);
        }
    }
    runs.sort_by_key(|run| run.run_id);
    Ok(runs)
}

fn run_row(path: &Path, batch: &RecordBatch, row: usize, angles: &[String]) -> Result<RunRow, OpenError> {
    let column = |name: &str| {
        batch
            .column_by_name(name)
            .ok_or_else(|| column_error(path, name, "any"))
    };
    let u64_at = |name: &str| -> Result<Option<u64>, OpenError> {
        let values = column(name)?.as_primitive_opt::<UInt64Type>();
        let values = values.ok_or_else(|| column_error(path, name, "uint64"))?;
        Ok(values.is_valid(row).then(|| values.value(row)))
    };
    let f64_at = |name: &str| -> Result<f64, OpenError> {
        let values = column(name)?.as_primitive_opt::<Float64Type>();
        let values = values.ok_or_else(|| column_error(path, name, "float64"))?;
        Ok(values.value(row))
    };
    let text_at = |name: &str| -> Result<Option<String>, OpenError> {
        let values = column(name)?.as_string_opt::<i32>();
        let values = values.ok_or_else(|| column_error(path, name, "string"))?;
        Ok(values.is_valid(row).then(|| values.value(row).to_owned()))
    };
    let value_error = |column, value: &str| OpenError::Value {
        path: path.to_path_buf(),
        column,
        value: value.to_owned(),
    };
    let split = text_at("split")?.unwrap_or_default();
    let status = text_at("status")?.unwrap_or_default();
    let flags = column("flags")?.as_list_opt::<i32>();
    let flags = flags.ok_or_else(|| column_error(path, "flags", "list of string"))?;
    let flags = flags.value(row);
    let flags = flags
        .as_string_opt::<i32>()
        .ok_or_else(|| column_error(path, "flags", "list of string"))?
        .iter()
        .flatten()
        .map(|name| RunFlag::from_name(name).ok_or_else(|| value_error("flags", name)))
        .collect::<Result<_, _>>()?;
    // data sets made before these were recorded have no such columns
    let later_text_at = |name: &str| match batch.column_by_name(name) {
        None => Ok(None),
        Some(_) => text_at(name),
    };
    let solver_path = later_text_at("solver_path")?
        .map(|name| SolverPath::from_name(&name).ok_or_else(|| value_error("solver_path", &name)))
        .transpose()?;
    Ok(RunRow {
        run_id: u64_at("run_id")?.unwrap_or_default(),
        split: SplitName::from_name(&split).ok_or_else(|| value_error("split", &split))?,
        seed: u64_at("seed")?,
        payload_kg: f64_at("payload_kg")?,
        material: later_text_at("material")?,
        angles_rad: angles
            .iter()
            .map(|angle| f64_at(&format!("angle_{angle}_rad")))
            .collect::<Result<_, _>>()?,
        status: match status.as_str() {
            "ok" => RunStatus::Ok,
            "failed" => RunStatus::Failed,
            other => return Err(value_error("status", other)),
        },
        reason: text_at("reason")?,
        flags,
        solver_path,
        file: text_at("file")?,
    })
}

fn column_error(path: &Path, column: &str, expected: &'static str) -> OpenError {
    OpenError::Column {
        path: path.to_path_buf(),
        column: column.to_owned(),
        expected,
    }
}

fn io_error(path: &Path) -> impl Fn(io::Error) -> OpenError + use<> {
    let path = path.to_path_buf();
    move |source| OpenError::Io {
        path: path.clone(),
        source,
    }
}

fn read(path: &Path) -> Result<Vec<u8>, OpenError> {
    fs::read(path).map_err(io_error(path))
}

fn parse<T: serde::de::DeserializeOwned>(path: &Path, text: &[u8]) -> Result<T, OpenError> {
    serde_json::from_slice(text).map_err(|source| OpenError::Json {
        path: path.to_path_buf(),
        source,
    })
}
