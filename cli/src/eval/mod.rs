//! `raygrad eval`: compares renders with images.

pub mod alignment;
mod judge;
mod page;
mod report;

use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::{Capture, Dataset, Frame, Split};
use raygrad::nerf::imaging::lpips::{Backbone, Lpips};
use raygrad::nerf::space::occupancy::{Skip, Skipping};
use raygrad::nerf::{Error, Image, Result, available_memory, fitted_cameras, rename_durable, write_atomic};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::interrupt::Work;
use super::lock::{Lock, UNFINISHED as UNFINISHED_LOCK};
use super::machine::processor;
use super::merge;
use super::output::{checksum, complain, make_folder, note, note_fewer, numbered, other_numbered, print, remove};
use super::precision::{Precision, Renderer};
use super::progress::Progress;
use super::run::{Run, write_json};
use super::scene::{Opened, Scene};
use super::shard::{self, Complete, Part, Shard, Whole};
use super::{parse, ranks};
use alignment::{Alignment, Appearance};
use judge::Judge;
use report::{Compared, Conditions, Identity, Machine, Report, Score, Weights, table};

/// Digits of the number of an image file.
const DIGITS: usize = 3;
/// Folder of the image files until the evaluation is complete.
const UNFINISHED: &str = "unfinished";
/// The page of a result.
const PAGE: &str = "index.html";
/// The name of the command in records.
pub const COMMAND: &str = "eval";

/// Measure PSNR, SSIM and LPIPS on held-out images
///
/// Writes RUN/eval-SPLIT-SKIP.json with the figures and the conditions they depend on.
/// RUN/eval-SPLIT-SKIP/index.html shows up to 13 views, the worst ones among them: image, render, error, depth.
///
/// --views, --precision, --lpips, --fit-poses and --fit-half become part of the name, as in RUN/eval-val-off-10.json.
/// A result with another --scene replaces the one of the same name.
///
/// Example: raygrad eval my-run --views 10
#[derive(clap::Args)]
pub struct Args {
    /// Run folder, made by `raygrad train`
    run: PathBuf,
    /// Image folder, if it moved after training
    ///
    /// Without it, raygrad reads the images from where they were during training.
    #[arg(long, help_heading = "Scene")]
    scene: Option<Scene>,
    /// Split: train, val or test
    #[arg(long, help_heading = "Scene", default_value = "test", value_parser = parse::word::<Split>)]
    split: Split,
    /// Use N evenly spaced views [default: all]
    #[arg(long, help_heading = "Scene", value_name = "N", value_parser = parse::within(1usize..))]
    views: Option<usize>,
    /// Empty-space skipping: off, near-lossless, fast
    ///
    /// near-lossless changes a colour by at most 0.6 % of its range, fast by at most 6 %. By default rendering
    /// skips as much as the run's config says.
    #[arg(long, help_heading = "Advanced", value_parser = parse::word::<Skip>)]
    skip: Option<Skip>,
    /// Align each camera to the model first
    ///
    /// Moves each held-out camera to where the model matches its image best. Use it after --refine poses: held-out
    /// cameras keep their given poses, which may be as wrong as the others were.
    #[arg(long, help_heading = "Model")]
    fit_poses: bool,
    /// Fit exposure on one half, score the other
    ///
    /// Fits one gain per colour channel to the left half of each image and compares the right half. Use it where
    /// images differ in exposure: that of a held-out image is unknown.
    #[arg(long, help_heading = "Model")]
    fit_half: bool,
    /// Also measure LPIPS, with these weights
    ///
    /// A safetensors file with the weights of AlexNet or VGG-16, made by benches/peers/lpips_weights.py. Values of
    /// the two networks are not comparable.
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    lpips: Option<PathBuf>,
    /// Arithmetic: f32 or f64
    ///
    /// f64 renders every sample in occupied cells in double precision and skips nothing else. It is slow, and a
    /// reference for measurements.
    #[arg(long, help_heading = "Advanced", hide_possible_values = true, value_enum, default_value_t)]
    precision: Precision,
    /// Measure every Nth view, starting with the Ith
    ///
    /// For several programs, such as a job array, that evaluate one run. Give each the same command with another I of
    /// I/N. The last one to finish writes the result. See `raygrad merge`.
    #[arg(long, help_heading = "Output", value_name = "I/N", conflicts_with = "json")]
    pub shard: Option<Shard>,
    /// Print the result as JSON
    #[arg(long, help_heading = "Output")]
    json: bool,
}

