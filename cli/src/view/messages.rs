//! Messages between the viewer and its pages.

use raygrad::nerf::dataset::{Photo, Split};
use raygrad::nerf::glam::{DAffine3, DMat3, DQuat, DVec3};
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Camera, Image};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::render::shown::Show;

/// Longest side of a render in pixels.
pub const LARGEST: u32 = 4096;
/// Most pixels of a render.
const MOST_PIXELS: u32 = 1 << 22;
/// Most pixels of all frames of a video, which are stored as files until the video is complete.
const MOST_OF_A_FILM: u64 = 1 << 34;
/// Largest coordinate in scene units.
const FARTHEST: f64 = 1e9;

/// A message from a page: text with one JSON object.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "ask", rename_all = "kebab-case", deny_unknown_fields, expecting = "a message")]
pub enum ClientMessage {
    /// Requests renders of this view until the next request. Each render has this `id`.
    View { id: u32, view: View },
    /// Requests no renders for now.
    Rest {},
    /// Acknowledges a render of the request `id`, so that the next one may be sent.
    Seen { id: u32 },
    /// Requests the full-size render as a PNG file.
    Save { view: View },
    /// Requests an image.
    Photograph { number: usize },
    /// Pauses or resumes training.
    Pause { pause: bool },
    /// Stops training and saves the model.
    Stop {},
    /// Fraction of time for renders during training, 0 to 0.9.
    Share { share: f64 },
    /// Requests a video.
    Video(VideoRequest),
    /// Cancels the video.
    EndVideo {},
}

impl ClientMessage {
    /// Parses a message.
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

/// A video along a camera path, rendered with the run's model.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VideoRequest {
    /// A path for `raygrad render --path`, which validates the rest of it.
    pub path: Value,
    #[serde(default)]
    pub show: Show,
    /// Background; the background of training if `None`.
    #[serde(default)]
    pub background: Option<[u8; 3]>,
    /// Skipping; as in training if `None`.
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

    /// Fails if the video has too many pixels. A page may request any size.
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

/// A view of the scene. Coordinates are in scene units.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    pub eye: Eye,
    /// Width and height in pixels.
    pub size: [u32; 2],
    #[serde(default)]
    pub show: Show,
    /// True to show the error of colours against the nearest image, from its camera.
    #[serde(default)]
    pub compared: bool,
    /// Background; the background of training if `None`.
    #[serde(default)]
    pub background: Option<[u8; 3]>,
    /// Visible box: lower and upper corner.
    #[serde(default)]
    pub crop: Option<[[f64; 3]; 2]>,
    /// Skipping; as in training if `None`.
    #[serde(default)]
    pub skip: Option<Skip>,
    /// Step of the displayed checkpoint; `None` during training.
    #[serde(default)]
    pub checkpoint: Option<u64>,
}

/// Camera of a view.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Eye {
    /// A pinhole camera.
    Free {
        /// Camera-to-world matrix, three rows of four.
        pose: [[f64; 4]; 3],
        /// Vertical field of view in degrees.
        fov: f64,
    },
    /// The camera of the image with this number.
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

    /// The camera of a free view.
    pub fn camera(pose: &[[f64; 4]; 3], fov: f64, [width, height]: [usize; 2]) -> Camera {
        // Makes the matrix an exact rotation, since the page sends rounded numbers.
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

/// Description of the scene, sent once to each page.
#[derive(Debug, Clone, Serialize)]
pub struct About {
    pub title: String,
    #[serde(flatten)]
    pub first: FirstView,
    /// Width and height of the images.
    pub size: [usize; 2],
    pub background: [f32; 3],
    #[serde(flatten)]
    pub taken: Taken,
    /// Sparse points of the capture with their colours.
    pub points: Vec<([f32; 3], [u8; 3])>,
    /// True during training.
    pub training: bool,
    /// Steps of the available checkpoints.
    pub checkpoints: Vec<u64>,
}

/// Cameras of the images, which pose refinement may change.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Taken {
    /// From scene coordinates to the capture's coordinates, three rows of four.
    pub to_capture: [[f64; 4]; 3],
    pub photographs: Vec<AboutPhotograph>,
}

/// Initial view, and bounds of the scene.
#[derive(Debug, Clone, Serialize)]
pub struct FirstView {
    pub pose: [[f64; 4]; 3],
    /// Vertical field of view in degrees.
    pub fov: f64,
    /// Aspect ratio of the view: width over height.
    pub proportion: f64,
    /// The corners of the scene box, in scene units.
    pub bounds: [[f64; 3]; 2],
}

/// An image and its camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AboutPhotograph {
    pub name: String,
    pub split: Split,
    pub pose: [[f64; 4]; 3],
    /// Vertical field of view in degrees.
    pub fov: f64,
    /// Principal point, 0 to 1 from the left and from the top.
    pub centre: [f64; 2],
    pub size: [usize; 2],
}

/// A text message to a page.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "tell", rename_all = "kebab-case")]
pub enum ServerMessage {
    About(Box<About>),
    /// State of training.
    Training(Value),
    /// Current cameras of the images.
    Taken(Taken),
    /// Progress of a video, and its file.
    Video {
        file: String,
        words: String,
        ended: bool,
    },
    /// A request failed.
    Sorry {
        what: String,
    },
}

/// Header of a binary message. The message starts with the header's length in four bytes, little-endian. The header and
/// the file follow.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "file", rename_all = "kebab-case")]
pub enum File {
    /// A JPEG render for the request `id`.
    Picture {
        id: u32,
        #[serde(flatten)]
        made: Made,
    },
    /// A PNG file to download.
    Save { name: String },
    /// A JPEG of the image with this number.
    Photograph { number: usize },
}

/// Properties of a render.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Made {
    /// Number of times that the size was halved; 0 for full size.
    pub halvings: u32,
    /// Render time in milliseconds.
    pub milliseconds: f64,
    /// The compared image, if any. The PSNR in dB is `None` for coarse renders, and if evaluation masks or corrects the
    /// image. The flag is true if `raygrad eval` compares at this size.
    pub compared: Option<(usize, Option<f64>, bool)>,
    /// Training step.
    pub step: u64,
}

impl File {
    /// The binary message with this file.
    pub fn message(&self, bytes: &[u8]) -> Vec<u8> {
        let head = serde_json::to_vec(self).unwrap_or_default();
        [&(head.len() as u32).to_le_bytes(), &head[..], bytes].concat()
    }
}

/// The message as JSON text.
pub fn text(tell: &ServerMessage) -> String {
    serde_json::to_string(tell).unwrap_or_default()
}

/// The image at this size, over a background.
pub fn at_size(photo: &Photo, [width, height]: [usize; 2], background: [f32; 3]) -> Image {
    let same = [photo.width, photo.height] == [width, height];
    if same { photo.over(background) } else { photo.resized([width, height]).over(background) }
}

#[cfg(test)]
mod tests;
