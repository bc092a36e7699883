//! Gradients of NeRF: its operations one by one, and the whole training loss by every parameter.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::check::{Check, check_function, check_op};
use raygrad::nerf::Jitter;
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::sampling::hierarchical::HierarchicalConfig;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::volume::Weights;
use raygrad::nerf::{
    ClassicConfig, Config, FieldConfig, InstantConfig, Loss as LossKind, Model, PositionalEncoding, Preset, Rays,
    SamplerConfig, Samples, SceneBox, VoxelConfig, catalogue, clip_near_far,
};
use raygrad::{Activation, Bound, Op, Real, Scalar, Segments, Tape, Tensor, Var};
use raygrad_scenes::{Scene, train_cameras};
use std::collections::BTreeSet;
use std::path::Path;

#[test]
fn nerf_operations_pass_all_checks() {
    let failures: Vec<_> = catalogue().iter().filter_map(|entry| check_op(&Check::default(), entry).err()).collect();
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

/// The names of the operations in a folder of sources.
fn operations_in(folder: &Path, names: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            operations_in(&path, names);
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        for start in ["fn name(&self) -> &'static str {", "const NAME: &'static str =", "Entry::function(", " entry(\""]
        {
            let name = if start.ends_with('"') { 0 } else { 1 };
            names.extend(text.split(start).skip(1).filter_map(|body| Some(body.split('"').nth(name)?.to_string())));
        }
    }
}

#[test]
fn nerf_operations_are_all_in_the_catalogue() {
    let known: BTreeSet<_> = catalogue().iter().map(|entry| entry.name.to_string()).collect();
    let mut written = BTreeSet::new();
    operations_in(&Path::new(env!("CARGO_MANIFEST_DIR")).join("nerf/src"), &mut written);
    assert!(written.contains("weights") && written.contains("positional_encoding"), "found only {written:?}");
    assert_eq!(written, known, "operations in the sources and in the catalogue");
}

/// The training loss at fixed samples, as a function of the parameters.
struct Loss<T: Scalar> {
    model: Model<T>,
    samples: Vec<Samples<T>>,
    target: Tensor<T>,
    background: Tensor<T>,
}

impl Loss<f32> {
    /// The loss of a new model on rays towards the embedded scene.
    fn new(config: Config, rays: usize, seed: u64) -> Self {
        // A cube of +-1 needs no scaling of positions, so both precisions encode the same numbers. The highest
        // frequency would amplify the rounding of a scaled position 1600 times.
        let [low, high] = Scene::bulldozer().bounds().map(|corner| corner.signum());
        let extent = SceneBox::new([low, high], [2.0, 6.0]);
        let mut rng = StdRng::seed_from_u64(seed);
        let mut batch = Rays::new();
        let cameras = train_cameras(5, 16);
        while batch.len() < rays {
            let camera = &cameras[batch.len() % cameras.len()];
            let ray = camera.pixel_ray(rng.random_range(4..12), rng.random_range(4..12));
            batch.push(&ray, clip_near_far(&ray, extent.bounds, extent.near_far));
        }
        let model = Model::new(config, extent, seed).unwrap();
        // Few enough binary digits that positions are equal in both precisions.
        let short = |x: &Tensor<f32>| Tensor::from_fn(x.shape(), |i| (x.as_slice()[i] * 512.0).round() / 512.0);
        let shorten = |samples: Samples<f32>| Samples {
            origins: short(&samples.origins),
            directions: short(&samples.directions),
            t: short(&samples.t),
            ..samples
        };
        let samples = model.samples(&batch, &mut Jitter::Random(&mut rng)).into_iter().map(shorten).collect();
        let mut colors = || Tensor::from_fn(&[rays, 3], |_| rng.random());
        Loss { target: colors(), background: colors(), samples, model }
    }

