//! `raygrad doctor`: checks a capture and explains its problems.

mod drawing;
mod page;
mod stage;
mod table;

use std::path::PathBuf;
use std::process::ExitCode;

use raygrad::nerf::doctor::{DoctorOptions, Finding, FindingKind, Report, Severity, examine, examine_cameras};
use raygrad::nerf::{Error, Result, write_atomic};

use super::output::{complain, make_folder, print, quoted};
use super::overwrite::{Job, png_with_text};
use super::parse;
use super::progress::Progress;
use super::scene::{CaptureArgs, Opened, Scene};
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
    #[command(flatten)]
    pub capture: CaptureArgs,
    /// Most images to compare with their neighbours
    ///
    /// Each of these, evenly spaced, shows whether its own pose is right. All images are read in any case. By default
    /// they are 120.
    #[arg(long, help_heading = "Computation", value_name = "N", value_parser = parse::count(1 << 20))]
    pub compare: Option<usize>,
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
    let capture = args.capture.read(folder)?;
    let analysis = args.capture.analyze(&capture);
    make_folder(&args.out)?;
    let progress = Progress::new();
    let show = |done: usize, total: usize| progress.count(done, total, "images checked");
    let usual = DoctorOptions::default();
    let report = examine(
        &capture,
        analysis.as_ref(),
        &DoctorOptions { compared: args.compare.unwrap_or(usual.compared), progress: &show },
    );
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

/// Warns of problems with the cameras of a training scene, one line each. `args` are those that it was read with.
pub fn warn(scene: &Opened, args: &CaptureArgs) {
    let Some((capture, analysis)) = &scene.capture else { return };
    let Report { findings, .. } = examine_cameras(capture, Ok(analysis));
    // Loading warns of absent images itself.
    let said = |finding: &Finding| finding.kind == FindingKind::ImagesAbsent;
    for Finding { kind, severity, what, .. } in findings.iter().filter(|finding| !said(finding)) {
        if *severity > Severity::Note {
            let folder = quoted(&capture.folder);
            let flags = args.flags();
            complain(&format!("{severity}: {kind}: {what}; `raygrad doctor {folder}{flags}` shows details"));
        }
    }
}
