//! Files of a run: `config.json`, `model.safetensors`, `metrics.jsonl`, `previews/`, `checkpoints/`, `summary.json`,
//! `lock`. Optional: `tensorboard/`, results of `raygrad eval`, renders, and the videos of `raygrad view` in `videos/`.

use std::fs::DirEntry;
use std::io::ErrorKind;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use raygrad::nerf::dataset::{Capture, HoldOut};
use raygrad::nerf::{Budget, Config, Error, Model, Result, SceneBox, write_atomic};
use raygrad::nn::TEMPORARY_PREFIX;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::cameras::Viewpoint;
use super::lock::{Lock, State};
use super::output::{checksum, make_folder, parent, quoted, remove};
use super::scene::{Opened, Scene};
use super::scratch;

/// Default folder of a run. Further runs use `run-2`, `run-3` ...
const DEFAULT: &str = "run";

/// File of the run's [`Lock`].
const LOCK: &str = "lock";
const OWNER: &str = "lock.owner";

/// Numbers of checkpoints to keep. The minimum is the default: the second one is the backup of a damaged last one.
pub const CHECKPOINTS: RangeInclusive<usize> = 2..=1 << 14;

/// Files that training writes in a run's folder. Evaluations (`eval-..`) are added to them.
const OWN: [&str; 9] = [
    "config.json",
    "model.safetensors",
    "metrics.jsonl",
    "summary.json",
    LOCK,
    OWNER,
    "checkpoints",
    "previews",
    "tensorboard",
];

/// Configuration of a run: `config.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Version of raygrad that trained the run last.
    pub raygrad: String,
    /// Source of the images.
    pub scene: Scene,
    /// Factor by which the image size was divided. Range: 1 or more.
    pub downscale: usize,
    /// File that describes the capture, below the scene's folder; null for built-in scenes.
    #[serde(default)]
    pub description: Option<PathBuf>,
    /// Test images that the run holds out; null for the choice of the files.
    #[serde(default)]
    pub test: Option<HoldOut>,
    /// Whether masks cut out an object: masked pixels are transparent instead of ignored.
    #[serde(default)]
    pub mask_as_alpha: bool,
    /// Scene box, and the scene transform that placed the capture in it.
    #[serde(alias = "extent")]
    pub scene_box: SceneBox,
    /// Average training camera. Orbits start from it.
    pub viewpoint: Viewpoint,
    /// Names of the training images.
    #[serde(default, alias = "photographs")]
    pub images: Vec<String>,
    /// Training budget. Runs of the first version have none.
    #[serde(default)]
    pub budget: Option<Budget>,
    /// Number of checkpoints to keep. Range: 2 to 16384.
    #[serde(default = "usual_checkpoints")]
    pub keep_checkpoints: usize,
    /// Model and training settings. `--set` takes its keys.
    pub config: Config,
}

/// Default number of checkpoints to keep.
pub fn usual_checkpoints() -> usize {
    *CHECKPOINTS.start()
}

/// A run on disk.
#[derive(Debug, Clone)]
pub struct Run {
    /// The folder.
    pub folder: PathBuf,
    /// The contents of `config.json`.
    pub config: RunConfig,
}

impl Run {
    /// Creates and [locks](Self::lock) the folder of a new run, which [`choose_folder`] has chosen.
    ///
    /// # Errors
    ///
    /// Fails if it is not writable, another program has created a run there meanwhile, or the configuration is one that
    /// [`open`](Self::open) refuses.
    pub fn create(folder: PathBuf, config: RunConfig) -> Result<(Run, Lock)> {
        config.check()?;
        make_folder(&folder)?;
        let run = Run { folder, config };
        let lock = run.lock()?;
        if run.file("config.json").exists() {
            drop(lock);
            return Err(holds_a_run(&run.folder));
        }
        run.write()?;
        Ok((run, lock))
    }

    /// Writes `config.json`.
    pub fn write(&self) -> Result<()> {
        write_json(&self.file("config.json"), &self.config)
    }