    /// The same numbers in double precision.
    fn double(&self) -> Loss<f64> {
        let mut model = Model::new(self.model.config.clone(), self.model.scene_box, 0).unwrap();
        model.params.assign(&self.model.params);
        let samples = self.samples.iter().map(Samples::cast).collect();
        Loss { model, samples, target: self.target.cast(), background: self.background.cast() }
    }
}

impl<T: Scalar> Loss<T> {
    fn at<'t>(&self, params: &Bound<'t, T>) -> Var<'t, T> {
        self.model.loss_at(params, &self.samples, &self.target, &self.background)
    }

    fn at_vars<'t>(&self, vars: &[Var<'t, T>]) -> Var<'t, T> {
        self.at(&self.model.params.layout().bind(vars.to_vec()))
    }

    fn value(&self, params: &[Tensor<T>]) -> T {
        let tape = Tape::new();
        let vars = params.iter().map(|x| tape.constant(x.clone())).collect();
        self.at(&self.model.params.layout().bind(vars)).item()
    }

    fn gradients(&self) -> Vec<Tensor<T>> {
        let tape = Tape::new();
        let params = self.model.params.bind(&tape);
        self.at(&params).grad(&params.vars())
    }
}

/// Two tiny networks with all parts of the classic field.
fn tiny() -> Config {
    let field = ClassicConfig {
        depth: 3,
        width: 8,
        skip_layers: vec![2],
        view_width: 6,
        position_levels: 3,
        direction_levels: 2,
        ..ClassicConfig::paper()
    };
    hierarchical(field, 4, 3)
}

/// Hierarchical sampling with a field that is also its own proposal, and few samples.
fn hierarchical(field: ClassicConfig, coarse: usize, fine: usize) -> Config {
    let sampler = HierarchicalConfig { proposal: field.clone(), coarse, fine, ..HierarchicalConfig::default() };
    let (field, sampler) = (FieldConfig::new(field), SamplerConfig::new(sampler));
    Config { field, sampler, ..Config::preset(Preset::Classic) }
}

#[test]
fn training_loss_derivatives_match_differences() {
    // The loss is smooth between two kinks of its ReLUs. A step of 1e-6 rarely meets a kink, and costs the differences
    // about ten of their sixteen digits. This seed meets none.
    let loss = Loss::new(tiny(), 3, 1).double();
    let check = Check { step: 1e-6, tolerance: 1e-8, ..Check::default() };
    let report = check_function(&check, loss.model.params.values(), |vars| loss.at_vars(vars));
    println!("{report:?}");
    let report = report.unwrap();
    assert!(report.comparisons > 2 * 40);
}

#[test]
fn instant_loss_derivatives_match_differences() {
    let mut config = Config::preset(Preset::Instant);
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        field.grid = HashGridConfig { levels: 2, features: 2, log2_table: 6, coarsest: 3, finest: 8 };
        (field.density_width, field.features, field.color_width, field.direction_degree) = (6, 4, 5, 2);
    }
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        sampler.step = 0.1;
    }
    let mut loss = Loss::new(config, 3, 1).double();
    // Features of the size after training, so that every gradient is well above rounding.
    let table = loss.model.params.find("field.table").unwrap();
    loss.model.params.get_mut(table).as_mut_slice().iter_mut().for_each(|x| *x *= 1e4);
    let check = Check { step: 1e-6, tolerance: 1e-8, ..Check::default() };
    let report = check_function(&check, loss.model.params.values(), |vars| loss.at_vars(vars));
    println!("{report:?}");
    assert!(report.unwrap().comparisons > 2 * 40);
}

#[test]
fn voxel_loss_derivatives_match_differences() {
    for loss in [LossKind::Mse, LossKind::Huber { delta: 0.2 }] {
        let mut config = Config { loss, ..Config::preset(Preset::Voxel) };
        config.field = FieldConfig::new(VoxelConfig { resolution: 3, direction_degree: 2 });
        if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
            sampler.step = 0.1;
        }
        let mut loss = Loss::new(config, 3, 1).double();
        // Coefficients of the size after training.
        let table = loss.model.params.find("field.table").unwrap();
        loss.model.params.get_mut(table).as_mut_slice().iter_mut().for_each(|x| *x *= 1e4);
        let check = Check { step: 1e-5, tolerance: 1e-8, ..Check::default() };
        let params = loss.model.params.values();
        let report = check_function(&check, params, |vars| loss.at_vars(vars));
        println!("{report:?}");
        assert!(report.unwrap().comparisons > 2 * 40);
    }
}

