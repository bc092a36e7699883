//! Parameters in safetensors files, in full precision or in 16 bits.

use crate::Params;
use crate::files::{bad_entry, shown};
use half::{bf16, f16};
use raygrad_tensor::{Scalar, Tensor};
use safetensors::tensor::{Dtype, SafeTensors, View};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

/// The number type of parameters in a file. Values are rounded once, on writing; arithmetic uses the model's own type.
/// A parameter with a number out of the type's range is stored in full precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Storage {
    /// The model's own type: parameters are restored bit for bit.
    #[default]
    Full,
    /// IEEE 754 binary16: a relative error of at most 4.9e-4 from 6.1e-5 to 65504, and steps of 6e-8 below.
    F16,
    /// bfloat16, the upper half of an f32: a relative error of at most 3.9e-3, and the range of f32.
    Bf16,
}

impl Storage {
    /// Rounds to the nearest number of the type.
    fn round<T: Scalar>(self, x: T) -> T {
        match self {
            Storage::Full => x,
            Storage::F16 => T::from_f64(f16::from_f32(to_odd(x.to_f64())).to_f64()),
            Storage::Bf16 => T::from_f64(bf16::from_f32(to_odd(x.to_f64())).to_f64()),
        }
    }

    /// The storage type for these values: this one, or full precision if a value is out of range.
    fn that_fits<T: Scalar>(self, values: &[T]) -> Self {
        let fits = |x: &T| !x.is_finite() || self.round(*x).is_finite();
        if values.iter().all(fits) { self } else { Storage::Full }
    }

    pub(crate) fn dtype<T: Scalar>(self) -> Dtype {
        match self {
            Storage::Full if size_of::<T>() == 4 => Dtype::F32,
            Storage::Full => Dtype::F64,
            Storage::F16 => Dtype::F16,
            Storage::Bf16 => Dtype::BF16,
        }
    }

    /// The storage type of a safetensors number type, if any.
    fn of<T: Scalar>(dtype: Dtype) -> Option<Self> {
        [Storage::Full, Storage::F16, Storage::Bf16].into_iter().find(|storage| storage.dtype::<T>() == dtype)
    }

    fn write<T: Scalar>(self, values: &[T]) -> Vec<u8> {
        let mut out = Vec::with_capacity(size_of_val(values));
        let pairs = |pair: fn(f64) -> [u8; 2]| values.iter().flat_map(move |x| pair(x.to_f64()));
        match self {
            Storage::Full => T::write_le(values, &mut out),
            Storage::F16 => out.extend(pairs(|x| f16::from_f32(to_odd(x)).to_le_bytes())),
            Storage::Bf16 => out.extend(pairs(|x| bf16::from_f32(to_odd(x)).to_le_bytes())),
        }
        out
    }

    pub(crate) fn read<T: Scalar>(self, bytes: &[u8]) -> Vec<T> {
        let pairs = || bytes.as_chunks().0.iter();
        match self {
            Storage::Full => T::read_le(bytes),
            Storage::F16 => pairs().map(|&pair| T::from_f64(f16::from_le_bytes(pair).to_f64())).collect(),
            Storage::Bf16 => pairs().map(|&pair| T::from_f64(bf16::from_le_bytes(pair).to_f64())).collect(),
        }
    }
}

/// The number as f32, or the neighbour whose last bit is 1 if it lies between two. So rounding that to 16 bits is the
/// same as rounding once. `half` does not round f64 to nearest: it cuts digits off first.
fn to_odd(x: f64) -> f32 {
    let near = x as f32;
    if f64::from(near) == x || !near.is_finite() {
        return near;
    }
    let toward_zero = near.to_bits() - u32::from(f64::from(near).abs() > x.abs());
    f32::from_bits(toward_zero | 1)
}

