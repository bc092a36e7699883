//! Einstein summation of one or two tensors: diagonals and sums of each, then one batched matrix product.

use crate::error::ensure;
use crate::{ShapeError, Var};
use raygrad_tensor::{Scalar, Shape};

/// A tensor whose axes have letters.
struct Labelled<'t, T: Scalar> {
    x: Var<'t, T>,
    labels: Vec<char>,
}

/// The letters of each operand and of the result.
///
/// # Errors
/// If the equation is malformed or does not fit the shapes.
fn parse(equation: &str, shapes: &[&[usize]]) -> Result<(Vec<Vec<char>>, Vec<char>), ShapeError> {
    let compact: String = equation.chars().filter(|c| !c.is_whitespace()).collect();
    let (left, right) = match compact.split_once("->") {
        Some((left, right)) => (left, Some(right)),
        None => (&compact[..], None),
    };
    let letters = |part: &str| match part.chars().find(|c| !c.is_alphabetic()) {
        None => Ok(part.chars().collect::<Vec<_>>()),
        Some(other) => Err(format!("{other:?} is no letter")),
    };
    let operands = left.split(',').map(letters).collect::<Result<Vec<_>, _>>()?;
    if operands.len() != shapes.len() {
        return Err(format!("the equation has {} operands, but there are {}", operands.len(), shapes.len()));
    }
    let mut extents: Vec<(char, usize)> = vec![];
    for (i, (labels, shape)) in operands.iter().zip(shapes).enumerate() {
        if labels.len() != shape.len() {
            return Err(format!("operand {i} has {} letters, but shape {shape:?}", labels.len()));
        }
        for (&label, &extent) in labels.iter().zip(*shape) {
            match extents.iter().find(|(known, _)| *known == label) {
                Some(&(_, known)) if known != extent => {
                    return Err(format!("`{label}` is {known} and {extent} in shapes {shapes:?}"));
                }
                Some(_) => {}
                None => extents.push((label, extent)),
            }
        }
    }
    let Some(right) = right else {
        // NumPy's rule: the letters that occur once, in alphabetical order.
        let times = |label| operands.iter().flatten().filter(|&&other| other == label).count();
        let mut result: Vec<char> =
            extents.iter().map(|&(label, _)| label).filter(|&label| times(label) == 1).collect();
        result.sort_unstable();
        return Ok((operands, result));
    };
    let result = letters(right)?;
    for (i, label) in result.iter().enumerate() {
        if result[..i].contains(label) {
            return Err(format!("`{label}` occurs twice in the result"));
        }
        if !extents.iter().any(|(known, _)| known == label) {
            return Err(format!("`{label}` of the result occurs in no operand"));
        }
    }
    Ok((operands, result))
}

impl<'t, T: Scalar> Labelled<'t, T> {
    fn extent(&self, label: char) -> usize {
        self.labels.iter().zip(self.x.shape()).find(|(other, _)| **other == label).map_or(1, |(_, &extent)| extent)
    }

    /// Takes the diagonal of the axes that share a letter.
    fn diagonals(mut self) -> Self {
        while let Some((a, b)) = self.repeated() {
            let x = self.x.view("einsum", |layout| Ok(layout.diagonal(a, b, 0)));
            let label = self.labels.remove(b);
            self.labels.remove(a);
            self.labels.push(label);
            self.x = x;
        }
        self
    }

    /// Two axes with one letter.
    fn repeated(&self) -> Option<(usize, usize)> {
        (0..self.labels.len()).find_map(|b| Some((self.labels[..b].iter().position(|&a| a == self.labels[b])?, b)))
    }

    /// Sums over the axes whose letters are not wanted.
    fn summed(self, wanted: impl Fn(char) -> bool) -> Self {
        let alone: Vec<_> = (0..self.labels.len()).filter(|&axis| !wanted(self.labels[axis])).collect();
        if alone.is_empty() {
            return self;
        }
        let keep = |axis: &usize| !alone.contains(axis);
        let axes: Vec<usize> = (0..self.labels.len()).filter(keep).collect();
        let alone: Vec<_> = alone.iter().map(|&axis| axis as isize).collect();
        Labelled { x: self.x.sum_over(&alone[..]), labels: axes.iter().map(|&axis| self.labels[axis]).collect() }
    }

