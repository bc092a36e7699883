//! What a page asks for and what it is told.

use raygrad::nerf::dataset::{Photo, Split};
use raygrad::nerf::glam::{DAffine3, DMat3, DQuat, DVec3};
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Camera, Image};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::render::shown::Show;

/// Longest side of a picture.
pub const LARGEST: u32 = 4096;
/// Most pixels of a picture.
const MOST_PIXELS: u32 = 1 << 22;
/// Most pixels of all pictures of a film, which are kept as files until it is made.
const MOST_OF_A_FILM: u64 = 1 << 34;
/// Coordinates beyond this, in scene units, are of nothing that can be seen.
const FARTHEST: f64 = 1e9;

/// What a page says: text, one JSON object a message.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "ask", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Ask {
    /// Pictures of this, until something else is asked for. `id` comes back with them.
    View { id: u32, view: View },
    /// Nothing is looked at for now.
    Rest {},
    /// Another may be sent: the picture that was asked for by `id` has arrived.
    Seen { id: u32 },
    /// The picture of this in full, as a PNG file.
    Save { view: View },
    /// A photograph.
    Photograph { number: usize },
    /// Training goes on or waits.
    Pause { pause: bool },
    /// Training ends here, and what it has found is saved.
    Stop {},
    /// The share of time that training leaves to pictures, 0 to .9.
    Share { share: f64 },
    /// A film.
    Film(Film),
    /// The film that is being made is not wanted.
    EndFilm {},
}

impl Ask {
    /// Reads a message.
    pub fn read(text: &str) -> Result<Ask, String> {
        let ask: Ask = serde_json::from_str(text).map_err(|e| e.to_string().replace(char::is_control, " "))?;
        match &ask {
            Ask::View { view, .. } | Ask::Save { view } => view.check()?,
            Ask::Film(film) => film.check()?,
            Ask::Share { share } if !(0.0..=0.9).contains(share) => return Err("a share is from 0 to 0.9".to_owned()),
            _ => (),
        }
        Ok(ask)
    }
}

/// A film along a camera path, of the run's model as a whole.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Film {
    /// As `raygrad render --path` reads it, which says what else is wrong with it.
    pub path: Value,
    #[serde(default)]
    pub show: Show,
    /// What lies behind the scene; as in training if nothing is said.
    #[serde(default)]
    pub background: Option<[u8; 3]>,
    /// How much that hardly shows is left out; as in training if nothing is said.
    #[serde(default)]
    pub skip: Option<Skip>,
}

impl Film {
    fn check(&self) -> Result<(), String> {
        if self.pixels()? > MOST_PIXELS.into() {
            return Err(format!("a film's pictures have {MOST_PIXELS} pixels at most"));
        }
        self.frames().map(drop)
    }

    /// Whether there is room for all of its frames: a page may well ask for more, and is told.
    pub fn fits(&self) -> Result<(), String> {
        let (pixels, frames) = (self.pixels()?, self.frames()?);
        if pixels * frames > MOST_OF_A_FILM as f64 {
            let most = MOST_OF_A_FILM as f64 / pixels;
            return Err(format!(
                "a film of this size has {most:.0} frames at most, not {frames:.0}: lower its seconds, `fps` or size"
            ));
        }
        Ok(())
    }

    /// Pixels of a frame.
    fn pixels(&self) -> Result<f64, String> {
        Ok(self.number("render_width", LARGEST.into())? * self.number("render_height", LARGEST.into())?)
    }

    fn frames(&self) -> Result<f64, String> {
        Ok(self.number("seconds", 600.0)? * self.number("fps", 60.0)?)
    }

    fn number(&self, name: &str, most: f64) -> Result<f64, String> {
        match self.path.get(name).map(Value::as_f64) {
            Some(Some(value)) if (0.0..=most).contains(&value) => Ok(value),
            _ => Err(format!("a film's `{name}` is a number up to {most}")),
        }
    }
}

/// What is to be seen. Places are in scene units.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    pub eye: Eye,
    /// Width and height in pixels.
    pub size: [u32; 2],
    #[serde(default)]
    pub show: Show,
    /// Whether colours are seen as how far they are from those of the nearest photograph, from where that was taken.
    #[serde(default)]
    pub compared: bool,
    /// What lies behind the scene; as in training if nothing is said.
    #[serde(default)]
    pub background: Option<[u8; 3]>,
    /// The box beyond which nothing is shown, lower and upper corner.
    #[serde(default)]
    pub crop: Option<[[f64; 3]; 2]>,
    /// How much that hardly shows is left out; as in training if nothing is said.
    #[serde(default)]
    pub skip: Option<Skip>,
    /// The step of the checkpoint that is looked at; none while it is trained.
    #[serde(default)]
    pub checkpoint: Option<u64>,
}