impl Args {
    /// Name of the result: `eval`, the split, skipping if there is a grid, and other options.
    fn name(&self, skip: Option<Skipping>, lpips: Option<Backbone>) -> String {
        let precision = (self.precision == Precision::F64).then(|| "f64".to_owned());
        let views = self.views.map(|n| n.to_string());
        let half = self.fit_half.then(|| "half".to_owned());
        let poses = self.fit_poses.then(|| "poses".to_owned());
        let lpips = lpips.map(|backbone| format!("lpips-{backbone}"));
        let others = [skip.map(level), views, precision, poses, half, lpips];
        let parts = ["eval".to_owned(), self.split.to_string()].into_iter().chain(others.into_iter().flatten());
        parts.collect::<Vec<_>>().join("-")
    }
}

/// Skipping in a word; `own` for custom thresholds.
fn level(skip: Skipping) -> String {
    let is = |level: &Skip| {
        let Skipping { grid, carving, .. } = skip;
        Skipping { grid, carving, ..(*level).into() } == skip
    };
    [Skip::Off, Skip::NearLossless, Skip::Fast].into_iter().find(is).map_or("own".to_owned(), |level| level.to_string())
}

/// The rule that selects the held-out images.
fn hold_out(run: &Run, opened: &Opened) -> &'static str {
    match &opened.capture {
        Some(_) if run.config.test.is_some() => "as `train --test` chose",
        None => "built in",
        Some((capture, _)) if Capture::holds_out_every_eighth(capture) => "every eighth by name, from the first",
        Some(_) => "as the capture says",
    }
}

/// Notes that no image of the scene bears the name of a training image, so that none is recognized as one.
fn note_other_names(run: &Run, opened: &Opened) {
    let (Some((capture, _)), names) = (&opened.capture, &run.config.images) else { return };
    if !names.is_empty() && !capture.views.iter().any(|view| names.contains(&view.name)) {
        let file = capture.file.display();
        complain(&format!(
            "note: {file} names none of the training images, so raygrad cannot tell whether images to compare are among \
             them"
        ));
    }
}

