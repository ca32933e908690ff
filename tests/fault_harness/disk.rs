//! A disk that gets full.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A small file system of its own for the data directory; only root can make one.
pub(super) struct SmallDisk(PathBuf);

impl SmallDisk {
    pub(super) fn mount(at: &Path) -> Option<Self> {
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=48m", "hydroflex-test"])
            .arg(at)
            .status();
        mounted
            .is_ok_and(|status| status.success())
            .then(|| Self(at.to_owned()))
    }

    pub(super) fn filler(&self) -> PathBuf {
        self.0.join("filler")
    }

    pub(super) fn fill(&self) {
        use std::io::Write;
        let Ok(mut file) = std::fs::File::create(self.filler()) else {
            return;
        };
        let block = vec![1_u8; 1 << 16];
        while file.write_all(&block).is_ok() {}
        // The last bytes too.
        while file.write_all(&block[..512]).is_ok() {}
    }

    pub(super) fn empty(&self) {
        let _ = std::fs::remove_file(self.filler());
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(&self.0).status();
    }
}
