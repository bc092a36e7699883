//! `raygrad eval`: how close a model comes to photographs.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use raygrad::nerf::dataset::{Dataset, Frame, Split, evenly_spaced};
use raygrad::nerf::pictures::colormap;
use raygrad::nerf::pictures::metrics::{SSIM_WINDOW, psnr, ssim};
use raygrad::nerf::space::occupancy::{Skip, Skipping};
use raygrad::nerf::{Background, Error, Evaluations, Image, InstantConfig, Model, Picture, Result, fitted_cameras};
use serde::Serialize;

use super::output::{depth_colors, make_folder, note, numbered, other_numbered, print, remove};
use super::parse;
use super::precision::{Precision, Renderer};
use super::progress::Progress;
use super::run::{Run, write_json};
use super::scene::Scene;

/// Digits of the number of a picture.
const DIGITS: usize = 3;
/// Views of which a picture is written.
const PICTURES: usize = 10;

/// Compare a model with photographs: PSNR and SSIM
///
/// Writes RUN/eval.json, and in RUN/eval/ up to 10 pictures: photograph, render, error, depth. Another split, number of
/// views, --skip, --precision, --fit-poses or --fit-half stands in the name, as in RUN/eval-val-10-off.json, so that none replaces another's result; that
/// of another --scene does.
#[derive(clap::Args)]
pub struct Args {
    /// Folder that `raygrad train` made
    run: PathBuf,
    /// Folder of the photographs, if they are no longer where they were for training
    #[arg(long)]
    scene: Option<Scene>,
    /// Photographs to compare with: train, val or test
    #[arg(long, default_value = "test")]
    split: Split,
    /// Compare with this many evenly spaced photographs [default: all]
    #[arg(long, value_name = "N", value_parser = parse::count(usize::MAX))]
    views: Option<usize>,
    /// How much that hardly shows to leave out: off, lossless or fast [default: as in training]
    #[arg(long)]
    skip: Option<Skip>,
    /// Move each photograph's camera to where the model shows it best, and compare then: of a model whose own cameras were
    /// corrected, others are where they were given, which may be as wrong
    #[arg(long)]
    fit_poses: bool,
    /// Fit a gain for each colour channel to the left half of each photograph, and compare the right half: where photographs
    /// differ in exposure, nobody can know that of one that was held out
    #[arg(long)]
    fit_half: bool,
    /// Arithmetic of the pictures
    #[arg(long, value_enum, default_value_t)]
    precision: Precision,
    /// Print what the file holds in place of a table
    #[arg(long)]
    json: bool,
}

impl Args {
    /// The name of the result: `eval`, and what differs from the ordinary.
    fn name(&self) -> String {
        let split = (self.split != Split::Test).then(|| self.split.to_string());
        let precision = (self.precision == Precision::F64).then(|| "f64".to_owned());
        let [views, skip] = [self.views.map(|n| n.to_string()), self.skip.map(|skip| skip.to_string())];
        let half = self.fit_half.then(|| "half".to_owned());
        let poses = self.fit_poses.then(|| "poses".to_owned());
        let others = [split, views, skip, precision, poses, half];
        let parts = ["eval".to_owned()].into_iter().chain(others.into_iter().flatten());
        parts.collect::<Vec<_>>().join("-")
    }
}

/// The result: `eval.json`.
#[derive(Serialize)]
struct Report {
    raygrad: &'static str,
    scene: Scene,
    split: Split,
    /// Number of views.
    views: usize,
    width: usize,
    height: usize,
    downscale: usize,
    /// What photographs with transparency are composited over.
    background: Background,
    /// What was left out; null where there is no occupancy grid.
    skip: Option<Skipping>,
    /// `f32`, or `f64` with nothing left out but empty cells.
    precision: Precision,
    /// Where the cameras are: as the scene has them, or as the model has found out.
    cameras: Alignment,
    /// As what photograph's exposure and code views are rendered.
    appearance: Appearance,
    /// Where in a pixel its ray passes: 0.5 is the centre.
    pixel_offset: f64,
    /// `none`: floating-point renders, clamped to 0..=1, are compared.
    quantisation: &'static str,
    /// The mean of the views' PSNR in dB; null if it is infinite.
    psnr_mean: f64,
    /// The mean of the views' SSIM; null if the images are smaller than its window.
    ssim_mean: Option<f64>,
    /// Mean rendering time of a view.
    seconds_per_view: f64,
    /// Evaluations of densities and of colours for each pixel, and of both if nothing in the box were skipped.
    density_per_pixel: f64,
    color_per_pixel: f64,
    unskipped_per_pixel: f64,
    per_view: Vec<Score>,
}

