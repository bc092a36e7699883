//! Images compared with exact values: a ray-traced scene from cameras without symmetry, and closed-form integrals
//! through the path of all renders.

use raygrad::Params;
use raygrad::nerf::analytic::{AnalyticField, AnalyticScene, Layer, Layers, scenes};
use raygrad::nerf::dataset::{Dataset, Frame, SceneTransform, SceneType, Split};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::glam::{DMat3, DVec3};
use raygrad::nerf::imaging::metrics::{psnr, ssim};
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::space::occupancy::{OccupancyConfig, Skip};
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{
    Camera, Config, Image, InstantConfig, Jitter, Lens, Model, Preset, Purpose, Query, RayTolerance, Rays,
    SamplerConfig, SceneBox, Trainer,
};
use raygrad::{Real, Tape};
use raygrad_scenes::{DISTANCE, Landscape, Scene, View, walk_cameras};
use std::path::PathBuf;
use std::sync::Arc;

/// A camera with a wide image, non-square pixels, an off-centre principal point and a roll.
fn camera(number: usize) -> Camera {
    let angle = 0.4 + 2.4 * number as f64;
    let height = 0.15 + 0.7 * (number as f64 * 0.618).fract();
    let radius = (1.0 - height * height).sqrt();
    let eye = DISTANCE * DVec3::new(radius * angle.cos(), radius * angle.sin(), height);
    let mut pose = Camera::look_at(eye, DVec3::new(0.1, -0.1, 0.2), DVec3::Z);
    pose.matrix3 *= DMat3::from_rotation_z(0.3 + number as f64);
    Camera { width: 60, height: 44, focal: [110.0, 99.0], centre: [33.0, 19.0], lens: Lens::Pinhole, pose }
}

/// The path of a golden file.
fn golden(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/reference").join(name)
}

/// `reference/metrics.py` computed the expected values with scikit-image.
#[test]
fn psnr_and_ssim_equal_scikit_image() {
    let values: serde_json::Value = serde_json::from_slice(&std::fs::read(golden("metrics.json")).unwrap()).unwrap();
    let values = values.as_object().unwrap();
    assert_eq!(values.len(), 10);
    for (name, value) in values {
        let [a, b] = ["a", "b"].map(|which| Image::open(golden(&format!("metrics/{name}-{which}.png"))).unwrap());
        for (a, b) in [(&a, &b), (&b, &a)] {
            let [db, similarity] = ["psnr", "ssim"].map(|metric| value[metric].as_f64().unwrap());
            assert!((psnr(a, b) - db).abs() < 1e-4, "{name}: {} dB, not {db}", psnr(a, b));
            assert!((ssim(a, b) - similarity).abs() < 1e-5, "{name}: SSIM {}, not {similarity}", ssim(a, b));
        }
    }
}

/// All golden images: of the bulldozer alone, and of the landscape around it.
fn all_pictures() -> Vec<(&'static str, Image)> {
    let mut all = Vec::from(pictures(&Scene::bulldozer().render(&camera(1), 9)));
    all.push(("golden-landscape.png", Landscape::new().render(&walk_cameras(Split::Test, 64)[3], 9)));
    all
}

