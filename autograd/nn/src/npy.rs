//! NumPy's `.npy` files: one array.
//!
//! ```
//! use raygrad_autograd::Tensor;
//! use raygrad_nn::npy;
//! let x = Tensor::from([[0.5_f32, -1.0], [2.0, 4.0]]);
//! let bytes = npy::encode(x.shape(), x.as_slice()); // as numpy.save writes it
//! assert_eq!(npy::decode::<f32>(&bytes)?, x);
//! # Ok::<(), npy::NpyError>(())
//! ```

use crate::files::shown;
use raygrad_tensor::{Scalar, Shape, Tensor};

/// The first bytes of a file.
pub const MAGIC: &[u8] = b"\x93NUMPY";

/// The reason that a `.npy` file cannot be read. The message continues the name of the file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct NpyError(String);

fn broken() -> NpyError {
    NpyError("is not a complete npy file: copy it again".into())
}

/// Encodes an array of this shape, in row-major order, as `numpy.save` does: in version 1, or 2 for very many axes.
///
/// # Panics
/// If the shape has another number of elements.
pub fn encode<T: Scalar>(shape: &[usize], values: &[T]) -> Vec<u8> {
    assert_eq!(shape.iter().product::<usize>(), values.len(), "elements of an array of shape {shape:?}");
    let mut extents = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    if shape.len() == 1 {
        // Python's tuple of one element.
        extents.push(',');
    }
    let mut text = format!("{{'descr': '{}', 'fortran_order': False, 'shape': ({extents}), }}", descr::<T>());
    let long = text.len() > usize::from(u16::MAX) - 128;
    let prefix = if long { 12 } else { 10 };
    // The elements start at a multiple of 64 bytes.
    let padding = (prefix + text.len() + 1).next_multiple_of(64) - prefix - text.len() - 1;
    text.extend(std::iter::repeat_n(' ', padding));
    text.push('\n');
    let mut bytes = MAGIC.to_vec();
    if long {
        bytes.extend([2, 0]);
        bytes.extend((text.len() as u32).to_le_bytes());
    } else {
        bytes.extend([1, 0]);
        bytes.extend((text.len() as u16).to_le_bytes());
    }
    bytes.extend(text.as_bytes());
    T::write_le(values, &mut bytes);
    bytes
}

/// The type of a file's numbers in NumPy's notation, such as `<f4`; `None` if it is damaged.
pub fn number_type(bytes: &[u8]) -> Option<&str> {
    let (header, _) = split(bytes)?;
    let found = member(header, "descr")?.trim_start_matches(['\'', '"']);
    found.split(['\'', '"']).next()
}

/// Decodes the array of a file, in either order of elements.
///
/// # Errors
/// If the file is damaged, has numbers of another type, or its shape does not fit the number of elements.
pub fn decode<T: Scalar>(bytes: &[u8]) -> Result<Tensor<T>, NpyError> {
    let (header, data) = split(bytes).ok_or_else(broken)?;
    let found = number_type(bytes).unwrap_or_default();
    if found != descr::<T>() {
        return Err(NpyError(format!("holds numbers of type `{}`, not `{}`", shown(found), descr::<T>())));
    }
    let extents = member(header, "shape").and_then(|rest| rest.strip_prefix('(')?.split_once(')'));
    let extents = extents.ok_or_else(broken)?.0.split(',').map(str::trim).filter(|extent| !extent.is_empty());
    let shape = extents.map(|extent| extent.parse().map_err(|_| broken())).collect::<Result<Shape, NpyError>>()?;
    // Without its empty axes, too, a shape must be of a size that memory could hold: an array library may multiply these.
    let mut size = shape.iter().filter(|&&extent| extent > 0);
    let size = size.try_fold(size_of::<T>(), |size, &extent| size.checked_mul(extent));
    let Some(size) = size.filter(|&size| isize::try_from(size).is_ok()) else {
        return Err(NpyError(format!("has shape {shape:?}, which is too large")));
    };
    if data.len() != if shape.contains(&0) { 0 } else { size } {
        let what = format!("has {} bytes of elements, which do not fit the shape {shape:?}: copy it again", data.len());
        return Err(NpyError(what));
    }
    let values = T::read_le(data);
    let by_columns = member(header, "fortran_order").ok_or_else(broken)?.starts_with("True");
    Ok(if by_columns { from_columns(&shape, &values) } else { Tensor::from_vec(&shape, values) })
}

