//! Camera paths: named ones, paths from files, and options that change them.

use std::path::PathBuf;

use raygrad::nerf::camera::{CameraPath as Spline, Keyframe, Spiral};
use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::glam::DAffine3;
use raygrad::nerf::{Camera, Error, Model, Result, SceneBox};
use raygrad_scenes::test_cameras;
use serde::{Serialize, Serializer};

use super::path_file::{self, Motion};
use crate::cameras::{Viewpoint, fitted};
use crate::output::note_fewer;
use crate::photographs::{Photograph, learned_transform, photographs};
use crate::run::Run;
use crate::scene::Scene;
use crate::{memory, parse};

/// Most frames of a video.
const MOST_FRAMES: usize = 100_000;
/// Default frames of an orbit.
const ORBIT_FRAMES: usize = 60;
/// Default frames of other paths, as in LLFF's spiral.
const FRAMES: usize = 120;
/// Default frames per second.
const FPS: f64 = 25.0;
/// Radius of a spiral about the orbit's first camera, as a fraction of its distance from the centre. Used if the
/// cameras have no mean.
const SPIRAL_SHARE: f64 = 0.1;

/// Options of the camera path.
#[derive(Debug, Clone, Default, clap::Args, Serialize)]
pub struct CameraPathArgs {
    /// Kind of path, or FILE.json
    ///
    /// orbit: around the scene, or back and forth where all images are from one side. spiral: LLFF's, about the
    /// mean camera. spline: through the images of --keyframes. test: from test view to test view. FILE.json: a
    /// camera path of nerfstudio or instant-ngp.
    #[arg(long, help_heading = "Camera", default_value = "orbit", value_parser = CameraPath::parse)]
    pub path: CameraPath,
    /// Number of frames
    ///
    /// The default is 60 for an orbit, 120 for other paths, one per test view, or what FILE.json says.
    #[arg(long, help_heading = "Camera", value_name = "N", value_parser = parse::count(MOST_FRAMES))]
    frames: Option<usize>,
    /// Video length, instead of --frames
    #[arg(long, help_heading = "Camera", value_parser = parse::above_zero, conflicts_with = "frames")]
    pub seconds: Option<f64>,
    /// Frames per second
    ///
    /// The default is 25, or what FILE.json says.
    #[arg(long, help_heading = "Camera", value_parser = parse::fps)]
    pub fps: Option<f64>,
    /// Image size, such as 400x300
    ///
    /// The default is the size of the training images, or what FILE.json says. Range: 1 to 16384 per side.
    #[arg(long, help_heading = "Camera", value_name = "WxH", value_parser = parse::size)]
    size: Option<[usize; 2]>,
    /// Aspect ratio, such as 16:9
    ///
    /// The height stays as usual. Range: 1:20 to 20:1.
    #[arg(long, help_heading = "Camera", value_name = "W:H", value_parser = parse::aspect, conflicts_with = "size")]
    aspect: Option<f64>,
    /// Vertical field of view, in degrees
    ///
    /// The default is that of the training images. Range: 0 to 180, exclusive.
    #[arg(long, help_heading = "Camera", value_name = "DEGREES", value_parser = parse::between(0.0, 180.0))]
    fov: Option<f64>,
    /// Scale of an orbit's or a spiral's radius
    ///
    /// 1 is the mean distance of the training cameras for an orbit, and LLFF's radius for a spiral.
    #[arg(long, help_heading = "Camera", value_name = "FACTOR", value_parser = parse::above_zero)]
    radius: Option<f64>,
    /// Height of an orbit, in degrees
    ///
    /// Angle above the horizon, -85 to 85. The default is the mean of the training cameras.
    #[arg(long, help_heading = "Camera", value_name = "DEGREES", value_parser = parse::between(-85.0, 85.0), allow_negative_numbers = true)]
    elevation: Option<f64>,
    /// Images on a spline's path, such as 0,5,9
    ///
    /// By number, counted from 0, or by name.
    #[arg(long, help_heading = "Camera", value_name = "VIEWS", value_delimiter = ',')]
    keyframes: Vec<String>,
    /// Split of --keyframes [default: train]
    ///
    /// train, val or test.
    #[arg(long, help_heading = "Camera", value_parser = parse::word::<Split>)]
    split: Option<Split>,
    /// Close a spline to a loop
    #[arg(long, help_heading = "Camera")]
    closed: bool,
    /// Where FILE.json's world lies in the capture
    ///
    /// For nerfstudio its dataparser_transforms.json; for instant-ngp the transforms.json with scale and offset.
    #[arg(long, help_heading = "Camera", value_name = "FILE")]
    #[serde(serialize_with = "lossy")]
    path_transform: Option<PathBuf>,
}

