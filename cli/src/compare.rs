//! `raygrad compare`: a table of the results of several runs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result};
use serde_json::Value;

use super::output::{checksum, complain, entries, print};
use super::parse::read_text;
use super::run::Run;

/// Conditions that must be equal for comparable results.
const SAME: [&str; 14] = [
    "scene",
    "split",
    "hold_out",
    "views",
    "width",
    "height",
    "downscale",
    "mask_as_alpha",
    "background",
    "cameras",
    "appearance",
    "pixel_offset",
    "quantisation",
    "images",
];
/// Measured fields. All other fields are conditions.
const MEASURED: [&str; 7] = [
    "psnr_mean",
    "ssim_mean",
    "lpips_mean",
    "seconds_per_view",
    "density_per_pixel",
    "color_per_pixel",
    "unskipped_per_pixel",
];
/// Compare the results of several runs
///
/// Prints one row per result of `raygrad eval`, and below the table what all have in common. Warns where results
/// are not comparable: other images, sizes, backgrounds or cameras.
///
/// Example: raygrad compare run run-2 --only eval-test-fast
#[derive(clap::Args)]
pub struct Args {
    /// Run folders, made by `raygrad train`
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Only this result, such as eval-test-fast
    #[arg(long, help_heading = "Output", value_name = "NAME")]
    only: Option<String>,
}

/// A result of a run.
struct Row {
    run: String,
    name: String,
    /// Measured values and conditions.
    fields: BTreeMap<String, String>,
}

/// Prints the table.
pub fn run(args: &Args) -> Result<()> {
    let mut rows = vec![];
    for run in &args.runs {
        let opened = Run::open(run)?;
        let found = results(&opened.folder, args.only.as_deref())?;
        // The model file may be absent; results are not checked against it then.
        let model = checksum(&opened.model_file()).ok();
        if found.is_empty() {
            let what = match &args.only {
                Some(name) => format!("has no result `{name}.json`: run `raygrad eval` first"),
                None => "has no eval results: run `raygrad eval` first".to_owned(),
            };
            return Err(Error::file(run, what));
        }
        for path in found {
            let fields = read(&path)?;
            if let (Some(now), Some(then)) = (&model, fields.get("model.crc32"))
                && now != then
            {
                complain(&format!(
                    "warning: {}: the model was trained further after this result: run `raygrad eval` again",
                    path.display()
                ));
            }
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            rows.push(Row { run: run.display().to_string(), name, fields });
        }
    }
    print(&table(&rows))
}

/// The result files in a run's folder, sorted by name.
fn results(folder: &Path, only: Option<&str>) -> Result<Vec<PathBuf>> {
    let is_result = |path: &PathBuf| {
        let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        path.extension().is_some_and(|e| e == "json")
            && (stem == "eval" || stem.starts_with("eval-"))
            && only.is_none_or(|only| stem == only)
    };
    Ok(entries(folder)?.into_iter().filter(is_result).collect())
}

/// The fields of a result under dotted names. The views are replaced by their names.
pub fn read(path: &Path) -> Result<BTreeMap<String, String>> {
    let bad = |what: String| Error::file(path, what);
    let text = read_text(path, "an eval result")?;
    let value: Value = serde_json::from_str(&text).map_err(|e| bad(format!("not an eval result: {e}")))?;
    let Value::Object(all) = value else { return Err(bad("not an eval result: it is not a JSON object".into())) };
    if !all.contains_key("psnr_mean") {
        return Err(bad("not an eval result: it has no `psnr_mean`".into()));
    }
    let mut fields = BTreeMap::new();
    for (name, value) in all {
        match (name.as_str(), value) {
            ("per_view", Value::Array(views)) => {
                let names: Vec<String> = views.iter().map(|view| shown(&view["name"])).collect();
                fields.insert("images".to_owned(), names.join(", "));
            }
            (_, value) => flatten(name, value, &mut fields),
        }
    }
    Ok(fields)
}

