//! NumPy's `.npy` files, of two axes.

use super::limits::start;
use raygrad_nn::npy;

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

impl Matrix {
    /// The matrix of a `.npy` file of f32 or f64 numbers, in either order of elements; or a message that follows the
    /// file's name. Some programs append an axis of extent 1.
    pub fn read(bytes: &[u8]) -> Result<Self, String> {
        let array = match npy::number_type(bytes) {
            Some("<f4") => npy::decode::<f32>(bytes).map(|array| array.cast()),
            Some(found) if found != "<f8" => {
                let what = "not `<f8` or `<f4`: write it with astype(numpy.float64)";
                return Err(format!("has elements of type `{}`, {what}", start(found)));
            }
            _ => npy::decode::<f64>(bytes),
        };
        let array = array.map_err(|what| what.to_string())?;
        match *array.shape() {
            [rows, columns] | [rows, columns, 1] => Ok(Matrix { rows, columns, values: array.to_vec() }),
            _ => Err(format!("has {} axes, not rows and columns", array.ndim())),
        }
    }

    /// The bytes of a `.npy` file with f64 numbers.
    pub fn write(&self) -> Vec<u8> {
        npy::encode(&[self.rows, self.columns], &self.values)
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
        let single = npy::encode::<f32>(&[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.5]);
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
        fails(&of("<f8", "2, 1", 8), "has 8 bytes of elements, which do not fit the shape [2, 1]: copy it again");
        // The header announces more elements than memory could hold.
        fails(&of("<f8", "4294967296, 4294967297", 8), "has shape [4294967296, 4294967297], which is too large");
        fails(&of("<f8", "99999999999999999999, 1", 8), "is not a complete npy file: copy it again");
    }
}
