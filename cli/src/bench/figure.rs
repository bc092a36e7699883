//! What a figure shows.

/// A direction of a panel.
#[derive(Debug, Clone)]
pub struct Axis {
    /// What is shown, with its unit.
    pub label: String,
    /// Whether decades are equally far apart.
    pub log: bool,
}

impl Axis {
    /// Equal steps are equally far apart.
    pub fn linear(label: &str) -> Self {
        Axis { label: label.to_owned(), log: false }
    }

    /// Equal factors are equally far apart; what is not more than 0 is not shown.
    pub fn log(label: &str) -> Self {
        Axis { label: label.to_owned(), log: true }
    }

    /// Where a value lies; equal distances of this are equal distances on paper.
    pub fn place(&self, value: f64) -> f64 {
        if self.log { value.log10() } else { value }
    }
}

/// Points of one kind.
#[derive(Debug, Clone)]
pub struct Series {
    /// As the legend has it; the same name in several panels is the same kind.
    pub name: String,
    /// Number of the colour and of the shape of its marks.
    pub style: usize,
    /// Whether a line joins the points.
    pub line: bool,
    /// Whether marks are hollow: for what is no choice.
    pub hollow: bool,
    /// The points.
    pub points: Vec<[f64; 2]>,
}

impl Series {
    /// Marks joined by a line.
    pub fn line(name: &str, style: usize, points: Vec<[f64; 2]>) -> Self {
        Series { name: name.to_owned(), style, line: true, hollow: false, points }
    }

    /// Marks alone.
    pub fn marks(name: &str, style: usize, points: Vec<[f64; 2]>) -> Self {
        Series { line: false, ..Series::line(name, style, points) }
    }
}

/// One diagram.
#[derive(Debug, Clone)]
pub struct Panel {
    /// What it is about.
    pub title: String,
    /// To the right.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
    /// What it shows.
    pub series: Vec<Series>,
    /// Words beside points.
    pub labels: Vec<([f64; 2], String)>,
}

/// Diagrams that belong together.
#[derive(Debug, Clone)]
pub struct Figure {
    /// The name of its files.
    pub name: String,
    /// The line above it.
    pub title: String,
    /// What to see in it.
    pub caption: String,
    /// Diagrams beside each other.
    pub columns: usize,
    /// Width and height of a diagram in pixels.
    pub panel: [u32; 2],
    /// The diagrams, row by row.
    pub panels: Vec<Panel>,
}