/// Bytes of a dotted name from which its value is shown as a whole. Otherwise long names of many nested values would take
/// the square of the file's memory.
const LONG: usize = 200;

/// Adds a value under its name, and nested values under dotted names.
fn flatten(name: String, value: Value, fields: &mut BTreeMap<String, String>) {
    match value {
        Value::Object(inner) if name.len() < LONG => {
            inner.into_iter().for_each(|(key, value)| flatten(format!("{name}.{key}"), value, fields))
        }
        value => drop(fields.insert(name, shown(&value))),
    }
}

/// A value for display: strings without quotes.
fn shown(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// The rows with a column for each differing condition, and the common conditions below.
fn table(rows: &[Row]) -> String {
    let mut conditions: Vec<&str> = rows.iter().flat_map(|row| row.fields.keys().map(String::as_str)).collect();
    conditions.sort_unstable();
    conditions.dedup();
    conditions.retain(|name| !MEASURED.contains(name));
    let value = |row: &Row, name: &str| row.fields.get(name).cloned().unwrap_or("-".to_owned());
    let (common, differing): (Vec<&str>, Vec<&str>) =
        conditions.into_iter().partition(|name| rows.iter().all(|row| value(row, name) == value(&rows[0], name)));
    let (other, shown): (Vec<&str>, Vec<&str>) = differing.into_iter().partition(|name| SAME.contains(name));
    let measured = |row: &Row, name: &str, digits: usize| {
        let number = row.fields.get(name).and_then(|text| text.parse::<f64>().ok());
        number.map_or("-".to_owned(), |number| format!("{number:.digits$}"))
    };
    let weights: Vec<&String> = rows.iter().filter_map(|row| row.fields.get("lpips_crc32")).collect();
    let figures = [("PSNR", "psnr_mean", 2), ("SSIM", "ssim_mean", 4), ("LPIPS", "lpips_mean", 4)];
    // Without LPIPS results, the column is omitted.
    let figures = figures.into_iter().filter(|(head, ..)| *head != "LPIPS" || !weights.is_empty());
    let figures: Vec<_> = figures.chain([("s/view", "seconds_per_view", 3)]).collect();
    let heads =
        ["run", "result"].into_iter().chain(figures.iter().map(|(head, ..)| *head)).chain(shown.iter().copied());
    let mut cells: Vec<Vec<String>> = vec![heads.map(str::to_owned).collect()];
    for row in rows {
        let figures = figures.iter().map(|(_, name, digits)| measured(row, name, *digits));
        let shown = shown.iter().map(|name| value(row, name));
        cells.push([row.run.clone(), row.name.clone()].into_iter().chain(figures).chain(shown).collect());
    }
    let widths: Vec<usize> =
        (0..cells[0].len()).map(|i| cells.iter().map(|row| row[i].chars().count()).max().unwrap_or(0)).collect();
    let mut text = String::new();
    for row in &cells {
        let padded: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        text += padded.join("  ").trim_end();
        text.push('\n');
    }
    for name in other {
        text += &format!("different {name}, so these results are not comparable:\n");
        for row in rows {
            text += &format!("  {} {}: {}\n", row.run, row.name, value(row, name));
        }
    }
    if weights.iter().any(|crc32| *crc32 != weights[0]) {
        text += "different LPIPS weights (lpips_crc32), so the LPIPS values are not comparable\n";
    }
    let width = common.iter().map(|name| name.len()).max().unwrap_or(0);
    let common = common.iter().map(|name| format!("  {name:width$}  {}\n", value(&rows[0], name)));
    text + "same for all:\n" + &common.collect::<String>()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(run: &str, fields: &[(&str, &str)]) -> Row {
        let fields = fields.iter().map(|(name, value)| (name.to_string(), value.to_string())).collect();
        Row { run: run.to_owned(), name: "eval-test".to_owned(), fields }
    }

    #[test]
    fn compare_shows_differences_as_columns() {
        let one = [("psnr_mean", "31.126"), ("split", "test"), ("model.seed", "0"), ("views", "8")];
        let other = [("psnr_mean", "NaN"), ("split", "test"), ("model.seed", "7"), ("views", "80"), ("threads", "2")];
        let text = table(&[row("first", &one), row("b", &other)]);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "run    result     PSNR   SSIM  s/view  model.seed  threads");
        assert_eq!(lines[1], "first  eval-test  31.13  -     -       0           -");
        assert_eq!(lines[2], "b      eval-test  NaN    -     -       7           2");
        assert_eq!(lines[3], "different views, so these results are not comparable:");
        assert_eq!(lines[4..], ["  first eval-test: 8", "  b eval-test: 80", "same for all:", "  split  test"]);
    }

    #[test]
    fn compare_shows_lpips_and_warns_of_other_weights() {
        let plain = [("psnr_mean", "31.126"), ("ssim_mean", "0.9")];
        let with = |crc32: &'static str, backbone: &'static str| {
            [("lpips_mean", "0.05678"), ("lpips_crc32", crc32), ("lpips_backbone", backbone)]
        };
        let text = table(&[row("a", &plain), row("b", &[&plain[..], &with("0a", "vgg")].concat())]);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "run  result     PSNR   SSIM    LPIPS   s/view  lpips_backbone  lpips_crc32");
        assert_eq!(lines[1], "a    eval-test  31.13  0.9000  -       -       -               -");
        assert_eq!(lines[2], "b    eval-test  31.13  0.9000  0.0568  -       vgg             0a");
        assert_eq!(lines[3..], ["same for all:"]);
        let text = table(&[row("a", &with("0b", "vgg")), row("b", &plain), row("c", &with("0a", "vgg"))]);
        assert!(text.contains("\ndifferent LPIPS weights (lpips_crc32)"), "{text}");
        let text = table(&[row("a", &with("0a", "vgg")), row("b", &with("0a", "vgg"))]);
        assert!(
            !text.contains("different")
                && text.ends_with("\nsame for all:\n  lpips_backbone  vgg\n  lpips_crc32     0a\n"),
            "{text}"
        );
    }

    #[test]
    fn read_invalid_result_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("eval-test.json");
        for (text, expected) in [
            ("[1]", "not an eval result: it is not a JSON object"),
            ("{}", "`psnr_mean`"),
            ("{\"psnr", "not an eval result"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = read(&path).unwrap_err().to_string();
            assert!(error.contains("eval-test.json") && error.contains(expected), "{error}");
        }
        std::fs::File::create(&path).unwrap().set_len(300 << 20).unwrap();
        let expected = format!("{}: not an eval result (300 MiB; the limit is 256 MiB)", path.display());
        assert_eq!(read(&path).unwrap_err().to_string(), expected);
        let text = r#"{"psnr_mean":3.5,"model":{"seed":4,"budget":{"steps":9}},"per_view":[{"name":"b","psnr":1},{"name":"a"}],"scene":"x"}"#;
        std::fs::write(&path, text).unwrap();
        let expected = [
            ("model.seed", "4"),
            ("model.budget.steps", "9"),
            ("images", "b, a"),
            ("psnr_mean", "3.5"),
            ("scene", "x"),
        ];
        let expected: BTreeMap<_, _> = expected.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
        assert_eq!(read(&path).unwrap(), expected);
        for name in ["eval.json", "evaluation.json", "eval-val.json.tmp", "eval-val.json"] {
            std::fs::write(folder.path().join(name), "{}").unwrap();
        }
        let found =
            |only| results(folder.path(), only).unwrap().into_iter().map(|path| path.file_name().unwrap().to_owned());
        assert!(found(None).eq(["eval-test.json", "eval-val.json", "eval.json"]));
        assert!(found(Some("eval-val")).eq(["eval-val.json"]));
    }
}
