//! Where the time of a training step goes, and how far each phase is from what the machine could do: one thread, one tile
//! of rays of a trained run.
//!
//! ```text
//! raygrad train --out run    # or train path/to/scene
//! cargo run --release --example step_phases -- run
//! ```
//!
//! Networks are compared with a large matrix product, everything that looks up or changes rows of the table with fetching
//! cache lines from random places of as much memory.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::nerf::Jitter;
use raygrad::nerf::dataset::{Dataset, Split, load};
use raygrad::nerf::encoding::hash_grid::HashGrid;
use raygrad::nerf::space::occupancy::Step;
use raygrad::nerf::{Config, Instant, InstantConfig, Model, Query, Rays, SceneBox};
use raygrad::tensor::matmul::{Matrix, gemm};
use raygrad::tensor::simd;
use raygrad::{Adam, Optimizer, Params, Pool, Tape, Tensor};
use raygrad_scenes::embedded;
use serde_json::Value;
use std::any::Any;
use std::error::Error;
use std::hint::black_box;
use std::path::Path;
use std::time;

/// Times that each phase is run; the least counts.
const RUNS: usize = 20;

fn main() -> Result<(), Box<dyn Error>> {
    let run = std::env::args().nth(1).ok_or("name a run: step_phases RUN")?;
    // The phases are those of one thread. Reading images would start a pool of all of them.
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    let about: Value = serde_json::from_str(&std::fs::read_to_string(Path::new(&run).join("config.json"))?)?;
    let config: Config = serde_json::from_value(about["config"].clone())?;
    let extent: SceneBox = serde_json::from_value(about["scene_box"].clone())?;
    let model = Model::load(Path::new(&run).join("model.safetensors"), config, extent)?;
    let data = match (about["scene"].as_str(), about["scene"]["folder"].as_str()) {
        (Some("embedded"), _) => embedded(Split::Train, 200),
        (_, Some(folder)) => load(folder, Split::Train, 1)?,
        _ => return Err("the run's scene is neither `embedded` nor a folder".into()),
    };
    measure(&model, &data)
}

/// The least time of several runs, in seconds.
fn least(mut f: impl FnMut()) -> f64 {
    let time = |_| {
        let start = time::Instant::now();
        f();
        start.elapsed().as_secs_f64()
    };
    (0..RUNS).map(time).fold(f64::INFINITY, f64::min)
}

/// Operations a second of a large matrix product.
fn matrix_rate() -> f64 {
    let n = 1024;
    let (a, b, mut c) = (vec![0.5_f32; n * n], vec![0.25_f32; n * n], vec![0.0_f32; n * n]);
    let seconds = least(|| gemm(Matrix::new(&a, n, n), Matrix::new(&b, n, n), black_box(&mut c), false));
    2.0 * (n * n * n) as f64 / seconds
}

/// Cache lines a second that arrive from random places of `bytes` of memory, asked for ahead of time.
fn line_rate(bytes: usize) -> f64 {
    let lines = (bytes / 64).max(1);
    let memory = vec![[1.0_f32; 16]; lines];
    let mut rng = StdRng::seed_from_u64(1);
    let places: Vec<u32> = (0..1 << 18).map(|_| rng.random_range(0..lines as u32)).collect();
    let seconds = least(|| {
        let mut sum = 0.0;
        for (i, &place) in places.iter().enumerate() {
            if let Some(&later) = places.get(i + 16) {
                simd::prefetch(&memory[later as usize]);
            }
            sum += memory[place as usize][0];
        }
        black_box(sum);
    });
    places.len() as f64 / seconds
}

/// A training batch of so many samples, more or less: rays and the colours that images show along them.
fn batch(model: &Model<f32>, data: &Dataset, count: usize) -> (Rays<f32>, Vec<f32>) {
    let mut rng = StdRng::seed_from_u64(7);
    let (mut rays, mut target) = (Rays::new(), vec![]);
    for _ in 0..count {
        let frame = &data.frames[rng.random_range(0..data.frames.len())];
        let (x, y) = (rng.random_range(0..frame.image.width), rng.random_range(0..frame.image.height));
        rays.push_pixel(&frame.camera, [x, y], model.scene_box.bounds, model.scene_box.near_far);
        target.extend_from_slice(&frame.image.pixel(x, y)[..3]);
    }
    (rays, target)
}

/// Multiplications of the density network and of the colour network for a sample.
fn network(config: &InstantConfig, grid: &HashGrid) -> [f64; 2] {
    let density = config.density_width * (grid.width() + config.features);
    let directions = config.direction_degree * config.direction_degree;
    let first = (config.features + directions) * config.color_width;
    let color = first + (config.color_depth - 1) * config.color_width * config.color_width + 3 * config.color_width;
    [density as f64, color as f64]
}