/// Serialises a path, which may not be Unicode.
fn lossy<S: Serializer>(path: &Option<PathBuf>, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    path.as_ref().map(|path| path.to_string_lossy()).serialize(serializer)
}

/// The camera path.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub enum CameraPath {
    #[default]
    Orbit,
    Spiral,
    Spline,
    Test,
    File(PathBuf),
}

impl CameraPath {
    fn parse(text: &str) -> std::result::Result<Self, String> {
        match text {
            "orbit" => Ok(CameraPath::Orbit),
            "spiral" => Ok(CameraPath::Spiral),
            "spline" => Ok(CameraPath::Spline),
            "test" => Ok(CameraPath::Test),
            file if file.to_ascii_lowercase().ends_with(".json") => Ok(CameraPath::File(file.into())),
            _ => Err("use orbit, spiral, spline, test or a FILE.json".to_owned()),
        }
    }

    /// Name of the path, and of the folder of its renders.
    pub fn name(&self) -> &'static str {
        match self {
            CameraPath::Orbit => "orbit",
            CameraPath::Spiral => "spiral",
            CameraPath::Spline => "spline",
            CameraPath::Test => "test",
            CameraPath::File(_) => "path",
        }
    }
}

/// Cameras of the same size, at least one, with the frame rate.
pub struct CameraMotion {
    pub cameras: Vec<Camera>,
    /// Frames per second.
    pub fps: f64,
}

impl CameraPathArgs {
    /// The cameras along the path, in scene coordinates.
    pub fn cameras(&self, run: &Run, model: &Model<f32>, scene: Option<&Scene>) -> Result<CameraMotion> {
        self.check()?;
        let (view, extent) = (&run.config.viewpoint, &run.config.scene_box);
        let (usual, given) = ([view.width, view.height], self.fps.unwrap_or(FPS));
        let flight = |cameras: Vec<Camera>| Ok::<_, Error>((cameras, usual, given));
        let (cameras, usual, fps) = match &self.path {
            CameraPath::Orbit => flight(self.orbit(view, &run.config.scene, extent, self.count(None, given)?))?,
            CameraPath::Spiral => {
                let spiral = self.spiral(view, extent, &photographs(run, model, scene, Split::Train)?);
                let camera = |pose: DAffine3| Camera::from_angle(view.width, view.height, view.angle_x, pose);
                flight(spiral.poses(self.count(None, given)?).into_iter().map(camera).collect())?
            }
            CameraPath::Spline => {
                let split = self.split.unwrap_or(Split::Train);
                let keys = chosen(&photographs(run, model, scene, split)?, &self.keyframes, split)?;
                let keys = Spline::through(keys, self.closed).frames(self.count(None, given)?);
                flight(keys.iter().map(|key| key.camera(usual)).collect())?
            }
            CameraPath::Test => {
                let all = photographs(run, model, scene, Split::Test)?;
                note_fewer("frames", self.frames, all.len(), "test images");
                let some = evenly_spaced(all, self.frames.unwrap_or(usize::MAX));
                // The exact size of the downscaled image.
                let small = |side: usize| ((side as f64 / run.config.downscale as f64).round() as usize).max(1);
                let camera = |camera: Camera| camera.resized(small(camera.width), small(camera.height));
                flight(some.into_iter().map(|photograph| camera(photograph.camera)).collect())?
            }
            CameraPath::File(file) => {
                let path_file::Path { motion, size, fps } =
                    path_file::read(file, self.path_transform.as_deref(), || Ok(run.capture(scene)?.applied))?;
                let (usual, fps) = (size.unwrap_or(usual), self.fps.or(fps).unwrap_or(FPS));
                let keys = match motion {
                    Motion::Frames(_) if self.frames.is_some() || self.seconds.is_some() => {
                        let flag = if self.frames.is_some() { "frames" } else { "seconds" };
                        return Err(Error::setting(flag, "does not apply to a file that lists every frame"));
                    }
                    Motion::Frames(keys) => keys,
                    Motion::Keys { path, seconds } => {
                        let usual = seconds.map(|seconds| (seconds * fps).round().max(1.0) as usize);
                        path.frames(self.count(usual, fps)?)
                    }
                };
                let given: Vec<Camera> = keys.iter().map(|key| extent.transform.camera(&key.camera(usual))).collect();
                // As the viewer, which writes such files, maps poses.
                let learned = learned_transform(model);
                (given.iter().map(|camera| learned.camera(camera)).collect(), usual, fps)
            }
        };
        let cameras = self.sized(&cameras, usual);
        memory::check_renders(&cameras)?;
        Ok(CameraMotion { cameras, fps })
    }

