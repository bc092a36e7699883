//! What EXIF data (TIFF 6.0 and CIPA DC-008) say about a photograph.

use super::tiff::{Entry, Tiff};
use std::io::{Read, Seek};

/// Entries of the first directory.
const MAKE: u16 = 0x010f;
const MODEL: u16 = 0x0110;
const EXIF_DIRECTORY: u16 = 0x8769;
const GPS_DIRECTORY: u16 = 0x8825;
/// Entries of the EXIF directory.
const FOCAL_LENGTH: u16 = 0x920a;
const FOCAL_LENGTH_35MM: u16 = 0xa405;
const LENS_MODEL: u16 = 0xa434;
/// Entries of the GPS directory: hemisphere and angle, of latitude and longitude.
const GPS: [[u16; 2]; 2] = [[1, 2], [3, 4]];

/// The lens and the place of a photograph. Absent and damaged entries are left out.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Exif {
    /// What it was taken with.
    pub lens: Option<ExifLens>,
    /// Latitude and longitude in degrees.
    pub place: Option<[f64; 2]>,
}

/// What a photograph was taken with. Photographs of one lens are equal.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct ExifLens {
    /// Maker and model of the camera, and model of the lens.
    pub names: [String; 3],
    /// Focal length in hundredths of a millimetre; 0 if unknown.
    pub focal: u64,
    /// The same in millimetres of a 35 mm camera, which digital zoom changes; 0 if unknown.
    pub focal_35mm: u32,
}

impl Exif {
    /// Reads a TIFF structure.
    pub(super) fn read(reader: impl Read + Seek) -> Exif {
        let Some(mut tiff) = Tiff::new(reader) else { return Exif::default() };
        let main = tiff.directory(tiff.first);
        let mut inner = |tag| {
            let entry = main.iter().find(|entry| entry.tag == tag)?;
            let at = tiff.number(*entry)?;
            Some(tiff.directory(at.into()))
        };
        let [camera, gps] = [EXIF_DIRECTORY, GPS_DIRECTORY].map(|tag| inner(tag).unwrap_or_default());
        let find = |directory: &[Entry], tag| directory.iter().find(|entry| entry.tag == tag).copied();
        let mut text = |directory: &[Entry], tag| find(directory, tag).and_then(|entry| tiff.text(entry));
        let names = [text(&main, MAKE), text(&main, MODEL), text(&camera, LENS_MODEL)].map(Option::unwrap_or_default);
        let sides = GPS.map(|[side, _]| text(&gps, side));
        let focal = find(&camera, FOCAL_LENGTH).and_then(|entry| tiff.ratio(entry, 0)).unwrap_or(0.0);
        let focal_35mm = find(&camera, FOCAL_LENGTH_35MM).and_then(|entry| tiff.number(entry)).unwrap_or(0);
        let lens = ExifLens { names, focal: (100.0 * focal).round() as u64, focal_35mm };
        let mut angle = |i: usize| {
            let entry = find(&gps, GPS[i][1])?;
            let [degrees, minutes, seconds] = [0, 1, 2].map(|part| tiff.ratio(entry, part));
            let angle = degrees? + minutes.unwrap_or(0.0) / 60.0 + seconds.unwrap_or(0.0) / 3600.0;
            let is_negative = matches!(sides[i].as_deref(), Some("S" | "W"));
            (angle <= 180.0).then_some(if is_negative { -angle } else { angle })
        };
        let place = angle(0).zip(angle(1)).map(|(north, east)| [north, east]);
        Exif { lens: (lens != ExifLens::default()).then_some(lens), place }
    }

