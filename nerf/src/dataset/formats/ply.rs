//! Points in PLY files (Stanford's polygon format, Turk 1994), ASCII or binary with the least byte first.

use crate::dataset::capture::Point;
use crate::error::{Error, Result};
use glam::DVec3;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

/// The longest line and the most lines of a header.
const LONGEST_LINE: u64 = 4096;
const MOST_LINES: usize = 1000;

/// The colour of points without one.
const GREY: [u8; 3] = [128; 3];

/// A number of a vertex: its name, its size in bytes and the decoder of its little-endian bits.
struct Property {
    name: String,
    size: usize,
    value: fn(u64) -> f64,
    /// True for an unsigned byte, the type of colours.
    is_byte: bool,
}

impl Property {
    /// A property of a type by name; `None` for an unknown type.
    fn new(name: &str, kind: &str) -> Option<Self> {
        let (size, value): (usize, fn(u64) -> f64) = match kind {
            "char" | "int8" => (1, |bits| f64::from(bits as i8)),
            "short" | "int16" => (2, |bits| f64::from(bits as i16)),
            "int" | "int32" => (4, |bits| f64::from(bits as i32)),
            "uchar" | "uint8" => (1, |bits| bits as f64),
            "ushort" | "uint16" => (2, |bits| bits as f64),
            "uint" | "uint32" => (4, |bits| bits as f64),
            "float" | "float32" => (4, |bits| f64::from(f32::from_bits(bits as u32))),
            "double" | "float64" => (8, f64::from_bits),
            _ => return None,
        };
        Some(Property { name: name.to_owned(), size, value, is_byte: matches!(kind, "uchar" | "uint8") })
    }

    /// Takes the number off the front of the bytes.
    fn take(&self, bytes: &mut &[u8]) -> f64 {
        let (own, rest) = bytes.split_at(self.size);
        *bytes = rest;
        let mut word = [0; 8];
        word[..self.size].copy_from_slice(own);
        (self.value)(u64::from_le_bytes(word))
    }
}

/// The content of a header.
struct Header {
    ascii: bool,
    count: u64,
    /// The properties of a vertex, in order.
    properties: Vec<Property>,
}

/// A line without its end, or an error message.
fn line(reader: &mut impl BufRead) -> std::result::Result<String, String> {
    let mut bytes = vec![];
    let read = reader.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut bytes);
    match read.map_err(|e| format!("cannot be read: {e}"))? as u64 {
        0 => Err("ends too early, copy it again".to_owned()),
        LONGEST_LINE => Err(format!("has a line of {LONGEST_LINE} bytes or more, too long for a PLY file")),
        _ => String::from_utf8(bytes).map_err(|_| "has a line that is not UTF-8 text".to_owned()),
    }
}

impl Header {
    fn read(reader: &mut impl BufRead) -> std::result::Result<Self, String> {
        let cut = |text: &str| text.chars().filter(|c| !c.is_control()).take(60).collect::<String>();
        if line(reader)?.trim_end() != "ply" {
            return Err("is not a PLY file: its first line must be `ply`".to_owned());
        }
        let (mut ascii, mut count, mut properties, mut vertex) = (None, None, vec![], false);
        for _ in 0..MOST_LINES {
            let line = line(reader)?;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words[..] {
                [] | ["comment" | "obj_info", ..] => {}
                ["format", "ascii", _] => ascii = Some(true),
                ["format", "binary_little_endian", _] => ascii = Some(false),
                ["format", ..] => {
                    return Err(format!("has the line `{}`: use ascii or binary_little_endian", cut(line.trim_end())));
                }
                ["element", "vertex", number] if count.is_none() => {
                    count = Some(
                        number.parse().map_err(|_| format!("must have a number of vertices, has `{}`", cut(number)))?,
                    );
                    vertex = true;
                }
                // Elements after the vertices are ignored.
                ["element", ..] if count.is_some() => vertex = false,
                ["element", name, ..] => {
                    return Err(format!("has the element `{}` before `vertex`: put the vertices first", cut(name)));
                }
                ["property", kind, name] if vertex => match Property::new(name, kind) {
                    Some(property) => properties.push(property),
                    None => return Err(format!("has a property `{}` of the unknown type `{}`", cut(name), cut(kind))),
                },
                ["property", ..] if !vertex && count.is_some() => {}
                ["end_header"] => {
                    let ascii = ascii.ok_or("has no line `format`")?;
                    let count = count.ok_or("has no line `element vertex`")?;
                    return Ok(Header { ascii, count, properties });
                }
                _ => {
                    return Err(format!("has an unknown header line: `{}`", cut(line.trim_end())));
                }
            }
        }
        Err(format!("has a header of more than {MOST_LINES} lines, too long for a PLY file"))
    }