/// The reason that stored parameters do not fit a model.
#[derive(Debug, thiserror::Error)]
pub enum ParamsError {
    /// The bytes are not a safetensors file.
    #[error("not a safetensors file: {}", shown(&.0.to_string()))]
    Format(#[from] safetensors::SafeTensorError),
    /// Two entries of a file would have one name, or an entry would have the format's reserved name.
    #[error("`{}` cannot be the name of an entry: another one has it, or the format itself", shown(.0))]
    Name(String),
    /// A parameter of the model is not in the file.
    #[error("`{0}` is missing: the file belongs to a model of another configuration")]
    Missing(String),
    /// The file holds a parameter that the model does not have.
    #[error("`{}` is not a parameter of this model: the file belongs to a model of another configuration", shown(.0))]
    Unknown(String),
    /// A parameter has another shape or number type in the file.
    #[error("`{name}` is {found} in the file and {expected} in this model")]
    Mismatch {
        /// The name of the parameter.
        name: String,
        /// Type and shape in the file.
        found: String,
        /// Type and shape in the model.
        expected: String,
    },
}

/// An entry of a file, which is serialised only on writing. So there is no second copy of all numbers.
pub(crate) enum Part<'a, T: Scalar> {
    /// A tensor with its storage type.
    Value(Storage, &'a Tensor<T>),
    /// Numbers of another type as bytes, with their number.
    Bytes(Dtype, [usize; 1], Cow<'a, [u8]>),
}

impl<T: Scalar> View for Part<'_, T> {
    fn dtype(&self) -> Dtype {
        match self {
            Part::Value(storage, _) => storage.dtype::<T>(),
            Part::Bytes(dtype, ..) => *dtype,
        }
    }

    fn shape(&self) -> &[usize] {
        match self {
            Part::Value(_, value) => value.shape(),
            Part::Bytes(_, len, _) => len,
        }
    }

    fn data(&self) -> Cow<'_, [u8]> {
        match self {
            Part::Value(storage, value) => storage.write(value.as_slice()).into(),
            Part::Bytes(.., bytes) => Cow::Borrowed(bytes),
        }
    }

    fn data_len(&self) -> usize {
        self.shape().iter().product::<usize>() * self.dtype().bitsize() / 8
    }
}

impl<T: Scalar> Params<T> {
    /// Rounds every value to the storage type.
    pub fn round_to(&mut self, storage: Storage) {
        for value in self.values_mut() {
            let storage = storage.that_fits(value.as_slice());
            value.as_mut_slice().iter_mut().for_each(|x| *x = storage.round(*x));
        }
    }

    /// Serialises the parameters as a safetensors file, with `metadata` and further named byte arrays. Equal contents
    /// give equal bytes.
    ///
    /// # Errors
    /// If the format cannot hold them: two entries of one name, or an entry named `__metadata__`.
    pub fn to_safetensors(
        &self,
        storage: Storage,
        metadata: &BTreeMap<String, String>,
        blobs: &[(&str, Vec<u8>)],
    ) -> Result<Vec<u8>, ParamsError> {
        if let Some(name) = bad_entry(self.names().chain(blobs.iter().map(|(name, _)| *name))) {
            return Err(ParamsError::Name(name.to_owned()));
        }
        let values = self.iter().map(|(name, value)| (name, Part::Value(storage.that_fits(value.as_slice()), value)));
        let blobs = blobs.iter().map(|(name, bytes)| (*name, Part::Bytes(Dtype::U8, [bytes.len()], bytes.into())));
        let unordered = metadata.clone().into_iter().collect();
        let mut bytes = safetensors::serialize(values.chain(blobs), Some(unordered))?;
        sort_metadata(&mut bytes, metadata)?;
        Ok(bytes)
    }

