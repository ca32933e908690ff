//! Objects in a directory or an object store: shards, data sets, models.
//!
//! ```text
//! shards/JOB/…-eEPOCH.parquet   private; created once, never replaced, deleted when the job is over
//! datasets/ID/…   models/ID/…   addressed by content; visible once the ledger lists them
//! meshes/SHA256.inp             uploaded, addressed by content
//! ```

use crate::s3;
use bytes::Bytes;
use futures::stream::{BoxStream, StreamExt, TryStreamExt};
use hydroflex_openapi::catalogue::FileEntry;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{GetOptions, GetRange, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload};
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Why the store did not answer.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// The URL names no store that we know.
    #[error("a store URL begins with file:/// or s3://, not {scheme:?}")]
    UnknownStore {
        /// Text before the first colon.
        scheme: String,
    },
    /// A part of an S3 URL that is not allowed.
    #[error("a store URL s3://BUCKET/PREFIX has the {what} {value:?}; allowed: {allowed}")]
    S3Url {
        /// Which part.
        what: &'static str,
        /// As given.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The store refused, or could not be reached.
    #[error("store: {0}")]
    Store(#[from] object_store::Error),
    /// A local file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// File.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// An object is not what was put.
    #[error("object {key} has SHA-256 {found}, expected {expected}")]
    Damaged {
        /// Object.
        key: String,
        /// Hash found.
        found: String,
        /// Hash recorded.
        expected: String,
    },
}

impl BlobError {
    /// True if an object that was put is no longer there, or no longer what it was.
    #[must_use]
    pub fn is_loss(&self) -> bool {
        matches!(
            self,
            Self::Damaged { .. } | Self::Store(object_store::Error::NotFound { .. })
        )
    }

    /// True if the same call may succeed later without anybody doing anything.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Store(error) => matches!(
                error,
                object_store::Error::Generic { .. } | object_store::Error::JoinError { .. }
            ),
            Self::File { .. } => true,
            Self::UnknownStore { .. } | Self::S3Url { .. } | Self::Damaged { .. } => false,
        }
    }

    /// True if a put was refused because the object is there.
    #[must_use]
    pub fn is_already_there(&self) -> bool {
        matches!(self, Self::Store(object_store::Error::AlreadyExists { .. }))
    }
}

/// Key of an uploaded mesh; nothing for text that is no SHA-256 in lower case, so that no text from
/// outside becomes a path.
#[must_use]
pub fn mesh_key(sha256: &str) -> Option<String> {
    let hexadecimal = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
    (sha256.len() == 64 && sha256.bytes().all(hexadecimal)).then(|| format!("meshes/{sha256}.inp"))
}

/// A place for objects.
#[derive(Clone)]
pub struct Blobs {
    store: Arc<dyn ObjectStore>,
    root: Option<PathBuf>,
}