/// NumPy's name of the number type, in little-endian order.
fn descr<T: Scalar>() -> &'static str {
    if size_of::<T>() == 4 { "<f4" } else { "<f8" }
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

/// A tensor from elements in column-major order (the first index varies fastest).
fn from_columns<T: Scalar>(shape: &[usize], values: &[T]) -> Tensor<T> {
    Tensor::from_fn(shape, |mut i| {
        let (mut place, mut stride) = (0, values.len());
        for &extent in shape.iter().rev() {
            stride /= extent;
            place += i % extent * stride;
            i /= extent;
        }
        values[place]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A `.npy` file of version 2.
    fn file(header: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x02\x00".to_vec();
        bytes.extend((header.len() as u32).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    #[test]
    fn shapes_beyond_memory_are_errors() {
        let whole = format!("{}", u64::MAX);
        for shape in [
            "(0, 9223372036854775808)",
            "(9223372036854775808, 0)",
            "(9223372036854775808, 2, 0)",
            "(0, 4294967296, 4294967296)",
            "(0, 1152921504606846976, 8)",
            "(4294967296, 4294967296)",
            "(9223372036854775808, 2)",
            "(1152921504606846976,)",
            &format!("({whole}, {whole})"),
            "(36893488147419103232,)",
            "(-1,)",
        ] {
            for order in ["False", "True"] {
                let header = format!("{{'descr': '<f4', 'fortran_order': {order}, 'shape': {shape}, }}");
                for data in [&[][..], &[0; 8]] {
                    let error = decode::<f32>(&file(&header, data)).expect_err(shape).to_string();
                    let words = ["which is too large", "is not a complete npy file", "which do not fit the shape"];
                    assert!(words.iter().any(|words| error.contains(words)), "{shape}: {error}");
                }
            }
        }
        // As large as an empty array may be.
        let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 1152921504606846976), }";
        assert_eq!(decode::<f32>(&file(header, &[])).unwrap().shape(), [0, 1 << 60]);
    }

    #[test]
    fn types_are_named_on_one_line() {
        let bytes = file("{'descr': 'a\nb', 'fortran_order': False, 'shape': ()}", &[]);
        let error = decode::<f32>(&bytes).unwrap_err().to_string();
        assert!(error.contains("of type `a\\nb`"), "{error}");
        assert_eq!((number_type(&bytes), number_type(b"")), (Some("a\nb"), None));
    }

    #[test]
    fn headers_are_those_of_numpy() {
        assert_eq!(encode::<f32>(&[3, 4], &[0.0; 12]).len(), 128 + 48);
        assert!(
            encode::<f32>(&[], &[0.0])
                .starts_with(b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (), }")
        );
        for (shape, written) in [(&[3][..], "(3,)"), (&[1, 3], "(1, 3)"), (&[3, 1, 1], "(3, 1, 1)")] {
            let bytes = encode(shape, &[0.0_f32; 3]);
            let header = String::from_utf8_lossy(&bytes[10..128]);
            assert!(header.contains(&format!("'shape': {written}, }}")), "{header}");
        }
        assert!(encode::<f64>(&[0], &[]).ends_with(b" \n"));
        for text in [
            "{'descr': '<f4', 'fortran_order': False, 'shape': (3,), }",
            "{\"shape\" : (3 ,) , \"fortran_order\":False,\"descr\":\"<f4\"}\n",
        ] {
            let bytes = file(text, &[0; 12]);
            assert_eq!(decode::<f32>(&bytes).unwrap(), Tensor::zeros(&[3]));
            assert!(decode::<f32>(&bytes[..bytes.len() - 1]).unwrap_err().to_string().contains("11 bytes"));
        }
    }
}
