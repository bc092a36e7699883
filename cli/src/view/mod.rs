//! `raygrad view`: the browser viewer.

mod access;
mod cache;
mod connection;
mod forward;
pub mod messages;
mod model_cache;
mod networks;
mod photo_cache;
mod renderer;
mod requests;
mod row_tiles;
mod served;
mod server;
mod training_viewer;
mod video_jobs;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use raygrad::nerf::dataset::SceneTransform;
use raygrad::nerf::glam::{DAffine3, DMat3, DVec3};
use raygrad::nerf::{Model, Result};

use super::checkpoint;
use super::output::{complain, note, print};
use super::photographs::learned_transform;
use super::run::Run;
use super::scene::Scene;
use forward::ForwardPage;
use messages::{About, FirstView, ServerMessage, Taken, rows};
use model_cache::ModelCache;
use photo_cache::PhotoCache;
use renderer::Renderer;
use requests::Requests;
use video_jobs::VideoJobs;

use served::Limits;
pub use server::Listener;
pub use training_viewer::TrainingViewer;

/// The camera controls, shared by all pages.
pub const CAMERA: &str = include_str!("page/camera.js");

/// Loopback address, which other machines cannot reach.
const HOST: &str = "127.0.0.1";

/// Open a run in the browser viewer
///
/// raygrad serves the page itself, to this machine only unless --host says otherwise. Ctrl-C ends it.
///
/// Example: raygrad view my-run --open
#[derive(clap::Args)]
pub struct Args {
    /// Run folder, made by `raygrad train`
    run: PathBuf,
    #[command(flatten)]
    place: PlaceArgs,
    /// Open the viewer in the browser
    #[arg(long, help_heading = "Viewer")]
    open: bool,
    /// Image folder, if it moved after training
    ///
    /// Without it, raygrad reads the images from where they were during training.
    #[arg(long, help_heading = "Scene")]
    scene: Option<Scene>,
}

/// Address and port of the viewer.
#[derive(Debug, Clone, clap::Args)]
pub struct PlaceArgs {
    /// Address to serve on
    ///
    /// 127.0.0.1 serves this machine only. The link holds a token, which gives access.
    /// The connection is not encrypted.
    #[arg(long, help_heading = "Viewer", default_value = HOST)]
    host: String,
    /// Port to serve on [default: a free one]
    #[arg(long, help_heading = "Viewer", default_value_t = 0, hide_default_value = true)]
    port: u16,
}

impl PlaceArgs {
    /// Returns true if an option differs from its default.
    pub fn are_given(&self) -> bool {
        self.host != HOST || self.port != 0
    }

    /// Binds the port.
    ///
    /// # Errors
    ///
    /// Fails if the host is unknown or the port is in use.
    pub fn listen(&self) -> Result<Listener> {
        Listener::bind(&self.host, self.port)
    }
}

/// Serves the viewer until it is interrupted.
pub fn run(args: &Args) -> Result<()> {
    let run = Arc::new(Run::open(&args.run)?);
    let model = Arc::new(run.model()?);
    let (requests, photos) = (Arc::new(Requests::default()), photos(&run, args.scene.as_ref()));
    requests.introduce(about(&run, &model, photos.as_deref(), Some(checkpoint::steps(&run)?)));
    let video_jobs = Arc::new(VideoJobs::new(run.clone(), args.scene.clone(), requests.clone()));
    let background = model.config.background.shown();
    let link = server::serve(
        Limits::USUAL,
        args.place.listen()?,
        requests.clone(),
        photos.clone(),
        Some(video_jobs),
        background,
    )?;
    print(&format!("view     {link}\n         Ctrl-C ends the viewer\n"))?;
    let mut forward = args.open.then(|| ForwardPage::open(&run.folder, &link)).and_then(|opened| match opened {
        Ok(page) => Some(page),
        Err(error) => {
            complain(&format!("warning: cannot open a browser: {error}"));
            None
        }
    });
    let mut renderer = Renderer::new(requests.clone(), photos, Some(ModelCache::new(run, model.clone())));
    loop {
        renderer.work_or_wait(&model, 0, Duration::from_secs(1));
        forward.take_if(|page| requests.connected() > 0 || page.is_old());
    }
}

/// The images of a run. The viewer also works without them.
fn photos(run: &Run, scene: Option<&Scene>) -> Option<Arc<PhotoCache>> {
    match PhotoCache::open(run, scene) {
        Ok(photos) => Some(Arc::new(photos)),
        Err(error) => {
            note(&format!("the viewer shows no images: {error}"));
            None
        }
    }
}

/// The initial view of a scene.
pub fn first_view(run: &Run) -> FirstView {
    let (view, extent) = (&run.config.viewpoint, &run.config.scene_box);
    let camera = &view.orbit(extent, 1)[0];
    FirstView {
        pose: rows(&camera.pose),
        fov: 2.0 * (0.5 * camera.height as f64 / camera.focal[1]).atan().to_degrees(),
        proportion: camera.width as f64 / camera.height as f64,
        bounds: extent.bounds.map(|corner| corner.to_array()),
    }
}

/// The description of a scene for pages. `checkpoints` lists the available ones, if the scene is not being trained.
fn about(run: &Run, model: &Model<f32>, photos: Option<&PhotoCache>, checkpoints: Option<Vec<u64>>) -> String {
    let view = &run.config.viewpoint;
    let about = About {
        title: run.name(),
        first: first_view(run),
        size: [view.width, view.height],
        background: model.config.background.shown(),
        taken: taken(run, model, photos),
        points: photos.map_or(vec![], |photos| photos.points(model)),
        training: checkpoints.is_none(),
        checkpoints: checkpoints.unwrap_or_default(),
    };
    messages::text(&ServerMessage::About(Box::new(about)))
}

/// The cameras of the images.
fn taken(run: &Run, model: &Model<f32>, photos: Option<&PhotoCache>) -> Taken {
    // File coordinates map to the scene by the scene transform, then by the learned transform of all cameras.
    Taken {
        to_capture: rows(&to_capture(&run.config.scene_box.transform, &learned_transform(model))),
        photographs: photos.map_or(vec![], |photos| photos.about(model)),
    }
}

/// Maps scene coordinates to capture coordinates: the inverse of the learned transform, then of the scene transform.
fn to_capture(transform: &SceneTransform, learned: &SceneTransform) -> DAffine3 {
    inverse(transform) * inverse(learned)
}

/// The inverse of a scene transform.
fn inverse(transform: &SceneTransform) -> DAffine3 {
    let turn = transform.rotation.transpose() * DMat3::from_diagonal(DVec3::splat(transform.scale.recip()));
    DAffine3 { matrix3: turn, translation: transform.origin }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn to_capture_inverts_both_transforms() {
        let transform =
            SceneTransform { rotation: DMat3::from_rotation_z(0.7), scale: 2.5, origin: DVec3::new(1.0, -2.0, 0.5) };
        let learned =
            SceneTransform { rotation: DMat3::from_rotation_x(-0.3), scale: 0.8, origin: DVec3::new(0.1, 0.4, -0.2) };
        let point = DVec3::new(3.0, 4.0, -5.0);
        let found = to_capture(&transform, &learned).transform_point3(learned.point(transform.point(point)));
        assert!(found.abs_diff_eq(point, 1e-12), "{found}");
    }
}
