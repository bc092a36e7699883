//! Sources of images.

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::{
    AutomaticDownscale, Capture, Dataset, Format, Frame, HoldOut, LoadOptions, SceneAnalysis, SceneType, Split,
    evenly_spaced,
};
use raygrad::nerf::{Error, Result, SceneBox};
use raygrad_scenes::landscape_distances;
use serde::{Deserialize, Serialize};

use super::builtin;
use super::output::{complain, quoted};
use super::parse;
use super::progress::Progress;

/// Width and height of the embedded scene's images in pixels.
pub const EMBEDDED_SIZE: usize = 200;
/// Width and height of the landscape's images in pixels.
pub const LANDSCAPE_SIZE: [usize; 2] = [400, 300];

/// How the files of a capture are read.
#[derive(Default, clap::Args)]
pub struct CaptureArgs {
    /// Test images: none, every:N, or names
    ///
    /// Holds these images out of training, in place of the choice of the capture's files. every:8 holds out every
    /// eighth by name, which is the default where the capture has no splits. Example: --test frame_3.jpg,frame_9.jpg
    #[arg(long, help_heading = "Scene", value_name = "IMAGES", value_parser = parse::word::<HoldOut>)]
    pub test: Option<HoldOut>,
    /// transforms, blender, colmap or llff
    ///
    /// Chooses the files to read if a folder has several descriptions of a capture. By default the one with most
    /// images counts. The path of a description, such as my-scene/sparse/1/images.bin, chooses it too.
    #[arg(long, help_heading = "Scene", value_name = "FORMAT", value_parser = parse::word::<Format>)]
    pub format: Option<Format>,
    /// bounded, unbounded or forward-facing
    ///
    /// bounded: an object in front of an empty background. unbounded: the images show the surroundings.
    /// forward-facing: unbounded, and all cameras look the same way. By default raygrad infers the type from images
    /// and cameras, and prints it with the reason.
    #[arg(long, help_heading = "Scene", value_name = "TYPE", value_parser = parse::word::<SceneType>)]
    pub scene_type: Option<SceneType>,
    /// Masks cut out an object: make the rest transparent
    ///
    /// Without the flag, pixels that a mask hides are ignored, and the model may put anything there. With it, the
    /// model learns that nothing is there. Every image needs a mask or transparency.
    #[arg(long, help_heading = "Scene")]
    pub mask_as_alpha: bool,
}

impl CaptureArgs {
    /// Reads the capture of a folder.
    pub fn read(&self, folder: &Path) -> Result<Capture> {
        // The splits of the files are not used.
        let Some(chosen) = &self.test else { return Capture::read_format(folder, self.format) };
        let mut capture = Capture::read_unsplit(folder, None, self.format)?;
        capture.hold_out(chosen)?;
        Ok(capture)
    }

    /// Finds the scene of a capture.
    pub fn analyze(&self, capture: &Capture) -> Result<SceneAnalysis> {
        match self.mask_as_alpha {
            true => capture.analyze_cutout(self.scene_type),
            false => capture.analyze_scene(self.scene_type),
        }
    }

    /// These flags as they were given, each after a blank.
    pub fn flags(&self) -> String {
        let test = self.test.as_ref().map(|test| format!(" --test {}", quoted(Path::new(&test.to_string()))));
        let format = self.format.map(|format| format!(" --format {}", format.word()));
        let scene_type = self.scene_type.map(|scene_type| format!(" --scene-type {scene_type}"));
        let masks = self.mask_as_alpha.then(|| " --mask-as-alpha".to_owned());
        [test, format, scene_type, masks].into_iter().flatten().collect()
    }
}

/// A folder of images, or a built-in scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scene {
    /// The built-in bulldozer.
    Embedded,
    /// The built-in bulldozer in an unbounded landscape.
    Landscape,
    /// Path of a capture folder.
    Folder(PathBuf),
}

impl From<OsString> for Scene {
    /// `embedded` and `landscape` are the built-in scenes (a folder of that name is `./embedded`). All else is a
    /// folder.
    fn from(text: OsString) -> Self {
        match text.to_str() {
            Some("embedded") => Scene::Embedded,
            Some("landscape") => Scene::Landscape,
            _ => Scene::Folder(text.into()),
        }
    }
}

impl fmt::Display for Scene {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Scene::Embedded => f.write_str("embedded"),
            Scene::Landscape => f.write_str("landscape"),
            Scene::Folder(folder) => folder.display().fmt(f),
        }
    }
}

