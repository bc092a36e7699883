//! What can be wrong with a capture: the name of each kind of finding, how much it matters, what is said and what to do.

use serde::{Deserialize, Serialize};
use std::fmt;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth knowing; nothing needs to be done.
    Note,
    /// Views will probably be worse for it.
    Warning,
    /// Training will fail, or learn something else than the scene.
    Error,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// What is said of a kind of finding.
pub(super) struct Text {
    pub name: &'static str,
    /// How much it usually matters.
    pub severity: Severity,
    /// What was found, with `{}` in the place of each number or name.
    pub what: &'static str,
    pub advice: &'static str,
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident = $name:literal, $severity:ident, $what:literal, $advice:literal;)*) => {
        /// What can be wrong with a capture. The names stay the same from version to version.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub enum FindingKind {
            $($(#[$doc])* #[serde(rename = $name)] $kind,)*
        }

        impl FindingKind {
            /// All kinds.
            pub const ALL: &[FindingKind] = &[$(FindingKind::$kind),*];

            pub(super) fn text(self) -> Text {
                let (name, severity, what, advice) = match self {
                    $(FindingKind::$kind => ($name, Severity::$severity, $what, $advice),)*
                };
                Text { name, severity, what, advice }
            }
        }
    };
}

kinds! {
    /// Images that the capture lists do not exist.
    ImagesAbsent = "images-absent", Warning,
        "there is no image of {}; {} are listed",
        "They are left out. If they should be there, look at the paths in the file, and at the ending of their names.";
    /// Images cannot be decoded.
    ImagesUndecodable = "images-undecodable", Error,
        "the images or masks of {} cannot be decoded; the first: {}",
        "Copy these files again, or take them out of the capture; PNG, JPEG and WebP can be read.";
    /// Images are of another shape than their camera.
    ShapeMismatch = "shape-mismatch", Error,
        "the shape of {} is not that of the camera: {}",
        "Images that were cropped or turned after their cameras were measured cannot be used: take the original ones, \
         or measure again.";
    /// Photographs have several resolutions.
    MixedResolutions = "mixed-resolutions", Note,
        "photographs have several resolutions: {}",
        "Nothing needs to be done: each is used at its own.";
    /// A field of view is implausible.
    FieldOfView = "field-of-view", Warning,
        "the field of view of {} is below 10 or above 150 degrees",
        "Check the unit of the focal length (pixels, for the size of the images that the file names; not millimetres) \
         and of `camera_angle_x` (radians).";
    /// Horizontal and vertical focal length differ.
    PixelAspect = "pixel-aspect", Warning,
        "the horizontal focal length of {} is more than 5 % off the vertical one",
        "Cameras have square pixels: if the images were stretched, say so in both focal lengths; otherwise use one \
         for both.";
    /// The principal point is far from the middle of the image.
    PrincipalPoint = "principal-point", Warning,
        "the principal point of {} is more than a tenth of the image from its middle",
        "If the images are smaller than those that the cameras were measured with, scale `cx` and `cy` with them; if \
         they were cropped, this may be right.";
    /// The lens folds the image back, or leaves part of it dark.
    LensFolds = "lens-folds", Warning,
        "the lens of {} puts nothing in a part of the image, or folds it back on itself",
        "The coefficients were found from points nearer to the middle, and do not hold at the border: find them anew \
         with fewer of them (k1 alone), or crop or undistort the images. Pixels that no light reaches are left out.";
    /// The lens bends light strongly.
    StrongDistortion = "strong-distortion", Note,
        "the lens of {} bends light by more than 5 degrees at the border",
        "Nothing needs to be done if the coefficients are right. Straight lines that are curved in rendered views say \
         that they are not.";
    /// Cameras look away from each other.
    LooksAway = "looks-away", Warning,
        "all cameras look away from the middle of where they stand",
        "If they stand around a thing and look at it, the matrices have OpenCV's axes: change the signs of the second \
         and third column. If they stand in the middle of a room and look around, this is right.";
    /// Camera axes are those of OpenCV and not of OpenGL.
    OpenCvAxes = "opencv-axes", Error,
        "the matrices have OpenCV's camera axes, looking along +z with y down, and are read as OpenGL's",
        "Change the signs of the second and third column of each camera-to-world matrix.";
    /// Matrices lead from the world to the camera and not back.
    WorldToCamera = "world-to-camera", Error,
        "the matrices seem to lead from the world to the camera: inverted, all cameras look at one place",
        "Write the inverse of each matrix: files hold camera-to-world matrices, whose last column is where the camera \
         is.";
    /// The world is seen in a mirror.
    Mirrored = "mirrored", Error,
        "the cameras see the world in a mirror: one axis has the wrong sign",
        "Cameras or positions were taken to left-handed axes. Change the sign of one row of the matrices, and of one \
         column of their rotations to keep them rotations.";
    /// Photographs agree with their cameras under no convention.
    NoAgreement = "no-agreement", Warning,
        "photographs agree with their cameras no better than by chance, under any convention",
        "Are images and poses in one order, and of one capture? Is the focal length right? If photographs have little \
         to recognise, such as walls of one colour, this may mean nothing.";
    /// Cameras and points, or cameras and the format's convention, have different scales.
    Scale = "scale", Warning,
        "cameras are {} times as far apart as the points of the scene are from them",
        "Give positions of cameras and points in one unit: one of them may be in millimetres.";
    /// Coordinates are so large that digits are lost.
    FarFromOrigin = "far-from-origin", Note,
        "the cameras are {} units from the origin and {} from each other",
        "The scene is moved to its own origin here; other programs may lose digits. Move the positions before writing \
         them.";
    /// Photographs were taken with the camera turned about its optical axis.
    Roll = "roll", Note,
        "in {} the camera was turned by more than 30 degrees about its axis",
        "This is right where portrait and landscape are mixed. If not, some images are turned (EXIF) and their poses \
         are not. Up is found from all cameras, and may be off.";
    /// Different photographs have one pose.
    DuplicatePoses = "duplicate-poses", Warning,
        "the pose of {} is exactly that of another",
        "Two photographs are hardly ever taken from the same place: if the images differ, one of the poses is wrong; \
         leave it out.";
    /// One image has several poses.
    DuplicateImages = "duplicate-images", Warning,
        "the image of {} is pixel by pixel that of another",
        "If their poses differ, one of them is wrong; if not, one photograph counts twice. Leave one out.";
    /// Photographs are blurred.
    Blurred = "blurred", Warning,
        "the sharpness of {} is far below that of those beside",
        "Leave them out if others show the same: what is blurred in a photograph becomes blurred in the scene.";
    /// Photographs are brighter or darker than those beside them.
    ExposureJump = "exposure-jump", Warning,
        "the brightness of {} is far from that of those beside",
        "Photograph with a fixed exposure. With photographs as they are, codes for each photograph (`--set \
         field.appearance_embedding_dim=8`) take up what differs.";
    /// Photographs have other colours than those beside them.
    WhiteBalanceJump = "white-balance-jump", Warning,
        "the balance of colours in {} is far from that of those beside",
        "Photograph with a fixed white balance. With photographs as they are, codes for each photograph (`--set \
         field.appearance_embedding_dim=8`) take up what differs.";
    /// A camera is far from all others.
    FarCamera = "far-camera", Warning,
        "the camera of {} was far from all others",
        "Their poses are probably wrong: leave them out. A single far camera makes the scene small in its box.";
    /// No camera looks from a wide range of directions.
    CoverageGap = "coverage-gap", Note,
        "seen from the middle, no camera stands in an angle of {} degrees",
        "New views from there show what no photograph has seen. Nothing is wrong if nobody is to look from there.";
    /// There are few photographs.
    FewPhotographs = "few-photographs", Warning,
        "there {}",
        "Use 50 to 200 photographs, each part of the scene on at least three of them: more from where it has much \
         detail or hides things.";
    /// Photographs show nothing of the scene's box.
    MissesBox = "misses-box", Warning,
        "nothing of the box that is to hold the scene is seen in {}",
        "They look past it: their poses are wrong, or they belong to another scene; leave them out.";
    /// Cameras stand in the box of a scene that ends there.
    CameraInBox = "camera-in-box", Warning,
        "the camera of {} stands in the box that is to hold the scene",
        "A scene that ends at its box is seen from outside. If it is a room, train with `--scene-type unbounded`.";
    /// A photograph that is tested on is trained on too.
    Leak = "leak", Warning,
        "of those held out, {} can be found among those to train on, or taken from the same place",
        "Test on photographs from other places: what is measured on these says nothing of new views.";
    /// Masks hide whole photographs.
    MaskHidesAll = "mask-hides-all", Error,
        "the masks of {} hide all of it",
        "Masks are white where a photograph is used: they may be the wrong way round. Leave these photographs out \
         otherwise.";
    /// Masks hide nothing.
    MaskHidesNothing = "mask-hides-nothing", Note,
        "the masks of {} hide nothing",
        "Nothing needs to be done if there is nothing to hide.";
    /// Photographs have an alpha channel that is opaque throughout.
    OpaqueAlpha = "opaque-alpha", Note,
        "the alpha channel of {} is opaque throughout",
        "They say nothing, and the scene is taken to go on behind. If it does not, save what is transparent as such.";
    /// Single photographs disagree with their cameras.
    WrongPose = "wrong-pose", Warning,
        "{} cannot be matched with their neighbours: what is seen there is not where poses put it",
        "Look at them: their poses are wrong, or they show something that has moved, or hardly anything. Leave them \
         out, or have poses learned with the scene.";
    /// There is nothing to measure a model by.
    NothingHeldOut = "nothing-held-out", Note,
        "no photograph is held out: a model of this capture cannot be measured",
        "Put some photographs, one of eight is usual, in a split to test on.";
    /// All cameras stand in one place.
    OnePlace = "one-place", Error,
        "all cameras stand in one place: no depth can be found",
        "Photographs that are to give depth are taken from different places. If these were, their positions are lost: \
         look at the last column of the matrices.";
    /// All cameras stand on a line.
    OnALine = "on-a-line", Warning,
        "all cameras stand on a line: depth is found along it alone",
        "Take photographs from above and below that line too; edges along it have no depth otherwise.";
}

impl FindingKind {
    /// The name that is written to files and printed, such as `images-absent`.
    pub fn name(self) -> &'static str {
        self.text().name
    }
}

impl fmt::Display for FindingKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