impl Blobs {
    /// Opens the store with this URL: `file:///absolute/path` (made if absent), or
    /// `s3://BUCKET/PREFIX` with region, endpoint and credentials from the `AWS_…` variables.
    ///
    /// # Errors
    /// Refuses unknown stores; passes on what the file system says.
    pub fn open(url: &str) -> Result<Self, BlobError> {
        let variables = std::env::vars_os()
            .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)));
        Self::open_with(url, variables)
    }

    /// As [`Blobs::open`], with these variables in place of the environment's.
    ///
    /// # Errors
    /// As [`Blobs::open`].
    pub fn open_with(
        url: &str,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, BlobError> {
        if let Some(rest) = url.strip_prefix("s3://") {
            return Ok(Self {
                store: s3::open(rest, variables)?,
                root: None,
            });
        }
        match url.strip_prefix("file://") {
            Some(path) if path.starts_with('/') => Self::directory(Path::new(path)),
            _ => Err(BlobError::UnknownStore {
                scheme: url.split(':').next().unwrap_or_default().to_owned(),
            }),
        }
    }

    /// A directory of this machine. Puts are flushed to the disk before they count.
    ///
    /// # Errors
    /// Passes on what the file system says.
    pub fn directory(root: &Path) -> Result<Self, BlobError> {
        std::fs::create_dir_all(root).map_err(|source| BlobError::File {
            path: root.to_owned(),
            source,
        })?;
        let store = LocalFileSystem::new_with_prefix(root)?.with_fsync(true);
        Ok(Self {
            store: Arc::new(store),
            root: Some(root.to_owned()),
        })
    }

    /// Asks the store for anything at all: whether it is there and lets us in.
    ///
    /// # Errors
    /// Passes on what the store says.
    pub async fn ping(&self) -> Result<(), BlobError> {
        let nothing = Key::from("ping");
        match self.store.list(Some(&nothing)).try_next().await {
            Ok(_) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Asks again until the store answers or `patience` is over.
    ///
    /// # Errors
    /// What the store said last; at once if no patience would help.
    pub async fn wait_until_there(&self, patience: Duration) -> Result<(), BlobError> {
        let start = Instant::now();
        let mut has_said = false;
        loop {
            match self.ping().await {
                Err(error) if error.is_transient() && start.elapsed() < patience => {
                    if !has_said {
                        tracing::warn!(%error, "the store does not answer; trying for {} s", patience.as_secs());
                    }
                    has_said = true;
                }
                answer => return answer,
            }
            tokio::time::sleep(Duration::from_millis(500)).await;
        }
    }

    /// The directory that holds the objects below a key, if they are files of this machine.
    #[must_use]
    pub fn local_path(&self, key: &str) -> Option<PathBuf> {
        self.root.as_ref().map(|root| root.join(key))
    }

    /// Puts an object that does not exist yet.
    ///
    /// # Errors
    /// Refuses if it does; passes on what the store says.
    pub async fn create(&self, key: &str, content: Bytes) -> Result<(), BlobError> {
        let options = PutOptions {
            mode: PutMode::Create,
            ..PutOptions::default()
        };
        let key = Key::from(key);
        let put = self
            .store
            .put_opts(&key, PutPayload::from_bytes(content.clone()), options)
            .await;
        match put {
            Ok(_) => Ok(()),
            // Some stores know no conditional put (AWS_CONDITIONAL_PUT=disabled). Names of objects are
            // unique by their epoch, so the condition is a second guard, never the only one.
            Err(object_store::Error::NotImplemented { .. } | object_store::Error::NotSupported { .. }) => {
                self.store.put(&key, PutPayload::from_bytes(content)).await?;
                Ok(())
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Puts a local file under a key addressed by content: replacing it changes nothing.
    ///
    /// # Errors
    /// Passes on what the file system and the store say.
    pub async fn upload(&self, file: &Path, key: &str) -> Result<(), BlobError> {
        const PART_BYTES: usize = 8 << 20;
        let broken = |source| BlobError::File {
            path: file.to_owned(),
            source,
        };
        let mut reader = tokio::fs::File::open(file).await.map_err(broken)?;
        let size = reader.metadata().await.map_err(broken)?.len();
        let key = Key::from(key);
        if size <= PART_BYTES as u64 {
            let content = tokio::fs::read(file).await.map_err(broken)?;
            self.store.put(&key, PutPayload::from(content)).await?;
            return Ok(());
        }
        let upload = self.store.put_multipart(&key).await?;
        let mut writer = object_store::WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
        loop {
            let mut part = vec![0; PART_BYTES];
            let read = tokio::io::AsyncReadExt::read(&mut reader, &mut part)
                .await
                .map_err(broken)?;
            if read == 0 {
                break;
            }
            writer.wait_for_capacity(4).await?;
            writer.write(&part[..read]);
        }
        writer.finish().await?;
        Ok(())
    }

    /// As [`Blobs::upload`] for a file that is on the disk already and that nobody needs afterwards: a
    /// directory on the same file system takes the file itself.
    ///
    /// # Errors
    /// As [`Blobs::upload`].
    pub async fn adopt(&self, file: &Path, key: &str) -> Result<(), BlobError> {
        if let Some(target) = self.local_path(key) {
            let (from, to) = (file.to_owned(), target.clone());
            let moved = tokio::task::spawn_blocking(move || move_durably(&from, &to))
                .await
                .unwrap_or_else(|panic| Err(std::io::Error::other(panic)));
            match moved {
                Ok(()) => return Ok(()),
                Err(error) if error.kind() == std::io::ErrorKind::CrossesDevices => {}
                Err(source) => {
                    return Err(BlobError::File { path: target, source });
                }
            }
        }
        self.upload(file, key).await
    }

    /// Reads a whole object and checks its hash.
    ///
    /// # Errors
    /// [`BlobError::Damaged`] if it is not what was put; what the store says.
    pub async fn read(&self, key: &str, sha256: &str) -> Result<Bytes, BlobError> {
        let content = self.store.get(&Key::from(key)).await?.bytes().await?;
        let found = hex::encode(Sha256::digest(&content));
        if found == sha256 {
            Ok(content)
        } else {
            Err(BlobError::Damaged {
                key: key.to_owned(),
                found,
                expected: sha256.to_owned(),
            })
        }
    }

    /// Streams a part of an object.
    ///
    /// # Errors
    /// Passes on what the store says.
    pub async fn stream(
        &self,
        key: &str,
        range: Range<u64>,
    ) -> Result<BoxStream<'static, Result<Bytes, object_store::Error>>, BlobError> {
        if range.is_empty() {
            return Ok(futures::stream::empty().boxed());
        }
        let options = GetOptions {
            range: Some(GetRange::Bounded(range)),
            ..GetOptions::default()
        };
        Ok(self.store.get_opts(&Key::from(key), options).await?.into_stream())
    }

    /// A local folder with these files of a key: the store itself where it is a directory, else a
    /// copy, checked, that goes when the second value does.
    ///
    /// # Errors
    /// [`BlobError::Damaged`] if an object is not what was put; what store and file system say.
    pub async fn folder(
        &self,
        key: &str,
        files: &[FileEntry],
    ) -> Result<(PathBuf, Option<tempfile::TempDir>), BlobError> {
        let key = key.trim_end_matches('/');
        if let Some(path) = self.local_path(key) {
            return Ok((path, None));
        }
        let temporary = tempfile::tempdir().map_err(|source| BlobError::File {
            path: std::env::temp_dir(),
            source,
        })?;
        for file in files {
            let path = temporary.path().join(&file.path);
            let broken = |source| BlobError::File {
                path: path.clone(),
                source,
            };
            let content = self.read(&format!("{key}/{}", file.path), &file.sha256).await?;
            if let Some(parent) = path.parent() {
                tokio::fs::create_dir_all(parent).await.map_err(broken)?;
            }
            tokio::fs::write(&path, content).await.map_err(broken)?;
        }
        Ok((temporary.path().to_owned(), Some(temporary)))
    }

    /// Deletes an object; one that is not there is deleted already.
    ///
    /// # Errors
    /// Passes on what the store says.
    pub async fn delete(&self, key: &str) -> Result<(), BlobError> {
        match self.store.delete(&Key::from(key)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Deletes every object below a key, and what interrupted puts have left there; returns how many objects
    /// there were.
    ///
    /// # Errors
    /// Passes on what the store says.
    pub async fn delete_below(&self, key: &str) -> Result<u64, BlobError> {
        let prefix = Key::from(key);
        let locations = self
            .store
            .list(Some(&prefix))
            .map_ok(|object| object.location)
            .boxed();
        let deleted = self
            .store
            .delete_stream(locations)
            .try_fold(0, |count, _| async move { Ok(count + 1) })
            .await?;
        self.remove_interrupted_puts(key);
        // Object stores have no directories; a directory's empty ones would stay for ever.
        if let Some(path) = self.local_path(key) {
            let _ = std::fs::remove_dir(path);
        }
        Ok(deleted)
    }

    /// Removes what puts below a key have left that were interrupted by the death of their process. Whoever is
    /// putting there at this moment is refused and has to try again. Object stores keep unfinished
    /// uploads out of sight, and drop them by a rule of the bucket.
    pub fn remove_interrupted_puts(&self, key: &str) {
        fn remove(folder: &Path) {
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                let path = entry.path();
                match entry.file_type() {
                    Ok(kind) if kind.is_dir() => remove(&path),
                    Ok(kind) if kind.is_file() && is_staged(&entry.file_name()) => {
                        if let Err(error) = std::fs::remove_file(&path) {
                            tracing::debug!(%error, path = %path.display(), "an interrupted put stays");
                        }
                    }
                    _ => {}
                }
            }
        }
        if let Some(path) = self.local_path(key) {
            remove(&path);
        }
    }

    /// Removes the folders of a directory that deleted objects have left empty, and the folder of the key with
    /// them; object stores have none.
    pub fn remove_empty_folders(&self, key: &str) {
        fn remove(folder: &Path) {
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                    remove(&entry.path());
                }
            }
            // One that is not empty stays, and so does what is put into it meanwhile.
            let _ = std::fs::remove_dir(folder);
        }
        if let Some(path) = self.local_path(key) {
            remove(&path);
        }
    }

    /// Names of the folders directly below a key.
    ///
    /// # Errors
    /// Passes on what the store says.
    pub async fn folders(&self, key: &str) -> Result<Vec<String>, BlobError> {
        let below = self.store.list_with_delimiter(Some(&Key::from(key))).await?;
        let names = below
            .common_prefixes
            .iter()
            .filter_map(|folder| folder.filename().map(str::to_owned));
        let mut names: Vec<String> = names.collect();
        names.sort();
        Ok(names)
    }

    /// Keys of the objects below a key.
    ///
    /// # Errors
    /// Passes on what the store says.
    pub async fn list(&self, key: &str) -> Result<Vec<String>, BlobError> {
        let prefix = Key::from(key);
        let mut keys: Vec<String> = self
            .store
            .list(Some(&prefix))
            .map_ok(|object| object.location.to_string())
            .try_collect()
            .await?;
        keys.sort();
        Ok(keys)
    }
}

/// Whether a file is an object that is still being written: `LocalFileSystem` writes to `NAME#NUMBER`, renames
/// when it is whole, and neither lists such names nor lets them be deleted.
fn is_staged(name: &std::ffi::OsStr) -> bool {
    let Some((_, number)) = name.to_str().and_then(|name| name.split_once('#')) else {
        return false;
    };
    !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit())
}

/// Moves a file within a file system, and makes its new name durable with every directory made for it.
fn move_durably(from: &Path, to: &Path) -> std::io::Result<()> {
    let parents: Vec<&Path> = to.ancestors().skip(1).collect();
    let made = parents.iter().take_while(|parent| !parent.exists()).count();
    if let Some(parent) = to.parent() {
        std::fs::create_dir_all(parent)?;
    }
    std::fs::rename(from, to)?;
    for directory in parents.iter().take(made + 1) {
        std::fs::File::open(directory)?.sync_all()?;
    }
    Ok(())
}
