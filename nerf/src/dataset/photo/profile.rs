//! ICC profiles: conversion of colours to sRGB.

use crate::dataset::color_space::SrgbEncode;
use glam::{DMat3, DVec3, Mat3, Vec3};
use image::ImageDecoder;
use raygrad_autograd::Formula;
use std::sync::LazyLock;

/// The colours of a file.
#[derive(Debug)]
pub(super) enum Profile {
    /// sRGB, up to the rounding of profiles; also without a profile.
    Srgb,
    /// RGB colours with a matrix and three transfer curves.
    Rgb(Box<RgbSpace>),
    /// A damaged profile, or one of another kind: lookup tables, grey or CMYK. Colours count as sRGB.
    Unread,
}

impl Profile {
    /// Reads the profile of a file.
    pub fn of(decoder: &mut impl ImageDecoder) -> Self {
        match decoder.icc_profile() {
            Ok(None) => Profile::Srgb,
            Ok(Some(bytes)) => match RgbSpace::parse(&bytes) {
                Some(space) if space.is_srgb() => Profile::Srgb,
                Some(space) => Profile::Rgb(Box::new(space)),
                None => Profile::Unread,
            },
            Err(_) => Profile::Unread,
        }
    }

    /// Converts the colours of 8-bit pixels to sRGB; colours outside of sRGB are clipped.
    pub fn convert_bytes(&self, values: &mut [u8], channels: usize) {
        if let Profile::Rgb(space) = self {
            space.convert(values, channels, 255, byte);
        }
    }

    /// [`convert_bytes`](Self::convert_bytes) for 16-bit pixels.
    pub fn convert_words(&self, values: &mut [u16], channels: usize) {
        if let Profile::Rgb(space) = self {
            space.convert(values, channels, 65535, |value| value);
        }
    }
}

/// An RGB colour space (ICC.1:2022, 8.3 and F.3).
#[derive(Debug)]
pub(super) struct RgbSpace {
    /// Linear RGB to linear sRGB. White stays white.
    matrix: DMat3,
    curves: [Curve; 3],
}

/// A transfer curve from stored values to linear light, both in 0..=1.
#[derive(Debug, Clone, PartialEq)]
enum Curve {
    /// Values at even steps, at least two.
    Table(Vec<u16>),
    /// `[g, a, b, c, d, e, f]`: `(a x + b)^g + e` from `d`, `c x + f` below.
    Parametric([f64; 7]),
}

/// The most bytes of a profile; those with a matrix have less than 100 KB.
const LONGEST: usize = 1 << 20;
/// The white of the connection space, D50.
const WHITE: DVec3 = DVec3::new(0.9642, 1.0, 0.8249);
/// The columns of sRGB's primaries, adapted to D50, as in the ICC's profile sRGB2014.
const SRGB: DMat3 = DMat3::from_cols(
    DVec3::new(0.436066, 0.222488, 0.013916),
    DVec3::new(0.385147, 0.716873, 0.097076),
    DVec3::new(0.143066, 0.060608, 0.714096),
);
/// The most that sRGB's profiles differ from sRGB: entries of the matrix, and stored values of a curve.
const TOLERANCE: [f64; 2] = [0.003, 2.0 / 255.0];

impl RgbSpace {
    /// Parses a profile; `None` if it has no matrix and curves, or they are not those of a colour space.
    fn parse(profile: &[u8]) -> Option<Self> {
        let is_rgb = profile.get(36..40)? == b"acsp" && profile[16..24] == *b"RGB XYZ ";
        if !is_rgb || profile.len() > LONGEST {
            return None;
        }
        let count = word(profile, 128)? as usize;
        let tags = profile.get(132..)?;
        let tag = |name: &[u8; 4]| {
            let entry = tags.chunks_exact(12).take(count).find(|entry| entry[..4] == *name)?;
            profile.get(word(entry, 4)? as usize..)?.get(..word(entry, 8)? as usize)
        };
        let color = |name: &[u8; 4]| {
            let data = tag(name).filter(|data| data.starts_with(b"XYZ "))?;
            Some(DVec3::new(fixed(data, 8)?, fixed(data, 12)?, fixed(data, 16)?))
        };
        let columns = DMat3::from_cols(color(b"rXYZ")?, color(b"gXYZ")?, color(b"bXYZ")?);
        if !(columns * DVec3::ONE).abs_diff_eq(WHITE, 0.02) {
            return None;
        }
        let matrix = SRGB.inverse() * columns;
        let matrix = DMat3::from_diagonal((matrix * DVec3::ONE).recip()) * matrix;
        let curve = |name: &[u8; 4]| Curve::parse(tag(name)?);
        Some(RgbSpace { matrix, curves: [curve(b"rTRC")?, curve(b"gTRC")?, curve(b"bTRC")?] })
    }