    /// The axes in the order of these letters.
    fn ordered(&self, labels: &[char]) -> Var<'t, T> {
        if self.labels == labels {
            return self.x.clone();
        }
        let place = |label: &char| self.labels.iter().position(|other| other == label);
        let axes: Shape = labels.iter().filter_map(place).collect();
        self.x.reordered(&axes)
    }

    /// As matrices `[batch.., rows, columns]`, without a copy of axes that are already in order.
    fn matrices(&self, batch: &[char], rows: &[char], columns: &[char]) -> Var<'t, T> {
        let transpose = !rows.is_empty() && !columns.is_empty() && self.labels == [batch, columns, rows].concat();
        let (first, second) = if transpose { (columns, rows) } else { (rows, columns) };
        let product = |labels: &[char]| labels.iter().map(|&label| self.extent(label)).product::<usize>();
        let mut shape: Shape = batch.iter().map(|&label| self.extent(label)).collect();
        shape.extend([product(first), product(second)]);
        let x = self.ordered(&[batch, first, second].concat()).reshape(&shape);
        if transpose { x.t() } else { x }
    }
}

/// The result of a checked equation.
fn contract<'t, T: Scalar>(operands: Vec<Labelled<'t, T>>, result: &[char]) -> Var<'t, T> {
    let labels: Vec<Vec<char>> = operands.iter().map(|operand| operand.labels.clone()).collect();
    let wanted = |i: usize, label: char| {
        result.contains(&label) || labels.iter().enumerate().any(|(k, labels)| k != i && labels.contains(&label))
    };
    let reduce = |(i, operand): (usize, Labelled<'t, T>)| operand.diagonals().summed(|label| wanted(i, label));
    let mut operands = operands.into_iter().enumerate().map(reduce);
    let Some(a) = operands.next() else { unreachable!("an equation has an operand") };
    let Some(b) = operands.next() else { return a.ordered(result) };
    let in_b = |label: &char| b.labels.contains(label);
    let in_result = |label: &char| result.contains(label);
    let of_a = |shared: bool, kept: bool| -> Vec<char> {
        a.labels.iter().copied().filter(|label| in_b(label) == shared && in_result(label) == kept).collect()
    };
    let (batch, inner, left) = (of_a(true, true), of_a(true, false), of_a(false, true));
    let right: Vec<char> = b.labels.iter().copied().filter(|label| !a.labels.contains(label)).collect();
    let labels = [&batch[..], &left, &right].concat();
    let extent = |label: &char| if in_b(label) { b.extent(*label) } else { a.extent(*label) };
    let shape: Shape = labels.iter().map(extent).collect();
    let x = a.matrices(&batch, &left, &inner).matmul(b.matrices(&batch, &inner, &right)).reshape(&shape);
    Labelled { x, labels }.ordered(result)
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Einstein summation of one or two tensors (`numpy.einsum`, without `...`).
    ///
    /// Each axis has a letter. Axes that share a letter run together, and letters that are not in the result are summed
    /// over. Without `->`, the result has the letters that occur once, in alphabetical order. Spaces are ignored.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor, Var};
    /// let tape = Tape::<f64>::new();
    /// let a = tape.leaf(Tensor::from_fn(&[2, 3, 4], |i| i as f64));
    /// let b = tape.leaf(Tensor::from_fn(&[2, 4, 5], |i| i as f64));
    /// assert_eq!(Var::einsum("bij,bjk->bik", &[&a, &b]).value(), a.matmul(&b).value());
    /// assert_eq!(Var::einsum("bij->", &[&a]).item(), a.sum().item());
    /// let square = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
    /// let trace = Var::einsum("ii", &[&square]);
    /// assert_eq!(trace.item(), 5.0);
    /// assert_eq!(trace.grad(&[&square])[0], [[1.0, 0.0], [0.0, 1.0]]);
    /// ```
    ///
    /// # Panics
    /// If there are not one or two operands, or the equation does not fit the number of operands or their axes. If it
    /// has a character other than a letter, a comma or the arrow; `...` is not supported. If a letter stands for two
    /// extents, or the result repeats a letter or has a letter of no operand.
    #[track_caller]
    pub fn einsum(equation: &str, operands: &[&Self]) -> Self {
        let Some(first) = operands.first() else { panic!("einsum {equation:?} of no tensors") };
        let one_or_two =
            ensure(operands.len() < 3, || format!("{equation:?}: {} operands instead of 1 or 2", operands.len()));
        first.tape().fits("einsum", operands, one_or_two);
        let shapes: Vec<&[usize]> = operands.iter().map(|x| x.shape()).collect();
        match parse(equation, &shapes) {
            Err(what) => first.tape().fits("einsum", operands, Err(format!("{equation:?}: {what}"))),
            Ok((labels, result)) => {
                let labelled = operands.iter().zip(labels).map(|(&x, labels)| Labelled { x: x.clone(), labels });
                first.tape().as_one(|| contract(labelled.collect(), &result))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;
    use crate::check::spread;
    use crate::check::{Check, check_function};
    use raygrad_tensor::Tensor;

    /// The definition: a sum over all values of all letters.
    fn naive(labels: &[Vec<char>], result: &[char], x: &[Tensor<f64>]) -> Vec<f64> {
        let mut letters: Vec<(char, usize)> = vec![];
        let axes = labels.iter().zip(x).flat_map(|(labels, x)| labels.iter().copied().zip(x.shape().iter().copied()));
        for (label, extent) in axes {
            if !letters.iter().any(|(known, _)| *known == label) {
                letters.push((label, extent));
            }
        }
        let extent = |label: &char| letters.iter().find(|(known, _)| known == label).unwrap().1;
        let mut out = vec![0.0; result.iter().map(extent).product()];
        for mut number in 0..letters.iter().map(|(_, extent)| extent).product() {
            let mut value = vec![];
            for &(label, extent) in &letters {
                value.push((label, number % extent));
                number /= extent;
            }
            let at = |labels: &[char]| {
                let digit = |label: &char| value.iter().find(|(known, _)| known == label).unwrap().1;
                labels.iter().fold(0, |at, label| at * extent(label) + digit(label))
            };
            out[at(result)] += labels.iter().zip(x).map(|(labels, x)| x.as_slice()[at(labels)]).product::<f64>();
        }
        out
    }

    #[test]
    fn every_usual_contraction_agrees_with_its_definition() {
        let extent = |label: char| match label {
            'a' | 'i' => 2,
            'b' | 'j' => 3,
            'z' => 0,
            _ => 4,
        };
        for equation in [
            "ij->ji",
            "ij->i",
            "ij->",
            "ii->i",
            "ii",
            "iij->ji",
            "aia->i",
            "ji",
            "i,i->",
            "i,i->i",
            "i,j->ij",
            "i,j->ji",
            "ij,j->i",
            "ij,jk->ik",
            "ij,kj->ik",
            "ji,jk->ki",
            "bij,bjk->bik",
            "bij,bkj->bki",
            "abc,cd->abd",
            "abij,abjk->abik",
            "ijk,jil->kl",
            "abc,bca->",
            "ij,ij->ij",
            "ij,ij->j",
            "iij,jk->ik",
            "ab,cd->ad",
            ",ij->ij",
            "i,->i",
            ",->",
            "iz,zj->ij",
            "zi,ij->zj",
            "ac, cb",
            "aab,bcc->ac",
        ] {
            let parts: Vec<Vec<char>> =
                equation.split("->").next().unwrap().split(',').map(|part| part.trim().chars().collect()).collect();
            let shapes: Vec<Vec<usize>> =
                parts.iter().map(|part| part.iter().map(|&label| extent(label)).collect()).collect();
            let x: Vec<_> = shapes.iter().enumerate().map(|(i, shape)| spread(shape, &[-1.0..1.0], i)).collect();
            let (labels, result) = parse(equation, &shapes.iter().map(|shape| &shape[..]).collect::<Vec<_>>()).unwrap();
            let tape = Tape::new();
            let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
            let got = Var::einsum(equation, &leaves.iter().collect::<Vec<_>>());
            let extents: Vec<usize> = result.iter().map(|&label| extent(label)).collect();
            assert_eq!(got.shape(), &extents[..], "{equation}");
            for (got, expected) in got.value().as_slice().iter().zip(naive(&labels, &result, &x)) {
                assert!((got - expected).abs() < 1e-12, "{equation}: {got} instead of {expected}");
            }
            let check = Check { directions: 8, ..Check::default() };
            check_function(&check, &x, |x| Var::einsum(equation, &x.iter().collect::<Vec<_>>())).unwrap();
        }
    }

    #[test]
    fn what_an_equation_lacks_is_said() {
        let error = |equation: &str, shapes: &[&[usize]]| parse(equation, shapes).unwrap_err();
        assert!(error("ij,jk->ik", &[&[2, 3]]).contains("2 operands, but there are 1"));
        assert!(error("ij->i", &[&[2]]).contains("2 letters, but shape [2]"));
        assert!(error("ij,jk->ik", &[&[2, 3], &[4, 5]]).contains("`j` is 3 and 4"));
        assert!(error("ij->k", &[&[2, 3]]).contains("`k` of the result occurs in no operand"));
        assert!(error("ij->ii", &[&[2, 3]]).contains("`i` occurs twice"));
        assert!(error("...j->j", &[&[2, 3]]).contains("'.' is no letter"));
        assert!(error("i->->i", &[&[2]]).contains("'-' is no letter"));
    }
}