/// Where a picture is seen from.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Eye {
    /// A pinhole.
    Free {
        /// Camera to world, three rows of four.
        pose: [[f64; 4]; 3],
        /// Vertical field of view in degrees.
        fov: f64,
    },
    /// Where the photograph of this number was taken, by its camera.
    Photograph(usize),
}

impl View {
    fn check(&self) -> Result<(), String> {
        let [width, height] = self.size;
        let sides = 1..=LARGEST;
        if !sides.contains(&width) || !sides.contains(&height) || width * height > MOST_PIXELS {
            return Err(format!("{width}x{height} is no size from 1x1 to {MOST_PIXELS} pixels"));
        }
        if self.compared && self.show != Show::Color {
            return Err("colours are compared, and nothing else".to_owned());
        }
        if let Eye::Free { pose, fov } = &self.eye {
            let rotation = rotation(pose);
            let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
            let turns = excess.to_cols_array().iter().all(|x| x.abs() < 1e-3) && rotation.determinant() > 0.0;
            if !turns || !pose.iter().all(|row| row[3].abs() <= FARTHEST) {
                return Err("a pose is a rotation and a place".to_owned());
            }
            if !(1.0..=170.0).contains(fov) {
                return Err("a field of view is from 1 to 170 degrees".to_owned());
            }
        }
        let numbers = self.crop.iter().flatten().flatten();
        if !numbers.into_iter().all(|x| x.abs() <= FARTHEST) {
            return Err("a box has two corners".to_owned());
        }
        Ok(())
    }

    /// The camera of a view that is free.
    pub fn camera(pose: &[[f64; 4]; 3], fov: f64, [width, height]: [usize; 2]) -> Camera {
        // Exactly a rotation, whatever was lost in a few digits.
        let turn = DQuat::from_mat3(&rotation(pose)).normalize();
        let pose = DAffine3 { matrix3: DMat3::from_quat(turn), translation: DVec3::from(pose.map(|row| row[3])) };
        let focal = 0.5 * height as f64 / (0.5 * fov.to_radians()).tan();
        Camera { focal: [focal; 2], ..Camera::from_angle(width, height, 1.0, pose) }
    }
}

fn rotation(pose: &[[f64; 4]; 3]) -> DMat3 {
    DMat3::from_cols_array(&std::array::from_fn(|i| pose[i % 3][i / 3]))
}

/// The rows of a pose.
pub fn rows(pose: &DAffine3) -> [[f64; 4]; 3] {
    [0, 1, 2].map(|r| {
        let row = pose.matrix3.row(r);
        [row.x, row.y, row.z, pose.translation[r]]
    })
}

/// What a page is told of the scene, once.
#[derive(Debug, Clone, Serialize)]
pub struct About {
    pub title: String,
    #[serde(flatten)]
    pub first: FirstView,
    /// Width and height of the photographs.
    pub size: [usize; 2],
    pub background: [f32; 3],
    #[serde(flatten)]
    pub taken: Taken,
    /// Places of the scene that were found with the cameras, with their colours.
    pub points: Vec<([f32; 3], [u8; 3])>,
    /// Whether the scene is being trained.
    pub training: bool,
    /// The steps of which there are checkpoints to look at.
    pub checkpoints: Vec<u64>,
}

/// Where photographs were taken, which training may learn more of.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Taken {
    /// From the scene to the capture's own coordinates, three rows of four.
    pub to_capture: [[f64; 4]; 3],
    pub photographs: Vec<AboutPhotograph>,
}

/// Where a scene is looked at from first, and where it is.
#[derive(Debug, Clone, Serialize)]
pub struct FirstView {
    pub pose: [[f64; 4]; 3],
    /// Vertical field of view in degrees.
    pub fov: f64,
    /// Width through height of the picture that this is of.
    pub proportion: f64,
    /// The corners of the scene's box, in scene units.
    pub bounds: [[f64; 3]; 2],
}