impl Scene {
    /// Reads the scene's files and analyses the scene.
    pub fn open(&self, args: &CaptureArgs) -> Result<Opened> {
        let CaptureArgs { test, format, scene_type, mask_as_alpha } = args;
        let Scene::Folder(folder) = self else {
            if format.is_some() {
                return Err(Error::setting("format", "built-in scenes have no files: leave the flag out"));
            }
            if *mask_as_alpha {
                return Err(Error::setting("mask-as-alpha", "built-in scenes have no masks: leave the flag out"));
            }
            if test.is_some() {
                return Err(Error::setting("test", "built-in scenes have their own test images: leave the flag out"));
            }
            return Ok(Opened::new(self, None, *scene_type));
        };
        let capture = args.read(folder)?;
        assumptions(&capture);
        let analysis = args.analyze(&capture)?;
        Ok(Opened { mask_as_alpha: *mask_as_alpha, ..Opened::new(self, Some((capture, analysis)), *scene_type) })
    }

    /// Reads the capture of a folder, or builds that of a built-in scene without images, and prints what the reader
    /// assumed. `hold_out` replaces the splits; `description` is the file to read, below the folder.
    pub fn capture(&self, hold_out: Option<&HoldOut>, description: Option<&Path>) -> Result<Capture> {
        let mut capture = match self {
            Scene::Folder(folder) => {
                let file = description.map(|file| folder.join(file)).filter(|file| file.is_file());
                match file {
                    // The splits of the files are not used.
                    file if hold_out.is_some() => Capture::read_unsplit(folder, file.as_deref(), None)?,
                    Some(file) => Capture::read_description(folder, file)?,
                    None => Capture::read(folder)?,
                }
            }
            built_in => builtin::capture(built_in, None, None)?,
        };
        assumptions(&capture);
        hold_out.map_or(Ok(()), |chosen| capture.hold_out(chosen))?;
        Ok(capture)
    }

    /// Like [`open`](Self::open), with the scene transform of a model. `unbounded` is true for an unbounded scene.
    pub fn open_for(
        &self,
        extent: &SceneBox,
        unbounded: bool,
        hold_out: Option<&HoldOut>,
        description: Option<&Path>,
    ) -> Result<Opened> {
        if !matches!(self, Scene::Folder(_)) {
            return Ok(Opened::new(self, None, None));
        }
        let SceneBox { transform, bounds, near_far: [near, far], ndc, .. } = *extent;
        let scene_type = match (unbounded, ndc) {
            (false, _) => SceneType::Bounded,
            (true, None) => SceneType::Unbounded,
            (true, Some(_)) => SceneType::ForwardFacing,
        };
        let reason = "as in training".to_owned();
        let (empty, hollow) = (None, false);
        let analysis = SceneAnalysis { transform, scene_type, bounds, near, far, ndc, empty, hollow, reason };
        Ok(Opened::new(self, Some((self.capture(hold_out, description)?, analysis)), None))
    }

    /// The same scene with an absolute path.
    pub fn absolute(&self) -> Result<Scene> {
        match self {
            Scene::Embedded | Scene::Landscape => Ok(self.clone()),
            Scene::Folder(folder) => std::path::absolute(folder).map(Scene::Folder).map_err(|e| Error::file(folder, e)),
        }
    }
}

/// A scene whose files are read, except for the images.
pub struct Opened {
    /// True to load measured depths with the images.
    pub depth: bool,
    /// True if masks become alpha.
    pub mask_as_alpha: bool,
    scene: Scene,
    /// Capture and analysis of a folder.
    pub capture: Option<(Capture, SceneAnalysis)>,
    /// Requested scene type.
    asked: Option<SceneType>,
}

impl Opened {
    fn new(scene: &Scene, capture: Option<(Capture, SceneAnalysis)>, asked: Option<SceneType>) -> Self {
        Opened { depth: false, mask_as_alpha: false, scene: scene.clone(), capture, asked }
    }

    /// The file that describes the capture, below its folder.
    pub fn description(&self) -> Option<PathBuf> {
        inside(&self.scene, &self.capture.as_ref()?.0)
    }

    /// The factor that brings images to a size that suits a grid with at most `cells` cells along a scene of this type; 1
    /// for built-in scenes.
    pub fn automatic_downscale(&self, cells: impl FnOnce(SceneType) -> Result<f64>) -> Result<AutomaticDownscale> {
        let Some((capture, analysis)) = &self.capture else { return Ok(AutomaticDownscale { factor: 1, limit: None }) };
        Ok(capture.automatic_downscale(analysis, cells(analysis.scene_type)?))
    }

