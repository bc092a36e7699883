//! `raygrad doctor`: checks a capture and explains its problems.

mod drawing;
mod page;
mod stage;
mod table;

use std::path::PathBuf;
use std::process::ExitCode;

use raygrad::nerf::dataset::{Capture, SceneType};
use raygrad::nerf::doctor::{DoctorOptions, Finding, FindingKind, Report, Severity, examine, examine_cameras};
use raygrad::nerf::{Error, Result, write_atomic};

use super::output::{complain, make_folder, print, quoted};
use super::overwrite::{Job, png_with_text};
use super::parse;
use super::progress::Progress;
use super::scene::{Opened, Scene};
use serde_json::Value;
use stage::Stage;

/// Check a capture before training
///
/// Prints facts and findings with advice, draws the cameras to DIR/cameras.png and writes one page,
/// DIR/doctor.html. The exit code is 0 if there is nothing above a note, 3 for warnings, 4 for errors, and 1 if the
/// capture cannot be read.
///
/// Example: raygrad doctor my-scene
#[derive(clap::Args)]
pub struct Args {
    /// Capture folder, in any format that train reads
    pub scene: Scene,
    /// bounded, unbounded or forward-facing
    ///
    /// By default raygrad infers the type from images and cameras.
    #[arg(long, help_heading = "Scene", value_name = "TYPE", value_parser = parse::word::<SceneType>)]
    pub scene_type: Option<SceneType>,
    /// Folder for cameras.png and doctor.html
    ///
    /// They replace those of an earlier check.
    #[arg(long, help_heading = "Output", value_name = "DIR", default_value = "doctor")]
    pub out: PathBuf,
    /// Replace files that another command wrote
    #[arg(long, help_heading = "Output")]
    pub overwrite: bool,
    /// Print the report as JSON
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

/// Checks the capture, writes the files and prints the report.
pub fn run(args: &Args) -> Result<ExitCode> {
    let Scene::Folder(folder) = &args.scene else {
        return Err(Error::setting("scene", "built-in scenes have no files to check: name a folder"));
    };
    // The job has no arguments, so that each check may replace the files of the last one.
    let job = Job::new("doctor", &Value::Null, args.overwrite);
    let files = ["cameras.png", "doctor.html"].map(|name| args.out.join(name));
    files.iter().try_for_each(|file| job.check(file))?;
    let capture = Capture::read(folder)?;
    let analysis = capture.analyze_scene(args.scene_type);
    make_folder(&args.out)?;
    let progress = Progress::new();
    let show = |done: usize, total: usize| progress.count(done, total, "images checked");
    let report = examine(&capture, analysis.as_ref(), &DoctorOptions { progress: &show, ..DoctorOptions::default() });
    drop(progress);
    let stage = Stage::new(&capture, analysis.as_ref().ok(), &report);
    let drawn = drawing::draw(&stage).map_err(|e| Error::file(&files[0], e))?;
    let page = page::page(&capture, &report, &stage, job.mark())?;
    files.iter().try_for_each(|file| job.check(file))?;
    write_atomic(&files[0], &png_with_text(&drawn.to_png(), job.mark()))?;
    write_atomic(&files[1], page.as_bytes())?;
    if args.json {
        let text = serde_json::to_string_pretty(&report).map_err(|e| Error::setting("json", e))?;
        print(&format!("{text}\n"))?;
    } else {
        let [picture, page] = files.map(|file| file.display().to_string());
        print(&format!("{}written: {picture}, {page}\n", table::text(&report)))?;
    }
    Ok(match report.severity() {
        None | Some(Severity::Note) => ExitCode::SUCCESS,
        Some(Severity::Warning) => 3.into(),
        Some(Severity::Error) => 4.into(),
    })
}

/// Warns of problems with the cameras of a training scene, one line each.
pub fn warn(scene: &Opened) {
    let Some((capture, analysis)) = &scene.capture else { return };
    let Report { findings, .. } = examine_cameras(capture, Ok(analysis));
    // Loading warns of absent images itself.
    let said = |finding: &Finding| finding.kind == FindingKind::ImagesAbsent;
    for Finding { kind, severity, what, .. } in findings.iter().filter(|finding| !said(finding)) {
        if *severity > Severity::Note {
            let folder = quoted(&capture.folder);
            complain(&format!("{severity}: {kind}: {what}; `raygrad doctor {folder}` shows details"));
        }
    }
}
