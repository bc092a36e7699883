//! Drawing of the cameras from above and from the side.

use glam::DVec3;
use plotters::coord::Shift;
use plotters::prelude::*;
use raygrad::nerf::Image;

use super::stage::{Pyramid, Stage};
use crate::bench::bitmap;

/// Width and height of each view, and height of the legend above them.
const PANEL: i32 = 760;
const HEAD: i32 = 44;
/// From the palette of Okabe and Ito (2008), which is safe for colour blindness.
const TRAIN: RGBColor = RGBColor(0, 114, 178);
const TEST: RGBColor = RGBColor(230, 159, 0);
const ABSENT: RGBColor = RGBColor(190, 190, 190);
const FLAGGED: RGBColor = RGBColor(200, 30, 30);
const BOX: RGBColor = RGBColor(60, 60, 60);
const FRAME: RGBColor = RGBColor(220, 220, 220);

type Area<'a> = DrawingArea<BitMapBackend<'a>, Shift>;
type Drawn = Result<(), DrawingAreaErrorKind<<BitMapBackend<'static> as DrawingBackend>::ErrorType>>;

/// Draws the cameras; returns the message of an error.
pub fn draw(stage: &Stage) -> Result<Image, String> {
    let size = (2 * PANEL as u32, (PANEL + HEAD) as u32);
    bitmap(size, |area| both(stage, area)).map_err(|e| e.to_string())
}

fn both(stage: &Stage, area: &Area<'_>) -> Drawn {
    area.fill(&WHITE)?;
    type Flat = fn(DVec3) -> [f64; 2];
    let views: [(&str, Flat); 2] = [
        ("from above (x to the right, y up)", |p| [p.x, p.y]),
        ("from the side (x to the right, z up)", |p| [p.x, p.z]),
    ];
    for (i, (title, flat)) in views.into_iter().enumerate() {
        let left = i as i32 * PANEL;
        area.draw(&Text::new(title, (left + 14, HEAD + 10), ("sans-serif", 16).into_font().color(&BOX)))?;
        panel(stage, area, left, flat)?;
        area.draw(&Rectangle::new([(left, HEAD), (left + PANEL - 1, HEAD + PANEL - 1)], FRAME))?;
    }
    legend(stage, area)
}

fn panel(stage: &Stage, area: &Area<'_>, left: i32, flat: fn(DVec3) -> [f64; 2]) -> Drawn {
    let inner = area.clone().shrink((left, HEAD), (PANEL, PANEL));
    let scale = 0.5 * f64::from(PANEL) / stage.reach;
    let place = |point: DVec3| {
        let [x, y] = flat(point - stage.centre);
        let pixel = |v: f64| (0.5 * f64::from(PANEL) + v * scale).round().clamp(-4e3, 4e3) as i32;
        (pixel(x), pixel(-y))
    };
    for (point, [r, g, b]) in stage.points.iter().zip(&stage.colors) {
        inner.draw(&Circle::new(place(*point), 1, RGBColor(*r, *g, *b).mix(0.7).filled()))?;
    }
    let style = BOX.mix(if stage.bounded { 0.9 } else { 0.4 });
    for [a, b] in edges(stage.bounds) {
        inner.draw(&PathElement::new([place(a), place(b)], style))?;
    }
    // The centre of the scene.
    let middle = place(DVec3::ZERO);
    for [across, down] in [[6, 0], [0, 6]] {
        let ends = [(middle.0 - across, middle.1 - down), (middle.0 + across, middle.1 + down)];
        inner.draw(&PathElement::new(ends, BOX))?;
    }
    for camera in &stage.cameras {
        let (color, width) = look(camera);
        let eye = place(camera.eye);
        let corners = camera.corners.map(place);
        let mut around = corners.to_vec();
        around.push(corners[0]);
        inner.draw(&Polygon::new(around.clone(), color.mix(0.12)))?;
        inner.draw(&PathElement::new(around, color.stroke_width(width)))?;
        for corner in corners {
            inner.draw(&PathElement::new([eye, corner], color.mix(0.8).stroke_width(width)))?;
        }
        inner.draw(&Circle::new(eye, 1 + width as i32, color.filled()))?;
    }
    Ok(())
}

/// Colour and line width of a camera.
fn look(camera: &Pyramid) -> (RGBColor, u32) {
    match (camera.flagged, camera.kind) {
        (true, _) => (FLAGGED, 2),
        (_, "absent") => (ABSENT, 1),
        (_, "train") => (TRAIN, 1),
        _ => (TEST, 1),
    }
}

/// The twelve edges of a box.
fn edges([low, high]: [DVec3; 2]) -> impl Iterator<Item = [DVec3; 2]> {
    let corner =
        move |i: usize| DVec3::from([0, 1, 2].map(|axis| if i >> axis & 1 == 1 { high[axis] } else { low[axis] }));
    (0..8).flat_map(move |i| {
        (0..3).filter(move |axis| i >> axis & 1 == 0).map(move |axis| [corner(i), corner(i | 1 << axis)])
    })
}

fn legend(stage: &Stage, area: &Area<'_>) -> Drawn {
    let count = |kind: &str| stage.cameras.iter().filter(|camera| camera.kind == kind).count();
    let flagged = stage.cameras.iter().filter(|camera| camera.flagged).count();
    let entries = [
        (TRAIN, format!("{} training", count("train")), count("train")),
        (TEST, format!("{} held out", count("test")), count("test")),
        (FLAGGED, format!("{flagged} with a finding"), flagged),
        (ABSENT, format!("{} not used", count("absent")), count("absent")),
        (BOX, if stage.bounded { "scene box" } else { "scene box (unbounded scene)" }.to_owned(), 1),
    ];
    let mut x = 16;
    for (color, words, _) in entries.iter().filter(|entry| entry.2 > 0) {
        area.draw(&Rectangle::new([(x, 16), (x + 14, 30)], color.filled()))?;
        area.draw(&Text::new(words.clone(), (x + 22, 14), ("sans-serif", 17).into_font().color(&BOX)))?;
        x += 50 + 9 * words.len() as i32;
    }
    Ok(())
}
