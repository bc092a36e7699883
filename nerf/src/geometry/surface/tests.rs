//! Surfaces and point clouds of a model with a known field.

use super::*;
use crate::field::{self, Density, Field, FieldConfig, VoxelConfig};
use crate::model::{Config, Preset, SceneBox};
use crate::sampling::marching::MarchingConfig;
use glam::DVec3;
use raygrad_autograd::{Tensor, Var};
use raygrad_nn::Bound;
use std::f64::consts::{LN_2, PI};
use std::sync::Arc;

/// Balls whose density rises inwards by a factor of e per 40th of a unit, from 1 at their rims. Seen along the
/// direction -d, a point has the colour (d + 1) / 2.
struct Balls(Vec<(DVec3, f64)>);

const STEEPNESS: f64 = 40.0;

impl Field<f32> for Balls {
    fn density<'t>(&self, _: &Bound<'t, f32>, positions: &Var<'t, f32>) -> Density<'t, f32> {
        let depth = |(centre, radius): &(DVec3, f64)| {
            let centre = positions.tape().constant(Tensor::from(centre.as_vec3().to_array()));
            (*radius - (positions - centre).square().sum_over(-1).sqrt()) * STEEPNESS
        };
        let deepest = self.0.iter().map(depth).reduce(|a, b| a.maximum(b));
        Density { value: deepest.unwrap(), log: true, features: positions.clone() }
    }

    fn color<'t>(&self, _: &Bound<'t, f32>, _: &Var<'t, f32>, seen: &field::ViewInputs<'_, 't, f32>) -> Var<'t, f32> {
        0.5 - seen.directions.segment_expand(seen.segments) * 0.5
    }
}

const CENTRE: DVec3 = DVec3::new(0.3, -0.2, 0.1);
const RADIUS: f64 = 0.5;

/// A model with this field in a box with unequal sides. The preset decides on an occupancy grid.
fn model(balls: &[(DVec3, f64)], preset: Preset) -> Model<f32> {
    model_in([DVec3::new(-1.0, -0.9, -0.8), DVec3::new(1.5, 1.2, 0.9)], balls, preset)
}

fn model_in(bounds: [DVec3; 2], balls: &[(DVec3, f64)], preset: Preset) -> Model<f32> {
    let mut config = Config::preset(preset);
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        config.field = FieldConfig::new(VoxelConfig { resolution: 20, direction_degree: 1 });
        sampler.occupancy.resolution = 32;
    }
    let mut model = Model::new(config, SceneBox::new(bounds, [0.5, 8.0]), 0).unwrap();
    model.field = Arc::new(Balls(balls.to_vec()));
    model.finish();
    model
}

fn ball() -> Model<f32> {
    model(&[(CENTRE, RADIUS)], Preset::Voxel)
}

/// Cameras around the ball, with images that are not square.
fn cameras() -> Vec<Camera> {
    let camera = |i: usize| {
        let (sin, cos) = (i as f64).sin_cos();
        let eye = CENTRE + DVec3::new(3.0 * cos, 3.0 * sin, 1.0 - 0.7 * i as f64);
        Camera::from_angle(60, 40, 0.7, Camera::look_at(eye, CENTRE, DVec3::Z))
    };
    (0..6).map(camera).collect()
}

fn surface(model: &Model<f32>, config: &SurfaceConfig) -> Surface {
    model.surface(&cameras(), config, &mut |_, done| assert!((0.0..=1.0).contains(&done))).unwrap()
}

/// The resolution suits the balls.
const CONFIG: SurfaceConfig = SurfaceConfig {
    region: None,
    resolution: Some(80),
    iso_value: None,
    min_component: 0.01,
    triangles: None,
    fill_unseen: false,
    closed: true,
};

