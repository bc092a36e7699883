//! Progressive rendering: a coarse render first, then finer ones while the request lasts.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use raygrad::nerf::glam::DAffine3;
use raygrad::nerf::imaging::colormap;
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Camera, Model};

use super::cache::Cached;
use super::messages::{Eye, File, Made, View};
use super::model_cache::{ModelCache, ModelKey};
use super::photo_cache::PhotoCache;
use super::requests::{Outgoing, RenderRequest, RenderedFrame, Requests, Save};
use super::row_tiles::{LARGE, RowTiles};
use super::server::sorry;
use crate::render::shown::Show;

/// Time limit of the first render of a view, in seconds.
const FIRST: f64 = 0.035;
/// Assumed rays per second of an unmeasured model.
const RATE: f64 = 1e5;
/// Weight of the latest tile in the estimate of the rate.
const LATEST: f64 = 0.5;
/// Most halvings of the size. Coarser renders are useless.
const MOST_HALVINGS: u32 = 7;
/// Most large renders in progress, which limits memory.
const MOST_LARGE: usize = 4;
/// JPEG quality, 1 to 100, of coarse and of full-size renders.
const QUALITY: [u8; 2] = [75, 92];
/// Minimum interval between new renders of a view during training.
const AGAIN: Duration = Duration::from_millis(500);

/// Renders the requests, tile by tile.
pub struct Renderer {
    requests: Arc<Requests>,
    photos: Option<Arc<PhotoCache>>,
    /// Models other than the current one, if available.
    models: Option<ModelCache>,
    jobs: Vec<Job>,
    /// Measured rays per second, by output and skipping.
    rates: HashMap<(Show, Option<Skip>), f64>,
    turn: u64,
    /// True if the last tile was the first one of a job.
    fresh: bool,
}

/// A render in progress.
struct Job {
    target: Target,
    /// Halvings of the size of the current render.
    halvings: u32,
    /// The rows so far; `None` before the start and while the job rests.
    parts: Option<RowTiles>,
    spent: Duration,
    /// The turn of the last tile.
    turn: u64,
    /// Training step at the start of the render.
    begun: u64,
    /// True if evaluation uses the same comparison.
    plain: bool,
    /// If the job rests: the training step of its last render, and the time.
    whole: Option<(u64, Instant)>,
}

enum Target {
    Wish(Arc<RenderRequest>),
    Save(Save),
}

impl Renderer {
    pub fn new(requests: Arc<Requests>, photos: Option<Arc<PhotoCache>>, models: Option<ModelCache>) -> Self {
        Renderer { requests, photos, models, jobs: vec![], rates: HashMap::new(), turn: 0, fresh: false }
    }

    /// Renders the next tile with a model at this step. Returns false if there is nothing to render.
    pub fn work(&mut self, model: &Model<f32>, step: u64) -> bool {
        self.sync(step);
        // New jobs come first, unless the last tile was the first one of a job.
        let mut waiting: Vec<usize> = (0..self.jobs.len()).filter(|i| self.jobs[*i].whole.is_none()).collect();
        waiting.sort_by_key(|i| (self.fresh && self.jobs[*i].turn == 0, self.jobs[*i].turn));
        let ready = waiting.into_iter().find_map(|i| self.prepare(i, model, step).map(|(own, step)| (i, own, step)));
        let Some((i, own, step)) = ready else { return false };
        let (learns, model, job) = (self.models.is_none(), own.as_deref().unwrap_or(model), &mut self.jobs[i]);
        let Some(parts) = &mut job.parts else { return false };
        self.fresh = job.turn == 0;
        self.turn += 1;
        job.turn = self.turn;
        let requests = &self.requests;
        let wanted = || match &job.target {
            Target::Wish(wish) => requests.wants(wish),
            Target::Save(save) => requests.is_here(save.client),
        };
        let view = job.target.view();
        let rate = self.rates.entry((view.show, view.skip)).or_insert(RATE);
        // A saved render comes from one training step, so all its tiles are rendered now.
        let whole = learns && matches!(job.target, Target::Save(_));
        loop {
            let start = Instant::now();
            let painted = parts.paint(view, model, *rate, &wanted);
            let spent = start.elapsed();
            job.spent += spent;
            if painted.is_none() {
                // A cancelled tile gives an upper bound of the rate.
                *rate = rate.min(speed(parts.asked(), job.spent));
                return true;
            }
            parts.lr_scale(spent);
            if !whole || parts.is_whole() {
                break;
            }
        }
        if parts.is_whole() {
            // The rate of the whole render, since rays through empty space are fast.
            let now = speed(parts.camera.width * parts.camera.height, job.spent);
            *rate = expected(*rate, now);
            let soon = halvings(view.size, now, AGAIN.as_secs_f64());
            job.deliver(requests, self.photos.as_deref(), step);
            match finer(job.halvings, job.begun == step, soon) {
                Some(halvings) => job.begin(halvings),
                None => job.rest(step),
            }
        }
        true
    }