/// Colour over white, distances of 2 to 6 as grey, and normals as colours.
fn pictures(view: &View) -> [(&'static str, Image); 3] {
    let each = |image: &Image, f: &dyn Fn(&[f32]) -> [f32; 3]| {
        let data = image.data.chunks_exact(image.channels).flat_map(f).collect();
        Image { width: image.width, height: image.height, channels: 3, data }
    };
    [
        ("golden-color.png", view.color.over([1.0; 3])),
        ("golden-depth.png", each(&view.depth, &|d| [Real::maximum((d[0] - 2.0) / 4.0, 0.0); 3])),
        ("golden-normal.png", each(&view.normal, &|n| [0, 1, 2].map(|i| 0.5 + 0.5 * n[i]))),
    ]
}

/// All renderers share one [`Camera`], so its errors would show only in images that were inspected once and stored.
#[test]
fn scene_equals_golden_pictures() {
    for (name, image) in all_pictures() {
        let kept = Image::open(golden(name)).unwrap();
        assert_eq!([kept.width, kept.height], [image.width, image.height], "{name}");
        let pairs = kept.data.chunks_exact(kept.channels).zip(image.data.chunks_exact(3));
        let worst = pairs.flat_map(|(a, b)| (0..3).map(|i| (a[i] - b[i]).abs())).fold(0.0, Real::maximum);
        assert!(worst <= 1.01 / 255.0, "{name}: {worst}");
    }
}

#[test]
#[ignore = "writes the pictures that the test before it compares with: look at them before they are kept"]
fn write_golden_pictures() {
    for (name, image) in all_pictures() {
        image.save_png(golden(name)).unwrap();
    }
}

/// The pinhole formula, written out, gives the pixel of a scene point.
#[test]
fn points_project_by_the_pinhole_formula() {
    for number in 0..5 {
        let camera = camera(number);
        for (column, row) in [(0, 0), (59, 3), (17, 43), (33, 19)] {
            let ray = camera.pixel_ray(column, row);
            let point = ray.at(3.7) - camera.pose.translation;
            let axes = camera.pose.matrix3;
            let [right, up, back] = [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.dot(point));
            assert!(back < 0.0 && (right.hypot(up).hypot(back) - 3.7).abs() < 1e-12);
            let x = 33.0 + 110.0 * right / -back;
            let y = 19.0 - 99.0 * up / -back;
            assert!((x - column as f64 - 0.5).abs() < 1e-9 && (y - row as f64 - 0.5).abs() < 1e-9, "{x} {y}");
        }
    }
}

/// The image rotated and mirrored: the results of wrong signs and swapped axes.
fn mistaken(image: &Image) -> [Image; 3] {
    let Image { width, height, channels, .. } = *image;
    let from = |place: &dyn Fn(usize, usize) -> [usize; 2]| {
        let mut out = Image::new(width, height, channels);
        for y in 0..height {
            for x in 0..width {
                let [from_x, from_y] = place(x, y);
                out.pixel_mut(x, y).copy_from_slice(image.pixel(from_x, from_y));
            }
        }
        out
    };
    [from(&|x, y| [width - 1 - x, y]), from(&|x, y| [x, height - 1 - y]), from(&|x, y| [width - 1 - x, height - 1 - y])]
}

/// The median angle in degrees between a model's normals and those of the scene, at pixels whose neighbours have the
/// same normal.
fn normals_apart(model: &Model<f32>, camera: &Camera, truth: &Image) -> f64 {
    let tape = Tape::new();
    let params = model.params.bind_constant(&tape);
    let query = Query { position_grad: true, ..Query::new(&*model.field, &params) };
    let mut rays = Rays::new();
    for i in 0..camera.width * camera.height {
        rays.push_pixel(camera, [i % camera.width, i / camera.width], model.reach(), model.scene_box.near_far);
    }
    let steps = model.sampler.sample(&query, &rays, Purpose::View { finer: 1 }, &mut Jitter::Middle).samples;
    let seen = model.sampler.quadrature().render(&query, &steps, 0.0).rendered;
    let normals = seen.accumulate(&seen.normals());
    let vector = |n: &[f32]| DVec3::new(n[0].into(), n[1].into(), n[2].into());
    let mut angles = vec![];
    for (x, y) in (1..camera.width - 1).flat_map(|x| (1..camera.height - 1).map(move |y| (x, y))) {
        let at = |x: usize, y: usize| vector(truth.pixel(x, y));
        let own = at(x, y);
        let even = [at(x - 1, y), at(x + 1, y), at(x, y - 1), at(x, y + 1)].iter().all(|n| n.dot(own) > 0.99);
        if even {
            let place = 3 * (y * camera.width + x);
            let found = vector(&normals.value().as_slice()[place..place + 3]);
            angles.push(if found.length() > 0.1 { found.angle_between(own).to_degrees() } else { 180.0 });
        }
    }
    angles.sort_by(f64::total_cmp);
    assert!(angles.len() > 100, "{} even pixels", angles.len());
    angles[angles.len() / 2]
}

#[test]
fn learned_scene_has_true_colour_depth_and_normals() {
    let scene = Scene::bulldozer();
    let frame = |number: usize| {
        let camera = camera(number);
        let image = scene.render(&camera, 5).color.into();
        Frame { name: format!("train/{number}"), camera, image, mask: None, distances: None }
    };
    let [low, high] = scene.bounds();
    let data = Dataset {
        frames: (2..38).map(frame).collect(),
        bounds: [low - 0.02, high + 0.02],
        near: 2.0,
        far: 6.0,
        scene_type: SceneType::Bounded,
        ndc: None,
        transform: SceneTransform::default(),
        skipped: vec![],
        masked: vec![],
    };
    let mut config = Config::preset(Preset::Instant);
    let field = config.field.get_mut::<InstantConfig>().unwrap();
    field.grid = HashGridConfig { levels: 4, features: 2, log2_table: 14, coarsest: 8, finest: 40 };
    (field.density_width, field.color_width) = (16, 16);
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.step, sampler.view_step, sampler.samples, sampler.occupancy.resolution) = (0.02, 0.005, 4096, 32);
    let mut trainer = Trainer::new(config, Arc::new(data)).unwrap();
    for i in 0..500 {
        trainer.step(f64::from(i) / 500.0);
    }
    trainer.model.finish();
    // The first two are not training cameras.
    for number in 0..2 {
        let camera = camera(number);
        let truth = scene.render(&camera, 9);
        let seen = trainer.model.render(&camera, [1.0; 3]);
        let color = truth.color.over([1.0; 3]);
        let close = psnr(&seen.color, &color);
        let far = |depth: &Image| {
            let pairs = truth.depth.data.iter().zip(&depth.data);
            let mut errors: Vec<f32> =
                pairs.filter(|(a, b)| **a > 0.0 && **b > 0.0).map(|(a, b)| (a - b).abs()).collect();
            errors.sort_by(f32::total_cmp);
            assert!(errors.len() > 300, "{} pixels with a distance", errors.len());
            errors[errors.len() / 2]
        };
        let depth = far(&seen.depth);
        let normals = normals_apart(&trainer.model, &camera, &truth.normal);
        println!("view {number}: {close:.2} dB, distances {depth:.4} off, normals {normals:.1} degrees");
        assert!(close > 22.0 && depth < 0.045 && normals < 45.0, "{close} dB, {depth}, {normals} degrees");
        for wrong in mistaken(&seen.color) {
            assert!(psnr(&wrong, &color) < close - 6.0, "a mistaken picture is another one");
        }
        for wrong in mistaken(&seen.depth) {
            assert!(far(&wrong) > 3.0 * depth, "and so are its distances");
        }
        for wrong in mistaken(&truth.normal) {
            assert!(normals_apart(&trainer.model, &camera, &wrong) > normals + 10.0, "and its normals");
        }
    }
}

