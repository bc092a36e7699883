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
/// Most pixels of all pictures of a video, which are kept as files until it is made.
const MOST_OF_A_FILM: u64 = 1 << 34;
/// Coordinates beyond this, in scene units, are of nothing that can be seen.
const FARTHEST: f64 = 1e9;

/// What a page says: text, one JSON object a message.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "ask", rename_all = "kebab-case", deny_unknown_fields, expecting = "a message")]
pub enum ClientMessage {
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
    /// A video.
    Video(VideoRequest),
    /// The video that is being made is not wanted.
    EndVideo {},
}

impl ClientMessage {
    /// Reads a message.
    pub fn read(text: &str) -> Result<ClientMessage, String> {
        let ask: ClientMessage =
            serde_json::from_str(text).map_err(|e| e.to_string().replace(char::is_control, " "))?;
        match &ask {
            ClientMessage::View { view, .. } | ClientMessage::Save { view } => view.check()?,
            ClientMessage::Video(video) => video.check()?,
            ClientMessage::Share { share } if !(0.0..=0.9).contains(share) => {
                return Err("`share` must be from 0 to 0.9".to_owned());
            }
            _ => (),
        }
        Ok(ask)
    }
}

/// A video along a camera path, of the run's model as a whole.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VideoRequest {
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

impl VideoRequest {
    fn check(&self) -> Result<(), String> {
        if self.pixels()? > MOST_PIXELS.into() {
            return Err(format!("a video's frames may have at most {MOST_PIXELS} pixels"));
        }
        self.frames().map(drop)
    }

    /// Whether there is room for all of its frames: a page may well ask for more, and is told.
    pub fn fits(&self) -> Result<(), String> {
        let (pixels, frames) = (self.pixels()?, self.frames()?);
        if pixels * frames > MOST_OF_A_FILM as f64 {
            let most = MOST_OF_A_FILM as f64 / pixels;
            return Err(format!(
                "{frames:.0} frames of this size are too many (at most {most:.0}): lower the seconds, `fps` or size"
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
            _ => Err(format!("a video's `{name}` must be a number from 0 to {most}")),
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
            return Err(format!("{width}x{height} is not a size of 1 to {MOST_PIXELS} pixels"));
        }
        if self.compared && self.show != Show::Color {
            return Err("only colours can be compared".to_owned());
        }
        if let Eye::Free { pose, fov } = &self.eye {
            let rotation = rotation(pose);
            let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
            let turns = excess.to_cols_array().iter().all(|x| x.abs() < 1e-3) && rotation.determinant() > 0.0;
            if !turns || !pose.iter().all(|row| row[3].abs() <= FARTHEST) {
                return Err("`pose` must be a rotation and a position".to_owned());
            }
            if !(1.0..=170.0).contains(fov) {
                return Err("`fov` must be from 1 to 170 degrees".to_owned());
            }
        }
        let numbers = self.crop.iter().flatten().flatten();
        if !numbers.into_iter().all(|x| x.abs() <= FARTHEST) {
            return Err("`crop` must be two finite corners".to_owned());
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
pub enum ServerMessage {
    About(Box<About>),
    /// How training goes.
    Training(Value),
    /// Where photographs were taken, as it is known by now.
    Taken(Taken),
    /// How a video is getting on, and in which file.
    Video {
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
pub fn text(tell: &ServerMessage) -> String {
    serde_json::to_string(tell).unwrap_or_default()
}

/// A photograph at this size, over a background.
pub fn at_size(photo: &Photo, [width, height]: [usize; 2], background: [f32; 3]) -> Image {
    let same = [photo.width, photo.height] == [width, height];
    if same { photo.over(background) } else { photo.resized([width, height]).over(background) }
}

#[cfg(test)]
mod tests;