    /// Returns true if this is sRGB, up to [`TOLERANCE`].
    fn is_srgb(&self) -> bool {
        let [entry, value] = TOLERANCE;
        let differs = |x: f64, curve: &Curve| (SrgbEncode.f([curve.at(x)]) - x).abs() > value;
        self.matrix.abs_diff_eq(DMat3::IDENTITY, entry)
            && !(0..=255).any(|i| self.curves.iter().any(|curve| differs(f64::from(i) / 255.0, curve)))
    }

    /// Converts pixels of integers up to `most` in place; `stored` gives them for 16 bits.
    fn convert<S: Copy + Into<usize>>(
        &self,
        values: &mut [S],
        channels: usize,
        most: usize,
        stored: impl Fn(u16) -> S,
    ) {
        let light =
            |curve: &Curve| -> Vec<f32> { (0..=most).map(|i| curve.at(i as f64 / most as f64) as f32).collect() };
        let light = self.curves.each_ref().map(light);
        let (matrix, encoded): (Mat3, &[u16]) = (self.matrix.as_mat3(), &ENCODED);
        for pixel in values.chunks_exact_mut(channels) {
            let [r, g, b] = [0, 1, 2].map(|i| light[i][pixel[i].into()]);
            let srgb = (matrix * Vec3::new(r, g, b)).to_array();
            // The cast clips.
            (0..3).for_each(|i| pixel[i] = stored(encoded[(srgb[i] * 65535.0 + 0.5) as u16 as usize]));
        }
    }
}

impl Curve {
    /// Parses a curve; `None` if it is damaged, falls somewhere or is nearly constant.
    fn parse(data: &[u8]) -> Option<Self> {
        let power = |g| Curve::Parametric([g, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let curve = match data.get(..4)? {
            b"curv" => match word(data, 8)? as usize {
                0 => power(1.0),
                1 => power(f64::from(half(data.get(12..14)?)) / 256.0),
                count => {
                    Curve::Table(data.get(12..)?.get(..count.checked_mul(2)?)?.chunks_exact(2).map(half).collect())
                }
            },
            b"para" => {
                let numbers: Vec<f64> = (0..7).map_while(|i| fixed(data, 12 + 4 * i)).collect();
                let form = half(data.get(8..10)?);
                match numbers[..] {
                    [g, ..] if form == 0 => power(g),
                    [g, a, b, ..] if form == 1 => Curve::Parametric([g, a, b, 0.0, -b / a, 0.0, 0.0]),
                    [g, a, b, c, ..] if form == 2 => Curve::Parametric([g, a, b, 0.0, -b / a, c, c]),
                    [g, a, b, c, d, ..] if form == 3 => Curve::Parametric([g, a, b, c, d, 0.0, 0.0]),
                    [g, a, b, c, d, e, f] if form == 4 => Curve::Parametric([g, a, b, c, d, e, f]),
                    _ => return None,
                }
            }
            _ => return None,
        };
        let values: Vec<f64> = (0..=255).map(|i| curve.at(f64::from(i) / 255.0)).collect();
        // NaN is not sorted.
        (values.is_sorted() && values[255] - values[0] > 0.5).then_some(curve)
    }

    /// Linear light of a stored value.
    fn at(&self, x: f64) -> f64 {
        let light = match self {
            Curve::Table(values) => {
                let place = x * (values.len() - 1) as f64;
                let i = (place as usize).min(values.len() - 2);
                let [low, high] = [values[i], values[i + 1]].map(f64::from);
                (low + (high - low) * (place - i as f64)) / 65535.0
            }
            Curve::Parametric([g, a, b, c, d, e, f]) => {
                if x >= *d {
                    (a * x + b).powf(*g) + e
                } else {
                    c * x + f
                }
            }
        };
        light.clamp(0.0, 1.0)
    }
}

/// The nearest of 8 bits.
fn byte(word: u16) -> u8 {
    ((u32::from(word) + 128) / 257) as u8
}

/// A big-endian number of 4 bytes.
fn word(data: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(data.get(at..)?.first_chunk().copied()?))
}

/// A signed number with 16 bits after the point.
fn fixed(data: &[u8], at: usize) -> Option<f64> {
    Some(f64::from(word(data, at)? as i32) / 65536.0)
}

/// A big-endian number of 2 bytes.
fn half(data: &[u8]) -> u16 {
    u16::from_be_bytes([data[0], data[1]])
}

/// sRGB values of linear light, both in 16 bits. Near black, neighbours are .05 of a step of 8 bits apart.
static ENCODED: LazyLock<Vec<u16>> = LazyLock::new(|| {
    let code = |i: u16| (65535.0 * SrgbEncode.f([f64::from(i) / 65535.0])).round() as u16;
    (0..=u16::MAX).map(code).collect()
});

#[cfg(test)]
mod tests;
