//! `raygrad view`: a window on the scene, in a browser.

mod album;
mod guard;
mod hub;
pub mod messages;
mod painter;
mod parts;
mod served;
mod server;
mod shelf;
mod store;
mod studio;
mod talk;
mod window;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use raygrad::nerf::dataset::Placement;
use raygrad::nerf::glam::{DAffine3, DMat3, DVec3};
use raygrad::nerf::{Model, Result};

use super::checkpoint;
use super::output::{complain, note, print};
use super::run::Run;
use super::scene::Scene;
use album::Album;
use hub::Hub;
use messages::{About, FirstView, Taken, Tell, rows};
use painter::Painter;
use shelf::Shelf;
use studio::Studio;

pub use server::Listener;
pub use window::Window;

/// What moves cameras in pages.
pub const CAMERA: &str = include_str!("page/camera.js");

/// The address of this machine that others cannot reach.
const HOST: &str = "127.0.0.1";

/// Look at a run in a browser
///
/// The program itself serves the page, to this machine alone unless --host says otherwise. Ctrl-C ends it.
#[derive(clap::Args)]
pub struct Args {
    /// Folder that `raygrad train` made
    run: PathBuf,
    #[command(flatten)]
    place: PlaceArgs,
    /// Open the page in the browser
    #[arg(long)]
    open: bool,
    /// Folder of the photographs, if they are no longer where they were for training
    #[arg(long)]
    scene: Option<Scene>,
}

/// Where pages are served.
#[derive(Debug, Clone, clap::Args)]
pub struct PlaceArgs {
    /// Address or name under which pages are served: 127.0.0.1 for whoever uses this machine; with another, others come too who
    /// have the link with its token, unencrypted
    #[arg(long, default_value = HOST)]
    host: String,
    /// Port on which pages are served [default: a free one]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    port: u16,
}

impl PlaceArgs {
    /// Whether somebody has said something.
    pub fn are_given(&self) -> bool {
        self.host != HOST || self.port != 0
    }

    /// Takes the port.
    ///
    /// # Errors
    /// If the host is not known or the port is taken.
    pub fn listen(&self) -> Result<Listener> {
        Listener::bind(&self.host, self.port)
    }
}

/// Serves until it is ended.
pub fn run(args: &Args) -> Result<()> {
    let run = Arc::new(Run::open(&args.run)?);
    let model = Arc::new(run.model()?);
    let (hub, album) = (Arc::new(Hub::default()), album(&run, args.scene.as_ref()));
    hub.introduce(about(&run, &model, album.as_deref(), Some(checkpoint::steps(&run)?)));
    let studio = Arc::new(Studio::new(run.clone(), args.scene.clone(), hub.clone()));
    let background = model.config.background.shown();
    let link = server::serve(args.place.listen()?, hub.clone(), album.clone(), Some(studio), background)?;
    print(&format!("view     {link}\n"))?;
    if args.open
        && let Err(error) = open::that_detached(&link)
    {
        complain(&format!("warning: no browser could be opened: {error}"));
    }
    let mut painter = Painter::new(hub.clone(), album, Some(Shelf::new(run, model.clone())));
    loop {
        painter.work_or_wait(&model, 0, Duration::from_secs(1));
    }
}

/// The photographs of a run, which it can be looked at without.
fn album(run: &Run, scene: Option<&Scene>) -> Option<Arc<Album>> {
    match Album::open(run, scene) {
        Ok(album) => Some(Arc::new(album)),
        Err(error) => {
            note(&format!("photographs are not shown: {error}"));
            None
        }
    }
}

/// Where a scene is looked at from first.
pub fn first_view(run: &Run) -> FirstView {
    let (view, extent) = (&run.config.viewpoint, &run.config.extent);
    let camera = &view.orbit(extent, 1)[0];
    FirstView {
        pose: rows(&camera.pose),
        fov: 2.0 * (0.5 * camera.height as f64 / camera.focal[1]).atan().to_degrees(),
        proportion: camera.width as f64 / camera.height as f64,
        bounds: extent.bounds.map(|corner| corner.to_array()),
    }
}

/// What pages are told of a scene; `checkpoints` are those that can be looked at, if it is not being trained.
fn about(run: &Run, model: &Model<f32>, album: Option<&Album>, checkpoints: Option<Vec<u64>>) -> String {
    let view = &run.config.viewpoint;
    let about = About {
        title: run.name(),
        first: first_view(run),
        size: [view.width, view.height],
        background: model.config.background.shown(),
        taken: taken(run, model, album),
        points: album.map_or(vec![], |album| album.points(model)),
        training: checkpoints.is_none(),
        checkpoints: checkpoints.unwrap_or_default(),
    };
    messages::text(&Tell::About(Box::new(about)))
}

/// Where photographs were taken.
fn taken(run: &Run, model: &Model<f32>, album: Option<&Album>) -> Taken {
    // As cameras of files are taken to where the model has them: where they are given, and from there by what it has learned.
    let learned = model.refine.as_ref().and_then(|refine| refine.placement(&model.params)).unwrap_or_default();
    Taken {
        to_capture: rows(&to_capture(&run.config.extent.placement, &learned)),
        photographs: album.map_or(vec![], |album| album.about(model)),
    }
}

/// From the scene to a capture that was placed in it and has moved since as a whole.
fn to_capture(placement: &Placement, learned: &Placement) -> DAffine3 {
    inverse(placement) * inverse(learned)
}

/// From the scene to what was placed in it.
fn inverse(placement: &Placement) -> DAffine3 {
    let turn = placement.rotation.transpose() * DMat3::from_diagonal(DVec3::splat(placement.scale.recip()));
    DAffine3 { matrix3: turn, translation: placement.origin }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_placed_and_has_moved_is_found_where_it_was() {
        let placement =
            Placement { rotation: DMat3::from_rotation_z(0.7), scale: 2.5, origin: DVec3::new(1.0, -2.0, 0.5) };
        let learned =
            Placement { rotation: DMat3::from_rotation_x(-0.3), scale: 0.8, origin: DVec3::new(0.1, 0.4, -0.2) };
        let point = DVec3::new(3.0, 4.0, -5.0);
        let found = to_capture(&placement, &learned).transform_point3(learned.point(placement.point(point)));
        assert!(found.abs_diff_eq(point, 1e-12), "{found}");
    }
}
