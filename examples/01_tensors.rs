//! Arrays: shapes, broadcasting, reductions, products, slices. Nothing is differentiated yet, so there is no tape.
//!
//! ```text
//! cargo run --release --example 01_tensors
//! ```

use raygrad::{Axes, Tensor};

fn print(what: &str, x: &Tensor<f64>) {
    println!("{what} {:?}\n{:.3}\n", x.shape(), x.view());
}

fn main() {
    // A tensor is a shape and its elements, row by row. It is cheap to clone.
    let marks = Tensor::from_vec(&[3, 4], vec![5.0, 7.0, 9.0, 8.0, 6.0, 6.0, 8.0, 10.0, 9.0, 5.0, 7.0, 6.0]);
    print("Marks of three students in four subjects", &marks);

    // Reductions take any axes, counted from the front or the back.
    let means = marks.mean_over(Axes::from(-1).keepdims());
    print("The mean of each student", &means);

    // Shapes broadcast as in NumPy: [3, 4] - [3, 1].
    print("How far each mark is from the student's mean", &(&marks - &means));

    // Weights of subjects: a matrix times a vector.
    let weights = Tensor::from([0.4, 0.3, 0.2, 0.1]);
    print("Weighted marks", &marks.matmul(&weights));

    // Slices and permutations are views of the same memory.
    let last_two = marks.slice_axis(1, 2..4).t();
    print("The last two subjects, a row each", &last_two);
    let index = marks.argsort(1, true);
    print("Sorted, best mark first", &marks.gather(1, &index));
    println!("which are those of the subjects {index:?}\n");

    // Any ndarray converts to a tensor and back, without a copy where the layout allows it.
    println!("As an ndarray, transposed:\n{}", marks.into_array().t());
}
