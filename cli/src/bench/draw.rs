//! Figures as SVG and PNG. An embedded font draws the text of the PNG, so that no system font is needed.

use std::path::Path;
use std::sync::Once;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{FontStyle, register_font};
use raygrad::nerf::{Error, Image, Result, write_atomic};

use super::figure::{Axis, Figure, Panel, Series};

/// DejaVu Sans, reduced to ASCII. Its licence is in the same folder.
static FONT: &[u8] = include_bytes!("font/DejaVuSans-ascii.ttf");
static REGISTERED: Once = Once::new();

/// The palette of Okabe and Ito (2008), which is safe for colour blindness. Dark colours come first.
const COLORS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(0, 0, 0),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(130, 130, 130),
];
const GRID: RGBColor = RGBColor(225, 225, 225);
const FRAME: RGBColor = RGBColor(90, 90, 90);
/// Space around a diagram, in pixels: left, right, above, below.
const MARGINS: [i32; 4] = [62, 14, 44, 44];
/// Approximate width of a legend character, in pixels.
const LETTER: i32 = 8;

type Area<B> = DrawingArea<B, Shift>;
type Drawn<B> = std::result::Result<(), DrawingAreaErrorKind<<B as DrawingBackend>::ErrorType>>;

/// Registers the embedded font with plotters as `sans-serif`.
fn register_letters() {
    REGISTERED.call_once(|| {
        // The embedded font is valid: each figure uses it.
        let _ = register_font("sans-serif", FontStyle::Normal, FONT);
    });
}

/// Writes `NAME.svg` and `NAME.png` into a folder and returns the text of the SVG.
pub fn save(figure: &Figure, folder: &Path) -> Result<String> {
    register_letters();
    let size = size(figure);
    let mut svg = String::new();
    let svg_path = folder.join(format!("{}.svg", figure.name));
    draw(figure, &SVGBackend::with_string(&mut svg, size).into_drawing_area())
        .map_err(|e| Error::file(&svg_path, e))?;
    write_atomic(&svg_path, svg.as_bytes())?;
    let png_path = folder.join(format!("{}.png", figure.name));
    let image = bitmap(size, |area| draw(figure, area)).map_err(|e| Error::file(&png_path, e))?;
    image.save_png(&png_path)?;
    Ok(svg)
}