/// From where views are rendered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
enum Alignment {
    /// From where the scene has its cameras: the model has learned nothing of them.
    #[serde(rename = "none")]
    None,
    /// From where the model has found the cameras of its photographs to be.
    #[serde(rename = "as learned")]
    Learned,
    /// Focal length and lens are those that were found; poses are the scene's.
    #[serde(rename = "focal length and lens as learned")]
    Glass,
    /// As well, and poses moved by the similarity that takes the training cameras from where they were given to where they
    /// were found.
    #[serde(rename = "similarity of the training cameras")]
    Similarity,
    /// From where the model shows each most nearly, found from where one of the above has them.
    #[serde(rename = "each fitted to its own photograph")]
    Fitted,
}

/// What is done about what photographs differ in and nobody knows of one that was held out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
enum Appearance {
    /// Nothing: the model takes all photographs to be alike.
    #[serde(rename = "none")]
    None,
    /// Views have the mean of what was learned of the photographs that were trained on: of their codes, and of their exposures.
    #[serde(rename = "mean of the training photographs")]
    Mean,
    /// Views have what was learned of the photograph itself: it was trained on.
    #[serde(rename = "each photograph's own")]
    Own,
    /// As the mean, and a gain for each channel makes the left half most like the photograph's; the right half is compared.
    #[serde(rename = "gains fitted to the left half, right half compared")]
    Half,
}

impl Appearance {
    fn of(model: &Model<f32>, split: Split, fit_half: bool) -> Self {
        let has_codes = model.config.field.get::<InstantConfig>().is_some_and(|field| field.codes > 0);
        match (fit_half, has_codes || model.config.tone.exposure.is_some()) {
            (true, _) => Appearance::Half,
            (_, false) => Appearance::None,
            (_, true) if split == Split::Train => Appearance::Own,
            (_, true) => Appearance::Mean,
        }
    }
}

impl Alignment {
    /// Puts the cameras of the photographs where the model has them.
    ///
    /// # Errors
    /// If a photograph is said to be one of those that were trained on, whose names are `trained`, and is not.
    fn apply(model: &Model<f32>, trained: &[String], split: Split, data: &mut Dataset) -> Result<Self> {
        let Some(refine) = &model.refine else { return Ok(Alignment::None) };
        if split == Split::Train {
            for frame in &mut data.frames {
                let number = trained.iter().position(|name| *name == frame.name).ok_or_else(|| {
                    let what = format!("the run was not trained on `{}`, and has not found its camera", frame.name);
                    Error::setting("scene", what)
                })?;
                frame.camera = model.learned_camera(number, &frame.camera);
            }
            return Ok(Alignment::Learned);
        }
        data.frames.iter_mut().for_each(|frame| frame.camera = model.other_camera(&frame.camera));
        Ok(match refine.placement(&model.params) {
            Some(_) => Alignment::Similarity,
            None if refine.has_poses() => Alignment::None,
            None => Alignment::Glass,
        })
    }
}

/// The result for one view.
#[derive(Serialize)]
struct Score {
    name: String,
    psnr: f64,
    ssim: Option<f64>,
}

