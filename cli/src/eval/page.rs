//! The HTML page of a result, with its images in a folder.

use serde_json::Value;

use super::report::{Report, Score, four_digits};
use super::{DIGITS, numbered};
use crate::html::{escaped, filled};

/// The template of the page.
const PAGE: &str = include_str!("page.html");

/// The text of the page: drawn views, worst first, a table of all views, and the collapsed settings.
pub fn page(report: &Report) -> String {
    let order = report.by_psnr();
    let drawn = report.drawn();
    let pictures = order.iter().filter(|i| drawn.contains(i)).map(|&i| {
        let (score, file) = (&report.per_view[i], numbered(i, DIGITS));
        let lpips = score.lpips.map_or(String::new(), |lpips| format!(", LPIPS {lpips:.4}"));
        let figures = format!("PSNR {:.2} dB, SSIM {}{lpips}", score.psnr, four_digits(score.ssim));
        let words = escaped(&format!("{}, {figures}", score.name));
        format!(
            "<figure><a href=\"{file}\"><img alt=\"{words}\" src=\"{file}\"></a><figcaption>{words}</figcaption></figure>\n"
        )
    });
    let row = |score: &Score| {
        let Score { name, psnr, ssim, lpips } = score;
        let lpips = report.lpips.as_ref().map_or(String::new(), |_| format!("<td>{}</td>", four_digits(*lpips)));
        format!("<tr><td>{}</td><td>{psnr:.2}</td><td>{}</td>{lpips}</tr>\n", escaped(name), four_digits(*ssim))
    };
    let views = order.iter().map(|&i| row(&report.per_view[i]));
    let title = format!("{}, {} split: {:.2} dB", report.conditions.scene, report.conditions.split, report.psnr_mean);
    let lpips = report.lpips.as_ref().map_or("", |_| "<th>LPIPS</th>").to_owned();
    let places = [("title", escaped(&title)), ("facts", facts(report)), ("lpips", lpips)];
    filled(
        PAGE,
        &places.into_iter().chain([("pictures", pictures.collect()), ("views", views.collect())]).collect::<Vec<_>>(),
    )
}

/// All fields of the report except for the views, as table rows.
fn facts(report: &Report) -> String {
    // A report always converts to JSON.
    let Ok(Value::Object(all)) = serde_json::to_value(report) else { return String::new() };
    let rows = all.iter().filter(|(name, _)| *name != "per_view").flat_map(|(name, value)| match value {
        Value::Object(inner) if name == "model" => inner.iter().map(|(own, v)| (format!("{name} {own}"), v)).collect(),
        value => vec![(name.clone(), value)],
    });
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let row = |(name, value): (String, &Value)| {
        format!("<tr><th>{}</th><td>{}</td></tr>\n", escaped(&name.replace('_', " ")), escaped(&text(value)))
    };
    rows.map(row).collect()
}