/// Returns the RGB image of this width and height that `draw` draws.
pub fn bitmap<E>(
    size: (u32, u32),
    draw: impl FnOnce(&Area<BitMapBackend<'_>>) -> std::result::Result<(), E>,
) -> std::result::Result<Image, E> {
    register_letters();
    let mut bytes = vec![0; 3 * size.0 as usize * size.1 as usize];
    draw(&BitMapBackend::with_buffer(&mut bytes, size).into_drawing_area())?;
    let mut image = Image::new(size.0 as usize, size.1 as usize, 3);
    image.data.iter_mut().zip(&bytes).for_each(|(value, &byte)| *value = f32::from(byte) / 255.0);
    Ok(image)
}

fn size(figure: &Figure) -> (u32, u32) {
    let columns = figure.columns.min(figure.panels.len()).max(1) as u32;
    let rows = (figure.panels.len() as u32).div_ceil(columns);
    let width = columns * figure.panel[0];
    (width, head(figure, width) + rows * figure.panel[1])
}

/// Height of the title and the legend.
fn head(figure: &Figure, width: u32) -> u32 {
    34 + 20 * legend(figure, width as i32).last().map_or(0, |entry| entry.1 as u32 + 1)
}

/// Legend entries without duplicates: series, row and left end.
fn legend(figure: &Figure, width: i32) -> Vec<(&Series, i32, i32)> {
    let mut out: Vec<(&Series, i32, i32)> = vec![];
    let (mut row, mut left) = (0, 16);
    for series in figure.panels.iter().flat_map(|panel| &panel.series) {
        if series.name.is_empty() || out.iter().any(|entry| entry.0.name == series.name) {
            continue;
        }
        let wide = 34 + LETTER * series.name.len() as i32;
        if left > 16 && left + wide > width {
            (row, left) = (row + 1, 16);
        }
        out.push((series, row, left));
        left += wide;
    }
    out
}

fn draw<B: DrawingBackend>(figure: &Figure, area: &Area<B>) -> Drawn<B> {
    area.fill(&WHITE)?;
    let (width, _) = area.dim_in_pixel();
    write(area, &figure.title, [16, 18], 17, HPos::Left)?;
    for (series, row, left) in legend(figure, width as i32) {
        let y = 42 + 20 * row;
        if series.line {
            area.draw(&PathElement::new(vec![(left, y), (left + 20, y)], color(series.style).stroke_width(2)))?;
        }
        mark(area, series, [left + 10, y])?;
        write(area, &series.name, [left + 25, y], 13, HPos::Left)?;
    }
    let (_, below) = area.split_vertically(head(figure, width));
    let columns = figure.columns.min(figure.panels.len()).max(1);
    let areas = below.split_evenly((figure.panels.len().div_ceil(columns), columns));
    figure.panels.iter().zip(&areas).try_for_each(|(panel, area)| draw_panel(panel, area))?;
    area.present()
}

fn color(style: usize) -> RGBColor {
    COLORS[style % COLORS.len()]
}

fn write<B: DrawingBackend>(area: &Area<B>, text: &str, [x, y]: [i32; 2], size: i32, side: HPos) -> Drawn<B> {
    let style = TextStyle::from(("sans-serif", size).into_font()).color(&BLACK).pos(Pos::new(side, VPos::Center));
    area.draw(&Text::new(text, (x, y), style))
}

/// Draws a marker: a disc, a square, a triangle or a diamond.
fn mark<B: DrawingBackend>(area: &Area<B>, series: &Series, [x, y]: [i32; 2]) -> Drawn<B> {
    let style = color(series.style);
    let style = if series.hollow { style.stroke_width(1) } else { style.filled() };
    // Styles with the same colour have different markers.
    let corners: &[[i32; 2]] = match (series.style + series.style / 4) % 4 {
        0 => return area.draw(&Circle::new((x, y), 4, style)),
        1 => &[[-4, -4], [4, -4], [4, 4], [-4, 4]],
        2 => &[[0, -5], [5, 4], [-5, 4]],
        _ => &[[0, -6], [5, 0], [0, 6], [-5, 0]],
    };
    let mut corners: Vec<(i32, i32)> = corners.iter().map(|[dx, dy]| (x + dx, y + dy)).collect();
    if series.hollow {
        corners.push(corners[0]);
        return area.draw(&PathElement::new(corners, style));
    }
    area.draw(&Polygon::new(corners, style))
}

/// The range and the ticks of an axis, in axis coordinates.
struct Scale {
    low: f64,
    high: f64,
    ticks: Vec<(f64, String)>,
}

impl Scale {
    fn new(axis: &Axis, values: impl Iterator<Item = f64>) -> Self {
        let places = values.map(|value| axis.place(value)).filter(|place| place.is_finite());
        let (low, high) = places.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 1.0) };
        let room = 0.06 * (high - low).max(if axis.log { 0.2 } else { 1e-9 + 0.02 * high.abs() });
        let (low, high) = (low - room, high + room);
        let ticks = if axis.log { log_ticks(low, high) } else { linear_ticks(low, high) };
        Scale { low, high, ticks }
    }

    /// The pixel of an axis coordinate, between `from` and `to`.
    fn pixel(&self, place: f64, [from, to]: [i32; 2]) -> i32 {
        from + ((place - self.low) / (self.high - self.low) * f64::from(to - from)).round() as i32
    }
}

fn log_ticks(low: f64, high: f64) -> Vec<(f64, String)> {
    let decades = high - low;
    let every = (decades / 6.0).ceil().max(1.0) as i32;
    let multiples: &[f64] = if decades < 1.5 { &[1.0, 2.0, 5.0] } else { &[1.0] };
    let exponents = (low.floor() as i32..=high.ceil() as i32).filter(|exponent| exponent % every == 0);
    let ticks = exponents.flat_map(|exponent| {
        multiples.iter().map(move |m| (f64::from(exponent) + m.log10(), m * 10.0_f64.powi(exponent)))
    });
    ticks.filter(|(place, _)| (low..=high).contains(place)).map(|(place, value)| (place, number(value))).collect()
}

fn linear_ticks(low: f64, high: f64) -> Vec<(f64, String)> {
    let rough = (high - low) / 5.0;
    let power = 10.0_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|step| *step >= rough).unwrap_or(rough);
    let digits = (-step.log10().floor()).max(0.0) as usize;
    let first = (low / step).ceil() as i64;
    let ticks = (first..).map(|i| i as f64 * step).take_while(|place| *place <= high);
    ticks.map(|place| (place, format!("{place:.digits$}"))).collect()
}

/// A number as a short text.
fn number(value: f64) -> String {
    if (0.01..1e5).contains(&value) { format!("{}", (value * 1e6).round() / 1e6) } else { format!("{value:.0e}") }
}

