//! Facts and findings as text.

use raygrad::nerf::doctor::{CaptureSubset, Facts, Finding, Range, Report, Resolution, SceneLayout};

use crate::output::listed;

/// Most image names per finding. The page shows more.
const NAMES: usize = 6;
/// Most resolutions and lenses.
const LISTED: usize = 8;
/// Columns of a line of advice.
const WIDTH: usize = 96;

/// Names and values of the facts.
pub fn facts(facts: &Facts) -> Vec<(&'static str, String)> {
    let mut rows = vec![("format", facts.format.clone())];
    let parts = facts.subsets.iter().map(|CaptureSubset { split, present, absent }| match absent {
        0 => format!("{present} {split}"),
        _ => format!("{present} of {} {split}", present + absent),
    });
    rows.push(("images", joined(parts)));
    let sizes = facts.resolutions.iter().map(|Resolution { width, height, images }| {
        if facts.resolutions.len() == 1 { format!("{width}x{height}") } else { format!("{width}x{height} ({images})") }
    });
    rows.push(("resolution", some(sizes.collect())));
    rows.extend(facts.focal.map(|focal| ("focal length", format!("{} pixels", range(focal)))));
    rows.extend(facts.field_of_view.map(|view| ("field of view", format!("{} degrees horizontal", range(view)))));
    rows.push(("lens", some(facts.lenses.clone())));
    if facts.points > 0 {
        rows.push(("points", facts.points.to_string()));
    }
    if let Some(SceneLayout { scene_type, reason, near, far, bounds: [low, high], scale, up, middle }) = &facts.layout {
        rows.push(("scene type", format!("{scene_type}: {reason}")));
        rows.push(("near to far", format!("{near:.3} to {far:.3} scene units")));
        rows.push(("scene box", format!("{low:.2} to {high:.2} scene units")));
        rows.push(("scale", format!("{scale:.4} scene units per capture unit")));
        rows.push(("up axis", format!("{up:.3} in capture coordinates")));
        rows.push(("centre", format!("{middle:.3} in capture coordinates")));
    }
    if let Some(agreement) = facts.agreement {
        let word = if agreement < 0.1 {
            "poor"
        } else if agreement < 0.25 {
            "fair"
        } else {
            "good"
        };
        let all: usize = facts.subsets.iter().map(|part| part.present).sum();
        let of = if facts.compared < all {
            format!(" of {} of {all} images with neighbours", facts.compared)
        } else {
            " between images".to_owned()
        };
        rows.push(("agreement", format!("{agreement:.2}{of}, {word} (0 is chance, 1 is perfect)")));
    } else if facts.compared == 0 {
        rows.push(("agreement", "not measured: no images with a view to compare".to_owned()));
    } else {
        rows.push(("agreement", "not measured: too few patches match".to_owned()));
    }
    rows
}

/// The report for a terminal.
pub fn text(report: &Report) -> String {
    let rows = facts(&report.facts);
    let width = rows.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let mut text = format!("{}\n", report.facts.folder.display());
    rows.iter().for_each(|(name, value)| text += &format!("  {name:width$}  {value}\n"));
    if report.findings.is_empty() {
        text += "\nno problems found\n";
    }
    for finding in &report.findings {
        let Finding { kind, severity, what, advice, views } = finding;
        text += &format!("\n{severity}: {kind}: {what}\n");
        if !views.is_empty() {
            text += &format!("  {}\n", listed(views, NAMES));
        }
        text += &wrapped(advice);
    }
    text + "\n"
}

/// The first parts of a list, and how many more there are.
fn some(mut parts: Vec<String>) -> String {
    if parts.len() > LISTED {
        let more = parts.split_off(LISTED).len();
        parts.push(format!("and {more} more"));
    }
    parts.join(", ")
}

fn joined(parts: impl Iterator<Item = String>) -> String {
    parts.collect::<Vec<_>>().join(", ")
}

fn range(Range { least, median, most }: Range) -> String {
    if most - least < 0.005 * median.abs() { format!("{median:.1}") } else { format!("{least:.1} to {most:.1}") }
}

/// Wraps text to [`WIDTH`] columns, with indentation.
fn wrapped(text: &str) -> String {
    let (mut out, mut line) = (String::new(), String::new());
    for word in text.split(' ') {
        if line.len() + word.len() > WIDTH {
            out += &format!("  {}\n", line.trim_end());
            line.clear();
        }
        line += &format!("{word} ");
    }
    out + &format!("  {}\n", line.trim_end())
}
