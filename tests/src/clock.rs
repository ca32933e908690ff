//! Clocks that jump: `libfaketime` (Debian's package of that name) between a process and its wall clock.
//! The monotonic clock stays true, as it does when a real clock is set.

use std::io;
use std::path::{Path, PathBuf};

/// The wall clock of one process and its children.
pub struct Clock(PathBuf);

/// `libfaketime`; `None` where it is not installed.
#[must_use]
pub fn library() -> Option<PathBuf> {
    let folders = std::fs::read_dir("/usr/lib").ok()?;
    folders
        .flatten()
        .map(|folder| folder.path().join("faketime/libfaketimeMT.so.1"))
        .find(|library| library.is_file())
}

impl Clock {
    /// A clock that is right so far; its state is a file in `folder`.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn new(folder: &Path, name: &str) -> io::Result<Self> {
        let clock = Self(folder.join(format!("clock-{name}")));
        clock.set_ahead(0)?;
        Ok(clock)
    }

    /// Sets it that many seconds ahead of the true time, or behind it.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn set_ahead(&self, seconds: i64) -> io::Result<()> {
        // Renamed, because a reader may look at any time.
        let next = self.0.with_extension("next");
        std::fs::write(&next, format!("{seconds:+}\n"))?;
        std::fs::rename(next, &self.0)
    }

    /// Variables that give a process this clock.
    #[must_use]
    pub fn environment(&self, library: &Path) -> Vec<(&'static str, String)> {
        vec![
            ("LD_PRELOAD", library.display().to_string()),
            ("FAKETIME_TIMESTAMP_FILE", self.0.display().to_string()),
            ("FAKETIME_CACHE_DURATION", "1".to_owned()),
            ("FAKETIME_DONT_FAKE_MONOTONIC", "1".to_owned()),
        ]
    }
}