/// A random unit direction in the space of all parameters.
fn unit_direction(params: &[Tensor<f64>], rng: &mut StdRng) -> Vec<Tensor<f64>> {
    let mut direction: Vec<_> =
        params.iter().map(|x| Tensor::from_fn(x.shape(), |_| rng.random_range(-1.0..1.0))).collect();
    let norm = direction.iter().flat_map(Tensor::as_slice).map(|d: &f64| d * d).sum::<f64>().sqrt();
    direction.iter_mut().flat_map(Tensor::as_mut_slice).for_each(|d| *d /= norm);
    direction
}

/// `params + h direction`.
fn along(params: &[Tensor<f64>], direction: &[Tensor<f64>], h: f64) -> Vec<Tensor<f64>> {
    let pair =
        |(x, d): (&Tensor<f64>, &Tensor<f64>)| Tensor::from_fn(x.shape(), |i| x.as_slice()[i] + h * d.as_slice()[i]);
    params.iter().zip(direction).map(pair).collect()
}

/// A difference across the kink of a ReLU is invalid, so the best of several steps counts. A wrong derivative is wrong
/// at every step.
#[test]
fn deep_relu_network_passes_in_twenty_directions() {
    let field = ClassicConfig { depth: 8, width: 24, view_width: 12, ..ClassicConfig::paper() };
    let config = hierarchical(field, 16, 16);
    for config in [config.clone(), config.with_relu_density()] {
        let loss = Loss::new(config, 4, 3).double();
        let (params, grads) = (loss.model.params.values(), loss.gradients());
        let mut rng = StdRng::seed_from_u64(8);
        let norm = grads.iter().flat_map(|g| g.as_slice()).map(|g| g * g).sum::<f64>().sqrt();
        let count = grads.iter().map(Tensor::len).sum::<usize>() as f64;
        let error = || {
            let direction = unit_direction(params, &mut rng);
            let moved = |h: f64| loss.value(&along(params, &direction, h));
            let products = grads.iter().zip(&direction).flat_map(|(g, d)| g.as_slice().iter().zip(d.as_slice()));
            let analytic: f64 = products.map(|(g, d)| g * d).sum();
            let numeric = |step: f64| (moved(step) - moved(-step)) / (2.0 * step);
            // The expected component of a random unit vector along the gradient.
            let scale = norm / count.sqrt();
            let errors = [1e-4, 1e-5, 1e-6].map(|step| (numeric(step) - analytic).abs() / scale);
            errors.into_iter().reduce(Real::minimum).unwrap()
        };
        let errors: Vec<_> = std::iter::repeat_with(error).take(20).collect();
        let worst = errors.iter().copied().fold(0.0, Real::maximum);
        println!("worst of twenty directions {worst:.1e}");
        assert!(worst <= 1e-6, "{errors:?}");
    }
}

/// The distance of `got` from `expected` relative to the length of `expected`.
fn relative_error<T: Scalar, U: Scalar>(got: &Tensor<T>, expected: &Tensor<U>) -> f64 {
    assert_eq!(got.shape(), expected.shape());
    let pairs = got.as_slice().iter().zip(expected.as_slice());
    let error: f64 = pairs.map(|(g, e)| (g.to_f64() - e.to_f64()).powi(2)).sum();
    let norm: f64 = expected.as_slice().iter().map(|e| e.to_f64().powi(2)).sum();
    if error == 0.0 { 0.0 } else { (error / norm).sqrt() }
}

