//! Pictures of what pages want to see: a coarse one at once, and finer ones for as long as it is wanted.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use raygrad::nerf::dataset::Placement;
use raygrad::nerf::glam::{DAffine3, DVec3};
use raygrad::nerf::pictures::colormap;
use raygrad::nerf::pictures::metrics::psnr;
use raygrad::nerf::{Camera, Image, Limits, Model, Picture, Viewing};

use super::album::Album;
use super::hub::{Hub, Outgoing, Save, Shot, Wish};
use super::messages::{Eye, File, Made, Show, View, at_size};
use crate::cli::output::depth_colors;
use crate::cli::render::shown::{facing, over};

/// How long the first picture of a view may take, and a piece of a finer one, in seconds.
const FIRST: f64 = 0.035;
const PIECE: f64 = 0.08;
/// Rays a second of a model that nothing is known of.
const RATE: f64 = 1e5;
/// Weight of the latest piece in the rate that is expected of the next one.
const LATEST: f64 = 0.5;
/// At most so many times the size is halved: coarser pictures show nothing.
const MOST_HALVINGS: u32 = 5;
/// Quality of JPEG files, 1 to 100, of coarse pictures and of whole ones.
const QUALITY: [u8; 2] = [75, 92];
/// How often a picture is painted again while a model learns, at most.
const AGAIN: Duration = Duration::from_millis(500);

/// Paints, a piece at a time.
pub struct Painter {
    hub: Arc<Hub>,
    album: Option<Arc<Album>>,
    jobs: Vec<Job>,
    /// Rays a second, of what was shown lately.
    rates: HashMap<(Show, bool), f64>,
    turn: u64,
    /// Whether the last turn was that of something new.
    fresh: bool,
}

/// What is being painted.
struct Job {
    target: Target,
    /// How often the size of what is painted now is halved.
    halvings: u32,
    /// What there is of it so far.
    parts: Parts,
    spent: Duration,
    /// When it was worked on last, in turns.
    turn: u64,
    /// The step of training at which its picture was begun.
    begun: u64,
    /// If it rests: since which step of training, and when.
    whole: Option<(u64, Instant)>,
}

enum Target {
    Wish(Arc<Wish>),
    Save(Save),
}

/// The rows of a picture that are painted.
struct Parts {
    camera: Camera,
    /// The photograph that it is compared with, in its size.
    truth: Option<(usize, Image)>,
    color: Image,
    rows: usize,
    /// How many rows are painted at a time; before the first, none.
    band: usize,
}

impl Painter {
    pub fn new(hub: Arc<Hub>, album: Option<Arc<Album>>) -> Self {
        Painter { hub, album, jobs: vec![], rates: HashMap::new(), turn: 0, fresh: false }
    }

    /// Paints the next piece, of a model that is at this step; says whether there was anything to paint.
    pub fn work(&mut self, model: &Model<f32>, step: u64) -> bool {
        self.sync(model, step);
        // What nobody has seen anything of comes first, but not again before something else had its turn.
        let others = self.jobs.iter().any(|job| job.whole.is_none() && job.turn > 0);
        let skips = self.fresh && others;
        let waiting = self.jobs.iter_mut().filter(|job| job.whole.is_none() && !(skips && job.turn == 0));
        let Some(job) = waiting.min_by_key(|job| job.turn) else { return false };
        self.fresh = job.turn == 0;
        self.turn += 1;
        job.turn = self.turn;
        let (hub, album) = (self.hub.clone(), self.album.clone());
        let wanted = match &job.target {
            Target::Wish(wish) => Wanted::Wish(&hub, wish.clone()),
            Target::Save(save) => Wanted::Page(&hub, save.client),
        };
        let view = job.target.view().clone();
        let rate = self.rates.entry((view.show, view.exact)).or_insert(RATE);
        let start = Instant::now();
        if !job.parts.paint(&view, model, *rate, &|| wanted.holds()) {
            return true;
        }
        let spent = start.elapsed();
        job.spent += spent;
        job.parts.pace(spent);
        if job.parts.rows == job.parts.camera.height {
            // Of the whole picture: where there is nothing, rays are quick.
            let rays = job.parts.camera.width * job.parts.camera.height;
            let now = rays as f64 / job.spent.as_secs_f64().max(1e-6);
            *rate += LATEST * (now - *rate);
            job.deliver(&hub, step);
            // While a model learns, pictures are seen again rather than made ever finer.
            let stands = job.begun == step;
            let soon = halvings(view.size, now, AGAIN.as_secs_f64());
            match job.halvings {
                finer if finer > 0 && (stands || finer > soon) => {
                    job.halvings -= 1;
                    job.begin(model, album.as_deref(), step);
                }
                _ => job.rest(step),
            }
        }
        true
    }