/// Evaluates the model, writes the files and prints the result.
pub fn run(args: &Args) -> Work<()> {
    let run = Run::open(&args.run)?;
    // The checksum is computed before the model is read. If the file is replaced meanwhile, the result does not name
    // the new model.
    let [crc32, config] = run.checksums()?;
    let mut model = run.model()?;
    let identity = Identity::of(&run, &model, crc32);
    let lpips = args.lpips.as_ref().map(Lpips::open).transpose()?;
    let weights = args.lpips.as_deref().map(checksum).transpose()?;
    if let Some(skip) = args.skip {
        model.set_skip(skip);
    }
    let scene = run.scene(args.scene.as_ref())?;
    let opened = run.open_scene(args.scene.as_ref())?;
    let mut data = opened.load(args.split, run.config.downscale, args.views.unwrap_or(usize::MAX))?;
    note_fewer("views", args.views, data.frames.len() + data.masked.len(), "images to compare");
    if args.split != Split::Train
        && let Some(frame) = data.frames.iter().find(|frame| run.config.images.contains(&frame.name))
    {
        let what = format!(
            "the {} image `{}` was a training image of the run: name the unchanged capture with --scene",
            args.split, frame.name
        );
        return Err(Error::setting("scene", what).into());
    }
    note_other_names(&run, &opened);
    let images = fingerprint(&data)?;
    let appearance = Appearance::of(&model, args.split, args.fit_half);
    if let Some(lpips) = &lpips {
        check_seen(lpips.backbone(), &data, appearance)?;
    }
    // Vignetting is the same in all images, so renders have it too.
    model.vignetted = true;
    let mut cameras = Alignment::apply(&model, &run.config.images, args.split, &mut data)?;
    if args.fit_poses {
        note("aligning cameras to the images");
        let found = fitted_cameras(&model, data.clone())?;
        data.frames.iter_mut().zip(found).for_each(|(frame, camera)| frame.camera = camera);
        cameras = Alignment::Fitted;
    }
    let skip = model.marching().map(|marching| marching.config.occupancy.skip);
    let name = args.name(skip, lpips.as_ref().map(Lpips::backbone));
    let own = |frame: &Frame| {
        let number = run.config.images.iter().position(|name| *name == frame.name);
        number.filter(|_| appearance == Appearance::Own).map(|number| number as u32)
    };
    let looks = data.frames.iter().map(own).collect();
    let background = model.config.background.in_output();
    let conditions = Conditions {
        raygrad: env!("CARGO_PKG_VERSION").to_owned(),
        scene: scene.absolute()?,
        split: args.split,
        hold_out: hold_out(&run, &opened).to_owned(),
        views: data.frames.len(),
        width: data.frames[0].image.width,
        height: data.frames[0].image.height,
        downscale: run.config.downscale,
        mask_as_alpha: run.config.mask_as_alpha,
        background,
        skip,
        precision: args.precision,
        cameras,
        appearance,
        pixel_offset: 0.5,
        quantisation: "none".to_owned(),
        model: identity,
    };
    let weights = lpips.as_ref().zip(weights);
    let weights = weights.map(|(lpips, lpips_crc32)| Weights { lpips_backbone: lpips.backbone(), lpips_crc32 });
    let machine = Machine { threads: rayon::current_num_threads(), processor: processor() };
    let span = model.scene_box.near_far;
    let renderer = Renderer::new(model, args.precision)?;
    let judge = Judge { renderer, background: background.shown(), span, data, looks, appearance, lpips };
    let folder = run.file(&name);
    if args.json && ranks::own().is_some() {
        return Err(Error::setting("json", "needs a single process; the ranks write RUN/eval-SPLIT-SKIP.json").into());
    }
    let Some(shard) = args.shard.or_else(ranks::shard) else {
        let report = all(judge, |views| Report::new(conditions, weights, vec![machine], views), &folder)?;
        if !args.json {
            return Ok(describe(&report, &folder)?);
        }
        let text = serde_json::to_string_pretty(&report).map_err(|e| Error::file(result_of(&folder), e))?;
        return Ok(print(&format!("{text}\n"))?);
    };
    let inputs = Inputs { conditions, weights, config, images };
    measure_shard(judge, shard, &inputs, &machine, &folder)?;
    merge::merge_if_complete(&folder, shard)
}

/// All inputs of an evaluation in shards.
#[derive(Serialize, Deserialize)]
struct Inputs {
    conditions: Conditions,
    weights: Option<Weights>,
    /// Checksums of `config.json` and of names and cameras of the images.
    config: String,
    images: String,
}

/// A checksum of names and cameras of images.
fn fingerprint(data: &Dataset) -> Result<String> {
    let all: Vec<_> = data.frames.iter().map(|frame| (&frame.name, &frame.camera)).collect();
    let bytes = serde_json::to_vec(&all).map_err(|e| Error::setting("scene", e))?;
    Ok(format!("{:08x}", crc32fast::hash(&bytes)))
}

/// Measures all views and writes the result.
fn all(mut judge: Judge, report: impl FnOnce(Vec<Compared>) -> Report, folder: &Path) -> Result<Report> {
    let lock = lock(folder)?;
    let unfinished = new_unfinished(folder)?;
    let count = judge.data.frames.len();
    let regular = report::regular(count);
    let progress = Progress::new();
    let mut views = Vec::with_capacity(count);
    for i in 0..count {
        let (view, shown) = judge.compare(i)?;
        if regular.contains(&i) {
            judge.draw(&shown).save_png(unfinished.join(numbered(i, DIGITS)))?;
        }
        show_progress(&progress, [i + 1, count], &view);
        views.push(view);
    }
    drop(progress);
    let report = report(views);
    for &i in report.drawn().difference(&regular) {
        judge.drawn(i)?.save_png(unfinished.join(numbered(i, DIGITS)))?;
    }
    finish(&report, folder, &lock)?;
    lock.remove();
    Ok(report)
}