    /// The focal length in pixels of a whole image of this size, by that of a 35 mm camera with the same diagonal field
    /// of view.
    pub(crate) fn focal_pixels(&self, [width, height]: [usize; 2]) -> Option<f64> {
        let focal = f64::from(self.lens.as_ref()?.focal_35mm);
        let diagonal = (width as f64).hypot(height as f64);
        (focal > 0.0 && diagonal > 0.0).then(|| focal / 36.0_f64.hypot(24.0) * diagonal)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::photo::tiff::LONGEST;
    use raygrad_test_support::campaign::campaign;
    use raygrad_test_support::tally::Bound;
    use std::io::Cursor;

    fn read(bytes: &[u8]) -> (Option<ExifLens>, Option<[f64; 2]>) {
        let Exif { lens, place } = Exif::read(Cursor::new(bytes));
        (lens, place)
    }

    /// A value of an entry.
    enum Value {
        Text(&'static str),
        Short(u16),
        Long(u32),
        Ratios(Vec<[u32; 2]>),
    }

    /// A TIFF structure with a first, an EXIF and a GPS directory.
    fn tiff(is_little: bool, directories: [Vec<(u16, Value)>; 3]) -> Vec<u8> {
        let number = |value: u64, size: usize| match is_little {
            true => value.to_le_bytes()[..size].to_vec(),
            false => value.to_be_bytes()[8 - size..].to_vec(),
        };
        let mut out = [if is_little { b"II" } else { b"MM" }.to_vec(), number(42, 2), number(8, 4)].concat();
        let sizes = directories.each_ref().map(|entries| 2 + 12 * entries.len() + 4);
        let mut data = vec![];
        let begin = 8 + sizes.iter().sum::<usize>();
        for entries in directories {
            out.extend(number(entries.len() as u64, 2));
            for (tag, value) in entries {
                let (kind, count, bytes) = match value {
                    Value::Text(text) => (2, text.len() + 1, [text.as_bytes(), b"\0"].concat()),
                    Value::Short(value) => (3, 1, number(value.into(), 2)),
                    Value::Long(value) => (4, 1, number(value.into(), 4)),
                    Value::Ratios(all) => {
                        (5, all.len(), all.iter().flatten().flat_map(|part| number((*part).into(), 4)).collect())
                    }
                };
                out.extend([number(tag.into(), 2), number(kind, 2), number(count as u64, 4)].concat());
                if bytes.len() <= 4 {
                    out.extend([bytes.as_slice(), &[0; 4][bytes.len()..]].concat());
                } else {
                    out.extend(number((begin + data.len()) as u64, 4));
                    data.extend(bytes);
                }
            }
            out.extend([0; 4]);
        }
        out.extend(data);
        out
    }

    /// EXIF data of a phone.
    fn phone(is_little: bool, focal: [u32; 2], focal_35mm: u16) -> Vec<u8> {
        let (exif, gps) = (8 + 2 + 4 * 12 + 4, 8 + 2 + 4 * 12 + 4 + 2 + 3 * 12 + 4);
        let angle = |degrees, minutes, seconds| Value::Ratios(vec![[degrees, 1], [minutes, 1], [seconds, 100]]);
        tiff(
            is_little,
            [
                vec![
                    (MAKE, Value::Text("Apple")),
                    (MODEL, Value::Text("iPhone 13")),
                    (EXIF_DIRECTORY, Value::Long(exif)),
                    (GPS_DIRECTORY, Value::Long(gps)),
                ],
                vec![
                    (FOCAL_LENGTH, Value::Ratios(vec![focal])),
                    (FOCAL_LENGTH_35MM, Value::Short(focal_35mm)),
                    (LENS_MODEL, Value::Text("back camera")),
                ],
                vec![(1, Value::Text("S")), (2, angle(33, 51, 2400)), (3, Value::Text("E")), (4, angle(151, 12, 3600))],
            ],
        )
    }

    #[test]
    fn read_gives_lens_and_place_in_both_byte_orders() {
        for is_little in [false, true] {
            let exif = phone(is_little, [51, 10], 26);
            let names = ["Apple", "iPhone 13", "back camera"].map(str::to_owned);
            let (lens, place) = read(&exif);
            assert_eq!(lens, Some(ExifLens { names, focal: 510, focal_35mm: 26 }));
            let [north, east] = place.unwrap();
            assert!((north + 33.856_667).abs() < 1e-6 && (east - 151.21).abs() < 1e-6, "{north} {east}");
            // 26 mm before a diagonal of 43.267 mm.
            let focal = Exif { lens, place }.focal_pixels([3000, 4000]).unwrap();
            assert!((focal - 3004.626).abs() < 0.001, "{focal}");
        }
        assert_eq!(read(&tiff(true, [vec![], vec![], vec![]])), (None, None));
        assert_eq!(read(b"JFIF"), (None, None));
        // A ratio without a value.
        assert_eq!(read(&phone(true, [0, 0], 26)).0.map(|lens| [lens.focal, lens.focal_35mm.into()]), Some([0, 26]));
    }

    #[test]
    fn campaign_exif() {
        let whole = [phone(true, [51, 10], 26), phone(false, [154, 100], 13)];
        let parse = |bytes: &[u8]| match read(bytes) {
            (Some(lens), Some([north, east])) if north.abs().max(east.abs()) <= 180.0 => {
                assert!(lens.names.iter().all(|name| name.len() <= 3 * LONGEST), "{lens:?}");
                Ok(())
            }
            (_, Some(place)) if !place.iter().all(|angle| angle.abs() <= 180.0) => panic!("{place:?}"),
            _ => Err("incomplete"),
        };
        campaign("EXIF", &whole, Bound { times: 16, plus: 1 << 12 }, parse, |_| {});
    }
}
