//! One file of samples: row groups are encoded beside each other, and written in order.
//!
//! ```text
//! rows of whole runs ──► encoder threads ──► column chunks, in order ──► file
//! ```
//!
//! A row group's bytes depend on its rows alone, so the file is the same with any number of threads.

use crate::publish::{HashingFile, PublishError, PublishSpec, parquet_error};
use crate::samples::{SampleBatch, sample_properties, sample_schema};
use crate::sink::Sink;
use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_writer::{
    ArrowColumnChunk, ArrowColumnWriter, ArrowRowGroupWriterFactory, compute_leaves,
};
use parquet::errors::ParquetError;
use parquet::file::writer::SerializedFileWriter;
use std::collections::VecDeque;
use std::sync::mpsc;

type Encoded = Result<Vec<ArrowColumnChunk>, ParquetError>;

/// Threads that encode row groups, shared by the files of a data set.
pub(crate) struct Encoders {
    /// Without a pool the caller's thread encodes.
    pool: Option<rayon::ThreadPool>,
}

impl Encoders {
    /// The caller's thread alone, or this many beside it.
    pub(crate) fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        let pool = match threads {
            0 => None,
            _ => Some(
                rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .thread_name(|number| format!("encode-{number}"))
                    .build()?,
            ),
        };
        Ok(Self { pool })
    }

    /// Row groups of a file that may be under way: they bound the memory.
    fn most_waiting(&self) -> usize {
        self.pool
            .as_ref()
            .map_or(0, rayon::ThreadPool::current_num_threads)
    }

    fn encode(&self, writers: Vec<ArrowColumnWriter>, batch: RecordBatch) -> mpsc::Receiver<Encoded> {
        let (sender, receiver) = mpsc::sync_channel(1);
        let work = move || {
            // Nobody waits for it if another file has failed.
            let _ = sender.send(encode(writers, &batch));
        };
        match &self.pool {
            Some(pool) => pool.spawn(work),
            None => work(),
        }
        receiver
    }
}

fn encode(mut writers: Vec<ArrowColumnWriter>, batch: &RecordBatch) -> Encoded {
    let mut next = writers.iter_mut();
    for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
        for leaf in compute_leaves(field, column)? {
            if let Some(writer) = next.next() {
                writer.write(&leaf)?;
            }
        }
    }
    writers.into_iter().map(ArrowColumnWriter::close).collect()
}

/// A file under way.
pub(crate) struct SampleFile {
    path: String,
    writer: SerializedFileWriter<HashingFile>,
    factory: ArrowRowGroupWriterFactory,
    schema: SchemaRef,
    waiting: VecDeque<mpsc::Receiver<Encoded>>,
    groups: u32,
}

impl SampleFile {
    pub(crate) fn create<S: Sink>(
        path: &str,
        spec: &PublishSpec,
        sink: &mut S,
    ) -> Result<Self, PublishError> {
        let failed = parquet_error(path);
        let properties = sample_properties(spec).map_err(&failed)?;
        let schema = sample_schema(&spec.channels, spec.sample_type);
        let file = HashingFile::create(path, sink)?;
        let (writer, factory) = ArrowWriter::try_new(file, schema.clone(), Some(properties))
            .and_then(ArrowWriter::into_serialized_writer)
            .map_err(&failed)?;
        Ok(Self {
            path: path.to_owned(),
            writer,
            factory,
            schema,
            waiting: VecDeque::new(),
            groups: 0,
        })
    }

    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    /// Row groups so far, those that are still encoded among them.
    pub(crate) fn groups(&self) -> u32 {
        self.groups
    }

    /// Starts the next row group with the rows that wait, if there are any.
    pub(crate) fn push_group(
        &mut self,
        batch: &mut SampleBatch,
        encoders: &Encoders,
    ) -> Result<(), PublishError> {
        if batch.rows() == 0 {
            return Ok(());
        }
        let batch = batch.take()?;
        debug_assert_eq!(batch.schema(), self.schema);
        let writers = self
            .factory
            .create_column_writers(self.groups as usize)
            .map_err(parquet_error(&self.path))?;
        self.waiting.push_back(encoders.encode(writers, batch));
        self.groups += 1;
        while self.waiting.len() > encoders.most_waiting() {
            self.append_oldest()?;
        }
        Ok(())
    }

    fn append_oldest(&mut self) -> Result<(), PublishError> {
        let failed = parquet_error(&self.path);
        if let Some(oldest) = self.waiting.pop_front() {
            let chunks = oldest
                .recv()
                .unwrap_or_else(|_| Err(ParquetError::General("the encoder panicked".to_owned())))
                .map_err(&failed)?;
            let mut group = self.writer.next_row_group().map_err(&failed)?;
            for chunk in chunks {
                chunk.append_to_row_group(&mut group).map_err(&failed)?;
            }
            group.close().map_err(&failed)?;
        }
        Ok(())
    }

    /// Writes what is left; gives back the file, which is not yet on the disk.
    pub(crate) fn close(mut self) -> Result<HashingFile, PublishError> {
        while !self.waiting.is_empty() {
            self.append_oldest()?;
        }
        self.writer.into_inner().map_err(parquet_error(&self.path))
    }
}
