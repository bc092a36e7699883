//! The lens and the place of a photograph, from its EXIF data (TIFF 6.0 and CIPA DC-008).

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
/// The most bytes of a name that count.
const LONGEST: usize = 64;

/// What a photograph was taken with. Photographs of one lens are equal.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Lens {
    /// Maker and model of the camera, and model of the lens.
    pub names: [String; 3],
    /// Focal length in hundredths of a millimetre; 0 if unknown.
    pub focal: u64,
    /// The same in millimetres of a 35 mm camera, which digital zoom changes.
    pub focal_35mm: u32,
}

/// Reads the lens and the place, latitude and longitude in degrees. Absent and damaged entries are left out.
pub fn read(exif: &[u8]) -> (Option<Lens>, Option<[f64; 2]>) {
    let Some((tiff, first)) = Tiff::new(exif.strip_prefix(b"Exif\0\0").unwrap_or(exif)) else { return (None, None) };
    let directory = |tag| Some(tiff.number(tiff.entry(first, tag)?)? as usize);
    let (inner, gps) = (directory(EXIF_DIRECTORY), directory(GPS_DIRECTORY));
    let text = |at: Option<usize>, tag| at.and_then(|at| tiff.text(tiff.entry(at, tag)?)).unwrap_or_default();
    let focal = inner.and_then(|at| tiff.ratio(tiff.entry(at, FOCAL_LENGTH)?, 0)).unwrap_or(0.0);
    let lens = Lens {
        names: [text(Some(first), MAKE), text(Some(first), MODEL), text(inner, LENS_MODEL)],
        focal: (100.0 * focal).round() as u64,
        focal_35mm: inner.and_then(|at| tiff.number(tiff.entry(at, FOCAL_LENGTH_35MM)?)).unwrap_or(0),
    };
    let angle = |[side, angle]: [u16; 2]| {
        let [degrees, minutes, seconds] = [0, 1, 2].map(|i| tiff.ratio(tiff.entry(gps?, angle)?, i));
        let angle = degrees? + minutes.unwrap_or(0.0) / 60.0 + seconds.unwrap_or(0.0) / 3600.0;
        let is_negative = matches!(text(gps, side).as_str(), "S" | "W");
        (angle <= 180.0).then_some(if is_negative { -angle } else { angle })
    };
    let place = GPS.map(angle);
    ((lens != Lens::default()).then_some(lens), place[0].zip(place[1]).map(|(north, east)| [north, east]))
}

/// A TIFF structure.
struct Tiff<'a> {
    bytes: &'a [u8],
    is_little: bool,
}

/// An entry of a directory.
#[derive(Clone, Copy)]
struct Entry {
    kind: u16,
    count: usize,
    /// Where its values are.
    at: usize,
}

impl<'a> Tiff<'a> {
    /// The structure, and the place of its first directory.
    fn new(bytes: &'a [u8]) -> Option<(Self, usize)> {
        let tiff = Tiff { bytes, is_little: bytes.starts_with(b"II") };
        let is_known = tiff.is_little || bytes.starts_with(b"MM");
        let first = tiff.long(4)? as usize;
        (is_known && tiff.short(2) == Some(42)).then_some((tiff, first))
    }

    fn slice<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        self.bytes.get(at..at.checked_add(N)?)?.try_into().ok()
    }

    fn short(&self, at: usize) -> Option<u16> {
        let bytes = self.slice(at)?;
        Some(if self.is_little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
    }

    fn long(&self, at: usize) -> Option<u32> {
        let bytes = self.slice(at)?;
        Some(if self.is_little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    /// The entry of a directory with this tag.
    fn entry(&self, directory: usize, tag: u16) -> Option<Entry> {
        let count = usize::from(self.short(directory)?);
        let places = (0..count).map(|i| directory.saturating_add(2 + 12 * i));
        let at = places.take_while(|at| *at < self.bytes.len()).find(|at| self.short(*at) == Some(tag))?;
        let (kind, count) = (self.short(at + 2)?, self.long(at + 4)? as usize);
        let size: usize = match kind {
            1 | 2 | 7 => 1,
            3 => 2,
            4 => 4,
            5 => 8,
            _ => return None,
        };
        // Values of up to four bytes are in the entry itself.
        let is_inside = size.checked_mul(count)? <= 4;
        Some(Entry { kind, count, at: if is_inside { at + 8 } else { self.long(at + 8)? as usize } })
    }

    /// A number of 16 or 32 bits.
    fn number(&self, entry: Entry) -> Option<u32> {
        match entry.kind {
            3 => self.short(entry.at).map(u32::from),
            4 => self.long(entry.at),
            _ => None,
        }
    }

    /// The ratio number `i`, if it is finite.
    fn ratio(&self, entry: Entry, i: usize) -> Option<f64> {
        if entry.kind != 5 || i >= entry.count {
            return None;
        }
        let at = entry.at.checked_add(8 * i)?;
        let ratio = f64::from(self.long(at)?) / f64::from(self.long(at.checked_add(4)?)?);
        ratio.is_finite().then_some(ratio)
    }

    /// A text up to its first zero.
    fn text(&self, entry: Entry) -> Option<String> {
        let bytes = self.bytes.get(entry.at..entry.at.checked_add(entry.count.min(LONGEST))?)?;
        let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
        (entry.kind == 2).then(|| String::from_utf8_lossy(text).trim().to_owned())
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use raygrad_test_support::campaign::campaign;
    use raygrad_test_support::tally::Bound;

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
            assert_eq!(lens, Some(Lens { names, focal: 510, focal_35mm: 26 }));
            let [north, east] = place.unwrap();
            assert!((north + 33.856_667).abs() < 1e-6 && (east - 151.21).abs() < 1e-6, "{north} {east}");
            assert_eq!(read(&[b"Exif\0\0".as_slice(), &exif].concat()), (lens, place));
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
