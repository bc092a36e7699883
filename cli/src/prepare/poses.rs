//! Camera poses from COLMAP.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::formats::colmap;
use raygrad::nerf::dataset::{Capture, Photo};
use raygrad::nerf::{Error, Result};

use super::program::{COLMAP, counted};
use super::workplace::Workplace;
use crate::interrupt::Work;
use crate::output::{entries, note};
use crate::progress::Progress;

/// Up to this number of images, COLMAP matches all pairs. This closes loops of a video.
const EXHAUSTIVE: usize = 200;
/// Temporary folder of COLMAP.
const FOLDER: &str = "work";
/// Options that disable the GPU, for new and old versions.
const EXTRACTION: [&str; 2] = ["FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"];
const MATCHING: [&str; 2] = ["FeatureMatching.use_gpu", "SiftMatching.use_gpu"];
/// The mapper's output, with exit code 1, if it finds no model. [`find`] reports this case itself.
const NO_MODEL: &str = "failed to create sparse model";

/// Result of COLMAP.
#[derive(Debug, PartialEq)]
pub struct Found {
    /// Number of registered images.
    pub registered: usize,
    /// Names of the other images.
    pub lost: Vec<String>,
    /// Number of models. Only the largest is kept.
    pub models: usize,
}

/// Fails if COLMAP cannot be run.
pub fn check() -> Work<()> {
    COLMAP.check()
}

/// Finds the camera poses of `images` and writes them to `sparse/0`. `sequence` is true for frames of a video, in
/// order. `model` is COLMAP's name of a camera model.
pub fn find(place: &Workplace, sequence: bool, model: &str) -> Work<Found> {
    let images = place.folder().join("images");
    let names = names(&images)?;
    let work = place.make(FOLDER)?;
    let colmap = Colmap { database: work.join("database.db"), images };

    let mut arguments = vec!["--ImageReader.camera_model", model];
    if colmap.one_size(&names)? {
        // A shared camera has more accurate intrinsics.
        arguments.extend(["--ImageReader.single_camera", "1"]);
    }
    colmap.step("feature_extractor", Some(EXTRACTION), "extracting features", &arguments)?;
    let matcher = if names.len() > EXHAUSTIVE { "sequential_matcher" } else { "exhaustive_matcher" };
    if names.len() > EXHAUSTIVE && !sequence {
        note(&format!("more than {EXHAUSTIVE} images: COLMAP matches each only with those that follow by name"));
    }
    colmap.step(matcher, Some(MATCHING), "matching images", &[])?;
    let found = colmap.map(&place.make(&format!("{FOLDER}/models"))?, names.len())?;
    let count = found.len();
    // If sizes are equal, the first model is kept.
    let largest = found.into_iter().rev().max_by_key(|(_, capture)| capture.views.len());
    let Some((folder, capture)) = largest else {
        let what = "found no camera poses: the images overlap too little, are blurred or lack texture; take more \
                    that overlap and are sharp";
        return Err(Error::setting("colmap mapper", what).into());
    };
    let to = place.make("sparse")?.join("0");
    std::fs::rename(&folder, &to).map_err(|e| Error::file(&to, format!("cannot be created: {e}")))?;
    place.remove(FOLDER);
    let registered = capture.views.len();
    Ok(Found { registered, lost: lost(names, &capture), models: count })
}

/// The images without a camera.
fn lost(names: Vec<String>, capture: &Capture) -> Vec<String> {
    names.into_iter().filter(|name| capture.views.iter().all(|view| view.name != *name)).collect()
}

fn names(folder: &Path) -> Result<Vec<String>> {
    let name = |path: PathBuf| Some(path.file_name()?.to_string_lossy().into_owned());
    Ok(entries(folder)?.into_iter().filter_map(name).collect())
}

/// The folders of COLMAP's models, by number.
fn folders(models: &Path) -> Result<Vec<PathBuf>> {
    let mut numbers: Vec<usize> = names(models)?.iter().filter_map(|name| name.parse().ok()).collect();
    numbers.sort_unstable();
    Ok(numbers.into_iter().map(|number| models.join(number.to_string())).collect())
}

struct Colmap {
    database: PathBuf,
    images: PathBuf,
}

impl Colmap {
    /// Returns true if all images have one size, which suggests a single camera.
    fn one_size(&self, names: &[String]) -> Result<bool> {
        let mut first = None;
        for name in names {
            let [_, size] = Photo::size_of_file(self.images.join(name))?;
            if *first.get_or_insert(size) != size {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Runs a COLMAP command that prints its progress as a count.
    fn step(&self, step: &str, gpu: Option<[&str; 2]>, words: &str, arguments: &[&str]) -> Work<()> {
        let mut command = COLMAP.command();
        command.arg(step).arg("--database_path").arg(&self.database);
        if step == "feature_extractor" {
            command.arg("--image_path").arg(&self.images);
        }
        command.args(arguments);
        let help = COLMAP.ask(&[step, "-h"])?;
        // There may be no GPU, or no display to use it without a window.
        if let Some(name) = gpu.iter().flatten().find(|name| help.contains(**name)) {
            command.arg(format!("--{name}")).arg("0");
        }
        let progress = Progress::new();
        COLMAP.run(&mut command, None, |line| {
            let Some(done) = counted(line) else { return };
            progress.set(done, || format!("{words}: {:.0} %", 100.0 * done));
        })
    }

    /// Runs the mapper and returns its models with their folders. COLMAP prints each registered image and restarts the
    /// count for each model.
    fn map(&self, models: &Path, total: usize) -> Work<Vec<(PathBuf, Capture)>> {
        let mut command = COLMAP.command();
        let paths: [(&str, &OsStr); 3] = [
            ("--database_path", self.database.as_os_str()),
            ("--image_path", self.images.as_os_str()),
            ("--output_path", models.as_os_str()),
        ];
        command.arg("mapper");
        let mut most = 0;
        for (name, path) in paths {
            command.arg(name).arg(path);
        }
        let progress = Progress::new();
        COLMAP.run(&mut command, Some(NO_MODEL), |line| {
            let Some(count) = registered(line) else { return };
            most = most.max(count);
            progress.set(most as f64 / total as f64, || match count {
                count if count < most => format!("{most} of {total} images registered; {count} in another model"),
                _ => format!("{most} of {total} images registered"),
            });
        })?;
        let folders = folders(models)?.into_iter();
        Ok(folders.map(|folder| Ok((folder.clone(), colmap::read(&folder)?))).collect::<Result<_>>()?)
    }
}

/// The count in `Registering image #12 (13)`, or `(num_reg_frames=13)` in newer versions.
fn registered(line: &str) -> Option<usize> {
    let (_, rest) = line.split_once("Registering image #")?;
    let inside = rest.split_once('(')?.1.split_once(')')?.0;
    inside.rsplit('=').next()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::registered;

    #[test]
    fn registered_parses_old_and_new_output() {
        assert_eq!(registered("I20240101 incremental.cc:418] Registering image #12 (13)"), Some(13));
        assert_eq!(registered("Registering image #12 (num_reg_frames=7)"), Some(7));
        for line in ["", "=> Image sees 120 / 300 points", "Registering image #12", "Registering image #1 (x)"] {
            assert_eq!(registered(line), None, "{line}");
        }
    }
}
