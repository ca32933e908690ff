//! Reduced bodies on disk, by content hash.
//!
//! A file is a 32-byte SHA-256 of everything after it, the key, and the body. It is written beside
//! its place and renamed, so that readers see whole files only. Whatever does not fit (another
//! version, a damaged or cut file) counts as absent and is written anew; a cache that cannot be
//! written costs time and nothing else.

use super::{ReducedBody, ReducedInterface, ReducedNode, ReductionReport};
use nalgebra::{DMatrix, Matrix3, Matrix3xX, Vector3};
use sha2::{Digest, Sha256};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// First bytes of the content; raise the number when the layout changes.
const LAYOUT: &[u8; 16] = b"hydroflex body 2";

/// Reads the body stored under a key, or computes and stores it.
///
/// # Errors
/// Those of `compute`.
pub fn cached<E>(
    folder: &Path,
    key: [u8; 32],
    compute: impl FnOnce() -> Result<ReducedBody, E>,
) -> Result<ReducedBody, E> {
    let path = folder.join(format!("{}.body", hex::encode(key)));
    if let Some(body) = std::fs::read(&path).ok().and_then(|b| decode(&b, key)) {
        return Ok(body);
    }
    let body = compute()?;
    // a full or read-only disk must not stop a simulation
    let _ = store(folder, &path, &encode(&body, key));
    Ok(body)
}

fn store(folder: &Path, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    std::fs::create_dir_all(folder)?;
    let unique = COUNTER.fetch_add(1, Ordering::Relaxed);
    let part = PathBuf::from(format!("{}.{}-{unique}.part", path.display(), std::process::id()));
    let written = std::fs::File::create(&part)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&part, path));
    if written.is_err() {
        // what is left is of no use to anybody
        let _ = std::fs::remove_file(&part);
    }
    written
}

fn encode(body: &ReducedBody, key: [u8; 32]) -> Vec<u8> {
    let mut out = Writer(Vec::new());
    out.0.extend_from_slice(LAYOUT);
    out.0.extend_from_slice(&key);
    out.body(body);
    let mut bytes = Sha256::digest(&out.0).to_vec();
    bytes.append(&mut out.0);
    bytes
}

fn decode(bytes: &[u8], key: [u8; 32]) -> Option<ReducedBody> {
    let (digest, content) = bytes.split_at_checked(32)?;
    if Sha256::digest(content).as_slice() != digest {
        return None;
    }
    let mut input = Reader(content);
    if input.take(LAYOUT.len())? != LAYOUT || input.take(32)? != key {
        return None;
    }
    let body = input.body()?;
    input.0.is_empty().then_some(body)
}

/// Little-endian numbers; lists and texts with their length before them.
struct Writer(Vec<u8>);

impl Writer {
    fn count(&mut self, n: usize) {
        self.0.extend_from_slice(&(n as u64).to_le_bytes());
    }

    fn numbers(&mut self, numbers: &[f64]) {
        self.count(numbers.len());
        for x in numbers {
            self.0.extend_from_slice(&x.to_le_bytes());
        }
    }

    fn text(&mut self, text: &str) {
        self.count(text.len());
        self.0.extend_from_slice(text.as_bytes());
    }

