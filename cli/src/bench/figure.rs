//! Data of a figure.

/// An axis of a panel.
#[derive(Debug, Clone)]
pub struct Axis {
    /// Label with the unit.
    pub label: String,
    /// True for a logarithmic scale.
    pub log: bool,
}

impl Axis {
    /// A linear scale.
    pub fn linear(label: &str) -> Self {
        Axis { label: label.to_owned(), log: false }
    }

    /// A logarithmic scale. It omits values that are not positive.
    pub fn log(label: &str) -> Self {
        Axis { label: label.to_owned(), log: true }
    }

    /// The axis coordinate of a value: the value itself, or its logarithm.
    pub fn place(&self, value: f64) -> f64 {
        if self.log { value.log10() } else { value }
    }
}

/// Points with one style.
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend. Series of the same name share one entry.
    pub name: String,
    /// Index of the colour and of the marker.
    pub style: usize,
    /// True to join the points by a line.
    pub line: bool,
    /// True for hollow markers, which show settings that another one dominates.
    pub hollow: bool,
    /// The points.
    pub points: Vec<[f64; 2]>,
}

impl Series {
    /// Markers joined by a line.
    pub fn line(name: &str, style: usize, points: Vec<[f64; 2]>) -> Self {
        Series { name: name.to_owned(), style, line: true, hollow: false, points }
    }

    /// Markers alone.
    pub fn marks(name: &str, style: usize, points: Vec<[f64; 2]>) -> Self {
        Series { line: false, ..Series::line(name, style, points) }
    }
}

/// One plot of a figure.
#[derive(Debug, Clone)]
pub struct Panel {
    /// Title of the panel.
    pub title: String,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Series of the panel.
    pub series: Vec<Series>,
    /// Text beside points.
    pub labels: Vec<([f64; 2], String)>,
}

/// Related panels in one image.
#[derive(Debug, Clone)]
pub struct Figure {
    /// File name without extension.
    pub name: String,
    /// Title above the panels.
    pub title: String,
    /// Caption on the page.
    pub caption: String,
    /// Number of panels in a row.
    pub columns: usize,
    /// Width and height of a panel in pixels.
    pub panel: [u32; 2],
    /// The panels, row by row.
    pub panels: Vec<Panel>,
}