    /// Opens the run in a folder.
    pub fn open(folder: &Path) -> Result<Run> {
        if !folder.is_dir() {
            let what = if folder.exists() { "is not a folder" } else { "there is no such folder" };
            return Err(Error::file(folder, what));
        }
        let file = folder.join("config.json");
        let text = std::fs::read_to_string(&file).map_err(|e| match e.kind() {
            ErrorKind::NotFound => {
                Error::file(folder, "is not a run: it has no config.json; `raygrad train` creates runs")
            }
            _ => Error::file(&file, format!("cannot be read: {e}")),
        })?;
        let config: RunConfig = serde_json::from_str(&text).map_err(|e| match later_version(&text) {
            Some(version) => {
                let own = env!("CARGO_PKG_VERSION");
                Error::file(
                    &file,
                    format!("raygrad {version} wrote it, and this is raygrad {own}: use {version} or newer ({e})"),
                )
            }
            None => Error::file(&file, format!("not a run's configuration: {e}")),
        })?;
        config.check().map_err(|e| Error::file(&file, e))?;
        Ok(Run { folder: folder.into(), config })
    }

    /// Locks the run against training by other programs.
    pub fn lock(&self) -> Result<Lock> {
        Lock::take(&self.file(LOCK), || Error::file(&self.folder, "another raygrad is training it: wait until it ends"))
    }

    /// Checks before each write that this program still owns the folder. If the folder was removed or moved, creates it
    /// again with `config.json` and returns true.
    ///
    /// # Errors
    ///
    /// Fails if another program owns the folder or its path, or it cannot be created.
    pub fn keep(&self, lock: &mut Lock) -> Result<bool> {
        let lost = || {
            let what = "training stopped: another raygrad now uses this folder. This one wrote nothing more to it. \
                        If the run was moved, resume it there with `raygrad train --resume`";
            Error::file(&self.folder, what)
        };
        match lock.state() {
            State::Kept => return Ok(false),
            State::Lost => return Err(lost()),
            State::Gone => {}
        }
        make_folder(&self.folder)?;
        *lock = Lock::take(&self.file(LOCK), lost)?;
        if self.file("config.json").exists() {
            return Ok(false);
        }
        self.write()?;
        Ok(true)
    }

    /// Removes temporary files and folders of killed commands.
    pub fn sweep(&self) {
        let folders = ["", "checkpoints", "previews", "tensorboard", "videos"].map(|name| self.file(name));
        folders.iter().for_each(|folder| scratch::sweep(folder));
        // Another program may be making a video, so files beside videos stay for a day.
        let videos = self.file("videos");
        let is_old = |path: &PathBuf| {
            let age = path.symlink_metadata().and_then(|about| about.modified()).map(|time| time.elapsed());
            age.is_ok_and(|age| age.is_ok_and(|age| age > DAY))
        };
        let is_swept =
            |path: &PathBuf| (!path.is_dir() || path.is_symlink()) && (path.parent() != Some(&videos) || is_old(path));
        let entries = folders.iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flatten().flatten();
        let files = entries.filter(is_unfinished).map(|entry| entry.path()).filter(is_swept);
        remove(&files.collect::<Vec<_>>());
    }

    /// The path of a file of the run.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// The name of the folder.
    pub fn name(&self) -> String {
        let whole = self.folder.canonicalize().unwrap_or_else(|_| self.folder.clone());
        whole.file_name().map_or_else(|| self.folder.display().to_string(), |name| name.to_string_lossy().into_owned())
    }

    /// The canonical path of the folder, which identifies the run.
    pub fn identity(&self) -> String {
        self.folder.canonicalize().unwrap_or_else(|_| self.folder.clone()).to_string_lossy().into_owned()
    }

    /// The file of the parameters.
    pub fn model_file(&self) -> PathBuf {
        self.file("model.safetensors")
    }