/// What a page is told of a photograph.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AboutPhotograph {
    pub name: String,
    pub split: Split,
    pub pose: [[f64; 4]; 3],
    /// Vertical field of view in degrees.
    pub fov: f64,
    /// Where its optical axis is, 0 to 1 from the left and from the top.
    pub centre: [f64; 2],
    pub size: [usize; 2],
}

/// What a page is told: of these, text.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "tell", rename_all = "kebab-case")]
pub enum Tell {
    About(Box<About>),
    /// How training goes.
    Training(Value),
    /// Where photographs were taken, as it is known by now.
    Taken(Taken),
    /// How a film is getting on, and in which file.
    Film {
        file: String,
        words: String,
        ended: bool,
    },
    /// What was asked for cannot be had.
    Sorry {
        what: String,
    },
}

/// What stands before a file in a message of bytes: how long this is, in four bytes, the least first, and this.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "file", rename_all = "kebab-case")]
pub enum File {
    /// A JPEG of what was asked for by `id`.
    Picture {
        id: u32,
        #[serde(flatten)]
        made: Made,
    },
    /// A PNG to keep.
    Save { name: String },
    /// A JPEG of the photograph of this number.
    Photograph { number: usize },
}

/// How a picture was made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Made {
    /// How many times its size was halved; 0 is the whole.
    pub halvings: u32,
    /// How long it took.
    pub milliseconds: f64,
    /// The photograph that it is compared with, if it is; their PSNR in dB at this size, of whole pictures and none where evaluations
    /// would leave something out; and whether that is an evaluation's own.
    pub compared: Option<(usize, Option<f64>, bool)>,
    /// The step of training.
    pub step: u64,
}

impl File {
    /// The message that has these bytes.
    pub fn message(&self, bytes: &[u8]) -> Vec<u8> {
        let head = serde_json::to_vec(self).unwrap_or_default();
        [&(head.len() as u32).to_le_bytes(), &head[..], bytes].concat()
    }
}

/// As text.
pub fn text(tell: &Tell) -> String {
    serde_json::to_string(tell).unwrap_or_default()
}