/// Evaluates, writes the files and prints the result.
pub fn run(args: &Args) -> Result<()> {
    let run = Run::open(&args.run)?;
    let mut model = run.model()?;
    if let Some(skip) = args.skip {
        model.set_skip(skip);
    }
    let scene = run.scene(args.scene.as_ref())?;
    let opened = scene.open_for(&run.config.extent)?;
    let mut data = opened.load(args.split, run.config.downscale, args.views.unwrap_or(usize::MAX))?;
    if args.split != Split::Train
        && let Some(frame) = data.frames.iter().find(|frame| run.config.photographs.contains(&frame.name))
    {
        let what = format!(
            "holds out the {} photograph `{}`, which the run was trained on: the files have changed since",
            args.split, frame.name
        );
        return Err(Error::setting("scene", what));
    }
    let appearance = Appearance::of(&model, args.split, args.fit_half);
    // Corners are as dark in every photograph.
    model.vignetted = true;
    let mut cameras = Alignment::apply(&model, &run.config.photographs, args.split, &mut data)?;
    if args.fit_poses {
        note("fitting poses to photographs");
        let found = fitted_cameras(&model, data.clone())?;
        data.frames.iter_mut().zip(found).for_each(|(frame, camera)| frame.camera = camera);
        cameras = Alignment::Fitted;
    }
    let name = args.name();
    let pictures = run.file(&name);
    make_folder(&pictures)?;
    let (background, span) = (model.config.background, model.extent.span);
    let skip = model.marching().map(|marching| marching.config.occupancy.skip);
    let mut renderer = Renderer::new(model, args.precision)?;
    let own = |frame: &Frame| {
        let number = run.config.photographs.iter().position(|name| *name == frame.name);
        number.filter(|_| appearance == Appearance::Own).map(|number| number as u32)
    };
    let looks: Vec<Option<u32>> = data.frames.iter().map(own).collect();
    let (per_view, seconds_per_view, evaluations) =
        compare(&mut renderer, background, span, (&data, &looks), appearance, &pictures)?;
    let pixels: usize = data.frames.iter().map(|frame| frame.image.width * frame.image.height).sum();
    let per_pixel = |count: u64| count as f64 / pixels as f64;
    let report = Report {
        raygrad: env!("CARGO_PKG_VERSION"),
        scene: scene.absolute()?,
        split: args.split,
        views: per_view.len(),
        width: data.frames[0].image.width,
        height: data.frames[0].image.height,
        downscale: run.config.downscale,
        background: shown_background(background),
        skip,
        precision: args.precision,
        cameras,
        appearance,
        pixel_offset: 0.5,
        quantisation: "none",
        psnr_mean: mean(per_view.iter().map(|score| Some(score.psnr))).unwrap_or(f64::NAN),
        ssim_mean: mean(per_view.iter().map(|score| score.ssim)),
        seconds_per_view,
        density_per_pixel: per_pixel(evaluations.density),
        color_per_pixel: per_pixel(evaluations.color),
        unskipped_per_pixel: per_pixel(evaluations.unskipped),
        per_view,
    };
    let file = run.file(&format!("{name}.json"));
    write_json(&file, &report)?;
    // Pictures of an evaluation of other photographs under the same name would belong to no result.
    remove(&other_numbered(&pictures, DIGITS, &drawn(report.views)));
    if args.json {
        let text = serde_json::to_string_pretty(&report).map_err(|e| Error::file(&file, e))?;
        return print(&format!("{text}\n"));
    }
    print(&format!("{}written: {}, {}\n", table(&report), file.display(), pictures.display()))
}

/// The background that images are compared over: a random one is for training only.
fn shown_background(trained: Background) -> Background {
    match trained {
        Background::Random => Background::White,
        fixed => fixed,
    }
}

/// The mean, unless there is nothing or something is missing.
fn mean(values: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let count = values.len();
    let sum: Option<f64> = values.sum();
    sum.filter(|_| count > 0).map(|sum| sum / count as f64)
}

/// The numbers of the views of which a picture is written.
fn drawn(views: usize) -> Vec<usize> {
    evenly_spaced((0..views).collect(), PICTURES)
}

