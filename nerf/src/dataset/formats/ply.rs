//! Points in PLY files (Stanford's polygon format, Turk 1994).

use super::points::Points;
use crate::dataset::capture::Point;
use glam::DVec3;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, copy, sink};
use std::path::Path;

/// The longest line and the most lines of a header.
const LONGEST_LINE: u64 = 4096;
const MOST_LINES: usize = 1000;

/// The colour of points without one.
const GREY: [u8; 3] = [128; 3];

/// The names of colours, in the order of the search. The last are spherical harmonics of 3D Gaussians.
const COLORS: [[&str; 3]; 4] = [
    ["red", "green", "blue"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
    ["r", "g", "b"],
    ["f_dc_0", "f_dc_1", "f_dc_2"],
];

/// The spherical harmonic of degree 0.
const HARMONIC: f64 = 0.28209479177387814;

/// An error message that follows the name of the file.
type Result<T> = std::result::Result<T, String>;

/// The type of a number.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Type {
    I8,
    I16,
    I32,
    U8,
    U16,
    U32,
    F32,
    F64,
    Unknown,
}

impl Type {
    fn named(name: &str) -> Self {
        match name {
            "char" | "int8" => Type::I8,
            "short" | "int16" => Type::I16,
            "int" | "int32" => Type::I32,
            "uchar" | "uint8" => Type::U8,
            "ushort" | "uint16" => Type::U16,
            "uint" | "uint32" => Type::U32,
            "float" | "float32" => Type::F32,
            "double" | "float64" => Type::F64,
            _ => Type::Unknown,
        }
    }

    /// The size in bytes.
    fn size(self) -> usize {
        match self {
            Type::I8 | Type::U8 => 1,
            Type::I16 | Type::U16 => 2,
            Type::I32 | Type::U32 | Type::F32 => 4,
            Type::F64 => 8,
            Type::Unknown => 0,
        }
    }

    /// The number with these bits.
    fn value(self, bits: u64) -> f64 {
        match self {
            Type::I8 => f64::from(bits as i8),
            Type::I16 => f64::from(bits as i16),
            Type::I32 => f64::from(bits as i32),
            Type::U8 | Type::U16 | Type::U32 => bits as f64,
            Type::F32 => f64::from(f32::from_bits(bits as u32)),
            Type::F64 => f64::from_bits(bits),
            Type::Unknown => f64::NAN,
        }
    }
}

/// A number of an element, or a list of them.
struct Property {
    name: String,
    kind: Type,
    /// The type of a list's length.
    length: Option<Type>,
}

/// A kind of entries, such as vertices, and their number.
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

/// The content of a header.
struct Header {
    encoding: Encoding,
    /// The elements before the vertices.
    before: Vec<Element>,
    vertex: Element,
    /// True if no other element follows the vertices.
    is_last: bool,
}

/// The start of a word from the file, for messages.
fn cut(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(60).collect()
}

/// A line of the header.
fn line(reader: &mut impl BufRead) -> Result<String> {
    let mut bytes = vec![];
    let read = reader.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut bytes);
    match read.map_err(|e| format!("cannot be read: {e}"))? as u64 {
        0 => Err("ends within its header: copy it again".to_owned()),
        LONGEST_LINE => Err(format!("has a line of {LONGEST_LINE} bytes or more, too long for a PLY file")),
        // Comments may be in any encoding.
        _ => Ok(String::from_utf8_lossy(&bytes).into_owned()),
    }
}

