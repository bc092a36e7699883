//! The operations. The file of each has its formula, derivative, documentation, sample inputs and exact values. To add
//! one, write it in the file of its kind and list it in `check/catalogue.rs`.

/// The elementwise functions of a file. A line `name(other) = Formula;` makes a method of [`Var`](crate::Var) from a
/// formula of one or two operands without parameters. `entries` lists all of them for the catalogue, and those
/// `also examined`.
macro_rules! elementwise {
    (
        $($(#[$doc:meta])+ $name:ident($($other:ident)?) = $formula:ident;)*
        $(also examined: $($parametric:expr),+;)?
    ) => {
        impl<'t, T: raygrad_tensor::Scalar> crate::Var<'t, T> {
            $(
                $(#[$doc])+
                #[track_caller]
                pub fn $name(&self $(, $other: impl crate::Operand<'t, T>)?) -> Self {
                    $formula.on([self $(, &$other.on(self.tape()))?])
                }
            )*
        }

        #[cfg(feature = "check")]
        pub(crate) fn entries() -> Vec<crate::check::Entry> {
            vec![
                $(crate::check::Entry::method(stringify!($name), $formula),)*
                $($(crate::check::Entry::examined($parametric)),+)?
            ]
        }
    };
}

pub(crate) mod activation;
pub(crate) mod arithmetic;
pub(crate) mod arrange;
pub(crate) mod convolution;
pub(crate) mod cross_entropy;
mod double;
pub(crate) mod einsum;
pub(crate) mod exponential;
pub(crate) mod extremum;
pub(crate) mod gradient_op;
pub(crate) mod layer_norm;
pub(crate) mod linear;
pub(crate) mod loss;
pub(crate) mod matmul;
pub(crate) mod matrix;
pub(crate) mod moments;
pub(crate) mod pick;
pub(crate) mod piecewise;
pub(crate) mod pooling;
pub(crate) mod power;
pub(crate) mod product;
pub(crate) mod reduce;
pub(crate) mod row_grad;
mod running;
pub(crate) mod scan;
pub(crate) mod segment;
pub(crate) mod select;
pub(crate) mod shape;
pub(crate) mod softmax;
pub(crate) mod sort;
pub(crate) mod trigonometric;
mod unbounded;
pub(crate) mod vector;
pub(crate) mod walk;

pub(crate) use arithmetic::{add, div, mul, sub};
pub use convolution::Conv2dConfig;
pub use linear::Activation;
pub use pooling::Pool2dConfig;
pub use row_grad::RowGrad;
pub use segment::Segments;