    fn index(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|property| property.name == name)
    }

    /// The indices of `names` in the properties; `None` if all are absent, or an error message if only some exist.
    fn all<const N: usize>(&self, names: [&str; N]) -> std::result::Result<Option<[usize; N]>, String> {
        let found = names.map(|name| self.index(name));
        match found.iter().flatten().count() {
            0 => Ok(None),
            n if n == N => Ok(Some(found.map(Option::unwrap_or_default))),
            _ => Err(format!("has only some of the properties {}: give all or none", names.join(", "))),
        }
    }
}

/// Reads the vertices as points: `x y z` and, optionally, `red green blue`, `error` and `views`, which other programs
/// ignore. Memory is proportional to the file.
///
/// # Errors
/// If the file cannot be read, is not a PLY file, ends too early or has an invalid number.
pub(super) fn read(path: &Path) -> Result<Vec<Point>> {
    let read = || {
        let file = File::open(path).map_err(|e| format!("cannot be read: {e}"))?;
        let length = file.metadata().map_err(|e| format!("cannot be read: {e}"))?.len();
        points(&mut BufReader::new(file), length)
    };
    read().map_err(|what: String| Error::file(path, what))
}

/// [`read`] for a file of `length` bytes.
fn points(reader: &mut impl BufRead, length: u64) -> std::result::Result<Vec<Point>, String> {
    let header = Header::read(reader)?;
    let position = header.all(["x", "y", "z"])?.ok_or("has no vertex properties x, y and z")?;
    let color = header.all(["red", "green", "blue"])?;
    if color.is_some_and(|color| color.iter().any(|&i| !header.properties[i].is_byte)) {
        return Err("has colours of another type than uchar: convert them".to_owned());
    }
    let stride: usize = header.properties.iter().map(|property| property.size).sum();
    // In text, a number takes at least a digit and a separator.
    let least = if header.ascii { 2 * header.properties.len() } else { stride } as u64;
    if header.count.checked_mul(least).is_none_or(|bytes| bytes > length.saturating_add(1)) {
        return Err(format!("ends too early: {length} bytes cannot hold {} vertices, copy it again", header.count));
    }
    let (mut points, mut bytes) = (vec![], vec![0; stride]);
    let mut values = vec![0.0; header.properties.len()];
    for i in 0..header.count {
        if header.ascii {
            let line = line(reader).map_err(|what| format!("{what} (after {i} of {} vertices)", header.count))?;
            let mut words = line.split_whitespace();
            for (value, Property { name, .. }) in values.iter_mut().zip(&header.properties) {
                let number = words.next().and_then(|word| word.parse().ok());
                *value = number.ok_or_else(|| format!("has no number for {name:.20} of vertex {i}"))?;
            }
        } else {
            let whole = reader.read_exact(&mut bytes);
            whole.map_err(|e| format!("ends after {i} of {} vertices: {e}", header.count))?;
            let mut rest = &bytes[..];
            values.iter_mut().zip(&header.properties).for_each(|(value, property)| *value = property.take(&mut rest));
        }
        let position = DVec3::from_array(position.map(|i| values[i]));
        if !position.is_finite() {
            return Err(format!("has a vertex {i} with a non-finite position: {position}"));
        }
        let byte = |i: usize| match values[i] {
            x if (0.0..=255.0).contains(&x) => Ok(x as u8),
            x => Err(format!("has a vertex {i} with a colour of {x}; use 0 to 255")),
        };
        let color = match color {
            Some([r, g, b]) => [byte(r)?, byte(g)?, byte(b)?],
            None => GREY,
        };
        let other = |name| header.index(name).map_or(0.0, |i| values[i]);
        points.push(Point { position, color, error: other("error"), views: other("views") as u32 });
    }
    Ok(points)
}

