//! What a run costs from memory to bytes, and how large it becomes.
//!
//! ```text
//! cargo run --release -p hydroflex-dataset --example encode_cost -- DATASET
//! ```
//!
//! DATASET is a data set of the boom with some 2,000 runs; they are encoded in several ways on one
//! thread, best of five. (Repeating fewer runs would let zstd find the repeats.)

#![allow(
    clippy::print_stdout,
    reason = "a benchmark prints, and stops at what it did not expect"
)]

use arrow::array::{ArrayRef, Float32Array, Float64Array, RecordBatch};
use arrow::datatypes::{DataType, Field, Schema};
use hydroflex_dataset::{
    Dataset, MemorySink, PublishSpec, Publisher, RunKind, RunLengths, RunOutcome, RunRecord, RunSamples,
    RunStatistics, ShardReader, ShardWriter,
};
use hydroflex_openapi::job::{SampleType, Split};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::file::properties::WriterProperties;
use sha2::{Digest, Sha256};
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let path = std::env::args().nth(1).ok_or("usage: encode_cost DATASET")?;
    let dataset = Dataset::open(path)?;
    let names: Vec<&str> = dataset.channels().iter().map(|c| c.name.as_str()).collect();
    let loaded = dataset.load_all(&names)?;
    let records: Vec<RunRecord> = loaded
        .iter()
        .map(|run| RunRecord {
            kind: RunKind::Job,
            run_id: run.run_id,
            seed: None,
            payload_kg: 0.0,
            material: None,
            angles_rad: vec![0.0; dataset.manifest().machine.angles.len()],
            outcome: RunOutcome::Ok(RunSamples {
                sample_count: run.sample_count,
                columns: run.columns.clone(),
            }),
            flags: Vec::new(),
            statistics: RunStatistics::default(),
        })
        .collect();
    let samples: usize = loaded.iter().map(|run| run.sample_count * names.len()).sum();
    println!(
        "{} runs, {} columns, {samples} samples",
        records.len(),
        names.len()
    );
    let report = |what: &str, seconds: f64, bytes: usize| {
        println!(
            "{what:44} {:8.1} us/run {:7.2} bytes/sample",
            seconds / records.len() as f64 * 1e6,
            bytes as f64 / samples as f64
        );
    };
    for sample_type in [SampleType::Float64, SampleType::Float32] {
        let spec = PublishSpec {
            source: dataset.manifest().source.clone(),
            machine: dataset.manifest().machine.clone(),
            code: dataset.manifest().code.clone(),
            channels: dataset.channels().to_vec(),
            sample_time_s: dataset.sample_time_s(),
            sample_type,
            eigenvalue_window_s: None,
            split: Split::default(),
            file_size_mb: hydroflex_dataset::cut::FILE_SIZE_MB,
            lengths: RunLengths::Listed(loaded.iter().map(|r| r.sample_count as u64).collect()),
        };
        let name = format!("{sample_type:?}").to_lowercase();
        let (seconds, shard) = best(|| {
            let mut writer = ShardWriter::new(spec.shard_schema(), Vec::new())?;
            for record in &records {
                writer.push(record)?;
            }
            Ok(writer.finish()?)
        })?;
        report(&format!("{name} shard, write"), seconds, shard.len());
        let (seconds, _) = best(|| Ok(black_box(Sha256::digest(&shard))))?;
        report(&format!("{name} shard, SHA-256"), seconds, shard.len());
        let (seconds, _) = best(|| Ok(ShardReader::open(shard.as_slice())?.map(Result::unwrap).count()))?;
        report(&format!("{name} shard, read"), seconds, shard.len());
        let (seconds, bytes) = best(|| {
            let mut publisher = Publisher::new(spec.clone(), MemorySink::default())?;
            for record in &records {
                publisher.push(record)?;
            }
            Ok(publisher
                .finish()?
                .0
                .files
                .iter()
                .map(|file| file.bytes)
                .sum::<u64>())
        })?;
        report(
            &format!("{name} publish, all files"),
            seconds,
            usize::try_from(bytes)?,
        );
    }
    encodings(&dataset, &records, &report)
}

/// The sample columns in one file, in row groups as published.
fn encodings(
    dataset: &Dataset,
    records: &[RunRecord],
    report: &dyn Fn(&str, f64, usize),
) -> Result<(), Failure> {
    let zstd = |level| ZstdLevel::try_new(level).map(Compression::ZSTD);
    for float32 in [false, true] {
        let batches = batches(dataset, records, float32)?;
        for (compression, label) in [
            (Compression::UNCOMPRESSED, "none"),
            (Compression::SNAPPY, "snappy"),
            (zstd(1)?, "zstd 1"),
            (zstd(3)?, "zstd 3"),
            (zstd(9)?, "zstd 9"),
        ] {
            for encoding in [Encoding::PLAIN, Encoding::BYTE_STREAM_SPLIT] {
                let properties = WriterProperties::builder()
                    .set_dictionary_enabled(false)
                    .set_encoding(encoding)
                    .set_compression(compression)
                    .build();
                let (seconds, bytes) = best(|| {
                    let schema = batches[0].schema();
                    let mut writer = ArrowWriter::try_new(Vec::new(), schema, Some(properties.clone()))?;
                    for batch in &batches {
                        writer.write(batch)?;
                        writer.flush()?;
                    }
                    Ok(writer.into_inner()?.len())
                })?;
                let width = if float32 { "float32" } else { "float64" };
                report(&format!("{width} {encoding:?} {label}"), seconds, bytes);
            }
        }
    }
    Ok(())
}

#[expect(clippy::cast_possible_truncation, reason = "that is what float32 means")]
fn batches(dataset: &Dataset, records: &[RunRecord], float32: bool) -> Result<Vec<RecordBatch>, Failure> {
    let data_type = if float32 {
        DataType::Float32
    } else {
        DataType::Float64
    };
    let fields: Vec<Field> = dataset
        .channels()
        .iter()
        .map(|c| Field::new(&c.name, data_type.clone(), false))
        .collect();
    let schema = Arc::new(Schema::new(fields));
    let mut batches = Vec::new();
    for group in records.chunks(82) {
        let columns = (0..dataset.channels().len()).map(|channel| -> ArrayRef {
            let values = group
                .iter()
                .filter_map(RunRecord::samples)
                .flat_map(|samples| samples.columns[channel].iter().copied());
            if float32 {
                Arc::new(Float32Array::from_iter_values(values.map(|x| x as f32)))
            } else {
                Arc::new(Float64Array::from_iter_values(values))
            }
        });
        batches.push(RecordBatch::try_new(Arc::clone(&schema), columns.collect())?);
    }
    Ok(batches)
}

fn best<T>(mut work: impl FnMut() -> Result<T, Failure>) -> Result<(f64, T), Failure> {
    let mut seconds = f64::INFINITY;
    let mut last = None;
    for _ in 0..5 {
        let start = Instant::now();
        last = Some(work()?);
        seconds = seconds.min(start.elapsed().as_secs_f64());
    }
    last.map(|last| (seconds, last))
        .ok_or_else(|| "no repetition".into())
}
