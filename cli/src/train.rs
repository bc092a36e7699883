//! `raygrad train`: trains a model on the images of a capture.

mod config;

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use raygrad::Schedule;
use raygrad::nerf::dataset::{AutomaticDownscale, Dataset, DownscaleLimit, Split};
use raygrad::nerf::model::RefinedParam;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Background, Budget, Error, Preset, Result, StepStats, Trainer, available_memory};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::interrupt::Work;
use super::lock::Lock;
use super::output::{complain, print, quoted};
use super::prepare::beside;
use super::preview::Preview;
use super::progress::spoken;
use super::run::{CHECKPOINTS, Run, RunConfig, choose_folder};
use super::scene::{CaptureArgs, Opened, Scene};
use super::summary::Ended;
use super::view::{Listener, PlaceArgs, TrainingViewer};
use super::watch::Watch;
use super::{checkpoint, doctor, interrupt, machine, memory, parse, ranks, watch};
use config::set_near;

#[cfg(test)]
pub use config::changed;

/// How often a run that has diverged goes back to its last checkpoint.
const RETREATS: u32 = 3;
/// End of the message for a run that has used up its budget.
const FINISHED: &str = ", the end of its budget: add --steps or --budget with a larger total to train on";
/// The same if it is beyond the total that was given.
const BEYOND: &str = ", and the total that was given is not beyond it: totals count from the start of the run";

/// Options of new runs only.
const NEW: [&str; 19] = [
    "scene",
    "preset",
    "skip",
    "carve",
    "batch_scale",
    "seed",
    "downscale",
    "format",
    "test",
    "scene_type",
    "background",
    "refine",
    "depth_loss",
    "near",
    "mask_as_alpha",
    "loss",
    "out",
    "no_positional_encoding",
    "set",
];

