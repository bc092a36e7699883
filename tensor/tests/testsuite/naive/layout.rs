//! Reading, writing and adding through layouts: permuted, sliced, flipped, diagonal and stretched.

use super::support::{in_both, same, values, wide};
use raygrad_tensor::{Layout, Scalar};

/// Where the element at an index stands in a buffer.
type Position = Box<dyn Fn(&[usize]) -> usize>;

/// A layout of a buffer of `source` elements, and the positions that it names.
struct Case {
    layout: Layout,
    source: usize,
    position: Position,
}

/// Layouts of buffers `[a, b, c]`.
fn cases(a: usize, b: usize, c: usize) -> Vec<Case> {
    let whole = Layout::contiguous(&[a, b, c]);
    let source = a * b * c;
    let at = move |i: usize, j: usize, k: usize| (i * b + j) * c + k;
    let mut cases: Vec<Case> = vec![];
    let mut case = |layout: Layout, position: Position| cases.push(Case { layout, source, position });
    case(whole.clone(), Box::new(move |x| at(x[0], x[1], x[2])));
    case(whole.permuted(&[2, 0, 1]), Box::new(move |x| at(x[1], x[2], x[0])));
    case(whole.permuted(&[0, 2, 1]), Box::new(move |x| at(x[0], x[2], x[1])));
    case(whole.permuted(&[2, 1, 0]), Box::new(move |x| at(x[2], x[1], x[0])));
    case(whole.sliced(2, c - 1, c, -1), Box::new(move |x| at(x[0], x[1], c - 1 - x[2])));
    case(whole.sliced(0, a - 1, a, -1).sliced(1, 1, b / 2, 2), Box::new(move |x| at(a - 1 - x[0], 1 + 2 * x[1], x[2])));
    case(
        whole.permuted(&[1, 2, 0]).sliced(1, 1, c - 2, 1).sliced(2, 0, a.div_ceil(3), 3),
        Box::new(move |x| at(3 * x[2], x[0], 1 + x[1])),
    );
    case(whole.diagonal(0, 1, 1), Box::new(move |x| at(x[1], x[1] + 1, x[0])));
    case(whole.diagonal(2, 1, -1), Box::new(move |x| at(x[0], x[1], x[1] + 1)));
    cases
}

/// Layouts that stretch a buffer.
fn stretched(a: usize, b: usize, c: usize) -> Vec<Case> {
    let case = |from: &[usize], position: Position| Case {
        layout: Layout::contiguous(from).stretched(&[a, b, c]),
        source: from.iter().product(),
        position,
    };
    vec![
        case(&[c], Box::new(|x| x[2])),
        case(&[b, 1], Box::new(|x| x[1])),
        case(&[a, 1, c], Box::new(move |x| x[0] * c + x[2])),
        case(&[a, 1, 1], Box::new(|x| x[0])),
        case(&[1, b, c], Box::new(move |x| x[1] * c + x[2])),
        case(&[], Box::new(|_| 0)),
    ]
}

fn index(shape: &[usize], mut i: usize) -> Vec<usize> {
    let mut index = vec![0; shape.len()];
    for axis in (0..shape.len()).rev() {
        index[axis] = i % shape[axis];
        i /= shape[axis];
    }
    index
}

fn walks<T: Scalar>() {
    // Small; around a piece of 32768; a long last axis; a long first one; enough for all threads.
    for [a, b, c] in [[3, 4, 5], [31, 33, 32], [33, 31, 33], [3, 5, 4097], [5, 2, 32_769], [2049, 5, 7], [70, 65, 64]] {
        for (stretches, cases) in [(false, cases(a, b, c)), (true, stretched(a, b, c))] {
            for (number, Case { layout, source, position }) in cases.into_iter().enumerate() {
                let count = layout.shape().iter().product::<usize>();
                let what = format!("layout {number} of {:?}, stretched {stretches}", [a, b, c]);
                let places: Vec<usize> = (0..count).map(|i| position(&index(layout.shape(), i))).collect();
                let (x, v) = (values::<T>(source, 1), values::<T>(count, 2));
                let mut out = vec![T::from_f64(f64::NAN); count];
                layout.read(&x, &mut out);
                same(&what, &out, places.iter().map(|&place| x[place].to_f64()));
                if !stretches {
                    let mut target = x.clone();
                    layout.write(&v, &mut target);
                    let mut expected = wide(&x);
                    places.iter().zip(&v).for_each(|(&place, v)| expected[place] = v.to_f64());
                    same(&format!("written {what}"), &target, expected);
                }
                let mut target = x.clone();
                layout.add(&v, &mut target);
                let (mut expected, mut sizes) = (wide(&x), wide(&x));
                sizes.iter_mut().for_each(|x| *x = x.abs());
                for (&place, v) in places.iter().zip(&v) {
                    expected[place] += v.to_f64();
                    sizes[place] += v.to_f64().abs();
                }
                let pairs = expected.into_iter().zip(sizes).map(|(sum, size)| [sum, size]);
                // Only along the innermost axis are sums pairwise: one after another, the error grows as a walk.
                let units = 16.0 + ((count / source) as f64).sqrt();
                crate::naive::support::summed(&format!("added {what}"), &target, units, pairs);
            }
        }
    }
}

#[test]
fn walks_through_layouts() {
    in_both!(walks);
}
