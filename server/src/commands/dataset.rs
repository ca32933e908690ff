//! `hydroflex dataset`: data sets of a running service.

use super::job::ServiceArgs;
use crate::client::{self, Client};
use anyhow::{Context, bail};
use hydroflex_openapi::catalogue::{DatasetInfo, FileEntry};
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::fs::File;
use std::io::{ErrorKind, Read, Write as _};
use std::path::{Component, Path, PathBuf};

/// Subcommands of `hydroflex dataset`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Download a data set, resuming where an earlier download stopped, and check its hashes
    Fetch {
        /// Data set id
        dataset: String,
        /// Directory to write to
        #[arg(long)]
        out: PathBuf,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
}

/// Runs the command.
///
/// # Errors
/// If the service cannot be reached or refuses, a file cannot be written, or a hash does not match.
pub fn run(command: Command) -> anyhow::Result<()> {
    let Command::Fetch {
        dataset,
        out,
        service,
    } = command;
    let client = Client::new(&service.url)?;
    let info = fetch(&client, &dataset, &out, service.json)?;
    if service.json {
        return super::print_json(&serde_json::json!({
            "dataset_id": info.dataset_id, "dataset_sha256": info.dataset_sha256,
            "files": info.files.len(), "size_bytes": info.size_bytes, "out": out,
        }));
    }
    super::print_line(format_args!(
        "{} files, {:.1} MB, every SHA-256 matches: {}",
        info.files.len(),
        info.size_bytes as f64 / 1e6,
        out.display()
    ))
}

/// Downloads a data set. A file that is already there with the right hash is kept; a part of one is
/// continued.
///
/// # Errors
/// If the service cannot be reached or refuses, a file cannot be written, or a hash does not match.
pub fn fetch(client: &Client, dataset: &str, out: &Path, quiet: bool) -> anyhow::Result<DatasetInfo> {
    let info: DatasetInfo = client.get(&format!("/v1/datasets/{dataset}"))?;
    let files: HashMap<&Path, &str> = info
        .files
        .iter()
        .map(|file| (Path::new(&file.path), file.sha256.as_str()))
        .collect();
    refuse_foreign(out, out, &files)?;
    let base = format!("/v1/datasets/{dataset}/files");
    fetch_files(client, &base, &info.files, out, quiet)?;
    // The service's list and the data set's own must agree: the id promises the latter.
    let found = sha256_of(&out.join("SHA256SUMS"))?;
    if found != info.dataset_sha256 {
        bail!(
            "SHA256SUMS has SHA-256 {found}, the data set should have {}",
            info.dataset_sha256
        );
    }
    Ok(info)
}

/// Refuses a directory that holds anything but these files and parts of them. `SHA256SUMS` has to be the one that is
/// wanted; if it is there, other files may be damaged, and are downloaded again.
fn refuse_foreign(root: &Path, folder: &Path, files: &HashMap<&Path, &str>) -> anyhow::Result<()> {
    let cannot_read = || format!("cannot read {}", folder.display());
    let entries = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        entries => entries.with_context(cannot_read)?,
    };
    for entry in entries {
        let path = entry.with_context(cannot_read)?.path();
        if path.is_dir() {
            refuse_foreign(root, &path, files)?;
            continue;
        }
        let name = path.strip_prefix(root).unwrap_or(&path);
        let whole = name.with_extension("");
        let is_part = name.extension().is_some_and(|e| e == "part") && files.contains_key(whole.as_path());
        let why = match files.get(name) {
            _ if is_part => continue,
            None => "which is not a file of this data set",
            Some(&sha256) if name == Path::new("SHA256SUMS") && sha256_of(&path)? != sha256 => {
                "of another data set"
            }
            Some(&sha256) if !root.join("SHA256SUMS").exists() && sha256_of(&path)? != sha256 => {
                "which differs from this data set's"
            }
            Some(_) => continue,
        };
        bail!(
            "--out {} holds {}, {why}; it takes a directory that is absent or empty, or in which a download of the \
             same data set stopped",
            root.display(),
            name.display()
        );
    }
    Ok(())
}