/// Train a model on a scene
///
/// Ctrl-C finishes the current step, saves the model and exits with code 130. A second Ctrl-C exits at once.
/// `raygrad train --resume RUN` resumes the run.
///
/// Example: raygrad train my-scene --budget 10m --out my-run
#[derive(Parser)]
pub struct Args {
    /// Capture, image folder, video or built-in scene
    ///
    /// Built-in scenes: embedded and landscape.
    ///
    /// A video, or a folder of images without camera poses, is first made into a dataset beside it, as by `raygrad
    /// prepare`: walk.mp4 becomes walk.mp4-prepared. Later runs reuse that folder.
    ///
    /// raygrad reads transforms.json (nerfstudio, instant-ngp), transforms_train.json (Blender), sparse/0 (COLMAP)
    /// and poses_bounds.npy (LLFF).
    #[arg(default_value = "embedded")]
    scene: Scene,
    /// instant, voxel, small, classic
    ///
    /// instant: a hash grid, good within a minute. voxel: a dense grid without a network. small: a small MLP,
    /// minutes. classic: the networks of the NeRF paper, hours.
    #[arg(long, help_heading = "Model", default_value_t, value_parser = parse::word::<Preset>)]
    preset: Preset,
    /// Empty-space skipping: off, near-lossless, fast
    ///
    /// near-lossless changes a rendered colour by at most 0.6 % of its range, fast by at most 6 %. The default is
    /// fast for instant and voxel. small and classic sample hierarchically unless --skip is
    /// near-lossless or fast.
    #[arg(long, help_heading = "Model", value_parser = parse::word::<Skip>)]
    skip: Option<Skip>,
    /// Transparent images that empty a cell [default: 3]
    ///
    /// Visual hull carving: before training, cells become empty where at least N images are transparent. Of fewer
    /// than 17 images, one in eight is enough. 0 trusts no mask.
    #[arg(long, help_heading = "Scene", value_name = "N")]
    carve: Option<u32>,
    /// Training time: 90s, 10m or 1.5h
    ///
    /// Schedules stretch to the budget, and the hash table of an instant model grows with it. The default depends
    /// on the preset.
    #[arg(long, help_heading = "Time", value_name = "TIME", value_parser = parse::duration, conflicts_with = "steps")]
    budget: Option<Duration>,
    /// Training steps, instead of a time
    ///
    /// The same seed and number of steps give the same model, bit for bit, on processors with the same instruction set.
    #[arg(long, help_heading = "Time", value_name = "N", value_parser = parse::within(1u64..))]
    steps: Option<u64>,
    /// Enlarge training steps N times
    ///
    /// For machines with many cores. The samples or rays of a step, also if --set changes them, become N times as
    /// many, and learning rates grow by the square root of N. Range: 1 to 64.
    #[arg(long, help_heading = "Advanced", value_name = "N", default_value_t = 1, value_parser = parse::count(config::MOST_BATCH_SCALE))]
    batch_scale: usize,
    /// Random seed
    #[arg(long, help_heading = "Advanced", value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Divide the image size by K [default: automatic]
    ///
    /// A training pixel is the mean of the image pixels that it covers. The default brings the longest side to 1600
    /// pixels or less (panoramas: 6400), and all training images to about 3 GB or less. With a short budget it leaves
    /// as few as 800 pixels, since the model resolves no more. 1 keeps the size. Range: 1 to 16384.
    #[arg(long, help_heading = "Scene", value_name = "K", value_parser = parse::count(1 << 14))]
    downscale: Option<usize>,
    #[command(flatten)]
    capture: CaptureArgs,
    /// Background: white, black, random or expected
    ///
    /// Lies behind transparent images, and behind opaque ones too if given. The default for transparent images is
    /// expected with instant and voxel, and white with small and classic.
    #[arg(long, help_heading = "Scene", value_name = "COLOR", value_parser = parse::word::<Background>)]
    background: Option<Background>,
    /// Refine poses,focal,lens,exposure,vignetting
    ///
    /// Optimizes the listed parameters together with the scene: camera poses, focal lengths, lens coefficients,
    /// per-image exposure and white balance, vignetting. Example: --refine poses,focal
    #[arg(long, help_heading = "Model", value_name = "PARAMS", value_delimiter = ',', value_parser = parse::word::<RefinedParam>)]
    refine: Vec<RefinedParam>,
    /// Fit measured depths
    ///
    /// Adds a loss on depths measured along with the images (`depth_file_path` in transforms.json). Without a
    /// number its weight is 0.1. Example: --depth-loss=0.2
    #[arg(long, help_heading = "Model", value_name = "WEIGHT", num_args = 0..=1, require_equals = true, default_missing_value = "0.1")]
    depth_loss: Option<f64>,
    /// Near plane, in capture units
    ///
    /// Training places no samples closer to a camera. By default raygrad derives the near plane from cameras and
    /// points. Example: --near 0.2
    #[arg(long, help_heading = "Scene", value_name = "LENGTH")]
    near: Option<f64>,
    /// Add a loss term, such as distortion=0.1
    ///
    /// Terms: distortion (a ray's light comes from one place), entropy (a ray is opaque or empty), orientation
    /// (normals face the camera), depth. A weight of 0 removes the term. Give the flag several times for several terms.
    /// total_variation needs more than a weight: `--set 'loss_terms=[{"kind": "total_variation", ...}]'`.
    #[arg(long, help_heading = "Model", value_name = "NAME=WEIGHT", value_parser = parse::weight)]
    loss: Vec<(String, f64)>,
    /// Resume a run from its last checkpoint
    ///
    /// The run continues to the steps or budget that it was given. --steps or --budget beside --resume set a new
    /// total, counted from the start of the run. A total that the run is beyond changes nothing.
    #[arg(long, help_heading = "Time", value_name = "RUN", conflicts_with_all = NEW)]
    resume: Option<PathBuf>,
    /// With --resume: where the images are now
    #[arg(id = "moved", long = "scene", help_heading = "Scene", value_name = "SCENE")]
    moved: Option<Scene>,
    /// Time to wait for an MPI rank
    ///
    /// After this time without a message from a rank, the run ends with its number. It must be longer than rank 0
    /// needs to render a preview and to save. With --view, which can pause, ranks wait without limit.
    #[arg(long, help_heading = "Time", value_name = "TIME", value_parser = parse::duration, default_value = "10m")]
    rank_timeout: Duration,
    /// Time between checkpoints
    ///
    /// Measured in training time. --resume continues from the last checkpoint.
    #[arg(long, help_heading = "Time", value_name = "TIME", value_parser = parse::duration, default_value = "60s")]
    checkpoint_every: Duration,
    /// Checkpoints to keep
    ///
    /// At least 2: if the last one is damaged, the one before remains. `raygrad view` steps through the kept ones.
    /// A resumed run keeps as many as before. Range: 2 to 16384. [default: 2]
    #[arg(long, help_heading = "Time", value_name = "N", value_parser = parse::within(CHECKPOINTS))]
    keep_checkpoints: Option<usize>,
    /// Also write TensorBoard event files
    ///
    /// They go to RUN/tensorboard. A resumed run with event files starts a new file.
    #[arg(long, help_heading = "Output")]
    tensorboard: bool,
    /// Serve the viewer while training
    ///
    /// `raygrad view RUN` shows a run that has ended.
    #[arg(long, help_heading = "Viewer")]
    view: bool,
    #[command(flatten)]
    place: PlaceArgs,
    /// New run folder [default: run, run-2, ...]
    #[arg(long, help_heading = "Output", value_name = "RUN")]
    out: Option<PathBuf>,
    /// Leave out positional encoding
    ///
    /// Shows what the encoding is for: fine detail is lost.
    #[arg(long, help_heading = "Advanced")]
    no_positional_encoding: bool,
    /// Set a config key: sampler.samples=16384
    ///
    /// Keys are those of config.json in the run folder; values are JSON. Give the flag several times for several
    /// keys.
    #[arg(long, help_heading = "Advanced", value_name = "NAME=VALUE", value_parser = parse::setting)]
    set: Vec<(String, Value)>,
}