#[test]
fn surface_is_at_the_visible_depth() {
    let found = surface(&ball(), &CONFIG);
    // A ray through the centre has lost half of its light at the density 40 ln 2; an oblique ray has earlier.
    let most = STEEPNESS * LN_2;
    // The share of rays beyond an angle of incidence is its squared sine: the lower quartile has the cosine 0.5.
    assert!((0.4 * most..0.6 * most).contains(&found.iso_value), "{} {most}", found.iso_value);
    let radius = RADIUS - found.iso_value.ln() / STEEPNESS;
    let ColoredMesh { mesh, normals, colors } = &found.colored_mesh;
    assert!(mesh.is_closed() && mesh.components().1 == 1 && found.dropped == 0 && found.resolution == 80);
    assert!((mesh.volume() / (4.0 / 3.0 * PI * radius.powi(3)) - 1.0).abs() < 0.01);
    assert_eq!([normals.len(), colors.len()], [mesh.positions.len(); 2]);
    for ((place, normal), color) in mesh.positions.iter().zip(normals).zip(colors) {
        assert!((place.distance(CENTRE) - radius).abs() < 1e-4, "{place}");
        assert!(normal.dot((place - CENTRE).normalize()) > 0.98, "{place} {normal}");
        // The colour is that seen along the normal: towards +x, red is 1.
        let expected = normal.to_array().map(|x| 255.0 * (0.5 + 0.5 * x));
        assert!((0..3).all(|k| (f64::from(color[k]) - expected[k]).abs() < 0.51), "{color:?} {expected:?}");
    }
}

#[test]
fn iso_value_of_the_config_is_used() {
    for level in [1.0, 500.0] {
        let found = surface(&ball(), &SurfaceConfig { iso_value: Some(level), ..CONFIG });
        let radius = RADIUS - level.ln() / STEEPNESS;
        assert!(found.iso_value == level && !found.colored_mesh.mesh.positions.is_empty());
        let off = |place: &DVec3| (place.distance(CENTRE) - radius).abs();
        assert!(found.colored_mesh.mesh.positions.iter().all(|place| off(place) < 1e-4), "{level}");
        // Of 82 x 69 x 56 nodes, only those near the surface are evaluated. Each vertex takes five evaluations for its
        // position and six for its normal.
        let (asked, vertices) = (found.evaluations, found.colored_mesh.mesh.positions.len() as u64);
        assert!((11 * vertices + 5000..150_000).contains(&asked.density), "{asked:?} {vertices}");
        assert_eq!(asked.color, vertices);
    }
    let default = surface(&ball(), &SurfaceConfig { resolution: None, iso_value: Some(1.0), ..CONFIG });
    assert_eq!(default.resolution, 64, "two cells for each of the grid's 32");
}

#[test]
fn skipped_cells_have_no_surface() {
    let mut half = ball();
    if let Some(marching) = half.marching_mut() {
        // Cells are 0.078125 wide: those up to x = 0.25 stay.
        let left = |points: &[[f32; 3]], out: &mut [f32]| {
            points.iter().zip(out).for_each(|(x, out)| *out = if x[0] < 0.25 { 1.0 } else { 0.0 });
        };
        marching.grid.rebuild(0.5, false, &left);
    }
    half.finish();
    let found = surface(&half, &SurfaceConfig { iso_value: Some(1.0), ..CONFIG });
    let mesh = &found.colored_mesh.mesh;
    // A cap of the height RADIUS - 0.05, since the cut is at 0.25.
    let height: f64 = RADIUS - 0.05;
    let cap = PI * height * height * (3.0 * RADIUS - height) / 3.0;
    assert!(mesh.is_closed() && (mesh.volume() / cap - 1.0).abs() < 0.01, "{} {cap}", mesh.volume());
    assert!((mesh.bounds().unwrap()[1].x - 0.25).abs() < 2.5 / 80.0 / 32.0);
}

#[test]
fn surface_without_grid_equals_that_with_grid() {
    let config = SurfaceConfig { iso_value: Some(2.0), ..CONFIG };
    let with = surface(&ball(), &config);
    let without = surface(&model(&[(CENTRE, RADIUS)], Preset::Small), &config);
    assert_eq!(with.colored_mesh.mesh, without.colored_mesh.mesh);
    // The search starts on a grid, so it does not evaluate the whole lattice.
    assert!(without.evaluations.density > 128 * 128 * 128 / 4 && with.evaluations.density < 200_000);
}

