//! Parameters as NumPy's `.npz`: a zip archive with a `.npy` file for each array.
//!
//! This module does not use the crate `ndarray-npy` (0.10). That crate allocates the size in a header before it checks
//! the size of the file. A file of a hundred bytes that claims 2^60 elements would end the process.

use crate::files::shown;
use crate::{Params, npy, write_atomic};
use rawzip::{CompressionMethod, ZipArchive, ZipArchiveWriter};
use raygrad_tensor::{Scalar, Tensor};
use std::collections::{BTreeMap, HashSet};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// The reason that a `.npz` file cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum NpzError {
    /// The file cannot be read or written.
    #[error("{}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The I/O error.
        error: std::io::Error,
    },
    /// The file is not a zip archive or is damaged.
    #[error("{} is not a whole npz file: {what}", path.display())]
    Archive {
        /// The file.
        path: PathBuf,
        /// The damage.
        what: String,
    },
    /// An array of the file is damaged or does not fit the parameter of its name.
    #[error("{}: array `{}`: {what}", path.display(), shown(name))]
    Array {
        /// The file.
        path: PathBuf,
        /// The name of the array.
        name: String,
        /// The mismatch or damage.
        what: String,
    },
}

/// Limit of the bytes of all arrays: the first number times the bytes of the file, plus the second. Compression hardly
/// shortens numbers, but it shortens zeros to a thousandth: an archive of a megabyte can expand to a gigabyte.
const MOST: [u64; 2] = [64, 1 << 28];

/// The damage of an array, for [`NpzError::Array`].
type What = String;

impl<T: Scalar> Params<T> {
    /// Writes the parameters to a `.npz` file, uncompressed like `numpy.savez`. `numpy.load(path)[name]` is then the
    /// parameter `name`.
    ///
    /// It writes to a temporary file beside `path` and renames it. So the file is complete, or unchanged.
    ///
    /// ```
    /// use raygrad_autograd::Tensor;
    /// use raygrad_nn::Params;
    /// let mut params = Params::<f32>::new();
    /// params.add("layer.weight", Tensor::from_vec(&[1, 2], vec![0.5, -1.0]));
    /// let folder = tempfile::tempdir().unwrap();
    /// let path = folder.path().join("model.npz");
    /// params.save_npz(&path).unwrap();
    /// let copy = Params::<f32>::read_npz(&path).unwrap();
    /// assert_eq!(copy.values(), params.values());
    /// ```
    ///
    /// # Errors
    /// If the file cannot be written, or if a name cannot be a file name in an archive.
    pub fn save_npz(&self, path: impl AsRef<Path>) -> Result<(), NpzError> {
        let path = path.as_ref();
        let mut bytes = vec![];
        let mut archive = ZipArchiveWriter::new(&mut bytes);
        for (name, value) in self.iter() {
            add(&mut archive, name, value).map_err(|what| array(path, name, what))?;
        }
        archive.finish().map_err(|error| damaged(path, error))?;
        write_atomic(path, &bytes).map_err(|error| NpzError::File { path: path.into(), error })
    }

    /// Replaces every value with the array of the same name in a `.npz` file. The file may be compressed, and arrays
    /// may have either element order. If an array does not fit, no value changes.
    ///
    /// # Errors
    /// Where [`read_npz`](Self::read_npz) fails, or if names or shapes differ from those of this store.
    pub fn load_npz(&mut self, path: impl AsRef<Path>) -> Result<(), NpzError> {
        let path = path.as_ref();
        let mut arrays: BTreeMap<String, Tensor<T>> = read(path)?.into_iter().collect();
        let mut values = Vec::with_capacity(self.len());
        for (name, value) in self.iter() {
            let Some(found) = arrays.remove(name) else {
                return Err(array(path, name, "is missing: the file belongs to another model".into()));
            };
            if found.shape() != value.shape() {
                let what = format!("has shape {:?}, the parameter {:?}", found.shape(), value.shape());
                return Err(array(path, name, what));
            }
            values.push(found);
        }
        if let Some(name) = arrays.keys().next() {
            return Err(array(path, name, "is not a parameter of this model".into()));
        }
        self.replace(values);
        Ok(())
    }

    /// Reads a `.npz` file into a new store, in the order of the file.
    ///
    /// # Errors
    /// If the file cannot be read or is damaged, or an array has another number type. If the arrays take more than 256
    /// MiB plus 64 times the bytes of the file. The error names the file and the array.
    pub fn read_npz(path: impl AsRef<Path>) -> Result<Self, NpzError> {
        let mut params = Params::new();
        for (name, value) in read(path.as_ref())? {
            params.add(name, value);
        }
        Ok(params)
    }
}

fn array(path: &Path, name: &str, what: What) -> NpzError {
    NpzError::Array { path: path.into(), name: name.into(), what }
}

