//! The saved state of an optimizer, by the names of the parameters.

#[cfg(feature = "files")]
use crate::{Storage, files::bad_entry, storage::Part};
#[cfg(feature = "files")]
use raygrad_tensor::checked_len;
use raygrad_tensor::{Scalar, Tensor};
#[cfg(feature = "files")]
use safetensors::tensor::{Dtype, SafeTensors};
use std::collections::BTreeMap;

/// The saved state of an optimizer, to resume a run bit for bit.
///
/// The name of an entry has the parameter and the kind of state: `layer.weight.first`. Neither constants, such as those
/// of [`AdamConfig`](crate::AdamConfig), nor parameters are part of the state.
///
/// ```
/// use raygrad_autograd::{Gradient, Tensor};
/// use raygrad_nn::{Adam, AdamConfig, Optimizer, OptimizerState, Params};
/// let mut params = Params::<f32>::new();
/// params.add("x", Tensor::scalar(5.0));
/// let mut adam = Adam::new(AdamConfig::default());
/// adam.update(&mut params, &[Gradient::from(Tensor::scalar(1.0))], 0.1).check().unwrap();
/// let bytes = adam.state(&params).to_safetensors().unwrap();
///
/// let mut later = Adam::new(AdamConfig::default());
/// later.load_state(&params, &OptimizerState::from_safetensors(&bytes).unwrap()).unwrap();
/// assert_eq!(later.steps(), 1);
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct OptimizerState<T: Scalar> {
    /// Numbers of the parameters' type: moments, velocities, averages.
    pub tensors: BTreeMap<String, Tensor<T>>,
    /// Counts of steps: of the optimizer, of a parameter, or of each row of a table.
    pub counts: BTreeMap<String, Vec<u64>>,
}

/// The reason that a state does not fit an optimizer and its parameters.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// The bytes are not a safetensors file.
    #[cfg(feature = "files")]
    #[error("not a safetensors file: {}", crate::files::shown(&.0.to_string()))]
    Format(#[from] safetensors::SafeTensorError),
    /// An entry is missing, unknown or of another shape or type.
    #[error("`{name}` {what}")]
    Entry {
        /// The name of the entry.
        name: String,
        /// The mismatch.
        what: String,
    },
}

impl StateError {
    fn entry(name: &str, what: impl Into<String>) -> Self {
        StateError::Entry { name: name.escape_debug().take(200).collect(), what: what.into() }
    }
}

/// The name of an entry. Without a parameter it is an entry of the optimizer itself.
fn key(name: &str, what: &str) -> String {
    if name.is_empty() { what.to_owned() } else { format!("{name}.{what}") }
}

impl<T: Scalar> OptimizerState<T> {
    /// Adds numbers of a parameter.
    pub(crate) fn put(&mut self, name: &str, what: &str, shape: &[usize], values: Vec<T>) {
        self.tensors.insert(key(name, what), Tensor::from_vec(shape, values));
    }

    /// Adds counts of a parameter.
    pub(crate) fn put_counts(&mut self, name: &str, what: &str, counts: Vec<u64>) {
        self.counts.insert(key(name, what), counts);
    }

    /// Whether a parameter has such numbers.
    pub(crate) fn has(&self, name: &str, what: &str) -> bool {
        self.tensors.contains_key(&key(name, what))
    }

    /// Removes and returns numbers of a parameter.
    pub(crate) fn take(&mut self, name: &str, what: &str, shape: &[usize]) -> Result<Tensor<T>, StateError> {
        let key = key(name, what);
        let Some(tensor) = self.tensors.remove(&key) else { return Err(StateError::entry(&key, "is missing")) };
        if tensor.shape() != shape {
            return Err(StateError::entry(&key, format!("has the shape {:?}, and not {shape:?}", tensor.shape())));
        }
        Ok(tensor)
    }

    /// Removes and returns counts of a parameter, if there are any.
    pub(crate) fn take_counts(&mut self, name: &str, what: &str, len: usize) -> Result<Option<Vec<u64>>, StateError> {
        let key = key(name, what);
        match self.counts.remove(&key) {
            Some(counts) if counts.len() != len => {
                Err(StateError::entry(&key, format!("has {} counts, and not {len}", counts.len())))
            }
            counts => Ok(counts),
        }
    }

    /// Removes and returns the optimizer's own number of steps.
    pub(crate) fn take_steps(&mut self) -> Result<u64, StateError> {
        self.take_counts("", "steps", 1)?.map(|steps| steps[0]).ok_or_else(|| StateError::entry("steps", "is missing"))
    }

    /// An error with this text if a parameter has counts that it cannot have.
    pub(crate) fn refuse(&self, name: &str, what: &str, words: &str) -> Result<(), StateError> {
        let key = key(name, what);
        if self.counts.contains_key(&key) { Err(StateError::entry(&key, words)) } else { Ok(()) }
    }

    /// An error if an entry is left.
    pub(crate) fn refuse_rest(&self) -> Result<(), StateError> {
        let what = "is unknown: the state belongs to another optimizer or other parameters";
        self.tensors.keys().chain(self.counts.keys()).min().map_or(Ok(()), |name| Err(StateError::entry(name, what)))
    }
}

#[cfg(feature = "files")]
impl<T: Scalar> OptimizerState<T> {
    /// Serialises the state as a safetensors file: tensors in their own type, counts as `U64`.
    ///
    /// # Errors
    /// If the format cannot hold it, such as an entry that is both a tensor and a count.
    pub fn to_safetensors(&self) -> Result<Vec<u8>, StateError> {
        if let Some(name) = bad_entry(self.tensors.keys().chain(self.counts.keys()).map(String::as_str)) {
            return Err(StateError::entry(name, "is there twice, or has a name of the format's own"));
        }
        let values = self.tensors.iter().map(|(name, value)| (name, Part::Value(Storage::Full, value)));
        let counts = self.counts.iter().map(|(name, counts)| {
            let bytes: Vec<u8> = counts.iter().flat_map(|count| count.to_le_bytes()).collect();
            (name, Part::Bytes(Dtype::U64, [counts.len()], bytes.into()))
        });
        Ok(safetensors::serialize(values.chain(counts), None)?)
    }

    /// Reads a state from a safetensors file.
    ///
    /// # Errors
    /// If the bytes are not a safetensors file, or a number type is neither that of the parameters nor `U64`. Also if a
    /// shape is larger than memory can hold.
    pub fn from_safetensors(bytes: &[u8]) -> Result<Self, StateError> {
        let mut state = OptimizerState { tensors: BTreeMap::new(), counts: BTreeMap::new() };
        for (name, view) in SafeTensors::deserialize(bytes)?.tensors() {
            if view.dtype() == Storage::Full.dtype::<T>() {
                // The format takes extents beside a 0 for nothing, whatever they are.
                if checked_len(view.shape()).is_none() {
                    return Err(StateError::entry(&name, format!("has shape {:?}, which is too large", view.shape())));
                }
                state.tensors.insert(name, Tensor::from_vec(view.shape(), Storage::Full.read(view.data())));
            } else if view.dtype() == Dtype::U64 {
                let counts = view.data().as_chunks().0.iter().map(|bytes| u64::from_le_bytes(*bytes)).collect();
                state.counts.insert(name, counts);
            } else {
                return Err(StateError::entry(&name, format!("is of type {:?}, and not {}", view.dtype(), T::NAME)));
            }
        }
        Ok(state)
    }
}