impl Default for Args {
    /// The default arguments of `raygrad train`.
    fn default() -> Self {
        Args::parse_from(["train"])
    }
}

/// A trained run.
pub struct Trained {
    /// Its folder.
    pub folder: PathBuf,
    /// True if Ctrl-C ended it.
    pub interrupted: bool,
    /// True if its numbers are no longer finite.
    pub diverged: bool,
}

impl Trained {
    /// Whether training came to the end of its budget.
    pub fn is_complete(&self) -> bool {
        !self.interrupted && !self.diverged
    }

    /// With which code the program should exit.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Trained { interrupted: true, .. } => interrupt::EXIT_CODE.into(),
            Trained { diverged: true, .. } => ExitCode::FAILURE,
            _ => ExitCode::SUCCESS,
        }
    }
}

/// Trains a new run or resumes one.
pub fn run(args: &Args) -> Work<Trained> {
    if ranks::is_silent() {
        return follow();
    }
    if !args.view && args.place.are_given() {
        return Err(Error::setting("view", "is missing: --host and --port need --view").into());
    }
    if args.moved.is_some() && args.resume.is_none() {
        return Err(Error::setting("scene", "is for --resume: name the scene of a new run without a flag").into());
    }
    // Binds the port first, before files are created.
    let listener = args.view.then(|| args.place.listen()).transpose()?;
    match &args.resume {
        None => begin(args, listener),
        Some(folder) => Ok(resume(args, folder, listener)?),
    }
}