    /// The cameras at the size and field of view of the flags. `usual` is the size without flags.
    fn sized(&self, cameras: &[Camera], usual: [usize; 2]) -> Vec<Camera> {
        let size = match (self.size, self.aspect) {
            (Some(size), _) => size,
            (None, Some(aspect)) => [(usual[1] as f64 * aspect).round().max(1.0) as usize, usual[1]],
            (None, None) => usual,
        };
        let focal = self.fov.map(|degrees| 0.5 * size[1] as f64 / (0.5 * degrees.to_radians()).tan());
        let fit = |camera: &Camera| {
            let camera = fitted(camera, size);
            Camera { focal: focal.map_or(camera.focal, |focal| [focal; 2]), ..camera }
        };
        cameras.iter().map(fit).collect()
    }

    /// Fails if an option does not apply to the path.
    fn check(&self) -> Result<()> {
        use CameraPath::*;
        let (round, way) = (matches!(self.path, Orbit | Spiral), self.path == Spline);
        let file = matches!(self.path, File(_));
        let flags = [
            ("radius", self.radius.is_some(), round, "orbit and spiral"),
            ("elevation", self.elevation.is_some(), self.path == Orbit, "orbit"),
            ("fov", self.fov.is_some(), round || way, "orbit, spiral and spline"),
            ("keyframes", !self.keyframes.is_empty(), way, "spline"),
            ("split", self.split.is_some(), way, "spline"),
            ("closed", self.closed, way, "spline"),
            ("seconds", self.seconds.is_some(), self.path != Test, "all other paths"),
            ("path-transform", self.path_transform.is_some(), file, "a FILE.json"),
        ];
        if let Some((flag, _, _, paths)) = flags.into_iter().find(|(_, given, fits, _)| *given && !fits) {
            let what = format!("does not apply to --path {}: it is for {paths}", self.path.name());
            return Err(Error::setting(flag, what));
        }
        if way && self.keyframes.is_empty() {
            return Err(Error::setting(
                "keyframes",
                "is missing: --path spline needs images, such as --keyframes 0,5,9",
            ));
        }
        Ok(())
    }

    /// Number of frames: of the flags, else of the path's file, else the default of the path.
    fn count(&self, of_file: Option<usize>, fps: f64) -> Result<usize> {
        let usual = if self.path == CameraPath::Orbit { ORBIT_FRAMES } else { FRAMES };
        let timed = self.seconds.map(|seconds| (seconds * fps).round().max(1.0) as usize);
        let count = self.frames.or(timed).or(of_file).unwrap_or(usual);
        if count > MOST_FRAMES {
            let field = if self.seconds.is_some() { "seconds" } else { "path" };
            return Err(Error::setting(field, format!("{count} frames are more than the limit of {MOST_FRAMES}")));
        }
        Ok(count)
    }

    fn orbit(&self, view: &Viewpoint, scene: &Scene, extent: &SceneBox, count: usize) -> Vec<Camera> {
        if *scene == Scene::Embedded && self.radius.is_none() && self.elevation.is_none() {
            return test_cameras(count, view.width);
        }
        let distance = view.distance * self.radius.unwrap_or(1.0);
        let elevation = self.elevation.map_or(view.elevation, f64::to_radians);
        Viewpoint { distance, elevation, ..*view }.orbit(extent, count)
    }

    fn spiral(&self, view: &Viewpoint, extent: &SceneBox, photographs: &[Photograph]) -> Spiral {
        let middle = 0.5 * (extent.bounds[0] + extent.bounds[1]);
        let ahead = |pose: &DAffine3| (middle - pose.translation).dot(-pose.matrix3.z_axis);
        let times = self.radius.unwrap_or(1.0);
        let cameras: Vec<Camera> = photographs.iter().map(|photograph| photograph.camera.clone()).collect();
        if let Some(spiral) = Spiral::around(&cameras) {
            let known = photographs.iter().filter_map(|photograph| photograph.bounds);
            let known = known.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
            let [near, _] = extent.near_far;
            let focus = known.map_or_else(|| ahead(&spiral.pose).max(near), llff_focus);
            return Spiral { focus, radii: spiral.radii.map(|radius| times * radius), ..spiral };
        }
        let pose = view.orbit(extent, 1)[0].pose;
        let focus = ahead(&pose).max(SPIRAL_SHARE * extent.space().side());
        Spiral { pose, focus, radii: [times * SPIRAL_SHARE * focus; 3] }
    }
}