#[test]
fn surface_drops_small_parts_and_decimates() {
    let balls = [(CENTRE, RADIUS), (DVec3::new(-0.7, 0.8, -0.4), 0.15)];
    let config = SurfaceConfig { iso_value: Some(1.0), ..CONFIG };
    // Its area is 0.09 of the other's.
    for (parts, dropped) in [(0.0, 0), (0.05, 0), (0.15, 1)] {
        let found = surface(&model(&balls, Preset::Voxel), &SurfaceConfig { min_component: parts, ..config });
        assert_eq!((found.dropped, found.colored_mesh.mesh.components().1), (dropped, 2 - dropped), "{parts}");
    }
    let few = surface(&ball(), &SurfaceConfig { triangles: Some(500), ..config });
    let ColoredMesh { mesh, normals, .. } = &few.colored_mesh;
    assert!(mesh.triangles.len() == 500 && mesh.is_closed() && normals.len() == mesh.positions.len());
    assert!((mesh.volume() / (4.0 / 3.0 * PI * RADIUS.powi(3)) - 1.0).abs() < 0.02);
}

#[test]
fn surface_at_the_box_is_closed_or_open() {
    // The centre of the ball is on a side of the box.
    let model = model(&[(DVec3::new(1.5, 0.2, 0.0), RADIUS)], Preset::Voxel);
    let config = SurfaceConfig { iso_value: Some(1.0), ..CONFIG };
    let [closed, open] =
        [true, false].map(|closed| surface(&model, &SurfaceConfig { closed, ..config }).colored_mesh.mesh);
    let half = 2.0 / 3.0 * PI * RADIUS.powi(3);
    assert!(closed.is_closed() && (closed.volume() / half - 1.0).abs() < 0.015, "{} {half}", closed.volume());
    assert!(!open.is_closed() && (open.area() / (2.0 * PI * RADIUS.powi(2)) - 1.0).abs() < 0.015, "{}", open.area());
    // f32 rounds these faces outwards, where nothing is rendered: 1.7 and -0.6.
    for (centre, [low, high]) in
        [(1.7, [DVec3::new(-1.0, -0.9, -0.8), DVec3::new(1.7, 1.2, 0.9)]), (-0.6, [DVec3::splat(-0.6), DVec3::ONE])]
    {
        assert!([low.x, high.x].map(|x| f64::from(x as f32)).into_iter().any(|x| x > high.x || x < low.x));
        let model = model_in([low, high], &[(DVec3::new(centre, 0.2, 0.1), RADIUS)], Preset::Voxel);
        let open = surface(&model, &SurfaceConfig { closed: false, ..config }).colored_mesh.mesh;
        let area = 2.0 * PI * RADIUS.powi(2);
        assert!(!open.is_closed() && (open.area() / area - 1.0).abs() < 0.015, "{centre}: {} {area}", open.area());
    }
}

#[test]
fn surface_errors_name_the_setting() {
    let message = |config: SurfaceConfig, cameras: &[Camera]| {
        ball().surface(cameras, &config, &mut |_, _| ()).err().unwrap().to_string()
    };
    let cases = [
        (SurfaceConfig { iso_value: Some(-1.0), ..CONFIG }, "`iso_value`: is -1"),
        (SurfaceConfig { iso_value: Some(f64::NAN), ..CONFIG }, "`iso_value`: is NaN"),
        (SurfaceConfig { iso_value: Some(1e30), ..CONFIG }, "`iso_value`: is 1000000000000000000000000000000"),
        // The visible density is below the iso-value.
        (
            SurfaceConfig { iso_value: Some(1e30), fill_unseen: true, ..CONFIG },
            "`iso_value`: is 1000000000000000000000000000000",
        ),
        (SurfaceConfig { min_component: 1.5, ..CONFIG }, "`min_component`: is 1.5; use 0 to 1"),
        (SurfaceConfig { triangles: Some(3), ..CONFIG }, "`triangles`: is 3"),
        (SurfaceConfig { resolution: Some(0), ..CONFIG }, "`resolution`: is 0"),
    ];
    for (config, what) in cases {
        let said = message(config, &cameras());
        assert!(said.starts_with(what), "{said}");
    }
    let away = Camera::from_angle(8, 8, 0.3, Camera::look_at(DVec3::splat(5.0), DVec3::splat(9.0), DVec3::Z));
    for cameras in [vec![], vec![away.clone()]] {
        let said = message(CONFIG, &cameras);
        assert!(said.contains("`iso_value`: is missing, and no camera sees a surface"), "{said}");
        let said = ball().point_cloud(&cameras, 10, None, &mut |_, _| ()).err().unwrap().to_string();
        assert!(said.contains("`points`: cannot be found: no camera sees a surface"), "{said}");
    }
}

