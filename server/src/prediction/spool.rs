//! Bytes of any number, in memory while they are few and in a nameless file from then on.

use axum::body::{Body, BodyDataStream};
use bytes::Bytes;
use futures::StreamExt;
use std::fs::File;
use std::io::{self, Seek, Write};
use std::path::{Path, PathBuf};
use tokio_util::io::ReaderStream;

/// Bytes kept in memory.
const IN_MEMORY_BYTES: usize = 1 << 20;
/// Bytes read from a file at once.
const PIECE_BYTES: usize = 256 << 10;

/// Bytes that were written. The file has no name: it goes when the spool does, and with the process.
#[derive(Debug)]
pub enum Spool {
    /// Few.
    Memory {
        /// They.
        bytes: Vec<u8>,
        /// Where a file would be made.
        folder: PathBuf,
    },
    /// Many.
    File {
        /// They.
        file: File,
        /// Number of them.
        size_bytes: u64,
    },
}

/// Why a body was not read.
#[derive(Debug)]
pub enum ReceiveError {
    /// It is longer than allowed.
    TooLarge,
    /// The sender broke off, or was silent for too long.
    Broken(String),
    /// The disk did not take it.
    Disk(io::Error),
}

impl Spool {
    /// An empty one; its file would be made in `folder`.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        Self::Memory {
            bytes: Vec::new(),
            folder: folder.to_owned(),
        }
    }

    /// Everything that a body sends.
    ///
    /// # Errors
    /// If it is longer than `limit_bytes`, breaks off, or the disk does not take it.
    pub async fn receive(
        mut stream: BodyDataStream,
        folder: &Path,
        limit_bytes: u64,
    ) -> Result<Self, ReceiveError> {
        let mut spool = Self::new(folder);
        let mut size_bytes = 0;
        let mut waiting: Vec<u8> = Vec::new();
        while let Some(piece) = stream.next().await {
            let piece = piece.map_err(|error| ReceiveError::Broken(error.to_string()))?;
            size_bytes += piece.len() as u64;
            if size_bytes > limit_bytes {
                return Err(ReceiveError::TooLarge);
            }
            waiting.extend_from_slice(&piece);
            if waiting.len() >= IN_MEMORY_BYTES {
                spool = spool.append(std::mem::take(&mut waiting)).await?;
            }
        }
        spool.append(waiting).await
    }

    /// Disks may wait: not on the threads that answer everybody.
    async fn append(mut self, bytes: Vec<u8>) -> Result<Self, ReceiveError> {
        if let Self::Memory { bytes: before, .. } = &mut self
            && before.is_empty()
            && bytes.len() <= IN_MEMORY_BYTES
        {
            *before = bytes;
            return Ok(self);
        }
        tokio::task::spawn_blocking(move || self.write_all(&bytes).map(|()| self))
            .await
            .map_err(|error| ReceiveError::Broken(error.to_string()))?
            .map_err(ReceiveError::Disk)
    }

    /// Number of bytes.
    #[must_use]
    pub fn len(&self) -> u64 {
        match self {
            Self::Memory { bytes, .. } => bytes.len() as u64,
            Self::File { size_bytes, .. } => *size_bytes,
        }
    }

    /// Whether nothing was written.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// To be sent, in pieces.
    ///
    /// # Errors
    /// If the file cannot be read from its beginning.
    pub fn into_body(self) -> io::Result<Body> {
        Ok(match self {
            Self::Memory { bytes, .. } => Body::from(bytes),
            Self::File { mut file, .. } => {
                file.rewind()?;
                Body::from_stream(ReaderStream::with_capacity(
                    tokio::fs::File::from_std(file),
                    PIECE_BYTES,
                ))
            }
        })
    }

    /// To be read.
    ///
    /// # Errors
    /// If the file cannot be read from its beginning.
    pub fn into_reader(self) -> io::Result<SpoolReader> {
        Ok(match self {
            Self::Memory { bytes, .. } => SpoolReader::Memory(bytes.into()),
            Self::File { mut file, .. } => {
                file.rewind()?;
                SpoolReader::File(file)
            }
        })
    }
}

/// What can be read of a spool, in the types that readers of tables want.
pub enum SpoolReader {
    /// Few bytes.
    Memory(Bytes),
    /// Many.
    File(File),
}

impl Write for Spool {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if let Self::Memory {
            bytes: before,
            folder,
        } = self
        {
            if before.len() + bytes.len() <= IN_MEMORY_BYTES {
                before.extend_from_slice(bytes);
                return Ok(bytes.len());
            }
            std::fs::create_dir_all(&*folder)?;
            let mut file = tempfile::tempfile_in(&*folder)?;
            file.write_all(before)?;
            *self = Self::File {
                file,
                size_bytes: before.len() as u64,
            };
        }
        match self {
            Self::File { file, size_bytes } => {
                let written = file.write(bytes)?;
                *size_bytes += written as u64;
                Ok(written)
            }
            Self::Memory { .. } => Ok(0),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::File { file, .. } => file.flush(),
            Self::Memory { .. } => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_was_sent_comes_back_however_much_it_is() {
        let folder = tempfile::tempdir().unwrap();
        for size in [
            0,
            10,
            IN_MEMORY_BYTES,
            IN_MEMORY_BYTES + 1,
            3 * IN_MEMORY_BYTES + 17,
        ] {
            let sent: Vec<u8> = (0..size).map(|i| (i % 251) as u8).collect();
            let pieces: Vec<Result<Bytes, io::Error>> = sent
                .chunks(70_001)
                .map(|c| Ok(Bytes::copy_from_slice(c)))
                .collect();
            let body = Body::from_stream(futures::stream::iter(pieces));
            let spool = Spool::receive(body.into_data_stream(), folder.path(), 1 << 30)
                .await
                .unwrap();
            assert_eq!(spool.len(), size as u64);
            assert_eq!(matches!(spool, Spool::File { .. }), size > IN_MEMORY_BYTES);
            let back = axum::body::to_bytes(spool.into_body().unwrap(), usize::MAX)
                .await
                .unwrap();
            assert!(back == sent, "{size} bytes");
        }
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            0,
            "files are nameless"
        );
    }

    #[tokio::test]
    async fn too_much_is_refused_before_it_is_all_there() {
        let folder = tempfile::tempdir().unwrap();
        let endless = futures::stream::repeat_with(|| Ok::<_, io::Error>(Bytes::from_static(&[0; 4096])));
        let body = Body::from_stream(endless);
        let result = Spool::receive(body.into_data_stream(), folder.path(), 10 << 20).await;
        assert!(matches!(result, Err(ReceiveError::TooLarge)));
    }
}
