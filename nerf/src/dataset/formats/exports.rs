//! Files of other programs, which are no capture yet.

use super::colmap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// A program's file, as the end of a sentence, and the remedy.
type Export = (&'static str, &'static str);

/// Files of other programs that are no capture yet: a file or folder, the program, and the remedy.
pub(super) const EXPORTS: [(&str, &str, &str); 31] = [
    ("keyframes", "a raw export of Polycam", "convert it with nerfstudio's `ns-process-data polycam`"),
    ("rgbd", "an export of Record3D", "convert it with nerfstudio's `ns-process-data record3d`"),
    ("EXR_RGBD", "an export of Record3D", "convert it with nerfstudio's `ns-process-data record3d`"),
    ("intrinsics.txt", "a dataset such as NSVF's", "write its poses as transforms_train.json"),
    ("cameras_sphere.npz", "a dataset of DTU", "write its matrices as transforms.json"),
    ("cameras.npz", "a dataset of IDR or VolSDF", "write its matrices as transforms.json"),
    ("meta_data.json", "a dataset of SDFStudio", "write its frames as transforms.json"),
    ("intrinsic/intrinsic_color.txt", "a scene of ScanNet", "write its poses as transforms.json"),
    ("cams/00000000_cam.txt", "a dataset of MVSNet", "write its cameras as transforms.json"),
    ("odometry.csv", "a scan of Stray Scanner", "write its poses as transforms.json"),
    ("cameras.xml", "an export of Agisoft Metashape", "convert it with nerfstudio's `ns-process-data metashape`"),
    ("odm_report", "a project of OpenDroneMap", "convert it with nerfstudio's `ns-process-data odm`"),
    ("reconstruction.json", "a reconstruction of OpenSfM", "convert it with `opensfm export_colmap`"),
    ("sfm_data.json", "a scene of OpenMVG", "convert it with `openMVG_main_openMVG2Colmap`"),
    ("sfm_data.bin", "a scene of OpenMVG", "convert it with `openMVG_main_openMVG2Colmap`"),
    ("cameras.sfm", "a scene of Meshroom", "convert it with `aliceVision_exportColmap`"),
    ("bundle.out", "a reconstruction of Bundler", "write its cameras as transforms.json"),
    ("train/pose", "a dataset of NeRF++", "write its matrices as transforms.json"),
    ("results/frame000000.jpg", "a sequence of Replica", "write its matrices as transforms.json"),
    ("rgb.txt", "a sequence of TUM RGB-D", "write its poses as transforms.json"),
    ("frame_00000.json", "an export of 3D Scanner App", "write its `cameraPoseARFrame` as transforms.json"),
    ("lowres_wide.traj", "a scan of ARKitScenes", "write its trajectory as transforms.json"),
    ("frame_annotations.jgz", "a category of CO3D", "write the viewpoints of a sequence as transforms.json"),
    ("mav0", "a sequence of EuRoC", "write its poses as transforms.json"),
    ("image_2/000000.png", "a sequence of KITTI", "write its poses as transforms.json"),
    ("coordinates.pt", "a dataset of Mega-NeRF, such as Mill 19", "write its metadata as transforms.json"),
    ("camera-paths", "a dataset of Nerfies", "write its cameras as transforms.json"),
    ("frame-000000.pose.txt", "a sequence of 7-Scenes", "write its poses as transforms.json"),
    ("cfg_args", "an output of 3D Gaussian Splatting", "name the capture that its `source_path` names"),
    ("dataparser_transforms.json", "a run of nerfstudio", "name the capture that it was trained on"),
    ("database.db", "a COLMAP project without a model", "run COLMAP's mapper, or `raygrad prepare` on the images"),
];

/// Endings of archives. Those of Record3D are zip files.
const ARCHIVES: [&str; 7] = ["zip", "r3d", "7z", "rar", "tar", "gz", "tgz"];

const METASHAPE: Export = (
    "an export of Agisoft Metashape",
    "export its cameras as XML, and convert them with nerfstudio's `ns-process-data metashape`",
);
const REALITY: Export = (
    "an export of RealityCapture",
    "convert it with nerfstudio's `ns-process-data realitycapture`, or export for COLMAP",
);
const MESHROOM: Export = ("a scene of Meshroom", "convert it with `aliceVision_exportColmap`");
const SPLATS: Export = ("an output of 3D Gaussian Splatting", "name the capture that it was trained on");
const MVSNET: Export = ("a dataset of MVSNet", "write its cameras as transforms.json");

/// A capture under a name that raygrad does not look for.
const UNUSUAL: Export = ("of the form of transforms.json", "name that file");

/// Ends of the names of files of other programs.
const ENDINGS: [(&str, Export); 9] = [
    (".psx", METASHAPE),
    (".nvm", ("a reconstruction of VisualSFM", "write its cameras as transforms.json")),
    (".sfm", MESHROOM),
    ("bundle.rd.out", ("a reconstruction of Bundler", "write its cameras as transforms.json")),
    ("_cam.txt", MVSNET),
    ("shots.geojson", ("a project of OpenDroneMap", "convert it with nerfstudio's `ns-process-data odm`")),
    ("_colmap_sfm.log", ("a trajectory of Tanks and Temples", "write its matrices as transforms.json")),
    ("calibrated_camera_parameters.txt", ("a project of Pix4D", "write its cameras as transforms.json")),
    (".sens", ("a scene of ScanNet", "write its poses as transforms.json")),
];