/// Trains a new run.
fn begin(args: &Args, listener: Option<Listener>) -> Work<Trained> {
    let mut folder = choose_folder(args.out.as_deref())?;
    let source = match &args.scene {
        Scene::Folder(input) if beside::is_unprepared(input) => Scene::Folder(beside::dataset(input)?),
        scene => scene.clone(),
    };
    let mut scene = source.open(&args.capture)?;
    let AutomaticDownscale { factor: downscale, limit } = match args.downscale {
        Some(factor) => AutomaticDownscale { factor, limit: None },
        None => scene.automatic_downscale(|scene_type| args.most_cells(scene_type))?,
    };
    scene.depth = args.has_depth_loss();
    let mut data = scene.load(Split::Train, downscale, usize::MAX)?;
    if let Some(near) = args.near {
        set_near(&mut data, near)?;
    }
    let data = Arc::new(data);
    let config = args.config(&data)?;
    let background = config.background.shown();
    let mut trainer = Trainer::new(config, data.clone())?;
    let run_config = args.run_config((&source, &scene), downscale, &trainer, &data)?;
    // A rank that cannot begin ends the job, so that nothing may exist yet.
    share(&mut trainer, (&folder, &run_config), args.budget(), args.patience())?;
    // Before the first file.
    interrupt::listen();
    let (run, lock) = loop {
        match Run::create(folder.clone(), run_config.clone()) {
            // Without --out, another program may have taken the folder since.
            Err(error) if args.out.is_none() => {
                let other = choose_folder(None)?;
                if other == folder {
                    return Err(error.into());
                }
                folder = other;
            }
            created => break created?,
        }
    };
    describe(&run, &trainer, &data, &scene)?;
    // Warnings come after all checks, so that an error is the only line of output.
    doctor::warn(&scene, &args.capture);
    let marching = trainer.model.config.sampler.get::<MarchingConfig>();
    if let Some(note) = marching.and_then(|marching| args.idle_cores(marching.tiles)) {
        complain(&note);
    }
    if let Some(limit) = limit {
        let [width, height] = [data.frames[0].image.width, data.frames[0].image.height];
        let limit = match limit {
            DownscaleLimit::Side => "the longest side has at most 1600 pixels, or 6400 of a panorama",
            DownscaleLimit::Memory => "all of them take about 3 GB at most",
            DownscaleLimit::Cells => "this budget resolves no more",
        };
        complain(&format!(
            "note: images are downscaled by {downscale}, to {width}x{height}: {limit}; --downscale sets another factor"
        ));
    }

    let preview = Preview::choose(&scene, downscale, &data, background);
    Ok(train((run, lock), trainer, args.budget(), args, preview, listener)?)
}

/// What rank 0 tells the others.
#[derive(Serialize, Deserialize)]
struct Shared {
    folder: PathBuf,
    config: RunConfig,
    budget: Budget,
    /// How long ranks wait for one another in training.
    timeout: Duration,
}

/// Shares the training of a run with the other ranks, if there are any.
fn share(
    trainer: &mut Trainer,
    (folder, config): (&Path, &RunConfig),
    budget: Budget,
    timeout: Duration,
) -> Result<()> {
    let Some(mut exchange) = ranks::take() else { return Ok(()) };
    let shared = Shared { folder: folder.to_owned(), config: config.clone(), budget, timeout };
    ranks::of_first(&mut *exchange, Some(&shared))?;
    ranks::bytes_of_first(&mut *exchange, &trainer.state()?)?;
    trainer.share(exchange)?;
    set_timeout(trainer, timeout);
    Ok(())
}

fn set_timeout(trainer: &mut Trainer, timeout: Duration) {
    if let Some(exchange) = trainer.exchange_mut() {
        exchange.set_timeout(timeout);
    }
}

/// Trains the run of rank 0. It writes nothing.
fn follow() -> Work<Trained> {
    let lost = || Error::setting("mpi", "this rank has no connection to the others");
    let mut exchange = ranks::take().ok_or_else(lost)?;
    let Shared { folder, config, budget, timeout } = ranks::of_first(&mut *exchange, None)?;
    let state = ranks::bytes_of_first(&mut *exchange, &[])?;
    let (_, _, mut trainer) = reopen(&Run { folder: folder.clone(), config }, None)?;
    trainer.load_state(&state)?;
    trainer.share(exchange)?;
    set_timeout(&mut trainer, timeout);
    interrupt::listen();
    loop {
        trainer
            .run(budget, |_| if interrupt::requested() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) });
        let interrupted = ranks::any_is_interrupted(&mut trainer, interrupt::requested()).map_err(ranks::failed)?;
        // Rank 0 goes back to a checkpoint if the run has diverged.
        let state = trainer.exchange_mut().map_or(Ok(vec![]), |exchange| ranks::bytes_of_first(exchange, &[]))?;
        if state.is_empty() {
            let diverged = trainer.stats().ends_diverged();
            return Ok(Trained { folder, interrupted, diverged });
        }
        trainer.load_state(&state)?;
    }
}