/// Scores all views, each with its look, and draws some; also the mean time of rendering one, in seconds, and what was evaluated for all.
fn compare(
    renderer: &mut Renderer,
    background: Background,
    span: [f64; 2],
    (data, looks): (&Dataset, &[Option<u32>]),
    appearance: Appearance,
    pictures: &Path,
) -> Result<(Vec<Score>, f64, Evaluations)> {
    let background = background.shown();
    let drawn = drawn(data.frames.len());
    let mut scores = Vec::with_capacity(data.frames.len());
    let (mut seconds, mut evaluations) = (0.0, Evaluations::default());
    let mut progress = Progress::new();
    for (i, (frame, look)) in data.frames.iter().zip(looks).enumerate() {
        let start = Instant::now();
        renderer.look_like(*look);
        let mut picture = renderer.view(&frame.camera, background);
        seconds += start.elapsed().as_secs_f64();
        evaluations = evaluations + picture.evaluations;
        let truth = frame.image.over(background);
        let half = if appearance == Appearance::Half { truth.width / 2 } else { 0 };
        if half > 0 {
            if frame.mask.is_some() && used(frame, &truth, half..truth.width).data.is_empty() {
                let what = format!("the mask of `{}` leaves nothing of its right half to compare", frame.name);
                return Err(Error::setting("fit-half", what));
            }
            let gains = gains(frame, &picture.color, &truth, half);
            scale(&mut picture.color, gains);
        }
        picture.color.data.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        let score = score(frame, &picture.color, &truth, half);
        if drawn.contains(&i) {
            draw(&picture, &truth, span).save_png(pictures.join(numbered(i, DIGITS)))?;
        }
        let done = i + 1;
        progress.set(done as f64 / data.frames.len() as f64, || {
            format!("view {done} of {}  {}  PSNR {:.2}", data.frames.len(), score.name, score.psnr)
        });
        scores.push(score);
    }
    Ok((scores, seconds / data.frames.len() as f64, evaluations))
}

/// The pixels of these columns of an image that are [used](Frame::mask), in a row.
fn used(frame: &Frame, image: &Image, columns: Range<usize>) -> Image {
    let places = (0..image.height).flat_map(|y| columns.clone().map(move |x| (x, y)));
    let used = places.filter(|(x, y)| frame.mask.as_ref().is_none_or(|mask| mask.uses(*x, *y)));
    let data: Vec<f32> = used.flat_map(|(x, y)| image.pixel(x, y).to_vec()).collect();
    Image { width: data.len() / 3, height: 1, channels: 3, data }
}

/// The factors of red, green and blue that make the columns before `half` of a render most like the photograph, in the sense of least
/// squares; 1 where there is nothing to multiply.
fn gains(frame: &Frame, render: &Image, truth: &Image, half: usize) -> [f32; 3] {
    let [render, truth] = [render, truth].map(|image| used(frame, image, 0..half));
    std::array::from_fn(|channel| {
        let pairs = render.data.iter().zip(&truth.data).skip(channel).step_by(3);
        let [both, own] = pairs.fold([0.0; 2], |[both, own], (&a, &b)| [both + a * b, own + a * a]);
        if own > 0.0 { both / own } else { 1.0 }
    })
}

fn scale(image: &mut Image, gains: [f32; 3]) {
    image.data.chunks_exact_mut(3).for_each(|pixel| pixel.iter_mut().zip(gains).for_each(|(x, gain)| *x *= gain));
}

/// Of the pixels from column `half` on that are used; where some are not, windows have no similarity to speak of.
fn score(frame: &Frame, render: &Image, truth: &Image, half: usize) -> Score {
    let name = frame.name.clone();
    let [seen, shown] = [render, truth].map(|image| used(frame, image, half..image.width));
    let psnr = psnr(&seen, &shown);
    let [width, height] = [truth.width - half, truth.height];
    let whole = frame.mask.is_none() && width >= SSIM_WINDOW && height >= SSIM_WINDOW;
    let shaped = |image: Image| Image { width, height, ..image };
    Score { name, psnr, ssim: whole.then(|| ssim(&shaped(seen), &shaped(shown))) }
}

