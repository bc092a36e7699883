//! Kinds of findings: name, severity, message and advice of each.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The severity of a finding, least first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Information; nothing to do.
    Note,
    /// Renders will probably be worse.
    Warning,
    /// Training will fail, or learn a wrong scene.
    Error,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// The text of a kind of finding.
pub(super) struct Text {
    pub name: &'static str,
    /// The usual severity.
    pub severity: Severity,
    /// The message, with `{}` for each number or name.
    pub what: &'static str,
    pub advice: &'static str,
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident = $name:literal, $severity:ident, $what:literal, $advice:literal;)*) => {
        /// The kind of a finding: a possible problem of a capture. Names are stable across versions.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub enum FindingKind {
            $($(#[$doc])* #[serde(rename = $name)] $kind,)*
        }

        impl FindingKind {
            /// All kinds, in the order of the declarations.
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
        "missing files: {} of {} listed",
        "Training skips them. If they should exist, correct the paths and file extensions in the capture.";
    /// Images cannot be decoded.
    ImagesUndecodable = "images-undecodable", Error,
        "cannot decode {}; the first: {}",
        "Copy these files again, or remove them from the capture. raygrad reads PNG, JPEG, WebP, TIFF and BMP.";
    /// Training refuses the capture, for a reason that no other finding states.
    Refused = "refused", Error,
        "training refuses the capture: {}",
        "Correct this first. The other findings do not consider the scene type and the scene box.";
    /// Images differ in size from their cameras.
    ShapeMismatch = "shape-mismatch", Error,
        "the size of {} does not match the camera: {}",
        "Use the original images: copies cropped or rotated after calibration do not fit. Otherwise calibrate again.";
    /// Images have several resolutions.
    MixedResolutions = "mixed-resolutions", Note,
        "the images have several resolutions: {}",
        "Nothing to do: raygrad uses each image at its own resolution.";
    /// A field of view is implausible.
    FieldOfView = "field-of-view", Warning,
        "the field of view of {} is below 10 or above 150 degrees (230 with a fisheye lens)",
        "Check the units: focal lengths are in pixels of the listed image, not millimetres; `camera_angle_x` is in \
         radians.";
    /// Single focal lengths are far from the others.
    FocalLength = "focal-length", Note,
        "the focal length of {} is far from that of the other images of the same size",
        "Nothing to do for images of another zoom or lens. Otherwise the focal length is wrong: calibrate these images \
         with the others, or remove them.";
    /// Focal lengths are far from those of the EXIF data.
    ExifFocalLength = "exif-focal-length", Warning,
        "the focal length of {} is far from that of the EXIF data: {}",
        "A focal length is in pixels of the listed image; if the image was scaled after calibration, scale it too. \
         `camera_angle_x` is the whole horizontal angle. If COLMAP found this focal length, reconstruct with that of \
         the EXIF data. If images were cropped or upscaled, this may be right.";
    /// Horizontal and vertical focal lengths differ.
    PixelAspect = "pixel-aspect", Warning,
        "the horizontal and vertical focal lengths of {} differ by more than 5 %",
        "Cameras have square pixels. If the images were stretched, scale both focal lengths with them; otherwise use \
         one for both.";
    /// The principal point is far from the centre of the image.
    PrincipalPoint = "principal-point", Warning,
        "the principal point of {} is more than 10 % of the image off centre",
        "If the images were scaled down after calibration, scale `cx` and `cy` too. For cropped images this can be \
         right.";
    /// The lens model folds the image over, or leaves part of it dark.
    LensFolds = "lens-folds", Warning,
        "the lens of {} folds the image over, or maps no light to part of it",
        "The distortion coefficients do not hold at the border. Calibrate again with fewer (`k1` alone), or crop or \
         undistort the images. Training skips pixels without light.";
    /// The lens bends light strongly.
    StrongDistortion = "strong-distortion", Note,
        "the lens of {} bends light by more than 5 degrees at the border",
        "Nothing to do if the coefficients are right. They are wrong if straight lines are curved in renders.";
    /// Cameras look away from each other.
    LooksAway = "looks-away", Warning,
        "all cameras look away from the centre of their positions",
        "If they surround an object, the matrices use OpenCV's axes: negate the second and third columns. If they \
         stand inside a room, this is right.";
    /// Camera axes are OpenCV's, not OpenGL's.
    OpenCvAxes = "opencv-axes", Error,
        "the matrices use OpenCV's camera axes (+z ahead, y down); OpenGL's are expected",
        "Negate the second and third columns of each camera-to-world matrix.";
    /// Matrices are world-to-camera, not camera-to-world.
    WorldToCamera = "world-to-camera", Error,
        "the matrices seem to be world-to-camera: inverted, all cameras look at one place",
        "Write the inverse of each matrix: camera-to-world, with the camera's position in the last column.";
    /// Cameras are turned about one of their axes.
    TurnedCameras = "turned-cameras", Error,
        "the cameras are turned by 180 degrees against their images",
        "Negate two columns of the rotation of each matrix.";
    /// Poses are left-handed.
    Mirrored = "mirrored", Error,
        "the cameras mirror the world: one axis has the wrong sign",
        "The poses use left-handed axes. Negate one row of each matrix, and one column of each rotation so that it \
         stays a rotation.";
    /// Images and poses were listed in different orders.
    PoseOrder = "pose-order", Error,
        "the poses are {}",
        "Give each image its own pose: list images and poses in one order, without gaps.";
    /// Images match their cameras under no convention.
    NoAgreement = "no-agreement", Warning,
        "the images match their cameras hardly better than chance, under any convention",
        "Check that images and poses have one order, come from one capture and have the right focal length. Images \
         with little texture, such as plain walls, can cause this too.";
    /// Camera positions have another scale than the points, or than the format's convention.
    Scale = "scale", Warning,
        "the cameras' spacing is {} times their distance from the points of the scene",
        "Give camera positions and points in one unit: one of them may be in millimetres.";
    /// Depth files cannot be decoded, or do not fit their cameras.
    DepthsUndecodable = "depths-undecodable", Warning,
        "cannot use the depths of {}; the first: {}",
        "Make these files again, or remove them from the capture. Training with --depth-loss stops at them; without it \
         they are not read.";
    /// Measured depths have another unit than the points.
    DepthUnit = "depth-unit", Warning,
        "measured depths are {} times the distances of the points behind their pixels",
        "Divide `depth_unit_scale_factor` by this number: depths are its multiples, in the unit of the camera positions. \
         Depths that a network guessed from single images have no unit: train without --depth-loss.";
    /// Coordinates are so large that digits are lost.
    FarFromOrigin = "far-from-origin", Note,
        "the cameras are {} units from the origin and {} from each other",
        "raygrad centres the scene, so training is fine. Other programs may lose digits: for them, subtract the mean \
         position first.";
    /// Cameras are rolled about their optical axes.
    Roll = "roll", Note,
        "the camera of {} is rolled by more than 30 degrees",
        "This is right for mixed portrait and landscape images. Otherwise EXIF rotation was applied to images but not \
         to poses. The up direction, found from all cameras, may be wrong.";
    /// Different images have one pose.
    DuplicatePoses = "duplicate-poses", Warning,
        "the pose of {} is exactly that of another image",
        "If the images differ, one of the poses is wrong: remove it.";
    /// One image has several poses.
    DuplicateImages = "duplicate-images", Warning,
        "the pixels of {} are exactly those of another image",
        "Remove one of each pair. If their poses differ, one is wrong; if not, the image counts twice.";
    /// All images are equal.
    IdenticalImages = "identical-images", Error,
        "all {} have the same pixels",
        "Training needs different views. Check how the images were copied, rendered or extracted from a video.";
    /// Images are blurred.
    Blurred = "blurred", Warning,
        "the sharpness of {} is far below that of neighbouring images",
        "Remove them if other images show the same place: training reproduces blur.";
    /// Images are brighter or darker than their neighbours.
    ExposureJump = "exposure-jump", Warning,
        "the brightness of {} is far from that of neighbouring images",
        "Capture with a fixed exposure. For the images as they are, train with `--refine exposure`.";
    /// Images have another colour balance than their neighbours.
    WhiteBalanceJump = "white-balance-jump", Warning,
        "the colour balance of {} is far from that of neighbouring images",
        "Capture with a fixed white balance. For the images as they are, train with `--refine exposure`.";
    /// A camera is far from all others.
    FarCamera = "far-camera", Warning,
        "the camera of {} is far from all others",
        "Remove them: their poses are probably wrong. One far camera makes the scene small in its box.";
    /// No camera stands within a wide angle around the scene.
    CoverageGap = "coverage-gap", Note,
        "no camera covers an angle of {} degrees around the centre",
        "Renders from there show parts that no image shows. Capture that side too if you need it.";
    /// The capture has few images.
    FewImages = "few-images", Warning,
        "the capture has {}",
        "Capture 50 to 200 images that show each part of the scene at least three times. Fine detail and occlusion \
         need more.";
    /// Images show nothing of the scene box.
    MissesBox = "misses-box", Warning,
        "the scene box is outside the view of {}",
        "Remove them: their poses are wrong, or they show another scene.";
    /// Cameras stand inside the box of a bounded scene.
    CameraInBox = "camera-in-box", Warning,
        "the camera of {} is inside the scene box",
        "Cameras stand outside a bounded scene. For a room, train with `--scene-type unbounded`.";
    /// Held-out images are trained on too, or share a pose with training images.
    Leak = "leak", Warning,
        "training sees the content or pose of {} held out",
        "Hold out images from other places: scores on these say nothing about new views.";
    /// Masks have another aspect ratio than their images.
    MaskShape = "mask-shape", Error,
        "the aspect ratio of the mask does not match that of {}: {}",
        "A mask may have any size, but it must show the whole image. Make these masks again.";
    /// Masks cannot be decoded, or do not say which pixels are used.
    MaskUnusable = "mask-unusable", Error,
        "cannot use the mask of {}; the first: {}",
        "Copy damaged masks again. Others must be black where pixels are not used, and white elsewhere.";
    /// Masks hide whole images.
    MaskHidesAll = "mask-hides-all", Warning,
        "the masks of {} hide every pixel",
        "Training skips these images. Masks are white where pixels are used: invert them if they are the wrong way \
         round.";
    /// Masks hide nothing.
    MaskHidesNothing = "mask-hides-nothing", Note,
        "the masks of {} hide no pixel",
        "Nothing to do if nothing should be hidden.";
    /// Images have no alpha channel, unlike most others.
    NoAlpha = "no-alpha", Warning,
        "{} have no alpha channel, unlike most others",
        "Save these with a transparent background as the others are, or training learns their background as part of \
         the scene.";
    /// Images have an alpha channel that is opaque everywhere.
    OpaqueAlpha = "opaque-alpha", Note,
        "the alpha channel of {} is opaque everywhere",
        "Alpha then says nothing about the background. For an object on an empty background, save it with alpha 0.";
    /// Images are transparent within an opaque border.
    HollowAlpha = "hollow-alpha", Warning,
        "the alpha channel of {} is transparent inside an opaque border",
        "Alpha is 0 where the background is empty. If it is 0 on the object, invert it, or the masks of \
         --mask-as-alpha. To hide something that moved, use masks without that flag.";
    /// Colour profiles cannot be read.
    ColorProfile = "color-profile", Note,
        "cannot read the colour profile of {}; colours count as sRGB",
        "Nothing to do if the colours look right. Otherwise convert the images to sRGB. raygrad reads RGB profiles \
         with a matrix and curves.";
    /// Single images do not match their cameras.
    WrongPose = "wrong-pose", Warning,
        "cannot match {} with neighbouring images at the places that the poses predict",
        "Look at them: their poses are wrong, something moved, or they have little texture. Remove them, or train \
         with pose refinement (`--refine poses`).";
    /// No image is held out for evaluation.
    NothingHeldOut = "nothing-held-out", Note,
        "no image is held out, so a model of this capture cannot be evaluated",
        "Move some images (usually one in eight) to a test split.";
    /// All cameras stand in one place.
    OnePlace = "one-place", Error,
        "all cameras stand in one place, so depth cannot be found",
        "Capture from different places. If you did, the positions are lost: check the last column of the matrices.";
    /// All cameras stand on one line.
    OnALine = "on-a-line", Warning,
        "all cameras stand on one line, so edges along it have no depth",
        "Capture from above and below that line too.";
    /// The reader of the capture made an assumption.
    Assumption = "assumption", Note,
        "{}",
        "Nothing to do if this is right. Otherwise correct the files of the capture.";
}

impl FindingKind {
    /// Returns the name in files and output, such as `images-absent`.
    pub fn name(self) -> &'static str {
        self.text().name
    }
}

impl fmt::Display for FindingKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
