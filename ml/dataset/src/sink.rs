//! Where a data set is written: a directory, memory, or whatever a coordinator stores blobs in.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// A place that takes files by relative path, each in parts.
///
/// Several files are open at a time. Hashing and counting is the publisher's business.
pub trait Sink {
    /// Starts a file; the path has `/` and no `..`.
    ///
    /// # Errors
    /// Whatever the place reports.
    fn create(&mut self, path: &str) -> io::Result<Box<dyn SinkFile>>;
}

/// A file of a [`Sink`] under way.
pub trait SinkFile: Write + Send {
    /// Makes the file durable.
    ///
    /// # Errors
    /// Whatever the place reports.
    fn finish(self: Box<Self>) -> io::Result<()>;
}

/// A directory that appears whole or not at all: files are written to a temporary directory
/// beside it, flushed to the disk, and one rename makes them visible.
#[derive(Debug)]
pub struct DirectorySink {
    target: PathBuf,
    staging: PathBuf,
    committed: bool,
}

impl DirectorySink {
    /// Prepares to write `target`, which must be absent or an empty directory.
    ///
    /// # Errors
    /// The target holds something, or the temporary directory cannot be made.
    pub fn create(target: &Path) -> io::Result<Self> {
        match fs::read_dir(target) {
            Ok(mut entries) => {
                if entries.next().is_some() {
                    return Err(io::Error::new(
                        io::ErrorKind::AlreadyExists,
                        format!("{} is not empty", target.display()),
                    ));
                }
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
        let target = std::path::absolute(target)?;
        let parent = target.parent().unwrap_or(Path::new("/")).to_path_buf();
        fs::create_dir_all(&parent)?;
        let name = target.file_name().map_or_else(
            || "dataset".to_owned(),
            |name| name.to_string_lossy().into_owned(),
        );
        let staging = parent.join(format!(".{name}.partial-{}", std::process::id()));
        if staging.exists() {
            fs::remove_dir_all(&staging)?; // left by an earlier process of the same number
        }
        fs::create_dir(&staging)?;
        Ok(Self {
            target,
            staging,
            committed: false,
        })
    }

    /// Makes the data set visible.
    ///
    /// # Errors
    /// The disk reports one, or the target has been filled meanwhile.
    pub fn commit(mut self) -> io::Result<()> {
        sync_directories(&self.staging)?;
        // rename(2) replaces an empty directory and refuses a filled one
        fs::rename(&self.staging, &self.target)?;
        self.committed = true;
        if let Some(parent) = self.target.parent() {
            File::open(parent)?.sync_all()?;
        }
        Ok(())
    }
}

impl Drop for DirectorySink {
    fn drop(&mut self) {
        if !self.committed {
            let _ = fs::remove_dir_all(&self.staging); // nothing better to do while unwinding
        }
    }
}

impl Sink for DirectorySink {
    fn create(&mut self, path: &str) -> io::Result<Box<dyn SinkFile>> {
        let path = self.staging.join(path);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent)?;
        }
        let file = File::create_new(path)?;
        Ok(Box::new(DiskFile(BufWriter::with_capacity(1 << 18, file))))
    }
}

struct DiskFile(BufWriter<File>);

impl Write for DiskFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }
    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl SinkFile for DiskFile {
    fn finish(self: Box<Self>) -> io::Result<()> {
        let file = self.0.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.sync_all()
    }
}

fn sync_directories(directory: &Path) -> io::Result<()> {
    for entry in fs::read_dir(directory)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_directories(&entry.path())?;
        }
    }
    File::open(directory)?.sync_all()
}

/// Files in memory, for tests and small data sets. Clones share the files.
#[derive(Debug, Clone, Default)]
pub struct MemorySink {
    files: Arc<Mutex<BTreeMap<String, Vec<u8>>>>,
}

impl MemorySink {
    /// Finished files by path.
    #[must_use]
    pub fn files(&self) -> BTreeMap<String, Vec<u8>> {
        self.files.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Sink for MemorySink {
    fn create(&mut self, path: &str) -> io::Result<Box<dyn SinkFile>> {
        Ok(Box::new(MemoryFile {
            path: path.to_owned(),
            bytes: Vec::new(),
            sink: self.clone(),
        }))
    }
}

struct MemoryFile {
    path: String,
    bytes: Vec<u8>,
    sink: MemorySink,
}

impl Write for MemoryFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl SinkFile for MemoryFile {
    fn finish(self: Box<Self>) -> io::Result<()> {
        let mut files = self.sink.files.lock().unwrap_or_else(PoisonError::into_inner);
        files.insert(self.path, self.bytes);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_appears_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("set");
        let mut sink = DirectorySink::create(&target).unwrap();
        let mut file = sink.create("data/a.parquet").unwrap();
        file.write_all(b"abc").unwrap();
        file.finish().unwrap();
        assert!(!target.exists());
        sink.commit().unwrap();
        assert_eq!(fs::read(target.join("data/a.parquet")).unwrap(), b"abc");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);

        let refused = DirectorySink::create(&target).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::AlreadyExists);

        let other = folder.path().join("other");
        fs::create_dir(&other).unwrap();
        let mut sink = DirectorySink::create(&other).unwrap();
        sink.create("README.md").unwrap().finish().unwrap();
        drop(sink);
        assert_eq!(fs::read_dir(&other).unwrap().count(), 0);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
