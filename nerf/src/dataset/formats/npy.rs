//! NumPy's `.npy` files, of two axes.

use super::limits::start;

/// A row-major matrix.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::dataset) struct Matrix {
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
    /// `rows * columns` values.
    pub values: Vec<f64>,
}

/// The first bytes of a file.
pub(in crate::dataset) const MAGIC: &[u8] = b"\x93NUMPY";

/// The error of a damaged file.
const BROKEN: &str = "is not a complete npy file: copy it again";

impl Matrix {
    /// The matrix of a `.npy` file of f32 or f64 numbers, in either order of elements; or a message that follows the
    /// file's name.
    pub fn read(bytes: &[u8]) -> Result<Self, String> {
        let (header, data) = split(bytes).ok_or(BROKEN)?;
        let descr = member(header, "descr").ok_or(BROKEN)?.trim_start_matches(['\'', '"']);
        let descr = descr.split(['\'', '"']).next().unwrap_or_default();
        let size = match descr {
            "<f8" => 8,
            "<f4" => 4,
            _ => {
                let found = start(descr);
                let what = "not `<f8` or `<f4`: write it with astype(numpy.float64)";
                return Err(format!("has elements of type `{found}`, {what}"));
            }
        };
        let [rows, columns] = shape(header)?;
        // The header must match the file's length, so that a damaged header cannot exhaust memory.
        let announced = rows.checked_mul(columns).and_then(|count| count.checked_mul(size));
        if announced != Some(data.len()) {
            return Err(format!(
                "has {} bytes of elements, which do not fit the shape ({rows}, {columns}): copy it again",
                data.len()
            ));
        }
        let value = |element: &[u8]| match element.try_into() {
            Ok(bytes) => f64::from_le_bytes(bytes),
            Err(_) => element.try_into().map_or(f64::NAN, |bytes| f64::from(f32::from_le_bytes(bytes))),
        };
        let values: Vec<f64> = data.chunks_exact(size).map(value).collect();
        let by_columns = member(header, "fortran_order").ok_or(BROKEN)?.starts_with("True");
        let values = match by_columns {
            true => (0..values.len()).map(|i| values[i % columns * rows + i / columns]).collect(),
            false => values,
        };
        Ok(Matrix { rows, columns, values })
    }

    /// The bytes of a `.npy` file of version 1 with f64 numbers.
    pub fn write(&self) -> Vec<u8> {
        write([self.rows, self.columns], "<f8", self.values.iter().map(|value| value.to_le_bytes()))
    }
}

/// Encodes f32 numbers as a `.npy` file of version 1, row-major, rows times columns in number.
pub(in crate::dataset) fn write_single(shape: [usize; 2], values: &[f32]) -> Vec<u8> {
    write(shape, "<f4", values.iter().map(|value| value.to_le_bytes()))
}

fn write<const N: usize>([rows, columns]: [usize; 2], descr: &str, values: impl Iterator<Item = [u8; N]>) -> Vec<u8> {
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // The elements start at a multiple of 64 bytes, after the 10 bytes of magic, version and length.
    let padding = (10 + header.len() + 1).next_multiple_of(64) - 10 - header.len() - 1;
    header.extend(std::iter::repeat_n(' ', padding));
    header.push('\n');
    let mut bytes = MAGIC.to_vec();
    bytes.extend([1, 0]);
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(values.flatten());
    bytes
}

/// The header, a Python dictionary, and the elements.
fn split(bytes: &[u8]) -> Option<(&str, &[u8])> {
    let [major, _minor, rest @ ..] = bytes.strip_prefix(MAGIC)? else { return None };
    let (length, rest) = match major {
        1 => rest.split_first_chunk().map(|(length, rest)| (usize::from(u16::from_le_bytes(*length)), rest))?,
        2 | 3 => rest.split_first_chunk().map(|(length, rest)| (u32::from_le_bytes(*length) as usize, rest))?,
        _ => return None,
    };
    let (header, data) = rest.split_at_checked(length)?;
    Some((std::str::from_utf8(header).ok()?, data))
}

/// The text after a key of the header.
fn member<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let after = |quote: char| header.split_once(&format!("{quote}{key}{quote}"));
    let (_, rest) = after('\'').or_else(|| after('"'))?;
    Some(rest.trim_start().strip_prefix(':')?.trim_start())
}