/// Locks the folder of a result against other evaluations of all its views.
fn lock(folder: &Path) -> Result<Lock> {
    shard::check_none(folder)?;
    make_folder(folder)?;
    let busy = || Error::file(folder, "another raygrad is writing it: wait until it ends");
    let lock = Lock::take(&folder.join(UNFINISHED_LOCK), busy)?;
    // A shard may have begun meanwhile.
    shard::check_none(folder)?;
    Ok(lock)
}

/// Creates the folder of unfinished images, and discards those of an interrupted evaluation.
fn new_unfinished(folder: &Path) -> Result<PathBuf> {
    let unfinished = folder.join(UNFINISHED);
    let _ = std::fs::remove_dir_all(&unfinished);
    make_folder(&unfinished)?;
    Ok(unfinished)
}

/// The file of the result whose images are in a folder.
fn result_of(folder: &Path) -> PathBuf {
    let mut name = folder.file_name().unwrap_or_default().to_owned();
    name.push(".json");
    folder.with_file_name(name)
}

/// Replaces the result and its page, after the evaluation is complete. The images are in [`new_unfinished`].
fn finish(report: &Report, folder: &Path, lock: &Lock) -> Result<()> {
    let what = "was removed, or another raygrad evaluates there now: nothing was written; run the command again";
    lock.check(folder, what, what)?;
    write_json(&result_of(folder), report)?;
    let (drawn, unfinished) = (report.drawn(), folder.join(UNFINISHED));
    for name in drawn.iter().map(|&i| numbered(i, DIGITS)) {
        rename_durable(unfinished.join(&name), folder.join(&name))?;
    }
    let _ = std::fs::remove_dir(&unfinished);
    // Renders of earlier evaluations with other views would belong to no result.
    remove(&other_numbered(folder, DIGITS, &drawn.iter().copied().collect::<Vec<_>>()));
    write_atomic(folder.join(PAGE), page::page(report).as_bytes())
}

/// Prints a report and where it is.
fn describe(report: &Report, folder: &Path) -> Result<()> {
    let [file, index] = [result_of(folder), folder.join(PAGE)];
    print(&format!("{}written: {}, {}\n", table(report), file.display(), index.display()))
}

/// Measures the views of a shard. Each has a file beside the shards' records, and so has each image of the page.
fn measure_shard(mut judge: Judge, shard: Shard, inputs: &Inputs, machine: &Machine, folder: &Path) -> Result<()> {
    let count = judge.data.frames.len();
    let whole = Whole { command: COMMAND.to_owned(), inputs: json!(inputs), items: count };
    let (mut part, regular) = (Part::open(folder, shard, whole, json!(machine))?, report::regular(count));
    let items: Vec<usize> = part.items().collect();
    part.retain(|i| view_of(folder, i).is_file() && (!regular.contains(&i) || image_of(folder, i).is_file()))?;
    if part.done() > 0 && part.next().is_some() {
        note(&format!("resuming after {} of {} images of shard {shard}", part.done(), items.len()));
    }
    let progress = Progress::new();
    while let Some(i) = part.next() {
        let (view, shown) = judge.compare(i)?;
        let write = |i: usize, image: Image| part.write(&image_of(folder, i), &image.to_png());
        if regular.contains(&i) {
            write(i, judge.draw(&shown))?;
        }
        part.write(&view_of(folder, i), json!(view).to_string().as_bytes())?;
        if part.done() + 1 == items.len() {
            // The worst of all views are among the worst of each shard.
            let psnr =
                items.iter().map(|&i| Ok(read_view(&view_of(folder, i))?.score.psnr)).collect::<Result<Vec<f64>>>()?;
            for i in report::worst(&psnr).into_iter().map(|k| items[k]).filter(|i| !regular.contains(i)) {
                write(i, judge.drawn(i)?)?;
            }
        }
        show_progress(&progress, [part.done() + 1, items.len()], &view);
        part.advance(1)?;
    }
    part.finish();
    Ok(())
}

/// The file of a view that a shard has measured.
fn view_of(folder: &Path, i: usize) -> PathBuf {
    folder.join(shard::FOLDER).join(format!("view-{i}.json"))
}

/// The image of a view that a shard has drawn.
fn image_of(folder: &Path, i: usize) -> PathBuf {
    folder.join(shard::FOLDER).join(numbered(i, DIGITS))
}

