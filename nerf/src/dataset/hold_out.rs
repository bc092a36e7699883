//! The choice of images that are held out for evaluation.

use super::capture::{Capture, View};
use super::formats::fitting;
use super::frames::Split;
use crate::error::{Error, Result};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::HashSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// The images that are held out as [test](Split::Test) images; all others are trained on.
///
/// As text it is `none`, `every:8`, or names separated by commas.
///
/// # Examples
///
/// ```
/// use raygrad_nerf::dataset::HoldOut;
///
/// assert_eq!("every:8".parse::<HoldOut>()?, HoldOut::Every(8));
/// assert_eq!("a.jpg,b.jpg".parse::<HoldOut>()?, HoldOut::Images(vec!["a.jpg".into(), "b.jpg".into()]));
/// # Ok::<(), raygrad_nerf::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum HoldOut {
    /// No image.
    None,
    /// Every this many images by name, from the first; at least 2.
    Every(usize),
    /// The images with these names, or with these ends of their paths, also without the extension.
    Images(Vec<String>),
}

impl fmt::Display for HoldOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            HoldOut::None => f.write_str("none"),
            HoldOut::Every(count) => write!(f, "every:{count}"),
            HoldOut::Images(names) => f.write_str(&names.join(",")),
        }
    }
}

impl Serialize for HoldOut {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for HoldOut {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

impl FromStr for HoldOut {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if text == "none" {
            return Ok(HoldOut::None);
        }
        let wrong = |remedy: &str| Error::setting("test", format!("is `{text}`; {remedy}"));
        if let Some(count) = text.strip_prefix("every:") {
            let count = count.parse().ok().filter(|count| *count >= 2);
            return count.map(HoldOut::Every).ok_or_else(|| wrong("use every:N with N of at least 2"));
        }
        let names: Vec<String> = text.split(',').map(|name| name.trim().to_owned()).collect();
        match names.iter().any(String::is_empty) {
            true => Err(wrong("use none, every:N or names of images separated by commas")),
            false => Ok(HoldOut::Images(names)),
        }
    }
}

impl Capture {
    /// Replaces the splits of the files, or those that [`read`](Self::read) chose, by these held-out images. Views of
    /// one image are held out together.
    ///
    /// # Errors
    /// If a name fits no image or several.
    pub fn hold_out(&mut self, chosen: &HoldOut) -> Result<()> {
        let held_out: HashSet<PathBuf> = match chosen {
            HoldOut::None => HashSet::new(),
            HoldOut::Every(count) => self.every(*count),
            HoldOut::Images(names) => {
                let image = |name: &String| Ok(image(self.named_view(name)?).to_owned());
                names.iter().map(image).collect::<Result<_>>()?
            }
        };
        if self.views.iter().all(|view| held_out.contains(image(view))) {
            let what = format!("holds out all {} images: leave some to train on, or use none", self.views.len());
            return Err(Error::setting("test", what));
        }
        self.hold_out_images(&held_out);
        Ok(())
    }

    /// Every this many images by name, from the first.
    pub(super) fn every(&self, count: usize) -> HashSet<PathBuf> {
        let mut by_name: Vec<&View> = self.views.iter().collect();
        by_name.sort_by_key(|view| &view.name);
        distinct(by_name).step_by(count).map(|view| image(view).to_owned()).collect()
    }

    /// Makes these test images, and all others training images.
    pub(super) fn hold_out_images(&mut self, held_out: &HashSet<PathBuf>) {
        self.views.iter_mut().for_each(|view| view.split = Some(split_of(view, held_out)));
    }