    /// Returns true if the file that the run was trained on is gone from its folder: another would have other cameras.
    fn lacks_description(&self, folder: &Path) -> bool {
        folder.is_dir() && self.config.description.as_ref().is_some_and(|file| !folder.join(file).is_file())
    }

    /// The scene of the images: `given`, or else the one of training.
    pub fn scene<'a>(&'a self, given: Option<&'a Scene>) -> Result<&'a Scene> {
        match (given, &self.config.scene) {
            (None, Scene::Folder(folder)) if !folder.exists() => {
                Err(Error::file(folder, "the run's images are no longer here: name their folder with --scene"))
            }
            (None, Scene::Folder(folder)) if self.lacks_description(folder) => {
                let file = folder.join(self.config.description.as_deref().unwrap_or(Path::new("")));
                let what = "the run was trained on this file, which is no longer here: put it back, or name another \
                            capture with --scene";
                Err(Error::file(file, what))
            }
            (given, trained) => Ok(given.unwrap_or(trained)),
        }
    }

    /// Reads the cameras of [`scene`](Self::scene), with the splits of the run.
    pub fn capture(&self, given: Option<&Scene>) -> Result<Capture> {
        self.scene(given)?.capture(self.config.test.as_ref(), self.config.description.as_deref())
    }

    /// Opens [`scene`](Self::scene) with the scene transform, the splits and the masks of the run.
    pub fn open_scene(&self, given: Option<&Scene>) -> Result<Opened> {
        let RunConfig { scene_box, config, test, mask_as_alpha, description, .. } = &self.config;
        let mut opened =
            self.scene(given)?.open_for(scene_box, config.unbounded, test.as_ref(), description.as_deref())?;
        opened.mask_as_alpha = *mask_as_alpha;
        Ok(opened)
    }

    /// Fails if training was stopped before its first step, or the file was not copied.
    fn check_model(&self) -> Result<()> {
        if self.model_file().exists() {
            return Ok(());
        }
        let resume = format!("raygrad train --resume {}", quoted(&self.folder));
        let what = format!("has no model.safetensors; `{resume}` writes it, from the last checkpoint if there is one");
        Err(Error::file(&self.folder, what))
    }

    /// The CRC-32 of model and configuration.
    pub fn checksums(&self) -> Result<[String; 2]> {
        self.check_model()?;
        Ok([checksum(&self.model_file())?, checksum(&self.file("config.json"))?])
    }

    /// Loads the last saved model.
    pub fn model(&self) -> Result<Model<f32>> {
        self.check_model()?;
        Model::load(self.model_file(), self.config.config.clone(), self.config.scene_box)
    }
}

/// The version of raygrad in a run's configuration, if it is later than this one.
fn later_version(config: &str) -> Option<String> {
    let value: Value = serde_json::from_str(config).ok()?;
    let made_by = value.get("raygrad")?.as_str()?;
    let parts = |version: &str| {
        version.split(['.', '-', '+']).take(3).map(|part| part.parse().ok()).collect::<Option<Vec<u64>>>()
    };
    (parts(made_by)? > parts(env!("CARGO_PKG_VERSION"))?).then(|| made_by.to_owned())
}

impl RunConfig {
    /// Fails if a number is out of range. The model checks its own numbers.
    pub fn check(&self) -> Result<()> {
        if self.downscale == 0 {
            return Err(Error::setting("downscale", "is 0; use 1 or more"));
        }
        self.scene_box.check()?;
        let kept = self.keep_checkpoints;
        if !CHECKPOINTS.contains(&kept) {
            let (fewest, most) = CHECKPOINTS.into_inner();
            return Err(Error::setting("keep_checkpoints", format!("is {kept}; use {fewest} to {most}")));
        }
        self.config.check()?;
        self.viewpoint.check()
    }
}

