//! The HTML page of a benchmark.

use std::path::Path;

use raygrad::nerf::{Result, write_atomic};

use super::table::Table;
use crate::html::escaped;
use crate::machine;

/// Results of one suite.
pub struct Section {
    /// Heading of the section.
    pub title: String,
    /// Command that reproduces the results.
    pub command: String,
    /// SVG and caption of each figure.
    pub figures: Vec<(String, String)>,
    /// Tables.
    pub tables: Vec<Table>,
    /// Summary sentences.
    pub findings: Vec<String>,
}

const STYLE: &str = "body{font:15px/1.5 sans-serif;max-width:1250px;margin:2em auto;padding:0 1em;color:#222}\
    svg{max-width:100%;height:auto}figure{margin:1.5em 0}figcaption{color:#444;max-width:60em}\
    table{border-collapse:collapse;font-size:13px}td,th{padding:.15em .7em;text-align:right;border-bottom:1px solid #ddd}\
    td:first-child,th:first-child{text-align:left}code{background:#f2f2f2;padding:.1em .3em}details{margin:1em 0}";

/// Writes the page, which is self-contained. `mark` identifies the job that wrote it.
pub fn save(path: &Path, sections: &[Section], quick: bool, mark: &str) -> Result<()> {
    let mut page = String::from("<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">");
    page += &format!("<meta name=\"generator\" content=\"{mark}\">");
    page += &format!("<title>raygrad bench</title><style>{STYLE}</style></head><body>\n<h1>raygrad bench</h1>\n");
    if quick {
        page += "<p>A quick run: fewer and smaller measurements.</p>\n";
    }
    for section in sections {
        page += &format!("<h2>{}</h2>\n<p><code>{}</code></p>\n", escaped(&section.title), escaped(&section.command));
        for (svg, caption) in &section.figures {
            page += &format!("<figure>{svg}<figcaption>{}</figcaption></figure>\n", escaped(caption));
        }
        if !section.findings.is_empty() {
            let items: String = section.findings.iter().map(|text| format!("<li>{}</li>", escaped(text))).collect();
            page += &format!("<ul>{items}</ul>\n");
        }
        for table in &section.tables {
            let summary = format!("<details><summary>{}.csv</summary>", escaped(&table.name));
            page += &format!("{summary}{}</details>\n", table_html(&table.columns, &table.rows));
        }
    }
    let rows: Vec<Vec<String>> = machine::describe().into_iter().map(Vec::from).collect();
    page += &format!("<details><summary>Machine</summary>{}</details>\n", table_html(&["machine", ""], &rows));
    page += "</body></html>\n";
    write_atomic(path, page.as_bytes())
}

fn table_html(columns: &[&str], rows: &[Vec<String>]) -> String {
    let head = row_html("th", columns.iter().copied());
    let body: String = rows.iter().map(|cells| row_html("td", cells.iter().map(String::as_str))).collect();
    format!("<table>{head}{body}</table>\n")
}

fn row_html<'a>(tag: &str, cells: impl Iterator<Item = &'a str>) -> String {
    let cells: String = cells.map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell))).collect();
    format!("<tr>{cells}</tr>\n")
}