    /// The first view of the image with a [fitting] name.
    fn named_view(&self, name: &str) -> Result<&View> {
        let names = fitting(self.views.iter().map(|view| view.name.as_str()), name);
        let views = self.views.iter().filter(|view| names.contains(&view.name.as_str())).collect();
        match distinct(views).collect::<Vec<_>>()[..] {
            [one] => Ok(one),
            [one, two, ..] => {
                let [one, two] = [one, two].map(|view| &view.name);
                Err(Error::setting(
                    "test",
                    format!("names `{name}`, which fits `{one}` and `{two}`: write more of the path"),
                ))
            }
            [] => {
                let first = self.views.first().map_or("", |view| &view.name);
                let what = format!("names `{name}`, which is no image of the capture; names are as `{first}`");
                Err(Error::setting("test", what))
            }
        }
    }
}

/// The file of a view's image or, if it is absent, its name.
fn image(view: &View) -> &Path {
    view.image.as_deref().unwrap_or(Path::new(&view.name))
}

/// Test if an image is held out, or else training.
pub(super) fn split_of(view: &View, held_out: &HashSet<PathBuf>) -> Split {
    if held_out.contains(image(view)) { Split::Test } else { Split::Train }
}

/// The first view of each image.
fn distinct(views: Vec<&View>) -> impl Iterator<Item = &View> {
    let mut seen = HashSet::new();
    views.into_iter().filter(move |view| seen.insert(image(view)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Camera;
    use crate::dataset::capture::Format;
    use glam::DAffine3;

    fn capture(names: &[&str]) -> Capture {
        let camera = Camera::from_angle(8, 6, 0.9, DAffine3::IDENTITY);
        let view = |name: &&str| View { image: Some(name.into()), ..View::new(*name, *name, camera.clone()) };
        let views = names.iter().map(view).collect();
        Capture::new(Path::new("scene"), "transforms.json".into(), Format::Transforms, views)
    }

    /// The names of held-out images.
    fn held_out(names: &[&str], chosen: &str) -> Result<Vec<String>> {
        let mut capture = capture(names);
        capture.views[0].split = Some(Split::Val);
        capture.hold_out(&chosen.parse()?)?;
        assert!(capture.views.iter().all(|view| matches!(view.split, Some(Split::Train | Split::Test))));
        Ok(capture.views.into_iter().filter(|view| view.split == Some(Split::Test)).map(|view| view.name).collect())
    }

    #[test]
    fn chosen_images_are_held_out() {
        let names = ["images/c.jpg", "images/a.jpg", "images/b.jpg", "images/d.png", "more/d.jpg"];
        for (chosen, expected) in [
            ("none", vec![]),
            ("every:2", vec!["images/a.jpg", "images/c.jpg", "more/d.jpg"]),
            ("every:9", vec!["images/a.jpg"]),
            ("images/b.jpg", vec!["images/b.jpg"]),
            ("b.jpg, c", vec!["images/c.jpg", "images/b.jpg"]),
            ("d.png", vec!["images/d.png"]),
            ("more/d", vec!["more/d.jpg"]),
            ("/data/images/B.JPG,IMAGES/C", vec!["images/b.jpg", "images/c.jpg"]),
        ] {
            let mut found = held_out(&names, chosen).unwrap();
            let mut expected: Vec<String> = expected.into_iter().map(str::to_owned).collect();
            found.sort();
            expected.sort();
            assert_eq!(found, expected, "{chosen}");
        }
    }

    #[test]
    fn unclear_choices_are_refused() {
        let names = ["images/a.jpg", "images/d.png", "more/d.jpg"];
        for (chosen, expected) in [
            ("d", "`test`: names `d`, which fits `images/d.png` and `more/d.jpg`: write more of the path"),
            ("e.jpg", "`test`: names `e.jpg`, which is no image of the capture; names are as `images/a.jpg`"),
            // Ends of paths are whole parts.
            (".jpg", "names `.jpg`, which is no image"),
            ("every:1", "`test`: is `every:1`; use every:N with N of at least 2"),
            ("every:x", "use every:N"),
            ("a.jpg,,", "use none, every:N or names of images separated by commas"),
            ("", "use none, every:N or names"),
            ("a,d.png,more/d", "`test`: holds out all 3 images: leave some to train on, or use none"),
            ("more/a.jpg", "which is no image"),
        ] {
            let message = held_out(&names, chosen).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn views_of_one_image_are_held_out_together() {
        // One image under two names, and another in two files of frames.
        let mut twice = capture(&["a", "c", "b", "c", "d"]);
        twice.views[2].image = twice.views[0].image.clone();
        for (chosen, expected) in [
            ("b", [true, false, true, false, false]),
            ("c", [false, true, false, true, false]),
            ("every:2", [true, false, true, false, true]),
            ("every:3", [true, false, true, false, false]),
            ("none", [false; 5]),
        ] {
            twice.hold_out(&chosen.parse().unwrap()).unwrap();
            let held_out = twice.views.iter().map(|view| view.split == Some(Split::Test));
            assert_eq!(held_out.collect::<Vec<_>>(), expected, "{chosen}");
        }
    }

    #[test]
    fn choices_round_trip_as_text() {
        for text in ["none", "every:8", "a.jpg,b/c.jpg"] {
            let chosen: HoldOut = text.parse().unwrap();
            assert_eq!(chosen.to_string(), text);
            assert_eq!(serde_json::to_string(&chosen).unwrap(), format!("\"{text}\""));
            assert_eq!(serde_json::from_str::<HoldOut>(&format!("\"{text}\"")).unwrap(), chosen);
        }
    }
}