/// Encodes the points as a binary file. Positions are doubles, so that they round-trip bit for bit.
pub(super) fn to_bytes(points: &[Point]) -> Vec<u8> {
    let mut out = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", points.len());
    let properties = ["double x", "double y", "double z", "uchar red", "uchar green", "uchar blue", "double error"];
    for property in properties.into_iter().chain(["uint views"]) {
        out += &format!("property {property}\n");
    }
    let mut out = (out + "end_header\n").into_bytes();
    for Point { position, color, error, views } in points {
        position.to_array().into_iter().for_each(|x| out.extend(x.to_le_bytes()));
        out.extend(color);
        out.extend(error.to_le_bytes());
        out.extend(views.to_le_bytes());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(bytes: &[u8]) -> std::result::Result<Vec<Point>, String> {
        points(&mut &bytes[..], bytes.len() as u64)
    }

    fn some() -> Vec<Point> {
        let point = |i: u8| Point {
            position: DVec3::new(0.1 * f64::from(i), -1.0 / 3.0, 1e-300),
            color: [i, 255, 0],
            error: 0.7,
            views: u32::from(i) + 2,
        };
        (0..3).map(point).collect()
    }

    /// A file in nerfstudio's encoding.
    const TEXT: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
        property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n\
        0.500000 -1.250000 3.000000 255 128 0\n1e3 2 -0 1 2 3\n";

    #[test]
    fn ply_round_trip_is_exact() {
        assert_eq!(parse(&to_bytes(&some())).unwrap(), some());
        assert_eq!(parse(&to_bytes(&[])).unwrap(), []);
    }

    #[test]
    fn ply_text_is_read() {
        let points = parse(TEXT.as_bytes()).unwrap();
        assert_eq!((points[0].position, points[0].color), (DVec3::new(0.5, -1.25, 3.0), [255, 128, 0]));
        assert_eq!((points[1].position, points[1].color), (DVec3::new(1e3, 2.0, 0.0), [1, 2, 3]));
        assert_eq!((points.len(), points[0].views, points[0].error), (2, 0, 0.0));
        assert_eq!(parse(TEXT.trim_end().as_bytes()).unwrap(), points, "no end of the last line");
        assert_eq!(parse(TEXT.replace('\n', "\r\n").as_bytes()).unwrap(), points, "of Windows");
    }

    #[test]
    fn ply_types_are_all_read() {
        let mut bytes = b"ply\nformat binary_little_endian 1.0\ncomment c\nelement vertex 1\nproperty double nx\n\
            property char x\nproperty short y\nproperty float z\nproperty int a\nproperty uint b\nproperty ushort c\n\
            element face 7\nproperty list uchar int vertex_indices\nend_header\n"
            .to_vec();
        bytes.extend(9.5_f64.to_le_bytes());
        bytes.extend((-3_i8).to_le_bytes());
        bytes.extend((-300_i16).to_le_bytes());
        bytes.extend(0.75_f32.to_le_bytes());
        bytes.extend([0xff; 10]);
        let point = Point { position: DVec3::new(-3.0, -300.0, 0.75), color: GREY, error: 0.0, views: 0 };
        assert_eq!(parse(&bytes).unwrap(), [point]);
    }

    #[test]
    fn ply_errors_name_the_problem() {
        for (from, to, expected) in [
            ("ply\n", "obj\n", "is not a PLY file: its first line must be `ply`"),
            ("ascii", "binary_big_endian", "use ascii or binary_little_endian"),
            ("format ascii 1.0\n", "", "has no line `format`"),
            ("element vertex 2\n", "", "has an unknown header line: `property float x`"),
            ("vertex 2", "vertex 3", "ends too early, copy it again (after 2 of 3 vertices)"),
            ("vertex 2", "vertex 18446744073709551615", "cannot hold"),
            ("vertex 2", "vertex -1", "must have a number of vertices, has `-1`"),
            ("element vertex", "element face", "has the element `face` before `vertex`: put the vertices first"),
            ("float y", "float w", "only some of the properties x, y, z"),
            ("float y", "quad y", "unknown type `quad`"),
            ("float y", "list uchar int y", "has an unknown header line"),
            ("uint8 red", "float red", "has colours of another type than uchar: convert them"),
            ("uint8 red", "uint8 rot", "only some of the properties red, green, blue"),
            ("-1.250000", "nan", "has a vertex 0 with a non-finite position"),
            ("-1.250000", "x", "has no number for y of vertex 0"),
            ("255", "256", "a colour of 256"),
            ("end_header", "end", "has an unknown header line: `end`"),
        ] {
            let what = parse(TEXT.replacen(from, to, 1).as_bytes()).unwrap_err();
            assert!(what.contains(expected), "{from} -> {to}: {what}");
        }
        let bytes = to_bytes(&some());
        for length in 0..bytes.len() {
            assert!(parse(&bytes[..length]).is_err(), "{length}");
        }
        assert!(parse(&[b"ply\n".to_vec(), vec![b'x'; 5000]].concat()).unwrap_err().contains("4096 bytes"));
        assert!(parse(&[b"ply\n".to_vec(), b"comment\n".repeat(2000)].concat()).unwrap_err().contains("1000 lines"));
    }
}