    /// Forgets what nobody wants any more, and begins what is new.
    fn sync(&mut self, model: &Model<f32>, step: u64) {
        let wishes = self.hub.wishes();
        self.jobs.retain(|job| match &job.target {
            Target::Wish(wish) => wishes.iter().any(|own| Arc::ptr_eq(own, wish)),
            Target::Save(save) => job.whole.is_none() && self.hub.is_here(save.client),
        });
        for wish in wishes {
            let known = |job: &Job| matches!(&job.target, Target::Wish(own) if Arc::ptr_eq(own, &wish));
            if !self.jobs.iter().any(known) {
                let rate = self.rates.get(&(wish.view.show, wish.view.exact)).copied().unwrap_or(RATE);
                let halvings = halvings(wish.view.size, rate, FIRST);
                self.jobs.push(Job::new(Target::Wish(wish), halvings, model, self.album.as_deref(), step));
            }
        }
        // One after the other: each has a picture's memory.
        if !self.jobs.iter().any(|job| matches!(job.target, Target::Save(_)))
            && let Some(save) = self.hub.next_save()
        {
            self.jobs.push(Job::new(Target::Save(save), 0, model, self.album.as_deref(), step));
        }
        for job in &mut self.jobs {
            let Some((seen, when)) = job.whole else { continue };
            if when.elapsed() <= AGAIN.max(job.spent) {
                continue;
            }
            if seen == step && job.halvings > 0 {
                // It has not learned for a while: it is held.
                job.halvings -= 1;
                job.begin(model, self.album.as_deref(), step);
            } else if seen != step {
                // What has learned more is seen again, as fine as there is time for.
                let view = job.target.view();
                let rate = self.rates.get(&(view.show, view.exact)).copied().unwrap_or(RATE);
                job.halvings = halvings(view.size, rate, AGAIN.as_secs_f64());
                job.begin(model, self.album.as_deref(), step);
            }
        }
    }
}

/// How often a size is to be halved for a picture to be there in so many seconds.
fn halvings([width, height]: [u32; 2], rate: f64, seconds: f64) -> u32 {
    let rays = f64::from(width) * f64::from(height);
    let needed = (rays / (rate * seconds)).log2() / 2.0;
    let most = u32::min(width, height).ilog2().saturating_sub(2).min(MOST_HALVINGS);
    (needed.ceil().max(0.0) as u32).min(most)
}

enum Wanted<'a> {
    Wish(&'a Hub, Arc<Wish>),
    Page(&'a Hub, u64),
}

impl Wanted<'_> {
    fn holds(&self) -> bool {
        match self {
            Wanted::Wish(hub, wish) => hub.wants(wish),
            Wanted::Page(hub, client) => hub.is_here(*client),
        }
    }
}

impl Target {
    fn view(&self) -> &View {
        match self {
            Target::Wish(wish) => &wish.view,
            Target::Save(save) => &save.view,
        }
    }
}

impl Job {
    fn new(target: Target, halvings: u32, model: &Model<f32>, album: Option<&Album>, step: u64) -> Self {
        let parts = Parts::new(target.view(), halvings, model, album);
        Job { target, halvings, parts, spent: Duration::ZERO, turn: 0, begun: step, whole: None }
    }

    /// Begins a picture at the size that is next.
    fn begin(&mut self, model: &Model<f32>, album: Option<&Album>, step: u64) {
        self.parts = Parts::new(self.target.view(), self.halvings, model, album);
        (self.spent, self.begun, self.whole) = (Duration::ZERO, step, None);
    }

    /// Nothing is to be done for now, and no memory is needed.
    fn rest(&mut self, step: u64) {
        (self.parts.color, self.parts.truth) = (Image::new(1, 1, 3), None);
        self.whole = Some((step, Instant::now()));
    }

    /// Gives away a picture whose rows are all painted.
    fn deliver(&mut self, hub: &Hub, step: u64) {
        let Parts { truth, color, .. } = &self.parts;
        let compared = truth.as_ref().map(|(number, truth)| (*number, psnr(color, truth)));
        let error = truth.as_ref().map(|(_, truth)| colormap::error_map(color, truth));
        let image = error.as_ref().unwrap_or(color);
        let milliseconds = 1e3 * self.spent.as_secs_f64();
        let made = Made { halvings: self.halvings, milliseconds, compared, step };
        match &self.target {
            Target::Wish(wish) => {
                let jpeg = image.to_jpeg(QUALITY[usize::from(self.halvings == 0)]);
                hub.show(wish, Shot { made, jpeg });
            }
            Target::Save(save) => {
                let message = File::Save { name: "view.png".to_owned() }.message(&image.to_png());
                hub.post(save.client, Outgoing::Bytes(message));
            }
        }
    }
}