/// Photograph, render, error and depth, side by side.
fn draw(picture: &Picture, truth: &Image, span: [f64; 2]) -> Image {
    let error = colormap::error_map(&picture.color, truth);
    Image::hconcat(&[truth, &picture.color, &error, &depth_colors(picture, span)])
}

fn table(report: &Report) -> String {
    let ssim = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    let mean_of = format!("mean of {}", report.views);
    let names = report.per_view.iter().map(|score| score.name.len());
    let width = names.chain([mean_of.len()]).max().unwrap_or(0);
    let mut text = format!("{:width$}  {:>7}  {:>7}\n", "view", "PSNR", "SSIM");
    for Score { name, psnr, ssim: similarity } in &report.per_view {
        text += &format!("{name:width$}  {psnr:>7.2}  {:>7}\n", ssim(*similarity));
    }
    text += &format!("{mean_of:width$}  {:>7.2}  {:>7}\n", report.psnr_mean, ssim(report.ssim_mean));
    let Report { split, background, seconds_per_view, .. } = report;
    let size = format!("{}x{}", report.width, report.height);
    text += &format!("{split} views of {size} over {background}, {seconds_per_view:.2} s to render each\n");
    text += match report.appearance {
        Appearance::None => "",
        Appearance::Own => "exposures and codes: each photograph's own\n",
        Appearance::Mean => "exposures and codes: the mean of the training photographs'\n",
        Appearance::Half => "compared: right halves, after gains that were fitted to left halves\n",
    };
    text + match report.cameras {
        Alignment::None => "",
        Alignment::Learned => "cameras: as learned\n",
        Alignment::Fitted => "cameras: each fitted to its own photograph\n",
        Alignment::Glass => "cameras: focal length and lens as learned\n",
        Alignment::Similarity => "cameras: moved as those of the training photographs have as a whole\n",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::dataset::{Mask, embedded};
    use std::sync::Arc;

    #[test]
    fn gains_make_up_for_an_exposure_and_the_other_half_is_compared() {
        let mut frame = embedded(Split::Test, 26).frames.remove(0);
        let truth = frame.image.over([1.0; 3]);
        // Too dark by a factor for each channel, but for one pixel on the right.
        let mut render = truth.clone();
        scale(&mut render, [0.5, 0.8, 1.25]);
        let found = gains(&frame, &render, &truth, 13);
        assert!(found.iter().zip([2.0, 1.25, 0.8]).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
        scale(&mut render, found);
        assert!(score(&frame, &render, &truth, 13).psnr > 100.0);
        render.pixel_mut(20, 7)[1] += 0.5;
        // A quarter, of 13 x 26 pixels of 3 channels; the similarity is that of the right half.
        let off = score(&frame, &render, &truth, 13);
        assert!((off.psnr - 10.0 * (3.0 * 13.0 * 26.0 / 0.25_f64).log10()).abs() < 1e-3, "{}", off.psnr);
        assert!(off.ssim.unwrap() < 0.999 && score(&frame, &render, &truth, 0).psnr > off.psnr + 2.9);
        render.pixel_mut(3, 7)[1] = 9.0;
        assert_eq!(score(&frame, &render, &truth, 13).psnr, off.psnr, "what was fitted to is not compared");
        // Pixels that are not used neither fit nor count; a render of nothing has no gain.
        let mask = Mask::new(26, 26, |x, y| y != 7 || (x != 3 && x != 20));
        frame.mask = Some(Arc::new(mask));
        let masked = score(&frame, &render, &truth, 13);
        assert!(masked.psnr > 100.0 && masked.ssim.is_none(), "{}", masked.psnr);
        assert!(gains(&frame, &render, &truth, 13).iter().all(|gain| (gain - 1.0).abs() < 1e-5));
        assert_eq!(gains(&frame, &Image::new(26, 26, 3), &truth, 13), [1.0; 3]);
    }
}
