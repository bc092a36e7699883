//! The classic preset's training step (1024 rays, 64 + 128 samples, two 8x256 networks) and its forward pass, as one JSON
//! line each in the form of the scripts under `benches/peers`, to take ratios against.
//!
//! ```sh
//! cargo bench --bench classic_step
//! ```

use raygrad::nerf::dataset::Split;
use raygrad::nerf::{Config, Preset, Trainer};
use raygrad_scenes::embedded;
use std::sync::Arc;
use std::time::Instant;

/// Timed repetitions, after one that is not timed.
const REPEATS: usize = 5;
/// Side of the view of the forward pass: 1024 rays.
const SIDE: usize = 32;

fn main() -> raygrad::nerf::Result<()> {
    let data = Arc::new(embedded(Split::Train, 64));
    let mut trainer = Trainer::new(Config::preset(Preset::Classic), data.clone())?;
    let rays = |trainer: &Trainer| trainer.stats().rays;
    trainer.step(0.0);
    let before = rays(&trainer);
    let seconds = median(|| {
        trainer.step(0.0);
    });
    let batch = (rays(&trainer) - before) as usize / REPEATS;
    report("classic NeRF, training step", batch, seconds);
    let camera = data.frames[0].camera.resized(SIDE, SIDE);
    trainer.model.render(&camera, [1.0; 3]);
    let seconds = median(|| {
        trainer.model.render(&camera, [1.0; 3]);
    });
    report("classic NeRF, forward", SIDE * SIDE, seconds);
    Ok(())
}

/// The median time of a few calls, in seconds.
fn median(mut f: impl FnMut()) -> f64 {
    let mut times = [(); REPEATS].map(|()| {
        let start = Instant::now();
        f();
        start.elapsed().as_secs_f64()
    });
    times.sort_by(f64::total_cmp);
    times[REPEATS / 2]
}

fn report(what: &str, rays: usize, seconds: f64) {
    let line = serde_json::json!({
        "framework": "raygrad",
        "what": what,
        "rays_per_second": rays as f64 / seconds,
        "seconds_per_step": seconds,
        "peak_rss_bytes": peak_rss(),
        "threads": rayon::current_num_threads(),
    });
    println!("{line}");
}

/// The most memory that the process has held, where the system says so.
fn peak_rss() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}