/// Loads the images of a run and makes a trainer of its configuration, at step 0.
fn reopen(run: &Run, moved: Option<&Scene>) -> Result<(Opened, Arc<Dataset>, Trainer)> {
    let RunConfig { scene_box: extent, downscale, config, .. } = run.config.clone();
    let mut scene = run.open_scene(moved)?;
    scene.depth = config.loss_terms.iter().any(|term| term.kind() == "depth");
    let data = scene.load(Split::Train, downscale, usize::MAX)?;
    let [near, far] = extent.near_far;
    let data = Dataset { bounds: extent.bounds, near, far, transform: extent.transform, ndc: extent.ndc, ..data };
    let names = data.frames.iter().map(|frame| &frame.name);
    if !names.eq(&run.config.images) {
        let what = format!(
            "the run was trained on other images than {} has now: restore those, or train a new run",
            run.config.scene
        );
        return Err(Error::file(&run.folder, what));
    }
    let data = Arc::new(data);
    let trainer = Trainer::with_scene_box(config, data.clone(), extent)?;
    Ok((scene, data, trainer))
}

/// Resumes a run from its last checkpoint.
fn resume(args: &Args, folder: &Path, listener: Option<Listener>) -> Result<Trained> {
    let mut run = Run::open(folder)?;
    let before = run.config.clone();
    if let Some(scene) = &args.moved {
        run.config.scene = scene.absolute()?;
    }
    let budget = match (args.given(), run.config.budget) {
        (Some(budget), _) | (None, Some(budget)) => budget,
        (None, None) => return Err(Error::setting("budget", "the run has none: add --budget or --steps")),
    };
    let mut lock = run.lock()?;
    let (scene, data, mut trainer) = reopen(&run, args.moved.as_ref())?;
    if args.moved.is_some() {
        run.config.description = scene.description();
    }
    let (downscale, background) = (run.config.downscale, run.config.config.background.shown());
    // Before the first file.
    interrupt::listen();
    run.sweep();
    checkpoint::load(&run, &mut trainer)?;
    run.keep(&mut lock)?;
    let stats = trainer.stats();
    let is_over = watch::remaining(budget, &stats).0 >= 1.0;
    run.config.raygrad = env!("CARGO_PKG_VERSION").to_owned();
    run.config.keep_checkpoints = args.keep_checkpoints.unwrap_or(run.config.keep_checkpoints);
    // A total that the run is beyond has no effect, so a later --resume continues to the old one.
    if !is_over {
        run.config.budget = Some(budget);
    }
    share(&mut trainer, (&run.folder, &run.config), budget, args.patience())?;
    if run.config != before {
        run.write()?;
    }
    describe(&run, &trainer, &data, &scene)?;
    let end = match (is_over, args.given()) {
        (false, _) => "",
        (true, None) => FINISHED,
        (true, Some(_)) => BEYOND,
    };
    print(&format!("resumed  at step {}{end}\n", stats.step))?;
    let preview = Preview::choose(&scene, downscale, &data, background);
    train((run, lock), trainer, budget, args, preview, listener)
}