#[test]
fn f32_gradients_agree_with_f64() {
    for (preset, rays) in [(Preset::Small, 16), (Preset::Classic, 4)] {
        let mut names = vec![];
        let mut errors: Vec<Vec<f64>> = vec![];
        for seed in 0..7 {
            let single = Loss::new(Config::preset(preset), rays, seed);
            let pairs = single.gradients().into_iter().zip(single.double().gradients());
            errors.push(pairs.map(|(single, double)| relative_error(&single, &double)).collect());
            names = single.model.params.iter().map(|(name, _)| name.to_string()).collect();
        }
        // The median: sometimes a unit is so close to the kink of its ReLU that the precisions disagree on it.
        for (i, name) in names.iter().enumerate() {
            let mut errors: Vec<_> = errors.iter().map(|errors| errors[i]).collect();
            errors.sort_by(f64::total_cmp);
            println!("{preset:?} {name}: median {:.1e}, worst {:.1e}", errors[3], errors[6]);
            let is_close = errors[3] > 0.0 && errors[3] <= 2e-6 && errors.iter().all(|error| *error < 0.1);
            assert!(is_close, "{preset:?} {name}: {errors:?}");
        }
    }
}

/// Value and gradients of a fused operation and of its plain reference, for the same inputs.
fn both_routes<T: Scalar>(
    inputs: &[Tensor<f64>],
    fused: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    plain: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
) -> [Vec<Tensor<T>>; 2] {
    let tape = Tape::new();
    let leaves: Vec<_> = inputs.iter().map(|x| tape.leaf(x.cast())).collect();
    [fused(&leaves), plain(&leaves)].map(|y| {
        let weights = tape.constant(Tensor::from_fn(y.shape(), |i| T::from_f64((i as f64 * 0.7).cos())));
        let mut results = (&y * weights).sum().grad(&leaves.iter().collect::<Vec<_>>());
        results.push(y.into_value());
        results
    })
}

/// Checks every fused operation of a NeRF against its reference, in one precision.
fn fused_operations_agree<T: Scalar>(tolerance: f64) {
    let mut rng = StdRng::seed_from_u64(2);
    let mut random = |shape: &[usize], from: f64, to: f64| {
        // Numbers that f32 can hold, so that both precisions get the same.
        Tensor::from_fn(shape, |_| f64::from(rng.random_range(from..to) as f32))
    };
    let segments = Segments::new([0, 40, 40, 41, 150]);
    let weights = || Weights::new(segments.clone());
    let encoding = PositionalEncoding { levels: 10, input: true };
    let cases = [
        (
            "weights",
            both_routes::<T>(
                &[random(&[150], 0.0, 1.0)],
                |x| x[0].tape().apply(weights(), &[&x[0]]),
                |x| weights().reference(x).unwrap(),
            ),
        ),
        (
            "positional_encoding",
            both_routes::<T>(
                &[random(&[70, 3], -1.0, 1.0)],
                |x| x[0].tape().apply(encoding, &[&x[0]]),
                |x| encoding.reference(x).unwrap(),
            ),
        ),
        (
            "linear",
            both_routes::<T>(
                &[random(&[90, 31], -1.0, 1.0), random(&[31, 17], -1.0, 1.0), random(&[17], -1.0, 1.0)],
                |x| x[0].linear(&x[1], Some(&x[2]), Activation::Relu),
                |x| (x[0].matmul(&x[1]) + &x[2]).relu(),
            ),
        ),
    ];
    for (name, [fused, plain]) in &cases {
        for (i, (fused, plain)) in fused.iter().zip(plain).enumerate() {
            let error = relative_error(fused, plain);
            println!("{name} in {}, result {i}: {error:.1e}", T::NAME);
            assert!(error <= tolerance, "{name} in {}, result {i}: {error:.1e}", T::NAME);
        }
    }
}

#[test]
fn fused_operations_agree_with_plain_in_f32_and_f64() {
    fused_operations_agree::<f64>(1e-14);
    fused_operations_agree::<f32>(2e-6);
}
