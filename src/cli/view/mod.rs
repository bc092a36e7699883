//! `raygrad view`: a window on the scene, in a browser.

mod album;
mod hub;
pub mod messages;
mod painter;
mod server;
mod window;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use raygrad::nerf::glam::{DAffine3, DMat3, DVec3};
use raygrad::nerf::{Model, Result};

use super::output::{complain, note, print};
use super::run::Run;
use super::scene::Scene;
use album::Album;
use hub::Hub;
use messages::{About, Tell, rows};
use painter::Painter;
use server::Place;

pub use window::Window;

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
    /// Address or name under which pages are served: other machines can come if it is not of this one alone, with the
    /// token in the link
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

    fn place(&self) -> Place {
        Place { host: self.host.clone(), port: self.port }
    }
}

/// Serves until it is ended.
pub fn run(args: &Args) -> Result<ExitCode> {
    let run = Run::open(&args.run)?;
    let model = run.model()?;
    let (hub, album) = (Arc::new(Hub::default()), album(&run, args.scene.as_ref()));
    let link = serve(&args.place, &run, &model, &hub, album.clone(), false)?;
    print(&format!("view     {link}\n"))?;
    if args.open
        && let Err(error) = open::that_detached(&link)
    {
        complain(&format!("warning: no browser could be opened: {error}"));
    }
    let mut painter = Painter::new(hub.clone(), album);
    loop {
        if !painter.work(&model, 0) {
            hub.wait(Duration::from_secs(1));
        }
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

/// Begins to serve the page of a run; gives the link.
fn serve(
    place: &PlaceArgs,
    run: &Run,
    model: &Model<f32>,
    hub: &Arc<Hub>,
    album: Option<Arc<Album>>,
    training: bool,
) -> Result<String> {
    let (view, extent) = (&run.config.viewpoint, &run.config.extent);
    let camera = &view.orbit(extent, 1)[0];
    let placement = extent.placement;
    // Back: `origin + rotation^T x / scale`.
    let back = DAffine3 {
        matrix3: placement.rotation.transpose() * DMat3::from_diagonal(DVec3::splat(placement.scale.recip())),
        translation: placement.origin,
    };
    let about = About {
        title: run.folder.display().to_string(),
        pose: rows(&camera.pose),
        fov: 2.0 * (0.5 * camera.height as f64 / camera.focal[1]).atan().to_degrees(),
        size: [view.width, view.height],
        bounds: extent.bounds.map(|corner| corner.to_array()),
        background: model.config.background.shown(),
        to_capture: rows(&back),
        photographs: album.as_ref().map_or(vec![], |album| album.about(model)),
        points: album.as_ref().map_or(vec![], |album| album.points(model)),
        training,
    };
    let hub::Outgoing::Text(about) = server::text(&Tell::About(Box::new(about))) else { unreachable!("it is text") };
    server::serve(&place.place(), hub.clone(), album, about)
}
