//! Camera poses from COLMAP.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::formats::colmap;
use raygrad::nerf::dataset::{Capture, Photo};
use raygrad::nerf::{Error, Result};

use super::cameras::{self, About, Cameras};
use super::pairs;
use super::photographs::decoding_memory;
use super::program::{COLMAP, GLOMAP, Program, counted};
use super::workplace::Workplace;
use crate::interrupt::{Stop, Work};
use crate::output::{entries, note};
use crate::progress::Progress;

/// Up to this number of images, COLMAP matches all pairs. This closes loops of a video.
const EXHAUSTIVE: usize = 200;
/// Beyond it, each image is also matched with so many that look alike, no two of them closer by number than this.
const SIMILAR: [usize; 2] = [20, 0];
/// The same for frames of a video, which look like those beside them.
const LOOPS: [usize; 2] = [5, 10];
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
    let about = names.iter().map(|name| About::read(&images.join(name))).collect::<Result<Vec<About>>>()?;
    let colmap = Colmap { database: work.join("database.db"), images, work };
    colmap.extract(&names, &about, model)?;
    if names.len() <= EXHAUSTIVE {
        colmap.step("exhaustive_matcher", Some(MATCHING), "matching images", &[])?;
    } else {
        colmap.step("sequential_matcher", Some(MATCHING), "matching images that follow", &[])?;
        colmap.match_similar(&names, &about, sequence)?;
    }
    let found = colmap.map(place, names.len())?;
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
    /// Folder for lists.
    work: PathBuf,
}

impl Colmap {
    /// Finds features. Images of one lens and size share a camera, whose intrinsics are then more accurate. COLMAP reads
    /// the focal length from the EXIF data.
    fn extract(&self, names: &[String], about: &[About], model: &str) -> Work<()> {
        let Cameras { shared, single } = cameras::group(about);
        let groups = shared.iter().map(|group| (group, true)).chain(Some((&single, false)));
        let groups: Vec<_> = groups.filter(|(group, _)| !group.is_empty()).collect();
        if groups.len() > 1 {
            let (count, all) = (shared.len() + single.len(), names.len());
            note(&format!("the {all} images have {count} combinations of lens and size: COLMAP calibrates each alone"));
        }
        for (number, (group, is_shared)) in groups.iter().enumerate() {
            let mut arguments = ["--ImageReader.camera_model", model].map(OsStr::new).to_vec();
            if *is_shared {
                arguments.extend(["--ImageReader.single_camera", "1"].map(OsStr::new));
            }
            let list = self.work.join(format!("camera-{number}.txt"));
            let part = if groups.len() > 1 { format!(" ({} of {})", number + 1, groups.len()) } else { String::new() };
            if groups.len() > 1 {
                let lines: String = group.iter().map(|i| format!("{}\n", names[*i])).collect();
                write(&list, &lines)?;
                arguments.extend([OsStr::new("--image_list_path"), list.as_os_str()]);
            }
            let words = format!("extracting features{part}");
            self.step("feature_extractor", Some(EXTRACTION), &words, &arguments)?;
        }
        Ok(())
    }

    /// Matches images that look alike or were taken near each other, as in two loops around an object.
    fn match_similar(&self, names: &[String], about: &[About], sequence: bool) -> Work<()> {
        let files: Vec<PathBuf> = names.iter().map(|name| self.images.join(name)).collect();
        let descriptors = Progress::new().each(&decoding_memory(&files), "images compared", |i| {
            Ok(pairs::describe(&Photo::open(&files[i], None)?))
        })?;
        let places: Vec<_> = about.iter().map(|image| image.place).collect();
        let [wanted, apart] = if sequence { LOOPS } else { SIMILAR };
        let found = pairs::find(&descriptors, &places, wanted, apart);
        // COLMAP's list separates names by spaces, and its comments begin with #.
        let is_listed = |i: usize| !names[i].contains(char::is_whitespace) && !names[i].starts_with('#');
        let left_out = (0..names.len()).filter(|i| !is_listed(*i)).count();
        if left_out > 0 {
            note(&format!(
                "{left_out} images have spaces in their names: COLMAP matches them only with those that follow"
            ));
        }
        let found = found.iter().filter(|pair| pair.iter().all(|i| is_listed(*i)));
        let lines: String = found.map(|[a, b]| format!("{} {}\n", names[*a], names[*b])).collect();
        if lines.is_empty() {
            return Ok(());
        }
        let list = self.work.join("pairs.txt");
        write(&list, &lines)?;
        let [path, kind, pairs] = ["--match_list_path", "--match_type", "pairs"].map(OsStr::new);
        let arguments = [path, list.as_os_str(), kind, pairs];
        self.step("matches_importer", Some(MATCHING), "matching images that look alike", &arguments)
    }

    /// Runs a COLMAP command that prints its progress as a count.
    fn step(&self, step: &str, gpu: Option<[&str; 2]>, words: &str, arguments: &[&OsStr]) -> Work<()> {
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

    /// Finds poses and returns the models with their folders. GLOMAP, if installed, does it for many images: the time of
    /// COLMAP's mapper grows faster than their number.
    fn map(&self, place: &Workplace, total: usize) -> Work<Vec<(PathBuf, Capture)>> {
        if total > EXHAUSTIVE && GLOMAP.check().is_ok() {
            note(&format!("more than {EXHAUSTIVE} images: GLOMAP finds the poses"));
            let folder = place.make(&format!("{FOLDER}/global"))?;
            match self.run_mapper(GLOMAP, &folder, total) {
                Ok(found) if found.iter().any(|(_, capture)| !capture.views.is_empty()) => return Ok(found),
                Err(Stop::Interrupted) => return Err(Stop::Interrupted),
                _ => note("GLOMAP found no poses: COLMAP tries it"),
            }
        }
        self.run_mapper(COLMAP, &place.make(&format!("{FOLDER}/models"))?, total)
    }

    /// Runs the mapper of a program. COLMAP prints each registered image and restarts the count for each model.
    fn run_mapper(&self, program: Program, models: &Path, total: usize) -> Work<Vec<(PathBuf, Capture)>> {
        let mut command = program.command();
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
        program.run(&mut command, Some(NO_MODEL), |line| {
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

/// Writes a list for COLMAP.
fn write(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).map_err(|e| Error::file(path, format!("cannot be written: {e}")))
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