#[test]
fn point_cloud_covers_the_visible_surface() {
    let model = ball();
    let found = model.point_cloud(&cameras(), 2000, None, &mut |_, done| assert!((0.0..=1.0).contains(&done))).unwrap();
    let ColoredMesh { mesh, normals, colors } = &found.colored_mesh;
    let count = mesh.positions.len();
    assert!((1500..=2000).contains(&count) && mesh.triangles.is_empty(), "{count}");
    // Twelve rays per requested point, for any number of cameras.
    assert!((2 * count..12 * 2000 + 6 * 300).contains(&found.sights), "{}", found.sights);
    assert!([normals.len(), colors.len()] == [count; 2]);
    // Frontal rays lose half of their light at the density 40 ln 2, in the middle of a step; rays at the rim do so
    // nearer to the eye.
    let deepest = RADIUS - (STEEPNESS * LN_2).ln() / STEEPNESS;
    for ((place, normal), color) in mesh.positions.iter().zip(normals).zip(colors) {
        let radius = place.distance(CENTRE);
        assert!((deepest - 0.002..RADIUS).contains(&radius), "{radius} {deepest}");
        assert!(normal.dot((place - CENTRE).normalize()) > 0.98, "{place} {normal}");
        assert!((f64::from(color[2]) - 255.0 * (0.5 + 0.5 * normal.z)).abs() < 0.51, "{color:?} {normal}");
    }
    // The points are on all sides: their mean is near the ball's centre.
    let middle = mesh.positions.iter().sum::<DVec3>() / count as f64;
    assert!(middle.distance(CENTRE) < 0.1, "{middle}");
    let deep = mesh.positions.iter().filter(|place| place.distance(CENTRE) < deepest + 0.003).count();
    assert!(deep > count / 10, "straight on they are as deep as they can be: {deep} of {count}");
}

#[test]
fn fill_unseen_closes_hidden_voids() {
    // A ball with a void of the radius 0.2 inside a shell 0.3 thick. The cells of the void are occupied, like those of
    // a sponge.
    let mut hollow = ball();
    hollow.field = Arc::new(Hollow);
    let config = SurfaceConfig { iso_value: Some(2.0), min_component: 0.0, ..CONFIG };
    let open = surface(&hollow, &config).colored_mesh.mesh;
    let full = surface(&hollow, &SurfaceConfig { fill_unseen: true, ..config }).colored_mesh.mesh;
    assert_eq!((open.components().1, full.components().1), (2, 1));
    // The outer surface is unchanged.
    let whole = surface(&ball(), &config).colored_mesh.mesh;
    assert!((full.volume() / whole.volume() - 1.0).abs() < 1e-4, "{} {}", full.volume(), whole.volume());
    assert!(open.volume() < 0.95 * whole.volume() && full.is_closed());
    // Without cameras nothing counts as unseen.
    let blind = hollow.surface(&[], &SurfaceConfig { fill_unseen: true, ..config }, &mut |_, _| ()).unwrap();
    assert_eq!(blind.colored_mesh.mesh, open);
}

/// The ball with a void at its centre.
struct Hollow;