/// Words that the files with an ending have, all of them; several programs use these endings.
const CONTENTS: [(&str, &[&str], Export); 6] = [
    (
        "xml",
        &["<BlocksExchange"],
        ("an export in BlocksExchange, as of ContextCapture or DJI Terra", "export for COLMAP"),
    ),
    ("xml", &["<document", "<chunk"], METASHAPE),
    ("csv", &["name,x,y,alt"], REALITY),
    ("json", &["\"img_name\"", "\"rotation\""], SPLATS),
    ("json", &["\"views\"", "\"intrinsics\"", "\"version\""], MESHROOM),
    ("json", &["\"frames\"", "\"transform_matrix\""], UNUSUAL),
];

/// Folders whose files are examined besides those of the capture.
const FOLDERS: [&str; 4] = ["cams", "cams_1", "Cameras", "bundle"];
/// The most files of a folder that are examined, and the first bytes of one.
const FILES: usize = 100_000;
const START: u64 = 1 << 16;

/// Returns true for the name of an archive.
pub(super) fn is_archive(path: &Path) -> bool {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
    ARCHIVES.iter().any(|other| other.eq_ignore_ascii_case(ending))
}

fn unread((what, remedy): Export) -> String {
    format!("is {what}, which raygrad does not read: {remedy}")
}

/// What is wrong with a folder that holds the files of another program, or a part of a COLMAP model.
pub(super) fn of_folder(folder: &Path) -> Option<String> {
    if let Some((_, what, remedy)) = EXPORTS.iter().find(|(name, ..)| folder.join(name).exists()) {
        return Some(unread((what, remedy)));
    }
    let named = FOLDERS.map(|name| folder.join(name));
    let found = [folder].into_iter().chain(named.iter().map(PathBuf::as_path)).find_map(|place| {
        let ((what, remedy), file) = files(place).into_iter().find_map(|file| Some((program_of(&file)?, file)))?;
        let inside = file.strip_prefix(folder).unwrap_or(&file).display();
        let unread = if (what, remedy) == UNUSUAL { "" } else { " and which raygrad does not read" };
        Some(format!("holds `{inside}`, which is {what}{unread}: {remedy}"))
    });
    found.or_else(|| ["sparse/0", "sparse", ""].iter().find_map(|place| half_a_model(folder, place)))
}

/// The first folder in a folder that holds the files of another program, and what is wrong with it.
pub(super) fn below(folder: &Path) -> Option<(PathBuf, String)> {
    let mut folders: Vec<PathBuf> =
        std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    folders.sort();
    let found = folders.into_iter().find_map(|inside| Some((of_folder(&inside)?, inside)));
    found.map(|(what, inside)| (inside.strip_prefix(folder).unwrap_or(&inside).to_owned(), what))
}

/// What is wrong with a file of another program.
pub(super) fn of_file(file: &Path) -> Option<String> {
    let name = file.file_name()?.to_str()?;
    let named = EXPORTS.iter().find(|(known, ..)| *known == name).map(|(_, what, remedy)| (*what, *remedy));
    named.or_else(|| program_of(file).filter(|export| *export != UNUSUAL)).map(unread)
}

/// The files in a folder, in the order of their names.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().take(FILES);
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(|path| path.is_file()).collect();
    files.sort();
    files
}

/// The program that wrote a file, by the end of its name or by its first bytes.
fn program_of(file: &Path) -> Option<Export> {
    let name = file.file_name()?.to_str()?.to_lowercase();
    if let Some((_, export)) = ENDINGS.iter().find(|(end, _)| name.ends_with(end)) {
        return Some(*export);
    }
    let (_, ending) = name.rsplit_once('.')?;
    if CONTENTS.iter().all(|(known, ..)| *known != ending) {
        return None;
    }
    let start = start_of(file)?.replace(", ", ",");
    let has_all = |words: &[&str]| words.iter().all(|word| start.contains(word));
    CONTENTS.iter().find(|(known, words, _)| *known == ending && has_all(words)).map(|(.., export)| *export)
}

/// The beginning of a file.
fn start_of(file: &Path) -> Option<String> {
    let mut start = vec![];
    std::fs::File::open(file).ok()?.take(START).read_to_end(&mut start).ok()?;
    Some(String::from_utf8_lossy(&start).into_owned())
}

/// What is wrong with a COLMAP model of which a file is missing. Beside images, a text must begin as COLMAP's.
fn half_a_model(folder: &Path, place: &str) -> Option<String> {
    let [found, missing] = colmap::half_a_model_in(&folder.join(place))?;
    let is_text = found.extension().is_some_and(|ending| ending == "txt");
    if place.is_empty() && is_text && !start_of(&found)?.starts_with("# ") {
        return None;
    }
    let [found, missing] = [&found, &missing].map(|file| file.strip_prefix(folder).unwrap_or(file).display());
    let what = "its other files must have the same encoding, .bin or .txt";
    Some(format!("has a COLMAP model with `{found}` and no `{missing}`: {what}"))
}

#[cfg(test)]
mod tests;
