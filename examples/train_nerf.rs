//! From images to new views: loads a scene, trains a NeRF on it, measures it on views that it has not seen, and
//! writes an image of one of them.
//!
//! ```text
//! cargo run --release --example train_nerf [seconds] [folder for images]
//! ```
//!
//! Trains for 60 seconds unless told otherwise. The scene is the embedded bulldozer; `dataset::load(folder, split, 2)`
//! returns the images of a capture at half its size, or an error. `Config::for_budget`, `with_scene_type`, `with_images` and
//! `with_transparency` fit a preset to a budget and a capture, as `raygrad train` does.

use raygrad::nerf::dataset::Split;
use raygrad::nerf::imaging::colormap::{depth_map, error_map};
use raygrad::nerf::imaging::metrics;
use raygrad::nerf::{Budget, Config, Image, Preset, Result, Trainer};
use raygrad_scenes::embedded;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

fn main() -> Result<()> {
    let mut args = std::env::args().skip(1);
    let seconds = args.next().map_or(60.0, |text| text.parse().expect("the first argument is a number of seconds"));
    let folder = PathBuf::from(args.next().unwrap_or("target/examples-out".into()));
    std::fs::create_dir_all(&folder).expect("the folder for images can be made");

    // Photographs with their cameras.
    let [train, test] = [Split::Train, Split::Test].map(|split| embedded(split, 100));
    println!("{} images to train on, {} to test", train.frames.len(), test.frames.len());
    let (near, far) = (test.near, test.far);

    // A model and its optimizer. Every number of the preset can be changed before this.
    let mut trainer = Trainer::new(Config::preset(Preset::Small), Arc::new(train))?;
    println!("{} parameters", trainer.model.params.elements());

    // Training, with a word every few seconds; `ControlFlow::Break(())` would end it early.
    let mut next = 0.0;
    trainer.run(Budget::Time(Duration::from_secs_f64(seconds)), |trainer| {
        let now = trainer.stats();
        if now.train_seconds >= next {
            println!("{:6.1} s  step {:5}  loss {:.4}  {:.1} dB", now.train_seconds, now.step, now.loss, now.psnr);
            next = now.train_seconds + seconds / 12.0;
        }
        ControlFlow::Continue(())
    });

    // Views from the test cameras, and how far they are from the truth.
    let background = trainer.model.config.background.shown();
    let mut sum = 0.0;
    let chosen: Vec<_> = test.frames.iter().step_by(5).collect();
    for (i, frame) in chosen.iter().enumerate() {
        let (view, truth) = (trainer.model.render(&frame.camera, background), frame.image.over(background));
        let psnr = metrics::psnr(&view.color, &truth);
        println!("{}: {psnr:.2} dB", frame.name);
        sum += psnr;
        if i == 0 {
            let path = folder.join("train_nerf.png");
            let (depth, error) = (depth_map(&view.depth, near, far), error_map(&view.color, &truth));
            Image::hconcat(&[&truth, &view.color, &depth, &error]).save_png(&path)?;
            println!("{}: truth, view, depth, error", path.display());
        }
    }
    println!("mean {:.2} dB", sum / chosen.len() as f64);
    trainer.model.save(folder.join("train_nerf.safetensors"))
}