impl Header {
    fn read(reader: &mut impl BufRead) -> Result<Self> {
        if line(reader)?.trim_end() != "ply" {
            return Err("is not a PLY file: its first line must be `ply`".to_owned());
        }
        let (mut encoding, mut elements) = (None, Vec::<Element>::new());
        for _ in 0..MOST_LINES {
            let line = line(reader)?;
            let words: Vec<&str> = line.split_whitespace().collect();
            let unknown = || format!("has an unknown header line: `{}`", cut(line.trim_end()));
            match words[..] {
                [] | ["comment" | "obj_info", ..] => {}
                ["format", "ascii", ..] => encoding = Some(Encoding::Ascii),
                ["format", "binary_little_endian", ..] => encoding = Some(Encoding::Little),
                ["format", "binary_big_endian", ..] => encoding = Some(Encoding::Big),
                ["element", name, count] => {
                    let bad = |_| format!("must have a number of `{}`, has `{}`", cut(name), cut(count));
                    let count = count.parse().map_err(bad)?;
                    elements.push(Element { name: name.to_owned(), count, properties: vec![] });
                }
                ["property", ref kind @ .., name] => {
                    let (length, kind) = match *kind {
                        [kind] => (None, kind),
                        ["list", length, kind] => (Some(Type::named(length)), kind),
                        _ => return Err(unknown()),
                    };
                    let element = elements.last_mut().ok_or_else(unknown)?;
                    element.properties.push(Property { name: name.to_owned(), kind: Type::named(kind), length });
                }
                ["end_header"] => return Header::new(encoding.ok_or("has no line `format`")?, elements),
                _ => return Err(unknown()),
            }
        }
        Err(format!("has a header of more than {MOST_LINES} lines, too long for a PLY file"))
    }

    fn new(encoding: Encoding, mut elements: Vec<Element>) -> Result<Self> {
        let is_vertex = |element: &Element| element.name.eq_ignore_ascii_case("vertex");
        let place = elements.iter().position(is_vertex).ok_or("has no line `element vertex`")?;
        // Elements after the vertices are ignored.
        let is_last = elements.len() == place + 1;
        elements.truncate(place + 1);
        let is_unknown = |own: &&Property| own.kind == Type::Unknown || own.length == Some(Type::Unknown);
        let unknown = elements.iter().flat_map(|element| &element.properties).find(is_unknown);
        if let Some(Property { name, .. }) = unknown.filter(|_| encoding != Encoding::Ascii) {
            return Err(format!("has the property `{}` of an unknown type", cut(name)));
        }
        let vertex = elements.swap_remove(place);
        Ok(Header { encoding, before: elements, vertex, is_last })
    }

    /// The indices of these numbers of a vertex; `None` if one is absent.
    fn find(&self, names: [&str; 3]) -> Option<[usize; 3]> {
        let found = names.map(|name| self.index(name));
        found.iter().all(Option::is_some).then(|| found.map(Option::unwrap_or_default))
    }

    fn index(&self, name: &str) -> Option<usize> {
        let is_it = |own: &Property| own.length.is_none() && own.name.eq_ignore_ascii_case(name);
        self.vertex.properties.iter().position(is_it)
    }

    /// Reads the numbers of an entry, NaN for lists. In text, all are NaN if one is missing or not a number.
    fn entry(&self, reader: &mut impl BufRead, properties: &[Property], values: &mut Vec<f64>) -> Result<()> {
        values.clear();
        if self.encoding == Encoding::Ascii {
            let line = text(reader)?;
            let mut words = line.split_whitespace().map(|word| word.parse::<f64>().ok());
            let value = |own: &Property| {
                let value = words.next()??;
                let count = if own.length.is_some() { value as usize } else { return Some(value) };
                (words.by_ref().take(count).count() == count).then_some(f64::NAN)
            };
            values.extend(properties.iter().map_while(value));
            if values.len() < properties.len() {
                values.clear();
                values.resize(properties.len(), f64::NAN);
            }
            return Ok(());
        }
        for Property { kind, length, .. } in properties {
            let value = self.number(reader, length.unwrap_or(*kind))?;
            values.push(if length.is_some() { f64::NAN } else { value });
            if length.is_some() {
                let bytes = (value as u64).saturating_mul(kind.size() as u64);
                let skipped = copy(&mut reader.by_ref().take(bytes), &mut sink());
                if skipped.map_err(|e| e.to_string())? < bytes {
                    return Err("the file ends within a list".to_owned());
                }
            }
        }
        Ok(())
    }

    /// Returns true if data follow the last entry.
    fn has_more(&self, reader: &mut impl BufRead) -> bool {
        match self.encoding {
            Encoding::Ascii => text(reader).is_ok(),
            _ => reader.fill_buf().is_ok_and(|rest| !rest.is_empty()),
        }
    }