fn draw_panel<B: DrawingBackend>(panel: &Panel, area: &Area<B>) -> Drawn<B> {
    let (width, height) = area.dim_in_pixel();
    let [left, right, above, below] = MARGINS;
    let (x_range, y_range) = ([left, width as i32 - right], [height as i32 - below, above]);
    let values = |axis: usize| panel.series.iter().flat_map(move |s| s.points.iter().map(move |p| p[axis]));
    let (x, y) = (Scale::new(&panel.x, values(0)), Scale::new(&panel.y, values(1)));
    let line = |from: [i32; 2], to: [i32; 2], color: RGBColor| {
        area.draw(&PathElement::new(vec![(from[0], from[1]), (to[0], to[1])], color.stroke_width(1)))
    };
    for (place, label) in &x.ticks {
        let at = x.pixel(*place, x_range);
        line([at, y_range[0]], [at, y_range[1]], GRID)?;
        write(area, label, [at, y_range[0] + 12], 12, HPos::Center)?;
    }
    for (place, label) in &y.ticks {
        let at = y.pixel(*place, y_range);
        line([x_range[0], at], [x_range[1], at], GRID)?;
        write(area, label, [x_range[0] - 6, at], 12, HPos::Right)?;
    }
    let corners = [(x_range[0], y_range[1]), (x_range[1], y_range[0])];
    area.draw(&Rectangle::new(corners, FRAME.stroke_width(1)))?;
    write(area, &panel.title, [x_range[0], above - 30], 14, HPos::Left)?;
    write(area, &panel.y.label, [x_range[0], above - 12], 12, HPos::Left)?;
    write(area, &panel.x.label, [(x_range[0] + x_range[1]) / 2, height as i32 - 13], 12, HPos::Center)?;
    let pixel = |point: &[f64; 2]| {
        let places = [panel.x.place(point[0]), panel.y.place(point[1])];
        let is_shown = places.iter().all(|place| place.is_finite());
        is_shown.then(|| [x.pixel(places[0], x_range), y.pixel(places[1], y_range)])
    };
    for series in &panel.series {
        let pixels: Vec<[i32; 2]> = series.points.iter().filter_map(pixel).collect();
        if series.line {
            let path: Vec<(i32, i32)> = pixels.iter().map(|[x, y]| (*x, *y)).collect();
            area.draw(&PathElement::new(path, color(series.style).stroke_width(2)))?;
        }
        pixels.into_iter().try_for_each(|at| mark(area, series, at))?;
    }
    let mut taken: Vec<[i32; 4]> = vec![];
    for (point, label) in &panel.labels {
        if let Some([px, py]) = pixel(point) {
            let wide = LETTER * label.len() as i32;
            let is_right = px + 8 + wide > x_range[1];
            let (at, side, left) =
                if is_right { (px - 8, HPos::Right, px - 8 - wide) } else { (px + 8, HPos::Left, px + 8) };
            // Beside the point, or above or below if another label is there.
            let is_free = |y: &i32| {
                taken.iter().all(|[l, r, top, bottom]| left > *r || left + wide < *l || y - 6 > *bottom || y + 6 < *top)
            };
            let y = [-7, 7, -20, 20, -33, 33].map(|dy| py + dy).into_iter().find(is_free).unwrap_or(py - 7);
            taken.push([left, left + wide, y - 5, y + 5]);
            write(area, label, [at, y], 11, side)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_log_and_linear_are_round() {
        let labels = |ticks: Vec<(f64, String)>| ticks.into_iter().map(|tick| tick.1).collect::<Vec<_>>();
        assert_eq!(labels(linear_ticks(-0.1, 1.05)), ["0.0", "0.5", "1.0"]);
        assert_eq!(labels(linear_ticks(31.0, 47.0)), ["35", "40", "45"]);
        assert_eq!(labels(log_ticks(-3.2, 0.1)), ["1e-3", "0.01", "0.1", "1"]);
        assert_eq!(labels(log_ticks(2.1, 3.1)), ["200", "500", "1000"]);
        assert!(log_ticks(-14.0, 0.0).len() <= 7, "few labels on many decades");
    }

    #[test]
    fn font_embedded_is_drawn() {
        let axis = || Axis::log("evaluations");
        let points = vec![[8.0, 1e-2], [64.0, 1e-4], [128.0, 0.0]];
        let series = vec![
            Series::line("midpoint", 1, points.clone()),
            Series { hollow: true, ..Series::marks("left", 0, points) },
        ];
        let labels = vec![([64.0, 1e-4], "here".to_owned())];
        let panel = Panel { title: "slabs".into(), x: axis(), y: Axis::log("error"), series, labels };
        let figure = Figure {
            name: "figure".into(),
            title: "Title".into(),
            caption: String::new(),
            columns: 2,
            panel: [300, 200],
            panels: vec![panel.clone(), panel],
        };
        let folder = tempfile::tempdir().unwrap();
        let svg = save(&figure, folder.path()).unwrap();
        assert!(["Title", "slabs", "midpoint", "here", "1e-4"].iter().all(|text| svg.contains(text)), "{svg}");
        let image = Image::open(folder.path().join("figure.png")).unwrap();
        let (width, height) = size(&figure);
        assert_eq!([image.width, image.height], [width as usize, height as usize]);
        let dark = |x: std::ops::Range<usize>, y: std::ops::Range<usize>| {
            y.flat_map(|y| x.clone().map(move |x| (x, y))).filter(|&(x, y)| image.pixel(x, y)[0] < 0.5).count()
        };
        assert!(dark(16..60, 8..28) > 40, "the title has letters");
    }
}
