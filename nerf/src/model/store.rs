//! Saving and loading models.

use super::config::Config;
use super::{Model, SceneBox};
use crate::camera::Camera;
use crate::files::write_atomic;
use crate::{Error, Result};
use raygrad_nn::{stored_bytes, stored_words};
use std::collections::BTreeMap;
use std::path::Path;

impl Model<f32> {
    /// Writes parameters and sampler state (such as occupied cells) to a safetensors file, atomically.
    ///
    /// [`Config::storage`] is the number type of the parameters in the file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let metadata = BTreeMap::from([(FORMAT.into(), format!("raygrad {VERSION}"))]);
        let mut blobs = self.sampler.state();
        if self.detail < 1.0 {
            blobs.push((DETAIL, self.detail.to_le_bytes().to_vec()));
        }
        if !self.cameras().is_empty() {
            blobs.push((CAMERAS, serde_json::to_vec(self.cameras()).map_err(|error| Error::file(&path, error))?));
        }
        let bytes = self
            .params
            .to_safetensors(self.config.storage, &metadata, &blobs)
            .map_err(|error| Error::file(&path, error))?;
        write_atomic(path, &bytes)
    }

    /// Reads a model that [`save`](Self::save) wrote, with the same configuration and scene box.
    ///
    /// # Errors
    /// If the file cannot be read, has a later format version, belongs to another configuration, or has a value that is
    /// not finite.
    pub fn load(path: impl AsRef<Path>, config: Config, extent: SceneBox) -> Result<Self> {
        let bytes = std::fs::read(&path).map_err(|error| Error::file(&path, error))?;
        check_version(&bytes).map_err(|error| Error::file(&path, error))?;
        // The number of parameters depends on the cameras.
        let stored = stored_bytes(&bytes, CAMERAS).map_err(|error| Error::file(&path, error))?;
        let cameras = cameras(stored.as_deref()).map_err(|error| Error::file(&path, error))?;
        let mut model = Model::with_cameras(config, extent, &cameras, 0)?;
        let state = model.params.load_safetensors(&bytes).map_err(|error| Error::file(&path, error))?;
        if let Some((name, _)) = model.params.iter().find(|(_, value)| !value.is_finite()) {
            let what = format!("is damaged: `{name}` has values that are not finite; copy the file again");
            return Err(Error::file(&path, what));
        }
        model.sampler.load_state(&state).map_err(|error| Error::file(&path, error))?;
        // Training may have ended before all detail was enabled.
        let detail = stored_bytes(&bytes, DETAIL).map_err(|error| Error::file(&path, error))?;
        let detail = detail.and_then(|bytes| Some(f64::from_le_bytes(bytes.try_into().ok()?)));
        if let Some(detail) = detail.filter(|detail| (0.0..=1.0).contains(detail)) {
            model.set_detail(detail);
        }
        // Frees the file's bytes before `finish`, which samples the field.
        drop((bytes, state));
        model.finish();
        Ok(model)
    }
}

/// The metadata key of the format: `raygrad` and its version. The first version did not write it.
const FORMAT: &str = "format";
/// The current version.
const VERSION: u64 = 1;

/// Checks that this version can be read.
fn check_version(bytes: &[u8]) -> std::result::Result<(), String> {
    let stored = stored_words(bytes, FORMAT).map_err(|error| error.to_string())?;
    let Some(words) = stored.as_deref().and_then(|words| words.strip_prefix("raygrad ")) else { return Ok(()) };
    match words.parse::<u64>() {
        Ok(version) if version <= VERSION => Ok(()),
        Ok(version) => {
            Err(format!("has format version {version}, this raygrad reads up to {VERSION}: use a newer raygrad"))
        }
        Err(_) => Err(format!("has format version {words:?}, not a number: copy the file again")),
    }
}

/// The name of the training cameras, in files of models with camera refinement.
const CAMERAS: &str = "cameras";
/// The name of the share of detail.
const DETAIL: &str = "detail";

