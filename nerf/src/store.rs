//! Models on disk.

use crate::config::Config;
use crate::model::{Extent, Model, Sampler};
use crate::occupancy::OccupancyGrid;
use crate::output::write_atomic;
use crate::{Error, Result};
use std::collections::HashMap;
use std::path::Path;

/// The name of the occupancy grid's bytes in a file.
const GRID: &str = "occupancy";

impl Model<f32> {
    /// Writes the parameters, and the occupancy grid if there is one, as safetensors: beside the file first and then over
    /// it.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let metadata = HashMap::from([("format".into(), "raygrad".into())]);
        let blobs = match &self.sampler {
            Sampler::Hierarchical(_) => vec![],
            Sampler::Marching(sampler) => vec![(GRID, sampler.grid.to_bytes())],
        };
        let bytes = self.params.to_safetensors(metadata, &blobs).map_err(|error| Error::file(&path, error))?;
        write_atomic(path, &bytes)
    }

    /// A model of this configuration with the parameters of a file.
    ///
    /// # Errors
    /// If the file cannot be read or belongs to a model of another configuration.
    pub fn load(path: impl AsRef<Path>, config: Config, extent: Extent) -> Result<Self> {
        let bytes = std::fs::read(&path).map_err(|error| Error::file(&path, error))?;
        let mut model = Model::new(config, extent, 0)?;
        let blobs = model.params.load_safetensors(&bytes).map_err(|error| Error::file(&path, error))?;
        if let Sampler::Marching(sampler) = &mut model.sampler {
            let Some(bytes) = blobs.get(GRID) else { return Err(Error::file(&path, "holds no occupancy grid")) };
            let grid = OccupancyGrid::from_bytes(bytes).map_err(|error| Error::file(&path, error))?;
            if grid.bounds() != sampler.grid.bounds() || grid.cells() != sampler.grid.cells() {
                return Err(Error::file(&path, "its occupancy grid belongs to a model of another configuration"));
            }
            sampler.grid = grid;
        }
        Ok(model)
    }
}