impl Field<f32> for Hollow {
    fn density<'t>(&self, params: &Bound<'t, f32>, positions: &Var<'t, f32>) -> Density<'t, f32> {
        let [outer, inner] = [RADIUS, 0.2].map(|radius| Balls(vec![(CENTRE, radius)]).density(params, positions));
        Density { value: outer.value.minimum(-inner.value), ..outer }
    }

    fn color<'t>(&self, _: &Bound<'t, f32>, _: &Var<'t, f32>, seen: &field::ViewInputs<'_, 't, f32>) -> Var<'t, f32> {
        seen.directions.segment_expand(seen.segments)
    }
}

#[test]
fn surface_colors_have_the_exposure_of_renders() {
    let rate = Some(raygrad_nn::Schedule::Constant { lr: 0.1 });
    let mut config = Config::preset(Preset::Voxel);
    config.field = FieldConfig::new(VoxelConfig { resolution: 20, direction_degree: 1 });
    config.exposure_model = crate::model::ExposureConfig { exposure: rate, vignetting: rate };
    let mut model = Model::new(config, SceneBox { frames: 2, ..ball().scene_box }, 0).unwrap();
    model.field = Arc::new(Balls(vec![(CENTRE, RADIUS)]));
    let [exposure, vignetting] = ["exposure", "vignetting"].map(|name| model.params.find(name).unwrap());
    let gains: [[f32; 3]; 2] = [[0.5, 1.0, 0.25], [1.0, 0.25, 1.0]];
    let numbers = gains.as_flattened().iter().map(|gain| gain.ln());
    model.params.get_mut(exposure).as_mut_slice().iter_mut().zip(numbers).for_each(|(out, x)| *out = x);
    model.params.get_mut(vignetting).as_mut_slice().fill(-1.0);
    let places = [CENTRE + 0.4 * DVec3::new(0.6, 0.0, 0.8)];
    // Without an image the gain is the geometric mean. Vignetting does not apply: colours are those at the image
    // centre.
    for (look, gains) in [(Some(0), gains[0]), (Some(1), gains[1]), (None, [0.5_f32.sqrt(), 0.5, 0.5])] {
        model.appearance_image = look;
        let (_, colors) = Probe::new(&model, None).look(None, 0.02, &places);
        for (found, expected) in colors[0].iter().zip([0.8, 0.5, 0.9].into_iter().zip(gains)) {
            assert!((f32::from(*found) - 255.0 * expected.0 * expected.1).abs() < 1.5, "{look:?}: {colors:?}");
        }
    }
}

#[test]
fn densities_end_at_the_region_and_at_the_model() {
    // A ball across the upper side of the scene box along x, and one in its middle.
    let rim = DVec3::new(1.5, 0.0, 0.0);
    let model = model(&[(rim, RADIUS), (DVec3::ZERO, RADIUS)], Preset::Small);
    let region = [DVec3::new(0.5, -1.0, -1.0), DVec3::new(3.0, 1.0, 1.0)].into();
    let probe = Probe::new(&model, Some(region));
    let points = [[1.4, 0.0, 0.0], [1.6, 0.0, 0.0], [0.0; 3]];
    let mut found = [9.0; 3];
    let most = probe.shown(None, None, &points, &mut found);
    assert!(found[0] > 1e3 && most == found[0] && found[1..] == [0.0; 2], "{found:?} {most}");
}