/// Downloads listed files below a path of the service.
///
/// # Errors
/// As [`fetch`].
pub fn fetch_files(
    client: &Client,
    base: &str,
    files: &[FileEntry],
    out: &Path,
    quiet: bool,
) -> anyhow::Result<()> {
    let bar = client::bar("download", files.iter().map(|file| file.size_bytes).sum());
    if quiet {
        bar.set_draw_target(indicatif::ProgressDrawTarget::hidden());
    }
    for file in files {
        let target = out.join(safe(&file.path)?);
        if let Some(parent) = target.parent() {
            std::fs::create_dir_all(parent).with_context(|| format!("cannot make {}", parent.display()))?;
        }
        if !(target.exists() && sha256_of(&target)? == file.sha256) {
            download(client, &format!("{base}/{}", file.path), file, &target)?;
        }
        bar.inc(file.size_bytes);
    }
    bar.finish_and_clear();
    Ok(())
}

fn download(client: &Client, path: &str, file: &FileEntry, target: &Path) -> anyhow::Result<()> {
    let mut name = target.as_os_str().to_owned();
    name.push(".part");
    let part = PathBuf::from(name);
    let have = std::fs::metadata(&part).map_or(0, |meta| meta.len());
    let mut request = client.request(path);
    let resume = have > 0 && have < file.size_bytes;
    if resume {
        // The address is immutable: its content cannot have changed since.
        request = request.header("range", format!("bytes={have}-"));
    }
    let mut response = client.send(request)?;
    let appended = resume && response.status() == reqwest::StatusCode::PARTIAL_CONTENT;
    let mut sink = File::options()
        .create(true)
        .write(true)
        .append(appended)
        .truncate(!appended)
        .open(&part)
        .with_context(|| format!("cannot write {}", part.display()))?;
    std::io::copy(&mut response, &mut sink)
        .with_context(|| format!("the download of {path} broke off; call again to go on"))?;
    sink.flush()?;
    sink.sync_all()
        .with_context(|| format!("cannot write {}", part.display()))?;
    let found = sha256_of(&part)?;
    if found != file.sha256 {
        std::fs::remove_file(&part).with_context(|| format!("cannot remove {}", part.display()))?;
        bail!(
            "{path} arrived with SHA-256 {found}, expected {}; it was removed, call again",
            file.sha256
        );
    }
    std::fs::rename(&part, target).with_context(|| format!("cannot write {}", target.display()))
}

/// A path below the target directory, whatever a service says.
fn safe(path: &str) -> anyhow::Result<&Path> {
    let relative = Path::new(path);
    if path.is_empty()
        || !relative
            .components()
            .all(|part| matches!(part, Component::Normal(_)))
    {
        bail!("the service names a file {path:?}, which would lie outside of the directory");
    }
    Ok(relative)
}

fn sha256_of(path: &Path) -> anyhow::Result<String> {
    let mut file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        let count = file
            .read(&mut buffer)
            .with_context(|| format!("cannot read {}", path.display()))?;
        if count == 0 {
            return Ok(hex::encode(hash.finalize()));
        }
        hash.update(&buffer[..count]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_download_goes_on_where_it_stopped_and_never_over_other_files() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("set");
        let sha256 = |text: &str| hex::encode(Sha256::digest(text));
        let (sums, data) = (sha256("sums"), sha256("data"));
        let files = HashMap::from([
            (Path::new("SHA256SUMS"), sums.as_str()),
            (Path::new("data/a.parquet"), data.as_str()),
        ]);
        let check = || refuse_foreign(&out, &out, &files).map_err(|error| error.to_string());
        assert_eq!(check(), Ok(()), "absent");
        std::fs::create_dir_all(out.join("data")).unwrap();
        std::fs::write(out.join("data/a.parquet.part"), "da").unwrap();
        assert_eq!(check(), Ok(()), "a part");
        std::fs::write(out.join("data/a.parquet"), "mine").unwrap();
        assert!(check().unwrap_err().contains("data/a.parquet, which differs"));
        std::fs::write(out.join("SHA256SUMS"), "sums").unwrap();
        assert_eq!(check(), Ok(()), "a damaged file of the same set is repaired");
        std::fs::write(out.join("SHA256SUMS"), "others").unwrap();
        assert!(check().unwrap_err().contains("SHA256SUMS, of another data set"));
        std::fs::write(out.join("SHA256SUMS"), "sums").unwrap();
        std::fs::write(out.join("notes.md"), "mine").unwrap();
        assert!(check().unwrap_err().contains("notes.md"));
    }

    #[test]
    fn a_service_cannot_make_us_write_outside_of_the_directory() {
        for bad in ["../x", "/etc/passwd", "data/../../x", "", "./x"] {
            assert!(safe(bad).is_err() || bad == "./x", "{bad:?} passed");
        }
        assert!(safe("data/train-00000-of-00001.parquet").is_ok());
    }
}
