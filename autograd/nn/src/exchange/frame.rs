//! Messages as bytes: numbers and byte strings, one after another.

use raygrad_tensor::{Scalar, Tensor, checked_len};

/// A message that is being written.
#[derive(Default)]
pub(crate) struct Frame(pub Vec<u8>);

impl Frame {
    pub fn number(&mut self, x: usize) {
        self.0.extend_from_slice(&(x as u64).to_le_bytes());
    }

    pub fn bytes(&mut self, bytes: &[u8]) {
        self.number(bytes.len());
        self.0.extend_from_slice(bytes);
    }

    /// Numbers of 4 bytes, after their number.
    pub fn integers(&mut self, integers: &[u32]) {
        self.number(integers.len());
        integers.iter().for_each(|x| self.0.extend_from_slice(&x.to_le_bytes()));
    }

    pub fn tensor<T: Scalar>(&mut self, tensor: &Tensor<T>) {
        self.number(tensor.shape().len());
        tensor.shape().iter().for_each(|&extent| self.number(extent));
        T::write_le(tensor.as_slice(), &mut self.0);
    }
}

/// The rest of a message that is being read. Every method returns `None` where the message does not hold what it asks
/// for.
pub(crate) struct Reader<'a>(pub &'a [u8]);

impl<'a> Reader<'a> {
    pub fn number(&mut self) -> Option<usize> {
        let (number, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        usize::try_from(u64::from_le_bytes(*number)).ok()
    }

    /// A number of 4 bytes.
    pub fn integer(&mut self) -> Option<u32> {
        let (number, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(u32::from_le_bytes(*number))
    }

    pub fn bytes(&mut self) -> Option<&'a [u8]> {
        let len = self.number()?;
        self.take(len)
    }

    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let (bytes, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(bytes)
    }

    /// A sequence of elements that `element` reads, after their number.
    pub fn sequence<E>(&mut self, mut element: impl FnMut(&mut Self) -> Option<E>) -> Option<Vec<E>> {
        let len = self.number()?;
        (0..len).map(|_| element(self)).collect()
    }

    pub fn tensor<T: Scalar>(&mut self) -> Option<Tensor<T>> {
        let shape = self.sequence(Reader::number)?;
        let len = checked_len(&shape)?.checked_mul(size_of::<T>())?;
        Some(Tensor::from_vec(&shape, T::read_le(self.take(len)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_and_cut_ones_are_refused() {
        let tensor = Tensor::from_fn(&[2, 3], |i| [f64::NAN, -0.0, 1e-310][i % 3]);
        let mut frame = Frame::default();
        frame.number(usize::MAX);
        frame.bytes(b"name");
        frame.tensor(&tensor);
        let read = |bytes: &[u8]| {
            let mut reader = Reader(bytes);
            let all = (reader.number()?, reader.bytes()?.to_vec(), reader.tensor::<f64>()?);
            reader.0.is_empty().then_some(all)
        };
        let (number, name, back) = read(&frame.0).unwrap();
        let bits = |tensor: &Tensor<f64>| tensor.as_slice().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert!(number == usize::MAX && name == b"name" && back.shape() == [2, 3] && bits(&back) == bits(&tensor));
        for len in 0..frame.0.len() {
            assert!(read(&frame.0[..len]).is_none(), "{len} bytes");
        }
        // A length that no memory holds.
        frame.0[12..16].fill(255);
        assert!(read(&frame.0).is_none());
    }
}