    /// Replaces every value with that of the same name in a safetensors file. Returns the further byte arrays of the
    /// file by name. If a value does not fit, no value changes.
    ///
    /// # Errors
    /// If the bytes are not a safetensors file, or names or shapes differ from those of this store. Also if a number
    /// type is neither that of this store nor a 16-bit type.
    pub fn load_safetensors(&mut self, bytes: &[u8]) -> Result<HashMap<String, Vec<u8>>, ParamsError> {
        let file = SafeTensors::deserialize(bytes)?;
        let mut values = Vec::with_capacity(self.len());
        for (name, value) in self.iter() {
            let Ok(found) = file.tensor(name) else { return Err(ParamsError::Missing(name.into())) };
            let storage = Storage::of::<T>(found.dtype()).filter(|_| found.shape() == value.shape());
            let Some(storage) = storage else {
                return Err(ParamsError::Mismatch {
                    name: name.into(),
                    found: format!("{:?}{:?}", found.dtype(), found.shape()),
                    expected: format!("{:?}{:?}", Storage::Full.dtype::<T>(), value.shape()),
                });
            };
            values.push(Tensor::from_vec(value.shape(), storage.read(found.data())));
        }
        let mut blobs = HashMap::new();
        for (name, view) in file.tensors() {
            if view.dtype() == Dtype::U8 {
                blobs.insert(name, view.data().to_vec());
            } else if self.find(&name).is_none() {
                return Err(ParamsError::Unknown(name));
            }
        }
        self.replace(values);
        Ok(blobs)
    }
}

/// The start of a safetensors file with metadata, after the length of its header.
const METADATA: &[u8] = b"{\"__metadata__\":";

/// Sorts the metadata of a safetensors file by key. The crate writes them in the order of a hash map, which differs in
/// every run. Their length does not depend on the order.
fn sort_metadata(bytes: &mut [u8], metadata: &BTreeMap<String, String>) -> Result<(), ParamsError> {
    let sorted = serde_json::to_vec(metadata).map_err(safetensors::SafeTensorError::from)?;
    let header = bytes[size_of::<u64>()..].split_at_mut_checked(METADATA.len());
    let place = header.filter(|(start, _)| *start == METADATA).and_then(|(_, rest)| rest.get_mut(..sorted.len()));
    place.ok_or(safetensors::SafeTensorError::InvalidHeaderLength)?.copy_from_slice(&sorted);
    Ok(())
}

/// Reads the byte array of this name from a safetensors file, before its parameters are read. `None` if the file does
/// not have it.
///
/// # Errors
/// If the bytes are not a safetensors file.
pub fn stored_bytes(bytes: &[u8], name: &str) -> Result<Option<Vec<u8>>, ParamsError> {
    let file = SafeTensors::deserialize(bytes)?;
    let found = file.tensor(name).ok().filter(|view| view.dtype() == Dtype::U8);
    Ok(found.map(|view| view.data().to_vec()))
}