fn damaged(path: &Path, error: rawzip::Error) -> NpzError {
    NpzError::Archive { path: path.into(), what: error.to_string() }
}

/// Adds one array to an archive.
fn add<T: Scalar>(archive: &mut ZipArchiveWriter<&mut Vec<u8>>, name: &str, value: &Tensor<T>) -> Result<(), What> {
    let file = format!("{name}.npy");
    if rawzip::path::ZipFilePath::from_str(&file).as_str() != file {
        return Err("its name cannot be that of a file in an archive".into());
    }
    store(archive, &file, &npy::encode(value.shape(), value.as_slice())).map_err(|error| error.to_string())
}

fn store(archive: &mut ZipArchiveWriter<&mut Vec<u8>>, file: &str, bytes: &[u8]) -> Result<(), rawzip::Error> {
    let (mut entry, config) = archive.new_file(file).compression_method(CompressionMethod::STORE).start()?;
    let mut writer = config.wrap(&mut entry);
    writer.write_all(bytes)?;
    let (_, descriptor) = writer.finish()?;
    entry.finish(descriptor)?;
    Ok(())
}

/// The arrays of a file, in its order.
fn read<T: Scalar>(path: &Path) -> Result<Vec<(String, Tensor<T>)>, NpzError> {
    let bytes = std::fs::read(path).map_err(|error| NpzError::File { path: path.into(), error })?;
    let archive = ZipArchive::from_slice(&bytes).map_err(|error| damaged(path, error))?;
    let mut entries = archive.entries();
    let (mut arrays, mut seen, mut count) = (vec![], HashSet::new(), 0);
    let mut left = MOST[0] * bytes.len() as u64 + MOST[1];
    while let Some(entry) = entries.next_entry().map_err(|error| damaged(path, error))? {
        count += 1;
        if entry.is_dir() {
            continue;
        }
        let file = String::from_utf8_lossy(entry.file_path().as_bytes()).into_owned();
        let name = file.strip_suffix(".npy").unwrap_or(&file).to_owned();
        if !seen.insert(name.clone()) {
            return Err(array(path, &name, "is there twice".into()));
        }
        let size = entry.uncompressed_size_hint();
        left = left.checked_sub(size).ok_or_else(|| {
            let what = format!("takes {size} bytes, which is too much in a file of {}: use numpy.savez", bytes.len());
            array(path, &name, what)
        })?;
        let content = archive
            .get_entry(entry.wayfinder())
            .map_err(|error| error.to_string())
            .and_then(|content| unpack(&content, entry.compression_method(), size));
        let value = content.and_then(|content| npy::decode(&content).map_err(|what| what.to_string()));
        let value = value.map_err(|what| array(path, &name, what))?;
        arrays.push((name, value));
    }
    if count != archive.entries_hint() {
        let what = format!("{count} entries instead of {}", archive.entries_hint());
        return Err(NpzError::Archive { path: path.into(), what });
    }
    Ok(arrays)
}