impl Parts {
    fn new(view: &View, halvings: u32, model: &Model<f32>, album: Option<&Album>) -> Self {
        let [width, height] = view.size.map(|side| (side as usize).div_ceil(1 << halvings));
        let own = |number: usize| album.and_then(|album| album.camera(number, model));
        let (number, free) = match &view.eye {
            Eye::Free { pose, fov } => (None, View::camera(pose, *fov, [width, height])),
            Eye::Photograph(number) => (Some(*number), Camera::from_angle(width, height, 1.0, DAffine3::IDENTITY)),
        };
        let nearest = || album.and_then(|album| album.nearest(&free, model));
        let compares = view.show == Show::Error;
        let number = number.or_else(|| if compares { nearest() } else { None });
        let Some((number, camera)) = number.and_then(|number| Some((number, own(number)?))) else {
            return Parts::of(free, None);
        };
        let photo = album.filter(|_| compares).and_then(|album| album.photo(number).ok());
        // Photographs have proportions of their own, of which all is to be seen; and they are not made larger to be compared.
        let largest =
            photo.as_ref().map_or([width, height], |photo| [photo.width.min(width), photo.height.min(height)]);
        let sides = [camera.width, camera.height];
        let share = (0..2).map(|i| largest[i] as f64 / sides[i] as f64).fold(f64::INFINITY, f64::min);
        let [w, h] = [0, 1].map(|i| ((sides[i] as f64 * share).round() as usize).clamp(1, largest[i]));
        Parts::of(
            camera.resized(w, h),
            photo.map(|photo| (number, at_size(&photo, [w, h], model.config.background.shown()))),
        )
    }

    fn of(camera: Camera, truth: Option<(usize, Image)>) -> Self {
        let color = Image::new(camera.width, camera.height, 3);
        Parts { camera, truth, color, rows: 0, band: 0 }
    }

    /// Paints as many rows as there is time for; says whether it did, and was not stopped.
    fn paint(&mut self, view: &View, model: &Model<f32>, rate: f64, goes_on: &(dyn Fn() -> bool + Sync)) -> bool {
        self.try_paint(view, model, rate, goes_on).is_some()
    }

    fn try_paint(
        &mut self,
        view: &View,
        model: &Model<f32>,
        rate: f64,
        goes_on: &(dyn Fn() -> bool + Sync),
    ) -> Option<()> {
        let Camera { width, height, centre, .. } = self.camera;
        if self.band == 0 {
            self.band = (rate * PIECE / width as f64) as usize;
        }
        self.band = self.band.clamp(1, height);
        let rows = self.band.min(height - self.rows);
        // What is above lies outside of the picture.
        let band = Camera { height: rows, centre: [centre[0], centre[1] - self.rows as f64], ..self.camera.clone() };
        let background = match view.background {
            Some(color) => color.map(|value| f32::from(value) / 255.0),
            None => model.config.background.shown(),
        };
        // As evaluations have it.
        let background = if self.truth.is_some() { model.config.background.shown() } else { background };
        let everywhere = Viewing::over(background).within;
        let within = view.within.map_or(everywhere, |corners| corners.map(DVec3::from));
        let limits = view.exact.then_some(Limits::NONE);
        let viewing = Viewing { background, limits, within, goes_on };
        let picture = model.view_while(&band, &viewing)?;
        let image = match view.show {
            Show::Color | Show::Error => picture.color,
            Show::Depth => depth_colors(&picture, model.extent.span),
            Show::Opacity => grey(&picture),
            Show::Normals => normals(model, &band, &viewing, &picture, &model.extent.placement)?,
        };
        let start = 3 * width * self.rows;
        self.color.data[start..start + image.data.len()].copy_from_slice(&image.data);
        self.rows += rows;
        Some(())
    }

    /// Chooses the next rows by how long the last ones took: few more than those, as they may show more.
    fn pace(&mut self, spent: Duration) {
        let fitting = self.band as f64 * PIECE / spent.as_secs_f64().max(1e-4);
        self.band = (fitting as usize).clamp(1, 2 * self.band);
    }
}

/// Opacity as a colour.
fn grey(picture: &Picture) -> Image {
    let Image { width, height, ref data, .. } = picture.opacity;
    Image { width, height, channels: 3, data: data.iter().flat_map(|x| [*x; 3]).collect() }
}

fn normals(
    model: &Model<f32>,
    camera: &Camera,
    viewing: &Viewing<'_>,
    picture: &Picture,
    placement: &Placement,
) -> Option<Image> {
    let colors = facing(model.normals_while(camera, viewing)?, placement);
    Some(over(&colors, &picture.opacity, viewing.background))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_picture_is_there_at_once() {
        for (size, rate) in [([800, 800], 1e5), ([400, 300], 1e6), ([4000, 1000], 3e4)] {
            let times = halvings(size, rate, FIRST);
            let rays = |times: u32| size.map(|side: u32| f64::from(side.div_ceil(1 << times))).iter().product::<f64>();
            assert!(rays(times) <= 1.1 * FIRST * rate || times == MOST_HALVINGS, "{size:?}: {times}");
            assert!(times == 0 || rays(times - 1) > FIRST * rate, "{size:?}: {times}");
        }
        // Nothing is smaller than a few pixels, and what is quick is whole.
        let at_once = |size: [u32; 2], rate: f64| halvings(size, rate, FIRST);
        assert_eq!([at_once([8, 8], 1.0), at_once([3, 3000], 1.0), at_once([640, 480], 1e9)], [1, 0, 0]);
    }
}