/// Reads the metadata value of this key from a safetensors file. `None` if the file does not have it.
///
/// # Errors
/// If the bytes are not a safetensors file.
pub fn stored_words(bytes: &[u8], key: &str) -> Result<Option<String>, ParamsError> {
    let (_, header) = SafeTensors::read_metadata(bytes)?;
    Ok(header.metadata().as_ref().and_then(|words| words.get(key).cloned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn store() -> Params<f32> {
        let mut params = Params::new();
        params.add("a", Tensor::from_vec(&[2], vec![1.0, f32::MIN_POSITIVE]));
        params.add("b", Tensor::from_vec(&[1, 2], vec![-0.0, 3.5]));
        params
    }

    /// The bytes of a store, in full.
    fn written(params: &Params<f32>) -> Vec<u8> {
        params.to_safetensors(Storage::Full, &BTreeMap::new(), &[]).unwrap()
    }

    #[test]
    fn a_stored_model_comes_back_bit_for_bit() {
        let params = store();
        let bytes = params.to_safetensors(Storage::Full, &BTreeMap::new(), &[("more", vec![1, 2, 3])]).unwrap();
        let mut other = params.clone();
        other.values_mut()[0].as_mut_slice().fill(9.0);
        let blobs = other.load_safetensors(&bytes).unwrap();
        assert_eq!(blobs["more"], [1, 2, 3]);
        assert_eq!(stored_words(&bytes, "version").unwrap(), None);
        let words = BTreeMap::from([("version".into(), "7".into())]);
        let bytes = params.to_safetensors(Storage::Full, &words, &[]).unwrap();
        assert_eq!(stored_words(&bytes, "version").unwrap().as_deref(), Some("7"));
        assert!(stored_words(&bytes, "other").unwrap().is_none() && stored_words(b"none", "version").is_err());
        for (a, b) in params.values().iter().zip(other.values()) {
            let bits = |x: &Tensor<f32>| x.as_slice().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(a), bits(b));
        }
    }

    #[test]
    fn equal_models_have_equal_bytes() {
        let metadata: BTreeMap<String, String> =
            (0..40).map(|i| (format!("key\n{i}\u{e9}"), format!("\"{i}\\"))).collect();
        let write = || store().to_safetensors(Storage::Full, &metadata, &[("more", vec![1])]).unwrap();
        let bytes = write();
        for _ in 0..5 {
            assert!(write() == bytes, "the same model, other bytes");
        }
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let places: Vec<_> =
            metadata.keys().map(|key| text.find(&serde_json::to_string(key).unwrap()).unwrap()).collect();
        assert!(places.is_sorted(), "{places:?}");
        for (key, value) in &metadata {
            assert_eq!(stored_words(&bytes, key).unwrap().as_ref(), Some(value));
        }
        assert_eq!(store().load_safetensors(&bytes).unwrap()["more"], [1]);
    }

    #[test]
    fn entries_of_one_name_are_an_error() {
        let write = |params: &Params<f32>, blobs: &[&str]| {
            let blobs: Vec<_> = blobs.iter().map(|name| (*name, vec![1])).collect();
            params.to_safetensors(Storage::Full, &BTreeMap::new(), &blobs).map(drop).map_err(|error| error.to_string())
        };
        let expected = |name: &str| {
            Err(format!("`{name}` cannot be the name of an entry: another one has it, or the format itself"))
        };
        assert_eq!(write(&store(), &["a"]), expected("a"));
        assert_eq!(write(&store(), &["c", "d", "c"]), expected("c"));
        assert_eq!(write(&store(), &["__metadata__"]), expected("__metadata__"));
        assert_eq!(write(&store(), &["c", "d"]), Ok(()));
        let mut params = store();
        params.add("__metadata__", Tensor::zeros(&[1]));
        assert_eq!(write(&params, &[]), expected("__metadata__"));
    }

    /// Values, and the nearest ones in f16 and in bf16.
    const ROUNDED: [[f32; 3]; 8] = [
        [1.0 / 3.0, 0.333_251_95, 0.333_984_38],
        [-1.0, -1.0, -1.0],
        [65504.0, 65504.0, 65536.0],
        [1e-4, 1.000_165_94e-4, 1.001_358e-4],
        [6e-8, 5.960_464_5e-8, 6.007_030_6e-8],
        [1e-9, 0.0, 9.968_062e-10],
        [0.0, 0.0, 0.0],
        [f32::INFINITY, f32::INFINITY, f32::INFINITY],
    ];

    #[test]
    fn half_of_the_bytes_hold_the_nearest_numbers() {
        let mut params = Params::<f32>::new();
        params.add("a", Tensor::from_vec(&[8], ROUNDED.map(|[x, ..]| x).to_vec()));
        for (which, storage) in [Storage::Full, Storage::F16, Storage::Bf16].into_iter().enumerate() {
            let bytes = params.to_safetensors(storage, &BTreeMap::new(), &[]).unwrap();
            let mut read = params.clone();
            read.values_mut()[0].as_mut_slice().fill(9.0);
            read.load_safetensors(&bytes).unwrap();
            assert_eq!(read.values()[0].as_slice(), ROUNDED.map(|row| row[which]), "{storage:?}");
            let mut rounded = params.clone();
            rounded.round_to(storage);
            assert_eq!(read.values(), rounded.values());
        }
        let sizes = [Storage::Full, Storage::F16, Storage::Bf16].map(|storage| storage.write(&[1.0_f32; 8]).len());
        assert_eq!(sizes, [32, 16, 16]);
    }

    #[test]
    fn what_would_become_infinite_is_stored_in_full() {
        let mut params = Params::<f64>::new();
        params.add("small", Tensor::full(&[2], 0.1));
        params.add("large", Tensor::full(&[2], 65520.1));
        let bytes = params.to_safetensors(Storage::F16, &BTreeMap::new(), &[]).unwrap();
        let mut read = params.clone();
        read.load_safetensors(&bytes).unwrap();
        assert_eq!(read.values()[1], params.values()[1]);
        assert_ne!(read.values()[0], params.values()[0]);
        params.round_to(Storage::F16);
        assert_eq!(read.values(), params.values());
    }

    #[test]
    fn another_model_is_refused_and_nothing_changes() {
        let mut wide = Params::<f32>::new();
        wide.add("a", Tensor::zeros(&[3]));
        wide.add("b", Tensor::zeros(&[1, 2]));
        let mut params = store();
        let message = params.load_safetensors(&written(&wide)).unwrap_err().to_string();
        assert!(message.contains("`a` is F32[3] in the file and F32[2]"), "{message}");
        assert_eq!(params.values()[0].as_slice()[0], 1.0);
        let mut more = store();
        more.add("c", Tensor::zeros(&[1]));
        assert!(matches!(more.load_safetensors(&written(&store())), Err(ParamsError::Missing(_))));
        assert!(matches!(params.load_safetensors(&written(&more)), Err(ParamsError::Unknown(_))));
        let mut odd = store();
        odd.add("c\nd", Tensor::zeros(&[1]));
        let message = params.load_safetensors(&written(&odd)).unwrap_err().to_string();
        assert!(message.starts_with("`c\\nd` is not a parameter"), "{message}");
        assert!(params.load_safetensors(b"no tensors").is_err());
    }

    #[test]
    fn numbers_are_rounded_to_the_nearest() {
        // Half a step above 1, and the numbers beside it.
        let bf16 = |x: f64| Storage::Bf16.round::<f64>(x);
        let f16 = |x: f64| Storage::F16.round::<f64>(x);
        let (half, half16) = (2.0_f64.powi(-8), 2.0_f64.powi(-11));
        for tiny in [2.0_f64.powi(-23), 2.0_f64.powi(-40), 2.0_f64.powi(-52)] {
            for sign in [1.0, -1.0] {
                assert_eq!(
                    [1.0 + half - tiny, 1.0 + half + tiny].map(|x| bf16(sign * x)),
                    [sign, sign * (1.0 + 2.0 * half)]
                );
                assert_eq!(
                    [1.0 + half16 - tiny, 1.0 + half16 + tiny].map(|x| f16(sign * x)),
                    [sign, sign * (1.0 + 2.0 * half16)]
                );
            }
        }
        assert_eq!(([bf16(1.0 + half), f16(1.0 + half16)], bf16(1.0 + 3.0 * half)), ([1.0; 2], 1.0 + 4.0 * half));
        assert_eq!(Storage::Bf16.round(f32::from_bits(0x3f80_8001)), f32::from_bits(0x3f81_0000));
        assert!(bf16(f64::NAN).is_nan() && f16(1e300) == f64::INFINITY && bf16(-1e-300).is_sign_negative());
        assert_eq!([bf16(1e-300), f16(2.0_f64.powi(-25) * 1.0001)], [0.0, 2.0_f64.powi(-24)]);
    }
}