fn read_view(path: &Path) -> Result<Compared> {
    let text = parse::read_text(path, "a measured view")?;
    let bad = |e| Error::file(path, format!("is not a measured view ({e}): remove it and run its shard again"));
    serde_json::from_str(&text).map_err(bad)
}

/// Writes the result of complete shards.
pub fn merge(complete: Complete) -> Result<()> {
    let folder = complete.at().to_owned();
    let Inputs { conditions, weights, .. } = complete.inputs()?;
    let view = |i: usize| {
        let file = view_of(&folder, i);
        complete.check(i, &file)?;
        read_view(&file)
    };
    let views = (0..complete.whole.items).map(view).collect::<Result<Vec<_>>>()?;
    let report = Report::new(conditions, weights, complete.own()?, views);
    let unfinished = new_unfinished(&folder)?;
    for i in report.drawn() {
        let from = image_of(&folder, i);
        complete.check(i, &from)?;
        // They stay among the records, so that an interrupted merge can be repeated.
        std::fs::copy(&from, unfinished.join(numbered(i, DIGITS)))
            .map_err(|e| Error::file(&from, format!("cannot be copied: {e}")))?;
    }
    finish(&report, &folder, &complete.lock)?;
    shard::clear(&folder);
    complete.lock.remove();
    describe(&report, &folder)
}

fn show_progress(progress: &Progress, [done, count]: [usize; 2], view: &Compared) {
    let Score { name, psnr, .. } = &view.score;
    progress.set(done as f64 / count as f64, || format!("image {done} of {count}  {name}  PSNR {psnr:.2}"));
}

/// Checks that unmasked images are large enough for the network, and that there is one. Notes masked images, and warns
/// if memory is short.
fn check_seen(backbone: Backbone, data: &Dataset, appearance: Appearance) -> Result<()> {
    let bad = |what: String| Err(Error::setting("lpips", what));
    let (side, mut largest, mut masked) = (backbone.smallest(), 0, 0);
    for Frame { name, image, mask, .. } in &data.frames {
        let [width, height] = [image.width - appearance.fitted_columns(image.width), image.height];
        masked += usize::from(mask.is_some());
        if mask.is_none() && (width < side || height < side) {
            return bad(format!(
                "`{name}` has {width}x{height} pixels to compare; {backbone} needs at least {side}x{side}"
            ));
        }
        largest = largest.max(if mask.is_some() { 0 } else { width * height });
    }
    if masked == data.frames.len() {
        return bad("needs an image without a mask: all of these have one, drawn or from dark lens corners".into());
    }
    if masked > 0 {
        note(&format!("LPIPS leaves out {masked} of {} images, because they have masks", data.frames.len()));
    }
    let need = largest as f64 * backbone.bytes();
    if let Some(free) = available_memory().map(|free| free as f64).filter(|free| need > *free) {
        let [need, free] = [need, free].map(|bytes| bytes / 1e9);
        complain(&format!(
            "warning: LPIPS needs about {need:.1} GB of memory for these images, but {free:.1} GB are free"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::dataset::Mask;
    use raygrad_scenes::embedded;
    use std::sync::Arc;

    #[test]
    fn check_seen_small_or_masked_images_fail() {
        let mut data = embedded(Split::Test, 26);
        data.frames.truncate(2);
        let check =
            |data: &Dataset, appearance| check_seen(Backbone::Vgg, data, appearance).map_err(|error| error.to_string());
        assert!(check(&data, Appearance::None).is_ok());
        assert!(
            check(&data, Appearance::Half)
                .unwrap_err()
                .contains("has 13x26 pixels to compare; vgg needs at least 16x16")
        );
        // An image without a mask that is not high enough.
        let low = data.frames[0].image.clone();
        data.frames[1].image = Image::new(40, 15, 3).into();
        assert!(check(&data, Appearance::None).unwrap_err().contains("40x15"));
        data.frames[1].mask = Some(Arc::new(Mask::new(40, 15, |_, _| true)));
        assert!(check(&data, Appearance::None).is_ok());
        data.frames[0].mask = Some(Arc::new(Mask::new(low.width, low.height, |x, _| x > 3)));
        assert!(check(&data, Appearance::None).unwrap_err().contains("needs an image without a mask"));
    }
}