    /// Reads a number of a binary file.
    fn number(&self, reader: &mut impl BufRead, kind: Type) -> Result<f64> {
        let mut word = [0; 8];
        let bytes = &mut word[..kind.size()];
        reader.read_exact(bytes).map_err(|e| e.to_string())?;
        if self.encoding == Encoding::Big {
            bytes.reverse();
        }
        Ok(kind.value(u64::from_le_bytes(word)))
    }
}

/// A line of an entry; empty lines are skipped.
fn text(reader: &mut impl BufRead) -> Result<String> {
    loop {
        let mut bytes = vec![];
        if reader.read_until(b'\n', &mut bytes).map_err(|e| e.to_string())? == 0 {
            return Err("the file ends here".to_owned());
        }
        let line = String::from_utf8_lossy(&bytes);
        if !line.trim().is_empty() {
            return Ok(line.into_owned());
        }
    }
}

/// Reads the vertices as points: `x y z` and, optionally, a [colour](COLORS), `error` and `views`, which other programs
/// ignore. Memory and time are proportional to the file.
pub(super) fn read(path: &Path) -> Points {
    let read = || {
        // Opening a pipe would wait.
        if !path.is_file() {
            return Err("there is no such file".to_owned());
        }
        points(&mut BufReader::new(File::open(path).map_err(|e| format!("cannot be read: {e}"))?))
    };
    read().unwrap_or_else(Points::unreadable)
}