#[test]
fn surface_and_points_of_an_oriented_box() {
    // Along axes that are turned about z, from the ball's centre on. Normals see the cut up to a cell of 0.08 away.
    let rotation = glam::DMat3::from_rotation_z(0.6);
    let [low, high] = [DVec3::new(0.0, -0.7, -0.8), DVec3::new(0.6, 0.7, 0.55)];
    let region = OrientedBox { rotation, bounds: [low, high].map(|corner| rotation.transpose() * CENTRE + corner) };
    let config = SurfaceConfig { region: Some(region), iso_value: Some(1.0), ..CONFIG };
    for preset in [Preset::Voxel, Preset::Small] {
        let ColoredMesh { mesh, normals, .. } = surface(&model(&[(CENTRE, RADIUS)], preset), &config).colored_mesh;
        let half = 2.0 / 3.0 * PI * RADIUS.powi(3);
        assert!(mesh.is_closed() && (mesh.volume() / half - 1.0).abs() < 0.015, "{} {half}", mesh.volume());
        for (place, normal) in mesh.positions.iter().zip(&normals) {
            let [local, normal] = [*place - CENTRE, *normal].map(|vector| rotation.transpose() * vector);
            assert!(local.x > -0.01 && local.length() < RADIUS + 0.01, "{local}");
            assert!(local.x < 0.1 || normal.dot(local.normalize()) > 0.95, "{local} {normal}");
        }
    }
    let cloud = ball().point_cloud(&cameras(), 500, Some(region), &mut |_, _| ()).unwrap().colored_mesh;
    assert!(cloud.mesh.positions.len() > 300);
    for (place, normal) in cloud.mesh.positions.iter().zip(&cloud.normals) {
        let local = rotation.transpose() * (place - CENTRE);
        assert!(local.x > -1e-9, "{local}");
        assert!(local.x < 0.1 || normal.dot((place - CENTRE).normalize()) > 0.95, "{local} {normal}");
    }
    // In a capture's coordinates.
    let transform = crate::dataset::SceneTransform { rotation, scale: 2.0, origin: DVec3::new(5.0, 6.0, 7.0) };
    let corners = [DVec3::new(4.0, 6.5, 7.0), DVec3::new(6.0, 8.0, 9.0)];
    let found = OrientedBox::in_capture(&transform, corners).corners();
    assert!(found[0].distance(transform.point(corners[0])) < 1e-12);
    assert!(found[7].distance(transform.point(corners[1])) < 1e-12);
    assert!(found[1].distance(transform.point(DVec3::new(6.0, 6.5, 7.0))) < 1e-12);
}

#[test]
fn surface_beyond_the_scene_box_needs_an_unbounded_scene() {
    // The ball is beside the scene box, which reaches to 1.
    let bounds = [DVec3::NEG_ONE, DVec3::ONE];
    let mut config = Config::preset(Preset::Instant);
    config.unbounded = true;
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.occupancy.resolution, sampler.occupancy.cascades) = (32, 2);
    let mut open = Model::new(config, SceneBox::new(bounds, [0.1, 100.0]), 0).unwrap();
    open.field = Arc::new(Balls(vec![(DVec3::new(1.6, 0.0, 0.0), 0.3)]));
    open.finish();
    let config = SurfaceConfig { iso_value: Some(1.0), ..CONFIG };
    let find = |model: &Model<f32>, config: &SurfaceConfig| {
        model.surface(&[], config, &mut |_, _| ()).map(|found| found.colored_mesh.mesh)
    };
    assert!(find(&open, &config).is_err());
    let region = [DVec3::new(1.2, -0.5, -0.5), DVec3::new(3.0, 0.5, 0.5)];
    let beside = SurfaceConfig { region: Some(region.into()), ..config };
    let mesh = find(&open, &beside).unwrap();
    assert!(mesh.is_closed() && (mesh.volume() / (4.0 / 3.0 * PI * 0.027) - 1.0).abs() < 0.02, "{}", mesh.volume());
    let bounded = model_in(bounds, &[(DVec3::new(1.6, 0.0, 0.0), 0.3)], Preset::Voxel);
    assert!(find(&bounded, &beside).is_err());
}

#[test]
fn density_outside_of_the_box_is_zero() {
    let model = model(&[(DVec3::new(1.5, 0.2, 0.0), RADIUS)], Preset::Voxel);
    let mut found = [f32::NAN; 3];
    Probe::new(&model, None).shown(None, None, &[[1.49, 0.2, 0.0], [1.51, 0.2, 0.0], [1.2, 0.2, 0.0]], &mut found);
    assert!(found[0] > 1e6 && found[1] == 0.0 && found[2] > 100.0, "{found:?}");
}