    /// Loads at most `views` evenly spaced images of a split at `1 / downscale` of their size. Warns of images that are
    /// left out.
    pub fn load(&self, split: Split, downscale: usize, views: usize) -> Result<Dataset> {
        let data = self.load_quietly(split, downscale, views)?;
        let rest = data.frames.len();
        let left_out = [
            left_out(&data.skipped, rest + data.masked.len(), "missing"),
            left_out(&data.masked, rest, "masked as a whole"),
        ];
        left_out.iter().flatten().for_each(|what| complain(&format!("warning: {}: {what}", self.scene)));
        Ok(data)
    }

    /// [`load`](Self::load) without a warning.
    pub fn load_quietly(&self, split: Split, downscale: usize, views: usize) -> Result<Dataset> {
        match &self.capture {
            None => {
                let is_landscape = self.scene == Scene::Landscape;
                let size = if is_landscape { LANDSCAPE_SIZE } else { [EMBEDDED_SIZE; 2] };
                divides(downscale, size)?;
                let mut data = builtin::images(&self.scene, split, size[0] / downscale);
                if is_landscape && self.depth {
                    let measure = |frame: &mut Frame| frame.distances = Some(landscape_distances(&frame.camera));
                    data.frames.iter_mut().for_each(measure);
                }
                Ok(Dataset {
                    frames: evenly_spaced(data.frames, views),
                    scene_type: self.asked.unwrap_or(data.scene_type),
                    ..data
                })
            }
            Some((capture, analysis)) => {
                let (progress, words) = (Progress::new(), format!("{split} images read"));
                let show = |done: usize, total: usize| progress.count(done, total, &words);
                let mask_as_alpha = self.mask_as_alpha;
                capture.load(
                    split,
                    analysis,
                    &LoadOptions {
                        downscale,
                        views,
                        distances: self.depth,
                        mask_as_alpha,
                        memory: None,
                        progress: &show,
                    },
                )
            }
        }
    }
}

/// Prints the assumptions of a capture's reader, one line each.
pub fn assumptions(capture: &Capture) {
    capture.assumptions.iter().for_each(|what| complain(&format!("note: {what}")));
}

/// The file of a capture below the folder of its scene; `None` if the capture is in another folder, where reading the
/// scene finds it again.
fn inside(scene: &Scene, capture: &Capture) -> Option<PathBuf> {
    let Scene::Folder(folder) = scene else { return None };
    let [own, found] = [folder, &capture.folder].map(|folder| folder.canonicalize().ok());
    // Where the scene is a file, that names the capture.
    let is_own = folder.is_file() || own.is_some() && own == found;
    Some(capture.file.strip_prefix(&capture.folder).ok().filter(|_| is_own)?.to_owned())
}

/// Says why images are left out, of which at most three are named. There are `others` besides.
fn left_out(skipped: &[String], others: usize, why: &str) -> Option<String> {
    /// Names that are listed.
    const NAMED: usize = 3;
    let named = skipped.iter().take(NAMED).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
    match (skipped.len(), skipped.len() + others) {
        (0, _) => None,
        (1, all) => Some(format!("1 of {all} images is {why} and was skipped: {named}")),
        (count, all) => {
            let rest = if count > NAMED { ", ..." } else { "" };
            Some(format!("{count} of {all} images are {why} and were skipped: {named}{rest}"))
        }
    }
}