/// [`read`] for the contents; an error message if no point is readable.
fn points(reader: &mut impl BufRead) -> Result<Points> {
    let header = Header::read(reader)?;
    let place = header.find(["x", "y", "z"]).ok_or("has no vertex properties x, y and z")?;
    let names = COLORS.into_iter().find(|names| header.find(*names).is_some());
    let color = names.and_then(|names| header.find(names));
    let is_harmonic = names == Some(COLORS[3]);
    let others = [header.index("error"), header.index("views")];
    let mut values = vec![];
    // Entries without properties take no bytes.
    for Element { name, count, properties } in header.before.iter().filter(|own| !own.properties.is_empty()) {
        for i in 0..*count {
            let ended = |what| format!("ends after {i} of {count} entries of `{}`: {what}", cut(name));
            header.entry(reader, properties, &mut values).map_err(ended)?;
        }
    }
    let Element { count, properties, .. } = &header.vertex;
    let (mut points, mut colors) = (Points::of(*count), vec![]);
    for i in 0..*count {
        if let Err(what) = header.entry(reader, properties, &mut values) {
            points.end(format!("ends after {i} of {count} vertices ({what}): copy it again"));
            break;
        }
        let [error, views] = others.map(|other| other.map_or(0.0, |other| values[other]));
        let position = DVec3::from_array(place.map(|at| values[at]));
        let point = Point { position, color: GREY, error, views: views as u32 };
        if points.push(point, || format!("vertex {i}")) {
            let value = |at: usize| if is_harmonic { 0.5 + HARMONIC * values[at] } else { values[at] };
            colors.extend(color.map(|color| color.map(|at| value(at) as f32)));
        }
    }
    if header.is_last && header.has_more(reader) {
        points.follow(format!("more data follow the last of {count} vertices: correct the count, or copy it again"));
    }
    let most = colors.iter().flatten().copied().fold(0.0, f32::max);
    let scale = match color.map(|[red, ..]| properties[red].kind) {
        _ if is_harmonic => 255.0,
        Some(Type::F32 | Type::F64) if most <= 1.0 => 255.0,
        Some(Type::U16) if most > 255.0 => 255.0 / 65535.0,
        _ => 1.0,
    };
    for (point, color) in points.points.iter_mut().zip(colors) {
        if color.iter().all(|x| x.is_finite()) {
            point.color = color.map(|x| (scale * x).round() as u8);
        }
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
    use crate::dataset::capture::{Capture, Format};
    use crate::dataset::formats::{cases, kit::damage};
    use proptest::prelude::*;

    /// The points, or the reason why there are none.
    fn parse(bytes: &[u8]) -> Result<Points> {
        points(&mut &bytes[..])
    }

    /// All points; none may be left out.
    #[track_caller]
    fn whole(bytes: &[u8]) -> Vec<Point> {
        let read = parse(bytes).unwrap();
        let points = read.points.clone();
        assert_eq!(said(read), [""; 0]);
        points
    }

    /// What a capture says about the points.
    fn said(points: Points) -> Vec<String> {
        let mut capture = Capture::new(Path::new("scene"), "file".into(), Format::Transforms, vec![]);
        points.attach(&mut capture, Path::new("scene/p.ply"));
        assert_eq!(capture.points_file.is_some(), !capture.points.is_empty());
        capture.assumptions
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
        assert_eq!(whole(&to_bytes(&some())), some());
        assert_eq!(whole(&to_bytes(&[])), []);
    }

    #[test]
    fn points_behind_the_announced_ones_are_noted() {
        let note = |count: usize| {
            let what = format!("more data follow the last of {count} vertices: correct the count, or copy it again");
            vec![format!("left out the {} of `p.ply`: {what}", if count == 0 { "points" } else { "rest" })]
        };
        for count in [0, 1] {
            let read = parse(TEXT.replace("vertex 2", &format!("vertex {count}")).as_bytes()).unwrap();
            assert_eq!((read.points.len(), said(read)), (count, note(count)));
        }
        let text = |points: &[Point], count: usize| {
            let bytes = to_bytes(points);
            let place = bytes.windows(7).position(|word| word == b"vertex ").unwrap() + 7;
            let mut bytes = bytes.clone();
            bytes[place] = b'0' + count as u8;
            bytes
        };
        assert_eq!(said(parse(&text(&some(), 2)).unwrap()), note(2));
        // Blank lines, and other elements.
        assert_eq!(said(parse(format!("{TEXT}\n \n").as_bytes()).unwrap()), [""; 0]);
        let faces = "element face 1\nproperty list uchar int i\nend_header";
        let with_face = TEXT.replace("end_header", faces) + "2 0 1\n";
        assert_eq!(said(parse(with_face.as_bytes()).unwrap()), [""; 0]);
    }

    #[test]
    fn ply_text_is_read() {
        let points = whole(TEXT.as_bytes());
        assert_eq!((points[0].position, points[0].color), (DVec3::new(0.5, -1.25, 3.0), [255, 128, 0]));
        assert_eq!((points[1].position, points[1].color), (DVec3::new(1e3, 2.0, 0.0), [1, 2, 3]));
        assert_eq!((points.len(), points[0].views, points[0].error), (2, 0, 0.0));
        assert_eq!(whole(TEXT.trim_end().as_bytes()), points, "no end of the last line");
        assert_eq!(whole(TEXT.replace('\n', "\r\n").as_bytes()), points, "of Windows");
        assert_eq!(whole(TEXT.replace("1e3", "\n1e3").as_bytes()), points, "an empty line");
        let latin = TEXT.replace("element", "comment M\u{1}ller\nelement");
        assert_eq!(whole(&latin.bytes().map(|b| if b == 1 { 0xfc } else { b }).collect::<Vec<_>>()), points);
    }

    #[test]
    fn ply_types_and_byte_orders_are_all_read() {
        // Elements and lists before and within the vertices are skipped.
        let header = "comment c\nelement camera 2\nproperty double a\nproperty list uchar short b\nelement vertex 1\n\
            property double nx\nproperty char x\nproperty short y\nproperty list int uchar l\nproperty float z\n\
            property int a\nproperty uint b\nproperty ushort c\nelement face 7\nproperty list uchar int indices\n\
            property quad q\nend_header";
        let point = Point { position: DVec3::new(-3.0, -300.0, 0.75), color: GREY, error: 0.0, views: 0 };
        for (format, big) in [("little", false), ("big", true)] {
            let mut bytes = vec![];
            let mut add = |number: &[u8]| match big {
                true => bytes.extend(number.iter().rev()),
                false => bytes.extend(number),
            };
            // A camera with a list of two numbers and one with an empty list.
            for number in [&7.5_f64.to_le_bytes()[..], &[2], &9_i16.to_le_bytes(), &8_i16.to_le_bytes()] {
                add(number);
            }
            [&7.5_f64.to_le_bytes()[..], &[0]].into_iter().for_each(&mut add);
            for number in [&9.5_f64.to_le_bytes()[..], &(-3_i8).to_le_bytes(), &(-300_i16).to_le_bytes()] {
                add(number);
            }
            [&3_i32.to_le_bytes()[..], &[1; 3], &0.75_f32.to_le_bytes(), &[0xff; 10]].into_iter().for_each(&mut add);
            for end in ["\n", "\r\n"] {
                let header = format!("ply\nformat binary_{format}_endian 1.0\n{header}\n").replace('\n', end);
                assert_eq!(whole(&[header.as_bytes(), &bytes].concat()), [point], "{format} {end:?}");
            }
        }
        let text = format!("ply\nformat ascii 1.0\n{header}\n").replace("double nx", "half nx");
        let text = text + "7.5 2 9 8\n7.5 0\n9.5 -3 -300 3 1 1 1 0.75 1 2 3\n3 0 1 2 9\n";
        assert_eq!(whole(text.as_bytes()), [point]);
    }

    #[test]
    fn ply_colors_of_all_programs_are_read() {
        let colors = |kind: &str, names: [&str; 3], lines: [&str; 2]| {
            let text = TEXT.replace("uint8 red", &format!("{kind} {}", names[0]));
            let text = text.replace("uint8 green", &format!("{kind} {}", names[1]));
            let text = text.replace("uint8 blue", &format!("{kind} {}", names[2]));
            let text = text.replace("255 128 0", lines[0]).replace("1 2 3", lines[1]);
            let points = whole(text.as_bytes());
            [points[0].color, points[1].color]
        };
        let rgb = ["red", "green", "blue"];
        assert_eq!(colors("float", rgb, ["1 0.5 0", "0 0.2 1"]), [[255, 128, 0], [0, 51, 255]]);
        let diffuse = ["diffuse_red", "diffuse_green", "diffuse_blue"];
        assert_eq!(colors("double", diffuse, ["1 0.5 0", "0 0.2 1"]), [[255, 128, 0], [0, 51, 255]]);
        // One float above 1 in the file: all are 0 to 255.
        assert_eq!(colors("float", ["r", "g", "b"], ["1 0.5 0", "0 0.2 37.4"]), [[1, 1, 0], [0, 0, 37]]);
        assert_eq!(colors("int", rgb, ["1 300 -4", "0 2 255"]), [[1, 255, 0], [0, 2, 255]]);
        assert_eq!(colors("ushort", rgb, ["1 255 0", "0 2 4"]), [[1, 255, 0], [0, 2, 4]]);
        assert_eq!(colors("ushort", rgb, ["65535 257 0", "0 2 4"]), [[255, 1, 0], [0, 0, 0]]);
        assert_eq!(colors("float", rgb, ["nan 0 0", "0 1 0"]), [GREY, [0, 255, 0]]);
        // Half of the harmonics of degree 0 above grey.
        let f_dc = ["f_dc_0", "f_dc_1", "f_dc_2"];
        assert_eq!(colors("float", f_dc, ["0 0.8862269 -9", "1.7724539 0 9"]), [[128, 191, 0], [255, 128, 255]]);
        assert_eq!(colors("uint8", ["Red", "GREEN", "blue"], ["9 8 7", "4 5 6"])[0], [9, 8, 7]);
        assert_eq!(colors("uint8", ["rot", "green", "blue"], ["9 8 7", "4 5 6"])[0], GREY);
    }

    #[test]
    fn damaged_vertices_are_left_out() {
        for (from, to, expected) in [
            ("-1.250000", "nan", "left out 1 of 2 points of `p.ply`: vertex 0 has no finite position"),
            ("1e3", "-inf", "left out 1 of 2 points of `p.ply`: vertex 1 has no finite position"),
            ("-1.250000", "x", "left out 1 of 2 points of `p.ply`: vertex 0 has no finite position"),
            (" 3\n", "\n", "left out 1 of 2 points of `p.ply`: vertex 1 has no finite position"),
            (
                "vertex 2",
                "vertex 3",
                "left out 1 of 3 points of `p.ply`: ends after 2 of 3 vertices (the file ends here): copy it again",
            ),
            ("vertex 2", "vertex 18446744073709551615", "left out 18446744073709551613 of 18446744073709551615 points"),
        ] {
            let points = parse(TEXT.replacen(from, to, 1).as_bytes()).unwrap();
            assert_eq!(points.points.len(), if from == "vertex 2" { 2 } else { 1 });
            let said = said(points);
            assert!(said.len() == 1 && said[0].starts_with(expected), "{from} -> {to}: {said:?}");
        }
        // The whole vertices of a file that was cut.
        let bytes = to_bytes(&some());
        let start = bytes.len() - 3 * 39;
        for length in start..bytes.len() {
            let points = parse(&bytes[..length]).unwrap();
            assert_eq!(points.points, some()[..(length - start) / 39], "{length}");
            assert_eq!(said(points).len(), 1);
        }
    }

    #[test]
    fn reasons_name_the_problem() {
        for (from, to, expected) in [
            ("ply\n", "obj\n", "is not a PLY file: its first line must be `ply`"),
            ("ascii", "binary", "has an unknown header line: `format binary 1.0`"),
            ("format ascii 1.0\n", "", "has no line `format`"),
            ("element vertex 2\n", "", "has an unknown header line: `property float x`"),
            ("element vertex", "element face", "has no line `element vertex`"),
            ("vertex 2", "vertex -1", "must have a number of `vertex`, has `-1`"),
            ("float y", "float w", "has no vertex properties x, y and z"),
            ("float y", "list uchar float y", "has no vertex properties x, y and z"),
            ("float y", "list int y", "has an unknown header line: `property list int y`"),
            ("end_header", "end", "has an unknown header line: `end`"),
            ("element vertex", "element box 9\nproperty int a\nelement vertex", "ends after 2 of 9 entries of `box`"),
        ] {
            let what = parse(TEXT.replacen(from, to, 1).as_bytes()).unwrap_err();
            assert!(what.contains(expected), "{from} -> {to}: {what}");
        }
        let unknown = TEXT.replace("ascii", "binary_big_endian").replace("float y", "quad y");
        assert_eq!(parse(unknown.as_bytes()).unwrap_err(), "has the property `y` of an unknown type");
        assert_eq!(parse(&TEXT.as_bytes()[..21]).unwrap_err(), "ends within its header: copy it again");
        assert!(parse(&[b"ply\n".to_vec(), vec![b'x'; 5000]].concat()).unwrap_err().contains("4096 bytes"));
        assert!(parse(&[b"ply\n".to_vec(), b"comment\n".repeat(2000)].concat()).unwrap_err().contains("1000 lines"));
        // Entries without properties take no time.
        let empty = TEXT.replace("element vertex", "element box 18446744073709551615\nelement vertex");
        assert_eq!(whole(empty.as_bytes()).len(), 2);
        let absent = said(read(Path::new("absent.ply")));
        assert_eq!(absent, ["left out the points of `p.ply`: there is no such file"]);
    }

    proptest! {
        #![proptest_config(cases(500))]

        #[test]
        fn damaged_ply_files_give_finite_points(damage in damage::damage(), is_text: bool) {
            let bytes = if is_text { TEXT.into() } else { to_bytes(&some()) };
            let damaged = damage::damaged(&bytes, TEXT.as_bytes(), &damage);
            if let Ok(read) = parse(&damaged) {
                prop_assert!(read.points.iter().all(|point| point.position.is_finite() && point.error.is_finite()));
                prop_assert!(read.points.len() as u64 <= read.total && read.points.len() <= damaged.len());
                let is_whole = read.points.len() as u64 == read.total;
                prop_assert!(is_whole || !said(read).is_empty(), "points are left out without a note");
            }
        }
    }
}