/// A wall across the ray: early termination is compensated for, also in depth.
#[test]
fn early_termination_keeps_the_depth() {
    let wall = Layer { from: 3.0, to: 3.5, sigma: 200.0, color: [0.5, 0.0] };
    let layers = Layers::new(std::slice::from_ref(&wall));
    let exact = layers.exact(4.0, 1.0);
    let scene = AnalyticScene { name: "wall", medium: Arc::new(layers), exact, ..scenes().remove(0) };
    let pose = Camera::look_at(scene.ray.origin, scene.ray.at(1.0), DVec3::Y);
    let camera = Camera { width: 1, height: 1, focal: [1.0; 2], centre: [0.5; 2], lens: Lens::Pinhole, pose };
    let model = medium(&scene, Quadrature::Midpoint, Skip::Off);
    let seen = model.render_within(&camera, [1.0; 3], &RayTolerance { early_stop_eps: 0.2, color_budget: 0.0 });
    let [depth, opacity] = [seen.depth.data[0], seen.opacity.data[0]];
    assert!((depth - 3.005).abs() < 0.01 && opacity == 1.0, "{depth} {opacity}");
    assert!((seen.color.data[0] - 0.5).abs() < 1e-5, "{:?}", seen.color.data);
}

/// A model that is an analytic medium, marched with steps of 1/400 of the box.
fn medium(scene: &AnalyticScene, rule: Quadrature, skip: Skip) -> Model<f32> {
    let occupancy = OccupancyConfig { resolution: 32, cascades: 1, skip: skip.into() };
    let marching = MarchingConfig { occupancy, quadrature: rule, view_step: 1.0 / 400.0, ..MarchingConfig::default() };
    let config = Config { sampler: SamplerConfig::new(marching), ..Config::preset(Preset::Instant) };
    let mut model = Model::new(config, SceneBox::new(scene.bounds(), [0.0, scene.length]), 0).unwrap();
    let mut params = Params::new();
    model.field = Arc::new(AnalyticField::new(scene.medium.clone(), &mut params));
    model.params = params;
    model.finish();
    model
}

