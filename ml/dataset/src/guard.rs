//! Parquet files that contradict themselves: the library panics on some of them, where a reader wants an error.

use arrow::array::RecordBatch;
use arrow::error::ArrowError;
use parquet::arrow::arrow_reader::{ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder};
use parquet::errors::ParquetError;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};

const CONTRADICTION: &str = "its parts contradict each other";

/// Opens a Parquet file.
///
/// # Errors
/// It is none, or damaged.
pub fn open_parquet(file: File) -> Result<ParquetRecordBatchReaderBuilder<File>, ParquetError> {
    guarded(|| ParquetRecordBatchReaderBuilder::try_new(file))
}

/// The batches of an opened file.
///
/// # Errors
/// It is damaged.
pub fn batches(builder: ParquetRecordBatchReaderBuilder<File>) -> Result<Batches, ParquetError> {
    guarded(|| builder.build()).map(|reader| Batches(Some(reader)))
}

/// Batches of a file; after an error there are no more.
#[derive(Debug)]
pub struct Batches(Option<ParquetRecordBatchReader>);

impl Iterator for Batches {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let reader = self.0.as_mut()?;
        // A reader that panicked is dropped, so its state does not matter.
        let next = catch_unwind(AssertUnwindSafe(|| reader.next()))
            .unwrap_or_else(|_| Some(Err(ArrowError::ParquetError(CONTRADICTION.to_owned()))));
        if next.as_ref().is_none_or(Result::is_err) {
            self.0 = None;
        }
        next
    }
}

fn guarded<T>(read: impl FnOnce() -> Result<T, ParquetError>) -> Result<T, ParquetError> {
    catch_unwind(AssertUnwindSafe(read))
        .unwrap_or_else(|_| Err(ParquetError::General(CONTRADICTION.to_owned())))
}