    /// Renders the next tile, or waits for a request for at most this time.
    pub fn work_or_wait(&mut self, model: &Model<f32>, step: u64, most: Duration) {
        if !self.work(model, step) {
            self.requests.wait(most);
        }
    }

    /// Starts a render if its inputs are ready. Returns its step, and its model, if that is not the current one.
    fn prepare(&mut self, i: usize, model: &Model<f32>, step: u64) -> Option<(Option<Arc<Model<f32>>>, u64)> {
        let view = self.jobs[i].target.view();
        let unknown = match (&view.eye, &self.photos) {
            (Eye::Photograph(_), None) => true,
            (Eye::Photograph(number), Some(photos)) => !photos.has(*number),
            (Eye::Free { .. }, photos) => view.compared && photos.is_none(),
        };
        if unknown {
            return self.refuse(i, "there is no such image, or the run's images are not available");
        }
        if self.models.is_none() && view.checkpoint.is_some() {
            return self.refuse(i, "checkpoints can be shown only after training");
        }
        if self.models.is_none() && !matches!(view.skip, None | Some(Skip::Off)) {
            return self.refuse(i, "during training, choose skipping `as in training` or `off`");
        }
        let (own, step) = match (&self.models, ModelKey::of(view)) {
            (Some(models), which) => match models.get(which, &self.requests) {
                Cached::Here(own) => (Some(own), which.checkpoint.unwrap_or(step)),
                Cached::Coming => return None,
                Cached::Failed(what) => return self.refuse(i, &what),
            },
            (None, _) => (None, step),
        };
        let model = own.as_deref().unwrap_or(model);
        if self.jobs[i].parts.is_none() {
            let size = view.size.map(|side| (side as usize).div_ceil(1 << self.jobs[i].halvings));
            let large = self.jobs.iter().filter_map(|job| job.parts.as_ref()).filter(|parts| parts.is_large()).count();
            if size[0] * size[1] > LARGE && large >= MOST_LARGE {
                return None;
            }
            let (number, camera) = self.camera(view, size, model);
            let truth = match (&self.photos, number.filter(|_| view.compared)) {
                (Some(photos), Some(number)) => match photos.fetch(number, &self.requests) {
                    Cached::Here(photo) => Some((number, photo)),
                    Cached::Coming => return None,
                    Cached::Failed(what) => return self.refuse(i, &what),
                },
                _ => None,
            };
            let job = &mut self.jobs[i];
            // The PSNR would differ from evaluation if that uses masks, exposure correction or an image's own
            // embedding.
            let own = |number| self.photos.as_ref().is_some_and(|photos| photos.is_special(number, model));
            job.plain = model.exposure.is_none() && !number.is_some_and(own);
            (job.parts, job.begun) = (Some(RowTiles::new(camera, number.is_some(), size, truth, model)), step);
        }
        Some((own, step))
    }

    /// The camera of a view, and the number of its image, if it is an image's camera.
    fn camera(&self, view: &View, size: [usize; 2], model: &Model<f32>) -> (Option<usize>, Camera) {
        let photos = self.photos.as_deref();
        let (number, free) = match &view.eye {
            Eye::Free { pose, fov } => (None, View::camera(pose, *fov, size)),
            Eye::Photograph(number) => (Some(*number), Camera::from_angle(size[0], size[1], 1.0, DAffine3::IDENTITY)),
        };
        let nearest = || photos.filter(|_| view.compared).and_then(|photos| photos.nearest(&free, model));
        let own = |number: usize| Some((number, photos?.camera(number, model)?));
        match number.or_else(nearest).and_then(own) {
            Some((number, camera)) => (Some(number), camera),
            None => (None, free),
        }
    }

    /// Sends the reason to the pages of a failed request.
    fn refuse<T>(&mut self, i: usize, what: &str) -> Option<T> {
        match &self.jobs[i].target {
            Target::Wish(wish) => self.requests.refuse(wish, what),
            Target::Save(save) => self.requests.post(save.client, sorry(what)),
        }
        // The next synchronisation removes the job.
        self.jobs[i].rest(0);
        None
    }

    /// Drops all jobs, as no page is connected.
    pub fn clear(&mut self) {
        self.jobs.clear();
    }