/// Trains to the end of the budget and writes the results to the run's folder, which is locked.
fn train(
    (run, lock): (Run, Lock),
    mut trainer: Trainer,
    budget: Budget,
    args: &Args,
    preview: Preview,
    listener: Option<Listener>,
) -> Result<Trained> {
    if let Some(exchange) = trainer.exchange_mut() {
        print(&format!("ranks    {}, connected by MPI\n", exchange.ranks()))?;
    }
    let sent = |trainer: &mut Trainer| trainer.exchange_mut().map(|exchange| exchange.sent_bytes());
    let before = (trainer.stats().step, sent(&mut trainer));
    let mut window = listener.map(|listener| TrainingViewer::open(listener, &run, &trainer)).transpose()?;
    let mut watch = Watch::new((&run, lock), &trainer, budget, args.checkpoint_every, preview, args.tensorboard)?;
    let (mut diverged, mut ended_by_page, mut interrupted) = (None, false, false);
    for retreats in 0.. {
        trainer.run(budget, |trainer| {
            let stops = interrupt::requested() || ended_by_page;
            watch.step(trainer, stops);
            if watch.has_lost_its_run() {
                return ControlFlow::Break(());
            }
            if let Some(window) = window.as_mut().filter(|_| !stops) {
                let (psnr, left) = watch.shown(trainer);
                ended_by_page = window.step(trainer, psnr, left);
            }
            if stops { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        interrupted = match ranks::any_is_interrupted(&mut trainer, interrupt::requested()) {
            Ok(interrupted) => interrupted,
            Err(error) => {
                let what = format!("{error}; resume the run with raygrad train --resume {}", quoted(&run.folder));
                return Err(Error::setting("mpi", what));
            }
        };
        if interrupted {
            watch.stop(&trainer);
        }
        let reason = (trainer.stats().ends_diverged() && !watch.has_lost_its_run()).then(|| watch::reason(&trainer));
        let tries_again = trainer.stats().has_diverged() && retreats < RETREATS && !interrupted && !ended_by_page;
        let again = reason.as_ref().is_some_and(|reason| tries_again && watch.retreat(&mut trainer, reason));
        let state = if again { trainer.state()? } else { vec![] };
        if let Some(exchange) = trainer.exchange_mut() {
            ranks::bytes_of_first(exchange, &state)?;
        }
        if !again {
            diverged = reason;
            break;
        }
    }
    let ended = match (interrupted || ended_by_page, &diverged) {
        (true, _) => Ended::Interrupted,
        (false, Some(_)) => Ended::Diverged,
        (false, None) => Ended::Done,
    };
    // A diverged run returns to its last checkpoint, which is good.
    let good = diverged.is_none() || watch.give_up(&mut trainer);
    // The lock is released here, so that another program may resume the run.
    watch.finish(&trainer, ended, good)?;
    summarise(&run, &trainer.stats(), ended == Ended::Interrupted)?;
    if let (first, Some(before), Some(after)) = (before.0, before.1, sent(&mut trainer)) {
        let each = (after - before) as f64 / (trainer.stats().step.saturating_sub(first)).max(1) as f64;
        print(&format!("sent     {:.0} kB by rank 0 in each step\n", 1e-3 * each))?;
    }
    if let Some(reason) = &diverged {
        let schedule = trainer.model.config.schedule;
        let rate = if let Schedule::Constant { .. } = schedule { "lr" } else { "from" };
        complain(&format!(
            "training diverged: its values are not finite{reason}; the saved model is from step {}; lower the \
             learning rate with --set schedule.{}.{rate}=VALUE",
            trainer.stats().step,
            schedule.name()
        ));
    }
    if let Some(window) = &mut window {
        window.end(&trainer, ended);
    }
    Ok(Trained { folder: run.folder, interrupted, diverged: diverged.is_some() })
}

/// Prints the estimated memory of training, and a warning if it is not free. Memory in use by this process is not
/// counted twice.
fn foresee_memory(trainer: &Trainer, data: &Dataset) -> Result<()> {
    let need = memory::need(trainer, data);
    let free = available_memory().map(|free| free as f64 + machine::taken_memory().unwrap_or(0) as f64);
    if let Some(warning) = free.and_then(|free| memory::shortage(need, free)) {
        complain(&warning);
    }
    print(&format!("memory   about {:.1} GB\n", need / 1e9))
}

fn describe(run: &Run, trainer: &Trainer, data: &Dataset, scene: &Opened) -> Result<()> {
    let (views, image) = (data.frames.len(), &data.frames[0].image);
    if let Some((capture, analysis)) = &scene.capture {
        let splits = capture.present().filter_map(|view| view.split);
        let held_out = splits.filter(|split| *split != Split::Train).count();
        print(&format!(
            "capture  {}, {} of {} images found, {held_out} held out; {}: {}\n",
            capture.format,
            capture.present().count(),
            capture.views.len(),
            analysis.scene_type,
            analysis.reason
        ))?;
    }
    print(&format!(
        "scene    {}: {views} images of {}x{}\nmodel    {} parameters, {} threads\nrun      {}\n",
        run.config.scene,
        image.width,
        image.height,
        trainer.model.params.elements(),
        rayon::current_num_threads(),
        run.folder.display()
    ))?;
    foresee_memory(trainer, data)
}

fn summarise(run: &Run, stats: &StepStats, interrupted: bool) -> Result<()> {
    let what = if interrupted { "stopped " } else { "trained " };
    print(&format!(
        "{what} {} steps in {}, {:.0} rays/s; model saved to {}\n",
        stats.step,
        spoken(stats.train_seconds),
        stats.rays as f64 / stats.train_seconds.max(1e-9),
        run.model_file().display()
    ))?;
    if interrupted { print(&format!("resume   raygrad train --resume {}\n", quoted(&run.folder))) } else { Ok(()) }
}