/// The two extents of the shape. Some programs append an axis of extent 1.
fn shape(header: &str) -> Result<[usize; 2], String> {
    let extents = member(header, "shape").and_then(|rest| rest.strip_prefix('(')?.split_once(')'));
    let (extents, _) = extents.ok_or(BROKEN)?;
    let words = extents.split(',').map(str::trim).filter(|extent| !extent.is_empty());
    let numbers = words.map(|extent| extent.parse().map_err(|_| BROKEN)).take(9).collect::<Result<Vec<usize>, _>>()?;
    match numbers[..] {
        [rows, columns] | [rows, columns, 1] => Ok([rows, columns]),
        _ => Err(format!("has {} axes, not rows and columns", numbers.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file in NumPy's encoding with this dictionary.
    fn file(version: u8, dictionary: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0x93, b'N', b'U', b'M', b'P', b'Y', version, 0];
        match version {
            1 => bytes.extend((dictionary.len() as u16).to_le_bytes()),
            _ => bytes.extend((dictionary.len() as u32).to_le_bytes()),
        }
        bytes.extend(dictionary.as_bytes());
        bytes.extend(data);
        bytes
    }

    #[test]
    fn both_orders_and_both_precisions_are_read() {
        let doubles: Vec<u8> = [1.0, 2.0, 3.0, 4.0, 5.0, 6.5_f64].iter().flat_map(|x| x.to_le_bytes()).collect();
        let floats: Vec<u8> = [1.0, 4.0, 2.0, 5.0, 3.0, 6.5_f32].iter().flat_map(|x| x.to_le_bytes()).collect();
        let rows = file(1, "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }\n", &doubles);
        let columns = file(2, r#"{"descr": "<f4", "fortran_order": True, "shape": (2, 3)}"#, &floats);
        let expected = Matrix { rows: 2, columns: 3, values: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.5] };
        assert_eq!(Matrix::read(&rows), Ok(expected.clone()));
        assert_eq!(Matrix::read(&columns), Ok(expected.clone()));
        let written = expected.write();
        assert_eq!((Matrix::read(&written), (written.len() - 48) % 64), (Ok(expected), 0));
        let single = write_single([2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.5]);
        assert_eq!((Matrix::read(&single), single.len() % 64), (Matrix::read(&written), 24));
        let third = file(1, "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3, 1), }", &doubles);
        assert_eq!(Matrix::read(&third), Matrix::read(&rows));
        let empty = file(1, "{'descr': '<f8', 'fortran_order': True, 'shape': (0, 17), }", &[]);
        assert_eq!(Matrix::read(&empty), Ok(Matrix { rows: 0, columns: 17, values: vec![] }));
    }

    #[test]
    fn npy_errors_name_the_problem() {
        let fails = |bytes: &[u8], expected: &str| {
            let what = Matrix::read(bytes).unwrap_err();
            assert!(what.contains(expected), "{what}");
        };
        let of = |descr: &str, shape: &str, size: usize| {
            file(1, &format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}"), &vec![0; size])
        };
        fails(b"", "is not a complete npy file: copy it again");
        fails(b"\x93NUMPY\x01\x00\xff\xff{}", "is not a complete npy file: copy it again");
        fails(&file(4, "{}", &[]), "is not a complete npy file: copy it again");
        fails(&of("<i8", "1, 1", 8), "of type `<i8`");
        fails(&of("<f8\n", "1, 1", 8), "of type `<f8\\n`");
        fails(&of("<f8", "1,", 8), "has 1 axes");
        fails(&of("<f8", "1, 1, 2", 16), "has 3 axes");
        fails(&of("<f8", "1, 1, 1, 1", 8), "has 4 axes");
        fails(&of("<f8", "1, x", 8), "is not a complete npy file: copy it again");
        fails(&of("<f8", "2, 1", 8), "has 8 bytes of elements, which do not fit the shape (2, 1): copy it again");
        // The header announces more elements than memory could hold.
        fails(&of("<f8", "4294967296, 4294967297", 8), "8 bytes of elements");
        fails(&of("<f8", "99999999999999999999, 1", 8), "is not a complete npy file: copy it again");
    }
}
