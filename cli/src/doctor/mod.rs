//! `raygrad doctor`: whether a capture is good, and if not, what is wrong with it.

mod drawing;
mod page;
mod stage;
mod table;

use std::path::PathBuf;
use std::process::ExitCode;

use raygrad::nerf::dataset::{Capture, Scope};
use raygrad::nerf::doctor::{Finding, FindingKind, Options, Report, Severity, examine, examine_cameras};
use raygrad::nerf::{Error, Result, write_atomic};

use super::output::{complain, make_folder, print};
use super::overwrite::{Job, png_with_text};
use super::progress::Progress;
use super::scene::{Opened, Scene};
use serde_json::Value;
use stage::Stage;

/// Examine a capture before training on it: what is wrong, and what to do
///
/// Prints facts and findings, and writes DIR/cameras.png and DIR/doctor.html, a page of its own with the same, the photographs in
/// question and the cameras to turn around. Exit code: 0 nothing above a note, 3 warnings, 4 errors in the capture; 1 if it cannot be
/// read at all.
#[derive(clap::Args)]
pub struct Args {
    /// Folder of photographs with poses, in any format that can be trained on
    pub scene: Scene,
    /// How far the scene goes: bounded, unbounded or forward [default: found out from the photographs]
    #[arg(long)]
    pub scope: Option<Scope>,
    /// Folder for the picture and the page, which replace those of an earlier examination
    #[arg(long, value_name = "DIR", default_value = "doctor")]
    pub out: PathBuf,
    /// Replace files of the same names that another command wrote
    #[arg(long)]
    pub overwrite: bool,
    /// Print facts and findings as JSON in place of a table
    #[arg(long)]
    pub json: bool,
}

/// Examines, writes the files and prints the result.
pub fn run(args: &Args) -> Result<ExitCode> {
    let Scene::Folder(folder) = &args.scene else {
        return Err(Error::setting("scene", "the scene that is built in has no files to examine; name a folder"));
    };
    // Its folder has one name for all captures: each examination replaces the last.
    let job = Job::new("doctor", &Value::Null, args.overwrite);
    let files = ["cameras.png", "doctor.html"].map(|name| args.out.join(name));
    files.iter().try_for_each(|file| job.check(file))?;
    let capture = Capture::read(folder)?;
    // A capture that has no size has none: the examination says why.
    let survey = capture.survey(args.scope).ok();
    make_folder(&args.out)?;
    let progress = Progress::new();
    let show = |done: usize, total: usize| progress.count(done, total, "photographs looked at");
    let report = examine(&capture, survey.as_ref(), &Options { progress: &show, ..Options::default() });
    drop(progress);
    let stage = Stage::new(&capture, survey.as_ref(), &report);
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

/// Says in a line each what is wrong with the cameras of a scene that is to be trained on; of absent images, only how many
/// there are of those that nobody reads.
pub fn warn(scene: &Opened) {
    let Some((capture, survey)) = &scene.capture else { return };
    let Report { findings, .. } = examine_cameras(capture, Some(survey));
    // Those that are read have been named.
    let said = |finding: &Finding| finding.kind == FindingKind::ImagesAbsent;
    for Finding { kind, severity, what, .. } in findings.iter().filter(|finding| !said(finding)) {
        if *severity > Severity::Note {
            let folder = capture.folder.display();
            complain(&format!("{severity}: {kind}: {what}; `raygrad doctor {folder}` says more"));
        }
    }
}