    /// Removes jobs without a request and adds jobs for new requests.
    fn sync(&mut self, step: u64) {
        let wishes = self.requests.wishes();
        self.jobs.retain(|job| match &job.target {
            Target::Wish(wish) => wishes.iter().any(|own| Arc::ptr_eq(own, wish)),
            Target::Save(save) => job.whole.is_none() && self.requests.is_here(save.client),
        });
        let halved = |view: &View, seconds: f64| {
            halvings(view.size, self.rates.get(&(view.show, view.skip)).copied().unwrap_or(RATE), seconds)
        };
        for wish in wishes {
            let known = |job: &Job| matches!(&job.target, Target::Wish(own) if Arc::ptr_eq(own, &wish));
            if !self.jobs.iter().any(known) {
                let halvings = halved(&wish.view, FIRST);
                self.jobs.push(Job::new(Target::Wish(wish), halvings));
            }
        }
        // One save at a time, since each has a full render in memory.
        if !self.jobs.iter().any(|job| matches!(job.target, Target::Save(_)))
            && let Some(save) = self.requests.next_save()
        {
            self.jobs.push(Job::new(Target::Save(save), 0));
        }
        for job in &mut self.jobs {
            let view = job.target.view();
            // The render of a checkpoint does not change.
            let now = if self.models.is_some() { view.checkpoint.unwrap_or(step) } else { step };
            let Some((seen, when)) = job.whole else { continue };
            if when.elapsed() <= AGAIN.max(job.spent) {
                continue;
            }
            if seen == now && job.halvings > 0 {
                // Training is paused, so the next render is finer.
                job.begin(job.halvings - 1);
            } else if seen != now {
                // The model has changed, so the view is rendered again, as fine as the interval allows.
                let halvings = halved(view, AGAIN.as_secs_f64());
                job.begin(halvings);
            }
        }
    }
}

/// Estimate of the rate: the weighted geometric mean, as both values may be far off.
fn expected(rate: f64, now: f64) -> f64 {
    rate * (now / rate).powf(LATEST)
}

/// Rays per second.
fn speed(rays: usize, spent: Duration) -> f64 {
    rays as f64 / spent.as_secs_f64().max(1e-6)
}

/// Halvings of the next, finer render, if there is one. During training, no render is finer than the interval `soon`
/// allows. The view is rendered again instead.
fn finer(halvings: u32, is_still: bool, soon: u32) -> Option<u32> {
    (halvings > 0 && (is_still || halvings > soon)).then(|| halvings - 1)
}

/// Halvings of the size for a render within this time.
fn halvings([width, height]: [u32; 2], rate: f64, seconds: f64) -> u32 {
    let rays = f64::from(width) * f64::from(height);
    let needed = (rays / (rate * seconds)).log2() / 2.0;
    let most = u32::min(width, height).ilog2().saturating_sub(2).min(MOST_HALVINGS);
    (needed.ceil().max(0.0) as u32).min(most)
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
    fn new(target: Target, halvings: u32) -> Self {
        Job { target, halvings, parts: None, spent: Duration::ZERO, turn: 0, begun: 0, plain: true, whole: None }
    }

    /// Starts a render at another size.
    fn begin(&mut self, halvings: u32) {
        (self.halvings, self.parts, self.spent, self.whole) = (halvings, None, Duration::ZERO, None);
    }

    /// Frees the memory of a job until its view changes.
    fn rest(&mut self, step: u64) {
        (self.parts, self.whole) = (None, Some((step, Instant::now())));
    }

    /// Sends a render that is complete.
    fn deliver(&mut self, requests: &Requests, photos: Option<&PhotoCache>, step: u64) {
        let Some(RowTiles { truth, color, .. }) = &self.parts else { return };
        // Only a full-size render of one training step has a PSNR.
        let plain = self.plain && self.halvings == 0 && self.begun == step;
        let is_evaluated =
            |number| plain && photos.is_some_and(|photos| photos.is_evaluated_at(number, [color.width, color.height]));
        let compared =
            truth.as_ref().map(|(number, truth)| (*number, plain.then(|| psnr(color, truth)), is_evaluated(*number)));
        let error = truth.as_ref().map(|(_, truth)| colormap::error_map(color, truth));
        let image = error.as_ref().unwrap_or(color);
        let milliseconds = 1e3 * self.spent.as_secs_f64();
        let made = Made { halvings: self.halvings, milliseconds, compared, step };
        match &self.target {
            Target::Wish(wish) => {
                let jpeg = image.to_jpeg(QUALITY[usize::from(self.halvings == 0)]);
                requests.show(wish, RenderedFrame { made, jpeg });
            }
            Target::Save(save) => {
                let message = File::Save { name: "view.png".to_owned() }.message(&image.to_png());
                requests.post(save.client, Outgoing::Bytes(message));
            }
        }
    }
}

#[cfg(test)]
mod tests;