fn measure(model: &Model<f32>, data: &Dataset) -> Result<(), Box<dyn Error>> {
    let (Some(sampler), Some(config)) = (model.marching(), model.config.field.get::<InstantConfig>()) else {
        return Err("step_phases looks at instant models".into());
    };
    let any: &dyn Any = &*model.field;
    let table = any.downcast_ref::<Instant>().ok_or("a field that is not instant")?.grid();
    let (id, grid, field) = (table.table(), table.grid(), &*model.field);
    let wanted = sampler.config.samples / sampler.config.tiles;
    let (probe, _) = batch(model, data, 256);
    let (step, pool) = (Step::uniform(sampler.step()), Pool::new());
    let marched = |rays: &Rays<f32>| {
        let mut random = StdRng::seed_from_u64(3);
        sampler.march(&sampler.grid, rays, &step, &mut Jitter::Random(&mut random), &pool).0
    };
    let each = marched(&probe).len() as f64 / 256.0;
    let (rays, target) = batch(model, data, (wanted as f64 / each.max(0.5)) as usize);
    let march = least(|| drop(marched(&rays)));
    let samples = marched(&rays);

    let mut tape = Tape::new();
    let target = Tensor::from_vec(&[rays.len(), 3], target);
    let white = Tensor::ones(&[rays.len(), 3]);
    let [mut whole, mut forward] = [f64::INFINITY; 2];
    let (mut asked, mut kept, mut grad) = (0, 0, None);
    for _ in 0..RUNS {
        let params = model.params.bind(&tape);
        let start = time::Instant::now();
        let query = Query::new(field, &params);
        let lit = sampler.config.quadrature.render(&query, &samples, sampler.config.early_stop_eps);
        let loss = model.config.loss.sum(&lit.rendered.over(&white), &target);
        let middle = start.elapsed().as_secs_f64();
        let given = loss.backward(&params.vars());
        whole = whole.min(start.elapsed().as_secs_f64());
        forward = forward.min(middle);
        (asked, kept) = (lit.density_queries, lit.visible);
        grad = given.into_iter().find(|grad| !grad.is_dense());
        drop((lit, loss, params));
        tape.clear();
    }
    let grad = grad.ok_or("no gradient of the table")?;

    // The densities that decide which samples light reaches, phase by phase.
    let positions = Tensor::from_vec(&[asked, 3], samples.positions(&pool).as_slice()[..3 * asked].to_vec());
    let [mut encode, mut both] = [f64::INFINITY; 2];
    for _ in 0..RUNS {
        let params = model.params.bind_constant(&tape);
        let x = tape.constant(positions.clone());
        let start = time::Instant::now();
        drop(table.encode(&params, &x));
        encode = encode.min(start.elapsed().as_secs_f64());
        let start = time::Instant::now();
        drop(field.density(&params, &x));
        both = both.min(start.elapsed().as_secs_f64());
        drop((x, params));
        tape.clear();
    }
    let density = (both - encode).max(0.0);
    let mut alone = Params::new();
    alone.add("table", model.params.get(id).clone());
    alone.set_lazy(|_| true, true);
    let (mut adam, mut moved) = (Adam::new(model.config.table_adam), 0);
    let update = least(|| moved = adam.update(&mut alone, std::slice::from_ref(&grad), 1e-3).updated / grid.features());
    let size = 4 * model.params.get(id).len();

    let (matrix, line) = (matrix_rate(), line_rate(size));
    let lines_of_state = line_rate(4 * size);
    let [density_work, color_work] = network(config, grid).map(|work| 2.0 * work);
    let lookups = (asked * grid.levels().len() * 8) as f64;
    println!(
        "a tile of {} rays: {} samples placed, {asked} density queries, {kept} visible",
        rays.len(),
        samples.len()
    );
    println!(
        "large matrix product {:.0} GFLOP/s; random lines {:.0} M/s of the table, {:.0} M/s of table and moments",
        1e-9 * matrix,
        1e-6 * line,
        1e-6 * lines_of_state
    );
    println!("{:<44}{:>8}{:>8}{:>24}{:>10}", "phase", "us", "share", "done", "of limit");
    let total = march + whole + update;
    let row = |name: &str, seconds: f64, done: String, limit: Option<f64>| {
        let limit = limit.map_or("".into(), |limit| format!("{:.0} %", 100.0 * limit / seconds));
        println!("{name:<44}{:>8.0}{:>6.0} %{done:>24}{limit:>10}", 1e6 * seconds, 100.0 * seconds / total);
    };
    let flop = |count: f64, seconds: f64| format!("{:.0} GFLOP/s", 1e-9 * count / seconds);
    let lines = |count: f64, seconds: f64| format!("{:.0} M look-ups/s", 1e-6 * count / seconds);
    row("march", march, format!("{:.0} M samples/s", 1e-6 * samples.len() as f64 / march), None);
    row("look up the table", encode, lines(lookups, encode), Some(lookups / line));
    let work = density_work * asked as f64;
    row("density network", density, flop(work, density), Some(work / matrix));
    let rest = (forward - encode - density).max(0.0);
    let work = (density_work + color_work) * kept as f64;
    row("visible samples: select, networks, composite, loss", rest, flop(work, rest), Some(work / matrix));
    let backward = whole - forward;
    let work = 2.0 * (density_work + color_work) * kept as f64;
    row("backward", backward, flop(work, backward), Some(work / matrix));
    // A moved row: its values, its moments, its step count.
    let touched = 3.0 * moved as f64;
    row("add up the table's gradient, move its rows", update, lines(touched, update), Some(touched / lines_of_state));
    println!("{:<44}{:>8.0}", "sum", 1e6 * total);
    Ok(())
}
