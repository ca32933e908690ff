//! Where published files and row groups begin: a function of the planned run lengths alone.
//!
//! A run never crosses a row group. Failed runs count with their planned length, so that a failure
//! moves no other run to another file.

use hydroflex_openapi::dataset::SplitName;

/// A row group is closed once it has this many rows: large enough for readers, small enough to
/// fetch a part over HTTP.
pub const ROW_GROUP_ROWS: u64 = 16_384;

/// Size of files of samples where nobody asks for another, in MB.
pub const FILE_SIZE_MB: u32 = 128;

/// A new file begins with the row group whose first run would exceed this, uncompressed: samples take about
/// half on disk.
#[must_use]
pub fn uncompressed_bytes(file_size_mb: u32) -> u64 {
    u64::from(file_size_mb) << 21
}

/// Place of a run in the files of its part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// File, from 0.
    pub file: u32,
    /// Row group in the file, from 0.
    pub row_group: u32,
}

/// Assigns runs of one part to files and row groups, in order.
#[derive(Debug, Clone)]
pub struct Cutter {
    bytes_per_row: u64,
    bytes_per_file: u64,
    next: Place,
    group_rows: u64,
    file_bytes: u64,
    any: bool,
}

impl Cutter {
    /// For rows and files of this uncompressed size.
    #[must_use]
    pub fn new(bytes_per_row: u64, bytes_per_file: u64) -> Self {
        Self {
            bytes_per_row,
            bytes_per_file,
            next: Place {
                file: 0,
                row_group: 0,
            },
            group_rows: 0,
            file_bytes: 0,
            any: false,
        }
    }

    /// Place of the next run, planned to have this many rows.
    pub fn place(&mut self, rows: u64) -> Place {
        if self.group_rows >= ROW_GROUP_ROWS {
            self.next.row_group += 1;
            self.group_rows = 0;
        }
        let bytes = rows * self.bytes_per_row;
        if self.any && self.group_rows == 0 && self.file_bytes + bytes > self.bytes_per_file {
            self.next = Place {
                file: self.next.file + 1,
                row_group: 0,
            };
            self.file_bytes = 0;
        }
        self.any = true;
        self.group_rows += rows;
        self.file_bytes += bytes;
        self.next
    }

    /// Files so far.
    #[must_use]
    pub fn files(&self) -> u32 {
        if self.any { self.next.file + 1 } else { 0 }
    }
}

/// `data/train-00000-of-00003.parquet`
#[must_use]
pub fn file_name(split: SplitName, file: u32, files: u32) -> String {
    format!("data/{split}-{file:05}-of-{files:05}.parquet")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_hold_whole_runs_and_files_hold_whole_groups() {
        let (rows, bytes_per_row) = (201, 160);
        let mut cutter = Cutter::new(bytes_per_row, uncompressed_bytes(FILE_SIZE_MB));
        let places: Vec<Place> = (0..20_000).map(|_| cutter.place(rows)).collect();
        // 82 runs of 201 rows are the first number above 16384 rows
        assert_eq!(places[81].row_group, 0);
        assert_eq!(places[82].row_group, 1);
        let per_file = places.iter().filter(|place| place.file == 0).count() as u64;
        assert_eq!(per_file % 82, 0);
        assert!(
            per_file * rows * bytes_per_row <= uncompressed_bytes(FILE_SIZE_MB) + 82 * rows * bytes_per_row
        );
        assert_eq!(cutter.files(), places.last().unwrap().file + 1);
        let mut one = Cutter::new(bytes_per_row, uncompressed_bytes(FILE_SIZE_MB));
        assert_eq!(one.files(), 0);
        assert_eq!(
            one.place(10_000_000),
            Place {
                file: 0,
                row_group: 0
            }
        );
        assert_eq!(
            one.place(1),
            Place {
                file: 1,
                row_group: 0
            }
        );
        assert_eq!(one.files(), 2);
    }
}