    fn body(&mut self, body: &ReducedBody) {
        self.text(&body.name);
        self.count(body.mode_count());
        self.numbers(&[body.mass_kg]);
        self.numbers(body.centre_of_mass_m.as_slice());
        self.numbers(body.inertia_origin_kg_m2.as_slice());
        for matrix in [&body.mass_modal, &body.stiffness_modal, &body.damping_modal] {
            self.numbers(matrix.as_slice());
        }
        self.numbers(body.c_pt.as_slice());
        self.numbers(body.c_xp.as_slice());
        let flat =
            |blocks: &[Matrix3<f64>]| -> Vec<f64> { blocks.iter().flat_map(|b| b.iter().copied()).collect() };
        self.numbers(&flat(&body.n_blocks));
        self.numbers(&flat(&body.b_blocks));
        let vectors = body.c_vectors.iter().flat_map(|v| v.iter().copied());
        self.numbers(&vectors.collect::<Vec<_>>());
        self.count(body.interfaces.len());
        for interface in &body.interfaces {
            self.text(&interface.name);
            self.numbers(interface.position_m.as_slice());
            self.numbers(interface.translation.as_slice());
            self.numbers(interface.rotation.as_slice());
            self.count(interface.node_count);
        }
        self.count(body.sensor_nodes.len());
        for node in &body.sensor_nodes {
            self.count(node.node);
            self.numbers(node.position_m.as_slice());
            self.numbers(node.translation.as_slice());
            self.numbers(node.strain.as_slice());
            self.numbers(node.stress_pa.as_slice());
        }
        let report = &body.report;
        self.count(report.node_count);
        self.count(report.element_count);
        self.numbers(&report.fixed_interface_hz);
        self.count(report.boundary_names.len());
        for name in &report.boundary_names {
            self.text(name);
        }
    }
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        Some(taken)
    }

    fn count(&mut self) -> Option<usize> {
        let bytes = self.take(8)?.try_into().ok()?;
        usize::try_from(u64::from_le_bytes(bytes)).ok()
    }

    fn numbers(&mut self) -> Option<Vec<f64>> {
        let n = self.count()?;
        let bytes = self.take(n.checked_mul(8)?)?;
        let number = |b: &[u8]| Some(f64::from_le_bytes(b.try_into().ok()?));
        bytes.chunks_exact(8).map(number).collect()
    }

    fn text(&mut self) -> Option<String> {
        let n = self.count()?;
        String::from_utf8(self.take(n)?.to_vec()).ok()
    }

    fn number(&mut self) -> Option<f64> {
        let [number] = self.numbers()?[..] else {
            return None;
        };
        Some(number)
    }

    fn vector(&mut self) -> Option<Vector3<f64>> {
        let [x, y, z] = self.numbers()?[..] else {
            return None;
        };
        Some(Vector3::new(x, y, z))
    }

    fn matrix(&mut self, rows: usize, columns: usize) -> Option<DMatrix<f64>> {
        let numbers = self.numbers()?;
        let fits = numbers.len() == rows.checked_mul(columns)?;
        fits.then(|| DMatrix::from_vec(rows, columns, numbers))
    }

    fn rows3(&mut self, columns: usize) -> Option<Matrix3xX<f64>> {
        let numbers = self.numbers()?;
        let fits = numbers.len() == columns.checked_mul(3)?;
        fits.then(|| Matrix3xX::from_vec(numbers))
    }

    fn blocks(&mut self, count: usize) -> Option<Vec<Matrix3<f64>>> {
        let numbers = self.numbers()?;
        let fits = numbers.len() == count.checked_mul(9)?;
        let blocks = numbers.chunks_exact(9).map(Matrix3::from_column_slice);
        fits.then(|| blocks.collect())
    }

    fn body(&mut self) -> Option<ReducedBody> {
        let name = self.text()?;
        let n = self.count()?;
        let squared = n.checked_mul(n)?;
        Some(ReducedBody {
            name,
            mass_kg: self.number()?,
            centre_of_mass_m: self.vector()?,
            inertia_origin_kg_m2: *self.blocks(1)?.first()?,
            mass_modal: self.matrix(n, n)?,
            stiffness_modal: self.matrix(n, n)?,
            damping_modal: self.matrix(n, n)?,
            c_pt: self.rows3(n)?,
            c_xp: self.rows3(n)?,
            n_blocks: self.blocks(n)?,
            b_blocks: self.blocks(squared)?,
            c_vectors: self
                .rows3(squared)?
                .column_iter()
                .map(nalgebra::Matrix::into_owned)
                .collect(),
            interfaces: self.list(|input| {
                Some(ReducedInterface {
                    name: input.text()?,
                    position_m: input.vector()?,
                    translation: input.rows3(n)?,
                    rotation: input.rows3(n)?,
                    node_count: input.count()?,
                })
            })?,
            sensor_nodes: self.list(|input| {
                Some(ReducedNode {
                    node: input.count()?,
                    position_m: input.vector()?,
                    translation: input.rows3(n)?,
                    strain: input.matrix(6, n)?,
                    stress_pa: input.matrix(6, n)?,
                })
            })?,
            report: ReductionReport {
                node_count: self.count()?,
                element_count: self.count()?,
                fixed_interface_hz: self.numbers()?,
                boundary_names: self.list(Self::text)?,
            },
        })
    }

    fn list<T>(&mut self, mut item: impl FnMut(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        let count = self.count()?;
        (0..count).map(|_| item(self)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::convert::Infallible;

    fn body(n: usize) -> ReducedBody {
        let matrix =
            |rows, columns| DMatrix::from_fn(rows, columns, |i, j| (3 * i + 7 * j) as f64 / 9.0 - 0.1);
        let rows3 = |columns| Matrix3xX::from_fn(columns, |i, j| (i as f64 - 0.3) * (j as f64));
        ReducedBody {
            name: "boom".to_owned(),
            mass_kg: 140.1,
            centre_of_mass_m: Vector3::new(1.0, 0.03, -1e-9),
            inertia_origin_kg_m2: Matrix3::new(1.0, 2.0, 3.0, 2.0, 5.0, 6.0, 3.0, 6.0, 9.0),
            mass_modal: matrix(n, n),
            stiffness_modal: matrix(n, n) * 1e9,
            damping_modal: matrix(n, n),
            c_pt: rows3(n),
            c_xp: rows3(n) * 2.0,
            n_blocks: (0..n).map(|i| Matrix3::from_element(i as f64)).collect(),
            b_blocks: (0..n * n)
                .map(|i| Matrix3::from_fn(|r, c| (r + 3 * c + i) as f64))
                .collect(),
            c_vectors: (0..n * n).map(|i| Vector3::new(i as f64, 0.5, -1.0)).collect(),
            interfaces: vec![ReducedInterface {
                name: "pivot".to_owned(),
                position_m: Vector3::new(0.0, 1.0, 2.0),
                translation: rows3(n),
                rotation: rows3(n),
                node_count: 416,
            }],
            sensor_nodes: vec![ReducedNode {
                node: 17,
                position_m: Vector3::x(),
                translation: rows3(n),
                strain: matrix(6, n),
                stress_pa: matrix(6, n) * 1e11,
            }],
            report: ReductionReport {
                node_count: 3,
                element_count: 4,
                fixed_interface_hz: vec![29.4],
                boundary_names: vec!["pivot".to_owned()],
            },
        }
    }

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("hydroflex-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        path
    }

    #[test]
    fn what_is_stored_is_read_back_bit_by_bit_and_not_computed_again() {
        let folder = folder("cache");
        let key = [7; 32];
        let stored = cached(&folder, key, || Ok::<_, Infallible>(body(3))).unwrap();
        let read = cached(&folder, key, || Err("computed again")).unwrap();
        assert_eq!(read, stored);
        assert_eq!(cached(&folder, [8; 32], || Err("other key")), Err("other key"));
        let left: Vec<_> = std::fs::read_dir(&folder).unwrap().collect();
        assert_eq!(left.len(), 1, "no part files stay behind");
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_damaged_or_foreign_file_is_replaced() {
        let folder = folder("damage");
        let key = [1; 32];
        let path = folder.join(format!("{}.body", hex::encode(key)));
        let good = encode(&body(2), key);
        for bad in [
            Vec::new(),
            b"nonsense".to_vec(),
            good[..good.len() - 1].to_vec(),
            encode(&body(2), [2; 32]),
        ] {
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(&path, bad).unwrap();
            let found = cached(&folder, key, || Ok::<_, Infallible>(body(3))).unwrap();
            assert_eq!(found, body(3));
            assert_eq!(std::fs::read(&path).unwrap(), encode(&body(3), key));
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_cache_that_cannot_be_written_does_no_harm() {
        let folder = folder("file");
        std::fs::write(&folder, "a file where the folder should be").unwrap();
        let found = cached(&folder, [0; 32], || Ok::<_, Infallible>(body(1)));
        assert_eq!(found, Ok(body(1)));
        std::fs::remove_file(folder).unwrap();
    }

    proptest! {
        #[test]
        fn any_single_wrong_byte_is_noticed(at in 0..3000_usize, flip in 1..=255_u8) {
            let key = [3; 32];
            let mut bytes = encode(&body(2), key);
            let at = at % bytes.len();
            bytes[at] ^= flip;
            prop_assert_eq!(decode(&bytes, key), None);
        }

        #[test]
        fn a_well_signed_but_garbled_body_never_panics(at in 0..3000_usize, value: u64) {
            let key = [3; 32];
            let mut content = encode(&body(2), key).split_off(32);
            let at = at % (content.len() - 8);
            content[at..at + 8].copy_from_slice(&value.to_le_bytes());
            let mut bytes = Sha256::digest(&content).to_vec();
            bytes.append(&mut content);
            let _ = decode(&bytes, key);
        }
    }
}