/// Checks that an output path is not a file or folder of a run.
///
/// # Errors
///
/// Fails if it is one, since the output would destroy the run.
pub fn check_output(out: &Path) -> Result<()> {
    // Links are resolved. A path that does not exist is not part of a run.
    let Ok(folder) = parent(out).canonicalize() else { return Ok(()) };
    let Some(name) = out.file_name() else { return Ok(()) };
    let (mut name, mut folder) = (PathBuf::from(name), folder.as_path());
    loop {
        let first = name.to_string_lossy().to_ascii_lowercase();
        let is_own = OWN.contains(&first.as_str()) || first.starts_with("eval-");
        if is_own && ["config.json", "model.safetensors"].iter().all(|file| folder.join(file).is_file()) {
            return Err(Error::file(out, format!("`{first}` belongs to a run: choose another name")));
        }
        let Some((parent, last)) = folder.parent().zip(folder.file_name()) else { return Ok(()) };
        (name, folder) = (last.into(), parent);
    }
}

/// Writes a value as JSON and replaces the file atomically.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let mut text = serde_json::to_string_pretty(value).map_err(|e| Error::file(path, e))?;
    text.push('\n');
    write_atomic(path, text.as_bytes())
}

/// Chooses the folder of a new run: `wanted`, or else the first free one of `run`, `run-2`, `run-3` ... An existing run
/// is never replaced.
pub fn choose_folder(wanted: Option<&Path>) -> Result<PathBuf> {
    if let Some(folder) = wanted {
        return match contents(folder)? {
            Contents::Nothing => Ok(folder.into()),
            Contents::Run => Err(holds_a_run(folder)),
            Contents::Other => Err(holds_other_files(folder)),
        };
    }
    let numbered = (2..).map(|i| format!("{DEFAULT}-{i}"));
    for folder in std::iter::once(DEFAULT.to_owned()).chain(numbered).map(PathBuf::from) {
        match contents(&folder)? {
            Contents::Nothing => return Ok(folder),
            Contents::Run => (),
            Contents::Other => return Err(holds_other_files(&folder)),
        }
    }
    unreachable!("there is no end to the numbers")
}

/// The error for a folder that holds a run. A run in training would create its folder again after removal.
fn holds_a_run(folder: &Path) -> Error {
    match Lock::is_taken(&folder.join(LOCK)) {
        true => Error::file(folder, "another raygrad is training it: stop that one or choose another --out"),
        false => Error::file(folder, "already holds a run: choose another --out, or continue it with --resume"),
    }
}

fn holds_other_files(folder: &Path) -> Error {
    Error::file(folder, "holds files that do not belong to a run: choose another folder with --out")
}

/// Returns true for files that a program leaves if it ends before its run begins.
fn is_nothing(entry: &DirEntry) -> bool {
    is_unfinished(entry) || [LOCK, OWNER].iter().any(|name| entry.file_name() == *name)
}

const DAY: Duration = Duration::from_secs(24 * 3600);

/// Returns true for temporary files of unfinished writes.
fn is_unfinished(entry: &DirEntry) -> bool {
    entry.file_name().to_string_lossy().starts_with(TEMPORARY_PREFIX)
}

/// Contents of a path.
enum Contents {
    /// Nothing, or a folder without finished files.
    Nothing,
    Run,
    Other,
}