/// The focus of LLFF's spiral for the nearest and the farthest visible depth: a weighted harmonic mean.
fn llff_focus([near, far]: [f64; 2]) -> f64 {
    let [near, far] = [0.9 * near, 5.0 * far];
    (0.25 / near + 0.75 / far).recip()
}

/// The images of these numbers or names.
fn chosen(photographs: &[Photograph], words: &[String], split: Split) -> Result<Vec<Keyframe>> {
    let number = |word: &String| {
        let named = photographs.iter().position(|photograph| photograph.name == *word);
        let numbered = || word.parse().ok().filter(|number| *number < photographs.len());
        named.or_else(numbered).ok_or_else(|| {
            let (last, first) = (photographs.len() - 1, &photographs[0].name);
            let what =
                format!("`{word}` is not a {split} image: use numbers from 0 to {last}, or names such as {first}");
            Error::setting("keyframes", what)
        })
    };
    words.iter().map(|word| Ok(Keyframe::of(&photographs[number(word)?].camera))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::glam::DVec3;
    use std::f64::consts::PI;

    #[test]
    fn llff_focus_matches_published_code() {
        // Published code: close_depth, inf_depth = bds.min()*.9, bds.max()*5.; dt = .75; 1./(((1.-dt)/close_depth +
        // dt/inf_depth))
        assert!((llff_focus([2.0, 30.0]) - 6.949806949806949).abs() < 1e-12);
    }

    #[test]
    fn spiral_centre_is_mean_camera_or_orbit() {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::new(1.0, 1.0, 3.0)], [0.5, 9.0]);
        let view =
            Viewpoint { width: 40, height: 30, angle_x: 0.8, distance: 4.0, elevation: 0.3, azimuth: 0.0, reach: 0.4 };
        let photograph = |i: usize, side: f64, bounds| {
            let eye = DVec3::new(side * 4.0, 0.1 * i as f64 - 0.5, 1.0);
            let pose = Camera::look_at(eye, eye - side * DVec3::X, DVec3::Z);
            Photograph { name: String::new(), camera: Camera::from_angle(40, 30, 0.8, pose), bounds }
        };
        let args = CameraPathArgs { radius: Some(3.0), ..CameraPathArgs::default() };
        let spiral = |photographs: Vec<Photograph>| args.spiral(&view, &extent, &photographs);
        // The focus distance is that of the box's centre, or follows LLFF.
        let ahead = spiral((0..11).map(|i| photograph(i, 1.0, None)).collect());
        assert!((ahead.focus - 4.0).abs() < 1e-12 && (ahead.radii[0] - 1.5).abs() < 1e-12, "{ahead:?}");
        let known = spiral((0..11).map(|i| photograph(i, 1.0, Some([2.0 + i as f64, 20.0 + i as f64]))).collect());
        assert!((known.focus - 6.949806949806949).abs() < 1e-12);
        // Cameras on both sides: the first camera of the orbit, and a tenth of its distance, times 3.
        let around = spiral((0..10).map(|i| photograph(i, if i % 2 == 0 { 1.0 } else { -1.0 }, None)).collect());
        assert!(around.pose.abs_diff_eq(view.orbit(&extent, 1)[0].pose, 1e-12) && (around.focus - 4.0).abs() < 1e-12);
        assert!(around.radii.iter().all(|radius| (radius - 1.2).abs() < 1e-12));
    }

    #[test]
    fn check_option_of_other_paths_is_refused() {
        let of = |path: &str| CameraPathArgs { path: CameraPath::parse(path).unwrap(), ..CameraPathArgs::default() };
        let fails = |args: CameraPathArgs, expected: &str| {
            let message = args.check().unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        };
        fails(
            CameraPathArgs { radius: Some(2.0), ..of("test") },
            "`radius`: does not apply to --path test: it is for orbit and spiral",
        );
        fails(CameraPathArgs { elevation: Some(2.0), ..of("spiral") }, "`elevation`");
        fails(CameraPathArgs { fov: Some(2.0), ..of("a.JSON") }, "`fov`");
        fails(CameraPathArgs { keyframes: vec!["1".into()], ..of("orbit") }, "`keyframes`");
        fails(CameraPathArgs { split: Some(Split::Test), ..of("orbit") }, "`split`");
        fails(CameraPathArgs { closed: true, ..of("test") }, "`closed`");
        fails(CameraPathArgs { seconds: Some(1.0), ..of("test") }, "`seconds`");
        fails(CameraPathArgs { path_transform: Some("x".into()), ..of("orbit") }, "`path-transform`");
        fails(of("spline"), "`keyframes`: is missing");
        assert!(CameraPath::parse("path.txt").is_err() && of("orbit").check().is_ok());
        assert_eq!(CameraPathArgs { seconds: Some(2.5), ..of("orbit") }.count(Some(7), 30.0).unwrap(), 75);
        assert_eq!(CameraPathArgs { seconds: Some(1e-3), ..of("orbit") }.count(Some(7), 30.0).unwrap(), 1);
        assert!(CameraPathArgs { seconds: Some(1e9), ..of("orbit") }.count(Some(7), 30.0).is_err());
        assert_eq!(of("a.json").count(Some(7), 30.0).unwrap(), 7);
        assert_eq!(CameraPathArgs { frames: Some(9), ..of("a.json") }.count(Some(7), 30.0).unwrap(), 9);
        let usual = ["orbit", "spiral", "spline", "a.json"].map(|path| of(path).count(None, 30.0).unwrap());
        assert_eq!(usual, [60, 120, 120, 120]);
    }

    #[test]
    fn orbit_flags_set_radius_and_degrees() {
        let extent = SceneBox::new([DVec3::ZERO, DVec3::new(2.0, 4.0, 6.0)], [0.5, 9.0]);
        let view =
            Viewpoint { width: 40, height: 30, angle_x: 0.8, distance: 4.0, elevation: 0.3, azimuth: 0.0, reach: PI };
        let eye = |radius, elevation, scene: &Scene| {
            let args = CameraPathArgs { radius, elevation, ..CameraPathArgs::default() };
            let cameras = args.orbit(&view, scene, &extent, 3);
            assert_eq!(cameras.len(), 3);
            cameras[0].pose.translation
        };
        // 4 times 2.5 from the centre, (1, 2, 3), at 30 and -30 degrees.
        for (degrees, height) in [(30.0, 8.0), (-30.0, -2.0)] {
            for scene in [Scene::Folder("scene".into()), Scene::Embedded] {
                let eye = eye(Some(2.5), Some(degrees), &scene);
                assert!(eye.distance(DVec3::new(1.0 + 10.0 * 0.75_f64.sqrt(), 2.0, height)) < 1e-12, "{eye}");
            }
        }
        let plain = eye(None, None, &Scene::Folder("scene".into()));
        assert!((plain.distance(DVec3::new(1.0, 2.0, 3.0)) - 4.0).abs() < 1e-12, "{plain}");
    }

    #[test]
    fn size_flags_set_focal_and_vertical_fov() {
        let camera = Camera::from_angle(40, 30, 2.0 * 0.4_f64.atan(), DAffine3::IDENTITY);
        let sized = |args: CameraPathArgs| {
            let cameras = args.sized(&[camera.clone(), camera.clone()], [40, 30]);
            assert_eq!(cameras.len(), 2);
            let Camera { width, height, focal, centre, .. } = cameras[1];
            assert_eq!(centre, [0.5 * width as f64, 0.5 * height as f64]);
            ([width, height], focal)
        };
        let default = CameraPathArgs::default;
        let (wide, square) = (CameraPathArgs { size: Some([160, 60]), ..default() }, Some(1.0));
        // 15 / tan(30 degrees) and 30 / tan(30 degrees): half the height.
        let tan = 3.0_f64.sqrt();
        for (args, size, focal) in [
            (default(), [40, 30], 50.0),
            (wide.clone(), [160, 60], 100.0),
            (CameraPathArgs { aspect: Some(16.0 / 9.0), ..default() }, [53, 30], 50.0),
            (CameraPathArgs { aspect: square, ..default() }, [30, 30], 37.5),
            (CameraPathArgs { fov: Some(60.0), ..default() }, [40, 30], 15.0 * tan),
            (CameraPathArgs { fov: Some(60.0), ..wide }, [160, 60], 30.0 * tan),
            (CameraPathArgs { fov: Some(60.0), aspect: square, ..default() }, [30, 30], 15.0 * tan),
        ] {
            let (got, focals) = sized(args);
            assert_eq!(got, size);
            assert!(focals.iter().all(|own| (own - focal).abs() < 1e-9), "{size:?}: {focals:?}");
        }
    }
}