/// Fails if images of this size cannot be downscaled by the factor.
fn divides(downscale: usize, [width, height]: [usize; 2]) -> Result<()> {
    if width.is_multiple_of(downscale) && height.is_multiple_of(downscale) {
        return Ok(());
    }
    Err(Error::setting("downscale", format!("{downscale} does not divide the image size {width}x{height}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::Image;
    use serde_json::json;

    #[test]
    fn chosen_test_images_replace_wrong_splits() {
        let folder = tempfile::tempdir().unwrap();
        let frame = |i: usize| {
            Image::new(8, 6, 3).save_png(folder.path().join(format!("{i}.png"))).unwrap();
            let matrix = json!([[1, 0, 0, i], [0, 1, 0, i * i % 3], [0, 0, 1, 4], [0, 0, 0, 1]]);
            json!({ "file_path": format!("{i}.png"), "transform_matrix": matrix })
        };
        let transforms = json!({
            "fl_x": 9.0, "frames": (0..4).map(frame).collect::<Vec<_>>(),
            "train_filenames": ["0.png", "1.png"], "test_filenames": ["1.png", "gone.png"]
        });
        std::fs::write(folder.path().join("transforms.json"), transforms.to_string()).unwrap();
        let scene = Scene::Folder(folder.path().to_owned());
        let message = scene.open(&CaptureArgs::default()).err().unwrap().to_string();
        let remedy = "has too: remove it from one of them; `raygrad train --test` chooses other test images";
        assert!(message.ends_with(remedy), "{message}");
        for format in [None, Some(Format::Transforms)] {
            let args = CaptureArgs { test: Some(HoldOut::Every(2)), format, ..CaptureArgs::default() };
            let opened = scene.open(&args).unwrap();
            assert_eq!(args.read(folder.path()).unwrap().split(Split::Train).unwrap().len(), 2);
            let names = |split| {
                let frames = opened.load(split, 1, usize::MAX).unwrap().frames;
                frames.into_iter().map(|frame| frame.name).collect::<Vec<_>>()
            };
            assert_eq!([names(Split::Train), names(Split::Test)], [["1.png", "3.png"], ["0.png", "2.png"]]);
        }
    }

    /// What is below another folder would be looked for in the scene's, where another file may have its path.
    #[test]
    fn description_is_below_the_folder_of_the_scene() {
        let folder = tempfile::tempdir().unwrap();
        let inner = folder.path().join("dense/0");
        std::fs::create_dir_all(&inner).unwrap();
        let scene = Scene::Folder(folder.path().to_owned());
        let of = |folder: &Path| {
            let capture = Capture::new(folder, folder.join("sparse/0/images.bin"), Format::Colmap, vec![]);
            inside(&scene, &capture)
        };
        assert_eq!(of(folder.path()), Some("sparse/0/images.bin".into()));
        assert_eq!(of(&folder.path().join("dense/..")), Some("sparse/0/images.bin".into()));
        assert_eq!(of(&inner), None);
        let file = folder.path().join("transforms_b.json");
        std::fs::write(&file, "{}").unwrap();
        let capture = Capture::new(folder.path(), file.clone(), Format::Transforms, vec![]);
        assert_eq!(inside(&Scene::Folder(file), &capture), Some("transforms_b.json".into()));
        assert_eq!(inside(&Scene::Embedded, &Capture::new(&inner, inner.join("a"), Format::Colmap, vec![])), None);
    }

    #[test]
    fn masks_as_alpha_are_loaded_as_an_object() {
        let folder = tempfile::tempdir().unwrap();
        let frame = |i: usize| {
            let mut mask = Image { width: 8, height: 6, channels: 1, data: vec![1.0; 48] };
            Image::new(8, 6, 3).save_png(folder.path().join(format!("{i}.png"))).unwrap();
            mask.pixel_mut(3, 2)[0] = 0.0;
            mask.save_png(folder.path().join(format!("mask{i}.png"))).unwrap();
            let matrix = json!([[1, 0, 0, i], [0, 1, 0, i * i % 3], [0, 0, 1, 4], [0, 0, 0, 1]]);
            json!({ "file_path": format!("{i}.png"), "mask_path": format!("mask{i}.png"), "transform_matrix": matrix })
        };
        let transforms = json!({ "fl_x": 9.0, "frames": (0..3).map(frame).collect::<Vec<_>>() });
        std::fs::write(folder.path().join("transforms.json"), transforms.to_string()).unwrap();
        let scene = Scene::Folder(folder.path().to_owned());
        for mask_as_alpha in [false, true] {
            let opened = scene.open(&CaptureArgs { mask_as_alpha, ..CaptureArgs::default() }).unwrap();
            let data = opened.load(Split::Train, 1, usize::MAX).unwrap();
            assert_eq!(data.scene_type == SceneType::Bounded, mask_as_alpha);
            let frame = &data.frames[0];
            assert_eq!((frame.image.has_alpha(), frame.mask.is_some()), (mask_as_alpha, !mask_as_alpha));
            let [hidden, used] = [[3, 2], [4, 2]].map(|[x, y]| frame.image.pixel(x, y)[3]);
            assert_eq!((hidden, used), (f32::from(u8::from(!mask_as_alpha)), 1.0));
        }
        let flags = CaptureArgs {
            test: Some(HoldOut::Images(vec!["my shot.jpg".into()])),
            format: Some(Format::Colmap),
            scene_type: Some(SceneType::ForwardFacing),
            mask_as_alpha: true,
        };
        let expected = " --test 'my shot.jpg' --format colmap --scene-type forward-facing --mask-as-alpha";
        assert_eq!(flags.flags(), expected);
        let message = Scene::Embedded.open(&CaptureArgs { format: None, ..flags }).err().unwrap().to_string();
        assert_eq!(message, "`mask-as-alpha`: built-in scenes have no masks: leave the flag out");
    }
}