fn contents(folder: &Path) -> Result<Contents> {
    if folder.join("config.json").is_file() {
        return Ok(Contents::Run);
    }
    match std::fs::read_dir(folder) {
        // Temporary files of a killed program do not count.
        Ok(mut entries) => Ok(match entries.any(|entry| !entry.is_ok_and(|entry| is_nothing(&entry))) {
            true => Contents::Other,
            false => Contents::Nothing,
        }),
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(Contents::Nothing),
        Err(e) => Err(Error::file(folder, format!("cannot be used as the run's folder: {e}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::glam::DVec3;
    use raygrad::nerf::losses::DistortionConfig;
    use raygrad::nerf::space::occupancy::Skip;
    use raygrad::nerf::{GroupConfig, LossTermConfig, Preset};

    #[test]
    fn open_later_version_names_it() {
        let later = |text: &str| later_version(text);
        assert_eq!(later(r#"{"raygrad":"999.0.1","new":[]}"#).as_deref(), Some("999.0.1"));
        assert_eq!(later(r#"{"raygrad":"0.999.0-rc1"}"#).as_deref(), Some("0.999.0-rc1"));
        for text in [r#"{"raygrad":"0.0.999"}"#, r#"{"raygrad":"x"}"#, r#"{"raygrad":3}"#, "{}", "[", "[]"] {
            assert_eq!(later(text), None, "{text}");
        }
        assert_eq!(later(&format!(r#"{{"raygrad":"{}"}}"#, env!("CARGO_PKG_VERSION"))), None);
    }
    /// Keys of `config.json` before they were renamed.
    const OLD_KEYS: [(&str, &str); 12] = [
        ("scene_box", "extent"),
        ("near_far", "span"),
        ("transform", "placement"),
        ("loss_terms", "terms"),
        ("camera_optimizer", "refine"),
        ("exposure_model", "tone"),
        ("gradient_scaling_distance", "near_gradients"),
        ("appearance_embedding_dim", "codes"),
        ("skip_layers", "skips"),
        ("early_stop_eps", "termination"),
        ("weight_decay", "decay"),
        ("eps", "epsilon"),
    ];

    /// The JSON value with the keys and words of earlier versions. `found` counts each of them.
    fn aged(value: Value, found: &mut [usize]) -> Value {
        let mut old = |text: &str| match OLD_KEYS.iter().position(|(new, _)| *new == text) {
            Some(i) => {
                found[i] += 1;
                OLD_KEYS[i].1.to_owned()
            }
            None => text.to_owned(),
        };
        match value {
            Value::String(text) => Value::String(old(&text)),
            Value::Array(values) => values.into_iter().map(|value| aged(value, found)).collect(),
            Value::Object(fields) => {
                let names: Vec<String> = fields.keys().map(|name| old(name)).collect();
                let values: Vec<Value> = fields.into_iter().map(|(_, value)| aged(value, found)).collect();
                Value::Object(names.into_iter().zip(values).collect())
            }
            other => other,
        }
    }

    #[test]
    fn open_config_with_old_keys_succeeds() {
        let viewpoint =
            Viewpoint { width: 8, height: 6, angle_x: 0.7, distance: 4.0, elevation: 0.5, azimuth: 0.0, reach: 1.0 };
        let mut found = [0; OLD_KEYS.len()];
        for preset in [Preset::Classic, Preset::Small, Preset::Instant, Preset::Voxel] {
            let mut config = Config::preset(preset).with_skip(Skip::NearLossless);
            config.gradient_scaling_distance = 0.25;
            config.loss_terms = vec![LossTermConfig::new(DistortionConfig { weight: 0.5 })];
            config.exposure_model.vignetting = config.poses;
            let group =
                GroupConfig { params: "field".into(), adam: config.adam, schedule: config.schedule, weight_decay: 0.5 };
            config.groups.push(group);
            let config = RunConfig {
                raygrad: "0.1.0".into(),
                scene: Scene::Embedded,
                downscale: 2,
                description: None,
                test: None,
                mask_as_alpha: false,
                scene_box: SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.5, 4.0]),
                viewpoint,
                images: vec![],
                budget: Some(Budget::Steps(7)),
                keep_checkpoints: 3,
                config,
            };
            let text = serde_json::to_string(&config).unwrap();
            let value: Value = serde_json::from_str(&text).unwrap();
            let old = aged(value, &mut found);
            assert_eq!(serde_json::from_value::<RunConfig>(old).unwrap(), config, "{preset}");
        }
        assert!(found.iter().all(|count| *count > 0), "{found:?}");
        assert_eq!(serde_json::from_str::<Skip>(r#""lossless""#).unwrap(), Skip::NearLossless);
    }
}