#[test]
fn renders_of_analytic_media_are_exact() {
    let rules = [
        (Quadrature::Left, 6e-3),
        (Quadrature::Midpoint, 4e-3),
        (Quadrature::PiecewiseLinear, 4e-3),
        (Quadrature::Gauss2, 4e-3),
        (Quadrature::Adaptive { tolerance: 1e-4 }, 1e-3),
    ];
    for scene in scenes() {
        // The ray is that of the pixel in column 3 and row 1 of a wide image.
        let pose = Camera::look_at(scene.ray.origin, scene.ray.at(1.0), DVec3::Y);
        let camera = Camera { width: 5, height: 3, focal: [40.0, 30.0], centre: [3.5, 1.5], lens: Lens::Pinhole, pose };
        assert!(camera.pixel_ray(3, 1).direction.distance(scene.ray.direction) < 1e-12);
        let white = [scene.background as f32; 3];
        let exact = &scene.exact;
        let opacity = 1.0 - exact.transmittance;
        for (rule, error) in rules {
            for skip in [Skip::Off, Skip::NearLossless, Skip::Fast] {
                let model = medium(&scene, rule, skip);
                let limits = RayTolerance::of(&skip.into());
                let few = RayTolerance { early_stop_eps: 0.02, color_budget: 0.02 };
                for limits in [limits, few] {
                    let seen = model.render_within(&camera, white, &limits);
                    let bound = error + skip.error_bound() + f64::from(limits.early_stop_eps + limits.color_budget);
                    let what = format!("{} by {rule}, {skip:?}, {limits:?}", scene.name);
                    let color = f64::from(seen.color.pixel(3, 1)[0]);
                    assert!((color - exact.color).abs() <= bound, "{what}: {color} for {}", exact.color);
                    let blocked = f64::from(seen.opacity.pixel(3, 1)[0]);
                    assert!((blocked - opacity).abs() <= bound, "{what}: opacity {blocked} for {opacity}");
                    let depth = f64::from(seen.depth.pixel(3, 1)[0]);
                    let expected = exact.depth / opacity;
                    let within = 2.0 * scene.length * bound / opacity;
                    assert!((depth - expected).abs() <= within, "{what}: distance {depth} for {expected}");
                    let asked = seen.evaluations;
                    assert!(asked.density > 0 && asked.color > 0 && asked.density >= asked.color, "{what}: {asked:?}");
                }
                if skip == Skip::Off {
                    let dense = model.render_reference(&camera, [scene.background; 3], 1).pixels[5 + 3];
                    assert!((dense.color[1] - exact.color).abs() <= error, "{} by {rule}: the reference", scene.name);
                }
            }
        }
    }
}
