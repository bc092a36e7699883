//! Facts and findings as text.

use raygrad::nerf::doctor::{CaptureSubset, Facts, Finding, Range, Report, Resolution, SceneLayout};

use crate::output::listed;

/// Most image names per finding. The page shows more.
const NAMES: usize = 6;
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
    rows.push(("resolution", joined(sizes)));
    rows.extend(facts.focal.map(|focal| ("focal length", format!("{} pixels", range(focal)))));
    rows.extend(facts.field_of_view.map(|view| ("field of view", format!("{} degrees horizontal", range(view)))));
    rows.push(("lens", joined(facts.lenses.iter().take(4).cloned())));
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
        rows.push(("agreement", format!("{agreement:.2} between images, {word} (0 is chance, 1 is perfect)")));
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