/// The cameras in a model file, if it has any.
fn cameras(stored: Option<&[u8]>) -> Result<Vec<Camera>> {
    let wrong = |what: String| Error::setting(CAMERAS, what);
    let Some(stored) = stored else { return Ok(vec![]) };
    let cameras: Vec<Camera> = serde_json::from_slice(stored).map_err(|error| wrong(error.to_string()))?;
    for camera in &cameras {
        camera.lens.check()?;
        if !(camera.focal.iter().all(|focal| *focal > 0.0) && camera.width > 0 && camera.height > 0) {
            return Err(wrong(format!("a camera needs focal lengths and a size above 0, is {camera:?}")));
        }
    }
    Ok(cameras)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::sample::cameras_around;
    use crate::field::{FieldConfig, VoxelConfig};
    use crate::model::Preset;
    use crate::model::densities;
    use crate::sampling::marching::MarchingConfig;
    use crate::space::occupancy::OccupancyGrid;
    use glam::DVec3;
    use raygrad_autograd::Pool;
    use raygrad_nn::Storage;

    fn voxel(direction_degree: usize) -> Config {
        let mut config = Config::preset(Preset::Voxel);
        config.field = FieldConfig::new(VoxelConfig { resolution: 20, direction_degree });
        if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
            sampler.occupancy.resolution = 16;
        }
        config
    }

    #[test]
    fn later_format_version_is_an_error() {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]);
        let model = Model::new(voxel(1), extent, 3).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        model.save(&path).unwrap();
        let written = stored_words(&std::fs::read(&path).unwrap(), "format").unwrap();
        assert_eq!(written.as_deref(), Some("raygrad 1"));
        let load = |words: Option<&str>| {
            let words = words.map(|words| ("format".to_owned(), words.to_owned())).into_iter().collect();
            let bytes = model.params.to_safetensors(Storage::Full, &words, &model.sampler.state()).unwrap();
            std::fs::write(&path, bytes).unwrap();
            Model::load(&path, voxel(1), extent).map(|_| ()).map_err(|error| error.to_string())
        };
        assert!([None, Some("raygrad"), Some("raygrad 1"), Some("pt")].into_iter().all(|words| load(words).is_ok()));
        let newer = load(Some("raygrad 2")).unwrap_err();
        let expected = "has format version 2, this raygrad reads up to 1: use a newer raygrad";
        assert_eq!(newer, format!("{}: {expected}", path.display()));
        let expected = "has format version \"one\", not a number: copy the file again";
        assert_eq!(load(Some("raygrad one")).unwrap_err(), format!("{}: {expected}", path.display()));
    }

    #[test]
    fn voxel_model_round_trips() {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]);
        let mut model = Model::new(voxel(2), extent, 3).unwrap();
        // A ball in one corner, so that the occupancy grid is not uniform.
        let table = model.params.find("field.table").unwrap();
        let rows = model.params.get_mut(table).as_mut_slice().chunks_exact_mut(16).enumerate();
        rows.for_each(|(i, row)| row[0] = if i % 21 < 9 && i / 441 < 9 { 4.0 } else { -20.0 });
        model.finish();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        model.save(&path).unwrap();
        let read = Model::load(&path, voxel(2), extent).unwrap();
        assert_eq!(read.params.values(), model.params.values());
        let (Some(old), Some(new)) = (model.marching(), read.marching()) else { panic!() };
        let bytes = |grid: [&OccupancyGrid; 2]| grid.map(OccupancyGrid::occupied_to_bytes);
        assert_eq!(bytes([&new.grid, new.view_grid()]), bytes([&old.grid, old.view_grid()]));
        assert!(new.view_grid().occupied_share() < 0.5, "what views look at is pruned");
        assert_eq!(new.grid.occupied_share(), 1.0, "what is stored is not");
        let camera = &cameras_around(4, 24)[1];
        let [seen, again] = [&model, &read].map(|model| model.render(camera, [1.0; 3]));
        assert!(seen.color.data == again.color.data && seen.opacity.data.iter().any(|&x| x > 0.5));
        let error = Model::load(&path, voxel(3), extent).err().unwrap().to_string();
        assert!(error.contains("field.table"), "{error}");
    }

    #[test]
    fn stopped_run_restores_its_share_of_detail() {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let mut model = Model::new(Config::preset(Preset::Small), extent, 3).unwrap();
        let camera = &cameras_around(4, 12)[1];
        let view = |model: &Model<f32>| model.render(camera, [1.0; 3]).color;
        let whole = view(&model);
        // The coarse field, which places the samples of the other one.
        let coarse = |model: &Model<f32>| {
            let mut out = [0.0; 3];
            let points = [[0.1, -0.7, 0.4], [0.33, 0.2, -0.9], [-0.5, 0.6, 0.1]];
            densities(model.fields()[0], &model.params, &Pool::new(), &points, &mut out);
            out
        };
        let all = coarse(&model);
        for (detail, stored) in [(0.3, true), (0.0, true), (1.0, false)] {
            model.set_detail(detail);
            model.save(&path).unwrap();
            assert_eq!(stored_bytes(&std::fs::read(&path).unwrap(), DETAIL).unwrap().is_some(), stored, "{detail}");
            let read = Model::load(&path, model.config.clone(), extent).unwrap();
            assert!(view(&read) == view(&model) && (view(&read) == whole) == (detail == 1.0), "{detail}");
            assert!(view(&read.cast::<f32>().unwrap()) == view(&model), "{detail}");
            assert!(coarse(&read) == coarse(&model) && (coarse(&read) == all) == (detail == 1.0), "{detail}");
        }
    }

    #[test]
    fn invalid_stored_cameras_are_errors() {
        let stored = |change: fn(&mut Camera)| {
            let mut camera = cameras_around(1, 8)[0].clone();
            change(&mut camera);
            cameras(Some(&serde_json::to_vec(&[camera]).unwrap()))
        };
        assert_eq!(stored(|_| ()).unwrap().len(), 1);
        for change in [|c: &mut Camera| c.width = 0, |c: &mut Camera| c.height = 0, |c: &mut Camera| c.focal[1] = -1.0]
        {
            assert!(stored(change).unwrap_err().to_string().starts_with("`cameras`"));
        }
        assert!(cameras(Some(b"[1]")).is_err() && cameras(None).unwrap().is_empty());
    }

    #[test]
    fn sixteen_bits_halve_the_file() {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let sizes = [Storage::Full, Storage::F16, Storage::Bf16].map(|storage| {
            let mut model = Model::new(Config { storage, ..voxel(2) }, extent, 3).unwrap();
            model.save(&path).unwrap();
            let read = Model::load(&path, model.config.clone(), extent).unwrap();
            model.params.round_to(storage);
            assert_eq!(read.params.values(), model.params.values());
            let count: usize = model.params.values().iter().map(|value| value.as_slice().len()).sum();
            (path.metadata().unwrap().len() as f64, count as f64)
        });
        let [(full, count), (f16, _), (bf16, _)] = sizes;
        // Beside parameters, the file holds the occupancy grid and some names.
        assert!((full - f16 - 2.0 * count).abs() < 100.0 && (f16 - bf16).abs() < 100.0, "{sizes:?}");
    }

    #[test]
    fn config_without_loss_choice_is_read() {
        let mut value = serde_json::to_value(voxel(2)).unwrap();
        value.as_object_mut().unwrap().remove("loss").unwrap();
        assert_eq!(serde_json::from_value::<Config>(value).unwrap(), voxel(2));
    }
}
