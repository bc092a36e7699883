//! Models on disk.

use crate::config::Config;
use crate::model::{Extent, Model};
use crate::output::write_atomic;
use crate::{Error, Result};
use std::collections::HashMap;
use std::path::Path;

impl Model<f32> {
    /// Writes the parameters as safetensors, beside the file first and then over it.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let metadata = HashMap::from([("format".into(), "raygrad".into())]);
        let bytes = self.params.to_safetensors(metadata).map_err(|error| Error::file(&path, error))?;
        write_atomic(path, &bytes)
    }

    /// A model of this configuration with the parameters of a file.
    ///
    /// # Errors
    /// If the file cannot be read or belongs to a model of another configuration.
    pub fn load(path: impl AsRef<Path>, config: Config, extent: Extent) -> Result<Self> {
        let bytes = std::fs::read(&path).map_err(|error| Error::file(&path, error))?;
        let mut model = Model::new(config, extent, 0)?;
        model.params.load_safetensors(&bytes).map_err(|error| Error::file(&path, error))?;
        Ok(model)
    }
}