/// A photograph at this size, over a background.
pub fn at_size(photo: &Photo, [width, height]: [usize; 2], background: [f32; 3]) -> Image {
    let same = [photo.width, photo.height] == [width, height];
    if same { photo.over(background) } else { photo.resized([width, height]).over(background) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const POSE: [[f64; 4]; 3] = [[0.0, -1.0, 0.0, 0.5], [1.0, 0.0, 0.0, -4.0], [0.0, 0.0, 1.0, 1.0]];

    fn sized(width: u32, height: u32) -> View {
        View {
            eye: Eye::Free { pose: POSE, fov: 50.0 },
            size: [width, height],
            show: Show::Color,
            compared: false,
            background: None,
            crop: None,
            skip: None,
            checkpoint: None,
        }
    }

    /// As a page asks for it.
    fn asked(view: &View) -> Value {
        let eye = match &view.eye {
            Eye::Free { pose, fov } => json!({ "free": { "pose": pose, "fov": fov } }),
            Eye::Photograph(number) => json!({ "photograph": number }),
        };
        json!({ "eye": eye, "size": view.size, "show": view.show, "compared": view.compared, "crop": view.crop })
    }

    #[test]
    fn a_view_has_the_camera_that_is_asked_for() {
        // Looks along +y from (0, -4, 1), half a unit to the right.
        let pose = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 1.0]];
        let camera = View::camera(&pose, 90.0, [40, 20]);
        assert_eq!([camera.width, camera.height], [40, 20]);
        assert!(camera.focal.iter().all(|focal| (focal - 10.0).abs() < 1e-12), "{camera:?}");
        assert!(camera.ray(20.0, 10.0).direction.abs_diff_eq(DVec3::Y, 1e-12));
        assert!(camera.ray(20.0, 0.0).direction.abs_diff_eq(DVec3::new(0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()), 1e-12));
        let same = rows(&camera.pose).iter().flatten().zip(pose.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(same, "{camera:?}");
        // Three digits of a rotation are enough, and it is one.
        let rough = [[0.866, -0.5, 0.0, 0.0], [0.5, 0.866, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let turn = View::camera(&rough, 50.0, [8, 8]).pose.matrix3;
        assert!(
            (turn.transpose() * turn).abs_diff_eq(DMat3::IDENTITY, 1e-12) && (turn.determinant() - 1.0).abs() < 1e-12
        );
    }

    #[test]
    fn what_is_asked_for_is_read() {
        let read = |message: Value| Ask::read(&message.to_string()).unwrap();
        assert_eq!(read(json!({ "ask": "seen", "id": 4_294_967_295_u32 })), Ask::Seen { id: u32::MAX });
        assert_eq!(read(json!({ "ask": "photograph", "number": 3 })), Ask::Photograph { number: 3 });
        assert_eq!(read(json!({ "ask": "end-film" })), Ask::EndFilm {});
        assert_eq!(read(json!({ "ask": "share", "share": 0 })), Ask::Share { share: 0.0 });
        assert_eq!(read(json!({ "ask": "share", "share": 0.9 })), Ask::Share { share: 0.9 });
        let mut view = View { eye: Eye::Free { pose: POSE, fov: 170.0 }, ..sized(9, 7) };
        assert_eq!(read(json!({ "ask": "save", "view": asked(&view) })), Ask::Save { view: view.clone() });
        // At the ends of what there is.
        view.eye = Eye::Free { pose: [[1.0, 0.0, 0.0, 1e9], [0.0, 1.0, 0.0, -1e9], [0.0, 0.0, 1.0, 0.0]], fov: 1.0 };
        (view.compared, view.crop) = (true, Some([[-1e9; 3], [1e9; 3]]));
        assert_eq!(
            read(json!({ "ask": "view", "id": 1, "view": asked(&view) })),
            Ask::View { id: 1, view: view.clone() }
        );
        (view.compared, view.show, view.crop) = (false, Show::Depth, None);
        assert_eq!(read(json!({ "ask": "view", "id": 1, "view": asked(&view) })), Ask::View { id: 1, view });
    }

    #[test]
    fn what_is_no_message_is_refused_with_the_reason() {
        let view = asked(&sized(16, 16));
        let ask = |view: &Value| json!({ "ask": "view", "id": 1, "view": view });
        let changed = |name: &str, value: Value| {
            let mut view = view.clone();
            view[name] = value;
            ask(&view).to_string()
        };
        let pose = |pose: Value| changed("eye", json!({ "free": { "pose": pose, "fov": 50 } }));
        let field_of_view = |fov: f64| changed("eye", json!({ "free": { "pose": POSE, "fov": fov } }));
        let mut more = ask(&view);
        more["more"] = json!(1);
        let mut compared = view.clone();
        (compared["show"], compared["compared"]) = (json!("depth"), json!(true));
        for (message, expected) in [
            (String::new(), "EOF"),
            ("{".into(), "EOF"),
            ("[]".into(), "missing field"),
            ("null".into(), "invalid"),
            ("[".repeat(10_000), ""),
            (json!({ "ask": "everything" }).to_string(), "unknown variant"),
            (json!({ "ask": "view", "id": -1, "view": view }).to_string(), "invalid value"),
            (more.to_string(), "unknown field"),
            (json!({ "ask": "share", "share": 0.95 }).to_string(), "a share is"),
            (json!({ "ask": "share", "share": -0.05 }).to_string(), "a share is"),
            (json!({ "ask": "share", "share": null }).to_string(), "invalid type"),
            (json!({ "ask": "photograph", "number": -3 }).to_string(), "invalid value"),
            (changed("size", json!([4_294_967_295_u32, 4_294_967_295_u32])), "is no size"),
            (changed("show", json!("secrets")), "unknown variant"),
            (json!({ "ask": "save", "view": compared }).to_string(), "colours are compared"),
            (ask(&compared).to_string(), "colours are compared"),
            (changed("background", json!([0, 0, 256])), "invalid value"),
            (changed("crop", json!([[0, 0, 0], [1, 1, 1e10]])), "a box has"),
            (changed("crop", json!([[0, 0, 0]])), "invalid length"),
            (field_of_view(170.1), "a field of view is"),
            (field_of_view(0.9), "a field of view is"),
            (changed("eye", json!({ "photograph": -1 })), "invalid value"),
            (changed("eye", json!({})), "expected"),
            (pose(json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0]])), "a pose is"),
            (pose(json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]])), "a pose is"),
            (pose(json!([[1, 0, 0, 1e12], [0, 1, 0, 0], [0, 0, 1, 0]])), "a pose is"),
            (pose(json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]])), "invalid length"),
            (json!({ "ask": "film", "path": { "keys": [] } }).to_string(), "`render_width`"),
        ] {
            let reason = Ask::read(&message).unwrap_err();
            assert!(reason.contains(expected) && !reason.is_empty(), "{message}: {reason}");
        }
        // It is said in one line.
        let reason = Ask::read(r#"{ "ask": "one\nof\u0007two" }"#).unwrap_err();
        assert!(reason.contains("one of two"), "{reason}");
    }

    #[test]
    fn pictures_have_so_many_pixels_and_no_more() {
        for [width, height] in [[1, 1], [4096, 1], [1, 4096], [2048, 2048], [4096, 1024], [1024, 4096]] {
            assert_eq!(sized(width, height).check(), Ok(()), "{width}x{height}");
        }
        for [width, height] in
            [[0, 16], [16, 0], [0, 0], [4097, 1], [1, 4097], [4096, 1025], [1025, 4096], [2048, 2049], [4096, 4096]]
        {
            let reason = sized(width, height).check().unwrap_err();
            assert!(reason.contains(&format!("{width}x{height} is no size")), "{reason}");
        }
    }

    #[test]
    fn films_have_so_many_pixels_and_no_more() {
        let film = |[width, height]: [u32; 2], seconds: f64, fps: f64| -> Result<Result<(), String>, String> {
            let path = json!({ "render_width": width, "render_height": height, "seconds": seconds, "fps": fps });
            match Ask::read(&json!({ "ask": "film", "path": path }).to_string())? {
                Ask::Film(film) => Ok(film.fits()),
                other => panic!("{other:?}"),
            }
        };
        // The last has 2^34 in all.
        for (size, seconds, fps) in [
            ([640, 480], 600.0, 60.0),
            ([4096, 1], 0.0, 0.0),
            ([2048, 2048], 1.0, 1.0),
            ([1920, 1080], 270.0, 30.0),
            ([4096, 1024], 128.0, 32.0),
        ] {
            assert_eq!(film(size, seconds, fps), Ok(Ok(())), "{size:?} {seconds} {fps}");
        }
        for (size, seconds, fps, expected) in [
            ([4097, 1], 1.0, 1.0, "`render_width` is a number up to 4096"),
            ([1, 4097], 1.0, 1.0, "`render_height`"),
            ([4096, 1025], 1.0, 1.0, "4194304 pixels at most"),
            ([40, 40], 600.5, 1.0, "`seconds` is a number up to 600"),
            ([40, 40], -0.5, 1.0, "`seconds`"),
            ([40, 40], 1.0, 61.0, "`fps` is a number up to 60"),
        ] {
            let reason = film(size, seconds, fps).unwrap_err();
            assert!(reason.contains(expected), "{reason}");
        }
        for (size, seconds, fps, expected) in [
            ([4096, 1024], 128.5, 32.0, "4096 frames at most, not 4112: lower its seconds, `fps` or size"),
            ([2048, 2048], 600.0, 60.0, "4096 frames at most, not 36000"),
        ] {
            let reason = film(size, seconds, fps).unwrap().unwrap_err();
            assert!(reason.contains(expected), "{reason}");
        }
        assert!(Ask::read(r#"{ "ask": "film", "path": { "render_width": "8" } }"#).is_err());
    }

    #[test]
    fn photographs_come_in_the_size_that_is_asked_for() {
        let photo =
            Photo::from(Image { width: 4, height: 2, channels: 3, data: (0..24).map(|i| i as f32 / 24.0).collect() });
        assert_eq!(at_size(&photo, [4, 2], [0.0; 3]), photo.over([0.0; 3]));
        for size in [[2, 1], [4, 1], [2, 2]] {
            let small = at_size(&photo, size, [0.0; 3]);
            assert_eq!([small.width, small.height], size);
        }
    }

    #[test]
    fn pages_are_told_in_json() {
        let told = text(&Tell::Sorry { what: "it is lost".to_owned() });
        assert_eq!(told, r#"{"tell":"sorry","what":"it is lost"}"#);
    }

    #[test]
    fn a_file_comes_after_what_is_said_of_it() {
        let message = File::Photograph { number: 3 }.message(&[9, 8]);
        let length = u32::from_le_bytes(message[..4].try_into().unwrap()) as usize;
        let head: Value = serde_json::from_slice(&message[4..4 + length]).unwrap();
        assert_eq!(head, serde_json::json!({ "file": "photograph", "number": 3 }));
        assert_eq!(message[4 + length..], [9, 8]);
    }
}
