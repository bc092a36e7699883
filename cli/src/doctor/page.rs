//! The self-contained page of facts, findings, images and cameras.

use std::collections::HashMap;
use std::path::Path;

use base64::prelude::{BASE64_STANDARD, Engine};
use raygrad::nerf::dataset::{Capture, Photo, View};
use raygrad::nerf::doctor::{Finding, Report};
use raygrad::nerf::{Error, Result};

use super::stage::Stage;
use super::table;
use crate::html::{escaped, filled, in_script};
use crate::output::listed;

/// The template of the page.
const PAGE: &str = include_str!("page.html");
/// Most images of a finding, and their longest side in pixels.
const SHOWN: usize = 8;
const SIDE: usize = 180;
/// Most names of a finding.
const NAMES: usize = 60;

/// The text of the page. `mark` identifies the job that wrote it.
pub fn page(capture: &Capture, report: &Report, stage: &Stage, mark: &str) -> Result<String> {
    let rows = table::facts(&report.facts);
    let facts: String =
        rows.iter().map(|(name, value)| format!("<tr><th>{name}</th><td>{}</td></tr>\n", escaped(value))).collect();
    let views: HashMap<&str, &View> = capture.views.iter().rev().map(|view| (view.name.as_str(), view)).collect();
    let mut findings: String = report.findings.iter().map(|finding| section(capture, &views, finding)).collect();
    if findings.is_empty() {
        findings = "<p class=\"good\">No problems found.</p>".to_owned();
    }
    let data = serde_json::to_string(stage).map_err(|e| Error::setting("page", e))?;
    let data = in_script(&data);
    let title = escaped(&report.facts.folder.display().to_string());
    let texts =
        [("title", title), ("facts", facts), ("findings", findings), ("stage", data), ("mark", mark.to_owned())];
    Ok(filled(PAGE, &texts))
}

/// A finding with some of its images.
fn section(capture: &Capture, views: &HashMap<&str, &View>, finding: &Finding) -> String {
    let Finding { kind, severity, what, advice, views: named } = finding;
    let mut text = format!(
        "<section class=\"{severity}\"><h3><span>{severity}</span> {kind}</h3>\n<p>{}.</p><p class=\"advice\">{}</p>\n",
        escaped(&capitalised(what)),
        escaped(advice)
    );
    if !named.is_empty() {
        text += &format!("<p class=\"names\">{}</p>\n", escaped(&listed(named, NAMES)));
    }
    let images = named.iter().filter_map(|name| Some((name, thumbnail(capture, views.get(name.as_str())?)?)));
    let figures = images.take(SHOWN).map(|(name, png)| {
        let name = escaped(name);
        format!(
            "<figure><img alt=\"{name}\" src=\"data:image/png;base64,{png}\"><figcaption>{name}</figcaption></figure>\n"
        )
    });
    text + &figures.collect::<String>() + "</section>\n"
}

/// An image as a small PNG, in the orientation of its camera if it fits; `None` if it cannot be read, which has its own
/// finding.
fn thumbnail(capture: &Capture, view: &View) -> Option<String> {
    let photo =
        capture.photo(view).or_else(|_| Photo::open(view.image.as_deref().unwrap_or(Path::new("")), None)).ok()?;
    Some(BASE64_STANDARD.encode(photo.at_most(SIDE).over([1.0; 3]).to_png()))
}

fn capitalised(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map(|first| first.to_uppercase().chain(letters).collect()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_is_complete_and_offline() {
        let names = ["title", "facts", "findings", "stage", "mark"];
        let page = filled(PAGE, &names.map(|name| (name, format!("<{{{{{name}}}}}>"))));
        assert!(names.iter().all(|name| page.contains(&format!("<{{{{{name}}}}}>"))), "{page}");
        assert_eq!(PAGE.matches("{{").count(), 6, "the title stands twice");
        assert!(!PAGE.contains("http") && !PAGE.contains("src="));
    }
}
