//! The graph as a drawing in the DOT language.

use crate::Tape;
use crate::nodes::CONSTANT;
use crate::tape::LEAF;
use raygrad_tensor::Scalar;
use std::fmt::Write;

impl<T: Scalar> Tape<T> {
    /// The recorded operations in the DOT language of Graphviz. `dot -Tsvg` draws them.
    ///
    /// A node shows its number, operation, shape and the line of the user's code. Leaves are boxes. Nodes that
    /// [`Var::backward`](crate::Var::backward) has freed are dashed. An edge runs from an input to its result, with the
    /// number of the input if there are several. Constants are not on the graph.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::scalar(2.0));
    /// let y = x.sin() * &x;
    /// let dot = tape.to_dot();
    /// assert!(dot.contains("n0 -> n1;") && dot.contains("n1 -> n2 [label=\"0\"];"));
    /// ```
    pub fn to_dot(&self) -> String {
        let mut out = String::from("digraph tape {\n  node [fontname=\"monospace\"];\n");
        let mut line = |text: String| out.extend(["  ", &text, "\n"]);
        for i in 0..self.len() as u32 {
            match &*self.nodes.place(i).borrow() {
                None => line(format!("n{i} [label=\"{i} freed\", style=dashed];")),
                Some(node) => {
                    let (name, form) = match &node.op {
                        Some(op) => (op.name(), ""),
                        None => (LEAF, ", shape=box"),
                    };
                    let place = format!("{}:{}", node.at.file(), node.at.line());
                    let mut label = format!("{i} {name}\n{:?}\n{place}", node.output.shape());
                    // A backslash first, so that those of the other escapes stay.
                    for (plain, escaped) in [("\\", "\\\\"), ("\"", "\\\""), ("\n", "\\n")] {
                        label = label.replace(plain, escaped);
                    }
                    line(format!("n{i} [label=\"{label}\"{form}];"));
                }
            }
            self.nodes.with_edges(|edges| {
                let inputs = edges.of(i);
                for (which, input) in inputs.iter().enumerate().filter(|(_, input)| **input != CONSTANT) {
                    let mut edge = format!("n{input} -> n{i}");
                    if inputs.len() > 1 {
                        // Writing to a string does not fail.
                        let _ = write!(edge, " [label=\"{which}\"]");
                    }
                    line(edge + ";");
                }
            });
        }
        out + "}\n"
    }
}

#[cfg(test)]
mod tests {
    use crate::{Tape, Tensor};

    #[test]
    fn every_node_and_every_edge_is_drawn() {
        let tape = Tape::<f32>::new();
        let (w, c) = (tape.leaf(Tensor::zeros(&[3, 2])), tape.constant(Tensor::zeros(&[4, 3])));
        let line = line!();
        let y = c.matmul(&w);
        let loss = (&y * &y).sum();
        let dot = tape.to_dot();
        let place = |line| format!("{}:{line}", file!());
        for expected in [
            format!("n0 [label=\"0 leaf\\n[3, 2]\\n{}\", shape=box];", place(line - 1)),
            format!("n1 [label=\"1 matmul\\n[4, 2]\\n{}\"];", place(line + 1)),
            "n0 -> n1 [label=\"1\"];".into(),
            "n1 -> n2 [label=\"0\"];\n  n1 -> n2 [label=\"1\"];".into(),
            "n2 -> n3;".into(),
        ] {
            assert!(dot.contains(&expected), "{expected}\n{dot}");
        }
        assert!(dot.starts_with("digraph tape {\n") && dot.ends_with("}\n"));
        assert_eq!(dot.matches("->").count(), 4);
        // A recorded gradient has the line of the operation that it is the gradient of.
        let before = tape.len();
        loss.grad_graph(&[&w]);
        let dot = tape.to_dot();
        assert!(tape.len() > before && !dot.contains("src/ops"), "{dot}");
        loss.backward(&[&w]);
        assert!(tape.to_dot().contains("n2 [label=\"2 freed\", style=dashed];"));
        assert_eq!(Tape::<f64>::new().to_dot().lines().count(), 3);
    }
}