/// The bytes of a file in an archive, checked against its checksum.
fn unpack(entry: &rawzip::ZipSliceEntry<'_>, method: CompressionMethod, size: u64) -> Result<Vec<u8>, What> {
    let mut content = vec![];
    // No more than the archive announces, whatever comes out.
    let most = size.saturating_add(1);
    let result = if method == CompressionMethod::STORE {
        entry.verifying_reader(entry.data().take(most)).read_to_end(&mut content)
    } else if method == CompressionMethod::DEFLATE {
        let reader = flate2::read::DeflateDecoder::new(entry.data()).take(most);
        entry.verifying_reader(reader).read_to_end(&mut content)
    } else {
        return Err(format!("is compressed by a method that is not supported ({method:?})"));
    };
    result.map_err(|error| format!("cannot be unpacked: {error}"))?;
    Ok(content)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Written by NumPy: see `tests/data/README.md`.
    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
    }

    fn store<T: Scalar>() -> Params<T> {
        let mut params = Params::new();
        let value = |i: usize| T::from_f64((i as f64 * 0.7).sin());
        params.add("net.0.weight", Tensor::from_fn(&[3, 4, 2], value));
        params.add("scalar", Tensor::scalar(T::from_f64(-0.0)));
        params.add("empty", Tensor::zeros(&[0, 5]));
        params.add("größe", Tensor::from_vec(&[3], [f64::NAN, f64::INFINITY, 1e-40].map(T::from_f64).to_vec()));
        params
    }

    fn bits<T: Scalar>(params: &Params<T>) -> Vec<(String, Vec<usize>, Vec<u64>)> {
        let bits = |x: &Tensor<T>| x.as_slice().iter().map(|x| x.to_f64().to_bits()).collect();
        params.iter().map(|(name, x)| (name.into(), x.shape().to_vec(), bits(x))).collect()
    }

    fn round_trip<T: Scalar>() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.npz");
        let params = store::<T>();
        params.save_npz(&path).unwrap();
        assert_eq!(bits(&Params::<T>::read_npz(&path).unwrap()), bits(&params));
        let mut other = params.clone();
        other.values_mut().iter_mut().for_each(|x| x.as_mut_slice().fill(T::from_f64(9.0)));
        other.load_npz(&path).unwrap();
        assert_eq!(bits(&other), bits(&params));
        // Written again over itself, and nothing else is left in the folder.
        other.save_npz(&path).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_stored_model_comes_back_bit_for_bit() {
        round_trip::<f32>();
        round_trip::<f64>();
    }

    #[test]
    fn files_of_numpy_are_understood() {
        for name in ["stored.npz", "compressed.npz"] {
            let params = Params::<f32>::read_npz(fixture(name)).unwrap();
            let get = |name| params.get(params.find(name).unwrap());
            assert_eq!(*get("matrix"), Tensor::from_vec(&[2, 3], vec![0.0, 0.5, 1.0, 1.5, 2.0, 2.5]), "{name}");
            // Stored with the first index running fastest.
            assert_eq!(*get("columns"), Tensor::from_fn(&[2, 3, 4], |i| i as f32), "{name}");
            assert_eq!((get("scalar").shape(), get("scalar").item()), (&[][..], -3.25));
            assert_eq!((get("empty").shape(), params.len()), (&[0, 2][..], 4));
        }
        let doubles = Params::<f64>::read_npz(fixture("doubles.npz")).unwrap();
        assert_eq!(doubles.values()[0].as_slice(), [0.1, -1e300]);
    }

    #[test]
    fn what_does_not_fit_is_named_and_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.npz");
        let write = |arrays: &[(&str, &[usize])]| {
            let mut params = Params::<f32>::new();
            for (name, shape) in arrays {
                params.add(*name, Tensor::ones(shape));
            }
            params.save_npz(&path).unwrap();
        };
        let mut params = Params::<f32>::new();
        params.add("a", Tensor::zeros(&[2]));
        params.add("b", Tensor::zeros(&[2, 2]));
        let mut refused = |part: &str| {
            let message = params.load_npz(&path).unwrap_err().to_string();
            assert!(message.starts_with(&path.display().to_string()) && message.contains(part), "{message}");
            assert!(params.values().iter().all(|x| x.as_slice().iter().all(|&x| x == 0.0)));
        };
        write(&[("a", &[2]), ("b", &[4])]);
        refused("array `b`: has shape [4], the parameter [2, 2]");
        write(&[("a", &[2])]);
        refused("array `b`: is missing");
        write(&[("b", &[2, 2]), ("a", &[2]), ("c", &[1])]);
        refused("array `c`: is not a parameter of this model");
        let mut doubles = Params::<f64>::new();
        doubles.add("a", Tensor::zeros(&[2]));
        doubles.save_npz(&path).unwrap();
        refused("array `a`: holds numbers of type `<f8`, not `<f4`");
        std::fs::write(&path, b"not an archive").unwrap();
        refused("is not a whole npz file");
        std::fs::remove_file(&path).unwrap();
        refused("No such file");
        let missing = folder.path().join("nowhere/model.npz");
        let message = params.save_npz(&missing).unwrap_err().to_string();
        assert!(message.starts_with(&missing.display().to_string()), "{message}");
        let mut odd = Params::<f32>::new();
        odd.add("../up", Tensor::zeros(&[1]));
        assert!(odd.save_npz(&path).unwrap_err().to_string().contains("array `../up`: its name cannot be"));
        assert!(!path.exists());
    }

    #[test]
    fn damage_anywhere_is_an_error_or_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.npz");
        let params = store::<f32>();
        params.save_npz(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let expected = bits(&params);
        for at in 0..whole.len() {
            // Cut short: never accepted.
            std::fs::write(&path, &whole[..at]).unwrap();
            assert!(Params::<f32>::read_npz(&path).is_err(), "cut at {at}");
            // One byte changed: noticed, or in a part that says nothing of the arrays.
            let mut changed = whole.clone();
            changed[at] ^= 0x55;
            std::fs::write(&path, &changed).unwrap();
            if let Ok(read) = Params::<f32>::read_npz(&path) {
                let names =
                    |bits: &[(String, Vec<usize>, Vec<u64>)]| bits.iter().map(|x| x.2.clone()).collect::<Vec<_>>();
                assert_eq!(names(&bits(&read)), names(&expected), "byte {at}");
            }
        }
    }

    #[test]
    fn names_in_messages_are_on_one_line() {
        let message = array(Path::new("a.npz"), "x\ny\u{1b}é", "is bad".into()).to_string();
        assert_eq!(message, "a.npz: array `x\\ny\\u{1b}é`: is bad");
    }
}
