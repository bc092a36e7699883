//! Arrays: shapes, broadcasting, reductions, slices. Nothing is differentiated yet: a tape's constants are used as NumPy's
//! arrays are.
//!
//! ```text
//! cargo run --release --example 01_tensors
//! ```

use raygrad::{Axes, Tape, Tensor, Var};

fn print(what: &str, x: &Var<'_, f64>) {
    println!("{what} {:?}\n{:.3}\n", x.shape(), x.value().view());
}

fn main() {
    // A tensor is a shape and its elements, row by row. It is cheap to clone.
    let marks = Tensor::from_vec(&[3, 4], vec![5.0, 7.0, 9.0, 8.0, 6.0, 6.0, 8.0, 10.0, 9.0, 5.0, 7.0, 6.0]);
    let tape = Tape::<f64>::new();
    let marks = tape.constant(marks);
    print("Marks of three students in four subjects", &marks);

    // Reductions take any axes, counted from the front or the back.
    let means = marks.mean_over(Axes::from(-1).keepdims());
    print("The mean of each student", &means);

    // Shapes broadcast as in NumPy: [3, 4] - [3, 1].
    print("How far each mark is from the student's mean", &(&marks - &means));

    // Weights of subjects: a matrix times a vector.
    let weights = tape.constant(Tensor::from([0.4, 0.3, 0.2, 0.1]));
    print("Weighted marks", &marks.matmul(&weights));

    // Slices, permutations and joins make new tensors.
    let last_two = marks.slice_axis(1, 2..4).t();
    print("The last two subjects, a row each", &last_two);
    let (sorted, index) = marks.sort(1, true);
    print("Sorted, best mark first", &sorted);
    println!("which are those of the subjects {index:?}\n");

    // Any ndarray converts to a tensor and back, without a copy where the layout allows it.
    let array = marks.value().clone().into_array();
    println!("As an ndarray, transposed:\n{}", array.t());
}
