//! Result tables as CSV.

use std::path::Path;

use raygrad::nerf::{Result, write_atomic};

/// A table with column headings.
#[derive(Debug, Clone)]
pub struct Table {
    /// File name without extension.
    pub name: String,
    /// Column headings with units.
    pub columns: Vec<&'static str>,
    /// Cells, row by row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows.
    pub fn new(name: &str, columns: &[&'static str]) -> Self {
        Table { name: name.to_owned(), columns: columns.to_vec(), rows: vec![] }
    }

    /// Adds a row.
    ///
    /// # Panics
    ///
    /// Panics if the number of cells differs from the number of columns.
    pub fn push(&mut self, row: Vec<String>) {
        assert_eq!(row.len(), self.columns.len(), "one cell a column in {}", self.name);
        self.rows.push(row);
    }

    /// Writes `NAME.csv` (RFC 4180) into a folder.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let mut text = line(self.columns.iter().copied());
        self.rows.iter().for_each(|row| text += &line(row.iter().map(String::as_str)));
        write_atomic(folder.join(format!("{}.csv", self.name)), text.as_bytes())
    }
}

fn line<'a>(cells: impl Iterator<Item = &'a str>) -> String {
    let cell = |text: &str| {
        let is_plain = !text.contains([',', '"', '\n']);
        if is_plain { text.to_owned() } else { format!("\"{}\"", text.replace('"', "\"\"")) }
    };
    cells.map(cell).collect::<Vec<_>>().join(",") + "\n"
}

/// A number with four significant digits; empty if it is not finite.
pub fn digits(value: f64) -> String {
    match value.abs() {
        _ if !value.is_finite() => String::new(),
        0.0 => "0".to_owned(),
        size if (1e-2..1e6).contains(&size) => {
            let decimals = (3 - size.log10().floor() as i32).max(0) as usize;
            format!("{value:.decimals$}")
        }
        _ => format!("{value:.3e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_four_are_significant() {
        let texts = [0.0, 1.0, 12.3456, 123456.0, 1.23456e-7, -0.5, f64::NAN].map(digits);
        assert_eq!(texts, ["0", "1.000", "12.35", "123456", "1.235e-7", "-0.5000", ""]);
    }

    #[test]
    fn csv_cell_with_comma_is_quoted() {
        let mut table = Table::new("t", &["a", "b"]);
        table.push(vec!["1,2".into(), "say \"x\"".into()]);
        let folder = tempfile::tempdir().unwrap();
        table.save(folder.path()).unwrap();
        let text = std::fs::read_to_string(folder.path().join("t.csv")).unwrap();
        assert_eq!(text, "a,b\n\"1,2\",\"say \"\"x\"\"\"\n");
    }
}
